"""The plan of a map: landmarks, keyframes and what joins them, the path and the truth.

A plan is seen from above, or, where the path climbs more than it wanders, along the axis along
which it extends least. The picture reaches as far as nearly
all landmarks do, but not to the few badly triangulated ones that would press the rest into a dot.
Thousands of dots and lines are one drawing element each kind, which keeps a page small.
"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from numpy.typing import NDArray

from odomap.views.covisibility import MapView
from odomap.views.loopplan import ENDS, draw_loops
from odomap.views.scene import AXES, Scene, gaps_as_nan, thin
from odomap.views.style import PALETTE, dress, legend, new_figure

__all__ = ["plan_axes", "plan_figure"]

LANDMARKS = 4000
KEYFRAMES = 1000
PATH_POINTS = 900
REACH = 10.0
"""Landmarks farther from the path's middle than this many of its radii are out of the picture."""

USUAL = 3.0
"""Percent of the landmarks at either end of an axis that the picture need not reach."""

CLIMBS, WANDERS = 0.3, 1.5
"""Height over the greater and the lesser horizontal extent, from which on a path climbs."""

ALPHAS = (0.16, 0.28, 0.42, 0.6)
"""How strongly a pair of keyframes is joined: each step is twice as many landmarks shared."""


def plan_axes(place: Scene) -> tuple[int, int]:
    """Return the axes drawn to the right and upwards: the ground, or a side of a path that climbs.

    A path climbs if its height changes by a good part of its length and clearly more than the
    lesser of its horizontal extents: a straight road that rises is still seen from above.
    """
    extents, up = np.ptp(place.positions, axis=0), place.up_axis
    lesser, greater = sorted(place.ground, key=lambda k: float(extents[k]))
    climbs = extents[up] > max(CLIMBS * extents[greater], WANDERS * extents[lesser])
    return (greater, up) if climbs else place.ground


def plan_figure(place: Scene, view: MapView, unit: str = "m") -> Figure:
    """Draw a map from above, or from the side where the path climbs.

    Args:
        place: the path, and its truth.
        view: the map, in the estimate's world.
        unit: what lengths are in; "units" where a path has no scale.
    """
    figure = new_figure(9.6, 5.6)
    axes = plan_axes(place)
    names = [f"{AXES[k]} [{unit}]" for k in axes]
    title = "From the side" if place.up_axis in axes else "From above"
    ax = dress(figure.subplots(), title, *names)
    keyframes = _moved(place, view.keyframes)[:, axes]
    landmarks = _near(place, _moved(place, view.landmarks))
    dots = landmarks[thin(len(landmarks), LANDMARKS)][:, axes]
    _dots(ax, dots, 1.7, color=PALETTE["muted"], alpha=0.5, zorder=1)
    _joins(ax, keyframes, view)
    _lines(ax, place, axes)
    shown = keyframes[thin(len(keyframes), KEYFRAMES)]
    _dots(ax, shown, 3.2, color=PALETTE["keyframe"], zorder=5)
    for index, marker, label in ((0, "o", "start"), (-1, "s", "end")):
        at = place.positions[index, list(axes)]
        style = {"ms": 6, "mfc": "none", "mec": PALETTE["ink"], "ls": "", "zorder": 6}
        ax.plot(*at, marker, label=label, **style)  # type: ignore[arg-type]
    _window(ax, place, landmarks, axes)
    if place.up_sign < 0 and axes[1] == place.up_axis:
        ax.invert_yaxis()
    flat = [_moved(place, ends.reshape(-1, 3))[:, axes] for ends in (view.loops, view.gaps)]
    loops, gaps = (ends.reshape(-1, 2, 2) for ends in flat)
    if len(gaps):
        _strokes(ax, gaps, color=PALETTE["muted"], lw=1.0, ls=(0, (2, 3)), zorder=4)
    draw_loops(ax, loops)
    drawn = len(dots) > 0, len(view.pairs) > 0, len(shown) > 0
    handles, labels = ax.get_legend_handles_labels()
    named = [handle for handle, label in zip(handles, labels) if label not in ENDS]
    legend(ax, handles=[*_key(view, *drawn), *named])
    return figure


def _key(view: MapView, landmarks: bool, pairs: bool, keyframes: bool) -> list[Line2D]:
    """Return what stands in the legend for strokes, which are drawn without a name."""
    dot = {"marker": "o", "ls": ""}
    join = f"{view.least} or more landmarks shared"
    entries: list[tuple[bool, str, dict[str, Any]]] = [
        (landmarks, "landmark", {**dot, "ms": 2.5, "color": PALETTE["muted"]}),
        (keyframes, "keyframe", {**dot, "ms": 4.0, "color": PALETTE["keyframe"]}),
        (len(view.gaps) > 0, "not measured", {"lw": 1.0, "ls": ":", "color": PALETTE["muted"]}),
        (pairs, join, {"lw": 1.2, "color": PALETTE["good"], "alpha": ALPHAS[-1]}),
    ]
    return [Line2D([], [], label=label, **style) for is_drawn, label, style in entries if is_drawn]


def _moved(place: Scene, points: NDArray[np.float64]) -> NDArray[np.float64]:
    T = place.T_drawn_world
    moved: NDArray[np.float64] = points @ T[:3, :3].T + T[:3, 3]
    return moved


def _lines(ax: Axes, place: Scene, axes: tuple[int, int]) -> None:
    if place.truth is not None:
        true = place.truth[thin(len(place.truth), PATH_POINTS)][:, axes]
        ax.plot(*true.T, color=PALETTE["truth"], lw=2.6, label="truth", zorder=3)
    keep = thin(len(place.positions), PATH_POINTS)
    path = gaps_as_nan(place.stamps_ns[keep], place.positions[keep][:, axes])
    ax.plot(*path.T, color=PALETTE["estimate"], lw=1.4, label="path", zorder=4)


def _joins(ax: Axes, keyframes: NDArray[np.float64], view: MapView) -> None:
    """Join keyframes that share landmarks: one element for each strength."""
    if not len(view.pairs):
        return
    strength = np.log2(view.shared / view.least).astype(np.int64).clip(0, len(ALPHAS) - 1)
    for k in np.unique(strength).tolist():
        ends = keyframes[view.pairs[strength == k]]
        _strokes(ax, ends, color=PALETTE["good"], lw=0.7, alpha=ALPHAS[k], zorder=2)


def _dots(ax: Axes, points: NDArray[np.float64], size: float, **style: Any) -> None:
    """Draw round dots, as strokes too short to be seen with round ends."""
    if len(points):
        short = np.array([1e-6 * max(float(np.ptp(points)), 1e-3), 0.0])
        _strokes(ax, np.stack([points, points + short], axis=1), lw=size, **style)


def _strokes(ax: Axes, ends: NDArray[np.float64], **style: Any) -> None:
    """Draw (n, 2, 2) straight strokes as one element."""
    path = Path(ends.reshape(-1, 2), np.tile([Path.MOVETO, Path.LINETO], len(ends)))
    path.should_simplify = False  # which would take dots for noise
    ax.add_patch(PathPatch(path, fill=False, capstyle="round", **style))


def _near(place: Scene, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points that are near enough to the path to be told apart from each other."""
    low, high = _extent(place)
    radius = max(float(np.linalg.norm(high - low)) / 2, 1.0)
    finite = points[np.isfinite(points).all(axis=1)]
    near: NDArray[np.bool_] = np.linalg.norm(finite - (low + high) / 2, axis=1) < REACH * radius
    kept: NDArray[np.float64] = finite[near]
    return kept


def _extent(place: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    path = place.positions if place.truth is None else np.r_[place.positions, place.truth]
    return path.min(axis=0), path.max(axis=0)


def _window(ax: Axes, place: Scene, landmarks: NDArray[np.float64], axes: tuple[int, int]) -> None:
    """Show the whole path, and around it nearly all landmarks."""
    low, high = _extent(place)
    low, high = low[list(axes)], high[list(axes)]
    if len(landmarks):
        usual = np.percentile(landmarks[:, axes], [USUAL, 100.0 - USUAL], axis=0)
        low, high = np.minimum(low, usual[0]), np.maximum(high, usual[1])
    _frame(ax, (low + high) / 2, 1.08 * np.maximum(high - low, 1e-3))


def _frame(ax: Axes, middle: NDArray[np.float64], size: NDArray[np.float64]) -> None:
    """Show at least so much around a middle, with equal scales, in the whole of the axes."""
    figure = ax.get_figure()
    assert figure is not None
    box = ax.get_position()
    wide = box.width * figure.bbox.width / (box.height * figure.bbox.height)
    half = max(float(size[1]), float(size[0]) / wide) / 2
    ax.set_xlim(middle[0] - half * wide, middle[0] + half * wide)
    ax.set_ylim(middle[1] - half, middle[1] + half)
    ax.set_aspect("equal", adjustable="box")
