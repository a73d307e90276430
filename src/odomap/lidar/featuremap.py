"""Maps of edges and planes: what features of a sweep are laid onto.

LOAM searches five neighbours of each feature and fits a line or a plane to them, again and again.
Here the fit is kept: all features that ever fell into a voxel go into its sums n, Σ u, Σ u uᵀ, and
the eigenvalues λ₀ ≤ λ₁ ≤ λ₂ of their covariance say whether it is

    a plane   √λ₀ thin, λ₁ far larger:  mean μ, normal v₀
    an edge   √λ₁ thin, λ₂ far larger:  mean μ, direction v₂

or neither, such as a bush, or two walls in one voxel. Only voxels that were added to are fitted
again. A voxel counts the last points in the main, so that what it holds stays in bounds and the
place of a thing that was moved is forgotten. Voxels far from the sensor go.

Cost: 30 ns an inserted point, 0.3 µs a voxel that changed.

Reference: J. Zhang, S. Singh, "LOAM: lidar odometry and mapping in real-time", RSS 2014, section
VI.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.kernels import kernel
from odomap.lidar.normals import eigenvalues, longest_cross
from odomap.lidar.voxels import FURTHEST, axis_of_key, new_table, rehash_kernel, sum_cells

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
PATCH = 0.06
"""Least λ₁ of a plane as a share of λ₂: else it is a line, about which any normal may turn."""


class VoxelShapes:
    """Edges or planes by voxel.

    Args:
        voxel: side of a voxel, metres.
        is_edges: whether they are edges.
        thickness: standard deviation across them at most, metres.
        most: points that a voxel counts at most.
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

    def insert(self, points: Array) -> None:
        """Add points (N, 3) in the map's frame.

        Raises:
            InputError: points too far from the origin for the voxels.
        """
        if not float(np.abs(points).max(initial=0.0)) < (FURTHEST - 1) * self.voxel:
            raise InputError("feature map: points are too far from where it begins for its voxels")
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
        near = np.empty(self._size, np.bool_)
        _near_kernel(self._keys, self.voxel, centre, radius, near)
        rows = np.flatnonzero(near)
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
        least = max(least, 0.0)
        thin, wide = (max(middle, 0.0), largest) if is_edges else (least, middle)
        if thin > thickness * thickness or thin > (EDGE_RATIO if is_edges else PLANE_RATIO) * wide:
            continue
        if not is_edges and middle < PATCH * largest:
            continue
        root = largest if is_edges else least
        i, j, k, n2 = longest_cross(a - root, b, c, d - root, e, f - root)
        if not n2 > 0.0:
            continue
        scale = 1.0 / np.sqrt(n2)
        shapes[v, AXIS], shapes[v, AXIS + 1], shapes[v, AXIS + 2] = i * scale, j * scale, k * scale
        shapes[v, MEAN] = (axis_of_key(keys[v], 0) + 0.5) * size + x
        shapes[v, MEAN + 1] = (axis_of_key(keys[v], 1) + 0.5) * size + y
        shapes[v, MEAN + 2] = (axis_of_key(keys[v], 2) + 0.5) * size + z
        shapes[v, SPREAD], shapes[v, SPREAD + 1] = n, thin
        shapes[v, SPREAD + 2], shapes[v, SPREAD + 3] = wide, largest


@kernel
def _near_kernel(
    keys: Index, size: float, centre: Array, radius: float, near: NDArray[np.bool_]
) -> None:
    """Which voxels have their middle within a radius."""
    for v in range(near.shape[0]):
        square = 0.0
        for axis in range(3):
            off = (axis_of_key(keys[v], axis) + 0.5) * size - centre[axis]
            square += off * off
        near[v] = square <= radius * radius


def warm_up() -> None:
    """Compile the kernels of this file."""
    shapes = VoxelShapes(1.0, True, 0.1, 9)
    shapes.insert(np.eye(3))
    shapes.forget(np.zeros(3), 0.5)
