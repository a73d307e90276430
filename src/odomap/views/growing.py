"""Plots of how a run grows: keyframes, landmarks and memory over time, side by side.

All begin at zero, so that a flat line is one: a camera that stays where it was should not make the
map larger. With thousands of frames, of each column of neighbouring frames the largest is drawn.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from odomap.maps.estimate import Estimate
from odomap.views.record import Growth
from odomap.views.style import PALETTE, dress, legend, new_figure
from odomap.views.timelines import columns, seconds

__all__ = ["growth_figure"]


@dataclass(frozen=True, eq=False)
class _Panel:
    """One quantity: its title, times in seconds, values, and how many were ever made."""

    title: str
    t: NDArray[np.float64]
    values: NDArray[np.float64]
    made: NDArray[np.float64] | None = None


def growth_figure(estimates: Sequence[Estimate], growth: Growth) -> Figure | None:
    """Draw what was counted with every frame; None where nothing was.

    Args:
        estimates: one per frame, in order.
        growth: what was counted after each.
    """
    panels = _panels(estimates, growth)
    if not panels:
        return None
    figure = new_figure(9.6, 2.5)
    axes = figure.subplots(1, len(panels), squeeze=False, gridspec_kw={"wspace": 0.2})[0]
    end = max(float(seconds(estimates)[-1]), 1e-3)
    for ax, panel in zip(axes, panels):
        dress(ax, panel.title, "time [s]")
        _draw(ax, panel)
        ax.set_xlim(-0.01 * end, 1.01 * end)
    return figure


def _panels(estimates: Sequence[Estimate], growth: Growth) -> list[_Panel]:
    t = seconds(estimates)
    panels = []
    if len(t) and len(growth.keyframes) == len(t):
        made = growth.before(estimates) + growth.made(estimates)
        panels.append(
            _Panel("Keyframes", t, growth.keyframes.astype(np.float64), made.astype(np.float64))
        )
        if growth.landmarks.any():  # lasers have none
            panels.append(_Panel("Landmarks", t, growth.landmarks.astype(np.float64)))
    inside = growth.memory_frames < len(t)
    if inside.any() and (growth.memory_mb[inside] > 0).all():
        memory = growth.memory_mb[inside]
        at = np.r_[t[growth.memory_frames[inside]], t[-1]]
        panels.append(_Panel("Memory held [MB]", at, np.r_[memory, memory[-1]]))
    return panels


def _draw(ax: Axes, panel: _Panel) -> None:
    starts = columns(len(panel.t))
    t, most = panel.t[starts], np.maximum.reduceat(panel.values, starts)
    style: dict[str, Any] = {"drawstyle": "steps-post", "lw": 1.4}
    ax.fill_between(t, most, color=PALETTE["band"], lw=0, step="post", alpha=0.6)
    ax.plot(t, most, color=PALETTE["estimate"], label="in the map", **style)
    top = float(most.max())
    if panel.made is not None and (panel.made > panel.values).any():
        style |= {"lw": 1.0, "ls": (0, (3, 2)), "color": PALETTE["muted"]}
        ax.plot(t, panel.made[starts], label="made", **style)
        top = max(top, float(panel.made.max()))
        legend(ax)
    ax.set_ylim(0.0, max(1.12 * top, 1.0))
