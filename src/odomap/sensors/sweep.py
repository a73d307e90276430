"""Sweeps: what a 3D LiDAR saw in one turn, as it said it.

A LiDAR measures while it moves. Each point of a sweep is given in the frame that the LiDAR had at
the moment of that point, and where the sensor says so that moment is kept beside it, so that the
motion can be taken out (`lidar/deskew`):

    p(stamp) = T_lidar(stamp)⁻¹ T_lidar(stamp + times[n]) points[n]

Rows are in the order in which they came, and may be NaN or zero where nothing returned: cleaning
them is for those who use them. Columns that a recording does not have are None.

Reference: J. Zhang, S. Singh, "LOAM: lidar odometry and mapping in real-time", RSS 2014, section V.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Sweep"]


@dataclass(frozen=True, eq=False, repr=False)
class Sweep:
    """Points of a 3D LiDAR in the order they came.

    Attributes:
        points: (N, 3) metres, in the LiDAR's frame at the moment of each; NaN or zero where nothing
            returned.
        times: (N,) seconds since the frame's stamp, or None where nobody says.
        intensities: (N,) float32 as the sensor says them, or None.
        beams: (N,) int16 which of the beams above each other, 0 for the lowest, or None.
    """

    points: NDArray[np.float64]
    times: NDArray[np.float64] | None = None
    intensities: NDArray[np.float32] | None = None
    beams: NDArray[np.int16] | None = None

    def __post_init__(self) -> None:
        n = len(self.points)
        if self.points.shape != (n, 3):
            raise ValueError(f"points of a sweep have shape {self.points.shape}, give (N, 3)")
        for name in ("times", "intensities", "beams"):
            column = getattr(self, name)
            if column is not None and column.shape != (n,):
                raise ValueError(f"{n} points need {name} of shape ({n},), got {column.shape}")

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        names = ("times", "intensities", "beams")
        known = [name for name in names if getattr(self, name) is not None]
        return f"Sweep({len(self)} points{', with ' if known else ''}{', '.join(known)})"

    def only(self, rows: NDArray[Any]) -> "Sweep":
        """Return some of the rows, by their numbers or by a mask."""
        return Sweep(
            self.points[rows],
            None if self.times is None else self.times[rows],
            None if self.intensities is None else self.intensities[rows],
            None if self.beams is None else self.beams[rows],
        )

    def arrays(self) -> Iterator[NDArray[Any]]:
        """Yield the arrays there are."""
        columns = (self.points, self.times, self.intensities, self.beams)
        yield from (column for column in columns if column is not None)
