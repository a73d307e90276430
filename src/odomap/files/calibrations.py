"""Calibrations: one door to every file that says what the cameras are.

Recognised by what is inside, not by the name:

    rig.yaml                     odomap_rig: 1
    Kalibr's camchain.yaml       cam0: {camera_model: ...}
    OpenCV's and ROS' YAML       camera_matrix: ..., or M1 D1 M2 D2 R T for a pair

What is read here and written with `files.rig.write_rig` is converted.
"""

from pathlib import Path

from odomap.errors import CalibrationError
from odomap.files.fields import read_yaml
from odomap.files.kalibr import is_camchain, read_camchain
from odomap.files.opencv_yaml import is_opencv, read_opencv
from odomap.files.rig import read_rig
from odomap.files.text import read_text
from odomap.sensors.rig import Rig

__all__ = ["KNOWN", "read_calibration"]

KNOWN = (
    "odomap's rig.yaml (odomap_rig: 1), Kalibr's camchain.yaml (cam0: ...), "
    "and OpenCV's or ROS' camera YAML (camera_matrix: ..., or M1 D1 M2 D2 R T)"
)


def read_calibration(path: str | Path) -> Rig:
    """Read what is mounted where from any of the files that are known.

    Args:
        path: the file, or a folder that holds a `rig.yaml`.

    Returns:
        The rig.

    Raises:
        CalibrationError: it is none of the three, or what it says cannot be true.
        InputError: the file cannot be read.
    """
    file = Path(path)
    if file.is_dir():
        file = file / "rig.yaml"
    if read_text(file).lstrip().startswith("<"):
        raise CalibrationError(
            f"{file}: XML is not read: write it as YAML (a name that ends in .yaml is enough for "
            f"OpenCV's FileStorage); known are {KNOWN}"
        )
    fields = read_yaml(file)
    if "odomap_rig" in fields or "cameras" in fields:
        return read_rig(file)
    if is_camchain(fields):
        return read_camchain(file)
    if is_opencv(fields):
        return read_opencv(file)
    raise CalibrationError(f"{file}: is not a calibration that is known; known are {KNOWN}")
