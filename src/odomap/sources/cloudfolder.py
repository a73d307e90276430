"""Folders of clouds: one file per sweep, PCD, PLY, LAS or NPY.

    clouds/1403636584.763.pcd ...       stamps are the names (s, ms, µs, ns), or else
    times.txt or timestamps.txt         one time per file, or name and time; or else the rate
    groundtruth.txt                     optional: T_world_body, TUM text
    rig.yaml                            optional: mount, range, beams, how it turns

Files may lie in the folder or in one below it, such as pcd/. What the columns of a file are is
found out by their names and values (`pointfields`); a cloud alone is a recording of one sweep.
Where no column says times and the rig says how the LiDAR turns, a sweep is taken to begin at its
first point and to be stamped then.

Reference: R. B. Rusu, S. Cousins, "3D is here: Point Cloud Library (PCL)", ICRA 2011.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError, MissingExtra
from odomap.files.clouds import read_ply_points
from odomap.files.pcd import read_pcd
from odomap.files.pointtable import PointTable, read_las, read_npy
from odomap.files.trajectories import read_tum
from odomap.geometry.trajectory import Trajectory
from odomap.lidar.rings import azimuths
from odomap.lidar.turning import turn_times
from odomap.sensors.rig import LidarMount, Rig
from odomap.sensors.sweep import Sweep
from odomap.sources.filenames import Clock, in_order, stamp_names
from odomap.sources.options import check_options
from odomap.sources.pointfields import OPTIONS, recognised
from odomap.sources.recording import check_truth
from odomap.sources.source import Skipped, UnusableFrame
from odomap.sources.survey import FAR_M, NEAR_M, mounted_sweeps, sample, survey
from odomap.sources.sweepfolders import cloud_folder, is_cloud
from odomap.sources.sweeplog import SweepLog, usual_rate

__all__ = ["CloudSource"]

READERS: Mapping[str, Callable[[Path], PointTable]] = MappingProxyType(
    {
        ".pcd": read_pcd,
        ".ply": read_ply_points,
        ".npy": read_npy,
        ".las": read_las,
        ".laz": read_las,
    }
)
TIMES = ("times.txt", "timestamps.txt")
RATE_HZ = 10.0


class CloudSource(SweepLog):
    """Clouds in a folder as a source of frames."""

    def __init__(
        self, path: str | Path, rig: Rig | None = None, options: Mapping[str, str] | None = None
    ) -> None:
        """Open a folder, or one cloud.

        Args:
            path: the folder, or a file.
            rig: its one LiDAR is used for mount and range.
            options: time, ring (names of columns, or "off"), unit (of times: s, ms, us, ns).

        Raises:
            MissingExtra: files are LAS, and laspy is not installed.
            InputError: there are no clouds, or their columns cannot be what they are called.
            CalibrationError: the rig is for another LiDAR.
        """
        path, options = Path(path), dict(options or {})
        check_options(path, options, OPTIONS)
        folder, names, left_out = _files(path)
        notes: list[str] = []
        given = None if rig is None or not rig.lidars else rig.lidars[0]
        clock = Clock(
            _times_file(folder), RATE_HZ if given is None else given.rate_hz, folder, "sweeps"
        )
        rows, stamps = stamp_names(names, clock, left_out, notes) if len(names) > 1 else (
            [0], np.zeros(1, np.int64))  # fmt: skip
        self._files = [folder / names[row] for row in rows]
        self._stamps = stamps
        rate = usual_rate(stamps, clock.rate_hz)
        chosen = sample(len(stamps), lambda index: (index, self._table(index)))
        if not chosen:
            self._table(0)
        step = 1 / rate if len(stamps) > 1 else 0.0
        samples = [(index, table) for index, table in chosen if table.count]
        self._fields = recognised(
            path,
            [table for _, table in samples],
            [int(stamps[i]) for i, _ in samples],
            step,
            options,
        )
        fields = self._fields
        if fields.time and fields.times is None and samples:
            notes.append(
                f"'{fields.time}' is the same for all points of a sweep: they have no times"
            )
        turns = "none" if given is None else given.sweep
        self._turns = turns if fields.times is None and turns != "none" else ""
        self._period = 1 / rate
        how = fields.times_how
        if self._turns:
            how = f"from the azimuth: {self._turns} from the first point, stamped then"
        facts = survey(
            sample(len(samples), lambda k: self._made(*samples[k])),
            how,
            *fields.num_beams,
        )
        mount = LidarMount("lidar", range_m=(NEAR_M, FAR_M), rate_hz=rate, sweep=turns)
        if fields.times is not None:  # nobody needs to know how it turns
            mount = replace(mount, sweep="none")
        super().__init__(
            name=path.resolve().name,
            rig=mounted_sweeps(mount, rig, facts, path),
            stamps_ns=stamps,
            read=lambda index: self._made(index, self._table(index)),
            survey=facts,
            left_out=left_out,
            notes=notes,
        )
        self.truth = _read_truth((path, folder, folder.parent), stamps, notes)

    def _table(self, index: int) -> PointTable:
        file = self._files[index]
        try:
            return READERS[file.suffix.lower()](file)
        except MissingExtra:
            raise
        except InputError as error:
            reason = str(error).removeprefix(f"{file}:").strip()
            raise UnusableFrame(Skipped(int(self._stamps[index]), str(file), reason)) from error

    def _made(self, index: int, table: PointTable) -> Sweep:
        """Return a table as a sweep, with what follows from where its points are."""
        stamp = int(self._stamps[index])
        try:
            sweep = self._fields.sweep(table, stamp)
        except KeyError as error:
            reason = f"points have no {error}, as those of the other files have"
            raise UnusableFrame(Skipped(stamp, str(self._files[index]), reason)) from error
        if self._fields.times is not None and sweep.times is None and table.count:
            reason = f"'{self._fields.time}' is not within this sweep: it has no times"
            skipped = Skipped(stamp, str(self._files[index]), reason)
            known = getattr(self, "skipped", [])
            if skipped not in known:
                known.append(skipped)
        if not self._turns:
            return sweep
        azimuth = azimuths(sweep.points)
        seen = np.flatnonzero(np.square(sweep.points).sum(axis=1) > 0)
        begin = float(azimuth[seen[0]]) if len(seen) else 0.0
        clockwise = self._turns == "clockwise"
        return replace(sweep, times=turn_times(azimuth, self._period, clockwise, begin, begin))


def _files(path: Path) -> tuple[Path, list[str], list[Skipped]]:
    """Return the folder, its clouds of the kind there is most of, and the others."""
    if path.is_file():
        return path.parent, [path.name], []
    folder = cloud_folder(path)
    if folder is None:
        raise InputError(f"{path}: holds no clouds ({', '.join(READERS)})")
    names = in_order(f.name for f in folder.iterdir() if f.is_file() and is_cloud(f))
    kinds = [Path(name).suffix.lower() for name in names]
    most = max(sorted(set(kinds)), key=kinds.count)
    left_out = [
        Skipped(0, str(folder / name), f"is no {most} as most are")
        for name, kind in zip(names, kinds)
        if kind != most
    ]
    return folder, [name for name, kind in zip(names, kinds) if kind == most], left_out


def _times_file(folder: Path) -> Path | None:
    files = (place / name for place in (folder, folder.parent) for name in TIMES)
    return next((file for file in files if file.is_file()), None)


def _read_truth(
    places: tuple[Path, ...], stamps: NDArray[np.int64], notes: list[str]
) -> Trajectory | None:
    file = next((p / "groundtruth.txt" for p in places if (p / "groundtruth.txt").is_file()), None)
    if file is None:
        return None
    try:
        return check_truth(read_tum(file), stamps, file.name, notes)
    except InputError as error:
        notes.append(f"{error}: ground truth ignored")
        return None
