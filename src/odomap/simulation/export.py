"""Write a world to disk as data sets are, so that other systems can run on the same measurements.

EuRoC's ASL layout for cameras:

    mav0/cam0, cam1    data.csv, sensor.yaml, data/<stamp>.png
    mav0/imu0          data.csv, sensor.yaml
    mav0/state_groundtruth_estimate0/data.csv      p, q (wxyz), v, biases (zero) of the body

Images are lossless; numbers are written with their full precision. And KITTI's for a LiDAR:

    velodyne/000000.bin ...     x y z intensity as float32, beam after beam, the highest first,
                                each from straight ahead to the left and around
    times.txt                   seconds, when the LiDAR looks ahead
    poses_velodyne.txt          T_world_lidar then

which has no times of points: they follow from the azimuth.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from odomap.errors import InputError, OutputError
from odomap.geometry.pose import SE3
from odomap.sensors.frame import ImuSamples
from odomap.sensors.rig import CameraMount, ImuMount
from odomap.simulation.world import START_NS, World

if TYPE_CHECKING:
    from odomap.simulation.sweepworld import SweepWorld

__all__ = ["export_euroc", "export_velodyne"]

TRUTH_HEADER = (
    "#timestamp,p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n"
)
IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"
)


def export_euroc(world: World, folder: str | Path) -> Path:
    """Render all frames of a world into a folder.

    Args:
        world: with one or two cameras.
        folder: is made if it is not there; `mav0` goes into it.

    Returns:
        The folder.

    Raises:
        InputError: a lens has no place in this format: its sensor.yaml knows radtan alone.
        OutputError: something cannot be written.
    """
    for mount in world.rig.cameras:
        if mount.camera.model != "pinhole":
            raise InputError(
                f"camera '{mount.name}': {mount.camera.model} cannot be written as EuRoC, "
                "whose cameras are pinholes: take lens=pinhole or lens=radtan"
            )
    root = Path(folder)
    try:
        for number, mount in enumerate(world.rig.cameras):
            _write(root / f"mav0/cam{number}/sensor.yaml", _camera_yaml(mount))
        listings = [["#timestamp [ns],filename\n"] for _ in world.rig.cameras]
        samples: list[ImuSamples] = []
        for index in range(len(world)):
            frame = world.frame(index)
            for number, image in enumerate(frame.images):
                name = f"{frame.stamp_ns}.png"
                listings[number].append(f"{frame.stamp_ns},{name}\n")
                if image is not None:
                    ok, png = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
                    if not ok:
                        raise OutputError(f"{name}: cannot be encoded as PNG")
                    _write(root / f"mav0/cam{number}/data/{name}", png.tobytes())
            if frame.imu is not None:
                samples.append(frame.imu)
        for number, rows in enumerate(listings):
            _write(root / f"mav0/cam{number}/data.csv", "".join(rows))
        if world.rig.imu is not None:
            _write(root / "mav0/imu0/sensor.yaml", _imu_yaml(world.rig.imu))
            _write(root / "mav0/imu0/data.csv", _imu_csv(samples))
        _write(root / "mav0/state_groundtruth_estimate0/data.csv", _truth_csv(world))
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{error.filename or root}: cannot be written: {reason}") from error
    return root


def export_velodyne(world: "SweepWorld", folder: str | Path) -> Path:
    """Write all sweeps of a world into a folder.

    Args:
        world: with a rotating LiDAR.
        folder: is made if it is not there.

    Returns:
        The folder.

    Raises:
        InputError: the LiDAR does not rotate, so that nothing would say when a point was seen.
        OutputError: something cannot be written.
    """
    if world.spec.pattern != "rotating":
        raise InputError(
            "export_velodyne: times of a solid-state LiDAR have no place in this format: "
            "take pattern=rotating"
        )
    root = Path(folder)
    begun = np.asarray(world.truth.stamps_ns - START_NS, np.float64) * 1e-9
    ahead = begun + 0.5 / world.spec.rate_hz
    try:
        for index in range(len(world)):
            sweep = world.frame(index).cloud
            assert sweep is not None
            assert sweep.intensities is not None
            assert sweep.beams is not None
            azimuth = np.arctan2(sweep.points[:, 1], sweep.points[:, 0]) % (2 * np.pi)
            rows = np.lexsort([azimuth, -sweep.beams.astype(np.int64)])
            table = np.column_stack([sweep.points, sweep.intensities / 255.0])[rows]
            _write(root / f"velodyne/{index:06d}.bin", table.astype("<f4").tobytes())
        _write(root / "times.txt", "".join(f"{time:.9e}\n" for time in ahead))
        Ts = world.path.at(ahead).Ts_world_body[:, :3].reshape(-1, 12)
        lines = (" ".join(repr(float(x)) for x in row) + "\n" for row in Ts)
        _write(root / "poses_velodyne.txt", "".join(lines))
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{error.filename or root}: cannot be written: {reason}") from error
    return root


def _write(path: Path, content: str | bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, str):
        path.write_text(content, encoding="utf-8", newline="\n")
    else:
        path.write_bytes(content)


def _transform_yaml(T_body_sensor: SE3) -> str:
    numbers = ", ".join(repr(float(x)) for x in T_body_sensor.matrix.ravel())
    return f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{numbers}]\n"


def _camera_yaml(mount: CameraMount) -> str:
    camera = mount.camera
    intrinsics = ", ".join(repr(float(x)) for x in camera.intrinsics)
    distortion = ", ".join(repr(float(x)) for x in camera.distortion) or "0.0, 0.0, 0.0, 0.0"
    return (
        f"sensor_type: camera\ncomment: simulated {mount.name}\n"
        + _transform_yaml(mount.T_body_camera)
        + f"rate_hz: {mount.rate_hz:g}\nresolution: [{camera.width}, {camera.height}]\n"
        "camera_model: pinhole\n"
        f"intrinsics: [{intrinsics}]\n"
        "distortion_model: radial-tangential\n"
        f"distortion_coefficients: [{distortion}]\n"
    )


def _imu_yaml(mount: ImuMount) -> str:
    return (
        "sensor_type: imu\ncomment: simulated\n"
        + _transform_yaml(mount.T_body_imu)
        + f"rate_hz: {mount.rate_hz:g}\n"
        f"gyroscope_noise_density: {mount.gyro_noise!r}\n"
        f"gyroscope_random_walk: {mount.gyro_walk!r}\n"
        f"accelerometer_noise_density: {mount.accel_noise!r}\n"
        f"accelerometer_random_walk: {mount.accel_walk!r}\n"
    )


def _imu_csv(samples: list[ImuSamples]) -> str:
    rows = [IMU_HEADER]
    for part in samples:
        for stamp, gyro, accel in zip(part.stamps_ns, part.gyro, part.accel, strict=True):
            numbers = ",".join(repr(float(x)) for x in np.concatenate([gyro, accel]))
            rows.append(f"{stamp},{numbers}\n")
    return "".join(rows)


def _truth_csv(world: World) -> str:
    rows = [TRUTH_HEADER]
    truth = world.truth
    for stamp, T in zip(truth.stamps_ns, truth.Ts_world_body, strict=True):
        pose = SE3(T)
        numbers = ",".join(repr(float(x)) for x in np.concatenate([pose.t, pose.quaternion]))
        rows.append(f"{stamp},{numbers}\n")
    return "".join(rows)
