"""TUM RGB-D recordings: colour and registered depth, listed by stamp.

    rgb.txt, depth.txt        stamp (s) and file, one row per image
    rgb/*.png, depth/*.png    colour; 16-bit depth, 5000 per metre, registered to colour
    groundtruth.txt           optional: T_world_camera, TUM text
    rig.yaml                  optional: calibration; without it the names freiburg1 to 3 tell it
    accelerometer.txt         not used: it has no gyroscope beside it

The body is the camera. Colour and depth are triggered apart: a frame has the stamp of its colour
image, and the depth nearest to it within half a frame period, or none. What can be mended is, and
noted; a colour image that cannot be read costs its frame, a depth image only the frame's depth.

Reference: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError, InputError
from odomap.files.text import read_lines, read_text
from odomap.files.trajectories import read_tum
from odomap.geometry.camera import Camera
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.rig import CameraMount, DepthMount, Rig
from odomap.sensors.sync import pair_stamps
from odomap.sources.calibration import HOW_TO, rig_beside
from odomap.sources.depth import DepthFiles, probe_depth
from odomap.sources.listing import Listing, images_in, list_rows
from odomap.sources.recording import Recording, check_truth, open_cameras

__all__ = ["TumSource", "is_tum"]

RATE_HZ = 30.0
FACTOR = 5000.0
LAG = 0.25
"""Share of a frame period from which on a constant offset of depth is noted."""
SHIFT = 3.0
"""Periods by which depth begins and ends later, or earlier, if it is of another clock."""
FREIBURG = {
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), ()),
}
"""Published intrinsics and distortion of the colour cameras; the third is already undistorted."""
_FREIBURG = re.compile(r"(?:freiburg|fr)[_-]?([123])(?![0-9])", re.IGNORECASE)


def is_tum(path: Path) -> bool:
    """Tell whether a folder holds a TUM RGB-D recording."""
    return (path / "rgb.txt").is_file() or ((path / "rgb").is_dir() and (path / "depth").is_dir())


class TumSource(Recording):
    """A TUM RGB-D recording as a source of frames with depth."""

    def __init__(self, root: str | Path, rig: Rig | None = None) -> None:
        """Open a recording.

        Args:
            root: the folder that holds `rgb.txt` and `depth.txt`.
            rig: calibration to use instead of the folder's own: one camera, and the depth factor.

        Raises:
            InputError: something is missing or of no use; names the file and the mend.
            CalibrationError: there is no calibration, or it cannot be true.
        """
        root = Path(root)
        notes: list[str] = []
        rig, where = _find_rig(root, rig, notes)
        colour = _read_list(root, "rgb", rig.cameras[0].rate_hz, notes)
        offset_ns = round(rig.cameras[0].time_offset_s * 1e9)
        colour = replace(colour, stamps_ns=colour.stamps_ns + offset_ns)
        mend = f"correct 'resolution' and 'intrinsics' in {where}, or resize the images"
        cameras = open_cameras([root], [colour.names], rig.cameras, mend)
        depth, left_out = None, list(colour.skipped)
        if (root / "depth.txt").is_file() or images_in(root / "depth"):
            listing = _read_list(root, "depth", rig.cameras[0].rate_hz, notes)
            left_out += listing.skipped
            rig, depth = _open_depth(root, rig, (colour, listing), where, notes)
        else:
            notes.append("depth.txt and depth/ are missing: the recording is monocular")
            rig = replace(rig, depth=None)
        super().__init__(
            name=root.resolve().name,
            rig=rig,
            stamps_ns=colour.stamps_ns,
            cameras=cameras,
            depth=depth,
            left_out=left_out,
            notes=notes,
        )
        self.truth = _read_truth(root / "groundtruth.txt", self)


def _find_rig(root: Path, rig: Rig | None, notes: list[str]) -> tuple[Rig, str]:
    """Return the calibration, and what to call its place in messages."""
    where = "the given rig"
    if rig is None:
        where = str(root / "rig.yaml")
        rig = rig_beside([root / "rig.yaml"])
    if rig is None:
        number = _freiburg_number(root)
        if not number:
            raise CalibrationError(
                f"{root}: there is no calibration: no rig.yaml in it, and neither its name nor "
                f"rgb.txt says freiburg1, 2 or 3: {HOW_TO}"
            )
        notes.append(f"there is no rig.yaml: the published calibration of freiburg{number} is used")
        where = f"the published calibration of freiburg{number}"
        rig = _freiburg(number)
    if len(rig.cameras) != 1:
        raise CalibrationError(
            f"{where}: has {len(rig.cameras)} cameras, but {root} has one (colour): list that one"
        )
    return rig.without_imu(), where


def _freiburg_number(root: Path) -> str:
    """Return which of the known cameras took a recording, by its name or its listing's header."""
    match = _FREIBURG.search(root.resolve().name)
    listing = root / "rgb.txt"
    if match is None and listing.is_file():
        head = "\n".join(line for line in read_text(listing).splitlines()[:5] if line[:1] == "#")
        match = _FREIBURG.search(head)
    return match[1] if match else ""


def _freiburg(number: str) -> Rig:
    intrinsics, distortion = FREIBURG[number]
    camera = Camera("pinhole", np.array(intrinsics), np.array(distortion), (640, 480))
    return Rig((CameraMount("rgb", camera, rate_hz=RATE_HZ),), DepthMount("rgb", FACTOR))


def _read_list(root: Path, kind: str, rate_hz: float, notes: list[str]) -> Listing:
    """Read `rgb.txt` or `depth.txt`; without one, take the stamps from the file names."""
    file = root / f"{kind}.txt"
    if file.is_file():
        rows = [
            (number, cells[0], cells[1] if len(cells) > 1 else f"{kind}/{cells[0]}.png")
            for number, cells in read_lines(file)
        ]
    else:
        names = images_in(root / kind)
        if not names:
            raise InputError(f"{root}: neither {kind}.txt nor images in {kind}/")
        notes.append(f"{kind}.txt is missing: stamps are taken from the names of the images")
        rows = [(0, Path(name).stem, f"{kind}/{name}") for name in names]
    listing = list_rows(rows, "s", rate_hz or RATE_HZ, file, file.name)
    if file.is_file():  # it is the row that is wrong, not the image it names
        bad = [replace(item, file=str(file)) for item in listing.skipped]
        listing = replace(listing, skipped=bad)
    notes += listing.notes
    return listing


def _open_depth(
    root: Path, rig: Rig, listings: tuple[Listing, Listing], where: str, notes: list[str]
) -> tuple[Rig, DepthFiles]:
    """Pair depth with colour, and look whether it can be what the calibration says."""
    mount = rig.depth
    if mount is None:
        mount = DepthMount(rig.cameras[0].name, FACTOR)
        notes.append(f"{where}: says nothing of depth: the factor of TUM ({FACTOR:g}) is used")
    colour, listing = listings
    rows = _pair(root, colour.stamps_ns, listing.stamps_ns, notes)
    names = [None if row < 0 else listing.names[row] for row in rows.tolist()]
    offsets = np.where(rows < 0, 0, listing.stamps_ns[rows] - colour.stamps_ns)
    paths = [root / name for name in names if name is not None]
    resolution = rig.cameras[0].camera.resolution
    note = probe_depth(paths, mount, resolution, where)
    notes += [note] if note else []
    return replace(rig, depth=mount), DepthFiles(root, names, offsets, mount, resolution)


def _is_shift(begins_s: float, ends_s: float, step_s: float) -> bool:
    """Tell whether one listing is the other one later or earlier, by more than a few frames."""
    least = min(abs(begins_s), abs(ends_s))
    return least > SHIFT * step_s and abs(begins_s - ends_s) < SHIFT * step_s


def _pair(
    root: Path, colour_ns: NDArray[np.int64], depth_ns: NDArray[np.int64], notes: list[str]
) -> NDArray[np.intp]:
    """Return the row of depth for each row of colour, -1 where there is none near enough."""
    step = float(np.median(np.diff(colour_ns))) if len(colour_ns) > 1 else 1e9 / RATE_HZ
    tolerance = round(step / 2)
    ours, theirs = pair_stamps(colour_ns, depth_ns, tolerance)
    if len(ours) == 0:
        begin = (depth_ns[0] - colour_ns[0]) * 1e-9
        raise InputError(
            f"{root / 'depth.txt'}: no depth within {tolerance * 1e-6:.3g} ms of a colour image: "
            f"depth begins {abs(begin):.6g} s {'after' if begin > 0 else 'before'} colour: if "
            "their clocks differ by that, shift the stamps of one of the two"
        )
    rows = np.full(len(colour_ns), -1, np.intp)
    rows[ours] = theirs
    lag = float(np.median(depth_ns[theirs] - colour_ns[ours]))
    alone = len(colour_ns) - len(ours)
    if abs(lag) > LAG * step:
        notes.append(
            f"depth.txt: depth is {abs(lag) * 1e-6:.3g} ms {'behind' if lag > 0 else 'ahead of'} "
            f"colour in most frames ({step * 1e-6:.3g} ms apart): are they synchronised? Set "
            f"'time_offset_s: {lag * 1e-9:.4f}' of the camera in a rig.yaml if its clock is off"
        )
    begins, ends = ((depth_ns[k] - colour_ns[k]) * 1e-9 for k in (0, -1))
    if _is_shift(begins, ends, step * 1e-9):
        notes.append(
            f"depth.txt: depth begins {abs(begins):.3g} s {'after' if begins > 0 else 'before'} "
            f"colour, and ends {abs(ends):.3g} s {'after' if ends > 0 else 'before'} it: do their "
            "clocks differ? Then shift the stamps of one of the two"
        )
    if alone:
        notes.append(
            f"{alone} of {len(colour_ns)} colour images have no depth within "
            f"{tolerance * 1e-6:.3g} ms: those frames have none"
        )
    return rows


def _read_truth(file: Path, source: TumSource) -> Trajectory | None:
    """Read T_world_camera and return T_world_body."""
    if not file.is_file():
        return None
    try:
        truth = read_tum(file)
    except InputError as error:
        source.notes.append(f"{error}: ground truth ignored")
        return None
    T_camera_body = source.rig.cameras[0].T_body_camera.inverse()
    moved = Trajectory(truth.stamps_ns, truth.Ts_world_body @ T_camera_body.matrix)
    return check_truth(moved, source.stamps_ns, file.name, source.notes)
