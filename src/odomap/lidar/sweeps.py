"""Sweeps made ready: the points that returned, seen from the body.

A sensor says more than it saw: NaN or zero where nothing came back, its own housing, and echoes
from beyond where it can see well. What is left is turned into the frame of the body, so that motion
and mount need not be told apart any more,

    p_body = T_body_lidar p_lidar,      nearest ≤ |p_lidar| ≤ farthest,

each point at its own moment still; `deskew` brings them to one.

Cost: 10 ns a point.

Reference: I. Vizzo et al., "KISS-ICP: in defense of point-to-point ICP", RA-L 8(2), 2023.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.sensors.rig import LidarMount
from odomap.sensors.sweep import Sweep

__all__ = ["SweepPoints", "points_of"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SweepPoints:
    """What returned in a sweep.

    Attributes:
        points: (N, 3) in the frame of the body at the moment of each.
        times: (N,) seconds since the stamp; zero where they are not known.
        intensities: (N,) float32; zero where they are not known.
        beams: (N,) int16, 0 for the lowest; -1 where they are not known.
        rows: (N,) of the sweep, in its order.
        has_times: whether times are known.
        num_rows: of the sweep.
    """

    points: Array
    times: Array
    intensities: NDArray[np.float32]
    beams: NDArray[np.int16]
    rows: NDArray[np.int64]
    has_times: bool
    num_rows: int

    def __len__(self) -> int:
        return len(self.points)


def points_of(sweep: Sweep, mount: LidarMount, farthest: float = np.inf) -> SweepPoints:
    """Return the points that returned from within a LiDAR's range.

    Args:
        sweep: as it came.
        mount: where the LiDAR is, and how far it sees.
        farthest: points beyond are not used either, metres.
    """
    near, far = mount.range_m
    rows = np.empty(len(sweep), np.int64)
    moved = np.empty((len(sweep), 3))
    reach = min(far, farthest)
    count = _kept(sweep.points, near, reach, mount.T_body_lidar.matrix, rows, moved)
    rows, none = rows[:count], np.zeros(count)
    beams, intensities = sweep.beams, sweep.intensities
    return SweepPoints(
        moved[:count],
        none if sweep.times is None else sweep.times[rows],
        none.astype(np.float32) if intensities is None else intensities[rows],
        np.full(count, -1, np.int16) if beams is None else beams[rows],
        rows,
        sweep.times is not None,
        len(sweep),
    )


@kernel
def _kept(
    points: Array, near: float, far: float, T: Array, rows: NDArray[np.int64], moved: Array
) -> int:
    """rows: those with near ≤ |p| ≤ far and p ≠ 0; moved: T p. Returns how many."""
    count = 0
    least, most = max(near * near, 1e-12), far * far
    for n in range(points.shape[0]):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        square = x * x + y * y + z * z
        if least <= square <= most:  # not so of NaN
            rows[count] = n
            for r in range(3):
                moved[count, r] = T[r, 0] * x + T[r, 1] * y + T[r, 2] * z + T[r, 3]
            count += 1
    return count


def warm_up() -> None:
    """Compile the kernels of this file."""
    points_of(Sweep(np.ones((1, 3))), LidarMount("warm"))
