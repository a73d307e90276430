"""A map of surfaces: voxels that know how the points that fell into them are spread.

A sweep is laid onto what sweeps before it saw. Of the points that fell into a voxel are kept n, Σ u
and Σ u uᵀ, and with that their mean μ and covariance

    C = Σ_i λ_i v_i v_iᵀ,     λ₀ ≤ λ₁ ≤ λ₂.

Where they lie in a plane, a point p is off it by r = nᵀ (μ - p), n being the normal v₀ with a
length that says how thin the plane is: |n|² = f / (λ₀ + σ²), f = 1 - λ₀ / (κ λ₁). So a wall is one
term, whatever way its points lie, and a sweep is matched to surfaces and not to points of other
beams. Where they lie on a line, as those of one beam do, there is no plane.

Beams that are far apart draw lines in small voxels, which are planes in large ones. So there are
two levels, the second of voxels COARSER times as large, far away in the same table.

Voxels farther than a distance from the body are forgotten. Cost: 80 ns for a point that is
inserted, 0.3 µs for the plane of a voxel, which is found when it is first asked for.

Reference: K. Koide, M. Yokozuka, S. Oishi, A. Banno, "Voxelized GICP for fast and accurate 3D point
cloud registration", ICRA 2021; P. Biber, W. Straßer, "The normal distributions transform", IROS
2003.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.lidar.normals import eigenvalues, longest_cross
from odomap.lidar.voxels import (
    COARSER,
    FAR_AWAY,
    FURTHEST,
    axis_of_key,
    key_of,
    level_of_key,
    near_cells,
    new_table,
    rehash_kernel,
    slot_of,
)

__all__ = [
    "NONE",
    "NORMAL",
    "OLD",
    "SURFACE",
    "TILT",
    "WHEN",
    "PlaneMap",
    "plane_kernel",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Flags = NDArray[np.int8]

OLD, NONE, SURFACE = np.int8(0), np.int8(1), np.int8(2)
"""What is known of a voxel: its plane is to be found again, there is none, or it is there."""
TILT, NORMAL, PLANE = 3, 4, 8
"""Columns of a voxel's plane after its mean: how far its normal may be tilted, δ², radians squared;
where the normal begins, |n|² after it; and how many there are, as many as are fetched at once."""
WHEN, SUMS = 10, 11
"""Column of a voxel's sums that adds up the numbers of its points' sweeps; and how many it has."""
FEWEST = 6
"""Points from which on they may lie in a plane."""
MANY = 400.0
"""Points whose sums are halved, so that a voxel follows what changes."""
THIN = 0.3
"""κ: λ₀ / λ₁ from which on points do not lie in a plane."""
LINE = 0.03
"""Of λ₂: what λ₁ must exceed λ₀ by, else points lie on a line."""
FIRST_ROOM = 4096


@kernel
def plane_kernel(v: int, key: int, size: float, sums: Array, sigma2: float, planes: Array) -> bool:
    """planes[v] ← μ, δ², n, |n|² of a voxel; whether its points lie in a plane."""
    n = sums[v, 0]
    if n < FEWEST:
        return False
    i, size = level_of_key(key, size)
    x, y, z = sums[v, 1] / n, sums[v, 2] / n, sums[v, 3] / n
    planes[v, 0], planes[v, 1] = x + (i + 0.5) * size, y + (axis_of_key(key, 1) + 0.5) * size
    planes[v, 2] = z + (axis_of_key(key, 2) + 0.5) * size
    unbiased = n / (n - 1.0)
    a, b = unbiased * (sums[v, 4] / n - x * x), unbiased * (sums[v, 5] / n - x * y)
    c, d = unbiased * (sums[v, 6] / n - x * z), unbiased * (sums[v, 7] / n - y * y)
    e, f = unbiased * (sums[v, 8] / n - y * z), unbiased * (sums[v, 9] / n - z * z)
    least, middle, largest = eigenvalues(a, b, c, d, e, f)
    if middle - least <= LINE * largest or least >= THIN * middle:
        return False
    x, y, z, square = longest_cross(a - least, b, c, d - least, e, f - least)
    if not square > 0.0:
        return False
    share = 1.0 - least / (THIN * middle)
    length2 = share / (least + sigma2)
    length = np.sqrt(length2 / square)
    planes[v, NORMAL], planes[v, NORMAL + 1] = length * x, length * y
    planes[v, NORMAL + 2], planes[v, NORMAL + 3] = length * z, length2
    planes[v, TILT] = least * middle / (n * (middle - least) ** 2)
    return True


@kernel
def _insert_kernel(
    points: Array, first: int, size: float, table: Index, keys: Index, sums: Array, flags: Flags,
    count: int, sweep: float,
) -> tuple[int, int]:  # fmt: skip
    """Add points of a sweep from `first` on to the sums of a small voxel and a large one each.

    Returns where it stopped, for want of room if before the end, and how many voxels there are.
    """
    for n in range(first, points.shape[0]):
        if count + 2 > keys.shape[0]:
            return n, count
        for level in range(2):
            side = size * COARSER if level else size
            x, y, z = points[n, 0] / side, points[n, 1] / side, points[n, 2] / side
            i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
            key = key_of(i + FAR_AWAY if level else i, j, k)
            slot = slot_of(key, table)
            v = int(table[slot, 1])
            if v < 0:
                v = count
                table[slot, 0], table[slot, 1], keys[v] = key, v, key
                for c in range(SUMS):
                    sums[v, c] = 0.0
                count += 1
            elif sums[v, 0] >= MANY:
                for c in range(SUMS):
                    sums[v, c] *= 0.5
            x, y, z = side * (x - i - 0.5), side * (y - j - 0.5), side * (z - k - 0.5)
            sums[v, 0] += 1.0
            sums[v, 1] += x
            sums[v, 2] += y
            sums[v, 3] += z
            sums[v, 4] += x * x
            sums[v, 5] += x * y
            sums[v, 6] += x * z
            sums[v, 7] += y * y
            sums[v, 8] += y * z
            sums[v, 9] += z * z
            sums[v, WHEN] += sweep
            flags[v] = OLD
    return points.shape[0], count


class PlaneMap:
    """Surfaces around a body.

    Args:
        voxel: side of a small voxel, metres.
        sigma: least thickness of a surface, metres.

    Attributes:
        table, keys, sums, flags, planes: arrays of the voxels, for kernels; the first
            `len` rows count.
        sweeps: how many were added.
    """

    def __init__(self, voxel: float, sigma: float) -> None:
        self.voxel, self.sigma = voxel, sigma
        self.clear()

    def __len__(self) -> int:
        return self._size

    def clear(self) -> None:
        """Forget everything."""
        self._size = self.sweeps = 0
        self._make(FIRST_ROOM)

    def _make(self, room: int) -> None:
        self.table, self.keys = new_table(room), np.empty(room, np.int64)
        self.sums, self.flags = np.empty((room, SUMS)), np.zeros(room, np.int8)
        self.planes = np.empty((room, PLANE))

    def insert(self, points: Array) -> None:
        """Add points (N, 3) in the map's frame; those too far from its origin are left out."""
        inside = 0.25 * FURTHEST * self.voxel
        if len(points) and not float(np.abs(points).max()) < inside:
            points = points[np.abs(points).max(axis=1) < inside]
        done, self.sweeps = 0, self.sweeps + 1
        while True:
            done, self._size = _insert_kernel(
                points, done, self.voxel, self.table, self.keys, self.sums, self.flags, self._size,
                float(self.sweeps),
            )  # fmt: skip
            if done == len(points):
                return
            self._keep(np.arange(self._size), 2 * self._size + 2)

    def evict(self, centre: Array, distance: float) -> int:
        """Forget voxels farther than a distance from a point (3,); return how many."""
        near = np.empty(self._size, np.int64)
        near = near[: near_cells(self.keys[: self._size], self.voxel, centre, distance, near)]
        gone = self._size - len(near)
        if gone:
            self._keep(near, max(FIRST_ROOM, len(near) + len(near) // 2))
        return gone

    def _keep(self, rows: Index, room: int) -> None:
        """Keep some voxels, in their order, with room for others."""
        names = "keys", "sums", "flags", "planes"
        old = [getattr(self, name)[rows] for name in names]
        self._make(room)
        for name, kept in zip(names, old, strict=True):
            getattr(self, name)[: len(rows)] = kept
        self._size = len(rows)
        rehash_kernel(self.keys, self._size, self.table)


def warm_up() -> None:
    """Compile the kernels of this file."""
    surfaces = PlaneMap(1.0, 0.05)
    surfaces.insert(np.array([[x, y, 0.01 * x * y] for x in range(3) for y in range(3)]) / 3.0)
    plane_kernel(0, surfaces.keys[0], 1.0, surfaces.sums, 0.01, surfaces.planes)
    surfaces.evict(np.zeros(3), 0.1)
