"""Recordings of a 3D LiDAR: one sweep per frame, read when it is asked for.

What sources of sweeps share, whatever they read: stamps known on opening, a way to read sweep i,
and what becomes of one that cannot be read. That costs its frame alone; a sweep without points is a
frame with none, since the LiDAR was there and saw nothing.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig
from odomap.sensors.sweep import Sweep
from odomap.sources.source import Skipped, UnusableFrame
from odomap.sources.survey import SweepSurvey

__all__ = ["SweepLog", "usual_rate"]


@dataclass(eq=False, repr=False)
class SweepLog:
    """Sweeps of one 3D LiDAR; a `RandomAccess`.

    Attributes:
        name: short name.
        rig: the LiDAR.
        stamps_ns: (N,) int64, strictly increasing.
        read: reads one sweep by its number, or raises UnusableFrame.
        survey: what sweeps are like.
        truth: T_world_body, if known.
        left_out: what had to be left out on opening.
        notes: what was found odd and mended, for the user.
        details: facts for people.
        skipped: `left_out`, and what iterating so far could not read.
    """

    name: str
    rig: Rig
    stamps_ns: NDArray[np.int64]
    read: Callable[[int], Sweep]
    survey: SweepSurvey
    truth: Trajectory | None = None
    left_out: list[Skipped] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    details: dict[str, Any] = field(default_factory=dict)
    skipped: list[Skipped] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.skipped = list(self.left_out)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name}: {len(self)} sweeps)"

    def __iter__(self) -> Iterator[Frame]:
        """Yield the sweeps that can be read.

        Raises:
            InputError: after the last one, if none could be.
        """
        self.skipped = list(self.left_out)
        count = 0
        for index in range(len(self)):
            try:
                frame = self.frame(index)
            except UnusableFrame as error:
                self.skipped.append(error.skipped)
                continue
            count += 1
            yield frame
        if count == 0:
            first = self.skipped[-1]
            raise InputError(f"{first.file}: {first.reason}; no sweep of {self.name} can be read")

    def frame(self, index: int) -> Frame:
        """Read one sweep.

        Raises:
            UnusableFrame: it cannot be read.
            IndexError: there is no such frame.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        return Frame(index, int(self.stamps_ns[index]), cloud=self.read(index))


def usual_rate(stamps_ns: NDArray[np.int64], otherwise: float = 10.0) -> float:
    """Return the rate of sweeps by their median step; LiDARs turn evenly, and some are lost."""
    steps = np.diff(stamps_ns)
    steps = steps[steps > 0]
    return float(1e9 / np.median(steps)) if len(steps) else otherwise
