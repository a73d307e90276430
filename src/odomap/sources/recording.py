"""Recordings: folders of images with stamps, read one frame at a time.

What recordings made of image files share: for every frame a stamp and one image file per camera,
beside it depth, inertial samples and ground truth. Opening reads the listings (about 0.1 kB per
frame) and a few images; iterating reads one frame, hands it out, and keeps nothing.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError, InputError
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.frame import Frame, ImuSamples
from odomap.sensors.rig import CameraMount, Rig
from odomap.sources.calibration import check_resolution
from odomap.sources.depth import DepthFiles, read_depth
from odomap.sources.images import BadImage, ImageFormat, probe_format, read_colour, read_image
from odomap.sources.source import Skipped, UnusableFrame

__all__ = ["CameraFiles", "Recording", "check_stereo", "check_truth", "open_cameras"]


@dataclass(frozen=True)
class CameraFiles:
    """The images of one camera.

    Attributes:
        folder: where they are.
        names: (N,) one file name per frame.
        form: what the camera writes.
    """

    folder: Path
    names: Sequence[str]
    form: ImageFormat


@dataclass(eq=False, repr=False)
class Recording:
    """A source made of image files; a `RandomAccess`, and `Coloured`.

    Attributes:
        name: short name.
        rig: what is mounted where; one camera per entry of `cameras`.
        stamps_ns: (N,) int64, strictly increasing.
        cameras: the image files.
        depth: the depth images, if recorded.
        imu: all inertial samples, if recorded (56 bytes each).
        truth: T_world_body, if known.
        left_out: what the listings had to leave out.
        notes: what was found odd and mended, for the user.
        skipped: `left_out`, and what iterating so far could not read.
    """

    name: str
    rig: Rig
    stamps_ns: NDArray[np.int64]
    cameras: tuple[CameraFiles, ...]
    depth: DepthFiles | None = None
    imu: ImuSamples | None = None
    truth: Trajectory | None = None
    left_out: list[Skipped] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    skipped: list[Skipped] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.skipped = list(self.left_out)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __repr__(self) -> str:
        cameras = ", ".join(mount.name for mount in self.rig.cameras)
        return f"{type(self).__name__}({self.name}: {len(self)} frames of {cameras})"

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames that can be read.

        Raises:
            InputError: after the last one, if none could be.
        """
        self.skipped = list(self.left_out)
        last_ns: int | None = None
        for index in range(len(self)):
            try:
                frame = self._read(index, last_ns)
            except UnusableFrame as error:
                self.skipped.append(error.skipped)
                continue
            yield frame
            last_ns = frame.stamp_ns
        if last_ns is None:
            first = self.skipped[-1]
            raise InputError(f"{first.file}: {first.reason}; no frame of {self.name} can be read")

    def frame(self, index: int) -> Frame:
        """Read one frame.

        Args:
            index: from 0 to len - 1.

        Raises:
            UnusableFrame: it cannot be read.
            IndexError: there is no such frame.
        """
        self._check(index)
        return self._read(index, int(self.stamps_ns[index - 1]) if index else None)

    def colour(self, index: int) -> NDArray[np.uint8]:
        """Read the image of the first camera in colour: (H, W, 3) uint8 red, green, blue.

        Args:
            index: from 0 to len - 1.

        Raises:
            UnusableFrame: it cannot be read.
            IndexError: there is no such frame.
        """
        self._check(index)
        camera = self.cameras[0]
        path = camera.folder / camera.names[index]
        try:
            return read_colour(path, camera.form)
        except BadImage as error:
            raise UnusableFrame(self._skipped(index, path, error)) from error

    def _check(self, index: int) -> None:
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")

    def _read(self, index: int, last_ns: int | None) -> Frame:
        stamp_ns = int(self.stamps_ns[index])
        images = tuple(self._image(camera, index) for camera in self.cameras)
        imu = None if self.imu is None else self.imu.between(last_ns, stamp_ns)
        return Frame(index, stamp_ns, images, depth=self._depth(index), imu=imu)

    def _image(self, camera: CameraFiles, index: int) -> NDArray[np.uint8]:
        path = camera.folder / camera.names[index]
        try:
            return read_image(path, camera.form)
        except BadImage as error:
            raise UnusableFrame(self._skipped(index, path, error)) from error

    def _depth(self, index: int) -> NDArray[np.float32] | None:
        """Read the depth of a frame; one that is broken costs the depth, not the frame."""
        name = None if self.depth is None else self.depth.names[index]
        if self.depth is None or name is None:
            return None
        path = self.depth.folder / name
        try:
            return read_depth(path, self.depth.mount, self.depth.resolution)
        except BadImage as error:
            skipped = self._skipped(index, path, error, ": the frame has no depth")
            if skipped not in self.skipped:
                self.skipped.append(skipped)
            return None

    def _skipped(self, index: int, path: Path, error: BadImage, effect: str = "") -> Skipped:
        return Skipped(int(self.stamps_ns[index]), str(path), f"{error}{effect}")


def open_cameras(
    folders: Sequence[Path],
    names: Sequence[Sequence[str]],
    mounts: Sequence[CameraMount | None],
    mend: str,
) -> tuple[CameraFiles, ...]:
    """Find out what the cameras write, and check it against the calibration.

    Args:
        folders: the image folder of each camera.
        names: its file names.
        mounts: its calibration, or None where that does not say a resolution.
        mend: what to change if the resolution is wrong.

    Raises:
        CalibrationError: the images have another size than calibrated, or left and right differ.
        InputError: no image can be read.
    """
    cameras = []
    for folder, files, mount in zip(folders, names, mounts, strict=True):
        form = probe_format([folder / name for name in files], str(folder))
        if mount is not None:
            check_resolution(folder, form.resolution, mount, mend)
        cameras.append(CameraFiles(folder, files, form))
    sizes = {camera.form.resolution for camera in cameras}
    if len(sizes) > 1:
        found = " and ".join("{}x{}".format(*camera.form.resolution) for camera in cameras)
        raise CalibrationError(
            f"{folders[1]}: left and right images have different sizes ({found}): "
            "a stereo pair needs the same; resize one and its calibration"
        )
    return tuple(cameras)


def check_stereo(rig: Rig, where: Path | str) -> None:
    """Raise a CalibrationError, naming the file, if two cameras are no stereo pair."""
    if len(rig.cameras) < 2:
        return
    try:
        rig.stereo_pair()
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from error


def check_truth(
    truth: Trajectory, stamps_ns: NDArray[np.int64], label: str, notes: list[str]
) -> Trajectory | None:
    """Return the truth if it overlaps the frames in time; else None, with a note."""
    if truth.stamps_ns[0] <= stamps_ns[-1] and truth.stamps_ns[-1] >= stamps_ns[0]:
        return truth
    spans = [f"{s[0] * 1e-9:.1f} to {s[-1] * 1e-9:.1f} s" for s in (truth.stamps_ns, stamps_ns)]
    notes.append(
        f"{label}: ground truth ({spans[0]}) does not overlap the images ({spans[1]}): ignored"
    )
    return None
