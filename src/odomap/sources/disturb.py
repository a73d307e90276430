"""Disturbances: wrap a source to see what a system does when sensors fail or places recur.

    blank, drop, freeze, blur     a covered lens, lost frames, a camera that hangs, fast motion
    reverse, there_and_back       the same recording played backwards, or forth and back

Each wrapper is a source like any other: it streams, its stamps increase strictly, and its truth is
that of the frames it gives, so wrappers nest and every metric works on them. Played there and
back, a recording passes every place twice, on different images (even frames forth, odd frames
back), with known truth: a loop, made from any sequence.

Time reversal maps an instant t to first + last - t. A pose stays what it is, so truth is re-timed.
Inertial samples do not survive it (rates change sign, gravity does not), nor the even spacing of
there-and-back, so these two sources have no IMU.

Reference: J. Engel, V. Usenko, D. Cremers, "A photometrically calibrated benchmark for monocular
visual odometry", arXiv:1607.02555, 2016 (sequences played forwards and backwards).
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.frame import Frame, ImuSamples
from odomap.sources.source import RandomAccess, Skipped, Source, UnusableFrame

__all__ = ["blank", "blur", "drop", "freeze", "reverse", "there_and_back"]


def blank(source: Source, frames: Iterable[int]) -> Source:
    """Blacken the images of some frames: a covered lens, or no light.

    Args:
        source: any source.
        frames: ids of the frames.
    """
    chosen = frozenset(frames)

    def change(frame: Frame) -> Frame:
        if frame.id not in chosen:
            return frame
        dark = tuple(None if image is None else np.zeros_like(image) for image in frame.images)
        depth = None if frame.depth is None else np.zeros_like(frame.depth)
        return replace(frame, images=dark, depth=depth)

    return _Changed(source, "blank", change)


def blur(
    source: Source, frames: Iterable[int], length_px: float = 15.0, angle_deg: float = 0.0
) -> Source:
    """Smear the images of some frames along a line: motion too fast for the exposure.

    Args:
        source: any source.
        frames: ids of the frames.
        length_px: how far a point moves during the exposure.
        angle_deg: direction in the image, 0 along x, 90 along y.
    """
    chosen = frozenset(frames)
    if not length_px >= 0:
        raise InputError(f"blur: length_px {length_px} must be 0 or more")
    line = _line(length_px, np.deg2rad(angle_deg))

    def change(frame: Frame) -> Frame:
        if frame.id not in chosen:
            return frame
        smeared = tuple(
            None if image is None else np.asarray(cv2.filter2D(image, -1, line), np.uint8)
            for image in frame.images
        )
        return replace(frame, images=smeared)

    return _Changed(source, "blur", change)


def _line(length: float, angle: float) -> NDArray[np.float64]:
    """Return a blur kernel: a line through the centre, spread over pixels bilinearly."""
    half = int(np.ceil(length / 2)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1))
    along = np.linspace(-length / 2, length / 2, max(2, int(8 * length)))
    x, y = half + along * np.cos(angle), half + along * np.sin(angle)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    for dx in (0, 1):
        for dy in (0, 1):
            weight = (1 - np.abs(x - left - dx)) * (1 - np.abs(y - top - dy))
            np.add.at(kernel, (top + dy, left + dx), weight)
    return np.asarray(kernel / kernel.sum())


def drop(source: Source, frames: Iterable[int]) -> Source:
    """Leave out some frames; their inertial samples go to the next frame that is there.

    Args:
        source: any source.
        frames: ids of the frames; the ids of the others stay, so that the gaps show.
    """
    return _Dropped(source, frozenset(frames))


def freeze(source: Source, frames: Iterable[int]) -> Source:
    """Repeat the last image in some frames, under their own stamps: a camera that hangs.

    Args:
        source: any source.
        frames: ids of the frames; the first frame of a source cannot hang.
    """
    return _Frozen(source, frozenset(frames))


def reverse(source: Source) -> Source:
    """Play a recording backwards.

    Args:
        source: a source whose frames can be read in any order.

    Returns:
        Frames from the last to the first, without IMU; an instant t becomes first + last - t, of
        the truth too.

    Raises:
        InputError: the source is a stream only.
    """
    seekable = _seekable(source)
    stamps = seekable.stamps_ns
    order = np.arange(len(stamps))[::-1]
    mirror = int(stamps[0]) + int(stamps[-1]) if len(stamps) else 0
    truth = source.truth
    if truth is not None:
        truth = Trajectory(
            mirror - truth.stamps_ns[::-1],
            truth.Ts_world_body[::-1],
            None if truth.covariances is None else truth.covariances[::-1],
        )
    return _Replayed(seekable, "reversed", order, mirror - stamps[::-1], truth)


def there_and_back(source: Source) -> Source:
    """Play the even frames forth and the odd ones back, evenly spaced.

    Args:
        source: a source whose frames can be read in any order.

    Returns:
        Frames without IMU, from the first stamp on, twice the median step of the recording apart;
        its truth has one pose for each of them that the truth of the recording covers.

    Raises:
        InputError: the source is a stream only, or has less than three frames.
    """
    seekable = _seekable(source)
    stamps = seekable.stamps_ns
    if len(stamps) < 3:
        raise InputError(f"{source.name}: there and back needs three frames or more")
    places = np.arange(len(stamps))
    order = np.concatenate([places[::2], places[1::2][::-1]])
    step = 2 * round(float(np.median(np.diff(stamps))))
    played = stamps[0] + places * step
    return _Replayed(
        seekable, "there and back", order, played, _retimed(source.truth, stamps[order], played)
    )


def _retimed(
    truth: Trajectory | None, recorded: NDArray[np.int64], played: NDArray[np.int64]
) -> Trajectory | None:
    """Return the true poses of frames recorded at one time and played at another."""
    if truth is None:
        return None
    covered = (recorded >= truth.stamps_ns[0]) & (recorded <= truth.stamps_ns[-1])
    if not covered.any():
        return None
    in_order = np.argsort(recorded[covered])
    poses = truth.interpolate(recorded[covered][in_order]).Ts_world_body
    back = np.empty_like(in_order)
    back[in_order] = np.arange(len(in_order))
    return Trajectory(played[covered], poses[back])


def _seekable(source: Source) -> RandomAccess:
    """Return the source as one that can be read in any order."""
    if not isinstance(source, RandomAccess):
        raise InputError(f"{source.name}: is a stream: it can only be played forwards")
    return source


class _Wrapper:
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
        return inner.ids if isinstance(inner, _Wrapper) else np.arange(len(inner))

    @property
    def _inside(self) -> RandomAccess:
        return _seekable(self.source)

    def _frames(self) -> Iterator[Frame]:
        """Iterate the source inside, and show what it skips."""
        for frame in self.source:
            self.skipped = self.source.skipped
            yield frame
        self.skipped = self.source.skipped


class _Changed(_Wrapper):
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


class _Frozen(_Wrapper):
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


class _Dropped(_Wrapper):
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


class _Replayed(_Wrapper):
    """Frames in another order, at other times."""

    def __init__(
        self,
        source: RandomAccess,
        how: str,
        order: NDArray[np.int_],
        stamps_ns: NDArray[np.int64],
        truth: Trajectory | None,
    ) -> None:
        super().__init__(source, how)
        self.rig = source.rig.without_imu()
        self.truth = truth
        self.stamps_ns = stamps_ns
        self._order = order

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
        return replace(frame, id=index, stamp_ns=stamp_ns, imu=None)
