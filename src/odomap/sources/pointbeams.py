"""Beams of points: which of the beams above each other measured each, and in what order they are.

Drivers count from the top (Ouster), from the bottom (Velodyne), from 1, or as lasers are wired
(HDL-64E). Beams are ranked by the mean elevation of their points,

    rank(b) = |{b' : mean elevation of b' < that of b}|,

where numbers in between that some sweeps do not show keep their place if order by number and by
elevation agree. Where the lines of a sensor cross, as those of a solid-state one do, they are not
above each other, and there are no beams. Without a column that counts them, each row of an
organised cloud is one, or each column; else the order of rows, or the bands in which points lie,
may say it (`lidar/rings`).

Reference: R. B. Rusu, S. Cousins, "3D is here: Point Cloud Library (PCL)", ICRA 2011.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.files.pointtable import PointTable
from odomap.lidar.rings import Bands, Rings, azimuths, bands_of, rings_of

__all__ = ["PointBeams", "beams_of"]

Array = NDArray[np.float64]

FEWEST, MOST = 4, 160
"""Beams that are told by rows of a cloud, and by numbers."""
MOST_STRANGE = 0.1
"""Share of the points whose number may be none: some drivers write 255 or 65535."""
CROSSING = 0.5
"""Lines are not above each other if the spread of one is so much of the distance between two."""
ROWS, COLUMNS = "the rows of the cloud", "the columns of the cloud"


@dataclass(frozen=True, eq=False)
class PointBeams:
    """What tells beams apart.

    Attributes:
        count: how many there are.
        how: how they are known, for people.
        name: of the column that numbers them, or `ROWS` or `COLUMNS` of an organised cloud.
        ranks: (R,) beam of each number, 0 for the lowest, -1 for none.
        order: or their order instead of a number.
    """

    count: int
    how: str
    name: str = ""
    ranks: NDArray[np.int16] | None = None
    order: Rings | Bands | None = None

    def of(self, table: PointTable, points: Array) -> NDArray[np.int16]:
        """Return (N,) the beam of each point, -1 where nobody says.

        Args:
            table: the points as recorded.
            points: (N, 3) of it.
        """
        if self.order is not None:
            return self.order.beams(points, azimuths(points))
        number = _numbers(table, self.name)
        ranks = self.ranks
        if number is None or ranks is None:
            return np.full(table.count, -1, np.int16)
        whole = np.nan_to_num(number.astype(np.float64), nan=-1.0)
        known = (whole >= 0) & (whole < len(ranks))
        rank = ranks[np.where(known, whole, 0.0).astype(np.int64)]
        return np.where(known, rank, -1).astype(np.int16)


def beams_of(
    tables: Sequence[PointTable], clouds: Sequence[Array], seen: Sequence[NDArray[np.bool_]],
    ring: str,
) -> PointBeams | None:  # fmt: skip
    """Find out which beam a point is of.

    Args:
        tables: some sweeps of a recording.
        clouds: (N, 3) their points.
        seen: (N,) which of them returned.
        ring: the column that numbers beams, or nothing.

    Returns:
        What tells them apart, or None if there are no beams above each other.
    """
    for name in (ring,) if ring else (ROWS, COLUMNS):
        numbers = [_numbers(table, name) for table in tables]
        if all(number is not None for number in numbers):
            there = [n[s] for n, s in zip(numbers, seen, strict=True) if n is not None]
            ranks = _ranks(there, [c[s] for c, s in zip(clouds, seen, strict=True)])
            if ranks is not None:
                how = f"from '{ring}'" if ring else f"from {name}"
                return PointBeams(int(ranks.max()) + 1, how, name, ranks)
    if ring:
        return None
    rings = rings_of(clouds)
    if rings is not None:
        return PointBeams(len(rings), "from the order of the rows", order=rings)
    bands = bands_of(clouds)
    if bands is not None:
        return PointBeams(len(bands), "from the elevation of the points", order=bands)
    return None


def _numbers(table: PointTable, name: str) -> NDArray[np.generic] | None:
    """Return the number of the beam of each point as recorded; None if there is none."""
    if name not in (ROWS, COLUMNS):
        return table.columns.get(name)
    width = table.count // max(table.height, 1)
    if table.height < 2 or not FEWEST <= (table.height if name == ROWS else width) <= MOST:
        return None
    row, column = np.divmod(np.arange(table.count), width)
    return row if name == ROWS else column


def _ranks(
    numbers: Sequence[NDArray[np.generic]], clouds: Sequence[Array]
) -> NDArray[np.int16] | None:
    """Return the beam of each number of a column; None if these are no beams above each other."""
    number = np.concatenate([n.astype(np.float64) for n in numbers])
    points = np.concatenate(clouds)
    known = np.isfinite(number) & (number >= 0) & (number < MOST)
    if not known.any() or known.mean() < 1.0 - MOST_STRANGE or (number[known] % 1).any():
        return None
    which, points = number[known].astype(np.int64), points[known]
    count = int(which.max()) + 1
    if count < 2:
        return None
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    shown = np.bincount(which, minlength=count)
    there = np.flatnonzero(shown)
    mean = np.bincount(which, elevation, count)[there] / shown[there]
    square = np.bincount(which, elevation**2, count)[there] / shown[there]
    spread = float(np.median(np.sqrt(np.maximum(square - mean**2, 0.0))))
    between = float(np.ptp(mean)) / max(len(there) - 1, 1)
    if spread > CROSSING * between:
        return None
    # Those that count from 1 have no 0; a lowest beam that saw nothing yet is another matter.
    first = 1 if not shown[0] and count % 8 == 1 else 0
    ranks = np.arange(count) - first
    if (np.diff(mean) < 0).all():
        ranks = count - 1 - np.arange(count)
    elif not (np.diff(mean) > 0).all():
        ranks[:] = -1
        ranks[there[np.argsort(mean, kind="stable")]] = np.arange(len(there))
    ranks[:first] = -1
    return ranks.astype(np.int16)
