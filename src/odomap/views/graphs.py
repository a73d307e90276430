"""Pictures of a pose graph: where its nodes are, what ties them, and which ties were let go.

Nodes that follow each other are joined by the path; the other edges, which close loops, lie behind
it, faint, since there are often more of them than of the path; rejected ones stand out. What is
flat is seen from above, and what is not (a sphere, a garage of several floors) obliquely, by a
parallel projection, so that lengths can be compared along each direction.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from odomap.backend.graphs.posegraph import PoseGraph
from odomap.views.scene import AXES, thin
from odomap.views.style import PALETTE, dress, legend, new_figure

__all__ = ["graph_figure"]

Array = NDArray[np.float64]
Bool = NDArray[np.bool_]

FLAT = 0.15
"""What is lower than this share of its width is seen from above."""
AZIMUTH, ELEVATION = np.radians(35.0), np.radians(28.0)
MOST_EDGES = 20000
MOST_POINTS = 5000


def graph_figure(
    after: PoseGraph,
    before: Array | None = None,
    rejected: Bool | None = None,
    name_before: str = "Before",
) -> Figure:
    """Draw a graph as it was found, beside what it began with.

    Args:
        after: the graph at the poses found.
        before: (N, d) positions at the start; None draws only the end.
        rejected: (E,) edges that were found to be false.
        name_before: what the start is, for its title.
    """
    panels = [("After", after.positions)]
    if before is not None:
        panels.insert(0, (name_before, before))
    figure = new_figure(9.6, 5.2)
    axes = figure.subplots(1, len(panels), squeeze=False, gridspec_kw={"wspace": 0.16})[0]
    oblique = _is_spatial(after.positions)
    none = np.zeros(after.num_edges, bool)
    for ax, (title, positions) in zip(axes, panels):
        if oblique:
            extent = " x ".join(f"{length:.3g}" for length in np.ptp(positions, axis=0))
            dress(ax, title, f"{extent} m, seen obliquely")
            ax.set(xticks=[], yticks=[])
            ax.spines[:].set_visible(False)
        else:
            dress(ax, title, f"{AXES[0]} [m]", f"{AXES[1]} [m]")
        _draw(ax, after, positions, oblique, none if rejected is None else rejected)
    _draw_landmarks(axes[-1], after.points.points_world, oblique)
    handles, labels = axes[-1].get_legend_handles_labels()
    if handles:
        legend(axes[-1], handles=handles, labels=labels, ncols=4)
    return figure


def _is_spatial(positions: Array) -> bool:
    """Whether a graph is so high that a look from above would hide it."""
    extent = np.ptp(positions, axis=0)
    return len(extent) == 3 and bool(extent[2] > FLAT * extent[:2].max())


def _draw(ax: Axes, graph: PoseGraph, positions: Array, oblique: bool, rejected: Bool) -> None:
    flat = _projected(positions, oblique)
    ends = np.stack([flat[graph.first], flat[graph.second]], axis=1)
    path, loops = ~graph.is_loop & ~rejected, graph.is_loop & ~rejected
    for chosen, label, colour, width, order in (
        (loops, "loop", PALETTE["band"], 0.7, 1),
        (rejected, "rejected", PALETTE["lost"], 0.6, 2),
        (path, "path", PALETTE["estimate"], 1.1, 3),
    ):
        edges = ends[chosen]
        if len(edges):
            some = edges[thin(len(edges), MOST_EDGES)]
            lines = LineCollection(list(some), colors=colour, linewidths=width, zorder=order)
            lines.set_label(label)
            ax.add_collection(lines)
    if not len(ends):  # nodes that only priors or landmarks tie
        style = {"marker": "s", "ms": 2.5, "ls": "", "color": PALETTE["estimate"]}
        ax.plot(flat[:, 0], flat[:, 1], label="node", zorder=3, **style)  # type: ignore[arg-type]
    ax.update_datalim(flat)
    ax.set_aspect("equal", adjustable="datalim")
    ax.autoscale_view()


def _draw_landmarks(ax: Axes, points: Array, oblique: bool) -> None:
    if len(points):
        seen = _projected(points[thin(len(points), MOST_POINTS)], oblique)
        style = {"marker": "o", "ms": 1.8, "ls": "", "color": PALETTE["keyframe"]}
        ax.plot(seen[:, 0], seen[:, 1], label="landmark", zorder=4, **style)  # type: ignore[arg-type]


def _projected(points: Array, oblique: bool) -> Array:
    """Return (N, 2) places on the paper."""
    if not oblique:
        return points[:, :2]
    (sa, ca), (se, ce) = ((np.sin(a), np.cos(a)) for a in (AZIMUTH, ELEVATION))
    right = np.array([ca, sa, 0.0])
    up = np.array([-sa * se, ca * se, ce])
    return np.asarray(points @ np.column_stack([right, up]))
