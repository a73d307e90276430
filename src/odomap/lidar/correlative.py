"""Correlative matching: trying all poses near one, where Gauss-Newton would be led astray.

Gauss-Newton finds the nearest valley. Where a scan may be some cells off, as when nobody knows how
the body moved, all shifts by whole cells and all turns in a small window are tried,

    x* = argmax  Σ_i m(T_x p_i) · (1 - ε |x - x̂|²),

and the best is where it begins, of equal ones the nearest. Farther off, branch and bound is
quicker (`branchbound`).

Cost: points · shifts · turns; a thousand poses of 360 points take half a millisecond.

Reference: E. Olson, "Real-time correlative scan matching", ICRA 2009.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.lidar.grid import Cells, OccupancyGrid

__all__ = ["search_near"]

Array = NDArray[np.float64]

TURN = 0.02
"""Step of the turns, radians: the valley of Gauss-Newton is wider."""
MOST = 120
"""Points that are searched with, of more every second, third, ...: neighbours say the same."""


def search_near(
    grid: OccupancyGrid, points_body: Array, x_middle: Array, reach: float, turn: float
) -> Array:
    """Return the best pose near another.

    Args:
        grid: what is known.
        points_body: (N, 2), one at least, metres.
        x_middle: (3,) x, y, heading of the body in the grid.
        reach: how far from there in x and y, metres.
        turn: how far in heading, radians.

    Returns:
        (3,); of poses that are as good the nearest to the middle.
    """
    best = np.array(x_middle, float)
    some = np.ascontiguousarray(points_body[:: -(-len(points_body) // MOST)])
    cells, turns = int(np.ceil(reach / grid.resolution)), int(np.ceil(turn / TURN))
    search_kernel(
        grid.log_odds, grid.origin, grid.resolution, some, np.array(best), cells, turns, best
    )
    return best


@kernel
def search_kernel(
    log_odds: Cells,
    origin: Array,
    resolution: float,
    points: Array,
    x: Array,
    reach: int,
    turns: int,
    best: Array,
) -> None:
    """best ← argmax Σ max(l(T p), 0) over shifts and turns; the middle counts a little more."""
    height, width = log_odds.shape
    columns, rows = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    most = -1.0
    for a in range(-turns, turns + 1):
        c, s = np.cos(x[2] + a * TURN), np.sin(x[2] + a * TURN)
        for i in range(len(points)):
            p_x, p_y = c * points[i, 0] - s * points[i, 1], s * points[i, 0] + c * points[i, 1]
            columns[i] = int(np.floor((x[0] + p_x - origin[0]) / resolution))
            rows[i] = int(np.floor((x[1] + p_y - origin[1]) / resolution))
        for dy in range(-reach, reach + 1):
            for dx in range(-reach, reach + 1):
                total = 0.0
                for i in range(len(points)):
                    column, row = columns[i] + dx, rows[i] + dy
                    if column >= 0 and row >= 0 and column < width and row < height:
                        total += max(log_odds[row, column], 0.0)
                off = (dx * dx + dy * dy) / (reach * reach + 1.0) + a * a / (turns * turns + 1.0)
                total *= 1.0 - 0.05 * off
                if total > most:
                    most = total
                    best[0], best[1] = x[0] + dx * resolution, x[1] + dy * resolution
                    best[2] = x[2] + a * TURN


def warm_up() -> None:
    """Compile the kernels of this module."""
    grid = OccupancyGrid(0.1)
    points = np.array([[0.3, 0.1], [0.3, -0.1]])
    grid.insert(np.zeros(2), points)
    search_near(grid, points, np.zeros(3), 0.1, 0.02)
