"""The plan of loops: the path before and after them, side by side, and the largest one close up.

Both panels of a row show the same piece of the world at the same scale, so that what moved between
them is what closing the loops did; on the right the path before stays as a pale line. It ends where
the last loop was found: what was tracked from then on was on the path corrected. A correction of a
metre is a hair in the plan of a street: then a second row shows the loop that moved the path most
from near by, from above or, where it moved upwards, from the side.
"""

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from odomap.views.loopview import LoopView
from odomap.views.scene import AXES, Scene, gaps_as_nan, thin
from odomap.views.style import PALETTE, dress, new_figure

__all__ = ["ENDS", "draw_loops", "loops_figure"]

Array = NDArray[np.float64]

PATH_POINTS = 1500
MANY, FINEST = 12, 0.2
"""More loops are drawn finer, down to this part of width and ink."""
NUMBERED = 9
"""At most so many loops have their numbers beside them."""
NEAR = 0.35
"""A close look is drawn if it shows less than this share of the plan's width."""
MARGIN = 2.2
"""A close look is this many times as large as the loop before and after."""
LEAST = 0.005
"""The loop counts as at least this share of the path's extent."""
DEPTH = 3.0
"""A close look leaves out what is farther away than so many times its size."""
ENDS = "came back here", "had been here"


def loops_figure(place: Scene, view: LoopView, axes: tuple[int, int], unit: str = "m") -> Figure:
    """Draw the path before and after its loops were closed.

    Args:
        place: the path at the end, and its truth.
        view: the loops; one at least was closed.
        axes: which are drawn to the right and upwards.
        unit: what lengths are in; "units" where a path has no scale.
    """
    last = max(record.stamp_ns for record in view.log.closed)
    n = view.largest
    middle = _moved(place, view.after[n].mean(axis=0))
    panels = [_Panel(axes, _whole(place, view, axes), "", last, middle)]
    near = near_axes(place, view, n)
    window = _close(place, view, near, n)
    if window[1].max() < NEAR * panels[0].window[1].max():
        which = f"loop {n + 1}" if len(view.after) > 1 else "the loop"
        side = " from the side" if place.up_axis in near and place.up_axis not in axes else ""
        close = f", {which} close up{side}"
        stamp, depth = view.log.closed[n].stamp_ns, DEPTH * float(window[1].max())
        panels.append(_Panel(near, window, close, stamp, middle, depth))
    height = 3.6 * len(panels) + 0.5
    figure = new_figure(9.6, height)
    grid = figure.subplots(len(panels), 2, squeeze=False, gridspec_kw={"wspace": 0.14})
    figure.subplots_adjust(hspace=0.32, top=1.0 - 0.62 / height)
    for row, panel in zip(grid, panels):
        for ax, is_after in zip(row, (False, True)):
            names = [f"{AXES[k]} [{unit}]" for k in panel.axes]
            title = f"{'After' if is_after else 'Before'}{panel.title}"
            dress(ax, title, names[0], "" if is_after else names[1])
            _draw(ax, place, view, panel, is_after)
            _show(ax, panel.window)
            if place.up_sign < 0 and panel.axes[1] == place.up_axis:
                ax.invert_yaxis()
    _legend(figure, grid[0][1])
    return figure


@dataclass(frozen=True)
class _Panel:
    """What a row of panels shows.

    Attributes:
        axes: to the right and upwards.
        window: middle and size (2,) of what is seen.
        title: what is said of it.
        until_ns: the path before is drawn until then: it has been corrected since.
        around: (3,) and what is farther from it, behind or before, is left out.
        depth: how far.
    """

    axes: tuple[int, int]
    window: tuple[Array, Array]
    title: str
    until_ns: int
    around: Array
    depth: float = np.inf

    def flat(self, points: Array, stamps_ns: NDArray[np.int64] | None = None) -> Array:
        """Return (N, 2) of (N, 3) points, with NaN where a line over them breaks."""
        flat = np.array(points[:, list(self.axes)])
        flat[np.linalg.norm(points - self.around, axis=1) > self.depth] = np.nan
        return flat if stamps_ns is None else gaps_as_nan(stamps_ns, flat)


def draw_loops(ax: Axes, pairs: Array, dots: float = 3.2) -> None:
    """Draw loops as lines from where it came back (dot) to where it had been (ring).

    The more there are, the finer: a laser closes hundreds, and the path is to be seen below.

    Args:
        ax: where to.
        pairs: (L, 2, 2) both ends of each.
        dots: their size, points.
    """
    if not len(pairs):
        return
    fine = float(np.clip((MANY / len(pairs)) ** 0.5, FINEST, 1.0))
    line = np.concatenate([pairs, np.full((len(pairs), 1, 2), np.nan)], axis=1).reshape(-1, 2)
    style = {"color": PALETTE["loop"], "solid_capstyle": "round", "zorder": 7, "alpha": fine}
    ax.plot(*line.T, lw=max(1.6 * fine, 0.5), label="loop", **style)  # type: ignore[arg-type]
    style |= {"marker": "o", "ls": "", "ms": dots * fine, "mew": 1.4 * fine, "zorder": 8}
    fills = PALETTE["loop"], PALETTE["paper"]
    for k, (label, fill) in enumerate(zip(ENDS, fills)):
        ax.plot(*pairs[:, k].T, mfc=fill, label=label, **style)  # type: ignore[arg-type]


def _moved(place: Scene, points: Array) -> Array:
    T = place.T_drawn_world
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def _draw(ax: Axes, place: Scene, view: LoopView, panel: _Panel, is_after: bool) -> None:
    if place.truth is not None:
        true = panel.flat(place.truth[thin(len(place.truth), PATH_POINTS)])
        ax.plot(*true.T, color=PALETTE["truth"], lw=2.6, alpha=0.5, label="truth", zorder=2)
    told = view.live.rows(np.flatnonzero(view.live.stamps_ns <= panel.until_ns))
    keep = thin(len(told), PATH_POINTS)
    was = panel.flat(_moved(place, told.positions[keep]), told.stamps_ns[keep])
    if is_after:
        keep = thin(len(place.positions), PATH_POINTS)
        now = panel.flat(place.positions[keep], place.stamps_ns[keep])
        ax.plot(*was.T, color=PALETTE["before"], lw=2.2, label="path as it was before", zorder=3)
        ax.plot(*now.T, color=PALETTE["estimate"], lw=1.4, label="path", zorder=4)
    else:
        ax.plot(*was.T, color=PALETTE["estimate"], lw=1.4, label="path", zorder=4)
    ends = _moved(place, (view.after if is_after else view.before).reshape(-1, 3))
    pairs = panel.flat(ends).reshape(-1, 2, 2)
    draw_loops(ax, pairs, dots=6.0 if panel.title else 4.5)
    if 1 < len(pairs) <= NUMBERED:
        for n, at in enumerate(pairs[:, 0], 1):
            ax.annotate(
                str(n), at, (6, 5), textcoords="offset points", fontsize=9, fontweight="bold",
                color=PALETTE["loop"], zorder=9, clip_on=True,
            )  # fmt: skip


def near_axes(place: Scene, view: LoopView, loop: int) -> tuple[int, int]:
    """Return the axes that show best what a loop moved: from the side where that was upwards."""
    moved = np.abs(_moved(place, view.after[loop]) - _moved(place, view.before[loop])).sum(axis=0)
    a, b = place.ground
    if moved[place.up_axis] <= max(moved[a], moved[b]):
        return a, b
    span = np.abs(np.diff(_moved(place, view.after[loop]), axis=0))[0]
    return (a if span[a] >= span[b] else b), place.up_axis


def _whole(place: Scene, view: LoopView, axes: tuple[int, int]) -> tuple[Array, Array]:
    """Return middle and size (2,) of what holds the path before and after."""
    shown = [place.positions, _moved(place, view.live.positions)]
    shown += [_moved(place, np.concatenate([view.before, view.after]).reshape(-1, 3))]
    shown += [place.truth] if place.truth is not None else []
    points = np.concatenate(shown)[:, list(axes)]
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2, 1.1 * np.maximum(high - low, 1e-3)


def _close(place: Scene, view: LoopView, axes: tuple[int, int], loop: int) -> tuple[Array, Array]:
    """Return middle and size (2,) of what a loop needs to be seen from near by."""
    ends = _moved(place, np.concatenate([view.before[loop], view.after[loop]]))[:, list(axes)]
    low, high = ends.min(axis=0), ends.max(axis=0)
    whole = float(np.ptp(place.positions, axis=0).max())
    return (low + high) / 2, MARGIN * np.maximum(high - low, LEAST * whole)


def _show(ax: Axes, window: tuple[Array, Array]) -> None:
    """Show a window in the whole of the axes, with equal scales."""
    figure = ax.get_figure()
    assert figure is not None
    box = ax.get_position()
    wide = box.width * figure.bbox.width / (box.height * figure.bbox.height)
    middle, size = window
    half = max(float(size[1]), float(size[0]) / wide) / 2
    ax.set_xlim(middle[0] - half * wide, middle[0] + half * wide)
    ax.set_ylim(middle[1] - half, middle[1] + half)
    ax.set_aspect("equal", adjustable="box")


def _legend(figure: Figure, ax: Axes) -> None:
    """Put what lines and dots mean above all panels."""
    handles, labels = ax.get_legend_handles_labels()
    order = ("path", "path as it was before", "truth", *ENDS)
    chosen = [handles[labels.index(name)] for name in order if name in labels]
    legend = figure.legend(
        handles=chosen,
        loc="upper left",
        bbox_to_anchor=(0.055, 1.0),
        ncols=len(chosen),
        fontsize=8,
        labelcolor=PALETTE["ink"],
        frameon=False,
        handlelength=1.4,
    )
    for handle in legend.legend_handles:
        if isinstance(handle, Line2D) and handle.get_linestyle() == "None":
            handle.set(
                alpha=1.0, markersize=4.5, markeredgewidth=1.4
            )  # however fine they are drawn
