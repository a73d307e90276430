"""Disturbances of streams: frames delivered twice, a right camera that dies.

A driver under load hands a buffer over again: the same image, under the same stamp or under a new
one that the camera never saw. The cameras of a pair are two devices on two cables: one may stop
while the other goes on, and what then stands in the second image depends on the driver.

Both keep the promises of a wrapper, but for a stamp given twice on purpose. Each inertial sample is
still given once, with the first frame or copy that is not before it.

Reference: E. Gamma et al., "Design patterns", Addison-Wesley 1994 (decorator).
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.sensors.frame import Frame, ImuSamples
from odomap.sources.source import RandomAccess, Source
from odomap.sources.wrappers import Wrapper

__all__ = ["Dead", "duplicate", "kill_right"]

Image = NDArray[np.uint8]
Dead = Literal["missing", "black", "frozen"]
"""What stands in the image of a camera that is dead."""
LONE_NS = 10_000_000
"""How long after a recording's only frame its copy comes."""


def duplicate(source: Source, frames: Iterable[int], *, same_stamp: bool = False) -> Source:
    """Give some frames twice: a driver that hands a buffer over again.

    Args:
        source: any source.
        frames: ids of the frames; the copy has the same id.
        same_stamp: whether the copy keeps the stamp, so that time stands still. Else it comes
            halfway to the next frame: the body goes on, the image does not.
    """
    return _Duplicated(source, frozenset(frames), same_stamp)


def kill_right(source: Source, from_frame: int, how: Dead = "missing") -> Source:
    """Let the right camera of a stereo pair die; the left one and all else go on.

    Args:
        source: a source with two cameras or more; the second is the right one.
        from_frame: id of the first frame without it.
        how: what stands in its place: nothing ("missing"), "black", or its last image ("frozen").

    Raises:
        InputError: there is no second camera, or no such way to die.
    """
    if how not in ("missing", "black", "frozen"):
        raise InputError(f"kill_right: how '{how}' is none of missing, black, frozen")
    if len(source.rig.cameras) < 2:
        raise InputError(f"{source.name}: kill_right needs a rig with two cameras")
    return _Died(source, from_frame, how)


class _Died(Wrapper):
    """A second camera that stops."""

    def __init__(self, source: Source, from_frame: int, how: Dead) -> None:
        super().__init__(source, f"right {how}")
        self._from_frame, self._how = from_frame, how

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames; from the chosen one on without a living right image."""
        last: Image | None = None
        for frame in self._frames():
            if frame.id < self._from_frame:
                last = frame.images[1]
            yield self._after(frame, last)

    def frame(self, index: int) -> Frame:
        """Return one frame."""
        frame = self._inside.frame(index)
        last: Image | None = None
        if self._how == "frozen" and frame.id >= self._from_frame:
            alive = np.flatnonzero(self.ids < self._from_frame)
            last = self._inside.frame(int(alive[-1])).images[1] if alive.size else None
        return self._after(frame, last)

    def _after(self, frame: Frame, last: Image | None) -> Frame:
        """Return a frame as it is after the death; `last` is the last image before it."""
        right = frame.images[1]
        if frame.id < self._from_frame or right is None:
            return frame
        dead = {"missing": None, "black": np.zeros_like(right), "frozen": last}[self._how]
        return replace(frame, images=(frame.images[0], dead, *frame.images[2:]))


class _Duplicated(Wrapper):
    """Frames that come twice."""

    def __init__(self, source: Source, chosen: frozenset[int], same_stamp: bool) -> None:
        super().__init__(source, "duplicated")
        self._chosen, self._same_stamp = chosen, same_stamp
        times = 1 + np.isin(super().ids, sorted(chosen))
        self._order = np.repeat(np.arange(len(times)), times)
        """(len,) which frame of the source inside is played."""
        if isinstance(source, RandomAccess):
            self.stamps_ns = self._stamps(source.stamps_ns)

    def __len__(self) -> int:
        return len(self._order)

    @property
    def ids(self) -> NDArray[np.int_]:
        """(N,) ids of the frames; a copy has that of its frame."""
        return super().ids[self._order]

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames, and the copies when what comes next is known."""
        before: Frame | None = None
        last: Frame | None = None
        for frame in self._frames():
            if last is not None and last.id in self._chosen:
                yield self._copy(last, before, frame)
                yield self._after_copy(frame, last)
            else:
                yield frame
            before, last = last, frame
        if last is not None and last.id in self._chosen:
            yield self._copy(last, before, None)

    def frame(self, index: int) -> Frame:
        """Return one frame or copy.

        Raises:
            UnusableFrame: it, or one beside a copy that shares samples with it, cannot be read.
        """
        order, inner = self._order, self._inside
        place = int(order[index])
        frame = inner.frame(place)
        if index > 0 and order[index - 1] == place:
            is_last = place + 1 == len(inner)
            before = inner.frame(place - 1) if is_last and place > 0 else None
            return self._copy(frame, before, None if is_last else inner.frame(place + 1))
        if place > 0 and np.count_nonzero(order == place - 1) > 1:
            return self._after_copy(frame, inner.frame(place - 1))
        return frame

    def _copy(self, frame: Frame, before: Frame | None, coming: Frame | None) -> Frame:
        """Return the second of two, with the samples that arrived meanwhile."""
        stamp_ns = self._stamp(
            frame.stamp_ns,
            None if before is None else before.stamp_ns,
            None if coming is None else coming.stamp_ns,
        )
        imu = None if frame.imu is None else ImuSamples.joined([])
        if coming is not None and coming.imu is not None:
            imu = coming.imu.between(frame.stamp_ns, stamp_ns)
        return replace(frame, stamp_ns=stamp_ns, imu=imu)

    def _after_copy(self, frame: Frame, before: Frame) -> Frame:
        """Return the frame after a copy, without the samples that came with that."""
        if frame.imu is None:
            return frame
        stamp_ns = self._stamp(before.stamp_ns, None, frame.stamp_ns)
        return replace(frame, imu=frame.imu.between(stamp_ns, frame.stamp_ns))

    def _stamp(self, stamp_ns: int, before_ns: int | None, coming_ns: int | None) -> int:
        """Return the stamp of a frame's copy, from those of the frames around."""
        if self._same_stamp:
            return stamp_ns
        if coming_ns is not None:
            return (stamp_ns + coming_ns) // 2
        return stamp_ns + (LONE_NS if before_ns is None else (stamp_ns - before_ns) // 2)

    def _stamps(self, inside: NDArray[np.int64]) -> NDArray[np.int64]:
        stamps = inside[self._order]
        known = [None, *inside.tolist(), None]
        for index in np.flatnonzero(np.diff(self._order, prepend=-1) == 0).tolist():
            place = int(self._order[index])
            stamps[index] = self._stamp(int(inside[place]), known[place], known[place + 2])
        return stamps
