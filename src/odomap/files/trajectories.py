"""Trajectories as text: TUM, KITTI and EuRoC, stamps exact to the nanosecond.

Three layouts of the same thing, one pose T_world_body per row:

    TUM     time tx ty tz qx qy qz qw            seconds, metres, '#' comments
    KITTI   r11 r12 r13 tx r21 ... r33 tz        no times: they stand in a times.txt beside it
    EuRoC   stamp, px, py, pz, qw, qx, qy, qz, ...   integer nanoseconds, csv

Quaternions are w x y z in memory and are reordered here and nowhere else. A stamp goes from its
decimal text to integer nanoseconds and back without a float between, so what was written
associates with its images exactly. The same trajectory gives the same bytes, gzipped or not.
Reading accepts gzip, rows out of order (sorted) and repeated stamps (1 ns later each); a broken
row is an error that names its line.

Reference: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012;
A. Geiger, P. Lenz, R. Urtasun, "Are we ready for autonomous driving?", CVPR 2012.
"""

import gzip
import io
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.files.atomic import write_bytes
from odomap.files.text import Table, read_lines, read_table
from odomap.geometry.lie import orthonormalize, quaternion_from_rotation, rotation_from_quaternion
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.sync import format_stamp, read_stamps

__all__ = [
    "read_euroc",
    "read_kitti_poses",
    "read_times",
    "read_trajectory",
    "read_tum",
    "write_euroc",
    "write_kitti",
    "write_tum",
]

QUATERNION_TOLERANCE = 0.1
"""A row whose quaternion is this far from unit length holds something else."""
ROTATION_TOLERANCE = 1e-2
"""A KITTI row whose 3x3 block is this far from a rotation holds something else."""


def read_tum(path: str | Path) -> Trajectory:
    """Read `time tx ty tz qx qy qz qw` rows.

    Args:
        path: the file, plain or gzipped. Columns after the eighth are an error.

    Returns:
        T_world_body by stamp.

    Raises:
        InputError: names the file and line of what is wrong.
    """
    file = Path(path)
    table = read_table(file, 8, has_stamp=True)
    order = [0, 1, 2, 6, 3, 4, 5]
    return _stamped(file, table, table.values[:, order], "s")


def read_euroc(path: str | Path) -> Trajectory:
    """Read EuRoC ground truth: `stamp [ns], p x y z, q w x y z`, further columns ignored.

    Args:
        path: the csv file, plain or gzipped.

    Raises:
        InputError: names the file and line of what is wrong.
    """
    file = Path(path)
    table = read_table(file, 8, has_stamp=True, exact=False)
    return _stamped(file, table, table.values, "ns")


def read_kitti_poses(
    path: str | Path, times: str | Path | NDArray[np.int64] | None = None
) -> Trajectory:
    """Read KITTI rows: the upper 3x4 of T_world_camera, row by row.

    Args:
        path: the file of poses.
        times: file of times in seconds, or (N,) stamps in nanoseconds; without them rows are 0.1 s
            apart, KITTI's rate. If there are more times than poses, the first ones count.

    Raises:
        InputError: a row is broken, or there are fewer times than poses.
    """
    file = Path(path)
    table = read_table(file, 12, has_stamp=False)
    _need_rows(file, table)
    Ts = np.tile(np.eye(4), (len(table), 1, 1))
    Ts[:, :3] = table.values.reshape(-1, 3, 4)
    R = Ts[:, :3, :3]
    error = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2))
    bad = (error > ROTATION_TOLERANCE) | (np.linalg.det(R) < 0)
    if bad.any():
        line = table.lines[int(np.argmax(bad))]
        raise InputError(f"{file}:{line}: the 3x3 block is no rotation: are these KITTI poses?")
    Ts[:, :3, :3] = orthonormalize(R)
    if times is None:
        stamps = np.arange(len(table), dtype=np.int64) * 100_000_000
    elif isinstance(times, np.ndarray):
        stamps = times
    else:
        stamps = read_times(times)
    if len(stamps) < len(table):
        raise InputError(f"{file}: {len(table)} poses but only {len(stamps)} times")
    return _ordered(np.asarray(stamps[: len(table)], np.int64), Ts)


def read_times(path: str | Path) -> NDArray[np.int64]:
    """Read a times.txt: one time in seconds per row, to integer nanoseconds, in file order.

    Raises:
        InputError: a row is not a number.
    """
    file = Path(path)
    rows = [(number, cells[0]) for number, cells in read_lines(file)]
    column = read_stamps([text for _, text in rows], "s")
    if not column.valid.all():
        number, text = rows[int(np.argmin(column.valid))]
        raise InputError(f"{file}:{number}: time '{text}' is not a number of seconds")
    return column.stamps_ns


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory in whichever of the three layouts it is.

    Args:
        path: TUM (8 columns), KITTI (12 columns; a times.txt beside it is used), or EuRoC csv.

    Raises:
        InputError: it is none of them, or broken.
    """
    file = Path(path)
    number, cells = next(read_lines(file), (0, []))
    if not cells:
        raise InputError(f"{file}: no poses: the file is empty")
    is_csv = ".csv" in [suffix.lower() for suffix in file.suffixes]
    if len(cells) == 12 and not is_csv:
        times = file.with_name("times.txt")
        return read_kitti_poses(file, times if times.exists() else None)
    if is_csv or len(cells) == 17:
        return read_euroc(file)
    if len(cells) == 8:
        return read_tum(file)
    raise InputError(
        f"{file}:{number}: {len(cells)} numbers in a row: "
        "expected 8 (TUM: time tx ty tz qx qy qz qw) or 12 (KITTI: 3x4 matrix)"
    )


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write `time tx ty tz qx qy qz qw` rows, nine places; the same poses give the same bytes.

    Args:
        path: the file; gzipped if it ends in `.gz`.
        trajectory: T_world_body by stamp.

    Raises:
        OutputError: it cannot be written.
    """
    rows = np.column_stack([trajectory.Ts_world_body[:, :3, 3], _xyzw(trajectory)])
    lines = (
        f"{format_stamp(int(stamp))} {_decimals(row)}"
        for stamp, row in zip(trajectory.stamps_ns, rows, strict=True)
    )
    _write_lines(Path(path), "# time tx ty tz qx qy qz qw", lines)


def write_kitti(path: str | Path, trajectory: Trajectory) -> None:
    """Write KITTI rows (12 numbers, no times).

    Raises:
        OutputError: it cannot be written.
    """
    rows = trajectory.Ts_world_body[:, :3].reshape(-1, 12) + 0.0
    lines = (" ".join(f"{value:.9e}" for value in row) for row in rows)
    _write_lines(Path(path), "", lines)


def write_euroc(path: str | Path, trajectory: Trajectory) -> None:
    """Write EuRoC csv rows: `stamp [ns],px,py,pz,qw,qx,qy,qz`.

    Raises:
        OutputError: it cannot be written.
    """
    wxyz = np.roll(_xyzw(trajectory), 1, axis=1)
    rows = np.column_stack([trajectory.Ts_world_body[:, :3, 3], wxyz])
    lines = (
        f"{int(stamp)},{_decimals(row).replace(' ', ',')}"
        for stamp, row in zip(trajectory.stamps_ns, rows, strict=True)
    )
    position = ",".join(f"p_RS_R_{axis} [m]" for axis in "xyz")
    header = f"#timestamp [ns],{position},q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
    _write_lines(Path(path), header, lines)


def _stamped(file: Path, table: Table, rows: NDArray[np.float64], unit: str) -> Trajectory:
    """Make a trajectory of rows `t (3), q wxyz (4)` with stamps as text."""
    _need_rows(file, table)
    stamps = read_stamps(table.stamps, unit)
    if not stamps.valid.all():
        row = int(np.argmin(stamps.valid))
        raise InputError(f"{file}:{table.lines[row]}: stamp '{table.stamps[row]}' is not a number")
    lengths = np.linalg.norm(rows[:, 3:], axis=1)
    bad = np.abs(lengths - 1.0) > QUATERNION_TOLERANCE
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(
            f"{file}:{table.lines[row]}: quaternion of length {lengths[row]:.3g}: "
            "are the columns in the right order?"
        )
    Ts = np.tile(np.eye(4), (len(rows), 1, 1))
    Ts[:, :3, :3] = rotation_from_quaternion(rows[:, 3:])
    Ts[:, :3, 3] = rows[:, :3]
    return _ordered(stamps.stamps_ns, Ts)


def _ordered(stamps_ns: NDArray[np.int64], Ts: NDArray[np.float64]) -> Trajectory:
    """Sort by time; a repeated stamp moves on by a nanosecond: no pose of a file is lost."""
    order = np.argsort(stamps_ns, kind="stable")
    stamps = stamps_ns[order] - np.arange(len(order))
    stamps = np.maximum.accumulate(stamps) + np.arange(len(order))
    return Trajectory(stamps, Ts[order])


def _need_rows(file: Path, table: Table) -> None:
    if len(table) == 0:
        raise InputError(f"{file}: no poses: the file is empty")


def _xyzw(trajectory: Trajectory) -> NDArray[np.float64]:
    wxyz = quaternion_from_rotation(trajectory.Ts_world_body[:, :3, :3])
    return np.asarray(np.roll(wxyz, -1, axis=-1))


def _decimals(row: Iterable[float]) -> str:
    # Rounding before adding 0.0 turns -0.0000000001 into 0.000000000, without a sign.
    return " ".join(f"{round(float(value), 9) + 0.0:.9f}" for value in row)


def _write_lines(path: Path, header: str, lines: Iterable[str]) -> None:
    text = "".join(f"{line}\n" for line in ([header] if header else []))
    data = (text + "".join(f"{line}\n" for line in lines)).encode("ascii")
    if path.suffix == ".gz":
        packed = io.BytesIO()
        # No name and no time in the header: the same trajectory gives the same bytes.
        with gzip.GzipFile(filename="", mode="wb", fileobj=packed, mtime=0) as file:
            file.write(data)
        data = packed.getvalue()
    write_bytes(path, data)
