"""Images: from files of any kind to the (H, W) uint8 grey a front-end wants.

Cameras write 8 or 16 bits (of which 10 to 14 may be used), grey, colour, or the raw mosaic of a
colour sensor. What a camera writes is found out once, from a few images spread over the
recording, and then applied to all, since a scale that changes from frame to frame would look like
changing light.

A Bayer mosaic shows as a checkerboard: the two green pixels of each 2x2 cell lie on a diagonal,
red and blue on the other, so the diagonals differ in mean everywhere by the same sign. With the
means m of the four phases of a block, the statistic is the median over blocks of

    c = (m01 + m10 - m00 - m11) / (m00 + m01 + m10 + m11)

which stays under 0.0002 in grey recordings and is 0.016 to 0.3 in mosaics, where the diagonal whose
two means are more alike is the green one.

A decoder may return the upper half of a truncated file without complaint, so PNG chunks are checked
by their CRC, and JPEG for its end marker, first.

Reference: B. E. Bayer, "Color imaging array", US patent 3,971,065, 1976.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError

__all__ = [
    "BadImage",
    "ImageFormat",
    "decode",
    "find_mosaic",
    "probe_format",
    "read_colour",
    "read_image",
    "spread",
]

SAMPLES = 5
"""Images looked at to find out what a camera writes."""
MOSAIC_CONTRAST = 0.005
"""Checkerboard contrast from which on an image is taken for a Bayer mosaic."""
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"


class BadImage(Exception):
    """An image file cannot be used; the text is the reason."""


@dataclass(frozen=True)
class ImageFormat:
    """What a camera writes, and how that becomes (H, W) uint8.

    Attributes:
        resolution: width and height most images have.
        bits: how many bits are used; 8 needs no scaling.
        mosaic: "" or the sensor's green diagonal, "main" (GRBG, GBRG) or "anti" (RGGB, BGGR).
        is_colour: whether images have three channels or four.
    """

    resolution: tuple[int, int]
    bits: int = 8
    mosaic: str = ""
    is_colour: bool = False

    @property
    def note(self) -> str:
        """What the user should know about it; empty for plain 8-bit grey."""
        parts = []
        if self.bits > 8:
            parts.append(f"16-bit images ({self.bits} bits used) are scaled to 8 bits")
        if self.is_colour:
            parts.append("colour images are converted to grey")
        if self.mosaic:
            parts.append("images look like a raw Bayer mosaic and are converted to grey")
        return "; ".join(parts)


def read_image(path: Path, form: ImageFormat) -> NDArray[np.uint8]:
    """Read an image file as grey.

    Args:
        path: the file.
        form: what its camera writes.

    Returns:
        (H, W) uint8, C-contiguous.

    Raises:
        BadImage: it is missing, truncated, not an image, or of another size.
    """
    raw = decode(path)
    height, width = raw.shape[:2]
    if (width, height) != form.resolution:
        expected = "{}x{}".format(*form.resolution)
        raise BadImage(f"image is {width}x{height}, expected {expected}")
    if raw.ndim == 3:
        code = cv2.COLOR_BGRA2GRAY if raw.shape[2] == 4 else cv2.COLOR_BGR2GRAY
        raw = cv2.cvtColor(raw, code)
    elif form.mosaic:
        # OpenCV's BG is the layout RGGB, GB is GRBG. Exchanging red and blue shifts grey by 1 %.
        code = cv2.COLOR_BayerBG2GRAY if form.mosaic == "anti" else cv2.COLOR_BayerGB2GRAY
        raw = cv2.cvtColor(raw, code)
    if raw.dtype == np.uint16:
        raw = np.minimum(raw >> max(form.bits - 8, 0), 255).astype(np.uint8)
    return np.ascontiguousarray(raw, np.uint8)


def read_colour(path: Path, form: ImageFormat) -> NDArray[np.uint8]:
    """Read an image file as colour.

    Args:
        path: the file.
        form: what its camera writes.

    Returns:
        (H, W, 3) uint8 red, green, blue; three times the same where the file is grey or a mosaic,
        whose layout says where green is, but not which of the others is red.

    Raises:
        BadImage: it is missing, truncated, not an image, or of another size.
    """
    raw = decode(path)
    if raw.ndim == 2 or (raw.shape[1], raw.shape[0]) != form.resolution:
        return np.repeat(read_image(path, form)[:, :, None], 3, axis=2)
    code = cv2.COLOR_BGRA2RGB if raw.shape[2] == 4 else cv2.COLOR_BGR2RGB
    colour: NDArray[Any] = np.asarray(cv2.cvtColor(raw, code))
    if colour.dtype == np.uint16:
        colour = np.minimum(colour >> max(form.bits - 8, 0), 255)
    return np.ascontiguousarray(colour, np.uint8)


def decode(path: Path) -> NDArray[Any]:
    """Decode an image file as it is: (H, W) or (H, W, 3 | 4), uint8 or uint16.

    Raises:
        BadImage: it is missing, truncated or not an image.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise BadImage("file is missing") from None
    except OSError as error:
        raise BadImage(f"file cannot be read ({error.strerror})") from error
    if not data:
        raise BadImage("file is empty")
    check_complete(data)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise BadImage(f"image cannot be decoded ({error.err})") from error
    if image is None:
        raise BadImage("not an image, or broken")
    if image.dtype not in (np.uint8, np.uint16):
        raise BadImage(f"{image.dtype} pixels: only 8 and 16 bit images are read")
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    if image.ndim == 3 and image.shape[2] == 2:
        image = np.ascontiguousarray(image[:, :, 0])
    return np.asarray(image)


def check_complete(data: bytes) -> None:
    """Raise BadImage if the bytes of a PNG or JPEG end early or are damaged."""
    if data.startswith(_PNG):
        _check_png(data)
    elif data.startswith(_JPEG) and data.rfind(b"\xff\xd9") < len(data) // 2:
        # An end marker in the first half is that of a thumbnail.
        raise BadImage("JPEG is truncated (no end marker)")


def _check_png(data: bytes) -> None:
    at = len(_PNG)
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        end = at + 12 + length
        if end > len(data):
            raise BadImage("PNG is truncated")
        (stored,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(memoryview(data)[at + 4 : end - 4]) != stored:
            raise BadImage("PNG is damaged (checksum does not match)")
        if kind == b"IEND":
            return
        at = end
    raise BadImage("PNG is truncated (no end chunk)")


def probe_format(paths: Sequence[Path], where: str) -> ImageFormat:
    """Find out what a camera writes, from a few images spread over its recording.

    Args:
        paths: all of its image files.
        where: what to call the camera in messages.

    Raises:
        InputError: none of the sampled images can be read.
    """
    images: list[NDArray[Any]] = []
    reason = "no images"
    for index in spread(len(paths)):
        try:
            images.append(decode(paths[index]))
            if len(images) == SAMPLES:
                break
        except BadImage as error:
            reason = f"{paths[index].name}: {error}"
    if not images:
        raise InputError(f"{where}: no image can be read ({reason})")
    shapes = Counter((image.shape[1], image.shape[0]) for image in images)
    resolution = shapes.most_common(1)[0][0]
    images = [image for image in images if (image.shape[1], image.shape[0]) == resolution]
    flat = [image for image in images if image.ndim == 2]
    wide = [int(image.max()).bit_length() for image in images if image.dtype == np.uint16]
    # Sensors have an even number of bits; a dark scene may not use the highest one.
    bits = min(16, 2 * ((max(wide) + 1) // 2)) if wide else 8
    mosaics = Counter(find_mosaic(image) for image in flat)
    mosaic = mosaics.most_common(1)[0][0] if len(mosaics) == 1 else ""
    return ImageFormat(resolution, max(bits, 8), mosaic, len(flat) < len(images))


def spread(count: int, samples: int = SAMPLES) -> list[int]:
    """Return indices spread over a recording, then others between them, should some be broken."""
    coarse = np.linspace(0, count - 1, min(count, samples)).astype(int).tolist()
    fine = np.linspace(0, count - 1, min(count, 4 * samples)).astype(int).tolist()
    return list(dict.fromkeys(coarse + fine))


def find_mosaic(image: NDArray[Any], block: int = 16) -> str:
    """Tell whether a single-channel image is a raw Bayer mosaic.

    Args:
        image: (H, W).
        block: side of the blocks whose phases are compared, even.

    Returns:
        "" for a grey image, else the diagonal that is green: "main" or "anti".
    """
    height, width = (size // block * block for size in image.shape)
    if height < 2 * block or width < 2 * block:
        return ""
    blocks = image[:height, :width].astype(np.float32)
    cells = blocks.reshape(height // block, block // 2, 2, width // block, block // 2, 2)
    means = cells.mean(axis=(1, 4)).transpose(0, 2, 1, 3).reshape(-1, 4)
    total = means.sum(axis=1)
    lit = total > 0.02 * total.max(initial=0.0)
    if not lit.any():
        return ""
    means, total = means[lit], total[lit]
    contrast = (means[:, 1] + means[:, 2] - means[:, 0] - means[:, 3]) / total
    if abs(float(np.median(contrast))) < MOSAIC_CONTRAST:
        return ""
    main = np.median(np.abs(means[:, 0] - means[:, 3]) / total)
    anti = np.median(np.abs(means[:, 1] - means[:, 2]) / total)
    return "main" if main < anti else "anti"
