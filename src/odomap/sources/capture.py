"""Captures: OpenCV's decoders with their silence explained, their chatter silenced.

A video is two things: packets, each with its time in the container's own clock, and the images
they decode to. Reading the packets alone costs no more than reading the file, and gives the times
of all frames before one is decoded; sorted, since codecs store frames out of order. Then frame i
is found by its time: seek to a little before, decode until the time is that of i. Decoders land
where they like, and the time of what comes out tells, so a wrong image is never returned.

Reference: D. L. Mills, "Internet time synchronization: the network time protocol", IEEE Trans.
Communications 39(10), 1991 (on one clock as seen through another).
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.sources.container import Container, inspect

__all__ = [
    "SAME_US",
    "Cursor",
    "decoded_times",
    "fourcc",
    "open_file",
    "packet_times",
    "quiet",
    "stamp_us",
    "to_grey",
    "why_not",
]

FORWARD = 60
"""So many frames ahead are decoded rather than sought."""
TRIES = 25
"""So many broken packets in a row end a video."""
SAME_US = 2
"""Times of packets and images differ by their rounding."""


@contextmanager
def quiet() -> Iterator[None]:
    """Keep OpenCV and FFmpeg from printing what the caller says better."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    # OpenCV 5 has moved them into a module of their own.
    log: Any = getattr(cv2.utils, "logging", cv2)
    level = log.getLogLevel()
    log.setLogLevel(0)
    try:
        yield
    finally:
        log.setLogLevel(level)


def open_file(path: Path, *options: int) -> cv2.VideoCapture:
    """Open a video file.

    Args:
        path: the file.
        options: pairs of a capture property and its value.

    Returns:
        A capture; ask `isOpened` whether it could be.
    """
    with quiet():
        return cv2.VideoCapture(str(path), _backend(), list(options))


def _backend() -> int:
    has_ffmpeg = cv2.CAP_FFMPEG in cv2.videoio_registry.getStreamBackends()
    return cv2.CAP_FFMPEG if has_ffmpeg else cv2.CAP_ANY


def why_not(path: Path) -> InputError:
    """Return the error that says why a file cannot be decoded, and what to do."""
    container = inspect(path)
    if not container.kind:
        return InputError(
            f"{path}: is not a video that can be read (no MP4, AVI or Matroska): if it plays "
            f"elsewhere, convert it: {convert(path)}"
        )
    if not container.has_contents:
        return InputError(
            f"{path}: has no table of contents ('moov'): the recording was interrupted, or the "
            "copy is incomplete: copy it again, or repair it from a whole video of the same camera"
        )
    if container.is_cut:
        return InputError(f"{path}: the file is cut before its first frame: copy it again")
    if not container.codec:
        return InputError(f"{path}: the file holds no video: was the recording stopped at once?")
    return InputError(
        f"{path}: codec '{container.codec}' cannot be decoded here: convert it: {convert(path)}"
    )


def convert(path: Path) -> str:
    """Return the command that makes a readable video of an unreadable one, times kept."""
    target = path.with_name(f"{path.stem}_h264.mp4")
    return f"ffmpeg -i {path} -fps_mode passthrough -c:v libx264 -pix_fmt yuv420p {target}"


def packet_times(path: Path) -> NDArray[np.int64]:
    """Return the times of all packets in the order of the file, microseconds, without decoding."""
    return _times(open_file(path, cv2.CAP_PROP_FORMAT, -1))


def decoded_times(path: Path) -> NDArray[np.int64]:
    """Return the times of all frames that can be decoded, microseconds."""
    return _times(open_file(path))


def _times(capture: cv2.VideoCapture) -> NDArray[np.int64]:
    times = []
    while capture.grab():
        times.append(stamp_us(capture))
    capture.release()
    return np.array(times, np.int64)


def stamp_us(capture: cv2.VideoCapture) -> int:
    """Return the container's time of what was grabbed last, microseconds."""
    return round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e3)


def fourcc(capture: cv2.VideoCapture, container: Container) -> str:
    """Return the name of the codec, as the file has it or as the decoder calls it."""
    code = int(capture.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF
    decoder = code.to_bytes(4, "little").decode("latin-1").strip("\0 ")
    return container.codec or decoder


def to_grey(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Return a decoded image as (H, W) uint8."""
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return np.ascontiguousarray(image, np.uint8)


class Cursor:
    """A place in a video file, moved from frame to frame or to one of them.

    Args:
        path: the file.
        times_us: (N,) times of its frames, increasing; None where it has none, then frames are
            counted from the beginning.
        is_turned: whether images are turned as the file says.
    """

    def __init__(self, path: Path, times_us: NDArray[np.int64] | None, is_turned: bool) -> None:
        self._path = path
        self._times = times_us
        self._is_turned = is_turned
        self._at = -1
        self._capture = self._open()

    def step(self) -> int | None:
        """Go to the next frame.

        Returns:
            Which it is; -1 if that cannot be told, None at the end.
        """
        # A grab fails at a broken packet as at the end; behind a broken one there are others.
        failures = next((n for n in range(TRIES) if self._capture.grab()), None)
        if failures is None:
            return None
        if self._times is None:
            self._at += 1 + failures
            return self._at
        time = stamp_us(self._capture)
        place = int(np.searchsorted(self._times, time - SAME_US))
        if place == len(self._times) or self._times[place] > time + SAME_US:
            return -1
        self._at = place
        return place

    def image(self) -> NDArray[np.uint8] | None:
        """Return the image here, (H, W, 3) blue, green, red; None if it cannot be decoded."""
        done, image = self._capture.retrieve()
        return np.asarray(image, np.uint8) if done else None

    def read(self, index: int) -> NDArray[np.uint8] | None:
        """Return the image of a frame; None if it cannot be decoded."""
        if not self._at <= index <= self._at + FORWARD:
            self._seek(index)
        while self._at < index and self.step() is not None:
            pass
        return self.image() if self._at == index else None

    def close(self) -> None:
        """Let go of the file."""
        self._capture.release()

    def _seek(self, index: int) -> None:
        """Go to some frame before another, ever nearer to the beginning until that is so."""
        rate = self._capture.get(cv2.CAP_PROP_FPS)
        back = 2
        while self._times is not None:
            place = int(self._times[index] * 1e-6 * rate) - back
            if place <= 0 or not self._capture.set(cv2.CAP_PROP_POS_FRAMES, place):
                break
            self._at = -1
            if self.step() is None:
                break
            if 0 <= self._at <= index:
                return
            back *= 4
        if self._at > index or self._times is not None:
            self._capture, self._at = self._open(), -1

    def _open(self) -> cv2.VideoCapture:
        capture = open_file(self._path)
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, int(self._is_turned))
        return capture
