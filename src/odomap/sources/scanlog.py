"""From the lines of a laser's log to a source: beams, angles, mount, what the wheels said.

All kinds of text logs hold the same: numbers for beams, poses, stamps. Their readers fill a table
row by row, and `log_of` makes of it what a `LaserLog` is. A row that cannot be used costs itself
and says why: one that ends early, or that has not as many beams as most.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError, InputError
from odomap.geometry.pose import SE3
from odomap.sensors.rig import LidarMount, Rig
from odomap.sensors.sync import parse_stamp
from odomap.sources.scans import TOP, Beams, mark, no_return, ordered_rows, planar
from odomap.sources.source import Skipped

__all__ = ["Table", "half_plane", "log_of", "mounted", "rate_of"]

HALF_PLANE = (180, 181, 360, 361, 720, 721)
"""Usual numbers of beams over 180 degrees."""
FARTHEST_M = 1e9
"""Farther from its origin no robot is."""
NOMINAL_S = 0.1
"""How far apart scans without stamps are taken to be."""


@dataclass
class Table:
    """Rows of a log.

    Attributes:
        path: the file.
        kind: what its lines begin with.
        left_out: what could not be used.
        numbers: line of each row.
        ranges: beams of each row, metres.
        poses: laser's and body's x, y, heading of each row (6 values), or the body's alone (3).
        tails: cells after them: stamp, host, logged.
        angles: first angle, field of view, step (radians) and largest range of a row, or nothing.
        stamps_ns: (rows,) once they are read.
    """

    path: Path
    kind: str
    left_out: list[Skipped] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    ranges: list[NDArray[np.float32]] = field(default_factory=list)
    poses: list[list[float]] = field(default_factory=list)
    tails: list[tuple[str, ...]] = field(default_factory=list)
    angles: list[tuple[float, ...]] = field(default_factory=list)
    stamps_ns: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))

    def __len__(self) -> int:
        return len(self.numbers)

    def add(
        self, number: int, ranges: Sequence[float], poses: list[float],
        tail: tuple[str, ...] = (), angles: tuple[float, ...] = (),
    ) -> None:  # fmt: skip
        """Add a row; one whose poses are not numbers is left out."""
        if not np.all(np.abs(poses) < FARTHEST_M):
            self.skip(number, "its pose is not finite, or farther away than any can be")
            return
        self.numbers.append(number)
        with np.errstate(over="ignore"):
            self.ranges.append(np.array(ranges, np.float32))
        self.poses.append(poses)
        self.tails.append(tail)
        self.angles.append(angles)

    def name(self, number: int) -> str:
        """Return what to call a line."""
        return f"{self.path.name}:{number}"

    def skip(self, number: int, reason: str) -> None:
        """Leave a line out."""
        self.left_out.append(Skipped(0, self.name(number), f"{self.kind}: {reason}"))

    def keep(self, rows: Sequence[int]) -> None:
        """Keep some rows only, in the given order."""
        for name in ("numbers", "ranges", "poses", "tails", "angles"):
            column = getattr(self, name)
            setattr(self, name, [column[row] for row in rows])
        if len(self.stamps_ns):
            self.stamps_ns = self.stamps_ns[list(rows)]

    def close(self, is_whole: bool) -> None:
        """Leave out a last row that may be cut, and rows with another number of beams than most.

        Args:
            is_whole: whether the last line of the file ended in a newline.
        """
        if not is_whole and len(self) > 1 and len(self.tails[-1]) and not all(self.tails[-1]):
            self.skip(self.numbers[-1], "is cut in its stamp")
            self.keep(range(len(self) - 1))
        if not len(self):
            return
        count = Counter(len(row) for row in self.ranges).most_common(1)[0][0]
        usual = Counter(self.angles).most_common(1)[0][0]
        kept = []
        for row, ranges in enumerate(self.ranges):
            if len(ranges) != count:
                self.skip(self.numbers[row], f"{len(ranges)} beams where others have {count}")
            elif self.angles[row] != usual:
                self.skip(self.numbers[row], "its angles are not those of the others")
            else:
                kept.append(row)
        if len(kept) < len(self):
            self.keep(kept)

    def take_stamps(self, texts: Sequence[str]) -> bool:
        """Set the stamps, and leave out rows without one, unless they tell no scans apart."""
        stamps, valid = np.zeros(len(texts), np.int64), np.zeros(len(texts), np.bool_)
        for row, text in enumerate(texts):
            try:
                stamps[row], valid[row] = parse_stamp(text), True
            except ValueError:
                continue
        if 2 * len(np.unique(stamps[valid])) <= len(self):
            return False
        self.stamps_ns = stamps
        for row in np.flatnonzero(~valid).tolist():
            self.skip(self.numbers[row], f"stamp '{texts[row]}' is not a number")
        if not valid.all():
            self.keep(np.flatnonzero(valid).tolist())
        return True

    def number(self, notes: list[str]) -> None:
        """Set stamps that count the scans."""
        self.stamps_ns = np.arange(len(self), dtype=np.int64) * round(1e9 * NOMINAL_S)
        notes.append(f"scans have no stamps: they are taken to be {NOMINAL_S:g} s apart")


def half_plane(count: int, notes: list[str]) -> tuple[float, float, int]:
    """Return the angles of a laser that sees the half plane ahead.

    Args:
        count: of beams: an odd one has a beam at both ends, of an even one the last is missing.
        notes: gets a doubt.
    """
    if count not in HALF_PLANE:
        notes.append(
            f"{count} beams are taken to go over 180 degrees: if not, give ?fov_deg= or a rig.yaml"
        )
    step = np.pi / max(count - count % 2, 1)
    return -np.pi / 2, -np.pi / 2 + (count - 1) * step, count


def _angles(table: Table, options: Mapping[str, str], notes: list[str]) -> tuple[float, float, int]:
    """Return first angle, last angle and number of the beams."""
    count, said = len(table.ranges[0]), table.angles[0]
    if "fov_deg" in options:
        half = np.radians(_number(table.path, options, "fov_deg", 180.0)) / 2
        if half > np.pi:
            raise InputError(f"{table.path}: fov_deg: {options['fov_deg']} is more than 360")
        return -half, half, count
    if not said:
        return half_plane(count, notes)
    first, view, step = said[:3]
    if step > 0:
        last = first + step * (count - 1)
        if abs(step * (count - 1) - view) > 1.5 * step:
            notes.append(
                f"{count} beams {np.degrees(step):g} degrees apart are not the "
                f"{np.degrees(view):g} degrees it says: its step is believed"
            )
    else:
        last = first + view
    return first, last, count


def mounted(mount: LidarMount, rig: Rig | None, where: Path) -> Rig:
    """Return the rig of one laser: what a recording says of it, or what a given rig does.

    Args:
        mount: what the recording says.
        rig: a rig with one LiDAR, or None.
        where: the recording.

    Raises:
        CalibrationError: the rig has not one LiDAR, or one with another number of beams.
    """
    if rig is None:
        return Rig(lidars=(mount,))
    if len(rig.lidars) != 1:
        raise CalibrationError(
            f"{where}: is of one laser, but the rig has {len(rig.lidars)} LiDARs: list that one"
        )
    given = rig.lidars[0]
    beams, count = given.angles[2], mount.angles[2]
    if beams not in (0, count):
        raise CalibrationError(
            f"{where}: scans have {count} beams, the rig says {beams}: mend 'angles'"
        )
    return Rig(lidars=(given if beams else replace(given, angles=mount.angles),))


def log_of(
    path: Path, table: Table, mount: SE3, rig: Rig | None, options: Mapping[str, str],
    notes: list[str], left_out: list[Skipped],
) -> dict[str, Any]:  # fmt: skip
    """Return what a `LaserLog` is made of.

    Args:
        path: the file.
        table: its rows, with stamps.
        mount: T_body_lidar.
        rig: to use instead, or None.
        options: order, odometry, fov_deg, no_return_m.
        notes: what was found odd.
        left_out: what was left out while reading; rows left out since are in the table.
    """
    names = [table.name(number) for number in table.numbers]
    order = options.get("order", "log")
    try:
        rows = ordered_rows(table.stamps_ns, order, names, left_out, notes).tolist()
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    angles = _angles(table, options, notes)
    left_out += [item for item in table.left_out if item not in left_out]
    table.keep(rows)
    ranges = np.stack(table.ranges)
    farthest = _number(path, options, "no_return_m", no_return(ranges))
    if len(table.angles[0]) > 3 and 0 < table.angles[0][3] < farthest:
        farthest = table.angles[0][3]
    mark(ranges, 0.0, (1 - TOP) * farthest)
    beams = Beams.of(ranges, farthest)
    reach = farthest if np.isfinite(farthest) else _largest(ranges)
    laser = LidarMount("laser", mount, (0.0, reach), rate_of(table.stamps_ns), "none", angles)
    odometry: NDArray[np.float64] | None = planar(np.array(table.poses)[:, -3:])
    if options.get("odometry") == "off":
        odometry = None
    elif options.get("odometry", "on") != "on":
        raise InputError(f"{path}: odometry '{options['odometry']}' is none of on, off")
    return {
        "name": path.name,
        "rig": mounted(laser, rig, path),
        "stamps_ns": table.stamps_ns,
        "ranges": ranges,
        "odometry": odometry,
        "beams": beams,
        "left_out": left_out,
        "notes": notes,
        "details": {"messages": table.kind},
    }


def _number(path: Path, options: Mapping[str, str], name: str, default: float) -> float:
    """Return the positive number of an option."""
    try:
        value = float(options.get(name, default))
    except ValueError:
        value = float("nan")
    if not value > 0:
        raise InputError(f"{path}: {name}: '{options[name]}' is no positive number")
    return value


def rate_of(stamps_ns: NDArray[np.int64]) -> float:
    """Return the mean rate; the median step of a jumping clock says little."""
    span = int(stamps_ns.max() - stamps_ns.min())
    return (len(stamps_ns) - 1) / (span * 1e-9) if span else 0.0


def _largest(ranges: NDArray[np.float32]) -> float:
    finite = ranges[np.isfinite(ranges)]
    return float(finite.max()) if finite.size else 1.0
