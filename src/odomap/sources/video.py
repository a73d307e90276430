"""Video files: one camera, its frames at the times the container says (see `footage`).

Frames are decoded one after the other and none is kept; a single one is found by its time. A file
that was cut gives the frames before the cut; a frame that cannot be decoded costs that frame.
Without a calibration there is no direction to a pixel, so one must stand beside the video
(clip.rig.yaml or rig.yaml beside clip.mp4) or be given.

Reference: D. Nistér, O. Naroditsky, J. Bergen, "Visual odometry", CVPR 2004 (paths from video).
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig
from odomap.sources.calibration import find_rig, one_camera
from odomap.sources.capture import Cursor, to_grey
from odomap.sources.footage import probe_video
from odomap.sources.source import Skipped, UnusableFrame

__all__ = ["SUFFIXES", "VideoSource", "is_video"]

SUFFIXES = (
    *(".3gp", ".avi", ".flv", ".h264", ".h265", ".m2ts", ".m4v", ".mjpeg", ".mkv", ".mov"),
    *(".mp4", ".mpeg", ".mpg", ".mts", ".ogv", ".ts", ".webm", ".wmv"),
)


def is_video(path: Path) -> bool:
    """Tell whether the name of a file is that of a video."""
    return path.suffix.lower() in SUFFIXES


class VideoSource:
    """The frames of a video file.

    A `RandomAccess` where the container has times, `Coloured` always.

    Attributes:
        stamps_ns: (N,) int64, strictly increasing; only there if the container has times.
        details: facts for people: container, codec, rotation.
    """

    stamps_ns: NDArray[np.int64]

    def __init__(self, path: str | Path, rig: Rig | None = None) -> None:
        """Open a video.

        Args:
            path: the file.
            rig: calibration of its camera; without it, clip.rig.yaml or rig.yaml beside clip.mp4.

        Raises:
            InputError: it cannot be decoded, or has no frames; says why and the mend.
            CalibrationError: there is no calibration, or it is for another resolution.
        """
        path = Path(path)
        beside = (path.with_suffix(".rig.yaml"), path.with_name("rig.yaml"))
        self.name = path.name
        self.rig = one_camera(find_rig(rig, beside, path), path)
        self.truth: Trajectory | None = None
        self.skipped: list[Skipped] = []
        self._footage = footage = probe_video(path, self.rig.cameras[0])
        self.notes = list(footage.notes)
        offset_ns = round(self.rig.cameras[0].time_offset_s * 1e9)
        self._stamps_ns = footage.times_us * 1000 + offset_ns
        if footage.has_times:
            self.stamps_ns = self._stamps_ns
        self.details: dict[str, Any] = {
            "container": footage.container.kind,
            "codec": footage.codec,
            "rotation_deg": footage.rotation_deg,
        }
        self._cursor: Cursor | None = None

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def __repr__(self) -> str:
        return f"VideoSource({self.name}: {len(self)} frames)"

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames that can be decoded.

        Raises:
            InputError: after the last one, if none could be.
        """
        self.skipped = []
        cursor = self._footage.open()
        last = -1
        try:
            while last + 1 < len(self) and (index := cursor.step()) is not None:
                # A frame whose time is not in the table is that of a cut packet.
                if index <= last or (image := cursor.image()) is None:
                    continue
                self._skip(last + 1, index)
                yield self._frame(index, image)
                last = index
        finally:
            cursor.close()
        if last < 0:
            raise InputError(f"{self._footage.path}: no frame can be decoded")
        self._skip(last + 1, len(self))

    def frame(self, index: int) -> Frame:
        """Decode one frame.

        Args:
            index: from 0 to len - 1.

        Raises:
            UnusableFrame: it cannot be decoded.
            IndexError: there is no such frame.
        """
        return self._frame(index, self._image(index))

    def colour(self, index: int) -> NDArray[np.uint8]:
        """Decode one frame in colour: (H, W, 3) uint8 red, green, blue.

        Args:
            index: from 0 to len - 1.

        Raises:
            UnusableFrame: it cannot be decoded.
            IndexError: there is no such frame.
        """
        return np.asarray(cv2.cvtColor(self._image(index), cv2.COLOR_BGR2RGB), np.uint8)

    def _image(self, index: int) -> NDArray[np.uint8]:
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        if self._cursor is None:
            self._cursor = self._footage.open()
        image = self._cursor.read(index)
        if image is None:
            raise UnusableFrame(self._undecoded(index))
        return image

    def _frame(self, index: int, image: NDArray[np.uint8]) -> Frame:
        return Frame(index, int(self._stamps_ns[index]), (to_grey(image),))

    def _skip(self, start: int, stop: int) -> None:
        """Note the frames that did not come."""
        self.skipped += [self._undecoded(index) for index in range(start, stop)]

    def _undecoded(self, index: int) -> Skipped:
        file = f"{self._footage.path}, frame {index}"
        return Skipped(int(self._stamps_ns[index]), file, "cannot be decoded")
