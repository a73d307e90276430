"""Pairs: what edges and planes say of a sweep once they are laid onto those of the map.

A plane says one thing of a point, how far it is off across it; an edge says two, as two planes do
that are across one another and meet in it. What m points of one voxel say they say in part of its
errors: with q the share of the variance that they have in common, they count as m / (1 + m q). And
all of a sweep share what is the same for all, D, such as motion that was not constant: I, what they
say, is worth (I⁻¹ + D)⁻¹. How well that fixes the motion is judged elsewhere (`degeneracy`).

Cost: 30 ns a feature.

Reference: J. Zhang, S. Singh, "LOAM: lidar odometry and mapping in real-time", RSS 2014, section V.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.lidar.featuremap import AXIS, MEAN, SPREAD, VoxelShapes

__all__ = ["ALL", "EDGES", "GROUND", "PLANES", "SIGMA", "pairs_of", "warm_up", "with_common"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Kinds = NDArray[np.uint8]

EDGES, PLANES, GROUND = 1, 2, 4
"""Kinds of features, as bits."""
ALL = EDGES | PLANES | GROUND
SIGMA = 0.02
"""Standard deviation of a feature across what it lies on, metres."""
SHARED = 0.1
"""Share of the variance that points on one voxel have in common."""
IN_COMMON = 0.002, 0.0002
"""Standard deviation of what all points of a sweep are off by together: metres, radians."""


def with_common(information: Array, common: float) -> Array:
    """Return (I⁻¹ + D)⁻¹ (6, 6) of an information I, with a factor on the deviations of D.

    It is R (1 + Rᵀ D R)⁻¹ Rᵀ with I = R Rᵀ, which need not be regular.
    """
    values, axes = np.linalg.eigh(information)
    root = axes * np.sqrt(np.maximum(values, 0.0))
    sigma = common * np.repeat(IN_COMMON, 3)[:, None]
    inner = np.linalg.inv(np.eye(6) + (sigma * root).T @ (sigma * root))
    return np.asarray(root @ (0.5 * (inner + inner.T)) @ root.T)


def pairs_of(
    points: Array, kinds: Kinds, rows: Index, planes: VoxelShapes, edges: VoxelShapes, R: Array,
    t: Array,
) -> tuple[Array, Array, Array, Array, Array]:  # fmt: skip
    """Return pairs as `degeneracy.judge` takes them: points, ways, normals, spreads, own shares.

    Args:
        points: (N, 3) in the body. kinds: (N,) what each is.
        rows: (N,) the shape that each lies on.
        planes: of the map. edges: of the map.
        R: (3, 3) of the body in the map. t: (3,) where it is.
    """
    count = len(points) + int(np.count_nonzero(kinds == EDGES))
    p, e, n = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 3))
    spreads, own = np.ones((count, 5)), np.empty(count)
    met = np.zeros((2, max(len(planes.shapes), len(edges.shapes))))
    _pairs_kernel(
        points, kinds, rows, planes.shapes, edges.shapes, R, t, met, p, e, n, spreads, own
    )
    return p, e, n, spreads, own


@kernel
def _pairs_kernel(
    points: Array, kinds: Kinds, rows: Index, planes: Array, edges: Array, R: Array, t: Array,
    met: Array, p: Array, e: Array, n: Array, spreads: Array, own: Array,
) -> None:  # fmt: skip
    """Rows of `pairs_of`; met: points on each plane, and on each edge."""
    for i in range(points.shape[0]):
        met[1 if kinds[i] == EDGES else 0, rows[i]] += 1.0
    k = 0
    for i in range(points.shape[0]):
        is_edge = kinds[i] == EDGES
        s = edges[rows[i]] if is_edge else planes[rows[i]]
        m = met[1 if is_edge else 0, rows[i]]
        ax, ay, az = s[AXIS], s[AXIS + 1], s[AXIS + 2]
        for side in range(2 if is_edge else 1):
            for r in range(3):
                x = R[r, 0] * points[i, 0] + R[r, 1] * points[i, 1] + R[r, 2] * points[i, 2] + t[r]
                e[k, r], p[k, r] = s[MEAN + r] - x, points[i, r]
                n[k, r] = s[AXIS + r]
            if is_edge and side == 0:  # across the edge, and level where it is not upright
                if abs(az) < 0.9:
                    ux, uy, uz = -ay, ax, 0.0
                else:
                    ux, uy, uz = 0.0, -az, ay
                size = np.sqrt(ux * ux + uy * uy + uz * uz)
                n[k, 0], n[k, 1], n[k, 2] = ux / size, uy / size, uz / size
            elif is_edge:
                bx, by, bz = n[k - 1, 0], n[k - 1, 1], n[k - 1, 2]
                n[k, 0], n[k, 1] = ay * bz - az * by, az * bx - ax * bz
                n[k, 2] = ax * by - ay * bx
            spreads[k, 0] = s[SPREAD]
            spreads[k, 1], spreads[k, 2] = s[SPREAD + 1], s[SPREAD + 2]
            spreads[k, 3] = s[SPREAD + 3]
            own[k] = SIGMA * SIGMA / (s[SPREAD + 1] + SIGMA * SIGMA) / (1.0 + SHARED * m)
            k += 1


def warm_up() -> None:
    """Compile the kernels of this file."""
    shapes = VoxelShapes(1.0, True, 0.1, 9)
    points, kinds, rows = np.eye(3), np.full(3, PLANES, np.uint8), np.zeros(3, np.int64)
    pairs_of(points, kinds, rows, shapes, shapes, np.eye(3), np.zeros(3))
