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
from odomap.files.pcd import write_pcd

__all__ = ["ENDINGS", "check_ending", "write_cloud"]

ENDINGS = (".ply", ".pcd")


def check_ending(path: str | Path) -> None:
    """Raise an InputError unless a file can be written by its name."""
    if Path(path).suffix.lower() not in ENDINGS:
        raise InputError(f"{path}: give a name that ends in {' or '.join(ENDINGS)}")


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
