"""Devices: what gives frames by the clock, a camera or a file that is played like one.

A driver keeps a few buffers. Frames that arrive while all are full are lost; a grab takes the
oldest buffered one at once, or waits for the next. A file is played just so: frame i arrives at

    due_i = start + t_i - t_0

by the clock, into as many buffers, so that what happens to a system that is slower than its camera
happens here, too.

Reference: Linux kernel documentation, "Video for Linux API", streaming I/O.
"""

import os
import time
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.sensors.rig import CameraMount
from odomap.sources.calibration import check_resolution, size_text
from odomap.sources.capture import quiet
from odomap.sources.footage import probe_video

__all__ = ["BUFFERS", "Device", "FileDevice", "VideoDevice"]

BUFFERS = 4
"""Frames a driver keeps, as Video4Linux does by default."""
RATE_HZ = 30.0
PLAUSIBLE_AGE_S = 5.0
"""A frame that seems older than that has another clock."""


class Device(Protocol):
    """What gives frames as they come.

    Attributes:
        label: what to call it in messages.
        rate_hz: how many frames a second it gives.
        details: facts for people.
    """

    label: str
    rate_hz: float
    details: dict[str, object]

    @property
    def has_ended(self) -> bool:
        """Whether it is known that no frame will come any more."""
        ...

    def grab(self) -> bool:
        """Take the oldest buffered frame, or wait for the next; False if none comes."""
        ...

    def age_s(self) -> float | None:
        """Return how long ago the frame taken last was exposed; None if that is not known."""
        ...

    def image(self) -> NDArray[np.uint8] | None:
        """Return the frame taken last, blue, green, red or grey; None if it is broken."""
        ...

    def close(self) -> None:
        """Let go of it."""
        ...


class VideoDevice:
    """A camera as OpenCV reads it.

    Args:
        place: its number, or the path of its device file.
        mount: its calibration; its size and rate are asked for unless others are.
        asked: width, height, fps to ask for.

    Raises:
        InputError: it is absent, may not be read, or gives no frames.
        CalibrationError: it gives images of another size than calibrated.
    """

    has_ended = False

    def __init__(self, place: int | str, mount: CameraMount, asked: dict[str, float]) -> None:
        self.label = f"camera {place}"
        width, height = mount.camera.resolution
        with quiet():
            self._capture = cv2.VideoCapture(place, cv2.CAP_ANY)
            if not self._capture.isOpened():
                raise InputError(f"{self.label} cannot be opened: {_why_absent(place)}")
            self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, asked.get("width", width))
            self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, asked.get("height", height))
            if rate := asked.get("fps", mount.rate_hz):
                self._capture.set(cv2.CAP_PROP_FPS, rate)
            self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
            image = self.image() if self.grab() else None
        if image is None:
            self.close()
            raise InputError(f"{self.label} opens but gives no frame: is another program using it?")
        self.rate_hz = self._capture.get(cv2.CAP_PROP_FPS) or RATE_HZ
        self._has_clock = self._capture.getBackendName() == "V4L2"
        size = (image.shape[1], image.shape[0])
        self.details: dict[str, object] = {
            "device": str(place),
            "backend": self._capture.getBackendName(),
            "image": f"{size_text(size)}, {self.rate_hz:g} Hz",
        }
        if size != mount.camera.resolution:
            self.close()
        mend = f"ask for that with 'camera:{place}?width={width}&height={height}' if the camera "
        mend += f"can, or calibrate it at {size_text(size)}"
        check_resolution(self.label, size, mount, mend)

    def grab(self) -> bool:
        """Take the oldest buffered frame, or wait for the next; False if none comes."""
        return bool(self._capture.grab())

    def age_s(self) -> float | None:
        """Return how long ago the frame taken last was exposed, by the driver's clock."""
        if not self._has_clock:
            return None
        age = time.monotonic() - self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e-3
        return max(age, 0.0) if -0.01 < age < PLAUSIBLE_AGE_S else None

    def image(self) -> NDArray[np.uint8] | None:
        """Return the frame taken last; None if it is broken."""
        done, image = self._capture.retrieve()
        return np.asarray(image, np.uint8) if done else None

    def close(self) -> None:
        """Let go of it."""
        self._capture.release()


def _why_absent(place: int | str) -> str:
    """Say what may be wrong with a camera that cannot be opened."""
    file = Path(f"/dev/video{place}" if isinstance(place, int) else place)
    if file.exists() and not os.access(file, os.R_OK | os.W_OK):
        return f"{file} may not be read: add yourself to its group, usually 'video'"
    found = sorted(str(other) for other in Path("/dev").glob("video*"))
    there = f"there are {', '.join(found)}" if found else "there is no /dev/video*"
    return f"is it plugged in, and not used by another program? ({there})"


class FileDevice:
    """A video file that is played like a camera, at its own rate.

    Args:
        path: the file.
        mount: the calibration of its camera.

    Raises:
        InputError: it cannot be decoded.
        CalibrationError: it is of another size than calibrated.
    """

    def __init__(self, path: Path, mount: CameraMount) -> None:
        footage = probe_video(path, mount)
        self.label = f"camera {path}"
        self.details: dict[str, object] = {"device": f"{path}, played", "codec": footage.codec}
        self._due_s = (footage.times_us - footage.times_us[0]) * 1e-6
        step = float(np.median(np.diff(self._due_s))) if len(self._due_s) > 1 else 1 / RATE_HZ
        self.rate_hz = 1 / step
        self._cursor = footage.open()
        self._start_s: float | None = None
        self._arrived = 0
        self._buffers: list[int] = []
        self._taken = 0

    @property
    def has_ended(self) -> bool:
        """Whether all frames were taken or lost."""
        return self._arrived == len(self._due_s) and not self._buffers

    def grab(self) -> bool:
        """Take the oldest buffered frame, or wait for the next; False at the end."""
        now = time.monotonic()
        if self._start_s is None:
            self._start_s = now
        self._arrive(now)
        if self.has_ended:
            return False
        if not self._buffers:
            time.sleep(max(0.0, self._start_s + float(self._due_s[self._arrived]) - now))
            self._buffers.append(self._arrived)
            self._arrived += 1
        self._taken = self._buffers.pop(0)
        return True

    def _arrive(self, now: float) -> None:
        """Fill the buffers with what arrived since the last grab; what finds none is lost."""
        while self._arrived < len(self._due_s) and self._age_of(self._arrived, now) >= 0:
            if len(self._buffers) < BUFFERS:
                self._buffers.append(self._arrived)
            self._arrived += 1

    def _age_of(self, index: int, now: float) -> float:
        return now - (self._start_s or 0.0) - float(self._due_s[index])

    def age_s(self) -> float | None:
        """Return how long ago the frame taken last arrived."""
        return max(0.0, self._age_of(self._taken, time.monotonic()))

    def image(self) -> NDArray[np.uint8] | None:
        """Return the frame taken last; None if it is broken."""
        return self._cursor.read(self._taken)

    def close(self) -> None:
        """Let go of the file."""
        self._cursor.close()
