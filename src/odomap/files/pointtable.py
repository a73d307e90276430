"""Tables of points: the columns of a cloud as a file names them, and NPY and LAS files as such.

Formats differ in names, types and units of what they say of a point, and what a name means is for
those who know the recording. Here columns are columns. A file says how many rows it has; that is
checked against its size before anything is allocated.

NPY: an array with named fields, or plain rows x y z, intensity, and then what looks like beams
(whole numbers below 256) or times. Pickles are refused: they could run code. LAS: the ASPRS format
of surveys, through `laspy` (extra `lidar`).

Reference: ASPRS, "LAS specification 1.4 - R15", 2019.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError, MissingExtra

__all__ = ["PointTable", "file_bytes", "read_las", "read_npy"]

LAS_HEADER = 227
"""Bytes of the shortest header of a LAS file."""
MOST_BEAMS, MOST_COLUMNS = 256, 64


@dataclass(frozen=True, eq=False)
class PointTable:
    """Points as a file has them.

    Attributes:
        columns: (N,) each, by name; any types.
        count: N.
        height: rows of an organised cloud, 1 of one without order; N is a multiple.
    """

    columns: Mapping[str, NDArray[Any]]
    count: int
    height: int = 1


def file_bytes(file: Path) -> bytes:
    """Return what a file holds.

    Raises:
        InputError: it cannot be read.
    """
    try:
        return file.read_bytes()
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror or error}") from error


def read_npy(path: str | Path) -> PointTable:
    """Read an array of points.

    Args:
        path: an NPY file: (N, 3) or more columns, or (N,) with named fields.

    Raises:
        InputError: no NPY, objects in it, another shape, or a file that ends too early.
    """
    file = Path(path)
    try:
        with file.open("rb") as stream:
            version = np.lib.format.read_magic(stream)
            read = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}
            if version[0] not in read:
                raise ValueError(f"version {version[0]}.{version[1]} is not known")
            shape, is_fortran, kind = read[version[0]](stream)
            if kind.hasobject:
                raise ValueError("holds objects, which could run code; save numbers")
            start = stream.tell()
            there = stream.seek(0, 2) - start
            count = int(np.prod(shape, dtype=object))
            needed = count * kind.itemsize
            if needed > there:
                raise ValueError(f"ends after {there} of {needed} bytes: is it cut off?")
            stream.seek(start)
            values = np.frombuffer(stream.read(needed), kind, count)
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise InputError(f"{file}: {' '.join(str(error).split())}") from error
    array = values.reshape(shape, order="F" if is_fortran else "C")
    if kind.names:
        flat = array.reshape(-1)
        return PointTable({name: flat[name] for name in kind.names}, len(flat))
    if array.ndim != 2 or array.shape[1] < 3 or kind.kind not in "fiu":
        raise InputError(
            f"{file}: is {kind} of shape {shape}: rows x y z [intensity ...] are needed"
        )
    if array.shape[1] > MOST_COLUMNS:
        raise InputError(
            f"{file}: is of shape {shape}: a row is a point, x y z [intensity ...]; transpose it"
        )
    columns = {name: array[:, k] for k, name in zip(range(4), ("x", "y", "z", "intensity"))
               if k < array.shape[1]}  # fmt: skip
    for k in range(4, array.shape[1]):
        column = array[:, k]
        with np.errstate(invalid="ignore"):
            is_beam = bool(np.all((column >= 0) & (column < MOST_BEAMS) & (column % 1 == 0)))
        columns.setdefault("ring" if is_beam else "time", column)
    return PointTable(columns, len(array))


def read_las(path: str | Path) -> PointTable:
    """Read a LAS file.

    Args:
        path: the file; compressed ones (.laz) must be unpacked first.

    Raises:
        MissingExtra: laspy is not installed.
        InputError: no LAS, a compressed one, or a file that ends too early.
    """
    file = Path(path)
    try:
        import laspy
    except ImportError as error:
        raise MissingExtra(f"{file}: LAS needs laspy: pip install 'odomap[lidar]'") from error
    data = file_bytes(file)
    if data[:4] != b"LASF" or len(data) < LAS_HEADER:
        raise InputError(f"{file}: is no LAS file")
    minor, form = data[25], data[104]
    if form & 0xC0:
        raise InputError(f"{file}: is compressed (LAZ): unpack it to .las first")
    start, length = struct.unpack_from("<I", data, 96)[0], struct.unpack_from("<H", data, 105)[0]
    count = struct.unpack_from("<I", data, 107)[0]
    if minor >= 4 and len(data) >= 255:
        count = struct.unpack_from("<Q", data, 247)[0]
    if start + count * length > len(data):
        raise InputError(
            f"{file}: the header says {count} points of {length} bytes, but {len(data) - start} "
            "bytes follow: is it cut off?"
        )
    try:
        cloud = laspy.read(file)
    # What is wrong within the file fails as anything in the library.
    except Exception as error:
        raise InputError(f"{file}: cannot be read: {' '.join(str(error).split())}") from error
    names = [n for n in cloud.point_format.dimension_names if n not in ("X", "Y", "Z")]
    columns = {name: np.asarray(cloud[name]) for name in ("x", "y", "z", *names)}
    return PointTable({n: c for n, c in columns.items() if c.ndim == 1}, len(columns["x"]))
