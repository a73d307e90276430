"""Laser logs of two words: `Odometry x y θ` before each `Laser n r1 ... rn`, and no stamps.

The pose is the body's by its wheels when the scan after it was taken. Nothing is said of angles,
which are those of the half plane ahead, nor of the mount, which is taken to be the identity; scans
are taken to be 0.1 s apart. Numbers mean what they do in CARMEN's logs (see `carmen`, `scans`).
"""

from collections.abc import Mapping
from pathlib import Path

from odomap.errors import InputError
from odomap.geometry.pose import SE3
from odomap.sensors.rig import Rig
from odomap.sources.logfiles import LogLines
from odomap.sources.options import check_options
from odomap.sources.scanlog import Table, log_of
from odomap.sources.scans import LaserLog

__all__ = ["WORDS", "PlainLogSource"]

WORDS = frozenset({"Odometry", "Laser"})
OPTIONS = ("odometry", "fov_deg", "no_return_m")


class PlainLogSource(LaserLog):
    """A log of `Odometry` and `Laser` lines as a source of frames."""

    def __init__(
        self, path: str | Path, rig: Rig | None = None, options: Mapping[str, str] | None = None
    ) -> None:
        """Read a log.

        Args:
            path: the file, plain, .gz or .bz2.
            rig: its one LiDAR is used instead of the half plane ahead.
            options: odometry ("off" to leave it out), fov_deg, no_return_m, as of CARMEN logs.

        Raises:
            InputError: it holds no scan that can be read, or an option is unknown.
            CalibrationError: the rig is for another number of beams.
        """
        path, options = Path(path), dict(options or {})
        check_options(path, options, OPTIONS)
        notes: list[str] = []
        table = _read(path, notes)
        if len(table) == 0:
            reason = f": {table.left_out[0].reason}" if table.left_out else ""
            raise InputError(f"{path}: no Laser line can be read{reason}")
        table.number(notes)
        super().__init__(**log_of(path, table, SE3.identity(), rig, options, notes, []))


def _read(path: Path, notes: list[str]) -> Table:
    table = Table(path, "Laser")
    lines = LogLines(path)
    pose: list[float] | None = None
    unknown = 0
    for number, line in lines:
        kind, *cells = line.split() or ["#"]
        try:
            if kind == "Odometry":
                pose = None
                x, y, theta = (float(cell) for cell in cells)
                pose = [x, y, theta]
            elif kind == "Laser":
                _scan(table, number, cells, pose)
                pose = None
            elif not kind.startswith("#"):
                unknown += 1
        except ValueError as error:
            table.skip(number, f"cannot be read ({error})")
    if unknown:
        notes.append(f"{unknown} lines begin with neither Odometry nor Laser: ignored")
    if lines.cut:
        notes.append(lines.cut)
    table.close(lines.is_whole)
    return table


def _scan(table: Table, number: int, cells: list[str], pose: list[float] | None) -> None:
    count = int(cells[0]) if cells else 0
    if count < 1 or len(cells) != count + 1:
        table.skip(number, f"{max(len(cells) - 1, 0)} of {count} beams")
    elif pose is None:
        table.skip(number, "there is no Odometry line before it")
    else:
        table.add(number, [float(cell) for cell in cells[1:]], pose)
