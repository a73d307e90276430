"""Folders of sweeps: recognising them, without what reads them."""

from pathlib import Path

__all__ = ["CLOUDS", "cloud_folder", "is_cloud", "is_sweep", "is_velodyne", "velodyne_folder"]

CLOUDS = (".pcd", ".ply", ".npy", ".las", ".laz")
"""Names of clouds end so."""
SWEEP = ".bin"


def is_sweep(file: Path) -> bool:
    """Tell whether a file is a sweep as KITTI writes them, by its name."""
    return file.suffix.lower() == SWEEP and not file.name.startswith(".")


def velodyne_folder(path: Path) -> Path | None:
    """Return the folder of the .bin files of a recording of KITTI, or None if there is none."""
    for place in (path / "velodyne_points" / "data", path / "data", path / "velodyne", path):
        if place.is_dir() and any(is_sweep(file) for file in place.iterdir()):
            return place
    return None


def is_velodyne(path: Path) -> bool:
    """Tell whether a folder holds sweeps as KITTI writes them."""
    return velodyne_folder(path) is not None


def is_cloud(path: Path) -> bool:
    """Tell whether a file is a cloud, by its name."""
    return path.suffix.lower() in CLOUDS and not path.name.startswith(".")


def cloud_folder(path: Path) -> Path | None:
    """Return the folder of the clouds of a recording: it, or the only one in it that holds any."""
    if any(is_cloud(file) for file in path.iterdir() if file.is_file()):
        return path
    inside = [p for p in sorted(path.iterdir()) if p.is_dir() and any(map(is_cloud, p.iterdir()))]
    return inside[0] if len(inside) == 1 else None
