"""Stages: the faces of tracker, mapper, closer and adjuster, blind to threads.

A run is a chain of agents over one map. The tracker places every frame; the mapper improves the map
around each new keyframe; the closer looks for places seen before and corrects the path; where it
did, the adjuster brings the whole map into agreement:

    frame → Tracker.prepare, track → Estimate;  Tracker.make_keyframe → keyframe
    keyframe → Mapper.add → Job → Change;       keyframe → Closer.add → Job → Change
    keyframe → Adjuster.add → LongJob → LongChange

Tracking must not wait for what takes long, so the work of mapper and closer comes in three parts:
`add` reads the map (a snapshot: short), `Job.solve` works on what was read and touches the map no
more (long), `Change.write` writes the result (short). The tracker has parts as well: `prepare` does
not need the map, and nobody waits for `make_keyframe`. A worker decides which thread runs each part
and when; inline, one after the other; in parallel, `solve` beside later frames and `write` before a
frame that is fixed beforehand, so that the result is the same on every run.

Reference: G. Klein, D. Murray, Parallel tracking and mapping for small AR workspaces, 2007.
"""

from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from odomap.maps.estimate import Estimate
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sensors.frame import Frame

__all__ = [
    "Adjuster",
    "Change",
    "Closer",
    "Job",
    "LongChange",
    "LongJob",
    "Loop",
    "MapState",
    "Mapper",
    "Stages",
    "Stop",
    "Tracker",
    "has_closed",
]


@dataclass(frozen=True, eq=False)
class Loop:
    """A place that was, or was not, found to be seen before.

    Attributes:
        keyframe_id: the keyframe that came back.
        matched_id: the keyframe it came back to.
        T_matched_keyframe: (4, 4) measured pose of the keyframe in the matched one.
        num_inliers: matches that agree with it.
        is_accepted: whether the map was corrected with it.
        reason: why not; empty when it was.
        merges: whether it makes one of two pieces of the map (`maps/atlas`), the newer of which
            was moved as a whole.
        moved: by how much the correction moved the keyframe, world units.
        turned: by how much it turned it, radians.
        rescaled: units of the keyframe after it per unit before; 1 where scale does not drift.
        stamps_ns: times of the two keyframes, which may be gone when somebody asks; None where
            nobody noted them.
        doubts: loops closed before that contradict it and are not believed any more, by keyframe
            that came back and keyframe it came back to.
        is_tied: whether landmarks of the old map pointed at it, which tracking had found again;
            else it was how the place looks.
    """

    keyframe_id: int
    matched_id: int
    T_matched_keyframe: NDArray[np.float64]
    num_inliers: int
    is_accepted: bool
    reason: str = ""
    merges: bool = False
    moved: float = 0.0
    turned: float = 0.0
    rescaled: float = 1.0
    stamps_ns: tuple[int, int] | None = None
    doubts: tuple[tuple[int, int], ...] = ()
    is_tied: bool = False


@dataclass(frozen=True)
class MapState:
    """What observers are told when a map has changed.

    Attributes:
        version: of the map, grows with every change.
        epoch: of the map, grows with every solution written.
        num_keyframes: living keyframes.
        num_landmarks: landmarks.
    """

    version: int
    epoch: int
    num_keyframes: int
    num_landmarks: int


class Change(Protocol):
    """A finished piece of work, frozen, to be written into the map."""

    @property
    def loops(self) -> tuple[Loop, ...]:
        """Loop candidates that were decided on, accepted or not."""
        ...

    def write(self, map: Map) -> None:
        """Write it into the map as it is now; short."""
        ...


class Job(Protocol):
    """A piece of work on data already read from the map."""

    def solve(self) -> Change:
        """Do it, without touching the map; may take long and run in any thread."""
        ...


class Stop(Protocol):
    """Says that what is being done is not wanted any more, such as a `threading.Event`."""

    def is_set(self) -> bool:
        """Say so."""
        ...


class LongChange(Change, Protocol):
    """A change of the whole map, too large to be written between two frames."""

    def parts(self) -> tuple[Change, ...]:
        """Cut it into changes that are short, after each of which the map is whole.

        Each is written before another frame, and those that are left may never be.
        """
        ...


class LongJob(Protocol):
    """A piece of work on the whole map, which may be given up."""

    @property
    def size(self) -> int:
        """How much there is to do, in observations; known when it has been read."""
        ...

    def read(self) -> None:
        """Copy what is needed of the map, which others may change meanwhile; before `solve`."""
        ...

    def solve(self, stop: Stop | None = None) -> LongChange:
        """Do it, without touching the map; once it is stopped, soon return a change of no parts."""
        ...


P = TypeVar("P")


class Tracker(Protocol[P]):
    """Places frames, and makes keyframes of some."""

    def prepare(self, frame: Frame) -> P:
        """Make a frame ready without touching the map, which may be changing meanwhile."""
        ...

    def track(self, prepared: P) -> Estimate:
        """Place a frame in the map; the map gets no new keyframe by that, but the very first."""
        ...

    def make_keyframe(self) -> Keyframe | None:
        """Make the last frame a keyframe if it is to be one, and return it; else None."""
        ...


class Mapper(Protocol):
    """Improves the map around a new keyframe."""

    def add(self, keyframe: Keyframe) -> Job | None:
        """Read what is needed of the map; None if there is nothing to do."""
        ...


class Closer(Protocol):
    """Recognises places seen before, and corrects the path."""

    def add(self, keyframe: Keyframe) -> Job | None:
        """Read what is needed of the map; None if there is nothing to do."""
        ...

    def last(self) -> Job | None:
        """Read, at the end of a run, what the last keyframe left to do; None if nothing."""
        ...


class Adjuster(Protocol):
    """Adjusts the whole map."""

    def add(self, keyframe: Keyframe, has_closed: bool) -> LongJob | None:
        """Take notice of a keyframe that the closer is done with; None if nothing is to begin.

        Args:
            keyframe: the keyframe.
            has_closed: whether it closed a loop; a job that is out is given up then.
        """
        ...

    def end(self) -> LongJob | None:
        """Return what is to be done since the last loop, at the end of a run; None if nothing."""
        ...


@dataclass(frozen=True, eq=False)
class Stages:
    """The agents of a run and the map they share.

    Attributes:
        map: the only thing shared.
        tracker: places frames.
        mapper: improves the map; None where the tracker is all there is.
        closer: closes loops; None where nobody looks for them.
        adjuster: adjusts the whole map after that; None where nobody does.
    """

    map: Map
    tracker: Tracker[Any]
    mapper: Mapper | None = None
    closer: Closer | None = None
    adjuster: Adjuster | None = None


def has_closed(change: Change) -> bool:
    """Say whether the map was corrected by a loop."""
    return any(loop.is_accepted for loop in change.loops)
