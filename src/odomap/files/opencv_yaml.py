"""Calibrations in the YAML of OpenCV and of ROS.

One camera, as OpenCV's calibration sample, ROS' camera_calibration and many scripts write it:

    image_width: 640
    image_height: 480
    camera_matrix: !!opencv-matrix {rows: 3, cols: 3, dt: d, data: [fx, 0, cx, 0, fy, cy, 0, 0, 1]}
    distortion_coefficients: {rows: 1, cols: 5, data: [k1, k2, p1, p2, k3]}
    distortion_model: plumb_bob              # ROS: or rational_polynomial, equidistant
    fisheye_model: 0                         # OpenCV: 1 for its fisheye, which is Kannala-Brandt

or two, M1 D1 M2 D2 with R and T, which map left to right coordinates, x_right = R x_left + T, so
that the right camera's mount is their inverse. OpenCV's stereo sample writes R and T into a second
file, extrinsics.yml, which is read where it lies beside the first, and not the size of the images,
which must be added. Names of fields are compared without regard to case and underscores; the
first camera is the body. Fields of a rectified pair (R1 R2 P1 P2 Q, projection_matrix) are not
needed.

Reference: OpenCV, "Camera calibration and 3D reconstruction"; ROS, sensor_msgs/CameraInfo.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError, InputError
from odomap.files.fields import Fields, read_yaml
from odomap.files.rig import located
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.sensors.rig import CameraMount, Rig

__all__ = ["is_opencv", "read_opencv"]

MATRIX = ("camera_matrix", "K", "M", "mtx")
DISTORTION = ("distortion_coefficients", "dist_coeffs", "D", "dist")
LENSES = {
    "plumb_bob": "pinhole",
    "rational_polynomial": "pinhole",
    "equidistant": "kannala_brandt",
    "fisheye": "kannala_brandt",
}


def is_opencv(fields: Fields) -> bool:
    """Tell whether a YAML file holds a camera matrix under one of its usual names."""
    return any(_find(fields, MATRIX, suffix) for suffix in ("", "1"))


def read_opencv(path: str | Path) -> Rig:
    """Read the calibration of one camera or of a stereo pair from OpenCV's or ROS' YAML.

    Args:
        path: the file.

    Returns:
        The rig: one camera, or "left" and "right".

    Raises:
        CalibrationError: a field is missing, of a wrong kind or implausible, or the lens model is
            one that odomap does not have.
        InputError: the file cannot be read.
    """
    file = Path(path)
    fields = read_yaml(file)
    resolution = _resolution(fields)
    try:
        if not _find(fields, MATRIX, "1"):
            name = fields.text("camera_name", "camera") or "camera"
            return Rig((CameraMount(name, _camera(fields, "", resolution)),))
        left = CameraMount("left", _camera(fields, "1", resolution))
        right = _camera(fields, "2", resolution)
        T_right_left = _transform(_extrinsics(file, fields))
        return Rig((left, CameraMount("right", right, T_right_left.inverse())))
    except InputError as error:
        raise located(fields, error) from error


def _plain(name: str) -> str:
    return name.replace("_", "").lower()


def _find(fields: Fields, names: Sequence[str], suffix: str = "") -> str:
    """Return the field of one of these names, however it is written, or nothing."""
    wanted = [_plain(name + suffix) for name in names]
    found = [name for name in fields.content if _plain(name) in wanted]
    return found[0] if found else ""


def _array(fields: Fields, name: str) -> NDArray[np.float64]:
    """Return a matrix: OpenCV's and ROS' mapping with rows, cols and data, or rows of numbers."""
    value = fields.get(name)
    if isinstance(value, Mapping):
        matrix = fields.section(name)
        shape = int(matrix.number("rows")), int(matrix.number("cols"))
        data = matrix.numbers("data")
        if len(data) != shape[0] * shape[1]:
            raise fields.error(name, f"has {len(data)} numbers for {shape[0]} x {shape[1]}")
        return data.reshape(shape)
    if isinstance(value, list) and value and all(isinstance(row, list) for row in value):
        rows = [Fields(fields.where, {name: row}).numbers(name) for row in value]
        if len({len(row) for row in rows}) == 1:
            return np.stack(rows)
        raise fields.error(name, "has rows of different lengths")
    return fields.numbers(name)


def _resolution(fields: Fields) -> tuple[int, int]:
    both = _find(fields, ("image_size", "img_size", "resolution"))
    if both:
        return fields.resolution(both)
    size = []
    for name in ("image_width", "image_height"):
        found = _find(fields, (name, name.removeprefix("image_")))
        if not found:
            raise CalibrationError(
                f"{fields.where}: field '{name}' is missing: add 'image_width: ...' and "
                "'image_height: ...', the size in pixels of the images it was made from"
            )
        size.append(fields.number(found))
    return Fields(fields.where, {"image size": size}).resolution("image size")


def _camera(fields: Fields, suffix: str, resolution: tuple[int, int]) -> Camera:
    name = _find(fields, MATRIX, suffix)
    if not name:
        raise CalibrationError(f"{fields.where}: field 'M{suffix}' is missing: the camera matrix")
    K = _array(fields, name)
    if K.size != 9:
        raise fields.error(name, f"must be 3 x 3, not {' x '.join(map(str, K.shape))}")
    K = K.reshape(3, 3)
    if np.any(np.abs(K[[1, 2, 2, 2], [0, 0, 1, 2]] - (0, 0, 0, 1)) > 1e-9):
        raise fields.error(name, "must be [fx, 0, cx, 0, fy, cy, 0, 0, 1]")
    if abs(K[0, 1]) > 1e-3 * abs(K[0, 0]):
        raise fields.error(name, f"has a skew of {K[0, 1]:g}: odomap's cameras have none")
    model = _model(fields)
    intrinsics = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
    return Camera(model, intrinsics, _distortion(fields, suffix, model), resolution)


def _model(fields: Fields) -> str:
    fisheye = _find(fields, ("fisheye_model",))
    if fisheye and fields.number(fisheye) != 0:
        return "kannala_brandt"
    lens = fields.text("distortion_model", "plumb_bob")
    if lens not in LENSES:
        known = ", ".join(LENSES)
        raise fields.error("distortion_model", f"'{lens}' is not supported: known are {known}")
    return LENSES[lens]


def _distortion(fields: Fields, suffix: str, model: str) -> NDArray[np.float64]:
    name = _find(fields, DISTORTION, suffix)
    if not name:
        wanted = DISTORTION[0] if not suffix else f"D{suffix}"
        raise CalibrationError(
            f"{fields.where}: field '{wanted}' is missing: for a lens without distortion write "
            f"'{wanted}: [0, 0, 0, 0]'"
        )
    numbers = _array(fields, name).ravel()
    if model != "pinhole" or len(numbers) <= 8:
        return numbers
    # 12 and 14 numbers add a thin prism and a tilted sensor, mostly left at zero.
    if np.any(numbers[8:]):
        raise fields.error(
            name, "has a thin prism or a tilted sensor: calibrate without, up to 8 numbers"
        )
    return numbers[:8]


def _extrinsics(file: Path, fields: Fields) -> Fields:
    """Return the fields that hold R and T."""
    if "R" in fields and "T" in fields:
        return fields
    for beside in (file.with_name("extrinsics.yml"), file.with_name("extrinsics.yaml")):
        if beside.exists():
            return read_yaml(beside)
    raise CalibrationError(
        f"{fields.where}: fields 'R' and 'T' of the stereo pair are missing, and there is no "
        "extrinsics.yml beside it"
    )


def _transform(fields: Fields) -> SE3:
    """Return T_right_left: x_right = R x_left + T."""
    R, t = _array(fields, "R"), _array(fields, "T")
    if R.size != 9 or t.size != 3:
        raise CalibrationError(f"{fields.where}: R must be 3 x 3 and T 3 x 1")
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = R.reshape(3, 3), t.ravel()
    return Fields(fields.where, {"R": matrix.ravel().tolist()}).transform("R")
