"""Footage: what is known of a video file before its frames are decoded.

Phones record at a rate that varies with the light, so frame i is not at i / rate: its time is the
container's, and the packets tell the times of all frames without decoding one (see `capture`). Only
where there are none, or all are the same, is the nominal rate taken.

Phones also store what they hold upright as a lying image and a note to turn it by 90°. A
calibration is of one of the two, and its resolution tells which; where both have the same size,
images are turned, as players show them.

Reference: ISO/IEC 14496-12:2022, "ISO base media file format", 8.6 (times) and 8.3.2 (rotation).
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.sensors.rig import CameraMount
from odomap.sources.calibration import check_resolution, size_text
from odomap.sources.capture import (
    SAME_US,
    Cursor,
    decoded_times,
    fourcc,
    open_file,
    packet_times,
    stamp_us,
    why_not,
)
from odomap.sources.container import Container, inspect

__all__ = ["Footage", "probe_video"]

RATE_HZ = 30.0
PLAUSIBLE_HZ = (0.1, 1000.0)
DISTINCT = 0.9
"""Share of the frames whose times must differ, for them to be times at all."""
LOOK = 3
"""Frames decoded to see whether they have the times of their packets."""


@dataclass(frozen=True)
class Footage:
    """What is known of a video file.

    Attributes:
        path: the file.
        container: what it says about itself.
        codec: name of the codec.
        rotation_deg: by how much the images are turned clockwise: 0, 90, 180, 270.
        times_us: (N,) int64, when the frames are, in microseconds; increasing.
        has_times: whether that is from the container, so that a frame can be found by it.
        notes: what was found odd, for the user.
    """

    path: Path
    container: Container
    codec: str
    rotation_deg: int
    times_us: NDArray[np.int64]
    has_times: bool
    notes: list[str]

    def open(self) -> Cursor:
        """Return a place before the first frame."""
        times = self.times_us if self.has_times else None
        return Cursor(self.path, times, is_turned=self.rotation_deg != 0)


def probe_video(path: Path, mount: CameraMount) -> Footage:
    """Look at a video file: its codec, its orientation, the times of its frames.

    Args:
        path: the file.
        mount: the calibration of its camera.

    Raises:
        InputError: it cannot be decoded, or has no frames; says why and the mend.
        CalibrationError: it is calibrated for another resolution.
    """
    container = inspect(path)
    capture = open_file(path)
    try:
        if not capture.isOpened():
            raise why_not(path)
        raw = _frame_times(capture, container, path)
        notes: list[str] = []
        codec = fourcc(capture, container)
        rotation = _orient(capture, path, mount, notes)
        announced = max(0.0, capture.get(cv2.CAP_PROP_FRAME_COUNT))
        rate = _rate(capture.get(cv2.CAP_PROP_FPS), mount.rate_hz)
    finally:
        capture.release()
    if len(raw) == 0:
        raise InputError(f"{path}: the file is cut within its first frame: copy it again")
    times = np.unique(raw)
    has_times = len(times) >= max(DISTINCT * len(raw), min(2, len(raw)))
    if not has_times:
        times = np.round(np.arange(len(raw)) * 1e6 / rate).astype(np.int64)
        notes.append(
            f"the video has no times of its own: frames are taken to be {1e3 / rate:.4g} ms apart"
        )
    if container.is_cut:
        of = f" of {announced:.0f} announced" if len(times) < announced < 1e9 else ""
        notes.append(
            f"the file is cut: it ends after {times[-1] * 1e-6:.2f} s and {len(times)} frames{of}"
        )
    return Footage(path, container, codec, rotation, times, has_times, notes)


def _orient(capture: cv2.VideoCapture, path: Path, mount: CameraMount, notes: list[str]) -> int:
    """Decide whether images are turned as the file says; return by how many degrees."""
    rotation = int(capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 360
    sizes = {}
    for is_turned in (True, False):
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, int(is_turned))
        sizes[is_turned] = (
            int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)),
            int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)),
        )
    if mount.camera.resolution not in sizes.values():
        mend = "give the calibration of these images with --rig, or convert the video"
        if rotation and sizes[True] != sizes[False]:
            mend = f"(or {size_text(sizes[False])} before they are turned by {rotation}°) {mend}"
        check_resolution(path, sizes[True], mount, mend)
    if mount.camera.resolution != sizes[True]:
        notes.append(
            f"the video says to turn its images by {rotation}°, the calibration is of "
            f"{size_text(sizes[False])}: they are used as stored"
        )
        return 0
    if rotation:
        notes.append(f"images are turned by {rotation}°, as the video says")
    return rotation


def _rate(announced: float, calibrated: float) -> float:
    """Return the nominal rate: the calibration's, else the file's where it can be true."""
    if not calibrated and PLAUSIBLE_HZ[0] <= announced <= PLAUSIBLE_HZ[1]:
        return announced
    return calibrated or RATE_HZ


def _frame_times(capture: cv2.VideoCapture, container: Container, path: Path) -> NDArray[np.int64]:
    """Return the times of all frames, in microseconds and any order."""
    times = packet_times(path)
    first = [stamp_us(capture) for _ in range(LOOK) if capture.grab()]
    if not first:
        if len(times) or container.is_cut:
            raise why_not(path)
        raise InputError(f"{path}: the video has no frames: was the recording stopped at once?")
    if container.is_cut:
        # The last packet of the file is the one that is cut; its image may be half grey.
        times = times[:-1]
    return times if _contains(times, first[: len(times)]) else decoded_times(path)


def _contains(times: NDArray[np.int64], some: list[int]) -> bool:
    """Tell whether all of some times are among others, in any order."""
    if len(times) == 0:
        return False
    gaps = np.abs(times[:, None] - np.array(some)[None, :]).min(axis=0)
    return bool((gaps <= SAME_US).all())
