"""Truth of KITTI's raw drives: what their GPS and inertial unit (OXTS) say, for the LiDAR.

    oxts/data/0000000000.txt ...      latitude longitude (degrees) altitude roll pitch yaw ...
    oxts/timestamps.txt               date and time of each
    ../calib_imu_to_velo.txt          R and T of T_velo_imu

Latitude φ and longitude λ become metres by Mercator's projection, true to scale where the drive
begins (φ₀, in radians, r = 6378137 m),

    x = r λ cos φ₀,    y = r cos φ₀ ln tan(π/4 + φ/2),    R = Rz(yaw) Ry(pitch) Rx(roll),

and T_world_velo = T_world_imu T_velo_imu⁻¹; the world begins where the drive does, with z up.

Reference: A. Geiger et al., "Vision meets robotics: the KITTI dataset", Int. J. Robotics Research
32(11), 2013.
"""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.files.text import read_lines
from odomap.geometry.lie import se3_inverse
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.sync import parse_stamp

__all__ = ["epoch_text", "read_oxts"]

Array = NDArray[np.float64]

RADIUS_M = 6_378_137.0
CALIBRATION = "calib_imu_to_velo.txt"


def epoch_text(file: Path, line: int, cells: list[str]) -> str:
    """Return the seconds of a date and a time of day, as text with all its digits.

    Raises:
        InputError: it is neither these nor a number of seconds.
    """
    day, _, fraction = " ".join(cells).partition(".")
    try:
        moment = datetime.strptime(day, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
    except ValueError:
        if len(cells) == 1:  # seconds
            return cells[0]
        raise InputError(f"{file}:{line}: '{' '.join(cells)}' is no date and time") from None
    return f"{int(moment.timestamp())}.{fraction or '0'}"


def read_oxts(drive: Path) -> Trajectory | None:
    """Read the poses of the LiDAR of a raw drive.

    Args:
        drive: its folder.

    Returns:
        T_world_velo, or None if the drive has no oxts.

    Raises:
        InputError: the calibration is missing, or something cannot be read.
    """
    files = sorted((drive / "oxts" / "data").glob("*.txt"))
    times = drive / "oxts" / "timestamps.txt"
    if not files or not times.is_file():
        return None
    stamps = [parse_stamp(epoch_text(times, n, cells)) for n, cells in read_lines(times)]
    count = min(len(stamps), len(files))
    rows = np.array([_row(file) for file in files[:count]])
    T_velo_imu = _calibration(drive)
    known, first = np.unique(np.array(stamps[:count], np.int64), return_index=True)
    return Trajectory(known, (_poses(rows) @ se3_inverse(T_velo_imu))[first])


def _row(file: Path) -> list[float]:
    """Return latitude, longitude, altitude, roll, pitch and yaw of a file."""
    for line, cells in read_lines(file):
        try:
            values = [float(cell) for cell in cells[:6]]
        except ValueError:
            values = []
        if len(values) < 6 or not np.isfinite(values).all():
            raise InputError(f"{file}:{line}: six numbers must come first")
        return values
    raise InputError(f"{file}: is empty")


def _poses(rows: Array) -> Array:
    """Return (N, 4, 4) T_world_imu."""
    latitude, longitude = np.radians(rows[:, 0]), np.radians(rows[:, 1])
    scale = RADIUS_M * np.cos(latitude[0])
    Ts = np.tile(np.eye(4), (len(rows), 1, 1))
    Ts[:, 0, 3] = scale * (longitude - longitude[0])
    y = scale * np.log(np.tan(np.pi / 4 + latitude / 2))
    Ts[:, 1, 3] = y - y[0]
    Ts[:, 2, 3] = rows[:, 2] - rows[0, 2]
    for T, (roll, pitch, yaw) in zip(Ts, rows[:, 3:6]):
        T[:3, :3] = _turn(2, yaw) @ _turn(1, pitch) @ _turn(0, roll)
    return Ts


def _turn(axis: int, angle: float) -> Array:
    R = np.eye(3)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    R[a, a] = R[b, b] = np.cos(angle)
    R[b, a], R[a, b] = np.sin(angle), -np.sin(angle)
    return R


def _calibration(drive: Path) -> Array:
    """Return (4, 4) T_velo_imu."""
    places = (drive, drive.absolute().parent)
    file = next((p / CALIBRATION for p in places if (p / CALIBRATION).is_file()), None)
    if file is None:
        raise InputError(f"{places[1] / CALIBRATION}: missing: it says where the GPS is")
    T = np.eye(4)
    found = {cells[0].rstrip(":"): cells[1:] for _, cells in read_lines(file)}
    try:
        T[:3, :3] = np.array(found["R"], np.float64).reshape(3, 3)
        T[:3, 3] = np.array(found["T"], np.float64)
    except (KeyError, ValueError):
        raise InputError(f"{file}: R must have 9 numbers, T 3") from None
    return T
