"""Is each wall of a grid there once? Two numbers that need no true plan (`laser2d.py`).

A map whose path does not meet itself shows one wall twice: two parallel lines, a hand's breadth to
an arm's length apart, and between them floor that beams went through when the nearer one was not
seen there. A real wall between two rooms has two faces as well, but what is between them nobody
saw. So of the cells of walls at least a metre long the share is counted from which, along the
normal, another such wall stands 10 to 40 cm away with free floor between. Where beams rubbed one of
the two out nothing is doubled; but then the scans that saw it end in the open, which is the second
number.

Shelves and half open doors are truly double: what counts is the difference to a grid whose loops
were not closed, and the picture.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from odomap.lidar.grid import OccupancyGrid, beside, is_wall
from odomap.lidar.scans import Beams
from odomap.maps.map import Map

NEAR_M, FAR_M = 0.10, 0.40
AROUND_CELLS = 3.0
"""Cells around one of which its wall's direction is found."""
LEAST_CELLS, WIDEST = 5, 0.4
"""Cells of a line at least, and how wide it may be for its length."""
PARALLEL = np.cos(np.radians(20.0))
LONG_M, WHOLE = 0.5, 0.8
"""How far a wall goes on to either side, and the share of that which must be there."""

Array = NDArray[np.float64]


def doubled(grid: OccupancyGrid) -> float:
    """Return the share of the cells of a grid's long walls that have a parallel one close by."""
    walls = grid.log_odds > 0.0
    cells = np.argwhere(walls)
    if not len(cells):
        return float("nan")
    normals = _normals(cells)
    normals[~_is_long(grid, cells, normals)] = np.nan
    is_line = np.isfinite(normals).all(axis=1)
    row = np.full(walls.shape, -1, np.int64)
    row[tuple(cells.T)] = np.arange(len(cells))
    found = np.zeros(len(cells), np.bool_)
    for side in (1.0, -1.0):
        found[is_line] |= _has_twin(grid, cells[is_line], side * normals[is_line], row, normals)
    return float(found.sum() / max(is_line.sum(), 1))


def _is_long(grid: OccupancyGrid, cells: NDArray[np.int64], normals: Array) -> NDArray[np.bool_]:
    """Say of each cell if its wall goes on to either side; where it has no normal, it does not."""
    walls = beside(is_wall(grid))
    steps = np.arange(-LONG_M / grid.resolution, LONG_M / grid.resolution + 1.0)
    along = np.nan_to_num(normals)[:, ::-1] * (1.0, -1.0)
    at = np.round(cells[:, None] + steps[:, None] * along[:, None]).astype(np.int64)
    shape = np.array(walls.shape)
    is_in = ((at >= 0) & (at < shape)).all(axis=2)
    y, x = np.clip(at, 0, shape - 1).transpose(2, 0, 1)
    there = (walls[y, x] & is_in).mean(axis=1) >= WHOLE
    return np.asarray(there & np.isfinite(normals).all(axis=1))


def _normals(cells: NDArray[np.int64]) -> Array:
    """Return the normals (N, 2) of walls at their cells; NaN where they are no lines."""
    tree = cKDTree(cells)
    normals = np.full(cells.shape, np.nan)
    for n, others in enumerate(tree.query_ball_point(cells, AROUND_CELLS)):
        if len(others) < LEAST_CELLS:
            continue
        variances, axes = np.linalg.eigh(np.cov(cells[others].T))
        if variances[0] < WIDEST * variances[1]:
            normals[n] = axes[:, 0]
    return normals


def _has_twin(
    grid: OccupancyGrid,
    cells: NDArray[np.int64],
    normals: Array,
    row: NDArray[np.int64],
    of_rows: Array,
) -> NDArray[np.bool_]:
    """Say of each cell if there is a parallel wall in the direction of its normal."""
    near, far = NEAR_M / grid.resolution, FAR_M / grid.resolution
    steps = np.arange(1.0, far + 1e-9, 0.5)
    at = np.floor(cells[:, None] + 0.5 + steps[:, None] * normals[:, None]).astype(np.int64)
    shape = np.array(row.shape)
    is_in = ((at >= 0) & (at < shape)).all(axis=2)
    y, x = np.clip(at, 0, shape - 1).transpose(2, 0, 1)
    odds = np.where(is_in, grid.log_odds[y, x], 0.0)
    was_free = np.logical_or.accumulate(odds < 0.0, axis=1)
    other = (odds > 0.0) & was_free & (steps >= near)
    first = other.argmax(axis=1)
    n = np.arange(len(cells))
    theirs = of_rows[row[y[n, first], x[n, first]]]
    is_parallel = np.abs((theirs * normals).sum(axis=1)) > PARALLEL
    return np.asarray(other.any(axis=1) & is_parallel)  # no twin is NaN, and not parallel


def in_the_open(map: Map, beams: Beams, grid: OccupancyGrid) -> float:
    """Return the share of all beams of a map's keyframes that end where its grid is free."""
    ended = total = 0.0
    for k in map.keyframe_ids.tolist():
        scan, T = map.keyframe(k).scan, map.T_world_body(k)
        if scan is None:
            continue
        hits = beams.points(scan).hits @ T[:2, :2].T + T[:2, 3]
        ended += grid.share_in_free(hits) * len(hits)
        total += len(hits)
    return ended / max(total, 1.0)
