"""Kalibr's camchain.yaml: cameras in a chain, and where the IMU is.

    cam0:
      camera_model: pinhole                  # or ds (double sphere)
      intrinsics: [fu, fv, pu, pv]           # ds: [xi, alpha, fu, fv, pu, pv]
      distortion_model: radtan               # or equidistant (Kannala-Brandt), none
      distortion_coeffs: [k1, k2, p1, p2]    # equidistant: [k1, k2, k3, k4]
      resolution: [752, 480]
      T_cam_imu: [[...], ...]                # maps IMU to camera coordinates
      timeshift_cam_imu: -8.1e-05            # t_imu = t_cam + shift
    cam1:
      T_cn_cnm1: [[...], ...]                # maps those of the camera before to this one's
      ...

Kalibr gives the way into the camera, odomap the way out of it, so both are inverted:

    T_body_camera = T_cam_imu⁻¹,   without an IMU   T_cam0_camN = (T_cN_cN-1 ... T_c1_c0)⁻¹.

With an IMU the body is the IMU, else the first camera. The IMU's noise is in a file of its own and
is left at its default.

Reference: P. Furgale, J. Rehder, R. Siegwart, "Unified temporal and spatial calibration for
multi-sensor systems", IROS 2013; the fields: the page "yaml formats" of Kalibr's wiki.
"""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from odomap.errors import CalibrationError, InputError
from odomap.files.fields import Fields, read_yaml
from odomap.files.rig import located
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.sensors.rig import CameraMount, ImuMount, Rig

__all__ = ["is_camchain", "read_camchain"]

SUPPORTED = "pinhole with radtan, equidistant or none, and ds (double sphere)"


def is_camchain(fields: Fields) -> bool:
    """Tell whether a YAML file is Kalibr's, by its sections cam0, cam1, ..."""
    return bool(_names(fields))


def read_camchain(path: str | Path) -> Rig:
    """Read a camchain.yaml of Kalibr.

    Args:
        path: the file, with or without an IMU.

    Returns:
        The rig; cameras are named as in the file, cam0, cam1, ...

    Raises:
        CalibrationError: a field is missing, of a wrong kind or implausible, or a camera model is
            one that odomap does not have.
        InputError: the file cannot be read.
    """
    file = Path(path)
    fields = read_yaml(file)
    names = _names(fields)
    if not names:
        raise CalibrationError(f"{file}: no section 'cam0': is this Kalibr's camchain.yaml?")
    sections = [fields.section(name) for name in names]
    with_imu = any("T_cam_imu" in section for section in sections)
    mounts: list[CameraMount] = []
    for name, section in zip(names, sections, strict=True):
        T_body_camera = _mount(section, mounts, with_imu)
        shift = section.number("timeshift_cam_imu", 0.0) if with_imu else 0.0
        try:
            mounts.append(CameraMount(name, _camera(section), T_body_camera, time_offset_s=shift))
        except InputError as error:
            raise located(section, error) from error
    return Rig(tuple(mounts), imu=ImuMount() if with_imu else None)


def _names(fields: Fields) -> list[str]:
    content = fields.content.items()
    cameras = [name for name, value in content if re.fullmatch(r"cam\d+", name)
               and isinstance(value, Mapping)]  # fmt: skip
    return sorted(cameras, key=lambda name: int(name[3:]))


def _mount(fields: Fields, before: list[CameraMount], with_imu: bool) -> SE3:
    """Return T_body_camera of the next camera in the chain."""
    if "T_cam_imu" in fields:
        return fields.transform("T_cam_imu").inverse()
    if before:
        if "T_cn_cnm1" not in fields:
            raise fields.error(
                "T_cn_cnm1", "is missing: it says where the camera is relative to the one before"
            )
        return before[-1].T_body_camera @ fields.transform("T_cn_cnm1").inverse()
    if with_imu:
        raise fields.error("T_cam_imu", "is missing, though another camera has it")
    return SE3.identity()


def _camera(fields: Fields) -> Camera:
    model, lens = fields.text("camera_model"), fields.text("distortion_model", "none")
    resolution = fields.resolution("resolution")
    if model == "ds" and lens == "none":
        numbers = fields.numbers("intrinsics", (6,))
        return Camera("double_sphere", numbers[2:], numbers[:2], resolution)
    if model != "pinhole":
        raise fields.error("camera_model", f"'{model}' is not supported: known are {SUPPORTED}")
    intrinsics = fields.numbers("intrinsics", (4,))
    if lens == "none":
        return Camera("pinhole", intrinsics, np.zeros(0), resolution)
    if lens not in ("radtan", "equidistant"):
        raise fields.error("distortion_model", f"'{lens}' is not supported: known are {SUPPORTED}")
    name = "pinhole" if lens == "radtan" else "kannala_brandt"
    return Camera(name, intrinsics, fields.numbers("distortion_coeffs", (4,)), resolution)
