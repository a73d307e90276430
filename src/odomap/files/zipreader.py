"""Reading arrays from a zip file without trusting it.

Any unzip and `numpy.load` read such a file; here its directory is parsed by hand, since sizes have
to be known before anything is read:

    Σ declared sizes <= min(limit, 64 MiB + 64 · size of the file)       (no bomb)

Members neither overlap nor leave the file, no name is there twice, and what comes out has the size
and the CRC-32 that were declared. An array's header must be the very text that its declared type
and shape give: it is compared, not evaluated, and nothing is pickled. Rows of a stored array can be
read without the rest.

Reference: D. Fifield, "A better zip bomb", USENIX WOOT 2019 (overlapping members).
"""

import json
import os
import struct
import zlib
from collections.abc import Sequence
from itertools import pairwise
from math import prod
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.files.ziplayout import (
    CENTRAL,
    DEFLATED,
    END,
    LOCAL,
    LONGEST_MANIFEST,
    MANIFEST,
    STORED,
    Member,
    local_header,
    npy_header,
)

__all__ = ["ZipReader"]

MOST_MEMBERS = 256
FREE_BYTES, RATIO = 64 << 20, 64


class ZipReader:
    """A file of arrays, opened for reading; use it in a `with` block.

    Attributes:
        path: the file.
        size: its bytes.
        manifest: what the manifest says, plain JSON; checked by whoever knows what it should say.
        members: by name, the manifest not among them.
    """

    def __init__(self, path: str | Path, limit_mb: float = 4096.0) -> None:
        """Open a file, and read its directory and manifest.

        Args:
            path: the file.
            limit_mb: how much all members together may take when they are read.

        Raises:
            InputError: it cannot be read, is no zip, or cannot be true.
        """
        self.path = Path(path)
        try:
            self._file = open(self.path, "rb")  # noqa: SIM115 - closed by `close`
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read: {error.strerror or error}") from error
        try:
            self.size = self._file.seek(0, os.SEEK_END)
            self.members = self._directory(limit_mb)
            self.manifest = self._manifest()
        except OSError as error:
            self._file.close()
            raise InputError(f"{self.path}: cannot be read: {error.strerror or error}") from error
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def error(self, problem: str) -> InputError:
        """Return an error that names the file."""
        return InputError(f"{self.path}: {problem}")

    def array(self, name: str, kind: str, shape: Sequence[int], crc32: int) -> NDArray[Any]:
        """Read an array.

        Args:
            name: without `.npy`.
            kind: its type as declared.
            shape: as declared; `check_array` has compared both with the member's size.
            crc32: of the member, as declared.

        Returns:
            A new array that may be written.

        Raises:
            InputError: what is there has another checksum, type or shape.
        """
        member, head = self.members[f"{name}.npy"], npy_header(kind, shape)
        if member.crc32 != crc32:
            raise self.error(f"{member.name}: is another one than the manifest says")
        data = self._content(member)
        if data[: len(head)] != head:
            raise self.error(f"{member.name}: its header is not that of {kind} {tuple(shape)}")
        return np.frombuffer(data, np.dtype(kind), offset=len(head)).reshape(shape)

    def rows(
        self, name: str, kind: str, shape: Sequence[int], first: int, end: int
    ) -> NDArray[Any]:
        """Read some rows of an array that is stored; the checksum of the whole is not looked at.

        Args:
            name: without `.npy`.
            kind: its type as declared.
            shape: of the whole array as declared.
            first: first row.
            end: row after the last one, at most the number of rows.

        Raises:
            InputError: its type or shape is another one, or it is deflated.
        """
        member, head = self.members[f"{name}.npy"], npy_header(kind, shape)
        start = self._start(member)
        if member.is_deflated:
            raise self.error(f"{member.name}: is deflated, so rows of it cannot be read")
        if self._exactly(len(head)) != head:
            raise self.error(f"{member.name}: its header is not that of {kind} {tuple(shape)}")
        row = np.dtype(kind).itemsize * prod(shape[1:])
        self._file.seek(start + len(head) + first * row)
        data = self._exactly((end - first) * row)
        return np.frombuffer(data, np.dtype(kind)).reshape(end - first, *shape[1:])

    def check_array(self, name: str, kind: str, shape: Sequence[int]) -> None:
        """Make sure that a member is as large as its declared type and shape, before it is read.

        Raises:
            InputError: it is not there, or of another size.
        """
        member = self.members.get(f"{name}.npy")
        if member is None:
            raise self.error(f"{name}.npy: is missing: the file was changed")
        wanted = len(npy_header(kind, shape)) + np.dtype(kind).itemsize * prod(shape)
        if member.size != wanted:
            said = f"{kind} {tuple(shape)} takes {wanted} bytes"
            raise self.error(f"{member.name}: has {member.size} bytes, but {said}")

    def _directory(self, limit_mb: float) -> dict[str, Member]:
        self._file.seek(0)
        if self.size == 0:
            raise self.error("is empty: copy or save it again")
        if self._file.read(4) != b"PK\x03\x04":
            raise self.error("is no map file (no zip)")
        self._file.seek(max(0, self.size - END.size))
        tail = self._file.read(END.size)
        if len(tail) < END.size or tail[:4] != b"PK\x05\x06":
            raise self.error("its end is missing: it was cut off, copy or save it again")
        _, disk, start_disk, here, count, length, start, comment = END.unpack(tail)
        if disk or start_disk or here != count or comment:
            raise self.error("its directory is broken: copy or save it again")
        if count > MOST_MEMBERS or length > MOST_MEMBERS * 512:
            raise self.error(f"has {count} members: that is no map file")
        if start + length + END.size != self.size:
            raise self.error("its directory is broken: copy or save it again")
        self._file.seek(start)
        members = self._entries(self._exactly(length), count)
        spans = sorted((m.offset, m.offset + LOCAL.size + m.packed, m.name) for m in members)
        for (_, end, name), (after, _, _) in pairwise([*spans, (start, 0, "")]):
            if end > after:
                raise self.error(f"{name}: reaches into what comes after it")
        if any(not m.is_deflated and m.packed != m.size for m in members):
            raise self.error("its directory is broken: copy or save it again")
        total, allowed = sum(m.size for m in members), FREE_BYTES + RATIO * self.size
        if total > min(allowed, limit_mb * 2**20):
            raise self.error(
                f"would take {total / 2**20:.0f} MB unpacked: refused "
                f"(the limit for this file is {min(allowed / 2**20, limit_mb):.0f} MB)"
            )
        return {m.name: m for m in members}

    def _entries(self, data: bytearray, count: int) -> list[Member]:
        members: list[Member] = []
        names: set[str] = set()
        at = 0
        for _ in range(count):
            if at + CENTRAL.size > len(data):
                raise self.error("its directory is broken: copy or save it again")
            head = CENTRAL.unpack_from(data, at)
            signature, flags, method = head[0], head[3], head[4]
            crc, packed, size, long_name, long_extra, long_comment = head[7:13]
            at += CENTRAL.size
            name = data[at : at + long_name].decode("ascii", "replace")
            at += long_name + long_extra + long_comment
            if signature != b"PK\x01\x02" or at > len(data):
                raise self.error("its directory is broken: copy or save it again")
            if flags & ~0x800 or method not in (STORED, DEFLATED):
                raise self.error(f"{name!r}: is encrypted or packed in a way that is not read")
            if name in names:
                raise self.error(f"{name!r}: is there twice")
            names.add(name)
            members.append(Member(name, size, packed, crc, head[16], method == DEFLATED))
        if at != len(data):
            raise self.error("its directory is broken: copy or save it again")
        return members

    def _manifest(self) -> dict[str, Any]:
        member = self.members.pop(MANIFEST, None)
        if member is None:
            raise self.error(f"is no map file: it has no {MANIFEST}")
        if member.size > LONGEST_MANIFEST:
            raise self.error(f"{MANIFEST}: has {member.size} bytes, above {LONGEST_MANIFEST}")
        try:
            content = json.loads(self._content(member), parse_constant=_refuse)
        except (ValueError, RecursionError) as error:
            raise self.error(f"{MANIFEST}: is no JSON ({' '.join(str(error).split())})") from None
        if not isinstance(content, dict):
            raise self.error(f"{MANIFEST}: must be a mapping")
        return content

    def _start(self, member: Member) -> int:
        """Return where the content begins, after comparing the two headers of a member."""
        self._file.seek(member.offset)
        head, wanted = self._exactly(LOCAL.size), local_header(member)
        name_length, extra_length = struct.unpack_from("<2H", head, 26)
        name = self._exactly(name_length).decode("ascii", "replace")
        # signature; method; checksum and sizes: version, flags and time mean nothing here
        same = all(head[a:b] == wanted[a:b] for a, b in ((0, 4), (8, 10), (14, 26)))
        if not same or name != member.name:
            raise self.error(f"{member.name}: is not where the directory says")
        return self._file.seek(extra_length, os.SEEK_CUR)

    def _content(self, member: Member) -> bytearray:
        """Read and unpack a member, and compare its checksum."""
        self._file.seek(self._start(member))
        data = self._exactly(member.packed)
        if member.is_deflated:
            unpack = zlib.decompressobj(-15)
            try:
                data = bytearray(unpack.decompress(data, max(member.size, 1)))
            except zlib.error:
                data = bytearray()
            if not unpack.eof or unpack.unused_data or len(data) != member.size:
                raise self.error(f"{member.name}: is broken: copy or save the file again")
        if zlib.crc32(data) != member.crc32:
            raise self.error(f"{member.name}: its checksum is wrong: copy or save the file again")
        return data

    def _exactly(self, size: int) -> bytearray:
        data = bytearray(min(size, self.size))
        if self._file.readinto(data) != size:
            raise self.error("ends too early: it was cut off, copy or save it again")
        return data


def _refuse(word: str) -> None:
    raise ValueError(f"{word} is no number")
