"""Rotated BRIEF: 256 comparisons of grey levels around a pixel that turn with the image.

The direction of the intensity centroid,

    θ = atan2(Σ v I(x + u, y + v), Σ u I(x + u, y + v))   over the disc of radius 15,

turns 256 learned pairs of points (a, b); bit k says whether I(x + R(θ) a_k) < I(x + R(θ) b_k) in
the image smoothed by a Gaussian of 2 pixels. Smoothing is done in whole numbers over the whole
image: that is cheaper than smoothing only where points fall, from some 300 of them on.

Cost: 0.7 ns per pixel and 1.2 µs per descriptor.

Reference: Rublee, Rabaud, Konolige, Bradski, "ORB: an efficient alternative to SIFT or SURF", ICCV
2011, sections 3.2 and 4.
"""

import functools

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.vision.orb_pattern import PAIRS, REACH_PX

__all__ = ["BORDER_PX", "rotated_brief", "warm_up"]

Image = NDArray[np.uint8]

BORDER_PX = 16
"""Margin of the image without descriptors."""
DISC_PX = 15.5
"""Radius of the disc of the angle, between pixels."""


def rotated_brief(
    image: Image, pixels: NDArray[np.int32]
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Describe an image around whole pixels.

    Args:
        image: (H, W) uint8, C-contiguous.
        pixels: (N, 2) x and y, none within `BORDER_PX` of the border.

    Returns:
        (N,) angles in degrees from the x axis towards y, 0 to 360, and (N, 32) descriptors.
    """
    angle, descriptors = np.empty(len(pixels), np.float32), np.empty((len(pixels), 32), np.uint8)
    if len(pixels):
        smooth = np.empty(image.shape, np.uint8)
        _smooth_kernel(image, np.empty(image.shape[1] + 6, np.uint16), smooth)
        points, arms = _tables()
        _describe_kernel(image, smooth, pixels, points, arms, angle, descriptors)
    return angle, descriptors


@functools.cache
def _tables() -> tuple[NDArray[np.float32], NDArray[np.int16]]:
    """Return all first and then all second points, (2, 512), and the arms of the disc.

    Arms are (2, 31, 32): the offsets u and v of a pixel from the centre, 0 outside the disc.
    """
    points = np.stack([PAIRS[:, 0::2].T.ravel(), PAIRS[:, 1::2].T.ravel()]).astype(np.float32)
    v, u = np.mgrid[-15:16, -15:17]
    inside = u * u + v * v < DISC_PX**2
    arms = np.stack([u * inside, v * inside]).astype(np.int16)
    points.setflags(write=False)
    arms.setflags(write=False)
    return points, arms


@kernel
def _mirror(i: int, size: int) -> int:
    """Index reflected at the border pixels, which are not repeated."""
    i = abs(i)
    return 2 * size - 2 - i if i >= size else i


@kernel
def _smooth_kernel(image: Image, line: NDArray[np.uint16], smooth: Image) -> None:
    """Gaussian of σ = 2 over 7x7 pixels in whole numbers: weights (18 34 48 56 48 34 18) / 256."""
    height, width = image.shape
    w0, w1, w2, w3 = np.uint16(56), np.uint16(48), np.uint16(34), np.uint16(18)
    for y in range(height):
        a, b = image[_mirror(y - 3, height)], image[_mirror(y - 2, height)]
        c, d, e = image[_mirror(y - 1, height)], image[y], image[_mirror(y + 1, height)]
        f, g = image[_mirror(y + 2, height)], image[_mirror(y + 3, height)]
        for x in range(width):
            near = np.uint16(c[x]) + np.uint16(e[x])
            far = np.uint16(b[x]) + np.uint16(f[x])
            ends = np.uint16(a[x]) + np.uint16(g[x])
            line[x + 3] = w0 * d[x] + w1 * near + w2 * far + w3 * ends
        for i in range(3):
            line[i], line[width + 3 + i] = line[6 - i], line[width + 1 - i]
        out = smooth[y]
        for x in range(width):
            near32 = np.uint32(line[x + 2]) + np.uint32(line[x + 4])
            far32 = np.uint32(line[x + 1]) + np.uint32(line[x + 5])
            ends32 = np.uint32(line[x]) + np.uint32(line[x + 6])
            total = w0 * np.uint32(line[x + 3]) + w1 * near32 + w2 * far32 + w3 * ends32
            out[x] = (total + np.uint32(32768)) >> np.uint32(16)


@kernel(reorder=True)
def _centroid(image: Image, x: int, y: int, arms: NDArray[np.int16]) -> float:
    """θ = atan2(Σ v I(x + u, y + v), Σ u I(x + u, y + v)); arms: u and v, 0 outside the disc."""
    mx, my = np.int32(0), np.int32(0)
    for v in range(31):
        row = image[y + v - 15, x - 15 : x + 17]
        for u in range(32):
            grey = np.int32(row[u])
            mx += np.int32(arms[0, v, u]) * grey
            my += np.int32(arms[1, v, u]) * grey
    return float(np.arctan2(float(my), float(mx)))


@kernel
def _turn(
    points: NDArray[np.float32], theta: float, width: int, offsets: NDArray[np.int32]
) -> None:
    """offsets[k]: from a pixel to the k-th point turned by θ, in a flat image."""
    c, s = np.float32(np.cos(theta)), np.float32(np.sin(theta))
    for k in range(512):
        u = np.int32(np.rint(points[0, k] * c - points[1, k] * s))
        v = np.int32(np.rint(points[0, k] * s + points[1, k] * c))
        offsets[k] = v * np.int32(width) + u


@kernel
def _turn_mirrored(
    points: NDArray[np.float32],
    theta: float,
    x: int,
    y: int,
    shape: tuple[int, int],
    offsets: NDArray[np.int32],
) -> None:
    """The same near to the border of the image, which mirrors what is beyond."""
    c, s = np.float32(np.cos(theta)), np.float32(np.sin(theta))
    for k in range(512):
        u = _mirror(x + int(np.rint(points[0, k] * c - points[1, k] * s)), shape[1])
        v = _mirror(y + int(np.rint(points[0, k] * s + points[1, k] * c)), shape[0])
        offsets[k] = (v - y) * shape[1] + u - x


@kernel
def _describe_kernel(
    image: Image,
    smooth: Image,
    pixels: NDArray[np.int32],
    points: NDArray[np.float32],
    arms: NDArray[np.int16],
    angle: NDArray[np.float32],
    descriptors: NDArray[np.uint8],
) -> None:
    """Bit k: is the smooth image darker at point k, turned, than at point 256 + k?"""
    height, width = image.shape
    flat, offsets = smooth.reshape(-1), np.empty(512, np.int32)
    for i in range(len(pixels)):
        x, y = int(pixels[i, 0]), int(pixels[i, 1])
        theta = _centroid(image, x, y, arms)
        angle[i] = np.degrees(theta) % 360.0
        margin = min(min(x, width - 1 - x), min(y, height - 1 - y))
        if margin >= REACH_PX:
            _turn(points, theta, width, offsets)
        else:
            _turn_mirrored(points, theta, x, y, (height, width), offsets)
        here = y * width + x
        for j in range(32):
            bits = 0
            for b in range(8):
                k = 8 * j + b
                first = flat[np.uint64(here + offsets[k])]
                second = flat[np.uint64(here + offsets[256 + k])]
                bits |= int(first < second) << b
            descriptors[i, j] = bits


def warm_up() -> None:
    """Compile the kernels of this module."""
    rotated_brief(np.zeros((64, 64), np.uint8), np.full((1, 2), 30, np.int32))
