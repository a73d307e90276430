"""Voxel maps: what many scans saw, kept near the sensor and in bounded memory.

A scan is laid onto what scans before it saw. Points are kept by the voxel they lie in, at most so
many per voxel and none nearer than a gap to another, so that standing still adds nothing; all
points that ever fell into a voxel go into its sums n, Σ u, Σ u uᵀ, from which normals are found. As
the sensor moves on, voxels farther than a distance are forgotten.

`target` makes what is there ready for `register`: points packed by voxel, which is the order the
search wants them in, and normals from the sums of 27 voxels.

Cost: 0.1 µs per inserted point; a target 0.5 µs per voxel, eviction 0.1 µs.

Reference: I. Vizzo, T. Guadagnino, B. Mersch, L. Wiesmann, J. Behley, C. Stachniss, "KISS-ICP: in
defense of point-to-point ICP", RA-L 8(2), 2023.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import ConfigError, InputError
from odomap.kernels import kernel
from odomap.lidar.gicp import discs
from odomap.lidar.neighbours import Grid, checked_points
from odomap.lidar.normals import cell_covariances, normals_of
from odomap.lidar.target import Target
from odomap.lidar.voxels import (
    FURTHEST,
    Cells,
    key_of,
    mean_points,
    new_table,
    rehash_kernel,
    slot_of,
)

__all__ = ["VoxelMap", "insert_kernel", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
FIRST_ROOM = 1024


@kernel
def insert_kernel(
    points: Array, first: int, size: float, gap2: float, table: Index, keys: Index, sums: Array,
    counts: Index, kept: Array, count: int,
) -> tuple[int, int]:  # fmt: skip
    """Add points from `first` on to the sums of their voxels, and keep those that are new.

    Returns where it stopped, for want of room if before the end, and how many voxels there are.
    """
    inverse, most = 1.0 / size, kept.shape[1]
    for n in range(first, points.shape[0]):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        i, j = int(np.floor(x * inverse)), int(np.floor(y * inverse))
        k = int(np.floor(z * inverse))
        key = key_of(i, j, k)
        slot = slot_of(key, table)
        v = table[slot, 1]
        if v < 0:
            if count == keys.shape[0]:
                return n, count
            v = count
            table[slot, 0], table[slot, 1], keys[v], counts[v] = key, v, key, 0
            for c in range(10):
                sums[v, c] = 0.0
            count += 1
        is_new = counts[v] < most
        for c in range(counts[v]):
            if not is_new:
                break
            a, b, d = kept[v, c, 0] - x, kept[v, c, 1] - y, kept[v, c, 2] - z
            is_new = a * a + b * b + d * d >= gap2
        if is_new:
            kept[v, counts[v], 0], kept[v, counts[v], 1], kept[v, counts[v], 2] = x, y, z
            counts[v] += 1
        x, y, z = x - (i + 0.5) * size, y - (j + 0.5) * size, z - (k + 0.5) * size
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
    return points.shape[0], count


class VoxelMap:
    """Points by voxel, that scans are added to and registered against.

    Args:
        voxel: side of a voxel, metres.
        points_per_voxel: most that are kept in one.
        gap: least distance between those kept in one; default a quarter of the voxel.
        is_planar: whether it is of scans of the plane z = 0.

    Raises:
        ConfigError: a size that cannot be.

    Example:
        >>> grid = VoxelMap(1.0)
        >>> grid.insert([[0.1, 0.1, 0.1], [0.9, 0.1, 0.1], [0.12, 0.1, 0.1]])
        >>> len(grid), grid.num_points
        (1, 2)
    """

    def __init__(
        self,
        voxel: float,
        points_per_voxel: int = 20,
        gap: float | None = None,
        is_planar: bool = False,
    ) -> None:
        self.voxel, self.is_planar = float(voxel), is_planar
        self.gap = 0.25 * self.voxel if gap is None else float(gap)
        if not (0.0 < self.voxel < np.inf and 0.0 <= self.gap < np.inf and points_per_voxel > 0):
            raise ConfigError(
                f"voxel map: voxel {voxel}, gap {self.gap} or points_per_voxel {points_per_voxel} "
                "cannot be: give metres above 0, and 1 point or more"
            )
        self._most, self._origin = points_per_voxel, np.zeros(3)
        self._empty(FIRST_ROOM)

    def _empty(self, room: int) -> None:
        self._table, self._keys = new_table(room), np.empty(room, np.int64)
        self._sums, self._counts = np.empty((room, 10)), np.zeros(room, np.int64)
        self._kept, self._size = np.empty((room, self._most, 3)), 0

    def __len__(self) -> int:
        return self._size

    @property
    def num_points(self) -> int:
        """How many points are kept."""
        return int(self._counts[: self._size].sum())

    @property
    def points(self) -> Array:
        """(N, 3) points that are kept, voxel by voxel."""
        return self._packed() + self._origin

    def _packed(self) -> Array:
        used = np.arange(self._most) < self._counts[: self._size, None]
        return np.ascontiguousarray(self._kept[: self._size][used])

    def insert(self, points: ArrayLike) -> None:
        """Add points (N, 3) in the map's frame.

        Raises:
            InputError: wrong shape, not finite, or too far from the first ones for the voxel.
        """
        new = checked_points(points, "voxel map")
        if not len(new):
            return
        if not self._size:
            self._origin = np.floor(new.mean(axis=0) / self.voxel) * self.voxel
        new = new - self._origin
        if not float(np.abs(new).max()) < (FURTHEST - 1) * self.voxel:
            raise InputError("voxel map: points are too far from the first ones for its voxels")
        done = 0
        while True:
            done, self._size = insert_kernel(
                new, done, self.voxel, self.gap**2, self._table, self._keys, self._sums,
                self._counts, self._kept, self._size,
            )  # fmt: skip
            if done == len(new):
                return
            self._keep(np.arange(self._size), 2 * self._size)

    def evict(self, centre: ArrayLike, distance: float) -> int:
        """Forget voxels whose middle is farther than a distance from a point; return how many."""
        middle = np.asarray(centre, np.float64)
        if middle.shape != (3,) or not np.isfinite(middle).all() or not distance >= 0.0:
            raise InputError("voxel map: evict needs a point (3,) and a distance")
        keys = self._keys[: self._size]
        places = np.stack([((keys >> (21 * a)) & ((1 << 21) - 1)) - FURTHEST for a in range(3)], 1)
        off = (places + 0.5) * self.voxel + self._origin - middle
        near = np.flatnonzero(np.sum(off * off, axis=1) <= distance**2)
        gone = self._size - len(near)
        if gone:
            self._keep(near, max(FIRST_ROOM, len(near) + len(near) // 2))
        return gone

    def _keep(self, rows: Index, room: int) -> None:
        """Keep some voxels, in their order, with room for others."""
        old = self._keys, self._sums, self._counts, self._kept
        self._empty(room)
        for new, before in zip(
            (self._keys, self._sums, self._counts, self._kept), old, strict=True
        ):
            new[: len(rows)] = before[rows]
        self._size = len(rows)
        rehash_kernel(self._keys, self._size, self._table)

    def target(self, max_distance: float | None = None) -> Target:
        """Return what is there as a target of `register`.

        Args:
            max_distance: farthest that pairs will be apart; default one voxel.

        Raises:
            InputError: there are no points.
        """
        if not self._size:
            raise InputError("voxel map: is empty: insert a scan before others are laid onto it")
        n = self._size
        keys, sums, counts = self._keys[:n], self._sums[:n], self._counts[:n]
        cells = Cells(self.voxel, self._table, keys, sums, np.empty(0, np.int64))
        means = np.empty((n, 3))
        mean_points(keys, sums, self.voxel, means)
        normals, spreads = normals_of(
            cell_covariances(cells, means, 10, self.is_planar), self.is_planar
        )
        spreads[:, 4] = 1.0
        scaled = discs(normals, spreads, 2.0 * self.voxel)
        stop = np.cumsum(counts)
        points, of = self._packed(), np.repeat(np.arange(n), counts)
        grid = Grid(
            self.voxel, self._table.copy(), stop - counts, stop, points, np.arange(len(points))
        )
        reach = self.voxel if max_distance is None else max_distance
        rest = self._origin.copy(), 0.5 * self.voxel, reach, self.is_planar
        return Target(grid, normals[of], spreads[of], scaled[of], *rest)


def warm_up() -> None:
    """Compile the kernels of this file."""
    grid = VoxelMap(1.0)
    grid.insert(np.eye(3))
    grid.target()
