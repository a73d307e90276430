"""What a sweep truly shows: edges as the beams of a LiDAR meet them.

Points that follow each other in a line of one beam are on one surface, or the line goes over to
another one. Whether the two meet there is not seen from how far they are: beams a degree apart find
floor and wall 2 m from each other, and one before the other may be no nearer. So each surface is
laid out flat beyond its end, and met with the other's beam,

    s₁ = n₁·x₁ / n₁·u₂ - r₂,      s₂ = n₂·x₂ / n₂·u₁ - r₁.

The first stands before the second, which goes on behind it, where s₁ < 0 < s₂, each by more than
0.1 m + 0.02 min(r₁, r₂); the second before the first where it is the other way round. Both positive
make a corner that is seen from within, both negative one from without: an edge, if normals differ
by more than an angle. Of what is round, or beside nothing, the ranges alone are asked. The one in
front has an edge; that the points of the other end there says nothing of it, and the place moves
with the LiDAR. Leaves have neither.

Cost: 30 ns a beam.

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
        is_ground: (N,) whether one could drive or walk on it, or it is the kerb between the two
            (which Cityscapes counts to the pavement).
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
    distance: Array,
    hit: NDArray[np.int32],
    normals: Array,
    rays: Array,
    is_round: NDArray[np.bool_],
    reach: int,
    bend: float,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return where surfaces end or bend beside beams, and where they are hidden there.

    Args:
        distance: (S, B) of what beam B of step S met, metres.
        hit: (S, B) which surface.
        normals: (S, B, 3) of the surfaces, towards the LiDAR, in any one frame; NaN of what is
            none.
        rays: (S, B, 3) where the beams go, in the same frame, unit length.
        is_round: (S, B) which of the surfaces are not flat.
        reach: how many steps from its surface's end a beam still feels it.
        bend: cosine of the angle from which on two surfaces make an edge.

    Returns:
        (S, B) whether there is an edge, and (S, B) whether the surface goes on behind another.
    """
    edge, hidden = np.zeros(hit.shape, np.bool_), np.zeros(hit.shape, np.bool_)
    # Leaves have neither, but what is before or behind them does.
    other = hit[1:] != hit[:-1]
    first, second = _in_front(distance, normals, rays, is_round)
    first, second = other & first, other & second
    with np.errstate(invalid="ignore"):
        cosine = (normals[1:] * normals[:-1]).sum(axis=2)
        fold = other & ~first & ~second & (cosine < bend)
    for k in range(reach):
        for before in (True, False):
            # Beams k steps from the border, on the side before it or behind it.
            rows = slice(0, len(fold) - k) if before else slice(k + 1, None)
            at = slice(k, None) if before else slice(0, len(fold) - k)
            same = hit[rows] == (hit[:-1] if before else hit[1:])[at]
            front, back = (first, second) if before else (second, first)
            edge[rows] |= (fold[at] | front[at]) & same
            hidden[rows] |= back[at] & same
    is_surface = ~np.isnan(normals[:, :, 0])
    return edge & is_surface, hidden & is_surface


def _in_front(
    distance: Array, normals: Array, rays: Array, is_round: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return where the surface of a beam is before that of the next (S - 1, B), or behind it.

    The LiDAR hardly moves between the two.
    """
    limit = 0.1 + 0.02 * np.minimum(distance[1:], distance[:-1])
    step = distance[1:] - distance[:-1]
    is_flat = ~is_round & ~np.isnan(normals[:, :, 0])
    is_flat = is_flat[1:] & is_flat[:-1]
    over = np.where(is_flat, _laid_out(distance, normals, rays, 1) - distance[1:], -step)
    back = np.where(is_flat, _laid_out(distance, normals, rays, -1) - distance[:-1], step)
    return (over < -limit) & (back > limit), (back < -limit) & (over > limit)


def _laid_out(distance: Array, normals: Array, rays: Array, way: int) -> Array:
    """Return how far surfaces (S - 1, B), laid out flat, are along the next beam, or the last."""
    here, there = (slice(None, -1), slice(1, None))[::way]
    n = normals[here]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (n * rays[there]).sum(axis=2)
        met = distance[here] * (n * rays[here]).sum(axis=2) / along
    # What looks away from a beam is never met.
    return np.asarray(np.where(along < 0.0, met, np.inf))
