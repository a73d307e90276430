"""Stereo: depth of points, or of all pixels, from a rectified pair.

In a rectified pair a point at depth z appears on the same row of both images, shifted by the
disparity d = x_left − x_right = f b / z. Sparse matching goes in two steps. A search along the
row compares windows by their sum of absolute differences (SAD) at whole disparities and takes the
best, if no other place is nearly as good. The best is then refined by aligning the patches as in
`flow`, in both directions: fitting a parabola to SAD scores instead pulls disparities towards
whole numbers, which turns into a scale error of the path, and a vertical offset left over from
calibration would bend horizontal ones. Dense matching (`sgbm`) is OpenCV's semi-global matching.

Cost: points x disparities x window area; 400 points in 128 disparities take a few milliseconds.

Reference: Hirschmüller, "Stereo Processing by Semiglobal Matching and Mutual Information", PAMI
2008; Shimizu, Okutomi, "Precise Sub-pixel Estimation on Area-based Matching", ICCV 2001 (on pixel
locking).
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.vision.patches import align_patches
from odomap.vision.visionconfig import StereoConfig

__all__ = ["StereoConfig", "match_sparse", "sgbm_disparity"]

Image = NDArray[np.uint8]

MOST_HALF = 7
"""Sums over windows of up to this half side, 225 differences, go into 16 bits."""


def match_sparse(
    left: Image,
    right: Image,
    points: NDArray[np.float64],
    config: StereoConfig,
    lowest: NDArray[np.float64] | None = None,
    highest: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Measure the disparities of points of the left image.

    Args:
        left: (H, W) uint8, rectified.
        right: (H, W) uint8, rectified.
        points: (N, 2) pixels in the left image.
        config: search range, windows, checks.
        lowest: (N,) smallest disparity to search for each point; default −2 (a little beyond
            infinity, so that a pair that is not what it claims shows).
        highest: (N,) largest disparity to search; default the configuration's.

    Returns:
        (N,) disparities in pixels, NaN where there is no match to trust.
    """
    n = len(points)
    low = np.full(n, -2.0) if lowest is None else np.maximum(lowest, -2.0)
    high = np.full(n, float(config.max_disparity_px)) if highest is None else highest
    high = np.minimum(high, float(config.max_disparity_px))
    coarse, width = np.full(n, np.nan), left.shape[1]
    _search_kernel(
        left,
        right,
        np.ascontiguousarray(points, np.float64),
        np.floor(low).astype(np.int64),
        np.ceil(high).astype(np.int64),
        config.half_search_px,
        config.uniqueness,
        np.empty(width, np.uint16)
        if config.half_search_px <= MOST_HALF
        else np.empty(width, np.int32),
        coarse,
    )
    disparity = np.full(n, np.nan)
    index = np.flatnonzero(np.isfinite(coarse))
    if not index.size:
        return disparity
    start = points[index] - np.stack([coarse[index], np.zeros(index.size)], axis=1)
    identity = np.tile(np.eye(2), (index.size, 1, 1))
    fine = align_patches(left, right, points[index], start, identity, config.half_refine_px, 12)
    off = fine.points - start
    good = (
        fine.found
        & (fine.correlation >= config.min_correlation)
        & (np.abs(off[:, 1]) <= config.max_vertical_px)
        & (np.abs(off[:, 0]) <= 1.5)
    )
    disparity[index[good]] = points[index[good], 0] - fine.points[good, 0]
    return disparity


@kernel
def _search_kernel(
    left: Image,
    right: Image,
    points: NDArray[np.float64],
    low: NDArray[np.int64],
    high: NDArray[np.int64],
    half: int,
    uniqueness: float,
    scores: NDArray[np.uint16] | NDArray[np.int32],
    disparity: NDArray[np.float64],
) -> None:
    """argmin_d Σ |L(x + u, y + v) − R(x − d + u, y + v)| over whole d, if clearly the best.

    The innermost loop runs along the row of the right image, over all candidates at once; the
    narrower the scores, the more of them.
    """
    height, width = left.shape
    for i in range(len(points)):
        x, y = int(np.floor(points[i, 0] + 0.5)), int(np.floor(points[i, 1] + 0.5))
        if x < half or y < half or x >= width - half or y >= height - half:
            continue
        begin = max(x - high[i], half)  # candidates are columns of the right image
        count = min(x - low[i], width - half - 1) - begin + 1
        if count < 3:
            continue
        scores[:count] = 0
        for v in range(-half, half + 1):
            for u in range(-half, half + 1):
                grey = left[y + v, x + u]
                row = right[y + v, begin + u : begin + u + count]
                for k in range(count):
                    scores[k] += max(grey, row[k]) - min(grey, row[k])
        at = np.argmin(scores[:count])
        other = 2**30
        for k in range(count):
            if abs(k - at) > 2 and scores[k] < other:
                other = scores[k]
        if scores[at] < uniqueness * other:
            disparity[i] = x - (begin + at)


def sgbm_disparity(left: Image, right: Image, config: StereoConfig) -> NDArray[np.float32]:
    """Return the dense disparity map (H, W) float32 of a rectified pair, NaN where unknown."""
    block = 5
    count = 16 * max(1, -(-config.max_disparity_px // 16))
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=count,
        blockSize=block,
        P1=8 * block * block,
        P2=32 * block * block,
        disp12MaxDiff=1,
        uniquenessRatio=8,
        speckleWindowSize=60,
        speckleRange=2,
        preFilterCap=31,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    disparity = matcher.compute(left, right).astype(np.float32) / np.float32(16.0)
    return np.where(disparity > 0, disparity, np.float32(np.nan))


def warm_up() -> None:
    """Compile the kernels of this module."""
    image = np.random.default_rng(0).integers(0, 255, (40, 80)).astype(np.uint8)
    match_sparse(image, image, np.array([[50.0, 20.0]]), StereoConfig(max_disparity_px=16))
