"""Writing arrays into one zip file, member by member, without a copy of them.

The checksum and the deflated size of a member are known once it is written, and so its header is
filled in then. A member is deflated where a sample of it shrinks by a third: tables of ids do, and
what is unknown throughout; descriptors and directions do not. The same arrays give the same bytes.

Reference: P. Deutsch, "DEFLATE compressed data format specification version 1.3", RFC 1951, 1996.
"""

import json
import zlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.files.ziplayout import (
    CENTRAL,
    DATE,
    DEFLATED,
    END,
    LARGEST_FILE,
    LOCAL,
    LONGEST_MANIFEST,
    MANIFEST,
    STORED,
    Member,
    local_header,
    npy_header,
)

__all__ = ["ZipWriter"]

SAMPLE = 1 << 16
"""Bytes that are deflated to see whether a member is worth it."""


class ZipWriter:
    """Writes members one after the other, then manifest and directory."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._members: list[Member] = []
        self.arrays: dict[str, dict[str, Any]] = {}
        """What was written, for the manifest: dtype, shape and crc32 by name."""

    def add(self, name: str, array: NDArray[Any], *, packs: bool = True) -> None:
        """Write an array as NAME.npy.

        Args:
            name: without `.npy`.
            array: of a plain type.
            packs: whether it may be deflated; it is where that saves a third.
        """
        values = np.ascontiguousarray(array).reshape(array.shape)
        self.add_rows(name, values.dtype.str, values.shape, [values], packs=packs)

    def add_rows(
        self,
        name: str,
        kind: str,
        shape: Sequence[int],
        parts: Iterable[NDArray[Any]],
        *,
        packs: bool = False,
    ) -> None:
        """Write an array that comes in C-contiguous parts; see `add`."""
        crc = self._write(f"{name}.npy", [npy_header(kind, shape), *map(_bytes, parts)], packs)
        self.arrays[name] = {"dtype": kind, "shape": [int(n) for n in shape], "crc32": crc}

    def close(self, manifest: Mapping[str, Any]) -> None:
        """Write manifest and directory.

        Raises:
            InputError: the manifest is too long, or the file larger than 4 GiB.
        """
        text = json.dumps(manifest, indent=1, ensure_ascii=True, allow_nan=False) + "\n"
        if len(text) > LONGEST_MANIFEST:
            raise InputError(f"the manifest has {len(text)} bytes, above {LONGEST_MANIFEST}")
        self._write(MANIFEST, [text.encode("ascii")], True)
        start = self._file.tell()
        for m in self._members:
            name = m.name.encode("ascii")
            method = DEFLATED if m.is_deflated else STORED
            sizes = m.crc32, m.packed, m.size, len(name)
            head = b"PK\x01\x02", 20, 20, 0, method, 0, DATE, *sizes, 0, 0, 0, 0, 0, m.offset
            self._file.write(CENTRAL.pack(*head) + name)
        end, count = self._file.tell(), len(self._members)
        if end > LARGEST_FILE:
            raise InputError("a file of arrays cannot be larger than 4 GiB")
        self._file.write(END.pack(b"PK\x05\x06", 0, 0, count, count, end - start, start, 0))

    def _write(self, name: str, parts: list[Any], packs: bool) -> int:
        """Write header and content, and return the content's CRC-32."""
        deflated = packs and _is_packable(parts)
        squeeze = zlib.compressobj(1, zlib.DEFLATED, -15) if deflated else None
        offset, crc, size = self._file.tell(), 0, 0
        if offset > LARGEST_FILE:
            raise InputError("a file of arrays cannot be larger than 4 GiB")
        encoded = name.encode("ascii")
        self._file.write(bytes(LOCAL.size) + encoded)
        for part in parts:
            crc, size = zlib.crc32(part, crc), size + len(part)
            self._file.write(part if squeeze is None else squeeze.compress(part))
        if squeeze is not None:
            self._file.write(squeeze.flush())
        end = self._file.tell()
        packed = end - offset - LOCAL.size - len(encoded)
        if max(size, packed) > LARGEST_FILE:
            raise InputError("a file of arrays cannot be larger than 4 GiB")
        member = Member(name, size, packed, crc, offset, deflated)
        self._file.seek(offset)
        self._file.write(local_header(member))
        self._file.seek(end)
        self._members.append(member)
        return crc


def _is_packable(parts: list[Any]) -> bool:
    """Return whether deflating saves a third, judged by the beginning."""
    sample = b"".join(bytes(part[:SAMPLE]) for part in parts[:2])
    return len(sample) > 512 and len(zlib.compress(sample, 1)) < 0.67 * len(sample)


def _bytes(array: NDArray[Any]) -> memoryview:
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
