"""rig.yaml: what is mounted where, for recordings that do not say it themselves.

Version 1 (lengths in metres, times in seconds, T_a_b maps b to a, four rows of four numbers):

    odomap_rig: 1
    body: imu         # optional: the sensor that is the body; default the IMU, else the first
    cameras:
      - {name: left, model: pinhole, intrinsics: [fx, fy, cx, cy], distortion: [k1, k2, p1, p2],
         resolution: [w, h], rate_hz: 20.0, T_body_camera: [[...], ...], time_offset_s: 0.0}
    depth: {camera: left, factor: 5000.0, invalid: [0]}
    imu: {rate_hz: 200.0, gyro_noise: 1.7e-4, gyro_walk: 1.9e-5, accel_noise: 2.0e-3,
          accel_walk: 3.0e-3}
    lidars:
      - {name: top, T_body_lidar: [[...], ...], range_m: [0.5, 100.0], rate_hz: 10.0,
         sweep: clockwise, beams: 64}

Models and their coefficients are those of `geometry.camera`: pinhole, kannala_brandt (k1 k2 k3 k4),
double_sphere (xi, alpha). A mount that is not given is the identity. Unknown fields are errors, so
that a typo is not a default.
"""

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from odomap.errors import CalibrationError, InputError
from odomap.files.atomic import write_text
from odomap.files.fields import Fields, read_yaml
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.sensors.rig import CameraMount, DepthMount, ImuMount, LidarMount, Rig

__all__ = ["VERSION", "located", "read_rig", "rig_fields", "rig_of", "write_rig"]

VERSION = 1


def read_rig(path: str | Path) -> Rig:
    """Read a rig.yaml.

    Args:
        path: the file, or a folder that holds a `rig.yaml`.

    Raises:
        CalibrationError: a field is missing, mistyped, of a wrong kind, or implausible.
        InputError: the file cannot be read.
    """
    file = Path(path)
    if file.is_dir():
        file = file / "rig.yaml"
    return rig_of(read_yaml(file))


def rig_of(fields: Fields) -> Rig:
    """Return the rig that the fields of a rig.yaml describe.

    Raises:
        CalibrationError: a field is missing, mistyped, of a wrong kind, or implausible.
    """
    file = fields.where
    version = fields.number("odomap_rig")
    if version != VERSION:
        raise CalibrationError(
            f"{file}: odomap_rig {version:g} is unknown, this odomap reads {VERSION}"
        )
    fields.allow("odomap_rig", "body", "cameras", "depth", "imu", "lidars")
    cameras = tuple(_camera(entry) for entry in fields.sections("cameras"))
    lidars = tuple(_lidar(entry) for entry in fields.sections("lidars"))
    depth = _depth(fields.section("depth")) if "depth" in fields else None
    imu = _imu(fields.section("imu")) if "imu" in fields else None
    if not cameras and not lidars and imu is None:
        raise CalibrationError(f"{file}: no sensor: add 'cameras', 'lidars' or 'imu'")
    try:
        return Rig(cameras, depth, imu, lidars, fields.text("body", ""))
    except CalibrationError as error:
        raise CalibrationError(f"{file}: {error}") from error


def _camera(fields: Fields) -> CameraMount:
    fields.allow(
        "name",
        "model",
        "intrinsics",
        "distortion",
        "resolution",
        "rate_hz",
        "T_body_camera",
        "time_offset_s",
    )
    distortion = fields.numbers("distortion") if "distortion" in fields else np.zeros(0)
    try:
        camera = Camera(
            model=fields.text("model", "pinhole"),
            intrinsics=fields.numbers("intrinsics", (4,)),
            distortion=distortion,
            resolution=fields.resolution("resolution"),
        )
        return CameraMount(
            fields.text("name"),
            camera,
            fields.transform("T_body_camera") if "T_body_camera" in fields else SE3.identity(),
            fields.number("rate_hz", 0.0),
            fields.number("time_offset_s", 0.0),
        )
    except InputError as error:
        raise located(fields, error) from error


def _depth(fields: Fields) -> DepthMount:
    fields.allow("camera", "factor", "invalid")
    invalid = fields.numbers("invalid") if "invalid" in fields else np.zeros(1)
    try:
        return DepthMount(
            fields.text("camera"), fields.number("factor", 5000.0), tuple(int(v) for v in invalid)
        )
    except InputError as error:
        raise located(fields, error) from error


def _imu(fields: Fields) -> ImuMount:
    defaults = ImuMount()
    names = ("rate_hz", "gyro_noise", "gyro_walk", "accel_noise", "accel_walk")
    fields.allow(*names, "T_body_imu")
    T_body_imu = fields.transform("T_body_imu") if "T_body_imu" in fields else SE3.identity()
    values = {name: fields.number(name, getattr(defaults, name)) for name in names}
    try:
        return ImuMount(**values, T_body_imu=T_body_imu)
    except InputError as error:
        raise located(fields, error) from error


def _lidar(fields: Fields) -> LidarMount:
    fields.allow("name", "T_body_lidar", "range_m", "rate_hz", "sweep", "angles", "beams")
    default = LidarMount("")
    near, far = fields.numbers("range_m", (2,)) if "range_m" in fields else default.range_m
    first, last, beams = fields.numbers("angles", (3,)) if "angles" in fields else default.angles
    try:
        return LidarMount(
            fields.text("name"),
            fields.transform("T_body_lidar") if "T_body_lidar" in fields else SE3.identity(),
            (float(near), float(far)),
            fields.number("rate_hz", default.rate_hz),
            fields.text("sweep", default.sweep),
            (float(first), float(last), int(beams)),
            int(fields.number("beams", default.beams)),
        )
    except InputError as error:
        raise located(fields, error) from error


def located(fields: Fields, error: InputError) -> CalibrationError:
    """Return an error that says where, unless it does so already."""
    message = str(error)
    if not message.startswith(fields.where):
        message = f"{fields.where}: {message}"
    return CalibrationError(message)


def write_rig(path: str | Path, rig: Rig) -> None:
    """Write a rig.yaml that `read_rig` reads back to the same rig.

    Raises:
        OutputError: it cannot be written.
    """
    text = yaml.safe_dump(rig_fields(rig), sort_keys=False, default_flow_style=None, width=1000)
    write_text(path, text)


def rig_fields(rig: Rig) -> dict[str, Any]:
    """Return the fields of a rig.yaml, plain numbers and texts; `rig_of` reads them."""
    content: dict[str, Any] = {"odomap_rig": VERSION}
    if rig.body:
        content["body"] = rig.body
    if rig.cameras:
        content["cameras"] = [_camera_fields(mount) for mount in rig.cameras]
    if rig.depth is not None:
        depth = rig.depth
        content["depth"] = {
            "camera": depth.camera,
            "factor": float(depth.factor),
            "invalid": list(depth.invalid),
        }
    if rig.imu is not None:
        names = ("rate_hz", "gyro_noise", "gyro_walk", "accel_noise", "accel_walk")
        content["imu"] = {name: float(getattr(rig.imu, name)) for name in names}
        content["imu"]["T_body_imu"] = rig.imu.T_body_imu.matrix.tolist()
    if rig.lidars:
        content["lidars"] = [_lidar_fields(mount) for mount in rig.lidars]
    return content


def _camera_fields(mount: CameraMount) -> dict[str, Any]:
    camera = mount.camera
    return {
        "name": mount.name,
        "model": camera.model,
        "intrinsics": np.asarray(camera.intrinsics).tolist(),
        "distortion": np.asarray(camera.distortion).tolist(),
        "resolution": [int(size) for size in camera.resolution],
        "rate_hz": float(mount.rate_hz),
        "T_body_camera": mount.T_body_camera.matrix.tolist(),
        "time_offset_s": float(mount.time_offset_s),
    }


def _lidar_fields(mount: LidarMount) -> dict[str, Any]:
    return {
        "name": mount.name,
        "T_body_lidar": mount.T_body_lidar.matrix.tolist(),
        "range_m": [float(value) for value in mount.range_m],
        "rate_hz": float(mount.rate_hz),
        "sweep": mount.sweep,
        "angles": [float(mount.angles[0]), float(mount.angles[1]), int(mount.angles[2])],
        "beams": int(mount.beams),
    }
