"""Features: corners spread evenly over an image, with or without descriptors.

Tracking wants points that are (a) well localised in both directions and (b) everywhere, because a
cluster of strong corners on one object constrains little of the pose. Candidates come from a
detector (FAST, Harris, ORB or SIFT); FAST candidates are ranked by the smaller eigenvalue of the
structure tensor, Σ_w ∇I ∇Iᵀ, since FAST's own score does not tell an edge from a corner. A greedy
pass from the strongest to the weakest then keeps a candidate only if none is kept within a radius
r, where r follows from the number wanted: a Poisson-disk sample weighted by strength, O(n log n).

Reference: Shi, Tomasi, "Good features to track", CVPR 1994; Rosten, Drummond, "Machine learning for
high-speed corner detection", ECCV 2006.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.vision.visionconfig import Detector, FeatureConfig

__all__ = [
    "Corners",
    "Detector",
    "FeatureConfig",
    "Features",
    "corner_strength",
    "describe",
    "detect",
    "orientation",
    "spread",
]

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Features:
    """What was seen in one (rectified) image, one row per feature.

    Attributes:
        keypoints: (N, 2) float32, pixels.
        descriptors: (N, D) uint8; D = 32 for binary ones, 128 for SIFT, 0 when not described.
        bearings: (N, 3) float64 unit vectors in the camera frame.
        depth: (N,) float64 metres along z, NaN where unknown.
        level: (N,) uint8, pyramid level the feature was found on.
    """

    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    bearings: NDArray[np.float64]
    depth: NDArray[np.float64]
    level: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.keypoints)


@dataclass(frozen=True)
class Corners:
    """Candidates of a detector: (N, 2) float32 pixels, (N,) strengths, (N,) pyramid levels."""

    keypoints: NDArray[np.float32]
    strength: NDArray[np.float64]
    level: NDArray[np.uint8]


def detect(
    image: Image,
    config: FeatureConfig,
    count: int | None = None,
    occupied: NDArray[np.float32] | None = None,
    mask: NDArray[np.bool_] | None = None,
) -> Corners:
    """Find corners spread over an image.

    Args:
        image: (H, W) uint8.
        config: the detector and its settings.
        count: corners wanted; default that of the configuration.
        occupied: (M, 2) float32 pixels of points already tracked, near which none is wanted.
        mask: (H, W) bool, where corners may be; default everywhere.

    Returns:
        At most `count` corners, the strongest first.
    """
    wanted = config.count if count is None else count
    occupied = np.empty((0, 2), np.float32) if occupied is None else occupied
    if wanted <= 0:
        return _take(_empty(), np.empty(0, np.int64))
    candidates = _candidates(image, config, wanted + len(occupied))
    inside = _inside(candidates.keypoints, image.shape, config.border_px)
    if mask is not None:
        columns, rows = candidates.keypoints.astype(np.int64).T
        inside &= mask[rows.clip(0, mask.shape[0] - 1), columns.clip(0, mask.shape[1] - 1)]
    candidates = _take(candidates, np.flatnonzero(inside))
    area = float(image.shape[0] * image.shape[1])
    radius = 0.75 * np.sqrt(area / max(wanted + len(occupied), 1))
    keep = spread(candidates.keypoints, candidates.strength, wanted, radius, image.shape, occupied)
    return _take(candidates, keep)


def _candidates(image: Image, config: FeatureConfig, wanted: int) -> Corners:
    if config.detector == "fast":
        return _fast(image, config.threshold, wanted)
    if config.detector == "harris":
        found = cv2.goodFeaturesToTrack(
            image, 4 * wanted, 0.002, 3, blockSize=5, useHarrisDetector=True, k=0.04
        )
        points = (
            np.empty((0, 2), np.float32)
            if found is None
            else np.asarray(found, np.float32).reshape(-1, 2)
        )
        order = np.arange(len(points), 0, -1, dtype=np.float64)  # they come sorted by response
        return Corners(points, order, np.zeros(len(points), np.uint8))
    detector = (
        # ORB finds a corner again on every level; of those in one place only one will be kept.
        cv2.ORB.create(nfeatures=8 * wanted, fastThreshold=config.threshold)
        if config.detector == "orb"
        else cv2.SIFT.create(nfeatures=2 * wanted)
    )
    keypoints = detector.detect(image, None)
    if not keypoints:
        return _empty()
    points = np.array([k.pt for k in keypoints], np.float32)
    strength = np.array([k.response for k in keypoints], np.float64)
    # SIFT packs the level in the lowest byte, −1 for the doubled image.
    levels = np.array([k.octave & 0xFF for k in keypoints], np.uint8).view(np.int8)
    return Corners(points, strength, levels.clip(0).astype(np.uint8))


def _fast(image: Image, threshold: int, wanted: int) -> Corners:
    keypoints: Sequence[cv2.KeyPoint] = ()
    for level in (threshold, max(threshold // 2, 3)):
        keypoints = cv2.FastFeatureDetector.create(level, True).detect(image, None)
        if len(keypoints) >= wanted:
            break
    if not keypoints:
        return _empty()
    points = np.asarray(cv2.KeyPoint.convert(keypoints), np.float32)
    strength = corner_strength(image, points)
    return Corners(points, strength, np.zeros(len(points), np.uint8))


def _empty() -> Corners:
    return Corners(np.empty((0, 2), np.float32), np.empty(0), np.empty(0, np.uint8))


def _take(corners: Corners, index: NDArray[np.int64]) -> Corners:
    return Corners(corners.keypoints[index], corners.strength[index], corners.level[index])


def _inside(points: NDArray[np.float32], shape: tuple[int, ...], border: int) -> NDArray[np.bool_]:
    x, y = points[:, 0], points[:, 1]
    inside: NDArray[np.bool_] = (
        (x >= border) & (x < shape[1] - border) & (y >= border) & (y < shape[0] - border)
    )
    return inside


def corner_strength(image: Image, points: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the smaller eigenvalue of the structure tensor of a 7x7 window at each point.

    Args:
        image: (H, W) uint8.
        points: (N, 2) float32 pixels; within 4 px of the border the strength is 0.

    Returns:
        (N,) float64, squared grey levels per pixel.
    """
    strength = np.zeros(len(points))
    _corner_strength_kernel(image, np.ascontiguousarray(points, np.float32), strength)
    return strength


@kernel
def _corner_strength_kernel(
    image: Image, points: NDArray[np.float32], strength: NDArray[np.float64]
) -> None:
    """λ_min of Σ ∇I ∇Iᵀ / 49 over a 7x7 window, with central differences."""
    height, width = image.shape
    for i in range(len(points)):
        x, y = int(points[i, 0] + 0.5), int(points[i, 1] + 0.5)
        if x < 4 or y < 4 or x >= width - 4 or y >= height - 4:
            continue
        xx, xy, yy = 0.0, 0.0, 0.0
        for v in range(y - 3, y + 4):
            for u in range(x - 3, x + 4):
                dx = 0.5 * (float(image[v, u + 1]) - float(image[v, u - 1]))
                dy = 0.5 * (float(image[v + 1, u]) - float(image[v - 1, u]))
                xx += dx * dx
                xy += dx * dy
                yy += dy * dy
        half = 0.5 * (xx + yy)
        strength[i] = (half - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)) / 49.0


def spread(
    points: NDArray[np.float32],
    strength: NDArray[np.float64],
    count: int,
    radius: float,
    shape: tuple[int, ...],
    occupied: NDArray[np.float32],
) -> NDArray[np.int64]:
    """Choose strong points that keep their distance from each other.

    Args:
        points: (N, 2) float32 pixels.
        strength: (N,) the larger the better.
        count: how many are wanted.
        radius: distance to keep, pixels; halved once if that leaves too few.
        shape: (H, W) of the image.
        occupied: (M, 2) float32 points to keep away from as well.

    Returns:
        Indices into `points`, strongest first within a pass.
    """
    order = np.argsort(-strength, kind="stable")
    chosen = np.empty(count, np.int64)
    found = 0
    for distance in (radius, 0.5 * radius):
        taken = np.concatenate([occupied, points[chosen[:found]]]).astype(np.float32)
        found = _spread_kernel(
            np.ascontiguousarray(points, np.float32),
            order,
            chosen,
            found,
            distance,
            shape[0],
            shape[1],
            taken,
        )
        if found >= count:
            break
    return chosen[:found]


@kernel
def _spread_kernel(
    points: NDArray[np.float32],
    order: NDArray[np.int64],
    chosen: NDArray[np.int64],
    found: int,
    radius: float,
    height: int,
    width: int,
    taken: NDArray[np.float32],
) -> int:
    """Greedy Poisson-disk choice; cells of the radius' size, linked lists in the cells."""
    cell = max(radius, 1.0)
    rows, cols = int(height / cell) + 1, int(width / cell) + 1
    head = np.full((rows, cols), -1, np.int64)
    size = len(taken) + len(chosen)
    after = np.empty(size, np.int64)
    xs, ys = np.empty(size), np.empty(size)
    used = 0
    for i in range(len(taken) + len(order)):
        if i >= len(taken) and found >= len(chosen):
            break
        is_taken = i < len(taken)
        k = 0 if is_taken else order[i - len(taken)]
        x = float(taken[i, 0]) if is_taken else float(points[k, 0])
        y = float(taken[i, 1]) if is_taken else float(points[k, 1])
        r = min(max(int(y / cell), 0), rows - 1)
        c = min(max(int(x / cell), 0), cols - 1)
        free = True
        if not is_taken:
            for rr in range(max(r - 1, 0), min(r + 2, rows)):
                for cc in range(max(c - 1, 0), min(c + 2, cols)):
                    j = head[rr, cc]
                    while j >= 0 and free:
                        if (xs[j] - x) ** 2 + (ys[j] - y) ** 2 < radius * radius:
                            free = False
                        j = after[j]
        if free:
            xs[used], ys[used], after[used] = x, y, head[r, c]
            head[r, c] = used
            used += 1
            if not is_taken:
                chosen[found] = k
                found += 1
    return found


def describe(
    image: Image, corners: Corners, detector: Detector
) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Compute descriptors at corners.

    Args:
        image: (H, W) uint8.
        corners: where.
        detector: sift gives 128 bytes of gradient histograms, all others 32 bytes of rotated BRIEF.

    Returns:
        (M, D) uint8 descriptors and the (M,) indices of the corners they belong to (OpenCV leaves
        out corners too near to the border).
    """
    if detector == "sift":
        size, angles = np.full(len(corners.level), 7.0), np.zeros(len(corners.level))
    else:
        size, angles = 31.0 * 1.2**corners.level, orientation(image, corners.keypoints)
    octaves = np.zeros(len(size), np.int64) if detector == "sift" else corners.level
    keypoints = [
        cv2.KeyPoint(x, y, s, angle, 0.0, octave, i)
        for i, ((x, y), s, angle, octave) in enumerate(
            zip(corners.keypoints.tolist(), size.tolist(), angles.tolist(), octaves.tolist())
        )
    ]
    extractor = cv2.SIFT.create() if detector == "sift" else cv2.ORB.create()
    kept, descriptors = extractor.compute(image, keypoints)
    if descriptors is None or len(kept) == 0:
        return np.empty((0, 128 if detector == "sift" else 32), np.uint8), np.empty(0, np.int64)
    return np.clip(descriptors, 0, 255).astype(np.uint8), np.array(
        [k.class_id for k in kept], np.int64
    )


def orientation(image: Image, points: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the direction of the intensity centroid of the 31x31 patch at each point.

    Args:
        image: (H, W) uint8.
        points: (N, 2) float32 pixels; within 15 px of the border the angle is 0.

    Returns:
        (N,) degrees from the x axis towards y, 0 to 360 (Rublee et al., ORB, ICCV 2011).
    """
    moments = np.zeros((len(points), 2))
    _centroid_kernel(image, np.ascontiguousarray(points, np.float32), moments)
    angles: NDArray[np.float64] = np.degrees(np.arctan2(moments[:, 1], moments[:, 0])) % 360.0
    return angles


@kernel
def _centroid_kernel(
    image: Image, points: NDArray[np.float32], moments: NDArray[np.float64]
) -> None:
    """m = Σ (u, v) I(x + u, y + v) over the disc of radius 15."""
    height, width = image.shape
    for i in range(len(points)):
        x, y = int(points[i, 0] + 0.5), int(points[i, 1] + 0.5)
        if x < 15 or y < 15 or x >= width - 15 or y >= height - 15:
            continue
        mx, my = 0, 0
        for v in range(-15, 16):
            for u in range(-15, 16):
                if u * u + v * v <= 225:
                    mx += u * image[y + v, x + u]
                    my += v * image[y + v, x + u]
        moments[i, 0], moments[i, 1] = mx, my


def warm_up() -> None:
    """Compile the kernels of this module."""
    image = np.zeros((32, 32), np.uint8)
    points = np.array([[10.0, 10.0], [20.0, 20.0]], np.float32)
    spread(points, corner_strength(image, points), 2, 5.0, image.shape, points[:0])
    orientation(image, points)
