"""ORB: corners on every level of a pyramid, with an angle and 256 bits that turn with it.

The image is reduced level by level by a factor of 1.2. On each level FAST corners are taken, cell by
cell, so that every region gets its share and what poor cells cannot use goes to the others; weak
corners are only admitted to cells without strong ones. The direction of the intensity centroid,

    θ = atan2(Σ v I(x + u, y + v), Σ u I(x + u, y + v))   over the disc of radius 15,

turns the 256 learned pairs of points (a, b); bit k says whether I(x + R(θ) a_k) < I(x + R(θ) b_k)
in the level's image, smoothed by a Gaussian of 2 pixels. Levels map to the image by pixel centres,
x = (x_l + ½) w / w_l − ½, and positions are fractions of a pixel.

Cost: O(pixels) for FAST and smoothing, some 2 µs per descriptor: 1000 features of 752x480 pixels
in 7 ms on one core.

Reference: Rublee, Rabaud, Konolige, Bradski, "ORB: an efficient alternative to SIFT or SURF", ICCV
2011; Mur-Artal, Montiel, Tardós, "ORB-SLAM", T-RO 2015, section V-A.
"""

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.errors import ConfigError
from odomap.kernels import kernel
from odomap.limits import Count, Limits, check_limits
from odomap.vision.fast import fast_corners
from odomap.vision.orb_pattern import PAIRS, REACH_PX

__all__ = ["OrbConfig", "OrbFeatures", "describe_at", "extract", "warm_up"]

Image = NDArray[np.uint8]

BORDER_PX = 16
"""Margin on every level; the disc of the angle reaches 15 px."""
DISC_PX = 15.5
"""Radius of the disc of the angle, between pixels."""
CELL = 1.0
"""Side of a cell in units of the mean distance between the features of a level."""


@dataclass(frozen=True)
class OrbConfig:
    """How ORB features are found."""

    count: Count = 1000
    """Features wanted per image."""
    levels: Annotated[int, Limits(least=1, most=16)] = 8
    """Levels of the image pyramid."""
    scale: Annotated[float, Limits(least=1.05, most=2)] = 1.2
    """Size of a level relative to the one above it."""
    threshold: Annotated[int, Limits(least=1, most=254)] = 20
    """FAST contrast threshold, grey levels."""
    least_threshold: Annotated[int, Limits(least=1, most=254)] = 7
    """Threshold in cells where no corner passes the other."""

    def __post_init__(self) -> None:
        check_limits(self)
        if self.least_threshold > self.threshold:
            raise ConfigError(
                f"least_threshold: {self.least_threshold} must be at most threshold, "
                f"{self.threshold}"
            )


@dataclass(frozen=True, eq=False)
class OrbFeatures:
    """What was found in one image, one row per feature.

    Attributes:
        keypoints: (N, 2) float32 pixels of the image.
        level: (N,) uint8 level of the pyramid, 0 the image itself.
        angle: (N,) float32 degrees from the x axis towards y, 0 to 360.
        strength: (N,) float64 FAST scores, grey levels.
        descriptors: (N, 32) uint8.
    """

    keypoints: NDArray[np.float32]
    level: NDArray[np.uint8]
    angle: NDArray[np.float32]
    strength: NDArray[np.float64]
    descriptors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.keypoints)


def extract(image: Image, config: OrbConfig, mask: NDArray[np.bool_] | None = None) -> OrbFeatures:
    """Find and describe features all over an image.

    Args:
        image: (H, W) uint8.
        config: how many, and from which contrast on.
        mask: (H, W) bool, where features may be; default everywhere.

    Returns:
        About `config.count` features, level by level; fewer where there is little to see.
    """
    pyramid = _pyramid(image, config.levels, config.scale)
    parts, missing = [], 0
    # From the coarsest level on: what it lacks, finer ones have.
    for level, wanted in reversed(list(enumerate(_shares(config, len(pyramid))))):
        part = _on_level(image, pyramid[level], level, wanted + missing, config, mask)
        missing += wanted - len(part)
        parts.append(part)
    parts.reverse()
    return OrbFeatures(
        np.concatenate([p.keypoints for p in parts]),
        np.concatenate([p.level for p in parts]),
        np.concatenate([p.angle for p in parts]),
        np.concatenate([p.strength for p in parts]),
        np.concatenate([p.descriptors for p in parts]),
    )


def describe_at(
    image: Image,
    keypoints: NDArray[np.float32],
    levels: NDArray[np.uint8] | None = None,
    config: OrbConfig | None = None,
) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Compute descriptors at given points.

    Args:
        image: (H, W) uint8.
        keypoints: (N, 2) float32 pixels.
        levels: (N,) uint8 level of the pyramid to describe each on; default 0.
        config: the pyramid's scale; default that of `OrbConfig`.

    Returns:
        (M, 32) uint8 descriptors and the (M,) indices of the keypoints they belong to: those nearer
        than `BORDER_PX` to the border of their level are left out.
    """
    config = OrbConfig() if config is None else config
    if levels is None:
        levels = np.zeros(len(keypoints), np.uint8)
    deepest = int(levels.max()) if len(levels) else 0
    pyramid = _pyramid(image, deepest + 1, config.scale)
    descriptors, kept = [np.empty((0, 32), np.uint8)], [np.empty(0, np.int64)]
    for level, small in enumerate(pyramid):
        rows = np.flatnonzero(levels == level)
        x, y = ((keypoints[rows] + 0.5) / _ratio(image, small) - 0.5).T
        height, width = small.shape
        with np.errstate(invalid="ignore"):  # a keypoint may be NaN: it is inside nothing
            inside = (x >= BORDER_PX - 0.5) & (x < width - BORDER_PX - 0.5)
            inside &= (y >= BORDER_PX - 0.5) & (y < height - BORDER_PX - 0.5)
        if inside.any():
            pixels = np.floor(np.stack([x, y], axis=1)[inside] + 0.5).astype(np.int32)
            descriptors.append(_describe(small, pixels)[1])
            kept.append(rows[inside])
    index = np.concatenate(kept)
    order = np.argsort(index, kind="stable")
    return np.ascontiguousarray(np.concatenate(descriptors)[order]), index[order]


def _pyramid(image: Image, levels: int, scale: float) -> list[Image]:
    """Return the image reduced again and again, while there is room for a feature."""
    pyramid = [np.ascontiguousarray(image)]
    for level in range(1, levels):
        height, width = (round(side / scale**level) for side in image.shape)
        if min(height, width) <= 2 * BORDER_PX:
            break
        small = cv2.resize(pyramid[-1], (width, height), interpolation=cv2.INTER_LINEAR)
        pyramid.append(np.asarray(small, np.uint8))
    return pyramid


def _ratio(image: Image, small: Image) -> NDArray[np.float32]:
    """Return the pixels of the image per pixel of the level, along x and y."""
    return np.array([image.shape[1] / small.shape[1], image.shape[0] / small.shape[0]], np.float32)


def _shares(config: OrbConfig, levels: int) -> list[int]:
    """Return how many features each level is to give: in the ratio of the levels' sides."""
    weights = config.scale ** -np.arange(levels, dtype=np.float64)
    ends = np.round(config.count * np.cumsum(weights) / weights.sum()).astype(np.int64)
    return [int(n) for n in np.diff(ends, prepend=0)]


def _on_level(
    image: Image,
    small: Image,
    level: int,
    wanted: int,
    config: OrbConfig,
    mask: NDArray[np.bool_] | None,
) -> OrbFeatures:
    """Return the features of one level, spread over it."""
    corners, positions = fast_corners(small, config.least_threshold, BORDER_PX)
    ratio = _ratio(image, small)
    if mask is not None and len(corners):
        x, y = ((corners[:, :2] + 0.5) * ratio).astype(np.int64).T
        free = mask[np.minimum(y, mask.shape[0] - 1), np.minimum(x, mask.shape[1] - 1)]
        corners, positions = np.ascontiguousarray(corners[free]), positions[free]
    chosen = _choose(corners, small.shape, wanted, config.threshold)
    angle, descriptors = _describe(small, np.ascontiguousarray(corners[chosen, :2]))
    return OrbFeatures(
        (positions[chosen] + np.float32(0.5)) * ratio - np.float32(0.5),
        np.full(len(chosen), level, np.uint8),
        angle,
        corners[chosen, 2].astype(np.float64),
        descriptors,
    )


def _choose(
    corners: NDArray[np.int32], shape: tuple[int, ...], wanted: int, threshold: int
) -> NDArray[np.int64]:
    """Return the indices of at most so many corners, every cell of the level having its share."""
    if len(corners) == 0 or wanted <= 0:
        return np.empty(0, np.int64)
    height, width = (side - 2 * BORDER_PX for side in shape)
    cell = max(CELL * np.sqrt(height * width / wanted), 4.0)
    cols, rows = int(width / cell) + 1, int(height / cell) + 1
    start, order = np.zeros(cols * rows + 1, np.int64), np.empty(len(corners), np.int64)
    chosen = np.empty(min(wanted, len(corners)), np.int64)
    found = _choose_kernel(corners, cell, cols, threshold, start, order, chosen)
    return chosen[:found]


@kernel
def _sort_into_cells(
    corners: NDArray[np.int32],
    cell: float,
    cols: int,
    start: NDArray[np.int64],
    order: NDArray[np.int64],
) -> None:
    """order[start[c]:start[c + 1]] are the corners of cell c, the strongest first."""
    cells = len(start) - 1
    end = np.zeros(cells, np.int64)
    of = np.empty(len(corners), np.int64)
    for i in range(len(corners)):
        of[i] = int((corners[i, 1] - BORDER_PX) / cell) * cols + int(
            (corners[i, 0] - BORDER_PX) / cell
        )
        start[of[i] + 1] += 1
    for c in range(cells):
        start[c + 1] += start[c]
        end[c] = start[c]
    for i in range(len(corners)):
        k = end[of[i]]
        end[of[i]] += 1
        while k > start[of[i]] and corners[order[k - 1], 2] < corners[i, 2]:
            order[k] = order[k - 1]
            k -= 1
        order[k] = i


@kernel
def _choose_kernel(
    corners: NDArray[np.int32],
    cell: float,
    cols: int,
    threshold: int,
    start: NDArray[np.int64],
    order: NDArray[np.int64],
    chosen: NDArray[np.int64],
) -> int:
    """The best of every cell, then the second best, ...; of the last round the strongest."""
    _sort_into_cells(corners, cell, cols, start, order)
    wanted, found, rank = len(chosen), 0, 0
    while found < wanted:
        # How many of this round have each score: from which score on are they taken?
        histogram = np.zeros(256, np.int64)
        total = 0
        for c in range(len(start) - 1):
            k = start[c] + rank
            if k < start[c + 1] and (rank == 0 or corners[order[k], 2] > threshold):
                histogram[corners[order[k], 2]] += 1
                total += 1
        if total == 0:
            break
        least, above = 255, 0
        while least > 0 and above + histogram[least] <= wanted - found:
            above += histogram[least]
            least -= 1
        ties = wanted - found - above
        for c in range(len(start) - 1):
            k = start[c] + rank
            if k >= start[c + 1] or not (rank == 0 or corners[order[k], 2] > threshold):
                continue
            score = corners[order[k], 2]
            if score < least or (score == least and ties <= 0):
                continue
            if score == least:
                ties -= 1
            chosen[found] = order[k]
            found += 1
        rank += 1
    return found


def _describe(
    small: Image, pixels: NDArray[np.int32]
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return (N,) angles in degrees and (N, 32) descriptors at whole pixels of a level."""
    smooth = np.empty(small.shape, np.uint8)
    line = np.empty(small.shape[1] + 6, np.uint16)
    _smooth_kernel(small, line, smooth)
    angle, descriptors = np.empty(len(pixels), np.float32), np.empty((len(pixels), 32), np.uint8)
    x, y = PAIRS[:, ::2].T.ravel(), PAIRS[:, 1::2].T.ravel()  # all first points, all second ones
    points = np.stack([x, y]).astype(np.float32)
    _describe_kernel(small, smooth, pixels, points, _arms(), angle, descriptors)
    return angle, descriptors


def _arms() -> NDArray[np.int32]:
    """Return (2, 31, 32) offsets u and v from the centre of the disc, 0 outside of it."""
    v, u = np.mgrid[-15:16, -15:17]
    inside = u * u + v * v < DISC_PX**2
    return np.ascontiguousarray(np.stack([u * inside, v * inside]), np.int32)


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
def _centroid(image: Image, x: int, y: int, arms: NDArray[np.int32]) -> float:
    """θ = atan2(Σ v I(x + u, y + v), Σ u I(x + u, y + v)); arms: u and v, 0 outside the disc."""
    mx, my = np.int32(0), np.int32(0)
    for v in range(31):
        row = image[y + v - 15, x - 15 : x + 17]
        for u in range(32):
            grey = np.int32(row[u])
            mx += arms[0, v, u] * grey
            my += arms[1, v, u] * grey
    return np.arctan2(float(my), float(mx))


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
    arms: NDArray[np.int32],
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
    image = np.zeros((64, 64), np.uint8)
    image[30:, 30:] = 200
    extract(image, OrbConfig(count=4, levels=1))
