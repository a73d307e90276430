"""Folders of images: one camera, or left and right, with or without times.

    frames/*.png, or frames/images/*.png        one camera, in natural order (9 before 10)
    left/*.png, right/*.png                     a pair; also image_0 and image_1, cam0 and cam1, or
                                                folders named as the cameras of the rig
    times.txt or timestamps.txt                 optional: one time per image, or name and time
    groundtruth.txt                             optional: T_world_body, TUM text
    rig.yaml                                    the calibration, unless it is given

Left and right are paired by their names, by the numbers in them, or by stamp. When an image was
taken is said by the file of times; else by its name, if the names are plausible as times (today's
epoch in any unit, seconds with a point, or numbers that step like a clock, where a counter steps
by one); else images are taken to come at the camera's rate, missing numbers leaving their gap.
What cannot be told is noted.

Reference: A. Geiger et al., "Vision meets robotics: the KITTI dataset", Int. J. Robotics Research
32(11), 2013 (the layout most folders follow).
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError, InputError
from odomap.files.trajectories import read_tum
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.rig import Rig
from odomap.sources.calibration import find_rig, one_camera
from odomap.sources.filenames import Clock, in_order, pair_names, stamp_names
from odomap.sources.listing import images_in
from odomap.sources.recording import Recording, check_stereo, check_truth, open_cameras

__all__ = ["FolderSource", "image_folders", "is_folder"]

PAIRS = (("left", "right"), ("image_0", "image_1"), ("cam0", "cam1"), ("image_2", "image_3"))
TIMES = ("times.txt", "timestamps.txt")


def is_folder(path: Path, rig: Rig | None = None) -> bool:
    """Tell whether a folder holds images of one camera, or of two in two folders."""
    return bool(image_folders(path, rig))


def image_folders(path: Path, rig: Rig | None = None) -> list[Path]:
    """Return the folders of images of each camera; none if there are none, or too many to tell."""
    named = () if rig is None else (tuple(mount.name for mount in rig.cameras),)
    for names in (*named, *PAIRS):
        folders = [path / name for name in names]
        if folders and all(images_in(folder) for folder in folders):
            return folders
    if images_in(path):
        return [path]
    inside = [entry for entry in sorted(path.iterdir()) if entry.is_dir() and images_in(entry)]
    return inside if len(inside) == 1 else []


class FolderSource(Recording):
    """Images in a folder, or in one for left and one for right, as a source of frames."""

    def __init__(self, path: str | Path, rig: Rig | None = None) -> None:
        """Open a folder.

        Args:
            path: the folder of the images, or that of the two folders.
            rig: its calibration; without it, the rig.yaml in the folder.

        Raises:
            InputError: something is missing or of no use; names the file and the mend.
            CalibrationError: there is no calibration, or it cannot be true.
        """
        root = Path(path)
        notes: list[str] = []
        where = root / "rig.yaml" if rig is None else "the given rig"
        rig = find_rig(rig, [root / "rig.yaml"], root)
        rig, folders = _match(root, rig, where, notes)
        lists = [in_order(images_in(folder)) for folder in folders]
        names, left_out = pair_names(folders, lists) if len(lists) > 1 else (lists, [])
        clock = Clock(_times_file(folders), rig.cameras[0].rate_hz, folders[0])
        rows, stamps = stamp_names(names[0], clock, left_out, notes)
        names = [[side[row] for row in rows] for side in names]
        mend = f"correct 'resolution' and 'intrinsics' in {where}, or resize the images"
        cameras = open_cameras(folders, names, rig.cameras, mend)
        notes += [f"{c.folder.name}: {c.form.note}" for c in cameras if c.form.note]
        super().__init__(
            name=root.resolve().name,
            rig=rig,
            stamps_ns=stamps + round(rig.cameras[0].time_offset_s * 1e9),
            cameras=cameras,
            left_out=left_out,
            notes=notes,
        )
        self.truth = _read_truth(root, self.stamps_ns, notes)


def _match(root: Path, rig: Rig, where: Path | str, notes: list[str]) -> tuple[Rig, list[Path]]:
    """Return the cameras that are used and the folder of each."""
    folders = image_folders(root, rig)
    if not folders:
        raise InputError(
            f"{root}: holds no images, nor folders 'left' and 'right' (or named as the cameras: "
            f"{', '.join(mount.name for mount in rig.cameras)}) that do"
        )
    if len(rig.cameras) > len(folders):
        raise CalibrationError(
            f"{where}: has {len(rig.cameras)} cameras, but {root} has images of one: list that "
            "one, or put the images of each camera into a folder of its name"
        )
    if len(rig.cameras) == 1:
        name = rig.cameras[0].name
        chosen = next((folder for folder in folders if folder.name == name), folders[0])
        if len(folders) > 1:
            notes.append(f"the calibration has one camera: only {chosen.name} is used")
        return one_camera(rig, where), [chosen]
    rig = Rig(rig.cameras[:2])
    check_stereo(rig, where)
    return rig, folders[:2]


def _times_file(folders: Sequence[Path]) -> Path | None:
    places = (*folders, folders[0].parent)
    files = (place / name for place in places for name in TIMES)
    return next((file for file in files if file.is_file()), None)


def _read_truth(root: Path, stamps_ns: NDArray[np.int64], notes: list[str]) -> Trajectory | None:
    file = root / "groundtruth.txt"
    if not file.is_file():
        return None
    try:
        return check_truth(read_tum(file), stamps_ns, file.name, notes)
    except InputError as error:
        notes.append(f"{error}: ground truth ignored")
        return None
