"""KITTI odometry recordings: rectified stereo pairs, nominal times, left-camera ground truth.

    image_0/000000.png ... image_1/...     grey, left and right; or image_2, image_3 in colour
    calib.txt                              P0 ... P3, 3x4 projections of the rectified cameras
    times.txt                              seconds, one per frame
    poses.txt                              truth of camera 0; or ../../poses/NN.txt

All cameras share one rectified orientation and P = K [I | t], so t = K⁻¹ P₄ and a camera's centre
is -t: the baseline of a pair is (P₁₄(left) - P₁₄(right)) / fx. The body is the left camera used;
truth of the colour pair is camera 0's, moved over by the mount. Images are matched by name, times
and poses by number.

Reference: A. Geiger, P. Lenz, R. Urtasun, "Are we ready for autonomous driving? The KITTI vision
benchmark suite", CVPR 2012.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError, InputError, nearest_name
from odomap.files.text import read_lines
from odomap.files.trajectories import read_kitti_poses, read_tum
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.rig import CameraMount, Rig
from odomap.sources.listing import images_in, list_rows
from odomap.sources.recording import (
    CameraFiles,
    Recording,
    check_stereo,
    check_truth,
    open_cameras,
)
from odomap.sources.source import Skipped

__all__ = ["KittiSource", "is_kitti"]

RATE_HZ = 10.0
PAIRS = ((0, 1), (2, 3))
"""Grey first, then colour."""


def is_kitti(path: Path) -> bool:
    """Tell whether a folder holds a KITTI odometry sequence."""
    return any((path / f"image_{camera}").is_dir() for pair in PAIRS for camera in pair)


class KittiSource(Recording):
    """A KITTI odometry sequence as a source of frames."""

    def __init__(self, path: str | Path, rig: Rig | None = None) -> None:
        """Open a sequence.

        Args:
            path: the folder of the sequence.
            rig: calibration to use instead of `calib.txt`.

        Raises:
            InputError: something is missing or of no use; names the file and the mend.
            CalibrationError: the calibration cannot be true.
        """
        root = Path(path)
        notes: list[str] = []
        numbers = _camera_numbers(root, rig, notes)
        folders = [root / f"image_{number}" for number in numbers]
        names, left_out = _common_names(folders)
        rows, stamps = _stamp(root, names, left_out, notes)
        used = [names[row] for row in rows]
        mounts = [None] * len(folders) if rig is None else list(rig.cameras)
        mend = "give the calibration of these images with --rig, or resize them"
        cameras = open_cameras(folders, [used] * len(folders), mounts, mend)
        offset = SE3.identity()
        if rig is None:
            rig, offset = _read_rig(root / "calib.txt", numbers, cameras)
        else:
            check_stereo(rig, "rig.yaml")
        notes += [f"{c.folder.name}: {c.form.note}" for c in cameras if c.form.note]
        super().__init__(
            name=root.resolve().name,
            rig=rig,
            stamps_ns=stamps,
            cameras=cameras,
            left_out=left_out,
            notes=notes,
        )
        self.truth = _read_truth(root, self, offset)


def _camera_numbers(root: Path, rig: Rig | None, notes: list[str]) -> list[int]:
    """Choose the cameras to read, and note what is missing of a pair."""
    there = {n for pair in PAIRS for n in pair if images_in(root / f"image_{n}")}
    if not there:
        raise InputError(f"{root}: image_0 to image_3 hold no images")
    pair = next((p for p in PAIRS if there.issuperset(p)), None) or next(
        p for p in PAIRS if there.intersection(p)
    )
    numbers = [n for n in pair if n in there]
    if len(numbers) == 1:
        missing = next(n for n in pair if n not in there)
        notes.append(f"image_{missing} is missing or empty: the recording is monocular")
    if rig is None:
        return numbers
    if not 1 <= len(rig.cameras) <= len(numbers):
        raise CalibrationError(
            f"the rig has {len(rig.cameras)} cameras, {root} has {len(numbers)}: "
            "list those that were recorded, left first"
        )
    return numbers[: len(rig.cameras)]


def _common_names(folders: list[Path]) -> tuple[list[str], list[Skipped]]:
    """Return the names that all cameras have, and what some have alone."""
    lists = [images_in(folder) for folder in folders]
    common = set(lists[0]).intersection(*lists)
    if not common:
        raise InputError(
            f"{folders[-1]}: no image has the same name as one in {folders[0].name}: "
            "left and right must be numbered alike"
        )
    left_out = []
    for folder, names in zip(folders, lists, strict=True):
        other = next((f.name for f in folders if f != folder), "")
        left_out += [
            Skipped(0, f"{folder.name}/{name}", f"no image of that name in {other}")
            for name in names
            if name not in common
        ]
    # Numbering is that of all images, so that one missing on a side shifts nothing.
    return sorted(set().union(*lists)), left_out


def _numbers_of(names: list[str]) -> list[int]:
    """Return the row each name has in times.txt and poses.txt: its number, or else its place."""
    stems = [Path(name).stem for name in names]
    if all(stem.isdigit() for stem in stems):
        return [int(stem) for stem in stems]
    return list(range(len(names)))


def _stamp(
    root: Path, names: list[str], left_out: list[Skipped], notes: list[str]
) -> tuple[list[int], NDArray[np.int64]]:
    """Return which of the names to use, in order of time, and their stamps."""
    alone = {Path(skipped.file).name for skipped in left_out}
    usable = [place for place, name in enumerate(names) if name not in alone]
    numbers = _numbers_of(names)
    file = root / "times.txt"
    if not file.exists():
        notes.append(f"times.txt is missing: frames are taken to be {1 / RATE_HZ:g} s apart")
        stamps = np.array([numbers[place] * round(1e9 / RATE_HZ) for place in usable], np.int64)
        return usable, stamps
    times = [(line, cells[0]) for line, cells in read_lines(file)]
    if numbers[-1] >= len(times) > 0 and len(times) == len(names):
        numbers = list(range(len(names)))
    rows = []
    for place in usable:
        if numbers[place] < len(times):
            line, text = times[numbers[place]]
            rows.append((line, text, str(place)))
        else:
            left_out.append(Skipped(0, names[place], f"times.txt has only {len(times)} rows"))
    if not rows:
        raise InputError(f"{file}: {len(times)} times for {len(names)} images: none matches")
    listing = list_rows(rows, "s", RATE_HZ, file, "times.txt")
    left_out += [
        Skipped(s.stamp_ns, names[int(s.file)], f"times.txt, {s.reason}") for s in listing.skipped
    ]
    notes += listing.notes
    return [int(place) for place in listing.names], listing.stamps_ns


def _read_rig(file: Path, numbers: list[int], cameras: tuple[CameraFiles, ...]) -> tuple[Rig, SE3]:
    """Read calib.txt: the rig, and T_camera0_body for moving the truth over."""
    if not file.exists():
        raise CalibrationError(f"{file}: missing: it holds the projections P0 to P3; or give --rig")
    projections = _read_projections(file, numbers)
    centres, mounts = [], []
    for number, camera in zip(numbers, cameras, strict=True):
        P = projections[number]
        K = P[:, :3]
        if np.linalg.cond(K) > 1e8:
            raise CalibrationError(f"{file}: P{number} is no projection of a rectified camera")
        centres.append(-np.linalg.solve(K, P[:, 3]))
        T_body_camera = SE3.from_parts(np.eye(3), centres[-1] - centres[0])
        intrinsics = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
        try:
            lens = Camera("pinhole", intrinsics, np.zeros(0), camera.form.resolution)
            mounts.append(CameraMount(f"image_{number}", lens, T_body_camera, RATE_HZ))
        except CalibrationError as error:
            raise CalibrationError(f"{file}: P{number}: {error}") from error
    rig = Rig(tuple(mounts))
    check_stereo(rig, file)
    return rig, SE3.from_parts(np.eye(3), centres[0])


def _read_projections(file: Path, numbers: list[int]) -> dict[int, NDArray[np.float64]]:
    found: dict[str, tuple[int, list[str]]] = {}
    for line, cells in read_lines(file):
        found[cells[0].rstrip(":")] = (line, cells[1:])
    projections = {}
    for number in numbers:
        name = f"P{number}"
        if name not in found:
            hint = nearest_name(name, found) or f" (found {', '.join(found) or 'nothing'})"
            raise CalibrationError(f"{file}: field '{name}' is missing{hint}")
        line, cells = found[name]
        try:
            values = np.array([float(cell) for cell in cells])
        except ValueError:
            raise CalibrationError(f"{file}:{line}: {name} must hold numbers") from None
        if len(values) != 12 or not np.isfinite(values).all():
            raise CalibrationError(
                f"{file}:{line}: {name} must have 12 finite numbers, got {len(values)}"
            )
        projections[number] = values.reshape(3, 4)
    return projections


def _read_truth(root: Path, source: Recording, T_camera0_body: SE3) -> Trajectory | None:
    full = root.resolve()
    candidates = (
        root / "poses.txt",
        full.parent.parent / "poses" / f"{full.name}.txt",
        root / "groundtruth.txt",
    )
    file = next((candidate for candidate in candidates if candidate.exists()), None)
    if file is None:
        return None
    try:
        if file == candidates[-1]:
            truth = read_tum(file)
        else:
            # Poses count the same frames as times.txt, or else are at KITTI's rate.
            times = root / "times.txt"
            truth = read_kitti_poses(file, times if times.exists() else None)
    except InputError as error:
        source.notes.append(f"{error}: ground truth ignored")
        return None
    truth = Trajectory(truth.stamps_ns, truth.Ts_world_body @ T_camera0_body.matrix)
    return check_truth(truth, source.stamps_ns, file.name, source.notes)
