"""Sources: where frames come from. Every reader, simulator and wrapper has this face."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from odomap.geometry.trajectory import Trajectory
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig

__all__ = ["Skipped", "Source"]


@dataclass(frozen=True)
class Skipped:
    """A measurement that could not be used, and why."""

    stamp_ns: int
    file: str
    reason: str


@runtime_checkable
class Source(Protocol):
    """A stream of frames in order of time.

    Attributes:
        name: short name of the recording, for titles.
        rig: what is mounted where.
        truth: ground truth of T_world_body, or None.
        skipped: what the iteration so far had to leave out; a fresh iteration starts it anew.
    """

    name: str
    rig: Rig
    truth: Trajectory | None
    skipped: list[Skipped]

    def __len__(self) -> int:
        """Return how many frames there are to expect."""
        ...

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames; starts from the beginning each time."""
        ...
