"""Picking features: the sharpest and the flattest points of all parts of the lines of a sweep.

Taken where they are most, edges would all be of one fence. So each line is parted into sectors; of
each the largest curvatures are taken in falling order, none within reach of another, and the
smallest in each of as many pieces, so that planes are spread out, too.

Curvature has its peak beside a bend of which one side is seen at a slant, where points lie farther
apart. An edge is where the line is farthest from the straight one between both ends of what was
looked at; and where that is behind a step it is the point before it, since what is behind goes on.

Cost: 20 ns a point.

Reference: J. Zhang, S. Singh, "LOAM: lidar odometry and mapping in real-time", RSS 2014, section V;
D. H. Douglas, T. K. Peucker, "Algorithms for the reduction of the number of points required to
represent a digitized line or its caricature", Cartographica 10(2), 1973.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.lidar.breaks import FAR_MORE
from odomap.lidar.curvature import CUT, FRONT, is_smooth
from odomap.lidar.featureconfig import CurvatureConfig
from odomap.lidar.scanlines import ScanLines

__all__ = ["EDGE", "FLAT", "PLANE", "pick", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Marks = NDArray[np.uint8]

FLAT, PLANE, EDGE = 1, 2, 3
"""Marks of points: in a plane; so, and picked; an edge, and picked. 0 are all others."""
SIDE = 4
"""Points on either side of a bend between which the line must be smooth."""


def pick(lines: ScanLines, c: Array, reach: Index, may: Marks, config: CurvatureConfig) -> Marks:
    """Mark edges and planes.

    Args:
        lines: the points.
        c: (N,) curvatures. reach: (N,) neighbours looked at.
        may: (N,) 0 leaves a point out, 1 lets it be a plane, 2 an edge, 3 either.
        config: how many.
    """
    marks = np.zeros(len(c), np.uint8)
    parts = max(len(lines) * config.sectors, 1)
    planes = max(config.planes, config.least_planes // parts)
    _pick(
        lines.points, lines.start, c, reach, may, config.noise, config.sharp, config.flat,
        config.sectors, config.edges, planes, marks,
    )  # fmt: skip
    return marks


@kernel
def _is_bent(p: Array, c: Array, n: int, first: int, last: int, noise: float) -> bool:
    """Whether those beside a point are bent half as much, too, and the line is smooth there."""
    if c[n] == FRONT:
        return True
    if n == first or n + 1 == last or c[n - 1] == CUT or c[n + 1] == CUT:
        return False
    if min(abs(c[n - 1]), abs(c[n + 1])) < 0.5 * c[n]:
        return False  # off by itself
    k = min(SIDE, min(n - 1 - first, last - 2 - n))
    return is_smooth(p, n - 1, -1, k, noise) and is_smooth(p, n + 1, 1, k, noise)


@kernel
def _corner(p: Array, c: Array, at: int, k: int, first: int, last: int) -> int:
    """The point farthest from the line through both ends of what was looked at around an edge.

    Where one side is seen at a slant c has its peak beside the bend; this has it there.
    """
    if c[at] == FRONT:
        return at
    low, high = at, at
    while low > max(first, at - k) and c[low - 1] != FRONT and c[low] != CUT:
        low -= 1
    while high < min(last - 1, at + k) and c[high + 1] != FRONT and c[high] != CUT:
        high += 1
    low, high = low + 1, high - 1
    x, y, z = (p[low - 1, 0] + p[low, 0] + p[low + 1, 0]) / 3.0, 0.0, 0.0
    y = (p[low - 1, 1] + p[low, 1] + p[low + 1, 1]) / 3.0
    z = (p[low - 1, 2] + p[low, 2] + p[low + 1, 2]) / 3.0
    u = (p[high - 1, 0] + p[high, 0] + p[high + 1, 0]) / 3.0 - x
    v = (p[high - 1, 1] + p[high, 1] + p[high + 1, 1]) / 3.0 - y
    w = (p[high - 1, 2] + p[high, 2] + p[high + 1, 2]) / 3.0 - z
    best, farthest = at, -1.0
    for n in range(low + 1, high):
        a = (p[n - 1, 0] + p[n, 0] + p[n + 1, 0]) / 3.0 - x
        b = (p[n - 1, 1] + p[n, 1] + p[n + 1, 1]) / 3.0 - y
        d = (p[n - 1, 2] + p[n, 2] + p[n + 1, 2]) / 3.0 - z
        i, j, k = b * w - d * v, d * u - a * w, a * v - b * u
        square = i * i + j * j + k * k
        if square > farthest:
            best, farthest = n, square
    return _nearer(p, best, first, last)


@kernel
def _nearer(p: Array, n: int, first: int, last: int) -> int:
    """The point before a step, where one behind it was found: what is behind ends nowhere."""
    for way in (-1, 1):
        a, b, before = n + way, n + 2 * way, n - way
        if min(b, before) < first or max(b, before) >= last:
            continue
        jump, inner, outer, near, far = 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(3):
            jump += (p[a, i] - p[n, i]) ** 2
            inner += (p[n, i] - p[before, i]) ** 2
            outer += (p[b, i] - p[a, i]) ** 2
            near, far = near + p[a, i] ** 2, far + p[n, i] ** 2
        if near < far and jump > FAR_MORE * FAR_MORE * max(inner, outer):
            return a
    return n


@kernel
def _pick(
    p: Array, start: Index, c: Array, reach: Index, may: Marks, noise: float, sharp: float,
    flat: float, sectors: int, edges: int, planes: int, marks: Marks,
) -> None:  # fmt: skip
    """Edges by falling c, none within reach of another; planes by least c in pieces."""
    taken = np.zeros(c.shape[0], np.bool_)
    for line in range(start.shape[0] - 1):
        first, count = start[line], start[line + 1] - start[line]
        for sector in range(sectors):
            begin, end = first + sector * count // sectors, first + (sector + 1) * count // sectors
            left = edges
            while left > 0:
                best, at = sharp, -1
                for n in range(begin, end):
                    if c[n] != CUT and abs(c[n]) >= best and not taken[n] and may[n] >= 2:
                        best, at = abs(c[n]), n
                if at < 0:
                    break
                if c[at] > 0.0 and _is_bent(p, c, at, first, first + count, noise):
                    corner = _corner(p, c, at, reach[at], first, first + count)
                    marks[corner if may[corner] >= 2 else at] = EDGE
                    left -= 1
                low, high = max(at - reach[at], first), min(at + reach[at] + 1, first + count)
                for n in range(low, high):
                    taken[n] = True
            for piece in range(planes):
                low = begin + piece * (end - begin) // planes
                high = begin + (piece + 1) * (end - begin) // planes
                best, at = flat, -1
                for n in range(low, high):
                    if taken[n] or c[n] < 0.0 or c[n] >= flat or (may[n] & 1) == 0:
                        continue
                    marks[n] = FLAT
                    if c[n] < best:
                        best, at = c[n], n
                if at >= 0:
                    marks[at] = PLANE


def warm_up() -> None:
    """Compile the kernels of this file."""
    points = np.array([[5.0, 0.01 * n, 0.0] for n in range(12)])
    lines = ScanLines(points, np.arange(12), np.array([0, 12]), True, 0.002)
    c, reach = np.linspace(0.0, 1.0, 12), np.full(12, 2)
    pick(lines, c, reach, np.full(12, 3, np.uint8), CurvatureConfig())
