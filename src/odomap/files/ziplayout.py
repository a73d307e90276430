"""How arrays lie in a zip: headers of members and of .npy files, the same for writer and reader.

A member is a local header, a name, and its content, stored or deflated; after the last member comes
the directory, an entry for each, and an end record of 22 bytes that says where it begins,

    [local header, name, content] ...  [entry, name] ...  end

The content of an array is a .npy file, version 1.0: a header that names type and shape, then the
numbers. All fields that could differ between two runs (time, system, comments) are constants.

Reference: PKWARE Inc., ".ZIP File Format Specification", version 6.3.10, 2022, section 4.3.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

__all__ = [
    "CENTRAL",
    "DATE",
    "DEFLATED",
    "END",
    "LARGEST_FILE",
    "LOCAL",
    "LONGEST_MANIFEST",
    "MANIFEST",
    "STORED",
    "Member",
    "local_header",
    "npy_header",
]

MANIFEST = "manifest.json"
LONGEST_MANIFEST = 1 << 20
LARGEST_FILE = (1 << 32) - 1

LOCAL = struct.Struct("<4s5H3L2H")
CENTRAL = struct.Struct("<4s6H3L5H2L")
END = struct.Struct("<4s4H2LH")
STORED, DEFLATED = 0, 8
DATE = 0x21
"""1 January 1980, the first day of zip."""


@dataclass(frozen=True)
class Member:
    """Where a member lies.

    Attributes:
        name: as in the directory.
        size: bytes of its content.
        packed: bytes it takes in the file.
        crc32: of its content.
        offset: of its header in the file.
        is_deflated: else it is stored.
    """

    name: str
    size: int
    packed: int
    crc32: int
    offset: int
    is_deflated: bool


def npy_header(kind: str, shape: Sequence[int]) -> bytes:
    """Return the header (version 1.0) of a .npy file of C order.

    Args:
        kind: type as in `numpy.dtype.str`.
        shape: of the array.
    """
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {tuple(shape)}, }}"
    pad = -(10 + len(text) + 1) % 64
    body = text.encode("ascii") + b" " * pad + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(body)) + body


def local_header(m: Member) -> bytes:
    """Return the header in front of a member's name and content."""
    method, long_name = DEFLATED if m.is_deflated else STORED, len(m.name)
    sizes = m.crc32, m.packed, m.size
    return LOCAL.pack(b"PK\x03\x04", 20, 0, method, 0, DATE, *sizes, long_name, 0)
