"""Clouds as PCD, the format of the Point Cloud Library: any fields, as text, binary or compressed.

    # .PCD v0.7
    FIELDS x y z intensity t ring           names; '_' is padding
    SIZE 4 4 4 4 4 2                        bytes of a value
    TYPE F F F F U U                        float, signed, unsigned
    COUNT 1 1 1 1 1 1                       values of a field
    WIDTH 1024                              HEIGHT 64: rows of an organised cloud, else 1
    POINTS 65536
    DATA ascii | binary | binary_compressed

Binary rows follow each other without gaps. Compressed are columns, one after the other, by LZF: a
control byte c < 32 is followed by c + 1 bytes as they are; else the c >> 5 (or a byte more, for 7)
plus 2 bytes that stood ((c & 31) << 8 | next byte) + 1 before are repeated. A byte makes at most
88, so what a header announces is checked against the file before anything is allocated.

Reference: R. B. Rusu, S. Cousins, "3D is here: Point Cloud Library (PCL)", ICRA 2011.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.files.atomic import atomic_binary
from odomap.files.pointtable import PointTable, file_bytes
from odomap.kernels import kernel

__all__ = ["read_pcd", "write_pcd"]

Bytes = NDArray[np.uint8]

LONGEST_HEADER = 1 << 14
MOST_PER_BYTE = 88
"""LZF makes at most 264 bytes of 3."""
KINDS = {
    **{f"F{size}": f"<f{size}" for size in (4, 8)},
    **{f"{kind}{size}": f"<{kind.lower()}{size}" for kind in "IU" for size in (1, 2, 4, 8)},
}
FORMS = ("ascii", "binary", "binary_compressed")
PADDING = "_"


@dataclass(frozen=True)
class _Header:
    names: list[str]
    kinds: list[str]
    counts: list[int]
    width: int
    height: int
    form: str
    start: int
    """Where the rows begin."""

    @property
    def points(self) -> int:
        return self.width * self.height

    @property
    def row(self) -> np.dtype[Any]:
        """A row; fields of several values are arrays, and no name comes twice."""
        names = [f"{k}:{name}" for k, name in enumerate(self.names)]
        parts = zip(names, self.kinds, self.counts, strict=True)
        return np.dtype([(n, kind, (c,)) if c > 1 else (n, kind) for n, kind, c in parts])


def read_pcd(path: str | Path) -> PointTable:
    """Read a cloud.

    Args:
        path: a PCD file of any form.

    Raises:
        InputError: no PCD, a header that cannot be, or a file that ends too early.
    """
    file = Path(path)
    data = file_bytes(file)
    header = _parse_header(file, data)
    body = data[header.start :]
    if header.form == "ascii":
        columns = _text_columns(file, header, body)
    elif header.form == "binary":
        columns = _row_columns(file, header, body)
    else:
        columns = _packed_columns(file, header, body)
    named: dict[str, NDArray[Any]] = {}
    for name, column in zip(header.names, columns, strict=True):
        if name != PADDING and column.ndim == 1:
            named.setdefault(name, column)
    return PointTable(named, header.points, header.height)


def _parse_header(file: Path, data: bytes) -> _Header:
    found: dict[str, tuple[int, list[str]]] = {}
    at, number = 0, 0
    while "DATA" not in found:
        end = data.find(b"\n", at, LONGEST_HEADER)
        if end < 0:
            raise InputError(f"{file}: is no PCD file: its header has no line 'DATA'")
        words = data[at:end].decode("latin-1").split()
        at, number = end + 1, number + 1
        if words and not words[0].startswith("#"):
            found[words[0].upper()] = number, words[1:]

    def words_of(name: str) -> list[str]:
        if name not in found:
            raise InputError(f"{file}: the header has no line '{name}'")
        return found[name][1]

    def numbers(name: str) -> list[int]:
        try:
            values = [int(word) for word in words_of(name)]
            if not values or min(values) < 0:
                raise ValueError
        except ValueError:
            raise _strange(file, name, *found[name]) from None
        return values

    names, sizes = words_of("FIELDS"), numbers("SIZE")
    counts = numbers("COUNT") if "COUNT" in found else [1] * len(names)
    types = words_of("TYPE")
    if not len(names) == len(sizes) == len(types) == len(counts):
        raise InputError(f"{file}: FIELDS, SIZE, TYPE and COUNT are not equally long")
    kinds = [KINDS.get(f"{kind.upper()}{size}", "") for kind, size in zip(types, sizes)]
    if "" in kinds or 0 in counts or sum(counts) > LONGEST_HEADER:
        raise _strange(file, "TYPE", *found["TYPE"])
    width, height = numbers("WIDTH")[0], numbers("HEIGHT")[0] if "HEIGHT" in found else 1
    if "POINTS" in found and numbers("POINTS")[0] != width * height:
        said = numbers("POINTS")[0]
        raise InputError(f"{file}: POINTS {said} is not WIDTH times HEIGHT, {width} x {height}")
    form = " ".join(words_of("DATA")).lower()
    if form not in FORMS:
        raise _strange(file, "DATA", *found["DATA"])
    return _Header(names, kinds, counts, width, height, form, at)


def _strange(file: Path, name: str, line: int, words: list[str]) -> InputError:
    return InputError(f"{file}:{line}: '{name} {' '.join(words)[:60]}' cannot be read")


def _too_short(file: Path, header: _Header, needed: int, there: int) -> InputError:
    return InputError(
        f"{file}: the header says {header.points} points, which are {needed} bytes, but {there} "
        "follow: is it cut off?"
    )


def _text_columns(file: Path, header: _Header, body: bytes) -> list[NDArray[Any]]:
    words = body.split()
    width = sum(header.counts)
    if len(words) != header.points * width:
        raise InputError(
            f"{file}: the header says {header.points} points of {width} numbers, but "
            f"{len(words)} numbers follow: is it cut off?"
        )
    try:
        values = np.array(words, np.float64).reshape(header.points, width)
    except ValueError as error:
        raise InputError(f"{file}: {error}: the rows must hold numbers") from None
    columns, at = [], 0
    for count in header.counts:
        columns.append(values[:, at] if count == 1 else values[:, at : at + count])
        at += count
    return columns


def _row_columns(file: Path, header: _Header, body: bytes) -> list[NDArray[Any]]:
    row = header.row
    needed = row.itemsize * header.points
    if needed > len(body):
        raise _too_short(file, header, needed, len(body))
    rows = np.frombuffer(body, row, header.points) if needed else np.empty(0, row)
    return [rows[name] for name in row.names or ()]


def _packed_columns(file: Path, header: _Header, body: bytes) -> list[NDArray[Any]]:
    needed = header.row.itemsize * header.points
    if len(body) < 8:
        if needed == 0:
            return [np.empty(0, kind) for kind in header.kinds]
        raise _too_short(file, header, needed, len(body))
    packed, unpacked = np.frombuffer(body[:8], "<u4").astype(int).tolist()
    if packed > len(body) - 8:
        raise InputError(
            f"{file}: {packed} compressed bytes are announced, but {len(body) - 8} follow: is it "
            "cut off?"
        )
    if unpacked != needed or unpacked > MOST_PER_BYTE * packed:
        raise InputError(
            f"{file}: the header says {header.points} points, which are {needed} bytes, but "
            f"{packed} compressed bytes for {unpacked} follow"
        )
    out = np.empty(unpacked, np.uint8)
    if _unpack(np.frombuffer(body[8 : 8 + packed], np.uint8), out) != unpacked:
        raise InputError(f"{file}: the compressed points are damaged: copy it again")
    columns, at = [], 0
    for kind, count in zip(header.kinds, header.counts):
        size = np.dtype(kind).itemsize * count * header.points
        column = out[at : at + size].view(kind)
        columns.append(column if count == 1 else column.reshape(header.points, count))
        at += size
    return columns


@kernel
def _unpack(packed: Bytes, out: Bytes) -> int:
    """out: LZF's bytes unpacked. Returns how many, or -1 if it reads or writes past an end."""
    n, m, at, to = len(packed), len(out), 0, 0
    while at < n:
        control = int(packed[at])
        at += 1
        if control < 32:
            count = control + 1
            if at + count > n or to + count > m:
                return -1
            for k in range(count):
                out[to + k] = packed[at + k]
            at += count
        else:
            count = control >> 5
            if count == 7:
                if at >= n:
                    return -1
                count += int(packed[at])
                at += 1
            count += 2
            if at >= n:
                return -1
            back = ((control & 31) << 8) + int(packed[at]) + 1
            at += 1
            if back > to or to + count > m:
                return -1
            for k in range(count):  # may overlap what it writes
                out[to + k] = out[to - back + k]
        to += count
    return to


def write_pcd(path: str | Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write a cloud, binary.

    Args:
        path: the file.
        columns: (N,) each, "x", "y", "z" first; float64 is written as float32.

    Raises:
        OutputError: the operating system refuses.
    """
    narrowed = {
        name: np.asarray(c, "<f4") if c.dtype.kind == "f" else c.astype(c.dtype.newbyteorder("<"))
        for name, c in columns.items()
    }
    row = np.dtype([(name, column.dtype) for name, column in narrowed.items()])
    rows = np.empty(len(next(iter(narrowed.values()))), row)
    for name, column in narrowed.items():
        rows[name] = column
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(narrowed)}",
        f"SIZE {' '.join(str(c.dtype.itemsize) for c in narrowed.values())}",
        f"TYPE {' '.join(c.dtype.kind.upper() for c in narrowed.values())}",
        f"COUNT {' '.join('1' for _ in narrowed)}",
        f"WIDTH {len(rows)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(rows)}",
        "DATA binary",
    ]
    with atomic_binary(path) as file:
        file.write(("\n".join(lines) + "\n").encode("ascii"))
        file.write(rows.tobytes())


def warm_up() -> None:
    """Compile the kernels of this file."""
    _unpack(np.zeros(2, np.uint8), np.zeros(1, np.uint8))
