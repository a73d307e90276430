"""ORB: corners on every level of a pyramid, with an angle and 256 bits that turn with it.

The image is reduced level by level by a factor of 1.2. On each level FAST corners are taken, cell
by cell, so that every region gets its share and what poor cells cannot use goes to the others; weak
corners are only admitted to cells without strong ones. Of its corners a cell prefers those with the
best FAST scores: they were found again more often than those of the best Harris response. Levels
map to the image by pixel centres, x = (x_l + ½) w / w_l − ½; positions are fractions of a pixel.

Cost: O(pixels); 1000 features of 752x480 pixels in 8 ms on one core.

Reference: Rublee, Rabaud, Konolige, Bradski, "ORB: an efficient alternative to SIFT or SURF", ICCV
2011; Mur-Artal, Montiel, Tardós, "ORB-SLAM", T-RO 2015, section V-A.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.vision.brief import BORDER_PX, rotated_brief
from odomap.vision.fast import fast_corners, refine
from odomap.vision.visionconfig import OrbConfig

__all__ = ["OrbConfig", "OrbFeatures", "describe_at", "extract", "warm_up"]

Image = NDArray[np.uint8]

CELLS_PER_FEATURE = 0.25
"""Cells a level is divided into, per feature wanted: finer ones spread better, and take weaker
corners."""


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
            descriptors.append(rotated_brief(small, pixels)[1])
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
    height, width = small.shape
    return np.array([image.shape[1] / max(width, 1), image.shape[0] / max(height, 1)], np.float32)


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
    corners, scores = fast_corners(small, config.least_threshold, BORDER_PX)
    ratio = _ratio(image, small)
    if mask is not None:
        corners = corners[: _keep_inside(corners, mask, float(ratio[0]), float(ratio[1]))]
    corners = corners[_choose(corners, small.shape, wanted, config.threshold)]
    angle, descriptors = rotated_brief(small, np.ascontiguousarray(corners[:, :2]))
    return OrbFeatures(
        (refine(corners, scores) + np.float32(0.5)) * ratio - np.float32(0.5),
        np.full(len(corners), level, np.uint8),
        angle,
        corners[:, 2].astype(np.float64),
        descriptors,
    )


def _choose(
    corners: NDArray[np.int32], shape: tuple[int, ...], wanted: int, threshold: int
) -> NDArray[np.int64]:
    """Return the indices of at most so many corners, every cell of the level having its share."""
    if len(corners) == 0 or wanted <= 0:
        return np.empty(0, np.int64)
    height, width = (side - 2 * BORDER_PX for side in shape)
    cell = max(np.sqrt(height * width / (CELLS_PER_FEATURE * wanted)), 4.0)
    cols, rows = int(width / cell) + 1, int(height / cell) + 1
    start, order = np.zeros(cols * rows + 1, np.int64), np.empty(len(corners), np.int64)
    chosen = np.empty(min(wanted, len(corners)), np.int64)
    found = _choose_kernel(corners, cell, cols, threshold, start, order, chosen)
    return chosen[:found]


@kernel
def _keep_inside(
    corners: NDArray[np.int32], mask: NDArray[np.bool_], ratio_x: float, ratio_y: float
) -> int:
    """Move the corners whose pixel ((x + ½) r_x, (y + ½) r_y) is in the mask to the front."""
    height, width = mask.shape
    kept = 0
    for i in range(len(corners)):
        x = min(int((corners[i, 0] + 0.5) * ratio_x), width - 1)
        y = min(int((corners[i, 1] + 0.5) * ratio_y), height - 1)
        if mask[y, x]:
            for k in range(3):
                corners[kept, k] = corners[i, k]
            kept += 1
    return kept


@kernel
def _sort_into_cells(
    corners: NDArray[np.int32],
    cell: float,
    cols: int,
    start: NDArray[np.int64],
    order: NDArray[np.int64],
) -> None:
    """order[start[c]:start[c + 1]] are the corners of cell c, the strongest first: two counts."""
    number, cells = len(corners), len(start) - 1
    by_score, of = np.empty(number, np.int64), np.empty(number, np.int64)
    place, end = np.zeros(257, np.int64), np.empty(cells, np.int64)
    for i in range(number):
        row, col = (corners[i, 1] - BORDER_PX) / cell, (corners[i, 0] - BORDER_PX) / cell
        of[i] = int(row) * cols + int(col)
        start[of[i] + 1] += 1
        place[256 - corners[i, 2]] += 1
    for score in range(256):
        place[score + 1] += place[score]
    for c in range(cells):
        start[c + 1] += start[c]
        end[c] = start[c]
    for i in range(number):
        by_score[place[255 - corners[i, 2]]] = i
        place[255 - corners[i, 2]] += 1
    for k in range(number):
        c = of[by_score[k]]
        order[end[c]] = by_score[k]
        end[c] += 1


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


def warm_up() -> None:
    """Compile the kernels of this module."""
    image = np.zeros((64, 64), np.uint8)
    image[30:, 30:] = 200
    extract(image, OrbConfig(count=4, levels=1), np.ones(image.shape, np.bool_))
