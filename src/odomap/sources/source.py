"""Sources: where frames come from. Every reader, simulator and wrapper has this face.

A source is a stream: iterating it reads one frame after the other and keeps none, so memory does
not grow with the recording. A source that can also give frame i by itself is a `RandomAccess`;
playing backwards needs that.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig

__all__ = ["Coloured", "RandomAccess", "Skipped", "Source", "UnusableFrame"]


@dataclass(frozen=True)
class Skipped:
    """A measurement that could not be used, and why."""

    stamp_ns: int
    file: str
    reason: str


class UnusableFrame(InputError):
    """A single frame cannot be read; iteration notes it in `skipped` and goes on."""

    def __init__(self, skipped: Skipped) -> None:
        super().__init__(f"{skipped.file}: {skipped.reason}")
        self.skipped = skipped


@runtime_checkable
class Source(Protocol):
    """A stream of frames in order of time.

    Attributes:
        name: short name of the recording, for titles.
        rig: what is mounted where.
        truth: ground truth of T_world_body, or None.
        skipped: what the iteration so far had to leave out; a fresh iteration starts it anew.

    Sources made from files also have `notes: list[str]`: what was found odd on opening and how it
    was mended, one sentence each, for the user. Some have `details: dict[str, Any]`: facts such as
    the codec of a video, for `odomap info`.
    """

    name: str
    rig: Rig
    truth: Trajectory | None
    skipped: list[Skipped]

    def __len__(self) -> int:
        """Return how many frames there are to expect; 0 when unknown (a live camera)."""
        ...

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames; starts from the beginning each time."""
        ...


@runtime_checkable
class RandomAccess(Source, Protocol):
    """A source whose frames can be read in any order.

    Attributes:
        stamps_ns: (len,) int64, strictly increasing: the stamps of all frames, known unread. Logs
            of lasers are the exception: their clocks may jump back, and frames keep the order in
            which they were measured (no stamp comes twice; a note says how many go back).
    """

    stamps_ns: NDArray[np.int64]

    def frame(self, index: int) -> Frame:
        """Read one frame.

        Args:
            index: from 0 to len - 1.

        Returns:
            The frame; its inertial samples are those since the frame before it.

        Raises:
            UnusableFrame: it cannot be read.
        """
        ...


@runtime_checkable
class Coloured(Protocol):
    """A source that knows the colour behind its grey images."""

    def colour(self, index: int) -> NDArray[np.uint8]:
        """Read the colour image of a frame's first camera.

        Args:
            index: the frame's, from 0 to len - 1.

        Returns:
            (H, W, 3) uint8 red, green, blue: the pixels of the grey image.

        Raises:
            UnusableFrame: it cannot be read.
        """
        ...
