"""Opening a recording by guessing what it is.

Recognised by what a folder holds, not by its name:

    EuRoC ASL         mav0/cam0/data.csv (or the inside of mav0)
    KITTI odometry    image_0/ (image_1/, or image_2/ image_3/), calib.txt, times.txt
    TUM RGB-D         rgb.txt, depth.txt, rgb/, depth/
    KITTI velodyne    velodyne/*.bin, times.txt; or velodyne_points/data/*.bin
    capture           a .pcap of a Velodyne LiDAR
    clouds            a folder of *.pcd, *.ply, *.las or *.npy, one per sweep; or one of these
    image folder      *.png, *.jpg, ..., or left/ and right/, and a rig.yaml
    video             a file: clip.mp4, .mov, .avi, .mkv, ...
    laser log         a file: CARMEN's (.clf, .log, also .bz2 or .gz), or Odometry and Laser lines
    bag               a ROS 1 .bag, an MCAP file, a ROS 2 bag (its folder, .mcap or .db3), with
                      LaserScan or PointCloud2
    live camera       a name "camera:0", "camera:0?width=640&height=480"
    simulated world   world.yaml (`odomap_world: 1`), or a name "sim:room?seed=3&frames=100"

Logs, bags and sweeps take options behind a '?': "run.bag?scan=/front/scan" (see the sources).

A path that leads nowhere is answered with what stands nearest to it.
"""

from pathlib import Path

from odomap.errors import InputError, nearest_name
from odomap.sensors.rig import Rig
from odomap.sources.bagfile import is_bag
from odomap.sources.calibration import load_rig, rig_beside
from odomap.sources.camera import PREFIX, CameraSource
from odomap.sources.carmen import MESSAGES, CarmenSource
from odomap.sources.euroc import EurocSource, is_euroc
from odomap.sources.folder import FolderSource, image_folders, is_folder
from odomap.sources.kitti import KittiSource, is_kitti
from odomap.sources.logfiles import beginnings
from odomap.sources.options import check_options, split_options
from odomap.sources.packets import is_pcap
from odomap.sources.plainlog import WORDS, PlainLogSource
from odomap.sources.source import Source
from odomap.sources.sweepfolders import cloud_folder, is_cloud, is_velodyne
from odomap.sources.tum import TumSource, is_tum
from odomap.sources.video import VideoSource, is_video

__all__ = ["SUPPORTED", "open"]

SUPPORTED = (
    "EuRoC (mav0/cam0/data.csv), KITTI odometry (image_0/, calib.txt), "
    "KITTI velodyne (velodyne/*.bin), TUM RGB-D (rgb.txt, depth.txt), "
    "folders of clouds (.pcd, .ply, .las, .npy), captures of a Velodyne (.pcap), "
    "videos (.mp4, .mov, .avi, .mkv, ...), "
    "folders of images (one, or left/ and right/), laser logs (CARMEN .clf, .log), "
    "bags of ROS 1 and 2 with scans or clouds (.bag, .mcap, .db3, or the folder of one), "
    "live cameras ('camera:0'), "
    "simulated worlds (world.yaml, or a name like 'sim:room?seed=3&frames=100')"
)


def open(path: str | Path, rig: Rig | str | Path | None = None) -> Source:
    """Open a recording, a live camera or a simulated world; the format is recognised.

    Args:
        path: a folder, a video, a log, a bag, a `world.yaml`, or a name that begins with "sim:" or
            "camera:".
        rig: calibration to use instead of the recording's own: a rig, or a `rig.yaml`. Without
            it, a `rig.yaml` in the folder is used where the recording has no calibration.

    Returns:
        A source; iterate it for frames.

    Raises:
        InputError: there is nothing there, or nothing that is recognised.
        CalibrationError: the calibration is incomplete or cannot be true.

    Example:
        >>> source = open("sim:room?seed=3&frames=2")  # doctest: +SKIP
    """
    if isinstance(path, str) and path.startswith("sim:"):
        return _simulated(path, rig)
    if isinstance(path, str) and path.startswith(PREFIX):
        return CameraSource(path, None if rig is None else load_rig(rig))
    try:
        place, options = split_options(path)
        source = _log(place, rig, options) if place.is_file() else None
        return _recognised(place, rig, options) if source is None else source
    except OSError as error:
        raise InputError(f"{error.filename or path}: {error.strerror or error}") from error


def _log(file: Path, rig: Rig | str | Path | None, options: dict[str, str]) -> Source | None:
    """Return the source of a laser's log or a bag, or None if a file is none of these."""
    if is_bag(file):
        return _bag(file, rig, options)
    if is_video(file) or file.suffix.lower() in (".yaml", ".yml"):
        return None
    if is_pcap(file) or is_cloud(file):
        return _sweeps(file, _beside(file, rig), options)
    words = set(beginnings(file))
    for kinds, kind in ((MESSAGES, CarmenSource), (WORDS, PlainLogSource)):
        if words & kinds:
            source: Source = kind(file, None if rig is None else load_rig(rig), options)
            return source
    if {".clf", ".log"} & {suffix.lower() for suffix in file.suffixes}:
        found = f"'{next(iter(words))[:20]}'" if words else "nothing"
        raise InputError(f"{file}: is no laser log: no line begins with FLASER (found {found})")
    return None


def _beside(file: Path, rig: Rig | str | Path | None) -> Rig | None:
    return rig_beside([file.with_name("rig.yaml")]) if rig is None else load_rig(rig)


def _sweeps(path: Path, rig: Rig | None, options: dict[str, str]) -> Source:
    """Return the source of a 3D LiDAR's files; its kernels are imported for nobody else."""
    source: Source
    if path.is_file() and is_pcap(path):
        from odomap.sources.velodynepcap import PcapSource

        source = PcapSource(path, rig, options)
    elif path.is_dir() and is_velodyne(path):
        from odomap.sources.velodyne import VelodyneSource

        source = VelodyneSource(path, rig, options)
    else:
        from odomap.sources.cloudfolder import CloudSource

        source = CloudSource(path, rig, options)
    return source


def _bag(path: Path, rig: Rig | str | Path | None, options: dict[str, str]) -> Source:
    """Return the source of a bag: of its 2D scans, or where it has none, of its clouds."""
    from odomap.sources.bag import BagSource
    from odomap.sources.bagfile import CLOUD, SCAN, BagFile
    from odomap.sources.cloudbag import CloudBagSource

    given = None if rig is None else load_rig(rig)
    bag = BagFile(path)
    kinds = {topic.kind for topic in bag.topics if topic.count}
    has_clouds = "cloud" in options or (CLOUD in kinds and SCAN not in kinds)
    source: Source = (CloudBagSource if has_clouds else BagSource)(bag, given, options)
    return source


def _recognised(root: Path, rig: Rig | str | Path | None, options: dict[str, str]) -> Source:
    if not root.exists():
        raise InputError(_missing(root))
    if root.is_dir() and not is_kitti(root) and is_velodyne(root):
        return _sweeps(root, _rig(root, rig, calibrated=False), options)
    if options and not is_bag(root) and not _holds_clouds(root):
        check_options(root, options, ())
    if root.is_file():
        if root.suffix.lower() in (".yaml", ".yml"):
            return _simulated(str(root), rig)
        if is_video(root):
            return VideoSource(root, None if rig is None else load_rig(rig))
        if not root.stat().st_size:
            raise InputError(f"{root}: is empty: copy it again")
        raise InputError(f"{root}: files of this kind cannot be opened; supported are {SUPPORTED}")
    if (root / "world.yaml").exists():
        return _simulated(str(root / "world.yaml"), rig)
    if is_euroc(root):
        return EurocSource(root, _rig(root, rig))
    if is_kitti(root):
        return KittiSource(root, _rig(root, rig))
    given = None if rig is None else load_rig(rig)
    if is_tum(root):
        return TumSource(root, given)
    if is_bag(root):
        return _bag(root, rig, options)
    calibration = given or rig_beside([root / "rig.yaml"])
    if _holds_clouds(root):
        return _sweeps(root, calibration, options)
    outside = next((p for p in list(root.resolve().parents)[:3] if _is_recording(p)), None)
    if outside is not None and calibration is None:
        raise InputError(f"{root}: is a part of a recording: open {outside}")
    if is_folder(root, calibration):
        return FolderSource(root, given)
    raise InputError(_unrecognised(root))


def _rig(root: Path, rig: Rig | str | Path | None, calibrated: bool | None = None) -> Rig | None:
    """Return the given rig, or that beside a recording that is not calibrated itself."""
    if rig is not None:
        return load_rig(rig)
    if calibrated is None:
        calibrated = any(
            (root / name).exists()
            for name in ("calib.txt", "mav0/cam0/sensor.yaml", "cam0/sensor.yaml")
        )
    return None if calibrated else rig_beside([root / "rig.yaml"])


def _is_recording(path: Path) -> bool:
    return is_euroc(path) or is_kitti(path) or is_tum(path)


def _holds_clouds(root: Path) -> bool:
    return root.is_dir() and cloud_folder(root) is not None and not image_folders(root)


def _simulated(spec: str, rig: Rig | str | Path | None) -> Source:
    if rig is not None:
        raise InputError(f"{spec}: a simulated world has its own rig; leave --rig out")
    from odomap.sources.simulated import SimulatedSource

    source: Source = SimulatedSource(spec)
    return source


def _missing(root: Path) -> str:
    parent = next((p for p in root.parents if p.exists()), Path("."))
    name = root.relative_to(parent).parts[0] if root != parent else root.name
    siblings = [entry.name for entry in parent.iterdir()] if parent.is_dir() else []
    return f"{root}: does not exist{nearest_name(name, siblings)}"


def _unrecognised(root: Path) -> str:
    entries = sorted(entry.name for entry in root.iterdir() if not entry.name.startswith("."))
    if not entries:
        return f"{root}: the folder is empty; supported are {SUPPORTED}"
    inside = sorted(p for p in (*root.glob("*/"), *root.glob("*/*/")) if p.is_dir())
    for path in inside:
        if _is_recording(path):
            return f"{root}: is not a recording itself, but holds one: open {path}"
    pictures = [path.name for path in inside if path.parent == root and image_folders(path)]
    if pictures:
        return (
            f"{root}: holds folders of images ({', '.join(pictures)}): open one of them, or name "
            "two 'left' and 'right', or as the cameras of the rig.yaml"
        )
    if videos := [name for name in entries if is_video(root / name)]:
        return f"{root}: is a folder that holds videos: open one of them: {', '.join(videos[:5])}"
    found = ", ".join(entries[:5]) + (", ..." if len(entries) > 5 else "")
    return f"{root}: not recognised (it holds {found}); supported are {SUPPORTED}"
