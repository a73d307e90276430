"""Maps of edges and planes: what features of a sweep are laid onto.

LOAM searches five neighbours of each feature and fits a line or a plane to them, again and again.
Here the fit is kept: all features that ever fell into a voxel go into its sums n, Σ u, Σ u uᵀ, and
the eigenvalues λ₀ ≤ λ₁ ≤ λ₂ of their covariance say whether it is

    a plane   √λ₀ thin, λ₁ far larger:  mean μ, normal v₀
    an edge   √λ₁ thin, λ₂ far larger:  mean μ, direction v₂

or neither, such as a bush, or two walls in one voxel. Only voxels that were added to are fitted
again. A voxel counts the last points in the main, so that what it holds stays in bounds and the
place of a thing that was moved is forgotten. Voxels far from the sensor go.

Beams that are far apart draw a line each through small voxels. Laid down a little too high or low,
the next sweep draws another beside it, and both span a plane across the way, which goes along with
the sensor and would hold it. So a plane must be a good deal wider than a line, and planes are kept
in large voxels, too (as in `planemap`), which several beams cross.

Cost: 30 ns an inserted point, 0.3 µs a voxel that changed.

Reference: J. Zhang, S. Singh, "LOAM: lidar odometry and mapping in real-time", RSS 2014, section
VI.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.kernels import kernel
from odomap.lidar.normals import eigenvalues, longest_cross
from odomap.lidar.voxels import (
    COARSER,
    FAR_AWAY,
    FURTHEST,
    axis_of_key,
    level_of_key,
    near_cells,
    new_table,
    rehash_kernel,
    sum_cells,
)

__all__ = ["AXIS", "MEAN", "SHAPE", "SPREAD", "VoxelShapes", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MEAN, AXIS, SPREAD, SHAPE = 0, 3, 6, 10
"""Columns of a shape: μ; normal or direction; n (0: none), thin λ, wide λ, widest λ. How many."""
FIRST_ROOM = 4096
FEWEST = 6
"""Points of a plane or an edge."""
PLANE_RATIO, EDGE_RATIO = 0.05, 0.08
"""Of the next eigenvalue: what the thin one may be at most."""
PATCH = 0.2
"""Least λ₁ of a plane as a share of λ₂: else it is a line, about which any normal may turn, or one
that was laid down twice."""


class VoxelShapes:
    """Edges or planes by voxel.

    Args:
        voxel: side of a voxel, metres.
        is_edges: whether they are edges.
        thickness: standard deviation across them at most, metres.
        most: points that a voxel counts at most.

    Attributes:
        table: of the voxels, for kernels; large ones are in it far away along x.
        shapes: (V, SHAPE) what each voxel holds.
    """

    def __init__(self, voxel: float, is_edges: bool, thickness: float, most: int) -> None:
        self.voxel, self.is_edges, self._thickness, self._most = voxel, is_edges, thickness, most
        self.clear()

    def clear(self) -> None:
        """Forget all."""
        self.table, self._keys = new_table(FIRST_ROOM), np.empty(FIRST_ROOM, np.int64)
        self._sums, self._size = np.empty((FIRST_ROOM, 10)), 0
        self.shapes = np.zeros((FIRST_ROOM, SHAPE))

    def __len__(self) -> int:
        return self._size

    @property
    def num_shapes(self) -> int:
        """How many voxels hold an edge, or a plane."""
        return int(np.count_nonzero(self.shapes[: self._size, SPREAD]))

    def insert(self, points: Array, some: Array | None = None) -> None:
        """Add points.

        Args:
            points: (N, 3) in the map's frame, for voxels.
            some: (M, 3) for large ones.

        Raises:
            InputError: points too far from the origin for the voxels.
        """
        self._insert(points)
        if some is not None:
            self._insert(some / COARSER, FAR_AWAY)

    def _insert(self, points: Array, away: int = 0) -> None:
        """Add points (N, 3), shrunk as voxels are, to those so many voxels away along x."""
        if not float(np.abs(points).max(initial=0.0)) < 0.25 * FURTHEST * self.voxel:
            raise InputError("feature map: points are too far from where it begins for its voxels")
        points = points + np.array([away * self.voxel, 0.0, 0.0]) if away else points
        cell_of, done = np.empty(len(points), np.int64), 0
        while True:
            done, self._size = sum_cells(
                points, done, self.voxel, self.table, self._keys, self._sums, cell_of, self._size
            )
            if done == len(points):
                break
            self._keep(np.arange(self._size), 2 * len(self._keys))
        touched = np.zeros(self._size, np.bool_)
        touched[cell_of] = True
        fit_kernel(
            np.flatnonzero(touched), self._keys, self._sums, self.voxel, self.is_edges,
            self._thickness, self._most, self.shapes,
        )  # fmt: skip

    def forget(self, centre: Array, radius: float) -> None:
        """Forget voxels farther than a distance from a point (3,)."""
        rows = np.empty(self._size, np.int64)
        keys = self._keys[: self._size]
        rows = rows[: near_cells(keys, self.voxel, centre, radius, rows)]
        if len(rows) < self._size:
            self._keep(rows, len(self._keys))

    def _keep(self, rows: Index, room: int) -> None:
        """Keep some voxels, in tables with room for more."""
        n = len(rows)
        keys, sums = np.empty(room, np.int64), np.empty((room, 10))
        shapes = np.zeros((room, SHAPE))
        keys[:n], sums[:n], shapes[:n] = self._keys[rows], self._sums[rows], self.shapes[rows]
        self.table = new_table(room)
        rehash_kernel(keys, n, self.table)
        self._keys, self._sums, self.shapes, self._size = keys, sums, shapes, n


@kernel
def fit_kernel(
    rows: Index, keys: Index, sums: Array, size: float, is_edges: bool, thickness: float, most: int,
    shapes: Array,
) -> None:  # fmt: skip
    """Fit planes, or edges, to the sums of some voxels; sums of more than `most` are scaled."""
    for at in range(rows.shape[0]):
        v = rows[at]
        n = sums[v, 0]
        shapes[v, SPREAD] = 0.0
        if n > most:
            for c in range(10):
                sums[v, c] *= most / n
            n = float(most)
        if n < FEWEST:
            continue
        x, y, z = sums[v, 1] / n, sums[v, 2] / n, sums[v, 3] / n
        a, b, c = sums[v, 4] / n - x * x, sums[v, 5] / n - x * y, sums[v, 6] / n - x * z
        d, e, f = sums[v, 7] / n - y * y, sums[v, 8] / n - y * z, sums[v, 9] / n - z * z
        least, middle, largest = eigenvalues(a, b, c, d, e, f)
        root = largest if is_edges else least
        u, q, w, n2 = longest_cross(a - root, b, c, d - root, e, f - root)
        far, side = level_of_key(keys[v], size)
        shrunk = side / size  # what lies in large voxels was shrunk as they are
        square = shrunk * shrunk
        least, middle, largest = square * max(least, 0.0), square * middle, square * largest
        thin, wide = (max(middle, 0.0), largest) if is_edges else (least, middle)
        if thin > thickness * thickness or thin > (EDGE_RATIO if is_edges else PLANE_RATIO) * wide:
            continue
        if not n2 > 0.0 or (not is_edges and middle < PATCH * largest):
            continue
        scale = 1.0 / np.sqrt(n2)
        shapes[v, AXIS], shapes[v, AXIS + 1], shapes[v, AXIS + 2] = u * scale, q * scale, w * scale
        shapes[v, MEAN] = (far + 0.5) * side + shrunk * x
        shapes[v, MEAN + 1] = (axis_of_key(keys[v], 1) + 0.5) * side + shrunk * y
        shapes[v, MEAN + 2] = (axis_of_key(keys[v], 2) + 0.5) * side + shrunk * z
        shapes[v, SPREAD], shapes[v, SPREAD + 1] = n, thin
        shapes[v, SPREAD + 2], shapes[v, SPREAD + 3] = wide, largest


def warm_up() -> None:
    """Compile the kernels of this file."""
    shapes = VoxelShapes(1.0, True, 0.1, 9)
    shapes.insert(np.eye(3), np.eye(3))
    shapes.forget(np.zeros(3), 0.5)
