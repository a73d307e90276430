"""Voxels by hash: which cell a point lies in, and what a cell's points amount to.

An endless grid of cubes of side h of which only the occupied exist. The cell (i, j, k) = ⌊p / h⌋ is
packed into one number of 63 bits, found in a table of a power of two by the top bits of its product
with a constant, and linear probing: O(1), one comparison. Cells are numbered as they first occur,
so that the same points give the same cells.

Down-sampling keeps one point per cell, the mean, and with it the sums that say how the cell's
points are spread: with u = p - (the cell's centre)

    n,   Σ u,   Σ u uᵀ

Sums of neighbouring cells are added after a shift of the centre, so that the spread of all points
around a cell costs 27 look-ups, however many points there are.

A table can hold cells of two sizes, the large ones far away along x, where no small one is.

Cost: 25 ns per point.

Reference: M. Teschner et al., "Optimized spatial hashing for collision detection of deformable
objects", VMV 2003.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.kernels import kernel

__all__ = [
    "COARSER",
    "FAR_AWAY",
    "FURTHEST",
    "Cells",
    "axis_of_key",
    "centred",
    "first_in_voxels",
    "into_cells",
    "key_of",
    "level_of_key",
    "mean_points",
    "near_cells",
    "new_table",
    "rehash_kernel",
    "slot_of",
    "sum_cells",
    "warm_up",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

FURTHEST = 1 << 20
"""Cells beyond this many from the origin along an axis cannot be told apart."""
COARSER = 3
"""Size of large cells in small ones, where a table holds both."""
FAR_AWAY = FURTHEST // 2
"""Where along x large cells are in it, in cells; small ones stay nearer than half of that."""
_MASK = (1 << 21) - 1
_MIXER = 0x1E3779B97F4A7C15


@dataclass(frozen=True, eq=False)
class Cells:
    """The occupied cells of a cloud.

    Attributes:
        size: side of a cell.
        table: (S, 2) key and number of the cell in each slot, -1 where there is none.
        keys: (V,) packed places of the cells.
        sums: (V, 10) n, Σ u, Σ u uᵀ (xx, xy, xz, yy, yz, zz) about the centres of the cells.
        cell_of: (N,) the cell of each point.
    """

    size: float
    table: Index
    keys: Index
    sums: Array
    cell_of: Index

    def __len__(self) -> int:
        return len(self.keys)


def new_table(room: int) -> Index:
    """Return an empty table for up to `room` cells, at most half full."""
    slots = 1 << max(int(2 * room - 1).bit_length(), 4)
    return np.full((slots, 2), -1, np.int64)


@kernel
def key_of(i: int, j: int, k: int) -> int:
    """The cell's place in one number, 21 bits per axis."""
    return (i + FURTHEST) | ((j + FURTHEST) << 21) | ((k + FURTHEST) << 42)


@kernel
def axis_of_key(key: int, axis: int) -> int:
    """Its place along one axis, 0 to 2."""
    return ((key >> (21 * axis)) & _MASK) - FURTHEST


@kernel
def level_of_key(key: int, size: float) -> tuple[int, float]:
    """Its place along x among cells of its size, and that size, where a table holds two."""
    i = axis_of_key(key, 0)
    if i > FAR_AWAY // 2:
        return i - FAR_AWAY, size * COARSER
    return i, size


@kernel
def near_cells(keys: Index, size: float, centre: Array, distance: float, near: Index) -> int:
    """near ← cells of either size whose middle is within a distance; returns how many."""
    count = 0
    for cell in range(keys.shape[0]):
        i, side = level_of_key(keys[cell], size)
        x = (i + 0.5) * side - centre[0]
        y = (axis_of_key(keys[cell], 1) + 0.5) * side - centre[1]
        z = (axis_of_key(keys[cell], 2) + 0.5) * side - centre[2]
        if x * x + y * y + z * z <= distance * distance:
            near[count] = cell
            count += 1
    return count


@kernel
def slot_of(key: int, table: Index) -> int:
    """The slot a cell is in, or the empty one where it would be entered."""
    mask = table.shape[0] - 1
    at = ((int(key) * _MIXER) >> 36) & mask
    while table[at, 0] != key and table[at, 0] >= 0:
        at = (at + 1) & mask
    return int(at)


@kernel
def rehash_kernel(keys: Index, count: int, table: Index) -> None:
    """Enter the first `count` cells into an empty table."""
    for cell in range(count):
        slot = slot_of(keys[cell], table)
        table[slot, 0], table[slot, 1] = keys[cell], cell


@kernel
def sum_cells(
    points: Array, first: int, size: float, table: Index, keys: Index, sums: Array, cell_of: Index,
    count: int,
) -> tuple[int, int]:  # fmt: skip
    """Enter points from `first` on: n += 1, Σ u += u, Σ u uᵀ += u uᵀ.

    Returns where it stopped, for want of room if before the end, and how many cells there are.
    """
    inverse, last, cell = 1.0 / size, -1, -1
    for n in range(first, points.shape[0]):
        i = int(np.floor(points[n, 0] * inverse))
        j = int(np.floor(points[n, 1] * inverse))
        k = int(np.floor(points[n, 2] * inverse))
        key = key_of(i, j, k)
        if key != last:  # points that follow one another often share a cell
            slot = slot_of(key, table)
            cell = int(table[slot, 1])
            last = key
            if cell < 0:
                if count == keys.shape[0]:
                    return n, count
                cell = count
                table[slot, 0], table[slot, 1], keys[cell] = key, cell, key
                for c in range(10):
                    sums[cell, c] = 0.0
                count += 1
        cell_of[n] = cell
        x = points[n, 0] - (i + 0.5) * size
        y = points[n, 1] - (j + 0.5) * size
        z = points[n, 2] - (k + 0.5) * size
        sums[cell, 0] += 1.0
        sums[cell, 1] += x
        sums[cell, 2] += y
        sums[cell, 3] += z
        sums[cell, 4] += x * x
        sums[cell, 5] += x * y
        sums[cell, 6] += x * z
        sums[cell, 7] += y * y
        sums[cell, 8] += y * z
        sums[cell, 9] += z * z
    return points.shape[0], count


@kernel
def mean_points(keys: Index, sums: Array, size: float, means: Array) -> None:
    """means = centre + Σ u / n."""
    for cell in range(means.shape[0]):
        for axis in range(3):
            centre = (axis_of_key(keys[cell], axis) + 0.5) * size
            means[cell, axis] = centre + sums[cell, 1 + axis] / sums[cell, 0]


@kernel
def _centre_kernel(points: Array, mean: Array, out: Array) -> float:
    """mean = Σ p / N, out = p - mean; returns the largest |coordinate| of out."""
    count = points.shape[0]
    x, y, z, furthest = 0.0, 0.0, 0.0, 0.0
    for n in range(count):
        x, y, z = x + points[n, 0], y + points[n, 1], z + points[n, 2]
    mean[0], mean[1], mean[2] = x / count, y / count, z / count
    for n in range(count):
        for axis in range(3):
            out[n, axis] = points[n, axis] - mean[axis]
            furthest = max(furthest, abs(out[n, axis]))
    return furthest


def centred(points: Array) -> tuple[Array, Array, float]:
    """Return the mean (3,) of some points (N, 3), them about it, and their largest coordinate."""
    mean, out = np.empty(3), np.empty((len(points), 3))
    return mean, out, float(_centre_kernel(np.ascontiguousarray(points), mean, out))


def into_cells(points: Array, size: float) -> Cells:
    """Sort points into cells.

    Args:
        points: (N, 3) finite.
        size: side of a cell, above 0.

    Raises:
        InputError: the cells are too small to be numbered.
    """
    furthest = float(np.abs(points).max(initial=0.0))
    if not furthest < (FURTHEST - 1) * size:
        raise InputError(
            f"voxel: {size:g} is too small for points {furthest:g} away: "
            f"at least {furthest / (FURTHEST - 2):.3g} is needed"
        )
    room = max(1024, len(points) // 8)
    table = new_table(room)
    keys, sums = np.empty(room, np.int64), np.empty((room, 10))
    cell_of = np.empty(len(points), np.int64)
    done, count = 0, 0
    while True:
        done, count = sum_cells(points, done, size, table, keys, sums, cell_of, count)
        if done == len(points):
            return Cells(size, table, keys[:count], sums[:count], cell_of)
        room *= 4
        table = new_table(room)
        rehash_kernel(keys, count, table)
        keys = np.concatenate([keys, np.empty(room - count, np.int64)])
        sums = np.concatenate([sums, np.empty((room - count, 10))])


def first_in_voxels(points: Array, size: float) -> Index:
    """Return the rows of the first point in each voxel, in order."""
    slots = 1 << max(int(2 * len(points)).bit_length(), 4)
    rows = np.empty(len(points), np.int64)
    count = _first_kernel(points, size, np.full(slots, -1, np.int64), rows)
    return rows[:count]


@kernel
def _first_kernel(points: Array, size: float, seen: Index, rows: Index) -> int:
    """rows ← the first point of each voxel; those that are too far to be numbered are left out."""
    inverse, mask, count = 1.0 / size, seen.shape[0] - 1, 0
    last = -1
    for n in range(points.shape[0]):
        x, y, z = points[n, 0] * inverse, points[n, 1] * inverse, points[n, 2] * inverse
        if not max(abs(x), abs(y), abs(z)) < FURTHEST - 1:
            continue
        key = key_of(int(np.floor(x)), int(np.floor(y)), int(np.floor(z)))
        if key == last:
            continue
        last = key
        at = ((int(key) * _MIXER) >> 36) & mask
        while seen[at] != key and seen[at] >= 0:
            at = (at + 1) & mask
        if seen[at] < 0:
            seen[at] = key
            rows[count] = n
            count += 1
    return count


def warm_up() -> None:
    """Compile the kernels of this file."""
    points = centred(np.zeros((1, 3)))[1]
    cells = into_cells(points, 1.0)
    rehash_kernel(cells.keys, 1, new_table(1))
    mean_points(cells.keys, cells.sums, 1.0, points)
    first_in_voxels(points, 1.0)
    near_cells(cells.keys, 1.0, np.zeros(3), 1.0, np.empty(len(cells), np.int64))
