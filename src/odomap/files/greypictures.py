"""Grey pictures: PGM, and PNG in any colours, of 8 bits.

A portable graymap is a header in text and rows of pixels, the top one first,

    P5  width height greatest    then one byte each;    P2 the same, then numbers in text;

where `#` begins a comment, and a value v is v / greatest of white. What a file says of its size is
compared with how long it is before anything is made of that size: files are not trusted.

Reference: J. Poskanzer, "pgm(5): Netpbm grayscale image format", 1989.
"""

import re
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError

__all__ = ["GreyPicture", "pgm_bytes", "read_grey"]

Grey = NDArray[np.uint8]

PNG = b"\x89PNG\r\n\x1a\n"
LONGEST_HEADER = 65536
"""Bytes within which the header of a PGM, comments included, must end."""
TOKEN = re.compile(rb"(?:\s|#[^\n\r]*[\n\r])*([0-9]+)")
PER_PIXEL = 16
"""Bytes of a file per pixel at most: four channels, or a number in text and room around it."""


@dataclass(frozen=True, eq=False)
class GreyPicture:
    """A picture.

    Attributes:
        grey: (H, W) uint8, the top row first; 255 is white.
        is_seen: (H, W) pixels that are not transparent; None where all are not.
    """

    grey: Grey
    is_seen: NDArray[np.bool_] | None = None


def pgm_bytes(grey: Grey) -> bytes:
    """Return a picture (H, W) as a binary PGM."""
    height, width = grey.shape
    return f"P5\n# odomap\n{width} {height}\n255\n".encode() + grey.tobytes()


def read_grey(path: Path, most_pixels: int) -> GreyPicture:
    """Read a PGM (P5, P2) or a PNG of 8 bits.

    Args:
        path: the file.
        most_pixels: how many it may have.

    Raises:
        InputError: it is not there, of another kind, broken, or too large.
    """
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode):
            raise InputError(f"{path}: is no file that could hold a picture")
        if found.st_size > LONGEST_HEADER + PER_PIXEL * most_pixels:
            raise InputError(f"{path}: {found.st_size} bytes are too many for a picture")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from error
    except ValueError as error:  # a name that can be none, as one with a zero in it
        raise InputError(f"{str(path)!r}: {error}") from error
    if data[:2] in (b"P5", b"P2"):
        return GreyPicture(_pgm(path, data, most_pixels))
    if data.startswith(PNG):
        return _png(path, data, most_pixels)
    raise InputError(f"{path}: is neither PGM (P5, P2) nor PNG: convert it to one of them")


def _check_size(path: Path, width: int, height: int, most: int) -> None:
    if width < 1 or height < 1:
        raise InputError(f"{path}: a picture of {width} x {height} pixels has none")
    if width * height > most:
        raise InputError(f"{path}: {width} x {height} pixels are too many: {most} at most")


def _pgm(path: Path, data: bytes, most: int) -> Grey:
    numbers, at = [], 2
    for _ in range(3):
        token = TOKEN.match(data, at, LONGEST_HEADER)
        if token is None or len(token.group(1)) > 9:
            raise InputError(f"{path}: its header is broken: width, height, greatest value wanted")
        numbers.append(int(token.group(1)))
        at = token.end()
    width, height, greatest = numbers
    _check_size(path, width, height, most)
    if not 0 < greatest < 256:
        raise InputError(f"{path}: its greatest value is {greatest}: only 8 bits are read")
    count = width * height
    values: NDArray[np.integer[Any]] = (
        np.frombuffer(data, np.uint8)[at + 1 : at + 1 + count]
        if data[:2] == b"P5"
        else _plain(path, data[at:], count)
    )
    if len(values) < count:
        raise InputError(f"{path}: ends after {len(values)} of {count} pixels: copy it again")
    if values.max() > greatest:
        raise InputError(f"{path}: a pixel is {values.max()}, but {greatest} is the greatest")
    if greatest != 255:
        values = np.round(values * (255.0 / greatest)).astype(np.uint8)
    return np.ascontiguousarray(values, np.uint8).reshape(height, width)


def _plain(path: Path, body: bytes, count: int) -> NDArray[np.int64]:
    cells = re.sub(rb"#[^\n\r]*", b"", body).split(None, count)[:count]
    try:
        values = np.array(cells, "S8").astype(np.int64) if cells else np.zeros(0, np.int64)
    except ValueError:
        raise InputError(f"{path}: a pixel is no number") from None
    if (values < 0).any():
        raise InputError(f"{path}: a pixel is below 0")
    return values


def _png(path: Path, data: bytes, most: int) -> GreyPicture:
    import cv2

    if len(data) < 33 or data[12:16] != b"IHDR":
        raise InputError(f"{path}: its header is broken: copy it again")
    width, height = (int.from_bytes(data[k : k + 4], "big") for k in (16, 20))
    _check_size(path, width, height, most)
    if data[24] > 8:
        raise InputError(f"{path}: has {data[24]} bits per colour: only 8 are read")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.shape[:2] != (height, width) or not _is_whole(data):
        raise InputError(f"{path}: a broken PNG: copy it again")
    if image.ndim == 2:
        return GreyPicture(np.asarray(image, np.uint8))
    colours = image[:, :, : 3 if image.shape[2] > 2 else 1]
    grey = np.round(colours.mean(axis=2)).astype(np.uint8)
    return GreyPicture(grey, image[:, :, -1] > 127 if image.shape[2] in (2, 4) else None)


def _is_whole(data: bytes) -> bool:
    """Say whether a PNG ends where it should: decoders fill what is missing with black."""
    at = len(PNG)
    while at + 12 <= len(data):
        if data[at + 4 : at + 8] == b"IEND":
            return True
        at += 12 + int.from_bytes(data[at : at + 4], "big")
    return False
