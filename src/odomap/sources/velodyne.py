"""Sweeps of KITTI: a folder of .bin files, x y z intensity of each point as float32.

    velodyne/000000.bin ...            times.txt (seconds), poses.txt and calib.txt (odometry)
    velodyne_points/data/*.bin         velodyne_points/timestamps*.txt (a raw drive)

The sensor, an HDL-64E at 10 Hz, turns clockwise, begins a sweep behind and is stamped when it looks
ahead, so that times go from -0.05 to 0.05 s and follow from the azimuth (`lidar/turning`). In the
files of drive 0013, at 11 m/s, surfaces across the way that are seen to the left and to the right
from places 7 m apart disagree by 2 mm then; by 45 mm without times, by 84 mm with the other turn,
and by 13 mm if sweeps began ahead. Rows are sorted by beam, highest first (`lidar/rings`).

The sweeps of the odometry benchmark had the motion taken out, those of raw drives did not, and
their files are the same. One sees it behind, where a sweep begins and ends: the ground goes through
there in raw sweeps, and steps by the distance driven meanwhile in compensated ones. Those get no
times.

Truth is poses_velodyne.txt (of the LiDAR), groundtruth.txt (TUM, of the LiDAR), poses.txt (of the
camera, brought over by Tr of calib.txt), or what a raw drive's GPS says (`oxts`).

Reference: A. Geiger et al., "Vision meets robotics: the KITTI dataset", Int. J. Robotics Research
32(11), 2013.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.files.text import read_lines
from odomap.files.trajectories import read_kitti_poses, read_tum
from odomap.geometry.lie import se3_inverse
from odomap.geometry.trajectory import Trajectory
from odomap.lidar.rings import azimuths, rings_of
from odomap.lidar.turning import turn_times
from odomap.sensors.rig import LidarMount, Rig
from odomap.sensors.sweep import Sweep
from odomap.sources.filenames import Clock, in_order, stamp_names
from odomap.sources.listing import list_rows
from odomap.sources.options import check_options
from odomap.sources.oxts import epoch_text, read_oxts
from odomap.sources.pointfields import FARTHEST_M
from odomap.sources.recording import check_truth
from odomap.sources.source import Skipped, UnusableFrame
from odomap.sources.survey import FAR_M, mounted_sweeps, sample, survey
from odomap.sources.sweepfolders import is_sweep, velodyne_folder
from odomap.sources.sweeplog import SweepLog, usual_rate

__all__ = ["VelodyneSource"]

Array = NDArray[np.float64]

COLUMNS = 4
ROW_BYTES = 4 * COLUMNS
RATE_HZ = 10.0
BEHIND = np.pi
HOUSING_M = 1.0
"""What is nearer is the sensor or its car."""
SEAM = np.radians(1.5)
"""Two rows of a ring so near to each other, behind, see the same ground."""
STEP_M, FEWEST_RINGS, SHARE = 0.1, 10, 0.2
"""A step behind of so much, in so many rings of so many of the sweeps, is no accident."""
BEAMS = (60, 66)
"""So many beams may be seen of an HDL-64E."""
TIMES = ("auto", "azimuth", "off")


class VelodyneSource(SweepLog):
    """Sweeps of KITTI as a source of frames."""

    def __init__(
        self, path: str | Path, rig: Rig | None = None, options: Mapping[str, str] | None = None
    ) -> None:
        """Open a recording.

        Args:
            path: the folder of the sequence or the drive, or that of the .bin files.
            rig: its one LiDAR is used for mount and range.
            options: times: "azimuth" for raw sweeps, "off" for motion-compensated ones, "auto" to
                find out.

        Raises:
            InputError: there are no sweeps, or none that can be read.
            CalibrationError: the rig is for another LiDAR.
        """
        path, options = Path(path), dict(options or {})
        check_options(path, options, ("times",))
        how = options.get("times", "auto")
        if how not in TIMES:
            raise InputError(f"{path}: times: '{how}' is none of {', '.join(TIMES)}")
        folder = velodyne_folder(path)
        if folder is None:
            raise InputError(f"{path}: holds no sweeps (velodyne/*.bin)")
        root = _root(folder)
        notes: list[str] = []
        left_out: list[Skipped] = []
        names = in_order(f.name for f in folder.iterdir() if is_sweep(f))
        rows, stamps = _stamp(folder, root, names, left_out, notes)
        self._files = [folder / names[row] for row in rows]
        self._stamps = stamps
        self._rings, self._period, self._is_clockwise = None, 0.0, True
        sweeps = sample(len(stamps), self._sweep)
        points = [sweep.points for sweep in sweeps if len(sweep)]
        self._rings = rings_of(points)
        beams = 0 if self._rings is None else len(self._rings)
        said = "none" if rig is None or len(rig.lidars) != 1 else rig.lidars[0].sweep
        is_raw, reason = _judged(how, points, beams, said)
        self._is_clockwise = said != "counter_clockwise"
        notes.append(reason)
        rate = usual_rate(stamps, RATE_HZ)
        self._period = 1 / rate if is_raw else 0.0
        turns = ("clockwise" if self._is_clockwise else "counter_clockwise") if is_raw else "none"
        how_times = f"from the azimuth: {turns} from behind, stamped ahead" if is_raw else ""
        facts = survey(
            [self._column(sweep) for sweep in sweeps],
            how_times,
            beams,
            "from the order of the rows" if beams else "",
        )
        mount = LidarMount("velodyne", range_m=(HOUSING_M, FAR_M), rate_hz=rate, sweep=turns)
        super().__init__(
            name=(root if folder.name in ("velodyne", "data") else folder).resolve().name,
            rig=mounted_sweeps(mount, rig, facts, path),
            stamps_ns=stamps,
            read=lambda index: self._column(self._sweep(index)),
            survey=facts,
            left_out=left_out,
            notes=notes,
        )
        self.truth = _read_truth(root, stamps, notes)

    def _sweep(self, index: int) -> Sweep:
        """Read a file as it is."""
        file = self._files[index]
        try:
            data = file.read_bytes()
        except OSError as error:
            raise self._unusable(index, f"cannot be read: {error.strerror or error}") from error
        if len(data) % ROW_BYTES:
            raise self._unusable(
                index,
                f"{len(data)} bytes are no multiple of {ROW_BYTES} (x y z intensity, float32): "
                "is it cut off? copy it again",
            )
        rows = np.frombuffer(data, "<f4").reshape(-1, COLUMNS)
        with np.errstate(invalid="ignore"):  # bytes that were damaged are any number
            points, intensities = rows[:, :3].astype(np.float64), rows[:, 3].astype(np.float32)
            points[~(np.abs(points) < FARTHEST_M).all(axis=1)] = np.nan
        return Sweep(points, intensities=intensities)

    def _column(self, sweep: Sweep) -> Sweep:
        """Return a sweep with what follows from where its points are."""
        azimuth = azimuths(sweep.points)
        return Sweep(
            sweep.points,
            turn_times(azimuth, self._period, self._is_clockwise, BEHIND, 0.0)
            if self._period
            else None,
            sweep.intensities,
            None if self._rings is None else self._rings.beams(sweep.points, azimuth),
        )

    def _unusable(self, index: int, reason: str) -> UnusableFrame:
        return UnusableFrame(Skipped(int(self._stamps[index]), str(self._files[index]), reason))


def _root(folder: Path) -> Path:
    """Return where times and truth of a folder of sweeps are."""
    if folder.name in ("velodyne", "data"):
        return folder.absolute().parent
    return folder


def _judged(how: str, sweeps: list[Array], beams: int, said: str) -> tuple[bool, str]:
    """Return whether times follow from azimuths, and why."""
    if how != "auto":
        return how == "azimuth", f"?times={how} is believed"
    if said != "none":
        return True, f"sweeps turn {said}, as the rig says: times follow from the azimuth"
    if not sweeps:
        return False, "the sweeps that were looked at hold no points"
    if not BEAMS[0] <= beams <= BEAMS[1]:
        return False, (
            f"sweeps of {beams or 'unknown'} beams are not KITTI's: points carry no times; "
            "?times=azimuth, or 'sweep' in a rig.yaml, if they turn as KITTI's do"
        )
    steps = [step for step in map(_step_behind, sweeps) if step is not None]
    moved = [step for step in steps if abs(step) > STEP_M]
    if len(moved) > max(1, SHARE * len(steps)):
        return False, (
            f"behind, the ground steps by {abs(float(np.median(moved))):.2f} m: the motion was "
            "taken out of these sweeps, and points carry no times; ?times=azimuth if that is wrong"
        )
    return True, (
        "sweeps are taken to be raw, as the ground goes through behind: times follow from the "
        "azimuth; ?times=off if the motion was taken out"
    )


def _step_behind(points: Array) -> float | None:
    """Return by how much the range of the ground changes from the end of a sweep to its begin.

    Args:
        points: (N, 3) ring by ring, each from straight ahead to the left, and around.

    Returns:
        The median over the rings, metres; None where too few of them can be seen, or disagree.
    """
    azimuth = azimuths(points)
    flat = np.hypot(points[:, 0], points[:, 1])
    at = np.flatnonzero(np.diff(azimuth) < -np.pi)  # from π to -π
    near = (azimuth[at + 1] + 2 * np.pi - azimuth[at] < SEAM) & (points[at, 2] < -1.0)
    steps = flat[at[near] + 1] - flat[at[near]]
    if len(steps) < FEWEST_RINGS:
        return None
    low, middle, high = np.quantile(steps, [0.25, 0.5, 0.75]).tolist()
    return middle if high - low < max(STEP_M, abs(middle)) else None


def _stamp(
    folder: Path, root: Path, names: list[str], left_out: list[Skipped], notes: list[str]
) -> tuple[list[int], NDArray[np.int64]]:
    """Return which of the files to use, in order of time, and their stamps."""
    raw = root / "timestamps.txt"
    if raw.is_file() and not (root / "times.txt").is_file():
        texts = [(line, epoch_text(raw, line, cells)) for line, cells in read_lines(raw)]
        numbers = [int(Path(n).stem) if Path(n).stem.isdigit() else i for i, n in enumerate(names)]
        rows = [
            (*texts[number], str(place))
            for place, number in enumerate(numbers)
            if number < len(texts)
        ]
        listing = list_rows(rows, "s", RATE_HZ, raw, raw.name)
        left_out += [
            Skipped(0, names[place], f"{raw.name} has only {len(texts)} rows")
            for place, number in enumerate(numbers)
            if number >= len(texts)
        ]
        left_out += [Skipped(s.stamp_ns, names[int(s.file)], s.reason) for s in listing.skipped]
        notes += listing.notes
        return [int(place) for place in listing.names], listing.stamps_ns
    file = next((f for f in (root / "times.txt", folder / "times.txt") if f.is_file()), None)
    return stamp_names(names, Clock(file, RATE_HZ, folder, "sweeps"), left_out, notes)


def _read_truth(root: Path, stamps: NDArray[np.int64], notes: list[str]) -> Trajectory | None:
    times = root / "times.txt"
    own, camera = root / "poses_velodyne.txt", root / "poses.txt"
    beside = root.parent.parent / "poses" / f"{root.name}.txt"
    try:
        if own.is_file():
            truth = read_kitti_poses(own, times if times.is_file() else None)
            return check_truth(truth, stamps, own.name, notes)
        if (root / "groundtruth.txt").is_file():
            truth = read_tum(root / "groundtruth.txt")
            return check_truth(truth, stamps, "groundtruth.txt", notes)
        file = camera if camera.is_file() else beside
        if not file.is_file():
            drive = read_oxts(root.parent)
            return None if drive is None else check_truth(drive, stamps, "oxts", notes)
        T = _camera_velodyne(root / "calib.txt")
        if T is None:
            notes.append(f"{file.name}: of a camera, and calib.txt has no Tr: truth ignored")
            return None
        truth = read_kitti_poses(file, times if times.is_file() else None)
        Ts = se3_inverse(T) @ truth.Ts_world_body @ T
        return check_truth(Trajectory(truth.stamps_ns, Ts), stamps, file.name, notes)
    except InputError as error:
        notes.append(f"{error}: ground truth ignored")
        return None


def _camera_velodyne(file: Path) -> Array | None:
    """Return (4, 4) T_camera0_velodyne, the row Tr of a calib.txt, or None."""
    if not file.is_file():
        return None
    for line, cells in read_lines(file):
        if cells[0].rstrip(":") in ("Tr", "Tr_velo_cam", "Tr_velo_to_cam"):
            try:
                values = np.array([float(cell) for cell in cells[1:]]).reshape(3, 4)
            except ValueError:
                raise InputError(f"{file}:{line}: Tr must have 12 numbers") from None
            return np.vstack([values, [0.0, 0.0, 0.0, 1.0]])
    return None
