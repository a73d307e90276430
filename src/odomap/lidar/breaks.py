"""Breaks: where a scan line leaves one surface for another.

What lies before something ends there, and what lies behind goes on: where its points stop depends
on the sensor alone, and an edge found there stands nowhere (LOAM's points to leave out). Neighbours
too far apart to be of one surface are told by their distance,

    |p' - p| > gap + r θ / sin 12°      (θ: angle between both beams),

but beams a degree apart meet ground 8 m away every metre, and a car's side before its far end is no
farther from it than that. So both sides are laid out past their ends, along the line through their
last two points, to the other's beam. If the sides end at ranges r₁ and r₂, and the first meets the
beam of the second at r₁₂,

    s₁ = r₁₂ - r₂,   s₂ = r₂₁ - r₁:    the first hides the second where s₁ < 0 < s₂

by more than noise makes; both positive are a corner seen from within, as where a wall meets the
floor, both negative one from without: there the surfaces meet. A point astray by x makes a step of
2x, so on both sides a third point must lie on the line to half of that.

Cost: 20 ns a point.

Reference: J. Zhang, S. Singh, "LOAM: lidar odometry and mapping in real-time", RSS 2014, section V;
J. Lin, F. Zhang, "Loam livox", ICRA 2020, section III (which points to leave out of a solid-state
LiDAR's).
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["FAR_MORE", "JOINED", "find_breaks", "is_before", "warm_up"]

Array = NDArray[np.float64]
Marks = NDArray[np.uint8]

JOINED, BEHIND, BEFORE, UNKNOWN = range(4)
"""What is between a point and the next: one surface; the next is behind, or in front; nothing."""
STEEP = 0.2
"""Sine of the angle with the beam up to which neighbours of one surface are told from a break."""
FAR_MORE = 2.5
"""How many times farther it is across an end than along a surface."""
PAST = 10.0
"""By how many standard deviations of the noise sides that do not meet go past one another: s is a
sum of ranges, weighed 1, -2 and 1, so that these are 4 of its own."""


@kernel
def find_breaks(
    p: Array, ranges: Array, step: float, gap: float, missing: float, noise: float, breaks: Marks
) -> None:
    """Write what is between each point (N, 3) of a line and the next."""
    for n in range(p.shape[0] - 1):
        dx, dy, dz = p[n + 1, 0] - p[n, 0], p[n + 1, 1] - p[n, 1], p[n + 1, 2] - p[n, 2]
        near, far = min(ranges[n], ranges[n + 1]), max(ranges[n], ranges[n + 1])
        chord2 = dx * dx + dy * dy + dz * dz
        theta = np.sqrt(max(chord2 - (far - near) ** 2, 0.0) / (near * far + 1e-12))
        if theta > missing * step:
            breaks[n] = UNKNOWN
            limit = gap + near * step
        else:
            breaks[n] = BEHIND if ranges[n + 1] > ranges[n] else BEFORE
            limit = gap + near * theta / STEEP
        if chord2 <= limit * limit:
            breaks[n] = JOINED
    breaks[p.shape[0] - 1] = UNKNOWN
    joined = 0  # steps before this one that are of one surface
    for n in range(p.shape[0] - 3):
        if breaks[n] != JOINED:
            joined = 0
            continue
        if joined >= 2 and breaks[n + 1] == JOINED and breaks[n + 2] == JOINED:
            breaks[n] = _past(p, ranges, n, noise)
        joined = joined + 1 if breaks[n] == JOINED else 0


@kernel
def _past(p: Array, ranges: Array, n: int, noise: float) -> int:
    """Whether the three points up to n and the three from the next on go past one another."""
    limit = PAST * noise * (1.0 + min(ranges[n], ranges[n + 1]) / 50.0)
    first = _laid_out(p, n - 1, n, n + 1) - ranges[n + 1]
    if abs(first) <= limit:
        return JOINED
    second = _laid_out(p, n + 2, n + 1, n) - ranges[n]
    if first < -limit and second > limit:
        found = BEHIND
    elif second < -limit and first > limit:
        found = BEFORE
    else:
        return JOINED
    if abs(_laid_out(p, n - 2, n - 1, n) - ranges[n]) > 0.5 * limit:
        return JOINED
    if abs(_laid_out(p, n + 3, n + 2, n + 1) - ranges[n + 1]) > 0.5 * limit:
        return JOINED
    return found


@kernel
def _laid_out(p: Array, before: int, end: int, beside: int) -> float:
    """How far along the beam of one point the line on through two others is; inf: it never is."""
    x, y, z = p[beside, 0], p[beside, 1], p[beside, 2]
    r = np.sqrt(x * x + y * y + z * z)
    x, y, z = x / r, y / r, z / r
    a, b, c = p[end, 0], p[end, 1], p[end, 2]
    u, v, w = a - p[before, 0], b - p[before, 1], c - p[before, 2]
    along, way = a * x + b * y + c * z, u * x + v * y + w * z
    a, b, c = a - along * x, b - along * y, c - along * z
    u, v, w = u - way * x, v - way * y, w - way * z
    t = -(a * u + b * v + c * w) / (u * u + v * v + w * w + 1e-12)
    return float(along + t * way) if t > 0.0 else np.inf


@kernel
def is_before(p: Array, ranges: Array, breaks: Marks, n: int, way: int, gap: float) -> bool:
    """Whether an end of a piece (way: where it ends) is before a surface, and no stray point.

    The way to it is far longer than that to the point before, and than the next one behind.
    """
    a, b, c, before = n + way, n + 2 * way, n + 3 * way, n - way
    if c < 0 or c >= p.shape[0]:
        return False
    if breaks[n if way > 0 else a] != (BEHIND if way > 0 else BEFORE):
        return False
    if min(ranges[a], min(ranges[b], ranges[c])) < ranges[n] + 0.5 * gap:
        return False
    jump, inner, outer = 0.0, 0.0, 0.0
    for i in range(3):
        jump += (p[a, i] - p[n, i]) ** 2
        inner += (p[n, i] - p[before, i]) ** 2
        outer += (p[b, i] - p[a, i]) ** 2
    return bool(jump > FAR_MORE * FAR_MORE * max(inner, outer))


def warm_up() -> None:
    """Compile the kernels of this file."""
    points, ranges = np.array([[5.0, 0.01 * n, 0.0] for n in range(8)]), np.full(8, 5.0)
    breaks = np.empty(8, np.uint8)
    find_breaks(points, ranges, 0.002, 0.15, 4.0, 0.02, breaks)
    is_before(points, ranges, breaks, 3, 1, 0.15)
