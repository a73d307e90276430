"""Plots over the frames of a run: how many points held the pose, and where the time went.

With thousands of frames, columns of neighbouring frames are merged: the worst of each column is
drawn for inliers (a dip must not vanish), the mean and the maximum for times.
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from odomap.maps.estimate import Estimate, Status
from odomap.views.record import lost_runs
from odomap.views.scene import thin
from odomap.views.style import PALETTE, STAGES, dress, legend, new_figure, plain

__all__ = ["columns", "inlier_figure", "seconds", "stage_colours", "stage_times", "timing_figure"]

COLUMNS = 500
RUG = 400
MOST_IN_A_ROW = 5
"""Entries of a legend in a row beside the title."""


def inlier_figure(estimates: Sequence[Estimate]) -> Figure:
    """Draw how many observations held each pose; keyframes ticked, lost frames shaded."""
    figure = new_figure(9.6, 2.8)
    ax = dress(figure.subplots(), "Inliers per frame", "time [s]")
    if not estimates:
        return _nothing(figure, ax)
    t = seconds(estimates)
    counts = np.array([e.num_inliers for e in estimates], np.float64)
    starts = columns(len(t))
    worst = np.minimum.reduceat(counts, starts)
    ax.fill_between(t[starts], worst, color=PALETTE["band"], lw=0, step="post")
    ax.plot(t[starts], worst, color=PALETTE["estimate"], lw=1.2, drawstyle="steps-post",
            label="inliers" if len(starts) == len(t) else "fewest inliers")  # fmt: skip
    top = max(float(counts.max()) * 1.12, 1.0)
    _shade_lost(ax, estimates, t)
    keyframes = np.array([e.is_keyframe for e in estimates])
    recovered = np.array([e.status is Status.RECOVERED for e in estimates])
    _rug(ax, t[keyframes], 0.0, "keyframe", "|", PALETTE["keyframe"])
    _rug(ax, t[recovered], 0.94 * top, "recovered", "v", PALETTE["good"])
    ax.set_ylim(0.0, top)
    ax.margins(x=0.01)
    legend(ax)
    return figure


def _shade_lost(ax: Axes, estimates: Sequence[Estimate], t: NDArray[np.float64]) -> None:
    period = float(np.median(np.diff(t))) if len(t) > 1 else 1.0
    runs = lost_runs(estimates)
    for k, run in enumerate(runs[:RUG]):
        end = t[run.first + run.count - 1]
        label = "lost" if k == 0 else None
        style = {"color": PALETTE["lost"], "alpha": 0.3, "lw": 0}
        ax.axvspan(t[run.first], end + period, label=label, **style)  # type: ignore[arg-type]


def _rug(ax: Axes, t: NDArray[np.float64], y: float, label: str, mark: str, colour: str) -> None:
    """Mark some times at one height, thinned to what can be told apart."""
    t = t[thin(len(t), RUG)]
    if len(t):
        style = {"marker": mark, "ms": 7, "mew": 1.3, "ls": "", "color": colour, "clip_on": False}
        ax.plot(t, np.full(len(t), y), label=label, zorder=4, **style)  # type: ignore[arg-type]


def stage_times(estimates: Sequence[Estimate]) -> dict[str, NDArray[np.float64]]:
    """Return milliseconds per frame of each stage (N,), those of the most frames first.

    Stages of equally many frames keep the order in which they first appear. Frames without a stage
    count as 0; a stage named "total" is left out.
    """
    count = Counter(name for e in estimates for name in e.timing if name != "total")
    names = sorted(count, key=lambda name: -count[name])
    rows = {n: np.array([e.timing.get(n, 0.0) for e in estimates], np.float64) for n in names}
    return {name: np.where(np.isfinite(ms), ms, 0.0) for name, ms in rows.items()}


def stage_colours(stages: dict[str, NDArray[np.float64]]) -> dict[str, str]:
    """Return the colour in which each stage is drawn; those summed as "other" share one."""
    few = dict(zip(_few(stages, len(STAGES)), STAGES))
    return {name: few.get(name, STAGES[-1]) for name in stages}


def timing_figure(estimates: Sequence[Estimate]) -> Figure:
    """Draw the time of each stage, stacked, over the frames; a line marks the camera's period."""
    figure = new_figure(9.6, 3.2)
    ax = dress(figure.subplots(), "Time per frame [ms]", "time [s]")
    stages = _few(stage_times(estimates), len(STAGES))
    if not stages:
        return _nothing(figure, ax)
    t = seconds(estimates)
    starts = columns(len(t))
    sizes = np.diff(np.r_[starts, len(t)])
    means = [np.add.reduceat(ms, starts) / sizes for ms in stages.values()]
    edges = np.r_[t[starts], t[-1] + (t[-1] - t[0]) / max(len(t) - 1, 1)]
    below = np.zeros(len(starts))
    for name, mean, colour in zip(stages, means, STAGES):
        low, high = np.r_[below, below[-1]], np.r_[below + mean, below[-1] + mean[-1]]
        ax.fill_between(edges, low, high, step="post", color=colour, lw=0, label=plain(name))
        below = below + mean
    total = np.sum(list(stages.values()), axis=0)
    worst = np.maximum.reduceat(total, starts)
    if len(starts) < len(t):
        ax.plot(t[starts], worst, color=PALETTE["muted"], lw=0.8, label="slowest frame")
    _limits(ax, total, t)
    # In two rows where there are many, of which the upper one needs a margin.
    rows = 1 if len(ax.get_legend_handles_labels()[1]) <= MOST_IN_A_ROW else 2
    figure.subplots_adjust(top=1.0 - (0.14 + 0.18 * rows) / figure.get_figheight())
    legend(ax, ncols=MOST_IN_A_ROW)
    return figure


def _limits(ax: Axes, total: NDArray[np.float64], t: NDArray[np.float64]) -> None:
    usual, most = float(np.percentile(total, 98)), float(total.max())
    # One slow first frame must not press all others flat; it is told in words instead.
    clipped = most > 2.5 * usual > 0
    top = 1.5 * usual if clipped else 1.1 * most
    period = 1000.0 * float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    if 0 < period < 3.0 * usual:
        top = max(top, 1.15 * period)
        style = {"color": PALETTE["ink"], "lw": 1.0, "ls": (0, (4, 3))}
        ax.axhline(period, label=f"camera period {period:.0f} ms", **style)  # type: ignore[arg-type]
    if clipped:
        at = t[int(np.argmax(total))]
        ax.annotate(f"{most:.0f} ms ↑", (at, top), (3, -10), textcoords="offset points",
                    fontsize=8, color=PALETTE["ink"], annotation_clip=False)  # fmt: skip
    ax.set_ylim(0.0, max(top, 1e-3))
    ax.margins(x=0.01)


def _few(stages: dict[str, NDArray[np.float64]], limit: int) -> dict[str, NDArray[np.float64]]:
    """Keep the costliest stages, in their order, and sum the rest as "other"."""
    if len(stages) <= limit:
        return stages
    kept = sorted(stages, key=lambda name: float(stages[name].mean()), reverse=True)[: limit - 1]
    few = {name: ms for name, ms in stages.items() if name in kept}
    few["other"] = np.sum([ms for name, ms in stages.items() if name not in kept], axis=0)
    return few


def seconds(estimates: Sequence[Estimate]) -> NDArray[np.float64]:
    """Return the time of each frame after the first, seconds."""
    stamps = np.array([e.stamp_ns for e in estimates], np.int64)
    return np.asarray((stamps - stamps[:1]) * 1e-9, np.float64)


def columns(n: int) -> NDArray[np.intp]:
    """Return where each column of merged frames starts."""
    return np.unique(np.linspace(0, n, min(n, COLUMNS), endpoint=False).astype(np.intp))


def _nothing(figure: Figure, ax: Axes) -> Figure:
    ax.set_axis_off()
    ax.text(0.5, 0.5, "nothing was recorded", ha="center", va="center",
            transform=ax.transAxes, fontsize=10, color=PALETTE["muted"])  # fmt: skip
    return figure
