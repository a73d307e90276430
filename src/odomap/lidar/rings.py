"""Rings: which beam of a LiDAR a point is of, where nobody says.

A turning LiDAR has beams above each other, and each draws a ring. Many files leave the beam out but
keep an order: one ring after the other, the highest first, each once around from straight ahead. A
ring ends where the azimuth falls back by more than half a turn,

    φ(n) < φ(n - 1) - π,      φ in [0, 2π) from where rings begin,

and rows that jitter over that line backwards end none. That these are rings is seen from their mean
elevations: they fall from one to the next. A sweep with fewer rings (of the highest, only sky) has
them numbered by the nearest of the elevations that whole sweeps have. (The 64 of an HDL-64E are
0.3° to 0.5° apart; a ring's own mean varies by 0.1°, as its beam does not leave from the centre.)

Where rows are in no such order but elevations fall into bands with nothing between, as those of a
VLP-16 do, 2° apart, the band is the beam.

Cost: 5 ns a point, beside its azimuth.

Reference: J. Behley et al., "SemanticKITTI", ICCV 2019 (on the rows of KITTI's sweeps).
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["Bands", "Rings", "azimuths", "bands_of", "rings_of"]

Array = NDArray[np.float64]

FEWEST, MOST = 4, 160
"""Rings that a LiDAR may have."""
SHUFFLED = 0.03
"""Share of the rings that may be higher than the one before, as noise makes them."""
BINS = 4096
"""Elevations are looked at in so many steps from lowest to highest."""
FEWEST_POINTS = 400
"""Fewer say nothing of bands."""


def azimuths(points: Array) -> Array:
    """Return (N,) angles to the left of straight ahead, -π to π; NaN and zero rows give any."""
    return np.arctan2(points[:, 1], points[:, 0])


@dataclass(frozen=True, eq=False)
class Rings:
    """Rings one after the other, as a recording's whole sweeps have them.

    Attributes:
        begin: azimuth at which rings begin, radians.
        turn: 1.0 if the azimuth grows along a ring, -1.0 if it falls.
        elevations: (B,) mean elevation of each ring, the lowest first, radians.
        is_top_first: whether the first ring in a sweep is the highest.
    """

    begin: float
    turn: float
    elevations: Array
    is_top_first: bool

    def __len__(self) -> int:
        return len(self.elevations)

    def beams(self, points: Array, azimuth: Array) -> NDArray[np.int16]:
        """Return (N,) the beam of each row, 0 for the lowest.

        Args:
            points: (N, 3) in their order.
            azimuth: (N,) of the points.
        """
        ring = np.empty(len(points), np.int64)
        count = _split(points, azimuth, self.begin, self.turn, ring)
        if count == len(self):
            number = np.arange(count)
            number = number[::-1] if self.is_top_first else number
        else:
            mean = _means(points, ring, count)
            number = np.abs(np.nan_to_num(mean)[:, None] - self.elevations).argmin(axis=1)
        return number.astype(np.int16)[ring] if count else ring.astype(np.int16)


@dataclass(frozen=True, eq=False)
class Bands:
    """Elevations that points of a recording have, with nothing between.

    Attributes:
        between: (B - 1,) elevations that part one beam from the next, radians.
    """

    between: Array

    def __len__(self) -> int:
        return len(self.between) + 1

    def beams(self, points: Array, azimuth: Array) -> NDArray[np.int16]:
        """Return (N,) the beam of each row, 0 for the lowest."""
        elevation = np.nan_to_num(_elevations(points))
        return np.searchsorted(self.between, elevation).astype(np.int16)


def rings_of(sweeps: Sequence[Array]) -> Rings | None:
    """Find rings one after the other in the sweeps of a recording.

    Args:
        sweeps: (N, 3) each, some of the recording's.

    Returns:
        What most of them have, or None if rows are in no such order.
    """
    found: list[tuple[float, float, bool, Array]] = []
    cleaned = [rows[np.square(rows).sum(axis=1) > 0] for rows in sweeps]
    cleaned = [points for points in cleaned if len(points)]
    for points in cleaned:
        azimuth = azimuths(points)
        step = (np.diff(azimuth) + np.pi) % (2 * np.pi) - np.pi
        turn = -1.0 if np.median(np.append(step, 0.0)) < 0 else 1.0
        for begin in (0.0, np.pi):
            ring = np.empty(len(points), np.int64)
            count = _split(points, azimuth, begin, turn, ring)
            mean = _means(points, ring, count)
            rises = int((np.diff(mean) > 0).sum())
            is_top_first = 2 * rises < count
            wrong = rises if is_top_first else count - 1 - rises
            if FEWEST <= count <= MOST and wrong <= SHUFFLED * count:
                found.append((begin, turn, is_top_first, mean))
                break
    if 2 * len(found) <= len(cleaned):
        return None
    kinds = Counter((*key, len(mean)) for *key, mean in found)
    usual, _ = kinds.most_common(1)[0]
    means = [mean for *key, mean in found if (*key, len(mean)) == usual]
    begin, turn, is_top_first = next(f[:3] for f in found if f[3] is means[0])
    return Rings(begin, turn, np.sort(np.median(means, axis=0)), is_top_first)


def bands_of(sweeps: Sequence[Array], beams: int = 0) -> Bands | None:
    """Find bands of elevation in the sweeps of a recording.

    Args:
        sweeps: (N, 3) each, some of the recording's.
        beams: how many there must be; 0 where that is not known.

    Returns:
        Where one beam parts from the next, or None if there are no bands.
    """
    elevation = np.concatenate([_elevations(points) for points in sweeps] or [np.zeros(0)])
    elevation = elevation[np.isfinite(elevation)]
    if len(elevation) < FEWEST_POINTS:
        return None
    low, high = float(elevation.min()), float(elevation.max())
    counts, edges = np.histogram(elevation, BINS, (low, high + 1e-9))
    # A band is a run of steps with points in them; single steps without any do not end it.
    used = np.convolve(counts, np.ones(3), "same") > 0
    starts = np.flatnonzero(used & ~np.r_[False, used[:-1]])
    ends = np.flatnonzero(used & ~np.r_[used[1:], False])
    if not FEWEST <= len(starts) <= MOST or (beams and len(starts) != beams):
        return None
    width, step = float((ends - starts).max() + 1), float(np.diff(starts).min())
    if width > 0.8 * step:
        return None
    return Bands(edges[(ends[:-1] + starts[1:] + 1) // 2])


def _elevations(points: Array) -> Array:
    """Return (N,) angles above the horizon; NaN where nothing returned."""
    flat = np.hypot(points[:, 0], points[:, 1])
    with np.errstate(invalid="ignore"):
        return np.where(flat > 0, np.arctan2(points[:, 2], flat), np.nan)


def _means(points: Array, ring: NDArray[np.int64], count: int) -> Array:
    """Return (count,) mean elevation of each ring, NaN of one without a point."""
    elevation = _elevations(points)
    valid = np.isfinite(elevation)
    number = np.bincount(ring[valid], minlength=count)
    total = np.bincount(ring[valid], elevation[valid], minlength=count)
    with np.errstate(invalid="ignore"):
        return np.asarray(total / number)


@kernel
def _split(
    points: Array, azimuth: Array, begin: float, turn: float, ring: NDArray[np.int64]
) -> int:
    """ring: number of the ring of each row; a new one where φ < previous φ - π. How many."""
    full = 2.0 * np.pi
    at, previous = -1, 0.0
    for n in range(len(points)):
        x, y = points[n, 0], points[n, 1]
        if not x * x + y * y > 0.0:  # NaN, or nothing returned
            ring[n] = max(at, 0)
            continue
        phi = (turn * (azimuth[n] - begin)) % full
        if at < 0:
            at = 0
            ring[:n] = 0
        elif phi < previous - np.pi:
            at += 1
        elif phi > previous + full - 0.1:  # backwards over the line
            phi = previous
        previous = phi
        ring[n] = at
    return at + 1


def warm_up() -> None:
    """Compile the kernels of this file."""
    _split(np.ones((1, 3)), np.ones(1), 0.0, 1.0, np.zeros(1, np.int64))
