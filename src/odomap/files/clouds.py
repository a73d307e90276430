"""Clouds and meshes as PLY, the format that every viewer reads.

A header in ASCII says which elements follow and what each row of them holds,

    ply
    format binary_little_endian 1.0
    element vertex 3
    property float x          (y, z, then nx ny nz, then uchar red green blue)
    element face 1
    property list uchar int vertex_indices
    end_header

and then come the rows, binary or as text. Written are float32 places and normals, uint8 colours,
triangles; the same surface gives the same bytes. Read is any PLY: both byte orders or text, other
types, other properties (passed over), faces of more corners (cut into triangles). Sizes are checked
against the file before anything is allocated: a header may say what it likes.

Reference: G. Turk, "The PLY polygon file format", Stanford University 1994.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.files.atomic import atomic_binary
from odomap.files.pointtable import PointTable, file_bytes
from odomap.maps.surface import Surface

__all__ = ["read_ply", "read_ply_points", "write_ply"]

_WORDS = (
    "char uchar short ushort int uint float double "
    "int8 uint8 int16 uint16 int32 uint32 float32 float64"
)
TYPES: Mapping[str, str] = MappingProxyType(
    dict(zip(_WORDS.split(), ("i1 u1 i2 u2 i4 u4 f4 f8 " * 2).split(), strict=True))
)
FORMATS: Mapping[str, str] = MappingProxyType(
    {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
)
LONGEST_HEADER = 1 << 16
COLOUR = ("red", "green", "blue")
NORMAL = ("nx", "ny", "nz")


@dataclass
class _Property:
    name: str
    kind: str
    count_kind: str = ""
    """Type of the number of entries of a list; empty for a single value."""


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property]


def write_ply(path: str | Path, surface: Surface, text: bool = False) -> None:
    """Write a cloud or a mesh.

    Args:
        path: the file.
        surface: points, with normals, colours and triangles where there are any.
        text: as ASCII instead of binary.

    Raises:
        OutputError: the operating system refuses.
    """
    parts: list[tuple[Sequence[str], str, NDArray[Any] | None]] = [
        (tuple("xyz"), "<f4", surface.points),
        (NORMAL, "<f4", surface.normals),
        (COLOUR, "u1", surface.colours),
    ]
    columns = [
        (name, kind, array[:, k])
        for names, kind, array in parts
        if array is not None
        for k, name in enumerate(names)
    ]
    rows = np.empty(len(surface.points), [(name, kind) for name, kind, _ in columns])
    for name, _, values in columns:
        rows[name] = values
    faces = np.empty(len(surface.faces), [("n", "u1"), ("rows", "<i4", (3,))])
    faces["n"], faces["rows"] = 3, surface.faces
    with atomic_binary(path) as file:
        header = _header(surface, [(name, kind) for name, kind, _ in columns], text)
        file.write(header.encode("ascii"))
        if text:
            for row in rows:
                file.write((" ".join(f"{value:.9g}" for value in row) + "\n").encode("ascii"))
            for a, b, c in surface.faces:
                file.write(f"3 {a} {b} {c}\n".encode("ascii"))
        else:
            file.write(rows.tobytes())
            file.write(faces.tobytes())


def _header(surface: Surface, names: list[tuple[str, str]], text: bool) -> str:
    words = {"<f4": "float", "u1": "uchar"}
    lines = [
        "ply",
        f"format {'ascii' if text else 'binary_little_endian'} 1.0",
        "comment odomap",
        f"element vertex {len(surface.points)}",
        *(f"property {words[kind]} {name}" for name, kind in names),
    ]
    if len(surface.faces):
        lines += [
            f"element face {len(surface.faces)}",
            "property list uchar int vertex_indices",
        ]
    return "\n".join([*lines, "end_header", ""])


def read_ply(path: str | Path) -> Surface:
    """Read a cloud or a mesh.

    Args:
        path: a PLY file, binary or ASCII.

    Returns:
        Its points, with normals, colours and triangles where the file has them.

    Raises:
        InputError: no PLY, a header that cannot be, or a file that ends too early.
    """
    file = Path(path)
    return _surface(file, _elements(file))


def read_ply_points(path: str | Path) -> PointTable:
    """Read all that a PLY says of its vertices: also intensities, times and beams.

    Raises:
        InputError: no PLY, a header that cannot be, or a file that ends too early.
    """
    file = Path(path)
    vertex = _elements(file).get("vertex", {})
    columns = {name: np.asarray(column) for name, column in vertex.items()}
    columns = {name: column for name, column in columns.items() if column.ndim == 1}
    if any(name not in columns for name in "xyz"):
        raise InputError(f"{file}: has no vertices with x, y and z")
    return PointTable(columns, len(columns["x"]))


def _elements(file: Path) -> dict[str, Any]:
    """Return the columns of each element of a file."""
    data = file_bytes(file)
    order, elements, start = _parse_header(file, data)
    if not order:
        return _text_rows(file, elements, data[start:])
    found: dict[str, Any] = {}
    body = memoryview(data)[start:]
    for element in elements:
        rows, used = _binary_rows(file, element, body, order)
        body = body[used:]
        found[element.name] = rows
    return found


def _parse_header(file: Path, data: bytes) -> tuple[str, list[_Element], int]:
    """Return byte order ("" for text), elements, and where the rows begin."""
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r"):
        raise InputError(f"{file}: is no PLY file: it does not begin with a line 'ply'")
    end = data.find(b"end_header", 0, LONGEST_HEADER)
    if end < 0:
        raise InputError(f"{file}: the header has no end: there is no line 'end_header'")
    start = end + len("end_header")
    start += 2 if data[start : start + 2] == b"\r\n" else 1
    order: str | None = None
    elements: list[_Element] = []
    for number, line in enumerate(data[:end].decode("latin-1").splitlines()[1:], 2):
        words = line.split()
        try:
            if not words or words[0] in ("comment", "obj_info"):
                continue
            if words[0] == "format":
                order = FORMATS[words[1]]
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2]), []))
                if elements[-1].count < 0:
                    raise ValueError
            elif words[:2] == ["property", "list"]:
                elements[-1].properties.append(
                    _Property(words[4], TYPES[words[3]], TYPES[words[2]])
                )
            elif words[0] == "property":
                elements[-1].properties.append(_Property(words[2], TYPES[words[1]]))
            else:
                raise ValueError
        except (KeyError, IndexError, ValueError):
            raise InputError(f"{file}:{number}: '{line.strip()}' cannot be read") from None
    if order is None:
        raise InputError(f"{file}: the header names no format")
    for element in elements:
        names = {p.name for p in element.properties}
        if not names or len(names) < len(element.properties):
            what = "two properties of one name" if names else "no properties"
            raise InputError(f"{file}: element '{element.name}' has {what}")
    return order, elements, start


def _binary_rows(
    file: Path, element: _Element, body: memoryview, order: str
) -> tuple[dict[str, Any], int]:
    """Return an element's columns, and how many bytes it took."""
    single = [p for p in element.properties if not p.count_kind]
    if len(single) == len(element.properties):
        kind = np.dtype([(p.name, order + p.kind) for p in element.properties])
        size = kind.itemsize * element.count
        if size > len(body):
            raise _too_short(file, element, len(body) // max(kind.itemsize, 1))
        rows = np.frombuffer(body, kind, element.count) if size else np.empty(0, kind)
        return {name: rows[name] for name in kind.names or ()}, size
    if len(element.properties) == 1:
        return _binary_list(file, element, body, order)
    return _mixed_rows(file, element, body, order)


def _binary_list(
    file: Path, element: _Element, body: memoryview, order: str
) -> tuple[dict[str, Any], int]:
    """Read an element of one list: all at once where all lists are as long as the first."""
    (only,) = element.properties
    head = np.dtype(order + only.count_kind)
    if element.count and len(body) >= head.itemsize:
        length = int(np.frombuffer(body[: head.itemsize], head)[0])
        if 0 <= length <= len(body):
            kind = np.dtype([("n", head), ("rows", order + only.kind, (length,))])
            size = kind.itemsize * element.count
            if size <= len(body):
                rows = np.frombuffer(body[:size], kind)
                if np.all(rows["n"] == length):
                    return {only.name: rows["rows"]}, size
    return _mixed_rows(file, element, body, order)


def _mixed_rows(
    file: Path, element: _Element, body: memoryview, order: str
) -> tuple[dict[str, Any], int]:
    """Read rows of lists of any length, one value after the other."""
    columns: dict[str, list[Any]] = {p.name: [] for p in element.properties}
    at = 0
    for row in range(element.count):
        for one in element.properties:
            length = 1
            if one.count_kind:
                head = np.dtype(order + one.count_kind)
                if at + head.itemsize > len(body):
                    raise _too_short(file, element, row)
                length = int(np.frombuffer(body[at : at + head.itemsize], head)[0])
                at += head.itemsize
            kind = np.dtype(order + one.kind)
            end = at + length * kind.itemsize
            if length < 0 or end > len(body):
                raise _too_short(file, element, row)
            values = np.frombuffer(body[at:end], kind)
            columns[one.name].append(values if one.count_kind else values[0])
            at = end
    return dict(columns), at


def _text_rows(file: Path, elements: list[_Element], body: bytes) -> dict[str, Any]:
    """Read rows of text, one per line."""
    lines = [line for line in body.decode("latin-1").splitlines() if line.strip()]
    found: dict[str, Any] = {}
    at = 0
    for element in elements:
        columns: dict[str, list[Any]] = {p.name: [] for p in element.properties}
        if at + element.count > len(lines):
            raise _too_short(file, element, len(lines) - at)
        for line in lines[at : at + element.count]:
            try:
                words = iter(line.split())
                for one in element.properties:
                    value: Callable[[str], float] = float if one.kind[0] == "f" else int
                    if one.count_kind:
                        length = int(next(words))
                        columns[one.name].append([value(next(words)) for _ in range(length)])
                    else:
                        columns[one.name].append(value(next(words)))
            except (ValueError, OverflowError, StopIteration):
                raise InputError(f"{file}: '{line.strip()[:60]}' is no {element.name}") from None
        found[element.name] = columns
        at += element.count
    return found


def _too_short(file: Path, element: _Element, rows: int) -> InputError:
    return InputError(
        f"{file}: ends after {max(rows, 0)} of {element.count} rows of '{element.name}': "
        "is it cut off?"
    )


def _surface(file: Path, found: Mapping[str, Mapping[str, Any]]) -> Surface:
    """Make a surface of the columns that mean something here."""
    vertex = found.get("vertex", {})
    if any(name not in vertex for name in "xyz"):
        raise InputError(f"{file}: has no vertices with x, y and z")
    points = _stack(vertex, tuple("xyz"), np.float32)
    normals = _stack(vertex, NORMAL, np.float32) if all(n in vertex for n in NORMAL) else None
    colours = _colours(vertex) if all(name in vertex for name in COLOUR) else None
    face = found.get("face", {})
    corners: Any = face.get("vertex_indices", face.get("vertex_index", ()))
    faces = _triangles(corners)
    if len(faces) and not 0 <= faces.min() <= faces.max() < len(points):
        raise InputError(f"{file}: a face names a vertex that is not among the {len(points)}")
    return Surface(points, normals, colours, faces.astype(np.int32))


def _colours(vertex: Mapping[str, Any]) -> NDArray[np.uint8]:
    """Return (N, 3) colours; as numbers with a point they are shares from 0 to 1."""
    values = _stack(vertex, COLOUR, np.float64)
    if len(values) and np.asarray(vertex["red"]).dtype.kind == "f" and np.nanmax(values) <= 1.0:
        values = 255.0 * values
    return np.asarray(np.clip(np.nan_to_num(values) + 0.5, 0.0, 255.0), np.uint8)


def _stack(vertex: Mapping[str, Any], names: tuple[str, ...], kind: Any) -> NDArray[Any]:
    return np.ascontiguousarray(np.stack([np.asarray(vertex[n], kind) for n in names], axis=1))


def _triangles(corners: Any) -> NDArray[np.int64]:
    """Cut polygons into fans of triangles."""
    if isinstance(corners, np.ndarray) and corners.ndim == 2:
        fans = [corners[:, [0, k, k + 1]] for k in range(1, corners.shape[1] - 1)]
        return np.concatenate(fans).astype(np.int64) if fans else np.zeros((0, 3), np.int64)
    fan = [(c[0], c[k], c[k + 1]) for c in corners for k in range(1, len(c) - 1)]
    return np.array(fan, np.int64).reshape(-1, 3)
