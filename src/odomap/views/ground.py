"""Heights above the ground of a cloud, where nobody says which points are ground.

Ground is seldom flat, but it is low: within a square of some metres its height is that of the
lowest points, but for the few that mirrors put below it. So

    h_i = z_i - z of the square's lowest twentieth.

Cost: O(N log N).

Reference: M. Himmelsbach et al., "Fast segmentation of 3D point clouds for ground vehicles", IV
2010 (ground as the lowest points of cells).
"""

import numpy as np
from numpy.typing import NDArray

__all__ = ["above_ground"]

Array = NDArray[np.float64]

SQUARE = 8.0
"""Side of the squares in which the ground is looked for, metres."""
ONE_IN = 20
"""One point in so many may lie below the ground."""


def above_ground(points: Array) -> Array:
    """Return the heights (N,) of points (N, 3) above the ground around them; z is up."""
    if not len(points):
        return np.zeros(0)
    columns, rows = np.floor(points[:, :2] / SQUARE).astype(np.int64).T
    square = (rows - rows.min()) * (np.ptp(columns) + 1) + columns - columns.min()
    z = points[:, 2]
    order = np.lexsort((z, square))
    starts = np.flatnonzero(np.diff(square[order], prepend=-1))
    counts = np.diff(starts, append=len(order))
    lowest = z[order[starts + counts // ONE_IN]]
    heights = np.empty(len(points))
    heights[order] = z[order] - np.repeat(lowest, counts)
    return heights
