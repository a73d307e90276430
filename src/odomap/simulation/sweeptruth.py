"""What a sweep truly shows: edges as the beams of a LiDAR meet them.

Points that follow each other in a line of one beam are on one surface, or the line goes over to
another one. Where the next one is as far and turned by more than an angle the two make an edge,
convex or not,

    |r₂ - r₁| <= 0.1 m + 0.02 min(r₁, r₂)   and   n₁·n₂ < cos(bend),

and where it is farther the nearer one has an edge, while the other goes on behind it: that its
points end there says nothing of it, and the place moves with the LiDAR. Leaves have neither.

Cost: 10 ns a beam.

Paper: J. Zhang, S. Singh, "LOAM: lidar odometry and mapping in real-time", RSS 2014 (which points
are edges, and which must not be taken for them: section V-A).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["SweepTruth", "edges_of"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SweepTruth:
    """What the points of a sweep show, row by row.

    Attributes:
        points: (N, 3) without noise, in the LiDAR's frame at the moment of each.
        surfaces: (N,) the surface: a row of the world's shapes, or -2 for the ground.
        things: (N,) what it is a part of, such as one house or one car; 0 for the ground.
        kinds: (N,) index of `solids.KINDS`.
        normals: (N, 3) of the surface, towards the LiDAR, in its frame at the moment of each; NaN
            of leaves.
        is_ground: (N,) whether one could drive or walk on it.
        is_edge: (N,) whether the surface ends beside the point, seen along its line of beams: it
            stands before what is beside it, or bends there; never of leaves.
        is_hidden: (N,) whether what ends beside the point is what stands before it: such an end is
            no edge of anything, and moves with the LiDAR.
    """

    points: Array
    surfaces: NDArray[np.int32]
    things: NDArray[np.int64]
    kinds: NDArray[np.int64]
    normals: Array
    is_ground: NDArray[np.bool_]
    is_edge: NDArray[np.bool_]
    is_hidden: NDArray[np.bool_]


def edges_of(
    distance: Array, hit: NDArray[np.int32], normals: Array, reach: int, bend: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return where surfaces end or bend beside beams, and where they are hidden there.

    Args:
        distance: (S, B) of what beam B of step S met, metres.
        hit: (S, B) which surface.
        normals: (S, B, 3) of the surfaces, in any one frame; NaN of what is none.
        reach: how many steps from its surface's end a beam still feels it.
        bend: cosine of the angle from which on two surfaces make an edge.

    Returns:
        (S, B) whether there is an edge, and (S, B) whether the surface goes on behind another.
    """
    edge, hidden = np.zeros(hit.shape, np.bool_), np.zeros(hit.shape, np.bool_)
    # Leaves have neither, but what is before or behind them does.
    other = hit[1:] != hit[:-1]
    step = distance[1:] - distance[:-1]
    nearer = np.minimum(distance[1:], distance[:-1])
    # Where nothing returned the surface ends, too, but nobody knows at what.
    jump = other & (np.abs(step) > 0.1 + 0.02 * nearer)
    with np.errstate(invalid="ignore"):
        cosine = (normals[1:] * normals[:-1]).sum(axis=2)
        fold = other & ~jump & (cosine < bend)
    for k in range(reach):
        for before in (True, False):
            # Beams k steps from the border, on the side before it or behind it.
            rows = slice(0, len(step) - k) if before else slice(k + 1, None)
            at = slice(k, None) if before else slice(0, len(step) - k)
            has_edge = fold[at] | (jump[at] & ((step[at] > 0) == before))
            same = hit[rows] == (hit[:-1] if before else hit[1:])[at]
            edge[rows] |= has_edge & same
            hidden[rows] |= jump[at] & ((step[at] > 0) != before) & same
    is_surface = ~np.isnan(normals[:, :, 0])
    return edge & is_surface, hidden & is_surface
