"""Wrappers: sources around sources, for disturbances that are sources themselves.

A wrapper changes frames (`Changed`), leaves some out (`Dropped`), repeats what they show
(`Frozen`) or plays them in another order, at other times (`Replayed`). Each has the whole face of
a source: it streams, its stamps increase strictly, it shows what the source inside skips, and it
is a `RandomAccess` if that is one. Nothing is kept but the frame at hand.

Reference: E. Gamma et al., "Design patterns", Addison-Wesley 1994 (decorator).
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.frame import Frame, ImuSamples
from odomap.sensors.sweep import Sweep
from odomap.sources.source import RandomAccess, Skipped, Source, UnusableFrame

__all__ = ["Changed", "Dropped", "Frozen", "Replayed", "Wrapper", "seekable"]


def seekable(source: Source) -> RandomAccess:
    """Return the source as one that can be read in any order."""
    if not isinstance(source, RandomAccess):
        raise InputError(f"{source.name}: is a stream: it can only be played forwards")
    return source


class Wrapper:
    """What all wrappers share: the face of the source inside."""

    stamps_ns: NDArray[np.int64]
    """(N,) stamps of the frames; only there if they can be read in any order."""

    def __init__(self, source: Source, how: str) -> None:
        self.source = source
        self.name = f"{source.name} ({how})"
        self.rig = source.rig
        self.truth = source.truth
        self.skipped: list[Skipped] = []
        self.notes: list[str] = list(getattr(source, "notes", []))
        if isinstance(source, RandomAccess):
            self.stamps_ns = source.stamps_ns

    def __len__(self) -> int:
        return len(self.source)

    @property
    def ids(self) -> NDArray[np.int_]:
        """(N,) ids of the frames."""
        inner = self.source
        return inner.ids if isinstance(inner, Wrapper) else np.arange(len(inner))

    @property
    def _inside(self) -> RandomAccess:
        return seekable(self.source)

    def _frames(self) -> Iterator[Frame]:
        """Iterate the source inside, and show what it skips."""
        for frame in self.source:
            self.skipped = self.source.skipped
            yield frame
        self.skipped = self.source.skipped


class Changed(Wrapper):
    """Frames changed one by one."""

    def __init__(self, source: Source, how: str, change: Callable[[Frame], Frame]) -> None:
        super().__init__(source, how)
        self._change = change

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames, changed."""
        return map(self._change, self._frames())

    def frame(self, index: int) -> Frame:
        """Return one frame, changed."""
        return self._change(self._inside.frame(index))


class Frozen(Wrapper):
    """Images that repeat."""

    def __init__(self, source: Source, chosen: frozenset[int]) -> None:
        super().__init__(source, "frozen")
        self._chosen = chosen

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames; the chosen ones with the images of the last that is not chosen."""
        shown: Frame | None = None
        for frame in self._frames():
            if shown is None or frame.id not in self._chosen:
                shown = frame
            yield replace(frame, images=shown.images, depth=shown.depth)

    def frame(self, index: int) -> Frame:
        """Return one frame; if chosen, with the images of the last that is not."""
        frame = self._inside.frame(index)
        shown = frame
        while shown.id in self._chosen and index > 0:
            index -= 1
            shown = self._inside.frame(index)
        return replace(frame, images=shown.images, depth=shown.depth)


class Dropped(Wrapper):
    """Frames left out."""

    def __init__(self, source: Source, chosen: frozenset[int]) -> None:
        super().__init__(source, "dropped")
        self._chosen = chosen
        self._kept = np.flatnonzero([i not in chosen for i in super().ids.tolist()])
        if isinstance(source, RandomAccess):
            self.stamps_ns = source.stamps_ns[self._kept]

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def ids(self) -> NDArray[np.int_]:
        """(N,) ids of the frames that are left."""
        return super().ids[self._kept]

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames that are left."""
        waiting: list[ImuSamples] = []
        for frame in self._frames():
            if frame.imu is not None:
                waiting.append(frame.imu)
            if frame.id not in self._chosen:
                yield replace(frame, imu=ImuSamples.joined(waiting)) if waiting else frame
                waiting = []

    def frame(self, index: int) -> Frame:
        """Return one of the frames that are left, with the samples of those dropped before it.

        Raises:
            UnusableFrame: it, or one dropped before it, cannot be read.
        """
        first = int(self._kept[index - 1]) + 1 if index > 0 else 0
        last = int(self._kept[index])
        frames = [self._inside.frame(place) for place in range(first, last + 1)]
        waiting = [frame.imu for frame in frames if frame.imu is not None]
        return replace(frames[-1], imu=ImuSamples.joined(waiting)) if waiting else frames[-1]


class Replayed(Wrapper):
    """Frames in another order, at other times."""

    def __init__(
        self,
        source: RandomAccess,
        how: str,
        order: NDArray[np.int_],
        stamps_ns: NDArray[np.int64],
        truth: Trajectory | None,
        is_backwards: NDArray[np.bool_],
    ) -> None:
        super().__init__(source, how)
        self.rig = source.rig.without_imu()
        self.truth = truth
        self.stamps_ns = stamps_ns
        self._order, self._is_backwards = order, is_backwards

    @property
    def ids(self) -> NDArray[np.int_]:
        """(N,) ids of the frames."""
        return np.arange(len(self))

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames in their new order."""
        self.skipped = skipped = []
        for place in range(len(self)):
            try:
                yield self.frame(place)
            except UnusableFrame as error:
                skipped.append(error.skipped)

    def frame(self, index: int) -> Frame:
        """Return the frame that is played at a place."""
        stamp_ns = int(self.stamps_ns[index])
        try:
            frame = self._inside.frame(int(self._order[index]))
        except UnusableFrame as error:
            raise UnusableFrame(replace(error.skipped, stamp_ns=stamp_ns)) from error
        cloud = frame.cloud
        if cloud is not None and self._is_backwards[index]:
            cloud = _mirrored(cloud)
        return replace(frame, id=index, stamp_ns=stamp_ns, imu=None, cloud=cloud)


def _mirrored(sweep: Sweep) -> Sweep:
    """Return a sweep as it comes backwards in time: what came t after the stamp comes t before."""
    back = sweep.only(np.arange(len(sweep))[::-1])
    return back if back.times is None else replace(back, times=-back.times)
