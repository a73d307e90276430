"""Matching: which descriptor of one image belongs to which of another.

Binary descriptors are compared by Hamming distance, SIFT's by Euclidean distance. A guided search
compares a landmark only with features within a radius of where it is expected, which cells over the
image hand out; between two views of known poses, with those whose distance from its epipolar line
l = [t]_x R x passes a χ² test, (l · x')² <= 3.84 σ² (l_1² + l_2²); without a guess every pair is
compared. A match must be clearly better than the second best (Lowe's ratio) and be the best seen
from both sides. Of equal ones the first counts.

Cost: guided, O(landmarks x features in the circle); otherwise O(N M): along epipolar lines 1 ns a
pair, all distances 3 ns a pair.

Reference: Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", IJCV 2004, section
7.1; Mur-Artal, Montiel, Tardós, "ORB-SLAM", T-RO 2015, section V.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.vision.hamming import (
    CELL_PX,
    NO_DISTANCE,
    as_words,
    fill_cells,
    search_all,
    search_circles,
    search_epipolar,
)
from odomap.vision.visionconfig import MatchConfig

__all__ = [
    "EpipolarView",
    "KeypointGrid",
    "MatchConfig",
    "match_all",
    "match_epipolar",
    "match_guided",
    "match_projected",
    "nearest",
    "warm_up",
]

Descriptors = NDArray[np.uint8]
Index = NDArray[np.int64]

CHI2 = 3.84
"""Squared deviations of one degree of freedom that 95 % stay below."""
EPIPOLE_SIGMAS = 10.0
"""Nearer to the epipole than this no line says where to search, and no depth follows."""


def match_guided(
    wanted: Descriptors,
    guess: NDArray[np.float64],
    descriptors: Descriptors,
    keypoints: NDArray[np.float32],
    config: MatchConfig,
) -> NDArray[np.int64]:
    """Match landmarks to the features near where they are expected.

    Args:
        wanted: (M, D) descriptors of the landmarks.
        guess: (M, 2) expected pixels; NaN where not expected in the image.
        descriptors: (N, D) of the image's features.
        keypoints: (N, 2) their pixels.
        config: radius and thresholds.

    Returns:
        (M,) index of each landmark's feature, −1 without a match; no feature is given twice.
    """
    limit = float(config.max_hamming) if wanted.shape[1] == 32 else config.max_euclidean**2
    matches, distances = np.full(len(wanted), -1, np.int64), np.full(len(wanted), np.inf)
    if len(wanted) and len(descriptors):
        ratio = config.ratio if wanted.shape[1] == 32 else config.ratio**2
        _guided_kernel(
            wanted,
            np.ascontiguousarray(guess),
            descriptors,
            np.ascontiguousarray(keypoints),
            config.radius_px,
            ratio,
            limit,
            matches,
            distances,
        )
        _keep_nearest(matches, distances)
    return matches


def match_all(first: Descriptors, second: Descriptors, config: MatchConfig) -> NDArray[np.int64]:
    """Match descriptors of two images without a guess, ratio and cross check included.

    Args:
        first: (N, D).
        second: (M, D).
        config: thresholds.

    Returns:
        (N,) index into `second`, −1 without a match.
    """
    matches = np.full(len(first), -1, np.int64)
    if len(first) < 2 or len(second) < 2:
        return matches
    binary = first.shape[1] == 32
    limit = config.max_hamming if binary else config.max_euclidean
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING if binary else cv2.NORM_L2)
    back = {m[0].queryIdx: m[0].trainIdx for m in matcher.knnMatch(second, first, k=1) if m}
    for best, other in matcher.knnMatch(first, second, k=2):
        clear = best.distance <= limit and best.distance < config.ratio * other.distance
        if clear and back.get(best.trainIdx) == best.queryIdx:
            matches[best.queryIdx] = best.trainIdx
    return matches


def _keep_nearest(matches: NDArray[np.int64], distances: NDArray[np.float64]) -> None:
    """Of landmarks that claim the same feature, keep the one nearest in descriptor space."""
    order = np.lexsort((np.arange(len(matches)), distances, matches))
    claimed = matches[order]
    again = np.zeros(len(order), np.bool_)
    again[1:] = (claimed[1:] == claimed[:-1]) & (claimed[1:] >= 0)
    matches[order[again]] = -1


@kernel
def _distance(a: Descriptors, b: Descriptors) -> float:
    """Hamming distance of 32 bytes; squared Euclidean distance of longer ones."""
    total = 0
    if len(a) == 32:
        for k in range(32):
            bits = int(a[k] ^ b[k])
            bits = bits - ((bits >> 1) & 0x55)
            bits = (bits & 0x33) + ((bits >> 2) & 0x33)
            total += (bits + (bits >> 4)) & 0x0F
    else:
        for k in range(len(a)):
            difference = int(a[k]) - int(b[k])
            total += difference * difference
    return float(total)


@kernel
def _guided_kernel(
    wanted: Descriptors,
    guess: NDArray[np.float64],
    descriptors: Descriptors,
    keypoints: NDArray[np.float32],
    radius: float,
    ratio: float,
    limit: float,
    matches: NDArray[np.int64],
    distances: NDArray[np.float64],
) -> None:
    """For each landmark the nearest descriptor within the radius, if clearly the nearest."""
    for m in range(len(wanted)):
        x, y = guess[m, 0], guess[m, 1]
        if not (np.isfinite(x) and np.isfinite(y)):
            continue
        best, second, index = np.inf, np.inf, -1
        for n in range(len(keypoints)):
            dx, dy = keypoints[n, 0] - x, keypoints[n, 1] - y
            if dx * dx + dy * dy > radius * radius:
                continue
            distance = _distance(wanted[m], descriptors[n])
            if distance < best:
                best, second, index = distance, best, n
            elif distance < second:
                second = distance
        if index >= 0 and best <= limit and best < ratio * second:
            matches[m], distances[m] = index, best


@dataclass(frozen=True, eq=False)
class KeypointGrid:
    """Cells over an image, each with the keypoints in it.

    Attributes:
        start: (rows * cols + 1,) where each cell begins in `order`.
        order: (N,) indices of the keypoints, cell by cell.
        cols: cells in a row.
        rows: rows of cells.
    """

    start: Index
    order: Index
    cols: int
    rows: int

    @classmethod
    def of(cls, keypoints: NDArray[np.float32], shape: tuple[int, ...]) -> "KeypointGrid":
        """Sort keypoints into cells.

        Args:
            keypoints: (N, 2) pixels; those outside the image go to the cells at its border.
            shape: (H, W) of the image.
        """
        rows, cols = int(shape[0] / CELL_PX) + 1, int(shape[1] / CELL_PX) + 1
        start, order = np.empty(rows * cols + 1, np.int64), np.empty(len(keypoints), np.int64)
        fill_cells(np.ascontiguousarray(keypoints, np.float32), cols, start, order)
        return cls(start, order, cols, rows)


@dataclass(frozen=True, eq=False)
class EpipolarView:
    """What one of two views offers for matching along epipolar lines.

    Attributes:
        descriptors: (N, 32) uint8.
        bearings: (N, 3) in the camera frame, z above 0; of any length.
        levels: (N,) uint8 pyramid levels.
        usable: (N,) bool, which features may be matched.
    """

    descriptors: Descriptors
    bearings: NDArray[np.float64]
    levels: NDArray[np.uint8]
    usable: NDArray[np.bool_]


def match_projected(
    wanted: Descriptors,
    guess: NDArray[np.float64],
    radius_px: NDArray[np.float64],
    lowest: Index,
    highest: Index,
    descriptors: Descriptors,
    keypoints: NDArray[np.float32],
    levels: NDArray[np.uint8],
    grid: KeypointGrid,
    config: MatchConfig,
) -> Index:
    """Match landmarks to the features near where they are projected, on the levels they may be on.

    The second best counts only where it is on the level of the best: the same corner, found again
    on another level, is no rival.

    Args:
        wanted: (M, 32) descriptors of the landmarks.
        guess: (M, 2) expected pixels; NaN where not expected in the image.
        radius_px: (M,) how far to search.
        lowest: (M,) finest level each may be found on.
        highest: (M,) coarsest level.
        descriptors: (N, 32) of the image's features.
        keypoints: (N, 2) their pixels.
        levels: (N,) their levels.
        grid: of the keypoints.
        config: ratio and largest distance.

    Returns:
        (M,) index of each landmark's feature, −1 without a match; a feature that several would
        have is given to the nearest, of equals to the first.
    """
    matches = np.full(len(wanted), -1, np.int64)
    if len(wanted) and len(descriptors):
        search_circles(
            as_words(wanted),
            np.ascontiguousarray(guess, np.float64),
            np.ascontiguousarray(radius_px, np.float64),
            np.ascontiguousarray(lowest, np.int64),
            np.ascontiguousarray(highest, np.int64),
            as_words(descriptors),
            np.ascontiguousarray(keypoints, np.float32),
            np.ascontiguousarray(levels, np.uint8),
            grid.start,
            grid.order,
            grid.cols,
            config.ratio,
            config.max_hamming,
            matches,
        )
    return matches


def match_epipolar(
    first: EpipolarView,
    second: EpipolarView,
    T_second_first: NDArray[np.float64],
    sigma: float,
    scale: float,
    config: MatchConfig,
) -> Index:
    """Match features of two views with known poses along epipolar lines.

    Args:
        first: features of one view.
        second: features of the other.
        T_second_first: (4, 4) from the first camera to the second.
        sigma: standard deviation of a keypoint at level 0 on the plane z = 1.
        scale: size of a level relative to the one below it; deviations grow with it.
        config: ratio and largest distance.

    Returns:
        (P, 2) index pairs, ordered by the first; each is the best of the other near its line.
    """
    coarsest = max(int(second.levels.max(initial=0)), 0)
    variance = (sigma * scale ** np.arange(coarsest + 1, dtype=np.float64)) ** 2
    pairs = np.empty((min(len(first.usable), len(second.usable)), 2), np.int64)
    found = search_epipolar(
        as_words(first.descriptors),
        np.ascontiguousarray(first.bearings, np.float64),
        np.ascontiguousarray(first.usable),
        as_words(second.descriptors),
        np.ascontiguousarray(second.bearings, np.float64),
        np.ascontiguousarray(second.levels),
        np.ascontiguousarray(second.usable),
        np.ascontiguousarray(T_second_first),
        variance,
        np.array([CHI2, EPIPOLE_SIGMAS]),
        config.ratio,
        config.max_hamming,
        pairs,
    )
    return pairs[:found]


def nearest(first: Descriptors, second: Descriptors) -> tuple[Index, Index, Index]:
    """Compare every binary descriptor of one image with every one of another.

    Args:
        first: (N, 32).
        second: (M, 32).

    Returns:
        (N,) index of the nearest in `second` (of equals the first; −1 of nothing), its distance
        and the distance of the second nearest (257 where there is none), bits.
    """
    index = np.full(len(first), -1, np.int64)
    best, other = (np.full(len(first), NO_DISTANCE, np.int64) for _ in range(2))
    search_all(as_words(first), as_words(second), index, best, other)
    return index, best, other


def warm_up() -> None:
    """Compile the kernels of this module."""
    rng = np.random.default_rng(0)
    descriptors = rng.integers(0, 255, (4, 32)).astype(np.uint8)
    keypoints = rng.uniform(0, 50, (4, 2)).astype(np.float32)
    match_guided(descriptors, keypoints.astype(np.float64), descriptors, keypoints, MatchConfig())
    grid = KeypointGrid.of(keypoints, (50, 50))
    guess, radius, levels = keypoints.astype(np.float64), np.full(4, 9.0), np.zeros(4, np.uint8)
    low, config = np.zeros(4, np.int64), MatchConfig()
    match_projected(
        descriptors, guess, radius, low, low, descriptors, keypoints, levels, grid, config
    )
    view = EpipolarView(descriptors, np.ones((4, 3)), levels, np.ones(4, np.bool_))
    match_epipolar(view, view, np.eye(4), 0.01, 1.2, config)
    nearest(descriptors, descriptors)
