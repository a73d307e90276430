"""Walls: how well the occupied cells of a grid show the plan it should show.

A grid is wrong where it has walls that are none, and where it lacks some that could be seen. With d
the distance to the true walls and s the size of a cell,

    true   share of occupied cells whose middles have d ≤ n s,
    found  share of the parts of true walls that a beam can have met, with an occupied cell within
           n s of them,

of n = 1 cell. Parts are the cells that such walls go through, so that a wall looked at for long
counts as much as one passed by. Both are needed: an empty grid has no wrong wall. Grid and plan are
compared where they are; to compare shapes, the path is aligned first, and the cells with it.
O(N log N).

Reference: A. Kümmerle et al., "On measuring the accuracy of SLAM algorithms", Autonomous Robots
27(4), 2009 (why maps are compared with plans as well as paths with paths).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["WallsResult", "compare_walls"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class WallsResult:
    """How well occupied cells show true walls.

    Attributes:
        true: share of the occupied cells within so many of a true wall; NaN if there are none.
        found: share of the seen parts of true walls with an occupied cell within so many.
        cells: how many cells are occupied.
        parts: how many parts of true walls could be seen.
        mean_m: mean distance of the occupied cells' middles from the true walls.
        worst_m: the largest.
    """

    true: float
    found: float
    cells: int
    parts: int
    mean_m: float
    worst_m: float


def compare_walls(
    centres: Array, distances: Array, seen: Array, cell_m: float, within_cells: float = 1.0
) -> WallsResult:
    """Compare the occupied cells of a grid with a true plan.

    Args:
        centres: (N, 2) middles of the occupied cells, in the plan's frame, metres.
        distances: (N,) of these from the nearest true wall.
        seen: (M, 2) points of true walls that beams can have met.
        cell_m: size of a cell.
        within_cells: how far off is no error.

    Raises:
        ValueError: shapes do not fit, a number is not finite, or there is nothing to be seen.
    """
    from scipy.spatial import cKDTree

    if len(centres) != len(distances) or np.shape(seen)[1:] != (2,) or not len(seen):
        raise ValueError(
            f"{np.shape(centres)} cells need as many distances, not {np.shape(distances)}, and "
            f"points of walls that can be seen, not {np.shape(seen)}"
        )
    if not all(np.isfinite(part).all() for part in (centres, distances, seen)):
        raise ValueError("a cell, a distance or a wall is not finite")
    _, first = np.unique(np.floor(seen / cell_m).astype(np.int64), axis=0, return_index=True)
    parts = seen[np.sort(first)]
    limit = within_cells * cell_m * (1.0 + 1e-9)
    if not len(centres):
        return WallsResult(float("nan"), 0.0, 0, len(parts), float("nan"), float("nan"))
    away, _ = cKDTree(centres).query(parts)
    return WallsResult(
        true=float(np.mean(distances <= limit)),
        found=float(np.mean(away <= limit)),
        cells=len(centres),
        parts=len(parts),
        mean_m=float(distances.mean()),
        worst_m=float(distances.max()),
    )
