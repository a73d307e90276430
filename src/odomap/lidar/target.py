"""Targets: a cloud made ready once, so that others can be laid onto it many times.

Both clouds are looked at about their mean, since coordinates of a map projection (5·10⁶ m) would
leave rotation and translation hardly apart; are down-sampled to one point per voxel; and get
normals from the raw points around each voxel, or, where points are taken as they are, from the k
nearest. A target is sorted into cells for the search as well.

A wall through the boundary of voxels is cut into two layers, each with a mean of its own, which lie
the farther off the smaller a part it is; pairs of such means are all off to one side, and a room
was by three millimetres where 0.4 were possible. So means are moved across the surface, by how flat
it is (`gicp`), onto the mean of all points around, which no boundary cuts. Neighbours then share
most of what they know: that is why their own share of it is kept (`degeneracy`).

The voxel that suits a cloud is a share of its size, so that nothing depends on the unit: a
twentieth of the mean distance from the middle (0.25 m where that is 5 m).

Cost: 0.1 µs per raw point and 1 µs per voxel.

Reference: S. Rusinkiewicz, M. Levoy, "Efficient variants of the ICP algorithm", 3DIM 2001.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import InputError
from odomap.lidar.cloud import Cloud, HasPoints, cloud_of
from odomap.lidar.gicp import discs
from odomap.lidar.neighbours import Grid, typical_cell
from odomap.lidar.normals import cell_covariances, nearest_covariances, normals_of
from odomap.lidar.voxels import centred, into_cells, mean_points

__all__ = ["FEWEST", "Sampled", "Target", "check_enough", "sample", "suitable_voxel"]

Array = NDArray[np.float64]

FEWEST = 6
"""Points below which a cloud is none."""
SHARE = 20.0
"""Voxels in the mean distance from the middle."""


@dataclass(frozen=True, eq=False)
class Sampled:
    """A cloud ready to be aligned.

    Attributes:
        origin: (3,) its mean, metres.
        points: (N, 3) about that.
        normals: (N, 3), zero where there is none.
        spreads: (N, 5) number of points around each, the eigenvalues of their covariance, and the
            share of them that is the point's own.
        spacing: how far points are apart, about.
        is_planar: whether it lies in the plane z = 0.
    """

    origin: Array
    points: Array
    normals: Array
    spreads: Array
    spacing: float
    is_planar: bool

    def __len__(self) -> int:
        return len(self.points)

    def discs(self) -> Array:
        """Return normals (N, 3) as `gicp` takes them; discs reach as far as was looked at."""
        return discs(self.normals, self.spreads, 2.0 * self.spacing)


@dataclass(frozen=True, eq=False)
class Target:
    """A cloud that others are laid onto.

    Attributes:
        grid: its points about `origin`, sorted for the search.
        normals: (M, 3) in the order of the grid.
        spreads: (M, 5) as of `Sampled`.
        discs: (M, 3) normals scaled as `gicp` takes them.
        origin: (3,).
        spacing: how far points are apart, about.
        reach: farthest that pairs may be apart unless said otherwise.
        is_planar: whether it lies in the plane z = 0.
    """

    grid: Grid
    normals: Array
    spreads: Array
    discs: Array
    origin: Array
    spacing: float
    reach: float
    is_planar: bool

    @classmethod
    def of(
        cls,
        points: "ArrayLike | Cloud | HasPoints",
        voxel: float | None = None,
        max_distance: float | None = None,
        neighbours: int = 10,
    ) -> "Target":
        """Make a cloud ready.

        Args:
            points: (N, 2), (N, 3), or a cloud.
            voxel: side of the voxels it is down-sampled to; 0: not at all; None: what suits it.
            max_distance: farthest that pairs will be apart; None: four times the spacing.
            neighbours: how many tell a normal where voxels do not.

        Raises:
            InputError: no such array, or hardly any points.
        """
        sampled = sample(cloud_of(points), voxel, neighbours, "target")
        reach = max_distance if max_distance is not None else 4.0 * sampled.spacing
        extent = float(np.abs(sampled.points).max())
        size = max(4.0 * sampled.spacing, 0.5 * reach, 1e-5 * (extent + reach))
        grid = Grid.of(sampled.points, size)
        normals, spreads = sampled.normals[grid.order], sampled.spreads[grid.order]
        rest = sampled.origin, sampled.spacing, reach, sampled.is_planar
        return cls(grid, normals, spreads, sampled.discs()[grid.order], *rest)

    def __len__(self) -> int:
        return len(self.grid.points)


def sample(cloud: Cloud, voxel: float | None, neighbours: int, name: str) -> Sampled:
    """Down-sample a cloud about its mean, and find normals.

    Args:
        cloud: what was seen.
        voxel: side of the voxels; 0: points as they are; None: what suits the cloud.
        neighbours: how many tell a normal where voxels do not.
        name: what errors call it.

    Raises:
        InputError: hardly any points, or all in one place.
    """
    check_enough(len(cloud), cloud, name)
    origin, raw, furthest = centred(cloud.points)
    if not furthest > 0.0:
        raise InputError(f"{name}: all {len(cloud)} points are in one place")
    size = suitable_voxel(cloud) if voxel is None else voxel
    if not (np.isfinite(size) and size >= 0.0):
        raise InputError(f"voxel: is {size}, give metres above 0, or 0 for points as they are")
    if size == 0.0:
        spread = nearest_covariances(raw, neighbours)
        normals, spreads = normals_of(spread, cloud.is_planar)
        if cloud.normals is not None:
            normals = np.array(cloud.normals)
        return Sampled(origin, raw, normals, spreads, 0.5 * typical_cell(raw), cloud.is_planar)
    cells = into_cells(raw, size)
    points = np.empty((len(cells), 3))
    mean_points(cells.keys, cells.sums, size, points)
    check_enough(len(points), cloud, f"{name}: in voxels of {size:g} m")
    if cloud.is_planar:
        points[:, 2] = 0.0
    spread = cell_covariances(cells, points, neighbours, cloud.is_planar)
    normals, spreads = normals_of(spread, cloud.is_planar)
    found = Sampled(origin, points, normals, spreads, size, cloud.is_planar)
    across = np.sum(spread[:, 8:11] * normals, axis=1)
    flat = np.sum(found.discs() ** 2, axis=1)
    points += (flat * across)[:, None] * normals
    return found


def suitable_voxel(cloud: Cloud) -> float:
    """Return the voxel that suits a cloud, metres."""
    centred = cloud.points - np.median(cloud.points, axis=0)
    return float(np.mean(np.linalg.norm(centred, axis=1))) / SHARE


def check_enough(count: int, cloud: Cloud, name: str) -> None:
    """Raise unless there are enough points to be aligned."""
    if count < FEWEST:
        dropped = f" ({cloud.num_dropped} of NaN or infinity dropped)" if cloud.num_dropped else ""
        raise InputError(f"{name}: has {count} points{dropped}: at least {FEWEST} are needed")
