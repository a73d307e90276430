"""The picture of the live view: an image with its tracks, fast enough for every frame shown.

Points the pose agrees with are green dots, the others red crosses; both have a trail from where
they were in the frame they were tracked from. Trails are drawn in one call per colour, dots are
written as blocks of pixels, so that a thousand tracks take about a millisecond.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.maps.estimate import Tracks

__all__ = ["picture", "shrunk"]

INLIER = (53, 224, 161)
OUTLIER = (255, 84, 60)
"""Colours, RGB; shape tells as well for those who cannot tell them apart."""

WIDEST_PX = 640
TRACKS = 2000
"""At most so many points are drawn."""
LONGEST_TRAIL = 0.25
"""Trails longer than this share of the image's width are mistakes, and only hide the image."""

DOT = np.array([(u, v) for u in (-1, 0, 1) for v in (-1, 0, 1)])
CROSS = np.array([(k, s * k) for k in (-4, -3, -2, -1, 0, 1, 2, 3, 4) for s in (-1, 1)])
CROSS = np.array([(u + w, v) for u, v in CROSS for w in (0, 1)])


def picture(image: NDArray[np.uint8], tracks: Tracks | None) -> NDArray[np.uint8]:
    """Draw tracks on an image.

    Args:
        image: (H, W) or (H, W, 3) uint8.
        tracks: points of this image, or None to show it bare.

    Returns:
        (h, w, 3) uint8 RGB, at most 640 wide.
    """
    small = shrunk(image, WIDEST_PX)
    coloured = cv2.cvtColor(small, cv2.COLOR_GRAY2RGB) if small.ndim == 2 else small.copy()
    canvas = np.asarray(coloured, np.uint8)
    if tracks is not None and len(tracks.keypoints):
        zoom = small.shape[1] / image.shape[1]
        for wanted, colour, mark in ((True, INLIER, DOT), (False, OUTLIER, CROSS)):
            rows = np.flatnonzero(tracks.inlier == wanted)[:TRACKS]
            _draw(canvas, zoom * tracks.keypoints[rows], zoom * tracks.previous[rows], colour, mark)
    return canvas


def shrunk(image: NDArray[np.uint8], widest_px: int) -> NDArray[np.uint8]:
    """Return an image no wider than so many pixels."""
    height, width = image.shape[:2]
    if width <= widest_px:
        return image
    size = (widest_px, max(1, round(height * widest_px / width)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _draw(
    canvas: NDArray[np.uint8],
    now: NDArray[np.float32],
    before: NDArray[np.float32],
    colour: tuple[int, int, int],
    mark: NDArray[np.int64],
) -> None:
    height, width = canvas.shape[:2]
    known = np.isfinite(now).all(axis=1)
    short = np.linalg.norm(now - before, axis=1) < LONGEST_TRAIL * width  # NaN is not short
    both = known & short
    trails = np.stack([before[both], now[both]], axis=1).round().astype(np.int32)
    cv2.polylines(canvas, list(trails), False, colour, 1, cv2.LINE_AA)
    pixels = (now[known].round().astype(np.int64)[:, None] + mark).reshape(-1, 2)
    inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
    u, v = pixels[inside].T
    canvas[v, u] = colour
