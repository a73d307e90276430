"""Video files as containers: what kind they are, which codec, and whether the end is missing.

When a decoder refuses a file it does not say why. The container does: MP4 and MOV are a row of
boxes (size, kind, content) of which `moov` is the table of contents, written last, so that a
recording that was interrupted has none; AVI is one RIFF chunk, Matroska and WebM one segment, whose
sizes stand at the front. A size that reaches past the end of the file tells that it was cut.

Reference: ISO/IEC 14496-12:2022, "ISO base media file format".
"""

import os
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from odomap.errors import InputError

__all__ = ["Container", "inspect"]

HEAD_BYTES = 1 << 16
"""Where AVI and Matroska say their codec."""
TABLE_BYTES = 1 << 26
"""Largest table of contents that is looked through."""
_EBML = b"\x1a\x45\xdf\xa3"
_SEGMENT = b"\x18\x53\x80\x67"


@dataclass(frozen=True)
class Container:
    """What a video file says about itself.

    Attributes:
        kind: "MP4", "AVI", "Matroska", or "" for what is not known here.
        codec: its name in the file, such as "avc1" or "V_VP9"; empty where not found.
        is_cut: the file ends before the size it announces.
        has_contents: whether there is a table of contents, without which MP4 cannot be read.
    """

    kind: str = ""
    codec: str = ""
    is_cut: bool = False
    has_contents: bool = True


def inspect(path: Path) -> Container:
    """Read what a video file says about itself, without decoding.

    Raises:
        InputError: it cannot be read, or is empty.
    """
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            if size == 0:
                raise InputError(f"{path}: the file is empty: copy it again")
            head = file.read(HEAD_BYTES)
            if head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip"):
                return _mp4(file, size)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from error
    if head[:4] == b"RIFF" and head[8:12] == b"AVI ":
        return _avi(head, size)
    if head[:4] == _EBML:
        return _matroska(head, size)
    return Container()


def _mp4(file: BinaryIO, size: int) -> Container:
    at, table, is_cut = 0, None, False
    while at + 8 <= size:
        file.seek(at)
        length, kind = struct.unpack(">I4s", file.read(8))
        if length == 1:
            length = int.from_bytes(file.read(8), "big")
        elif length == 0:
            length = size - at
        if length < 8 or at + length > size:
            is_cut = True
            break
        if kind == b"moov":
            table = file.read(min(length, TABLE_BYTES))
        at += length
    codec = "" if table is None else _mp4_codec(table)
    return Container("MP4", codec, is_cut, table is not None)


def _mp4_codec(table: bytes) -> str:
    """Return the code of the sample description of the first track that is video."""
    for track in table.split(b"trak")[1:]:
        at = track.find(b"stsd")
        if b"vide" in track and at >= 0:
            return _text(track[at + 16 : at + 20])
    return ""


def _avi(head: bytes, size: int) -> Container:
    (length,) = struct.unpack_from("<I", head, 4)
    at = head.find(b"vids")
    codec = ""
    if at >= 0:
        # The stream's handler may be left empty; the bitmap header that follows has it, too.
        header = head.find(b"strf", at)
        codec = _text(head[at + 4 : at + 8]) or _text(head[header + 24 : header + 28])
    return Container("AVI", codec, length + 8 > size)


def _matroska(head: bytes, size: int) -> Container:
    codec = re.search(rb"V_[A-Z0-9/_.]+", head)
    at = head.find(_SEGMENT)
    is_cut = False
    if 0 <= at < len(head) - 12:
        first = head[at + 4]
        width = 9 - first.bit_length() if first else 8
        field = head[at + 4 : at + 4 + width]
        length = int.from_bytes(field, "big") & ((1 << 7 * width) - 1)
        # All ones: the size was not known while writing.
        known = length != (1 << 7 * width) - 1
        is_cut = known and at + 4 + width + length > size
    return Container("Matroska", codec[0].decode() if codec else "", is_cut)


def _text(code: bytes) -> str:
    return code.decode("latin-1").strip("\0 ") if code.strip(b"\0").isascii() else code.hex()
