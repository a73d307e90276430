"""EuRoC recordings (ASL layout): stereo or single camera, IMU, ground truth.

    mav0/cam0/{sensor.yaml, data.csv, data/*.png}     cam1 likewise, if there are two
    mav0/imu0/{sensor.yaml, data.csv}                 optional
    mav0/state_groundtruth_estimate0/data.csv         optional; or groundtruth.txt (TUM) beside mav0

The body B is the frame all `T_BS` (sensor to body) refer to: the IMU's. Cameras are triggered
together but each has its own listing, so left and right are paired by stamp. Stamps are integer
nanoseconds. Everything that can be mended is, and noted; what cannot be read is skipped, and
counted.

Reference: M. Burri et al., "The EuRoC micro aerial vehicle datasets", Int. J. Robotics Research
35(10), 2016.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError, InputError
from odomap.files.fields import Fields, read_yaml
from odomap.files.text import read_table
from odomap.files.trajectories import read_euroc, read_tum
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.geometry.trajectory import Trajectory
from odomap.sensors.frame import ImuSamples
from odomap.sensors.rig import CameraMount, ImuMount, Rig
from odomap.sensors.sync import order_stamps, pair_stamps, read_stamps
from odomap.sources.listing import Listing, read_listing
from odomap.sources.recording import Recording, check_stereo, check_truth, open_cameras
from odomap.sources.source import Skipped

__all__ = ["EurocSource", "is_euroc"]

PAIR_TOLERANCE_NS = 5_000_000
"""Left and right of a pair may differ by 5 ms."""
CAMERAS = ("cam0", "cam1")
_LENSES = {"radial-tangential": True, "radtan": True, "plumb_bob": True, "none": False}


def is_euroc(path: Path) -> bool:
    """Tell whether a folder holds a EuRoC recording (`mav0` or what is in it)."""
    return any(
        (root / name / item).exists()
        for root in (path / "mav0", path)
        for name in CAMERAS
        for item in ("data.csv", "sensor.yaml", "data")
    )


class EurocSource(Recording):
    """A EuRoC recording as a source of frames."""

    def __init__(self, path: str | Path, rig: Rig | None = None) -> None:
        """Open a recording.

        Args:
            path: the folder that holds `mav0`, or `mav0` itself.
            rig: calibration to use instead of the recording's own; its cameras are cam0, cam1.

        Raises:
            InputError: something is missing or of no use; names the file and the mend.
            CalibrationError: the calibration cannot be true.
        """
        given = Path(path)
        root = given / "mav0" if (given / "mav0").is_dir() else given
        folders, notes = _camera_folders(root, rig)
        where = "rig.yaml" if rig is not None else folders[-1] / "sensor.yaml"
        if rig is None:
            mounts = tuple(_read_camera(folder) for folder in folders)
            rig = Rig(mounts, imu=_read_imu_mount(root))
        check_stereo(rig, where)
        names, stamps, left_out = _pair(folders, rig, notes)
        mend = f"correct 'resolution' and 'intrinsics' in {where}, or resize the images"
        cameras = open_cameras([folder / "data" for folder in folders], names, rig.cameras, mend)
        for camera in cameras:
            if camera.form.note:
                notes.append(f"{camera.folder.parent.name}: {camera.form.note}")
        imu = _read_imu(root, rig, notes)
        super().__init__(
            name=(
                given.resolve().parent if given.resolve().name == "mav0" else given.resolve()
            ).name,
            rig=rig if imu is not None else rig.without_imu(),
            stamps_ns=stamps,
            cameras=cameras,
            imu=imu,
            left_out=left_out,
            notes=notes,
        )
        self.truth = _read_truth(root, self)


def _camera_folders(root: Path, rig: Rig | None) -> tuple[list[Path], list[str]]:
    folders = [root / name for name in CAMERAS if (root / name).is_dir()]
    notes = []
    if not folders:
        raise InputError(f"{root}: neither cam0 nor cam1 is there: a EuRoC recording needs one")
    if len(folders) == 1:
        missing = next(name for name in CAMERAS if name != folders[0].name)
        notes.append(f"{missing} is missing: the recording is monocular")
    if rig is not None:
        if not 1 <= len(rig.cameras) <= len(folders):
            raise CalibrationError(
                f"the rig has {len(rig.cameras)} cameras, {root} has {len(folders)}: "
                "list those that were recorded, in the order of their folders"
            )
        folders = folders[: len(rig.cameras)]
    return folders, notes


def _read_camera(folder: Path) -> CameraMount:
    fields = read_yaml(folder / "sensor.yaml")
    model = fields.text("camera_model", "pinhole")
    if model != "pinhole":
        raise fields.error("camera_model", f"'{model}' is not supported: only 'pinhole' is")
    lens = fields.text("distortion_model", "radial-tangential")
    if lens not in _LENSES:
        raise fields.error(
            "distortion_model", f"'{lens}' is not supported: known are {', '.join(_LENSES)}"
        )
    distortion = np.zeros(0)
    if _LENSES[lens]:
        distortion = fields.numbers("distortion_coefficients", (0, 4, 5, 8))
    try:
        camera = Camera(
            "pinhole",
            fields.numbers("intrinsics", (4,)),
            distortion,
            fields.resolution("resolution"),
        )
        T_body_camera = fields.transform("T_BS")
        return CameraMount(folder.name, camera, T_body_camera, fields.number("rate_hz", 0.0))
    except CalibrationError as error:
        raise _located(fields, error) from error


def _read_imu_mount(root: Path) -> ImuMount | None:
    file = root / "imu0" / "sensor.yaml"
    if not file.exists():
        return ImuMount() if (root / "imu0" / "data.csv").exists() else None
    fields = read_yaml(file)
    default = ImuMount()
    try:
        return ImuMount(
            fields.number("rate_hz", default.rate_hz),
            fields.number("gyroscope_noise_density", default.gyro_noise),
            fields.number("gyroscope_random_walk", default.gyro_walk),
            fields.number("accelerometer_noise_density", default.accel_noise),
            fields.number("accelerometer_random_walk", default.accel_walk),
            fields.transform("T_BS") if "T_BS" in fields else SE3.identity(),
        )
    except CalibrationError as error:
        raise _located(fields, error) from error


def _located(fields: Fields, error: CalibrationError) -> CalibrationError:
    message = str(error)
    return (
        error
        if message.startswith(fields.where)
        else CalibrationError(f"{fields.where}: {message}")
    )


def _pair(
    folders: Sequence[Path], rig: Rig, notes: list[str]
) -> tuple[list[list[str]], NDArray[np.int64], list[Skipped]]:
    """Read the listings and pair them: names per camera, stamps, what was left out."""
    listings = []
    for folder, mount in zip(folders, rig.cameras, strict=True):
        listing = read_listing(folder, mount.rate_hz, f"{folder.name}/data.csv")
        offset_ns = round(mount.time_offset_s * 1e9)
        listings.append(replace(listing, stamps_ns=listing.stamps_ns + offset_ns))
        notes.extend(listing.notes)
    left_out = [skipped for listing in listings for skipped in listing.skipped]
    left = listings[0]
    if len(listings) == 1:
        return [left.names], left.stamps_ns, left_out
    right = listings[1]
    ours, theirs = pair_stamps(left.stamps_ns, right.stamps_ns, PAIR_TOLERANCE_NS)
    if len(ours) == 0:
        raise _unpaired(folders, left, right)
    left_out += _alone(left, ours, folders[1].name) + _alone(right, theirs, folders[0].name)
    names = [[left.names[i] for i in ours], [right.names[i] for i in theirs]]
    return names, left.stamps_ns[ours], left_out


def _alone(listing: Listing, paired: NDArray[np.intp], other: str) -> list[Skipped]:
    reason = f"no image of {other} within {PAIR_TOLERANCE_NS / 1e6:.0f} ms"
    alone = np.setdiff1d(np.arange(len(listing)), paired)
    return [Skipped(int(listing.stamps_ns[i]), listing.names[i], reason) for i in alone]


def _unpaired(folders: Sequence[Path], left: Listing, right: Listing) -> InputError:
    middle = left.stamps_ns[len(left) // 2]
    offset_ns = right.stamps_ns[np.argmin(np.abs(right.stamps_ns - middle))] - middle
    return InputError(
        f"{folders[1] / 'data.csv'}: no image within {PAIR_TOLERANCE_NS / 1e6:.0f} ms of one of "
        f"{folders[0].name}, the nearest differs by {offset_ns * 1e-6:.6g} ms: "
        "set 'time_offset_s' of the camera in a rig.yaml and give it with --rig"
    )


def _read_imu(root: Path, rig: Rig, notes: list[str]) -> ImuSamples | None:
    file = root / "imu0" / "data.csv"
    if not file.exists() or rig.imu is None:
        return None
    try:
        table = read_table(file, 7, has_stamp=True, exact=False)
    except InputError as error:
        notes.append(f"{error}: the IMU is not used")
        return None
    column = read_stamps(table.stamps, "ns", rig.imu.rate_hz)
    good = np.flatnonzero(column.valid)
    order = order_stamps(column.stamps_ns[good])
    lost = len(table) - len(order.order)
    if column.note:
        notes.append(f"imu0/data.csv: {column.note}")
    if lost:
        notes.append(f"imu0/data.csv: {lost} rows with a repeated or unreadable stamp are left out")
    if order.disordered:
        notes.append(f"imu0/data.csv: {order.disordered} stamps out of order: sorted")
    rows = good[order.order]
    if len(rows) == 0:
        return None
    values = table.values[rows]
    gyro, accel = np.ascontiguousarray(values[:, :3]), np.ascontiguousarray(values[:, 3:])
    return ImuSamples(column.stamps_ns[rows], gyro, accel)


def _read_truth(root: Path, source: Recording) -> Trajectory | None:
    beside = root.parent if root.name == "mav0" else root
    candidates = (
        (root / "state_groundtruth_estimate0" / "data.csv", read_euroc),
        (beside / "groundtruth.txt", read_tum),
    )
    for file, read in candidates:
        if not file.exists():
            continue
        try:
            truth = check_truth(read(file), source.stamps_ns, file.name, source.notes)
        except InputError as error:
            source.notes.append(f"{error}: ground truth ignored")
            continue
        if truth is not None:
            return truth
    return None
