"""Sightlines: what a sensor looked through cannot be where another one saw something.

Clouds of two places that look the same lie well on each other as far as they go; but a wall that
one of them has not is a wall that the other one looked through. So the directions around a sensor
are cut into pixels, each with the nearest range in it and in those around,

    ρ[v, u] = min |p|  of points p with  (elevation, azimuth) in pixel (v, u), or beside it,

and a point of the other cloud, moved there, at range r in pixel (v, u)

    agrees       if  |r - ρ| ≤ margin                 something was seen there
    contradicts  if  r < ρ - margin                   all that was seen there is beyond it
    is unknown   if  r > ρ + margin, or ρ is empty    hidden, or not looked at

The nearest of nine pixels, since points of a thinned cloud leave holes, through which a wall behind
shows. The margin grows with range: a pixel is as wide as that.

Cost: 40 ns a point.

Reference: F. Pomerleau, P. Krüsi, F. Colas, P. Furgale, R. Siegwart, "Long-term 3D map maintenance
in dynamic environments", ICRA 2014 (what is beyond a point tells that it is not there any more).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["Panorama", "Seen"]

Array = NDArray[np.float64]
Single = NDArray[np.float32]

PIXEL = np.radians(2.0)
"""Width of a pixel."""
MARGIN, SLOPE = 0.4, 0.08
"""Least margin, metres, and what is added of the range: twice a pixel, seen at a slant."""
SHARE_FAR = 60.0
"""Points beyond say nothing: they are few, and far apart; metres."""


@dataclass(frozen=True)
class Seen:
    """What a sensor says of points of another.

    Attributes:
        agree: share of the points where it saw something, too.
        against: share that it looked through.
    """

    agree: float
    against: float

    @property
    def doubt(self) -> float:
        """Share that contradicts of those that it says something of; 1 if it says nothing."""
        known = self.agree + self.against
        return self.against / known if known > 0.0 else 1.0


class Panorama:
    """How far a sensor saw in all directions.

    Args:
        points: (N, 3) seen from it.
    """

    def __init__(self, points: Array) -> None:
        rows, columns = round(np.pi / PIXEL), round(2.0 * np.pi / PIXEL)
        nearest = np.full((rows, columns), np.inf, np.float32)
        self._ranges = np.empty_like(nearest)
        _look(np.ascontiguousarray(points, np.float64), nearest, self._ranges)

    def judge(self, points: Array, T_sensor_points: Array) -> Seen:
        """Say how points (N, 3) of another sensor, moved by (4, 4), agree with what was seen."""
        counts = np.zeros(3)
        _judge(np.ascontiguousarray(points, np.float64), T_sensor_points, self._ranges, counts)
        total = max(counts.sum(), 1.0)
        return Seen(float(counts[0] / total), float(counts[1] / total))


@kernel
def _pixel(x: float, y: float, z: float, rows: int, columns: int) -> tuple[int, int]:
    """The pixel of a direction; rows from straight down to straight up."""
    up = np.arctan2(z, np.sqrt(x * x + y * y)) / np.pi + 0.5
    around = np.arctan2(y, x) / (2.0 * np.pi) + 0.5
    return min(int(up * rows), rows - 1), min(int(around * columns), columns - 1)


@kernel
def _look(points: Array, nearest: Single, ranges: Single) -> None:
    """ranges[v, u] = min of nearest over the pixel and the eight around, which is min |p| in it."""
    rows, columns = nearest.shape
    for n in range(points.shape[0]):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        v, u = _pixel(x, y, z, rows, columns)
        nearest[v, u] = min(nearest[v, u], np.float32(np.sqrt(x * x + y * y + z * z)))
    for v in range(rows):
        for u in range(columns):
            least = nearest[v, u]
            for a in range(max(v - 1, 0), min(v + 2, rows)):
                for b in range(u - 1, u + 2):
                    least = min(least, nearest[a, b % columns])
            ranges[v, u] = least


@kernel
def _judge(points: Array, T: Array, ranges: Single, counts: Array) -> None:
    """counts = points that agree, that contradict, of which nothing is known."""
    rows, columns = ranges.shape
    for n in range(points.shape[0]):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        r = np.sqrt(x * x + y * y + z * z)
        if r > SHARE_FAR:
            continue
        v, u = _pixel(x, y, z, rows, columns)
        off = ranges[v, u] - r
        margin = MARGIN + SLOPE * r
        if abs(off) <= margin:
            counts[0] += 1.0
        elif off > 0.0 and ranges[v, u] < np.inf:
            counts[1] += 1.0
        else:
            counts[2] += 1.0


def warm_up() -> None:
    """Compile the kernels of this file."""
    Panorama(np.ones((1, 3))).judge(np.ones((1, 3)), np.eye(4))
