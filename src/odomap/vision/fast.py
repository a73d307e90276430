"""FAST: pixels that a circle around them is brighter or darker than, with their exact scores.

A pixel c is a corner at threshold t if 9 contiguous ones of the 16 pixels p_i on the circle of
radius 3 are all brighter than c + t, or all darker than c − t. Its score is the largest difference
that still passes,

    s = max( max_k min_{i in arc k} p_i − c,  c − min_k max_{i in arc k} p_i ),

so that one pass serves every threshold: a corner at t has s > t. Minima over the 16 arcs are built
from minima of 2, 4 and 8 neighbours, without a branch, on bytes; the compiler works on 32 pixels at
a time, and the score of every pixel costs less than the usual early exits. Peaks of 3x3 scores
stay; a parabola through a peak and its neighbours gives a fraction of a pixel.

Cost: one pass over the image, some 2 ns per pixel in all.

Reference: Rosten, Porter, Drummond, "Faster and better: a machine learning approach to corner
detection", PAMI 2010.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.vision.hamming import lowest_byte

__all__ = ["LEAST_BORDER_PX", "fast_corners", "warm_up"]

Image = NDArray[np.uint8]

LEAST_BORDER_PX = 4
"""The circle and one neighbour reach this far."""
MOST_PX = 0.49
"""A refined position is not farther from its pixel."""


def fast_corners(
    image: Image, threshold: int, border_px: int = LEAST_BORDER_PX
) -> tuple[NDArray[np.int32], Image]:
    """Find the corners of an image.

    Args:
        image: (H, W) uint8.
        threshold: grey levels; the score of a corner is above it.
        border_px: margin without corners, at least `LEAST_BORDER_PX`.

    Returns:
        (N, 3) int32 pixels x, y and scores, row by row, and the (H, W) scores of all pixels, which
        are undefined in the three outermost.
    """
    image = np.ascontiguousarray(image)
    height, width = image.shape
    border = max(border_px, LEAST_BORDER_PX)
    scores = np.empty((height, width), np.uint8)
    if height <= 2 * border or width <= 2 * border:
        return np.empty((0, 3), np.int32), scores
    # No two peaks touch, hence at most every fourth pixel; what is not written costs no memory.
    corners = np.empty((((height + 1) // 2) * ((width + 1) // 2), 3), np.int32)
    peaks = np.zeros((width + 7) // 8 * 8, np.uint8)
    _score_kernel(image, scores)
    found = _peaks_kernel(scores, threshold, border, peaks, corners)
    return corners[:found], scores


def refine(corners: NDArray[np.int32], scores: Image) -> NDArray[np.float32]:
    """Return (N, 2) positions of corners to a fraction of a pixel, by a parabola in each direction.

    Args:
        corners: (N, 3) peaks as `fast_corners` gives them.
        scores: (H, W) of all pixels.
    """
    positions = np.empty((len(corners), 2), np.float32)
    _refine_kernel(corners, scores, positions)
    return positions


@kernel
def _vertex(left: np.uint8, middle: np.uint8, right: np.uint8) -> float:
    """Where a parabola through three values at −1, 0, 1 has its top."""
    bend = max(2.0 * middle - left - right, 1.0)
    # Where two neighbours are equal the top is half way: rounding is to give this pixel again.
    return float(min(max(0.5 * (float(right) - float(left)) / bend, -MOST_PX), MOST_PX))


@kernel
def _refine_kernel(
    corners: NDArray[np.int32], scores: Image, positions: NDArray[np.float32]
) -> None:
    """The top of a parabola along each axis."""
    for i in range(len(corners)):
        x, y = corners[i, 0], corners[i, 1]
        middle = scores[y, x]
        positions[i, 0] = x + _vertex(scores[y, x - 1], middle, scores[y, x + 1])
        positions[i, 1] = y + _vertex(scores[y - 1, x], middle, scores[y + 1, x])


@kernel
def _score_kernel(image: Image, scores: NDArray[np.uint8]) -> None:
    """Scores of all pixels but three at the borders (see the module's equation)."""
    height, width = image.shape
    for y in range(height - 6):
        r0, r1, r2, r3 = image[y], image[y + 1], image[y + 2], image[y + 3]
        r4, r5, r6, out = image[y + 4], image[y + 5], image[y + 6], scores[y + 3]
        for x in range(width - 6):
            c = r3[x + 3]
            p0, p1, p2, p3 = r0[x + 3], r0[x + 4], r1[x + 5], r2[x + 6]
            p4, p5, p6, p7 = r3[x + 6], r4[x + 6], r5[x + 5], r6[x + 4]
            p8, p9, p10, p11 = r6[x + 3], r6[x + 2], r5[x + 1], r4[x]
            p12, p13, p14, p15 = r3[x], r2[x], r1[x + 1], r0[x + 2]
            # Arcs k and k + 9 share the eight pixels between: min(a) of those, then the better end.
            a1, a3, a5, a7 = min(p1, p2), min(p3, p4), min(p5, p6), min(p7, p8)
            a9, a11, a13, a15 = min(p9, p10), min(p11, p12), min(p13, p14), min(p15, p0)
            b1, b3, b5, b7 = min(a1, a3), min(a3, a5), min(a5, a7), min(a7, a9)
            b9, b11, b13, b15 = min(a9, a11), min(a11, a13), min(a13, a15), min(a15, a1)
            m = min(min(b1, b5), max(p0, p9))
            m = max(m, min(min(b3, b7), max(p2, p11)))
            m = max(m, min(min(b5, b9), max(p4, p13)))
            m = max(m, min(min(b7, b11), max(p6, p15)))
            m = max(m, min(min(b9, b13), max(p8, p1)))
            m = max(m, min(min(b11, b15), max(p10, p3)))
            m = max(m, min(min(b13, b1), max(p12, p5)))
            m = max(m, min(min(b15, b3), max(p14, p7)))
            a1, a3, a5, a7 = max(p1, p2), max(p3, p4), max(p5, p6), max(p7, p8)
            a9, a11, a13, a15 = max(p9, p10), max(p11, p12), max(p13, p14), max(p15, p0)
            b1, b3, b5, b7 = max(a1, a3), max(a3, a5), max(a5, a7), max(a7, a9)
            b9, b11, b13, b15 = max(a9, a11), max(a11, a13), max(a13, a15), max(a15, a1)
            n = max(max(b1, b5), min(p0, p9))
            n = min(n, max(max(b3, b7), min(p2, p11)))
            n = min(n, max(max(b5, b9), min(p4, p13)))
            n = min(n, max(max(b7, b11), min(p6, p15)))
            n = min(n, max(max(b9, b13), min(p8, p1)))
            n = min(n, max(max(b11, b15), min(p10, p3)))
            n = min(n, max(max(b13, b1), min(p12, p5)))
            n = min(n, max(max(b15, b3), min(p14, p7)))
            out[x + 3] = max(max(m, c) - c, c - min(n, c))


@kernel
def _peaks_kernel(
    scores: NDArray[np.uint8],
    threshold: int,
    border: int,
    peaks: NDArray[np.uint8],
    corners: NDArray[np.int32],
) -> int:
    """Scores that no neighbour surpasses; of equal neighbours the first in order stays."""
    height, width = scores.shape
    words = peaks.view(np.uint64)
    t, found = np.uint8(threshold), 0
    for y in range(border, height - border):
        above, here, below = scores[y - 1], scores[y], scores[y + 1]
        for x in range(width - 2):
            c = here[x + 1]
            before = max(max(above[x], above[x + 1]), max(above[x + 2], here[x]))
            after = max(max(below[x], below[x + 1]), max(below[x + 2], here[x + 2]))
            peaks[x + 1] = c if (c > max(before, t)) & (c >= after) else np.uint8(0)
        for word in range(border // 8, (width - border + 7) // 8):
            rest = words[word]
            while rest != 0:
                byte = lowest_byte(rest)
                rest &= ~(np.uint64(255) << np.uint64(8 * byte))
                x = 8 * word + byte
                if x >= border and x < width - border:
                    corners[found, 0], corners[found, 1], corners[found, 2] = x, y, here[x]
                    found += 1
    return found


def warm_up() -> None:
    """Compile the kernels of this module."""
    refine(*fast_corners(np.zeros((16, 16), np.uint8), 20))
