"""Payloads of keyframes, packed: what each measured, one after the other in a few long arrays.

Thousands of keyframes with five small arrays each would be as many members to find and check. So a
column holds the rows of all keyframes, and a table says how many rows each has: those of the n-th
begin at Σ_{m<n} rows_m. Reading all of them is one sweep; reading those of one keyframe is a seek,
and a checksum per keyframe says whether they are whole.

Reference: Apache Arrow project, "Arrow columnar format", version 1.4, 2023 (variable-size lists).
"""

import zlib
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.files.mapschema import PAYLOADS, Column
from odomap.files.zipwriter import ZipWriter
from odomap.maps.keyframes import Keyframe
from odomap.sensors.frame import ImuSamples

__all__ = ["add_payloads", "checked_table", "one_payload", "payload_of", "unpacked"]

WIDTHS: Mapping[str, tuple[int, int]] = MappingProxyType(
    {"features": (0, 4096), "scan": (0, 0), "cloud": (3, 4), "imu": (0, 0)}
)
"""Least and most numbers of a row, in the column whose rows have a width of their own."""

Parts = list[NDArray[Any]]
Table = Mapping[str, NDArray[Any]]


def parts_of(kind: str, keyframe: Keyframe) -> Parts | None:
    """Return the arrays of a payload in the order of its columns, or None where there is none.

    Raises:
        ValueError: an array is of another type or shape than it should be.
    """
    value: Any = getattr(keyframe, kind)
    if value is None:
        return None
    columns = PAYLOADS[kind]
    whole = isinstance(value, np.ndarray)
    parts: Parts = [value if whole else getattr(value, column.name) for column in columns]
    for column, part in zip(columns, parts):
        tail = part.shape[1:] if column.tail is None else column.tail
        fits = part.ndim >= 1 and part.shape == (len(parts[0]), *tail)
        if not fits or (column.tail is None and part.ndim != 2) or part.dtype.str != column.kind:
            what = f"{part.dtype.str} {part.shape}"
            raise ValueError(f"keyframe {keyframe.id}: {kind}/{column.name} is {what}")
    if kind == "cloud" and parts[0].shape[1] not in WIDTHS["cloud"]:
        raise ValueError(f"keyframe {keyframe.id}: cloud has {parts[0].shape[1]} numbers per point")
    return parts


def add_payloads(writer: ZipWriter, keyframes: Sequence[Keyframe]) -> None:
    """Write the payloads of keyframes, packed.

    Raises:
        ValueError: a payload cannot be kept: an array of another type, or a submap.
    """
    for keyframe in keyframes:
        if keyframe.submap is not None:
            raise ValueError(f"keyframe {keyframe.id}: submaps are not kept in map files yet")
    for kind, columns in PAYLOADS.items():
        packed = [(k.id, parts) for k in keyframes if (parts := parts_of(kind, k)) is not None]
        if not packed:
            continue
        wide = [n for n, column in enumerate(columns) if column.tail is None]
        rows = np.array([len(parts[0]) for _, parts in packed], np.int64)
        width = [parts[wide[0]].shape[1] if wide else 0 for _, parts in packed]
        writer.add(f"{kind}/keyframe", np.array([k for k, _ in packed], np.int64))
        writer.add(f"{kind}/rows", rows)
        writer.add(f"{kind}/width", np.array(width, np.int64))
        writer.add(f"{kind}/crc32", np.array([_checksum(p) for _, p in packed], np.uint32))
        for n, column in enumerate(columns):
            total = sum(parts[n].size for _, parts in packed)
            shape = (total,) if column.tail is None else (int(rows.sum()), *column.tail)
            pieces = (parts[n] for _, parts in packed)
            writer.add_rows(f"{kind}/{column.name}", column.kind, shape, pieces)


def checked_table(
    kind: str, table: Table, alive: NDArray[np.bool_], shapes: Mapping[str, Sequence[int]]
) -> None:
    """Make sure that a table of payloads fits to the keyframes and to the packed arrays.

    Args:
        kind: which payload.
        table: columns of `PAYLOAD_TABLE`.
        alive: (K,) whether a keyframe id is that of a living keyframe.
        shapes: of the packed arrays, by column.

    Raises:
        ValueError: says what does not fit.
    """
    ids, rows, width = (table[name] for name in ("keyframe", "rows", "width"))
    if len(ids) == 0 or (ids < 0).any() or (ids >= len(alive)).any() or not alive[ids].all():
        raise ValueError(f"{kind}/keyframe: names a keyframe that is not in the map")
    if (np.diff(ids) <= 0).any():
        raise ValueError(f"{kind}/keyframe: is not ascending")
    longest = max(shape[0] for shape in shapes.values())
    if (rows < 0).any() or (rows > longest).any() or rows.sum() > longest:
        raise ValueError(f"{kind}/rows: {rows.min()} to {rows.max()}, but there are {longest}")
    least, most = WIDTHS[kind]
    if (width < least).any() or (width > most).any():
        raise ValueError(f"{kind}/width: {width.min()} to {width.max()}, not {least} to {most}")
    for column in PAYLOADS[kind]:
        wanted = int((rows * width).sum() if column.tail is None else rows.sum())
        if shapes[column.name][0] != wanted:
            given = shapes[column.name][0]
            raise ValueError(f"{kind}/{column.name}: has {given} rows, but {wanted} are named")


def unpacked(
    kind: str, table: Table, read: Callable[[str], NDArray[Any]]
) -> dict[int, list[NDArray[Any]]]:
    """Return the arrays of each keyframe by its id.

    Args:
        kind: which payload.
        table: as checked by `checked_table`.
        read: gives a packed array by its name; one at a time is held.
    """
    ids = table["keyframe"].tolist()
    parts: dict[int, list[NDArray[Any]]] = {k: [] for k in ids}
    for column in PAYLOADS[kind]:
        packed = read(f"{kind}/{column.name}")
        ends = np.cumsum(_lengths(column, table)).tolist()
        for n, (k, start, end) in enumerate(zip(ids, [0, *ends], ends)):
            # A copy of its own, so that a keyframe that is culled frees what it held; one that may
            # be written, since kernels are compiled for those.
            part = packed[start:end].copy()
            parts[k].append(_shaped(column, part, table, n))
    return parts


def one_payload(
    kind: str,
    table: Table,
    position: int,
    read: Callable[[str, int, int], NDArray[Any]],
) -> list[NDArray[Any]]:
    """Return the arrays of the keyframe at one position of the table.

    Args:
        kind: which payload.
        table: as checked by `checked_table`.
        position: row of the table.
        read: gives rows first to end of a packed array: `read(name, first, end)`.

    Raises:
        ValueError: the checksum is wrong.
    """
    parts = []
    for column in PAYLOADS[kind]:
        lengths = _lengths(column, table)
        start = int(lengths[:position].sum())
        part = read(f"{kind}/{column.name}", start, start + int(lengths[position]))
        parts.append(_shaped(column, part, table, position))
    if _checksum(parts) != int(table["crc32"][position]):
        keyframe = int(table["keyframe"][position])
        raise ValueError(f"keyframe {keyframe}: the checksum of its {kind} is wrong")
    return parts


def payload_of(kind: str, parts: list[NDArray[Any]]) -> Any:
    """Return a payload made of its arrays.

    Raises:
        ValueError: they cannot be one.
    """
    if kind == "features":
        from odomap.vision.features import Features

        return Features(*parts)
    return ImuSamples(*parts) if kind == "imu" else parts[0]


def _lengths(column: Column, table: Table) -> NDArray[np.int64]:
    rows = table["rows"]
    return np.asarray(rows if column.tail is not None else rows * table["width"])


def _shaped(column: Column, part: NDArray[Any], table: Table, position: int) -> NDArray[Any]:
    if column.tail is not None:
        return part
    return part.reshape(int(table["rows"][position]), int(table["width"][position]))


def _checksum(parts: Sequence[NDArray[Any]]) -> int:
    crc = 0
    for part in parts:
        crc = zlib.crc32(np.ascontiguousarray(part).reshape(-1).view(np.uint8).data, crc)
    return crc
