"""Matching: which descriptor of one image belongs to which of another.

Binary descriptors are compared by Hamming distance, SIFT's by Euclidean distance. A guided search
compares a landmark only with features within a radius of where it is expected; without a guess
every pair is compared. A match must be clearly better than the second best (Lowe's ratio) and be
the best seen from both sides.

Cost: guided, O(landmarks x features in the circle); without a guess, O(N M).

Reference: Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", IJCV 2004, section
7.1; Mur-Artal, Montiel, Tardós, "ORB-SLAM", T-RO 2015, section V.
"""

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.limits import Fraction, Limits, NotNegative, Positive, check_limits

__all__ = ["MatchConfig", "match_all", "match_guided", "warm_up"]

Descriptors = NDArray[np.uint8]


@dataclass(frozen=True)
class MatchConfig:
    """How descriptors are matched."""

    radius_px: Positive = 24.0
    """Search radius around the expected position."""
    ratio: Fraction = 0.85
    """The best distance must be below this fraction of the second best."""
    max_hamming: Annotated[int, Limits(least=0, most=256)] = 64
    """Largest distance of binary descriptors, bits of 256."""
    max_euclidean: NotNegative = 250.0
    """Largest distance of SIFT descriptors."""

    def __post_init__(self) -> None:
        check_limits(self)


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


def warm_up() -> None:
    """Compile the kernels of this module."""
    rng = np.random.default_rng(0)
    descriptors = rng.integers(0, 255, (4, 32)).astype(np.uint8)
    keypoints = rng.uniform(0, 50, (4, 2)).astype(np.float32)
    match_guided(descriptors, keypoints.astype(np.float64), descriptors, keypoints, MatchConfig())
