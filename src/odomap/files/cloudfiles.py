"""Clouds with more than places: PLY or PCD by the ending of the name.

A cloud of a LiDAR has a column of intensities, and may have others. PLY is read by every viewer,
PCD by PCL and ROS; both are written binary, little-endian, in the order of the columns.

Reference: G. Turk, "The PLY polygon file format", Stanford University 1994; R. B. Rusu, S. Cousins,
"3D is here: Point Cloud Library (PCL)", ICRA 2011.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.files.atomic import atomic_binary
from odomap.files.clouds import read_ply
from odomap.files.pcd import read_pcd, write_pcd
from odomap.maps.surface import Surface

__all__ = ["ENDINGS", "check_ending", "read_cloud", "write_cloud"]

ENDINGS = (".ply", ".pcd")


def check_ending(path: str | Path) -> None:
    """Raise an InputError unless a file can be written by its name."""
    if Path(path).suffix.lower() not in ENDINGS:
        raise InputError(f"{path}: give a name that ends in {' or '.join(ENDINGS)}")


def read_cloud(path: str | Path) -> Surface:
    """Read the places of a cloud, and of a PLY what else a surface has.

    Args:
        path: a PCD by its name, else a PLY.

    Raises:
        InputError: neither, without x, y and z, or a file that ends too early.
    """
    if Path(path).suffix.lower() != ".pcd":
        return read_ply(path)
    columns = read_pcd(path).columns
    if any(name not in columns for name in "xyz"):
        raise InputError(f"{path}: has no fields x, y and z")
    points = np.stack([columns[name].astype(np.float32) for name in "xyz"], axis=1)
    return Surface(points[np.isfinite(points).all(axis=1)])


def write_cloud(path: str | Path, columns: Mapping[str, NDArray[np.float32]]) -> None:
    """Write a cloud.

    Args:
        path: ends in .ply or .pcd.
        columns: (N,) each, "x", "y", "z" first.

    Raises:
        InputError: another ending.
        OutputError: the operating system refuses.
    """
    check_ending(path)
    if Path(path).suffix.lower() == ".pcd":
        write_pcd(path, columns)
        return
    rows: NDArray[Any] = np.empty(
        len(next(iter(columns.values()))), [(name, "<f4") for name in columns]
    )
    for name, column in columns.items():
        rows[name] = column
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment odomap",
        f"element vertex {len(rows)}",
        *(f"property float {name}" for name in columns),
        "end_header",
    ]
    with atomic_binary(path) as file:
        file.write(("\n".join(lines) + "\n").encode("ascii"))
        file.write(rows.tobytes())
