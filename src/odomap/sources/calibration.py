"""Calibrations of recordings that do not carry their own: video, pictures, TUM, live cameras.

Looked for in this order: what the caller gives, then a rig.yaml beside the images. Nothing is
guessed, since a focal length that is off by 10 % bends every path; who has no calibration is told
how to make one. A calibration belongs to an image size: pixels of one that is scaled by s have
intrinsics scaled by s, so a size that differs is an error that names both sizes and s.

Reference: Z. Zhang, "A flexible new technique for camera calibration", IEEE Trans. Pattern Analysis
and Machine Intelligence 22(11), 2000.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from odomap.errors import CalibrationError
from odomap.files.calibrations import read_calibration
from odomap.geometry.pose import SE3
from odomap.sensors.rig import CameraMount, Rig

__all__ = [
    "HOW_TO",
    "check_resolution",
    "find_rig",
    "load_rig",
    "one_camera",
    "rig_beside",
    "size_text",
]

HOW_TO = (
    "make one from pictures of a chessboard with 'odomap calibrate PICTURES --board 9x6 "
    "--square 0.025', and give it with --rig FILE"
)


def load_rig(rig: Rig | str | Path) -> Rig:
    """Return a rig, read from its file if it is none yet.

    Raises:
        CalibrationError: the file is no calibration.
        InputError: it cannot be read.
    """
    return rig if isinstance(rig, Rig) else read_calibration(rig)


def rig_beside(candidates: Iterable[Path]) -> Rig | None:
    """Return the rig of the first of some files that is there, or None."""
    return next((load_rig(file) for file in candidates if file.is_file()), None)


def find_rig(rig: Rig | None, candidates: Sequence[Path], where: Path | str) -> Rig:
    """Return the given rig, or that of the first of some files that is there.

    Raises:
        CalibrationError: there is none; says how to make one.
    """
    found = rig_beside(candidates) if rig is None else rig
    if found is None:
        names = " nor ".join(str(file) for file in candidates)
        raise CalibrationError(
            f"{where}: there is no calibration (neither --rig nor {names}): {HOW_TO}"
        )
    return found


def one_camera(rig: Rig, where: Path | str) -> Rig:
    """Return the rig of a single camera, which is the body, as a path without scale demands.

    Raises:
        CalibrationError: the rig has more cameras than one, or none.
    """
    if len(rig.cameras) != 1:
        raise CalibrationError(
            f"{where}: is of one camera, but its calibration has {len(rig.cameras)}: list that one"
        )
    return Rig((replace(rig.cameras[0], T_body_camera=SE3.identity()),))


def size_text(size: tuple[int, int]) -> str:
    """Return width and height as text, "640x480"."""
    return "{}x{}".format(*size)


def check_resolution(
    where: Path | str, size: tuple[int, int], mount: CameraMount, mend: str
) -> None:
    """Raise a CalibrationError if images have another size than their camera is calibrated for.

    Args:
        where: the file or folder of the images, for the message.
        size: width and height of the images, pixels.
        mount: the camera.
        mend: what to do about it.
    """
    calibrated = mount.camera.resolution
    if size == calibrated:
        return
    across, down = size[0] / calibrated[0], size[1] / calibrated[1]
    scale = f" (intrinsics scale by {across:.4g})" if abs(across / down - 1) < 0.01 else ""
    raise CalibrationError(
        f"{where}: images are {size_text(size)}, but camera '{mount.name}' is calibrated "
        f"for {size_text(calibrated)}: {mend}{scale}"
    )
