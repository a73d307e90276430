"""Searching a grid for a scan: the best of all poses in a window, by branch and bound.

A pose is as good as its points lie on walls, s(x) = Σ_i m(T_x p_i), where m is 1 in cells that are
rather occupied than free, one half beside them, for poses are tried in steps of a cell, and 0
elsewhere. All headings that differ by a cell at far points, and all shifts by whole cells, are
candidates: some hundred thousand. Shifts are taken together, 2^h by 2^h of them, and bounded by
what the best cell near each point could give,

    m_h(c) = max_{0 ≤ a, b < 2^h} m(c + (a, b)),     s(x) ≤ Σ_i m_h(T_x p_i),

so that a whole square of them is passed over where its bound is not above the best found. Squares
are split into four, the most promising first. The result is that of trying everything.

m has three values, so two bits hold it, 00, 01 and 11, of which the greater is a | b; a cell's bits
of all levels are side by side in one number.

Cost: O(cells · levels) for the pyramid of a grid, 2 bytes a cell; a search some milliseconds.

Reference: W. Hess, D. Kohler, H. Rapp, D. Andor, "Real-time loop closure in 2D LIDAR SLAM", ICRA
2016; E. Olson, "Real-time correlative scan matching", ICRA 2009.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.lidar.grid import OccupancyGrid, beside, is_wall

__all__ = ["Found", "GridPyramid"]

Array = NDArray[np.float64]
Level = NDArray[np.uint8]
Levels = NDArray[np.uint16]
Index = NDArray[np.int64]
Columns = NDArray[np.int32]

FULL, HALF = 255, 128
"""m = 1 and 1/2, as they are added up."""
IS_FULL, IS_HALF = np.uint8(0b11), np.uint8(0b01)
"""The same as they are kept."""
LEVELS = 8
"""Levels that the number of a cell has bits for."""
MOST = 180
"""Points that are searched with; of more every second, third, ..., for neighbours say the same."""
FAR = 0.8
"""Share of the points that move by less than a cell from one heading to the next."""


@dataclass(frozen=True, eq=False)
class Found:
    """The best pose of a search.

    Attributes:
        x_grid_body: (3,) x, y, heading; to a cell, and to a cell at far points.
        score: mean m of its points there, 0 to 1.
    """

    x_grid_body: Array
    score: float


class GridPyramid:
    """What is occupied in a grid, at best, in squares of 1, 2, 4, ... cells.

    Args:
        grid: it is copied.
        levels: so that the largest squares are 2^levels wide, 7 at most.
    """

    def __init__(self, grid: OccupancyGrid, levels: int = 6) -> None:
        if levels >= LEVELS:
            raise ValueError(f"squares of 2^{levels} cells: 2^{LEVELS - 1} at most")
        self._top, room = levels, 1 << levels
        part = grid.cropped()
        self.resolution = grid.resolution
        self._origin = part.origin - room * grid.resolution
        walls = is_wall(part)
        height, width = walls.shape
        level: Level = np.zeros((height + room, width + room), np.uint8)
        level[room:, room:] = np.where(walls, IS_FULL, IS_HALF * beside(walls))
        self._cells: Levels = level.astype(np.uint16)
        for h in range(levels):
            level = widened(level, 1 << h)
            self._cells |= level.astype(np.uint16) << (2 * h + 2)

    def search(
        self, points_body: Array, x_middle: Array, reach: float, turn: float, least: float
    ) -> Found | None:
        """Find the best pose in a window.

        Args:
            points_body: (N, 2), one at least, metres.
            x_middle: (3,) x, y, heading: the middle of the window.
            reach: half its side, metres.
            turn: half its range of headings, radians.
            least: mean m that is not enough yet, 0 to 1.

        Returns:
            The best; of equal ones always the same. None if none is better than `least`.
        """
        points_body = points_body[:: -(-len(points_body) // MOST)]
        far = float(np.quantile(np.linalg.norm(points_body, axis=1), FAR))
        step = self.resolution / max(far, self.resolution)
        count = int(np.ceil(min(turn, np.pi) / step))
        headings = x_middle[2] + step * np.arange(-count, count + 1)
        c, s = np.cos(headings)[:, None], np.sin(headings)[:, None]
        x, y = points_body.T
        columns, rows = (
            np.floor((at + turned - origin) / self.resolution).astype(np.int32)
            for at, turned, origin in (
                (x_middle[0], c * x - s * y, self._origin[0]),
                (x_middle[1], s * x + c * y, self._origin[1]),
            )
        )
        cells = int(np.ceil(reach / self.resolution))
        best = np.zeros(3, np.int64)
        full = FULL * len(points_body)
        bound = int(least * full)
        total = search_kernel(self._cells, self._top, columns, rows, cells, bound, best)
        if total <= bound:
            return None
        shift = self.resolution * best[1:]
        found = np.array([x_middle[0] + shift[0], x_middle[1] + shift[1], headings[best[0]]])
        return Found(found, total / full)


def widened(level: Level, by: int) -> Level:
    """Return the max of a level at c, c + (by, 0), c + (0, by) and c + (by, by), for all c."""
    across = level.copy()
    across[:, :-by] |= level[:, by:]
    both = across.copy()
    both[:-by] |= across[by:]
    return both


@kernel
def total_of(cells: Levels, h: int, columns: Columns, rows: Columns, a: int, x: int, y: int) -> int:
    """Σ_i m_h(c_i + (x, y)) of heading a."""
    height, width = cells.shape
    halves, fulls = 0, 0
    for i in range(columns.shape[1]):
        column, row = columns[a, i] + x, rows[a, i] + y
        if column >= 0 and row >= 0 and column < width and row < height:
            m = cells[row, column] >> (2 * h)
            halves += m & 1
            fulls += (m >> 1) & 1
    return HALF * halves + (FULL - HALF) * fulls


@kernel
def search_kernel(
    cells: Levels,
    top: int,
    columns: Columns,
    rows: Columns,
    reach: int,
    bound: int,
    best: Index,
) -> int:
    """Depth first through squares of shifts in [-reach, reach]², the best bounds first.

    Returns the best total above the bound, or the bound; best ← heading, shift in x and y.
    """
    side, headings = 1 << top, len(columns)
    across = (2 * reach + side) // side
    bounds = np.empty(headings * across * across, np.int64)
    for a in range(headings):
        for n in range(across * across):
            x, y = -reach + side * (n % across), -reach + side * (n // across)
            bounds[a * across * across + n] = total_of(cells, top, columns, rows, a, x, y)
    order = np.argsort(-bounds, kind="mergesort")
    stack = np.empty((4 * (top + 1) + 1, 5), np.int64)  # level, heading, x, y, bound
    four = np.empty(4, np.int64)
    for square in order:
        if bounds[square] <= bound:
            break
        n = square % (across * across)
        stack[0, 0], stack[0, 1], stack[0, 4] = top, square // (across * across), bounds[square]
        stack[0, 2], stack[0, 3] = -reach + side * (n % across), -reach + side * (n // across)
        height = 1
        while height > 0:
            height -= 1
            h, a, x, y = stack[height, 0], stack[height, 1], stack[height, 2], stack[height, 3]
            if stack[height, 4] <= bound:
                continue
            if h == 0:
                bound = stack[height, 4]
                best[0], best[1], best[2] = a, x, y
                continue
            half = 1 << (h - 1)
            for k in range(4):
                x_k, y_k = x + half * (k % 2), y + half * (k // 2)
                four[k] = -1
                if x_k <= reach and y_k <= reach:
                    four[k] = total_of(cells, h - 1, columns, rows, a, x_k, y_k)
            for _ in range(4):  # the worst first onto the stack, so that the best comes first off
                worst = -1
                for k in range(4):
                    if four[k] > bound and (worst < 0 or four[k] < four[worst]):
                        worst = k
                if worst < 0:
                    break
                stack[height, 0], stack[height, 1], stack[height, 4] = h - 1, a, four[worst]
                stack[height, 2], stack[height, 3] = x + half * (worst % 2), y + half * (worst // 2)
                height += 1
                four[worst] = -1
    return bound


def warm_up() -> None:
    """Compile the kernels of this module."""
    grid = OccupancyGrid(0.1)
    points = np.array([[0.3, 0.1], [0.3, -0.1]])
    grid.insert(np.zeros(2), points)
    GridPyramid(grid, 2).search(points, np.zeros(3), 0.2, 0.1, 0.1)
