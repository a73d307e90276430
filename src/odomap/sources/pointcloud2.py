"""PointCloud2: the message in which robots send clouds, as a table.

A message describes its own rows: fields of any name, type and place, rows with gaps between points
and lines, either order of bytes. What it says of sizes is checked against the bytes there are.

    point k of line l begins at byte  l · row_step + k · point_step

Reference: S. Macenski et al., "Robot Operating System 2", Science Robotics 7(66), 2022.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.files.pointtable import PointTable

__all__ = ["BadCloud", "table_of"]

KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


class BadCloud(Exception):
    """A message whose bytes are not what it says."""


def table_of(message: Any) -> PointTable:
    """Return the points of a message.

    Args:
        message: a PointCloud2 as rosbags decodes it.

    Raises:
        BadCloud: it cannot be what it says.
    """
    order = ">" if message.is_bigendian else "<"
    step, line = int(message.point_step), int(message.row_step)
    width, height = int(message.width), int(message.height)
    data = np.asarray(message.data, np.uint8)
    line = line if height > 1 else width * step
    needed = (height - 1) * line + width * step if width * height else 0
    if line < width * step:
        raise BadCloud(f"says rows of {line} bytes for {width} points of {step}")
    if needed > len(data):
        raise BadCloud(f"says {width} x {height} points of {step} bytes, but {len(data)} are there")
    names: list[str] = []
    places: list[int] = []
    kinds: list[str] = []
    for field in message.fields:
        kind = KINDS.get(int(field.datatype))
        if kind is None or int(field.count) > 1 or field.name in names:
            continue
        if int(field.offset) + np.dtype(kind).itemsize > step:
            raise BadCloud(f"says that '{field.name}' lies at byte {field.offset} of {step}")
        names.append(str(field.name))
        places.append(int(field.offset))
        kinds.append(order + kind)
    if not names or not width * height:
        none = {name: np.empty(0, kind) for name, kind in zip(names, kinds, strict=True)}
        return PointTable(none, 0)
    row = np.dtype({"names": names, "formats": kinds, "offsets": places, "itemsize": step})
    if line == width * step:
        rows = np.frombuffer(data[:needed].tobytes(), row)
    else:
        padded = np.zeros(height * line, np.uint8)
        padded[: min(len(data), height * line)] = data[: height * line]
        held = padded.reshape(height, line)[:, : width * step]
        rows = np.frombuffer(np.ascontiguousarray(held).tobytes(), row)
    columns: dict[str, NDArray[Any]] = {
        name: rows[name].astype(rows[name].dtype.newbyteorder("=")) for name in names
    }
    return PointTable(columns, len(rows), height)
