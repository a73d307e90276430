"""Scan lines: the points of a sweep in the order in which a beam passed over them.

Curvature needs to know what lies beside a point on the surface. Along the line that one beam drew
that is what came before and after it: a ring of a turning LiDAR, sorted by azimuth; of solid-state
sensors what each of their beams saw, sorted by time, or in the order it came where there is none.

The step of a beam is the angle between one point and the next, as the median of the sweep.

Cost: 20 ns a point where rings are known and in order, 0.1 µs where they must be found or sorted.

Reference: J. Zhang, S. Singh, "LOAM: lidar odometry and mapping in real-time", RSS 2014, section V.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.lidar.rings import azimuths, bands_of, rings_of
from odomap.lidar.sweeps import SweepPoints

__all__ = ["ScanLines", "scan_lines", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

SAMPLED = 4096
"""Steps of which the median is taken."""
SPARSELY = 7
"""Every how many-th point is asked whether beams keep to their elevation."""
NARROW = 0.02
"""Root mean square that tan(elevation) may be off the mean of its beam."""


@dataclass(frozen=True, eq=False)
class ScanLines:
    """Points sorted by line.

    Attributes:
        points: (N, 3) in the frame of the LiDAR, line after line.
        order: (N,) which point of the sweep each of them is.
        start: (L + 1,) first point of each line, and the end. Of rings the lowest is first.
        turns: whether lines are rings of a LiDAR that turns.
        step: angle from one point to the next, radians.
    """

    points: Array
    order: Index
    start: Index
    turns: bool
    step: float

    def __len__(self) -> int:
        return len(self.start) - 1


def scan_lines(sweep: SweepPoints, T_body_lidar: Array) -> ScanLines:
    """Sort a sweep into lines.

    Args:
        sweep: what returned.
        T_body_lidar: (4, 4) where the LiDAR is.
    """
    points = np.empty((len(sweep), 3))
    _seen_from(sweep.points, T_body_lidar, points)
    beams, turns = sweep.beams, False
    if len(beams) and beams.min() < 0:
        rings = rings_of([points]) or bands_of([points])
        turns = rings is not None
        beams = np.zeros(len(beams), np.int16)
        if rings is not None:
            beams = rings.beams(points, azimuths(points))
    elif len(beams):
        turns = _are_rings(points, beams)
    count = int(beams.max(initial=-1)) + 1
    order, start = np.empty(len(beams), np.int64), np.zeros(count + 1, np.int64)
    _by_beam(beams, order, start)
    if turns and _share_astray(points, order, start) > 0.02:
        order = np.lexsort((azimuths(points), beams))
    elif not turns and sweep.has_times and np.any(np.diff(sweep.times[order]) < 0):
        order = np.lexsort((sweep.times, beams))
    ordered = points.take(order, axis=0)  # far faster than points[order]
    return ScanLines(ordered, order, start, turns, _median_step(ordered, start))


@kernel
def _seen_from(points: Array, T: Array, out: Array) -> None:
    """Out = Rᵀ (p - t)."""
    for n in range(points.shape[0]):
        x, y, z = points[n, 0] - T[0, 3], points[n, 1] - T[1, 3], points[n, 2] - T[2, 3]
        for c in range(3):
            out[n, c] = T[0, c] * x + T[1, c] * y + T[2, c] * z


@kernel
def _by_beam(beams: NDArray[np.int16], order: Index, start: Index) -> None:
    """Sort by counting: order of the points by beam, start of each; start holds zeros."""
    for n in range(beams.shape[0]):
        start[beams[n] + 1] += 1
    for b in range(1, start.shape[0]):
        start[b] += start[b - 1]
    at = start.copy()
    for n in range(beams.shape[0]):
        order[at[beams[n]]] = n
        at[beams[n]] += 1


def _are_rings(points: Array, beams: NDArray[np.int16]) -> bool:
    """Say whether each beam keeps to its elevation, as those of a LiDAR that turns do."""
    points, beams = points[::SPARSELY], beams[::SPARSELY]
    slopes = points[:, 2] / np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-9)
    numbers = np.maximum(np.bincount(beams), 1)
    means = np.bincount(beams, slopes) / numbers
    return bool(np.sqrt(np.mean((slopes - means[beams]) ** 2)) < NARROW)


@kernel
def _share_astray(points: Array, order: Index, start: Index) -> float:
    """Share of the steps that go the other way round than most do."""
    left, right = 0, 0
    for line in range(start.shape[0] - 1):
        for k in range(start[line], start[line + 1] - 1):
            a, b = order[k], order[k + 1]
            cross = points[a, 0] * points[b, 1] - points[a, 1] * points[b, 0]
            left += cross > 0.0
            right += cross < 0.0
    return min(left, right) / max(left + right, 1)


def _median_step(points: Array, start: Index) -> float:
    """Return the median angle between neighbours of a line, of a sample of them."""
    if len(points) < 2:
        return 0.0
    stride = max(len(points) // SAMPLED, 1)
    at = np.arange(0, len(points) - 1, stride)
    at = at[~np.isin(at + 1, start)]
    a, b = points[at], points[at + 1]
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (a, b))
    apart = np.linalg.norm(a - b, axis=1)
    apart = apart[apart > 0.0]
    return float(np.median(apart)) if len(apart) else 0.0


def warm_up() -> None:
    """Compile the kernels of this file."""
    points, beams = np.ones((2, 3)), np.zeros(2, np.int16)
    order, start = np.empty(2, np.int64), np.zeros(2, np.int64)
    _seen_from(points, np.eye(4), np.empty((2, 3)))
    _by_beam(beams, order, start)
    _share_astray(points, order, start)
