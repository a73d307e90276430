"""Fields of points: which column of a recording is what, whatever it is called.

Sensors and drivers give columns names of their own. Here x, y, z, time, beam and intensity are
found among them by the usual names; times get their unit from their values (`pointtimes`), and
beams their order from elevations (`pointbeams`). Where recordings use other names, options name
them.

Reference: R. B. Rusu, S. Cousins, "3D is here: Point Cloud Library (PCL)", ICRA 2011.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError, nearest_name
from odomap.files.pointtable import PointTable
from odomap.sensors.sweep import Sweep
from odomap.sources.pointbeams import PointBeams, beams_of
from odomap.sources.pointtimes import PointTimes, times_of

__all__ = ["OPTIONS", "PointFields", "recognised"]

Array = NDArray[np.float64]

TIME = (
    *("t", "time", "times", "timestamp", "time_stamp", "offset_time", "time_offset", "offsettime"),
    *("gps_time", "gpstime", "point_time", "timestamp_offset", "relative_time", "stamp"),
)
RING = ("ring", "channel", "laser_id", "laserid", "laser", "beam", "line", "scan_line", "ring_id")
INTENSITY = (
    *("intensity", "intensities", "i", "reflectivity", "reflectance", "remission", "signal"),
    "scalar_intensity",
)
OPTIONS = ("time", "unit", "ring")
FARTHEST_M = 1e7
"""No point is farther, also where coordinates are those of a map."""


@dataclass(frozen=True, eq=False)
class PointFields:
    """What the columns of a recording are.

    Attributes:
        time: name of the column of times, empty if there is none.
        times: what it counts, None if it says nothing.
        intensity: name of the column of intensities, or empty.
        beams: tells them apart, None if nothing does.
    """

    time: str = ""
    times: PointTimes | None = None
    intensity: str = ""
    beams: PointBeams | None = None

    @property
    def times_how(self) -> str:
        """How it is known when a point was measured, or nothing."""
        return "" if self.times is None else f"from '{self.time}', {self.times}"

    @property
    def num_beams(self) -> tuple[int, str]:
        """How many beams there are, 0 if not known, and how they are known."""
        return (0, "") if self.beams is None else (self.beams.count, self.beams.how)

    def sweep(self, table: PointTable, stamp_ns: int) -> Sweep:
        """Return the points of a table as a sweep; without times where its own cannot be."""
        points = points_of_table(table)
        times = None
        if self.times is not None and self.time in table.columns:
            raw = table.columns[self.time]
            seen = _seen(points)
            if raw.dtype.kind == "f":
                seen &= np.isfinite(raw)
            times = self.times.seconds(raw, stamp_ns, seen)
        strength = table.columns.get(self.intensity) if self.intensity else None
        with np.errstate(invalid="ignore", over="ignore"):
            intensities = None if strength is None else strength.astype(np.float32)
        return Sweep(
            points,
            times,
            intensities,
            None if self.beams is None else self.beams.of(table, points),
        )


def points_of_table(table: PointTable) -> Array:
    """Return (N, 3) points of a table; places that cannot be are NaN."""
    points = np.empty((table.count, 3))
    lost = np.zeros(table.count, np.bool_)
    with np.errstate(invalid="ignore", over="ignore"):  # bytes that were damaged are any number
        for k, axis in enumerate("xyz"):
            points[:, k] = column = table.columns[_xyz(table, axis)].astype(np.float64)
            lost |= ~(np.abs(column) < FARTHEST_M)
    points[lost] = np.nan
    return points


def _xyz(table: PointTable, axis: str) -> str:
    return axis.upper() if axis.upper() in table.columns else axis


def _seen(points: Array) -> NDArray[np.bool_]:
    x, y, z = points.T
    return np.asarray((x * x + y * y + z * z) > 0)  # not so of NaN


def recognised(
    where: Path, tables: Sequence[PointTable], stamps_ns: Sequence[int], step_s: float,
    options: Mapping[str, str],
) -> PointFields:  # fmt: skip
    """Find out what the columns of a recording are.

    Args:
        where: the recording, for messages.
        tables: some of its sweeps.
        stamps_ns: their stamps.
        step_s: usual time from sweep to sweep; 0 when unknown.
        options: time and ring (names of columns, or "off"), unit (of times).

    Raises:
        InputError: there is no x, y, z, a column that is asked for is not there, or times are in
            no unit.
    """
    if not tables:
        return PointFields()
    usual = Counter(tuple(table.columns) for table in tables).most_common(1)[0][0]
    like = [k for k, table in enumerate(tables) if tuple(table.columns) == usual]
    tables, stamps_ns = [tables[k] for k in like], [stamps_ns[k] for k in like]
    names = list(usual)
    missing = [axis for axis in "xyz" if _xyz(tables[0], axis) not in names]
    if missing:
        has = ", ".join(names) or "nothing"
        raise InputError(f"{where}: points have no '{missing[0]}', but {has}")
    if options.get("unit", "s") not in ("s", "ms", "us", "ns"):
        raise InputError(f"{where}: unit: '{options['unit']}' is none of s, ms, us, ns")
    time = _chosen(where, names, TIME, options.get("time", ""), "time")
    ring = _chosen(where, names, RING, options.get("ring", ""), "ring")
    clouds = [points_of_table(table) for table in tables]
    seen = [_seen(points) for points in clouds]
    times = None
    if time:
        columns = [t.columns[time][s] for t, s in zip(tables, seen, strict=True)]
        try:
            times = times_of(time, columns, stamps_ns, step_s, options.get("unit", ""))
        except InputError as error:
            raise InputError(f"{where}: {error}") from error
    intensity = _chosen(where, names, INTENSITY, "", "")
    beams = None
    if options.get("ring") != "off":
        beams = beams_of(tables, clouds, seen, ring)
    return PointFields(time, times, intensity, beams)


def _chosen(where: Path, names: Sequence[str], usual: Sequence[str], asked: str, what: str) -> str:
    """Return the name of a column that is asked for, or of the first usual one, or nothing."""
    if asked == "off":
        return ""
    if asked:
        if asked not in names:
            raise InputError(
                f"{where}: {what}: points have no '{asked}'{nearest_name(asked, names)}; they "
                f"have: {', '.join(names)}"
            )
        return asked
    lower = {name.lower(): name for name in reversed(names)}
    return next((lower[name] for name in usual if name in lower), "")
