"""Plots of a path: where it went, and how far it is from the truth.

Every function takes values and returns a new matplotlib `Figure`; nothing is drawn on a screen and
no state is kept (pyplot is not used), so that plots can be made in any thread. Long recordings are
thinned to what an eye can resolve. The other plots stand in `timelines` and `frames` and can be had
from here.
"""

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from odomap.geometry.trajectory import Trajectory
from odomap.views.frames import frame_figure
from odomap.views.loopplan import ENDS, draw_loops
from odomap.views.patherror import PathError, finite_part, sigmas
from odomap.views.scene import AXES, Scene, gaps_as_nan, scene, thin, unit_of
from odomap.views.style import (
    ERROR_COLOURS,
    PALETTE,
    dress,
    figure_jpeg,
    figure_png,
    figure_svg,
    legend,
    new_figure,
)
from odomap.views.timelines import inlier_figure, timing_figure

__all__ = [
    "error_figure",
    "figure_jpeg",
    "figure_png",
    "figure_svg",
    "frame_figure",
    "inlier_figure",
    "path_3d_figure",
    "path_figure",
    "timing_figure",
]

PATH_POINTS = 900
ERROR_POINTS = 600


def path_figure(
    trajectory: Trajectory | None,
    truth: Trajectory | None = None,
    keyframe_stamps_ns: NDArray[np.int64] | None = None,
    unit: str = "m",
    loops: NDArray[np.float64] | None = None,
) -> Figure:
    """Draw a path from above and from the side, coloured by its error where the truth is known.

    Args:
        trajectory: the path; None or empty gives a figure that says so.
        truth: ground truth, onto which the path is laid as well as a rigid motion can.
        keyframe_stamps_ns: stamps of the keyframes, marked on the path.
        unit: what lengths are in; "units" where a path has no scale.
        loops: (L, 2, 3) ends of loops that were closed, in the path's world.
    """
    place = scene(trajectory, truth)
    if place is None:
        return _nothing(new_figure(9.6, 1.2), "no path: no frame was tracked")
    figure = new_figure(9.6, 4.3, right=1.0 if place.distances is not None else 0.12)
    above, side = figure.subplots(1, 2, width_ratios=(3, 2), gridspec_kw={"wspace": 0.16})
    across, up = place.ground, place.up_axis
    wide = max(across, key=lambda a: float(np.ptp(place.positions[:, a])))
    for ax, axes, title in (
        (above, across, "From above"),
        (side, (wide, up), "From the side"),
    ):
        dress(ax, title, f"{AXES[axes[0]]} [{unit}]", f"{AXES[axes[1]]} [{unit}]")
        _draw_path(ax, place, axes, keyframe_stamps_ns)
        if loops is not None:
            T = place.T_drawn_world
            draw_loops(ax, (loops @ T[:3, :3].T + T[:3, 3])[:, :, axes])
        ax.set_aspect("equal", adjustable="datalim")
        if axes[1] == up and place.up_sign < 0:
            ax.invert_yaxis()
    if place.distances is not None:
        _colour_bar(figure, side, place.distances)
    handles, labels = above.get_legend_handles_labels()
    ends = [k for k, label in enumerate(labels) if label in ("start", "end")]
    # Shared between the panels, so that no legend runs into a title.
    lines = [k for k in range(len(labels)) if k not in ends and labels[k] not in ENDS]
    for ax, chosen in ((above, lines), (side, ends)):
        legend(ax, handles=[handles[k] for k in chosen])
    return figure


def _draw_path(
    ax: Axes, place: Scene, axes: tuple[int, int], keyframes: NDArray[np.int64] | None
) -> None:
    a, b = axes
    if place.truth is not None:
        true = place.truth[thin(len(place.truth), PATH_POINTS)]
        ax.plot(true[:, a], true[:, b], color=PALETTE["truth"], lw=2.6, label="truth")
    keep = thin(len(place.positions), PATH_POINTS)
    p = gaps_as_nan(place.stamps_ns[keep], place.positions[keep][:, [a, b]])
    if place.distances is None:
        ax.plot(p[:, 0], p[:, 1], color=PALETTE["estimate"], lw=1.4, label="estimate")
    else:
        whole = np.isfinite(p[1:]).all(axis=1)
        lines = LineCollection(
            list(np.stack([place.positions[keep][:-1, [a, b]], p[1:]], axis=1)[whole]),
            cmap=ERROR_COLOURS,
            norm=_error_norm(place.distances),
            linewidths=1.6,
            label="estimate",
        )
        lines.set_array(place.distances[keep][1:][whole])
        ax.add_collection(lines)
        ax.update_datalim(place.positions[:, [a, b]])
    if keyframes is not None and len(keyframes):
        at = np.isin(place.stamps_ns, keyframes).nonzero()[0]
        at = at[thin(len(at), 300)]
        k = place.positions[at]
        style = {"marker": "o", "ms": 2.0, "ls": "", "color": PALETTE["keyframe"]}
        ax.plot(k[:, a], k[:, b], label="keyframe", zorder=3, **style)  # type: ignore[arg-type]
    ink = PALETTE["ink"]
    for index, marker, label in ((0, "o", "start"), (-1, "s", "end")):
        at_end = place.positions[index]
        ax.plot(at_end[a], at_end[b], marker, ms=6, mfc="none", mec=ink, ls="", label=label)
    ax.autoscale_view()


def _error_norm(distances: NDArray[np.float64]) -> Normalize:
    return Normalize(0.0, max(float(np.nanmax(distances)), 1e-9))


def _colour_bar(figure: Figure, beside: Axes, distances: NDArray[np.float64]) -> None:
    from matplotlib.cm import ScalarMappable

    factor, unit = unit_of(float(np.nanmax(distances)))
    norm = _error_norm(factor * distances)
    box = beside.get_position()
    cax = figure.add_axes((box.x1 + 0.015, box.y0, 0.011, box.height))
    bar = figure.colorbar(ScalarMappable(norm, ERROR_COLOURS), cax=cax)
    bar.set_label(f"distance to truth [{unit}]", fontsize=9, color=PALETTE["muted"])
    bar.ax.tick_params(labelsize=8, colors=PALETTE["muted"], length=3)
    bar.outline.set_visible(False)


def path_3d_figure(trajectory: Trajectory | None, truth: Trajectory | None = None) -> Figure:
    """Draw a path in three dimensions, with the truth where it is known."""
    from mpl_toolkits.mplot3d import Axes3D  # type: ignore[import-untyped]

    place = scene(trajectory, truth)
    if place is None:
        return _nothing(new_figure(6.4, 1.2), "no path: no frame was tracked")
    figure = new_figure(6.4, 5.2)
    figure.subplots_adjust(left=0.02, right=0.93, bottom=0.04, top=0.99)
    with mpl.rc_context({"grid.color": PALETTE["grid"], "axes.edgecolor": PALETTE["muted"]}):
        ax = figure.add_subplot(projection="3d")
    assert isinstance(ax, Axes3D)
    order = (*place.ground, place.up_axis)
    sign = np.array([1.0, 1.0, place.up_sign])
    if place.truth is not None:
        true = place.truth[thin(len(place.truth), PATH_POINTS)][:, order] * sign
        ax.plot(*true.T, color=PALETTE["truth"], lw=2.2, label="truth")
    keep = thin(len(place.positions), PATH_POINTS)
    p = gaps_as_nan(place.stamps_ns[keep], place.positions[keep][:, order] * sign)
    ax.plot(*p.T, color=PALETTE["estimate"], lw=1.4, label="estimate")
    ax.set_aspect("equal", adjustable="datalim")
    names = [AXES[a] for a in order]
    names[2] = names[2] if place.up_sign > 0 else f"−{names[2]}"
    for axis, name in zip((ax.xaxis, ax.yaxis, ax.zaxis), names):
        axis.set_label_text(f"{name} [m]", fontsize=8, color=PALETTE["muted"])
        axis.set_tick_params(labelsize=7, colors=PALETTE["muted"])
        axis.set_pane_color((0, 0, 0, 0.02))
    ax.legend(frameon=False, fontsize=8, loc="upper left")
    return figure


def error_figure(
    trajectory: Trajectory | None, truth: Trajectory | None = None, unit: str = "m"
) -> Figure:
    """Draw the errors over time inside the ±3σ they claim; without truth, the 3σ alone.

    Errors are those of the body, in its own axes, relative to the first pose, as the covariance is.
    A `unit` other than "m" is that of a path without scale, which is drawn as it is.
    """
    error = PathError.of(trajectory, truth)
    if error is None:
        return _uncertainty(trajectory, unit)
    figure = new_figure(9.6, 5.0)
    grid = figure.subplots(3, 2, sharex=True, gridspec_kw={"wspace": 0.2, "hspace": 0.12})
    keep = thin(len(error.index), ERROR_POINTS)
    stamps = error.stamps_ns[keep]
    t = (stamps - stamps[0]) * 1e-9
    for column, (first, title) in enumerate(((0, "Position error"), (3, "Rotation error"))):
        values = error.errors[keep, first : first + 3]
        factor, unit = _scale(values, rotation=first == 3)
        for k in range(3):
            ax = dress(grid[k, column], f"{title} [{unit}]" if k == 0 else "")
            if error.sigmas is not None:
                three = 3.0 * factor * error.sigmas[keep, first + k]
                three = gaps_as_nan(stamps, three)
                ax.fill_between(t, -three, three, color=PALETTE["band"], lw=0, label="±3σ claimed")
            line = gaps_as_nan(stamps, factor * values[:, k])
            ax.axhline(0.0, color=PALETTE["muted"], lw=0.6)
            ax.plot(t, line, color=PALETTE["estimate"], lw=1.3, label="error")
            ax.set_ylabel(AXES[k], rotation=0, fontsize=9, color=PALETTE["muted"])
            ax.yaxis.set_label_coords(-0.12, 0.45)
            ax.margins(x=0.01)
        grid[2, column].set_xlabel("time [s]")
    legend(grid[0, 1])
    return figure


def _uncertainty(trajectory: Trajectory | None, given: str) -> Figure:
    index = finite_part(trajectory)
    sigma = sigmas(trajectory, index) if trajectory is not None else None
    if trajectory is None or sigma is None or len(index) == 0:
        return _nothing(new_figure(9.6, 1.2), "no truth to compare with, and no covariances")
    figure = new_figure(9.6, 2.6)
    keep = thin(len(index), ERROR_POINTS)
    stamps = trajectory.stamps_ns[index[keep]]
    t = (stamps - stamps[0]) * 1e-9
    panels = zip(figure.subplots(1, 2), (0, 3), ("Position", "Rotation"))
    for ax, first, title in panels:
        three = 3.0 * np.sqrt((sigma[keep, first : first + 3] ** 2).sum(axis=1))
        free = first == 0 and given != "m"
        factor, unit = (1.0, given) if free else _scale(three, rotation=first == 3)
        dress(ax, f"{title} uncertainty, 3σ [{unit}]", "time [s]")
        three = gaps_as_nan(stamps, factor * three)
        ax.fill_between(t, 0.0, three, color=PALETTE["band"], lw=0)
        ax.plot(t, three, color=PALETTE["estimate"], lw=1.3)
        ax.margins(x=0.01)
    return figure


def _scale(values: NDArray[np.float64], rotation: bool) -> tuple[float, str]:
    if rotation:
        return float(np.degrees(1.0)), "°"
    finite = np.abs(values[np.isfinite(values)])
    return unit_of(float(finite.max()) if len(finite) else 1.0)


def _nothing(figure: Figure, message: str) -> Figure:
    figure.text(0.5, 0.5, message, ha="center", va="center", fontsize=11, color=PALETTE["muted"])
    return figure
