"""Occupancy grids: how likely each cell of the plane is occupied, from what beams met and missed.

Each beam that comes back from a cell speaks for it, and against all cells on its way. In log-odds
evidence adds up,

    l(cell) ← clip( l + l_hit | l + l_miss, -l_max, l_max ),    p = 1 / (1 + e^{-l}),

0 where nothing is known. A scan speaks once of a cell, and a hit outweighs what passes it. Clipping
lets a door that opened be seen open soon. On their way rays are followed from border to border of
the cells. The grid grows where points come to lie beyond it.

Cost: O(cells on the rays), some 5 ns each.

Reference: H. Moravec, A. Elfes, "High resolution maps from wide angle sonar", ICRA 1985;
J. Amanatides, A. Woo, "A fast voxel traversal algorithm for ray tracing", Eurographics 1987.
"""

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.limits import Positive, check_limits

__all__ = ["Evidence", "OccupancyGrid", "beside", "is_wall"]

Array = NDArray[np.float64]
Cells = NDArray[np.float32]
Marks = NDArray[np.int32]
Hits = NDArray[Any]
C = TypeVar("C", np.float32, np.int32)

MARGIN = 64
"""Cells by which a grid grows beyond what it must hold."""
TINY = 1e-6
"""Log-odds of a cell for which as much speaks as against it: it is known, and 0 means unknown."""
AGAINST = 90
"""Beams that are followed to say whether they contradict a grid."""
BEHIND = 0.5
"""How far behind a wall a beam must end to have gone through it, metres."""
MOST_CELLS = 400_000_000
"""Cells that a grid may have: beyond, a range or a pose must be wrong."""


@dataclass(frozen=True)
class Evidence:
    """What a beam says of cells, in log-odds."""

    hit: Positive = 0.9
    """For the one it came back from."""
    miss: Positive = 0.3
    """Against those on its way."""
    limit: Positive = 4.0
    """Most that is believed of a cell."""

    def __post_init__(self) -> None:
        check_limits(self)


class OccupancyGrid:
    """A grid of cells in a plane, of any size.

    Args:
        resolution: size of a cell, metres.
        evidence: what a beam says.
        keeps_hits: whether it is kept where in their cells points of surfaces lie, so that scans
            can be matched to a fraction of a cell.

    Attributes:
        resolution: size of a cell, metres.
        origin: (2,) the corner of cell (0, 0) with the smallest x and y, metres.
        log_odds: (H, W) float32, row by row along y; 0 where nothing is known.
        hits: (H, W, 3), of the points of surfaces in a cell the sums of x and y within it, in
            cells, and their number, float32; of a finished grid numbers of the same ratio, uint8.
            None where that is not kept.

    Example:
        >>> grid = OccupancyGrid(0.1)
        >>> grid.insert(np.zeros(2), np.array([[1.05, 0.0]]))
        >>> grid.probability(np.array([[1.05, 0.0], [0.5, 0.0], [2.0, 0.0]])).round(2).tolist()
        [0.71, 0.43, 0.5]
    """

    def __init__(
        self,
        resolution: float = 0.05,
        evidence: Evidence | None = None,
        keeps_hits: bool = False,
    ) -> None:
        if not (np.isfinite(resolution) and resolution > 0.0):
            raise ValueError(f"a cell of {resolution} m: its size must be positive")
        self.resolution, self.evidence = resolution, Evidence() if evidence is None else evidence
        self.origin = np.zeros(2)
        self.log_odds: Cells = np.zeros((0, 0), np.float32)
        self.hits: Hits | None = np.zeros((0, 0, 3), np.float32) if keeps_hits else None
        self._marks: Marks = np.zeros((0, 0), np.int32)
        self._count = 0

    @classmethod
    def of(
        cls,
        log_odds: Cells,
        origin: Array,
        resolution: float,
        evidence: Evidence | None = None,
    ) -> "OccupancyGrid":
        """Return a grid of known cells.

        Args:
            log_odds: (H, W); 0 where nothing is known.
            origin: (2,) the corner of cell (0, 0), metres.
            resolution: size of a cell, metres.
            evidence: what further beams say.
        """
        grid = cls(resolution, evidence)
        grid.log_odds = np.ascontiguousarray(log_odds, np.float32)
        grid.origin, grid._marks = np.array(origin, float), np.zeros(log_odds.shape, np.int32)
        return grid

    @property
    def is_known(self) -> NDArray[np.bool_]:
        """(H, W) cells of which something is known."""
        return np.asarray(self.log_odds != 0.0)

    def insert(
        self,
        sensor: Array,
        hits: Array,
        *,
        between: Array | None = None,
        free: Array | None = None,
        free_from: Array | None = None,
    ) -> None:
        """Add what a scan says.

        Args:
            sensor: (2,) where the scanner was, metres.
            hits: (N, 2) where beams came back from.
            between: (M, 2) further points of the surfaces there, which no beam went to.
            free: (F, 2) ends of beams that met nothing.
            free_from: (F, 2) where they begin to be seen; by default at the scanner.

        Raises:
            ValueError: a point is not finite, or so far away that it cannot be true.
        """
        nothing = np.zeros((0, 2))
        between, free = (nothing if x is None else x for x in (between, free))
        ends = np.concatenate([hits, between, free])
        starts = np.empty((len(hits) + len(free) + 1, 2))
        starts[:] = sensor
        if free_from is not None:
            starts[len(hits) : -1] = free_from
        self._hold(ends, starts)
        self._count += 1
        cells, evidence = 1.0 / self.resolution, self.evidence
        ends, starts = (ends - self.origin) * cells, (starts[:-1] - self.origin) * cells
        occupied = ends[: len(hits) + len(between)]
        parts = self.log_odds, self._marks, self._count
        hit_cells(*parts, occupied, evidence.hit, evidence.limit)
        if self.hits is not None:
            sum_hits(self.hits, occupied)
        rays = ends[: len(hits)]
        if len(free):
            rays = np.concatenate([rays, ends[len(occupied) :]])
        pass_cells(*parts, starts, rays, evidence.miss, evidence.limit)

    def probability(self, points: Array) -> Array:
        """Return how likely (N, 2) points are occupied, (N,); 0.5 where nothing is known."""
        cells = np.floor((points - self.origin) / self.resolution).astype(np.int64)
        height, width = self.log_odds.shape
        is_in = ((cells >= 0) & (cells < (width, height))).all(axis=1)
        found = np.full(len(points), 0.5)
        x, y = cells[is_in].T
        found[is_in] = 1.0 / (1.0 + np.exp(-self.log_odds[y, x].astype(np.float64)))
        return found

    def share_in_free(self, points: Array) -> float:
        """Return the share of points (N, 2) that lie in the open: a cell off any wall at least."""
        x, y = np.floor((points - self.origin) / self.resolution).astype(np.int64).T
        height, width = self.log_odds.shape
        is_in = (x > 0) & (y > 0) & (x < width - 1) & (y < height - 1)
        x, y = x[is_in], y[is_in]
        steps = np.arange(-1, 2)
        around = self.log_odds[y[:, None, None] + steps[:, None], x[:, None, None] + steps]
        in_free = (self.log_odds[y, x] < 0.0) & (around.max(axis=(1, 2), initial=-1.0) <= 0.0)
        return float(in_free.sum()) / max(len(points), 1)

    def share_against(self, sensor: Array, points: Array) -> float:
        """Return the share of beams that cannot be if this is where they were sent from.

        Args:
            sensor: (2,) where the scanner is.
            points: (N, 2) where beams came back from: in the open, or from behind a wall.
        """
        some = points[:: max(1, len(points) // AGAINST)]
        cells = 1.0 / self.resolution
        start, ends = (sensor - self.origin) * cells, (some - self.origin) * cells
        count = count_against(self.log_odds, start, ends, self.evidence.hit, BEHIND * cells)
        return count / max(len(some), 1)

    def centres(self, cells: NDArray[np.int64]) -> Array:
        """Return the middles (N, 2), metres, of (N, 2) cells, row and column."""
        return np.asarray(self.origin + (cells[:, ::-1] + 0.5) * self.resolution)

    def cropped(self) -> "OccupancyGrid":
        """Return the part of which something is known."""
        rows, columns = (np.flatnonzero(self.is_known.any(axis=a)) for a in (1, 0))
        if not len(rows):
            return OccupancyGrid(self.resolution, self.evidence)
        y, x = rows[0], columns[0]
        part = self.log_odds[y : rows[-1] + 1, x : columns[-1] + 1].copy()
        origin = self.origin + self.resolution * np.array([x, y])
        cropped = OccupancyGrid.of(part, origin, self.resolution, self.evidence)
        if self.hits is not None:
            cropped.hits = self.hits[y : rows[-1] + 1, x : columns[-1] + 1].copy()
        return cropped

    def finished(self) -> "OccupancyGrid":
        """Return the part of which something is known, in less memory, to be added to no more."""
        finished = self.cropped()
        if finished.hits is not None:
            mean = finished.hits / np.maximum(finished.hits[:, :, 2:], 1.0)
            finished.hits = np.round(255.0 * mean).astype(np.uint8)
        finished._marks = np.zeros((0, 0), np.int32)
        return finished

    def _hold(self, *points: Array) -> None:
        """Grow until points (N, 2) lie inside."""
        box = np.array([[np.inf, np.inf], [-np.inf, -np.inf]])
        if not all(widen_box(each, box) for each in points):
            raise ValueError("a point of a scan is not finite")
        cells = (box - self.origin) / self.resolution
        (left, down), (right, up) = cells.tolist()
        height, width = self.log_odds.shape
        if left >= 0 and down >= 0 and right < width and up < height:
            return
        (low, high), shape = np.floor(cells).astype(np.int64), np.array([width, height])
        if not shape.all():
            before, size = -low + MARGIN, high - low + 1 + 2 * MARGIN
        else:
            before = np.where(low < 0, -low + MARGIN, 0)
            size = before + np.where(high >= shape, high + 1 + MARGIN, shape)
        if int(size[0]) * int(size[1]) > MOST_CELLS:
            raise ValueError(f"a grid of {size[0]} x {size[1]} cells: a scan is far from others")
        self.log_odds = _moved(self.log_odds, before, size)
        self._marks = _moved(self._marks, before, size)
        if self.hits is not None:
            hits: NDArray[np.float32] = self.hits
            self.hits = _moved(hits, before, size)
        self.origin = self.origin - self.resolution * before


def is_wall(grid: OccupancyGrid) -> NDArray[np.bool_]:
    """Return (H, W) cells that are rather occupied than free."""
    return np.asarray(grid.log_odds > 0.0)


def beside(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return (H, W) which cells are marked (H, W), or touch one that is."""
    near = cells.copy()
    near[1:] |= cells[:-1]
    near[:-1] |= cells[1:]
    wide = near.copy()
    wide[:, 1:] |= near[:, :-1]
    wide[:, :-1] |= near[:, 1:]
    return wide


def _moved(cells: NDArray[C], before: NDArray[np.int64], size: NDArray[np.int64]) -> NDArray[C]:
    """Return cells with room around them."""
    larger = np.zeros((size[1], size[0], *cells.shape[2:]), cells.dtype)
    height, width = cells.shape[:2]
    if cells.size:
        larger[before[1] : before[1] + height, before[0] : before[0] + width] = cells
    return larger


@kernel
def count_against(log_odds: Cells, start: Array, ends: Array, hit: float, behind: float) -> int:
    """Points that are in the open, or on the way to which, further before than `behind`, is a cell
    that more than one hit speaks for."""
    height, width = log_odds.shape
    count = 0
    for i in range(len(ends)):
        d_x, d_y = ends[i, 0] - start[0], ends[i, 1] - start[1]
        length = np.hypot(d_x, d_y)
        x, y = int(np.floor(ends[i, 0])), int(np.floor(ends[i, 1]))
        is_against = False
        if x > 0 and y > 0 and x < width - 1 and y < height - 1:
            is_against = log_odds[y, x] < 0.0
            for n in range(9):
                is_against = is_against and log_odds[y - 1 + n // 3, x - 1 + n % 3] <= 0.0
        for step in range(1, int(length - behind) + 1):
            if is_against:
                break
            x = int(np.floor(start[0] + step / length * d_x))
            y = int(np.floor(start[1] + step / length * d_y))
            if x >= 0 and y >= 0 and x < width and y < height:
                is_against = log_odds[y, x] > hit
        count += is_against
    return count


@kernel
def widen_box(points: Array, box: Array) -> bool:
    """box ← the least and the greatest x and y of it and points; False if one is not finite."""
    for i in range(len(points)):
        for k in range(2):
            if not np.isfinite(points[i, k]):
                return False
            box[0, k] = min(box[0, k], points[i, k])
            box[1, k] = max(box[1, k], points[i, k])
    return True


@kernel
def sum_hits(hits: Hits, ends: Array) -> None:
    """Σ (x, y, 1) of points in their cells."""
    for i in range(len(ends)):
        x, y = int(np.floor(ends[i, 0])), int(np.floor(ends[i, 1]))
        hits[y, x, 0] += ends[i, 0] - x
        hits[y, x, 1] += ends[i, 1] - y
        hits[y, x, 2] += 1.0


@kernel
def hit_cells(
    log_odds: Cells, marks: Marks, mark: int, ends: Array, hit: float, limit: float
) -> None:
    """l ← min(l + hit, limit) in the cells of points, once each."""
    for i in range(len(ends)):
        x, y = int(np.floor(ends[i, 0])), int(np.floor(ends[i, 1]))
        if marks[y, x] != mark:
            marks[y, x] = mark
            log_odds[y, x] = min(log_odds[y, x] + hit, limit) or TINY


@kernel
def pass_cells(
    log_odds: Cells,
    marks: Marks,
    mark: int,
    starts: Array,
    ends: Array,
    miss: float,
    limit: float,
) -> None:
    """l ← max(l - miss, -limit) in the cells on the way to points, once each, without the last.

    A ray enters the next column at t = (border - x) / dx and the next row likewise; the smaller
    comes first, and after it the next border is 1 / |d| further. Which it is cannot be foretold, so
    there is no branch on it.
    """
    width = log_odds.shape[1]
    cells, marked = log_odds.reshape(-1), marks.reshape(-1)
    for i in range(len(ends)):
        x, y = int(np.floor(starts[i, 0])), int(np.floor(starts[i, 1]))
        dx, dy = ends[i, 0] - starts[i, 0], ends[i, 1] - starts[i, 1]
        columns, rows = int(np.floor(ends[i, 0])) - x, int(np.floor(ends[i, 1])) - y
        right, up = 1 if columns > 0 else -1, width if rows > 0 else -width
        column = 1.0 / abs(dx) if columns != 0 else 0.0
        row = 1.0 / abs(dy) if rows != 0 else 0.0
        t_x = ((x + 1 - starts[i, 0]) if columns > 0 else (starts[i, 0] - x)) * column
        t_y = ((y + 1 - starts[i, 1]) if rows > 0 else (starts[i, 1] - y)) * row
        columns, rows = abs(columns), abs(rows)
        cell = y * width + x
        for _ in range(columns + rows):
            if marked[cell] != mark:
                marked[cell] = mark
                cells[cell] = max(cells[cell] - miss, -limit) or -TINY
            # Rounding must not lead past the last column or row.
            is_x = (t_x < t_y and columns > 0) or rows == 0
            t_x += column if is_x else 0.0
            t_y += 0.0 if is_x else row
            cell += right if is_x else up
            columns -= 1 if is_x else 0
            rows -= 0 if is_x else 1


def warm_up() -> None:
    """Compile the kernels of this module."""
    grid = OccupancyGrid(0.1, keeps_hits=True)
    grid.insert(np.zeros(2), np.array([[0.35, 0.1]]))
    grid.share_against(np.zeros(2), np.array([[0.35, 0.1]]))
