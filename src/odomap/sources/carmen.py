"""CARMEN logs: scans of a 2D laser and odometry as text, the form of the classic data sets.

A line is a message; of those of the front laser there are an old and a new kind:

    FLASER n r1 ... rn  x y θ  odom_x odom_y odom_θ  stamp host logged
    ROBOTLASER1 type start fov step farthest accuracy mode n r1 ... rn  m e1 ... em
                x y θ  odom_x odom_y odom_θ  tv rv ... (5)  stamp host logged

`stamp` (the third cell from the end) is when the message was sent, `logged` seconds since the log
began; hand-made relations name scans by the text of `stamp`, so that is the frame's. Host clocks
jump back; the log's order is that of measurement (`scans`).

An FLASER says no angles: they go over the half plane ahead. An odd number of beams has one at each
end, −90° to 90°; of an even one the last is missing, so that 180 beams go from −90° to 89°. (On
Intel Research Lab scans matched so agree with 1,287 hand-made relations up to a turn of 0.09°, and
their turns up to a factor of 1.0005 ± 0.0006; with beams spread from −90° to 90° it is 1.0054.)

`odom` is the body's pose by its wheels, x y θ the laser's: their constant difference is its mount.
Where it is not constant a log was corrected, and the mount is what PARAM says, else the identity.

Reference: M. Montemerlo, N. Roy, S. Thrun, "Perspectives on standardization in mobile robot
programming: the Carnegie Mellon navigation (CARMEN) toolkit", IROS 2003.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.geometry.lie import se3_inverse
from odomap.geometry.pose import SE3
from odomap.sensors.rig import Rig
from odomap.sources.logfiles import LogLines
from odomap.sources.options import check_options
from odomap.sources.scanlog import Table, log_of
from odomap.sources.scans import LaserLog, planar
from odomap.sources.source import Skipped

__all__ = ["MESSAGES", "CarmenSource"]

Array = NDArray[np.float64]

OLD = ("FLASER", "RLASER", "LASER3", "LASER4", "LASER5")
NEW = ("ROBOTLASER1", "ROBOTLASER2", "ROBOTLASER0")
OTHERS = (
    *("ODOM", "PARAM", "SYNC", "TRUEPOS", "RAWLASER1", "RAWLASER2", "RAWLASER3", "RAWLASER4"),
    *("RAWLASER5", "REMISSIONFLASER", "NMEAGGA", "NMEARMC", "MARKER", "GRIDMAP", "IMU"),
)
MESSAGES = frozenset((*OLD, *NEW, *OTHERS))
"""First words of the lines of a log."""
OPTIONS = ("scan", "order", "odometry", "fov_deg", "no_return_m")
FRONT = ("FLASER", "ROBOTLASER1")
TAIL = 3
"""Cells after a message: stamp, host, seconds since the log began."""
STILL = (0.01, 0.01)
"""How far a mount may vary over a log, metres and radians, to be one."""


class CarmenSource(LaserLog):
    """A CARMEN log as a source of frames."""

    def __init__(
        self, path: str | Path, rig: Rig | None = None, options: Mapping[str, str] | None = None
    ) -> None:
        """Read a log.

        Args:
            path: the file, plain, .gz or .bz2.
            rig: its one LiDAR is used instead of what the log says of mount and angles.
            options: scan (which message; default the front laser's), order ("log" or "stamps"),
                odometry ("off" to leave it out), fov_deg (where it is not 180), no_return_m (the
                reading that means that nothing returned; "inf" for none).

        Raises:
            InputError: it holds no scan that can be read, or an option is unknown.
            CalibrationError: the rig is for another number of beams.
        """
        path, options = Path(path), dict(options or {})
        check_options(path, options, OPTIONS)
        kinds = (options["scan"],) if "scan" in options else FRONT
        for kind in kinds:
            if kind not in (*OLD, *NEW):
                raise InputError(f"{path}: scan: '{kind}' is none of {', '.join((*OLD, *NEW))}")
        log = _read(path, kinds)
        table = max(log.tables.values(), key=len)
        if len(table) == 0:
            raise InputError(f"{path}: {_why_empty(log, kinds)}")
        _stamp(table, log.notes)
        mount = _mount(table, log)
        others = {k: n for k, n in log.others.items() if k in (*OLD, *NEW)}
        others |= {k: len(t) for k, t in log.tables.items() if t is not table and len(t)}
        log.notes += [f"{n} {k} scans are of another laser: ?scan={k}" for k, n in others.items()]
        if log.unknown:
            log.notes.append(f"{log.unknown} lines are no messages of CARMEN: ignored")
        super().__init__(**log_of(path, table, mount, rig, options, log.notes, log.left_out))


@dataclass
class _Log:
    """What a log holds, while it is read."""

    tables: dict[str, Table]
    offsets: dict[str, float] = field(default_factory=dict)
    others: Counter[str] = field(default_factory=Counter)
    unknown: int = 0
    notes: list[str] = field(default_factory=list)
    left_out: list[Skipped] = field(default_factory=list)


def _read(path: Path, kinds: tuple[str, ...]) -> _Log:
    log = _Log({kind: Table(path, kind) for kind in kinds})
    lines = LogLines(path)
    for number, line in lines:
        cells = line.split()
        kind = cells[0] if cells else "#"
        if kind in log.tables:
            _scan(log.tables[kind], number, cells)
        elif kind == "PARAM":
            _param(log, cells)
        elif kind in MESSAGES:
            log.others[kind] += 1
        elif not kind.startswith("#"):
            log.unknown += 1
    if lines.cut:
        log.notes.append(lines.cut)
    for table in log.tables.values():
        table.close(lines.is_whole)
        log.left_out += table.left_out
    return log


def _scan(table: Table, number: int, cells: list[str]) -> None:
    """Read the line of a scan; one that cannot be costs itself."""
    try:
        start = 2 if table.kind in OLD else 9
        count = int(cells[start - 1])
        end = start + count
        poses = end
        if table.kind in NEW:
            poses = end + 1 + int(cells[end])
        stop = poses + (6 if table.kind in OLD else 11)
        if count < 1 or len(cells) < stop + 1:
            raise IndexError
        values = [float(cell) for cell in (*cells[start:end], *cells[poses : poses + 6])]
        angles = tuple(float(cell) for cell in cells[2:6]) if table.kind in NEW else ()
    except IndexError:
        table.skip(number, f"ends after {len(cells)} cells")
        return
    except ValueError as error:
        table.skip(number, f"cannot be read ({error})")
        return
    table.add(number, values[:count], values[count:], (*cells[stop:], "", "")[:TAIL], angles)


def _param(log: _Log, cells: list[str]) -> None:
    """Note how far ahead of the body's centre a laser is mounted."""
    name = cells[1].replace("_", "") if len(cells) > 2 else ""
    for kind, word in (("FLASER", "frontlaseroffset"), ("RLASER", "rearlaseroffset")):
        if name.endswith(word):
            try:
                log.offsets[kind] = float(cells[2])
            except ValueError:
                log.notes.append(f"PARAM {cells[1]}: '{cells[2]}' is not a number: ignored")


def _stamp(table: Table, notes: list[str]) -> None:
    """Read the stamps: when a message was sent, or else when it was logged."""
    if table.take_stamps([tail[0] for tail in table.tails]):
        return
    if table.take_stamps([tail[2] for tail in table.tails]):
        notes.append("stamps tell no scans apart: the times of logging are taken")
        return
    table.number(notes)


def _mount(table: Table, log: _Log) -> SE3:
    """Return T_body_lidar: how laser and body differ, if they do so all along."""
    poses = np.array(table.poses)
    Ts_world_lidar, Ts_world_body = planar(poses[:, :3]), planar(poses[:, 3:])
    between = se3_inverse(Ts_world_body) @ Ts_world_lidar
    median = np.median(between, axis=0)
    turn = float(np.arctan2(median[1, 0], median[0, 0]))
    T = planar(np.array([[median[0, 3], median[1, 3], turn]]))[0]
    off = se3_inverse(T) @ between
    ahead = log.offsets.get("FLASER" if table.kind in FRONT else table.kind, 0.0)
    shift = float(np.abs(off[:, :2, 3]).max())
    if shift > STILL[0] or float(np.abs(off[:, 1, 0]).max()) > STILL[1]:
        log.notes.append(
            "poses of laser and wheels part, as in a corrected log: the laser is taken to be "
            f"{ahead:g} m ahead of the body's centre"
        )
        T = planar(np.array([[ahead, 0.0, 0.0]]))[0]
    elif np.allclose(T, np.eye(4), atol=1e-6):
        T = planar(np.array([[ahead, 0.0, 0.0]]))[0]
    return SE3(T)


def _why_empty(log: _Log, kinds: tuple[str, ...]) -> str:
    if log.left_out:
        first = log.left_out[0]
        return f"no scan can be read: {first.file.rpartition(':')[2]}: {first.reason}"
    found = [kind for kind in log.others if kind in (*OLD, *NEW)]
    if found:
        return f"holds no {' or '.join(kinds)}, but {found[0]}: open it with ?scan={found[0]}"
    return f"holds no scans ({' or '.join(kinds)} lines)" + (
        f"; {log.notes[0]}" if log.notes else ""
    )
