"""Curvature: which points of a scan line are edges, and which lie in planes.

The problem: of 120,000 points a few thousand say where the sensor is. LOAM takes those where the
surface bends most, and least. With the means m₋ and m₊ of the k points before and after X on a line

    d = (m₋ + m₊)/2 - X,    d⊥ = d - (d·t) t  across t = m₊ - m₋,    c = 2 |d⊥| / (|m₋-X| + |m₊-X|)

c is 0 on a straight line, 0.7 at a right angle, 1 where the line turns back, at any range and for
any sensor (LOAM divides by |X| instead, and takes d, which is not 0 where points lie denser on one
side). k spans a baseline, so that noise does not look like an edge close by, nor do edges where d⊥
is within the noise count. Sums along the line give both means at once, whatever k is.

A line breaks where it leaves a surface (`breaks`). What is behind there is left out, since where it
ends only depends on what hides it; what is in front is an edge, and so is a post, thin with breaks
on both sides. Surfaces along the beam are left out, and leaves, among which a line is not smooth.
What of all that is used is picked elsewhere (`featurepicking`).

Cost: 50 ns a point.

Reference: J. Zhang, S. Singh, "LOAM: lidar odometry and mapping in real-time", RSS 2014, section V.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.pnp_kernels import cholesky_solve
from odomap.kernels import kernel
from odomap.lidar.breaks import JOINED, find_breaks, is_before
from odomap.lidar.featureconfig import CurvatureConfig
from odomap.lidar.scanlines import ScanLines

__all__ = ["CUT", "FRONT", "curvatures", "is_smooth", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Marks = NDArray[np.uint8]

SURE = 4.0
"""How many standard deviations of the noise an edge stands out."""
FEWEST_OF_A_POST = 3
"""Points of a post: one or two in front of all others may be stray."""
ON_PLANE, BY_PLANE = 1.5, 2.0
"""How many standard deviations of the noise points are off a plane that fits them, and up to which
it may yet be one, so that there is no edge either."""
AROUND = 3
"""Points to either side through which it is laid."""
RIDGE = 1e-9
"""What keeps a plane through points of a straight line definite."""
FRONT, CUT = 1.0, -2.0
"""Curvature of an edge in front of something, and of points too near to a break to have one."""


def curvatures(lines: ScanLines, config: CurvatureConfig) -> tuple[Array, Index]:
    """Return curvatures (N,) and how many neighbours (N,) were looked at on either side.

    Curvatures are negative where a point is neither an edge nor in a plane.
    """
    c, reach = np.empty(len(lines.points)), np.empty(len(lines.points), np.int64)
    for line in range(len(lines)):
        first, last = int(lines.start[line]), int(lines.start[line + 1])
        if last - first < 2 * config.fewest + 1:
            c[first:last], reach[first:last] = CUT, config.fewest
            continue
        part = slice(first, last)
        _curvatures(
            lines.points[part], lines.step, config.baseline, config.fewest, config.most,
            config.noise, config.sharp, config.flat, config.grazing, config.gap, config.missing,
            config.thin, c[part], reach[part],
        )  # fmt: skip
        if not lines.turns:
            _unbend(lines.points[part], AROUND, config.noise, config.sharp, config.flat, c[part])
    return c, reach


@kernel
def _curvatures(
    p: Array, step: float, baseline: float, fewest: int, most: int, noise: float, sharp: float,
    flat: float, grazing: float, gap: float, missing: float, thin: float, c: Array, reach: Index,
) -> None:  # fmt: skip
    """c of the points of one line, -c for those left out, CUT for those that a break cuts off."""
    count = p.shape[0]
    ranges, sums, breaks = np.empty(count), np.zeros((count + 1, 3)), np.empty(count, np.uint8)
    for n in range(count):
        x, y, z = p[n, 0], p[n, 1], p[n, 2]
        ranges[n] = np.sqrt(x * x + y * y + z * z)
        sums[n + 1, 0], sums[n + 1, 1] = sums[n, 0] + x, sums[n, 1] + y
        sums[n + 1, 2] = sums[n, 2] + z
    find_breaks(p, ranges, step, gap, missing, noise, breaks)
    begin, end = 0, 0
    while begin < count:  # a piece without breaks after the other
        end = begin + 1
        while end < count and breaks[end - 1] == JOINED:
            end += 1
        for n in range(begin, end):
            wanted = int(np.ceil(baseline / max(ranges[n] * step, 1e-6)))
            reach[n] = min(max(wanted, fewest), most)
            k, c[n] = min(reach[n], n - begin, end - 1 - n), CUT
            if k >= fewest:
                c[n] = _bend(p, sums, ranges, n, k, noise, sharp, flat, grazing)
        _ends(p, sums, ranges, breaks, begin, end, fewest, noise, grazing, gap, thin, c)
        begin = end


@kernel
def _bend(
    p: Array,
    sums: Array,
    ranges: Array,
    n: int,
    k: int,
    noise: float,
    sharp: float,
    flat: float,
    grazing: float,
) -> float:
    """c of one point, -c where the line is along the beam; no edge where the bend may be noise."""
    ax = (sums[n, 0] - sums[n - k, 0]) / k - p[n, 0]
    ay = (sums[n, 1] - sums[n - k, 1]) / k - p[n, 1]
    az = (sums[n, 2] - sums[n - k, 2]) / k - p[n, 2]
    bx = (sums[n + k + 1, 0] - sums[n + 1, 0]) / k - p[n, 0]
    by = (sums[n + k + 1, 1] - sums[n + 1, 1]) / k - p[n, 1]
    bz = (sums[n + k + 1, 2] - sums[n + 1, 2]) / k - p[n, 2]
    a, b = np.sqrt(ax * ax + ay * ay + az * az), np.sqrt(bx * bx + by * by + bz * bz)
    tx, ty, tz = bx - ax, by - ay, bz - az
    t2 = tx * tx + ty * ty + tz * tz + 1e-18
    x, y, z = p[n, 0], p[n, 1], p[n, 2]
    cx, cy, cz = y * tz - z * ty, z * tx - x * tz, x * ty - y * tx
    is_along = cx * cx + cy * cy + cz * cz < grazing * grazing * t2 * ranges[n] * ranges[n]
    dx, dy, dz = 0.5 * (ax + bx), 0.5 * (ay + by), 0.5 * (az + bz)
    along = (dx * tx + dy * ty + dz * tz) / t2
    dx, dy, dz = dx - along * tx, dy - along * ty, dz - along * tz
    bend = np.sqrt(dx * dx + dy * dy + dz * dz)
    c = 2.0 * bend / (a + b + 1e-12)
    if bend < noise:
        c = min(c, 0.999 * flat * bend / noise)
    if bend < SURE * noise:
        c = min(c, 0.999 * sharp)
    return float(-c if is_along else c)


@kernel
def is_smooth(p: Array, n: int, way: int, k: int, noise: float) -> bool:
    """Whether k steps along the line lead about straight away, as they do not among leaves."""
    path, straight = 0.0, 0.0
    for j in range(k):
        a, b, square = n + way * j, n + way * (j + 1), 0.0
        for i in range(3):
            square += (p[b, i] - p[a, i]) ** 2
        path += np.sqrt(square)
    for i in range(3):
        straight += (p[n + way * k, i] - p[n, i]) ** 2
    straight = np.sqrt(straight)
    return bool(path - straight < 0.5 * straight + 1.5 * noise * k)


@kernel
def _ends(
    p: Array, sums: Array, ranges: Array, breaks: Marks, begin: int, end: int, fewest: int,
    noise: float, grazing: float, gap: float, thin: float, c: Array,
) -> None:  # fmt: skip
    """c = FRONT at the ends of a piece that have something behind them."""
    count, last = end - begin, end - 1
    if count == 1:
        return
    before = is_before(p, ranges, breaks, begin, -1, gap)
    after = is_before(p, ranges, breaks, last, 1, gap)
    x, y, z = p[last, 0] - p[begin, 0], p[last, 1] - p[begin, 1], p[last, 2] - p[begin, 2]
    if before and after and x * x + y * y + z * z < thin * thin:
        if count >= FEWEST_OF_A_POST:
            c[begin], c[last] = FRONT, FRONT
        return
    if count <= fewest:
        return
    for side in range(2):
        if not (before if side == 0 else after):
            continue
        n, way = (begin, 1) if side == 0 else (last, -1)
        if not is_smooth(p, n, way, fewest, noise):
            continue
        first = begin + 1 if side == 0 else last - fewest
        stop = first + fewest
        x = (sums[stop, 0] - sums[first, 0]) / fewest - p[n, 0]
        y = (sums[stop, 1] - sums[first, 1]) / fewest - p[n, 1]
        z = (sums[stop, 2] - sums[first, 2]) / fewest - p[n, 2]
        u, v, w = p[n, 0], p[n, 1], p[n, 2]
        a, b, d = v * z - w * y, w * x - u * z, u * y - v * x
        sine2 = (a * a + b * b + d * d) / ((x * x + y * y + z * z) * ranges[n] * ranges[n] + 1e-12)
        if sine2 > grazing * grazing:
            c[n] = FRONT


@kernel
def _unbend(p: Array, k: int, noise: float, sharp: float, flat: float, c: Array) -> None:
    """c ← at most `flat` where a line that itself is curved lies in a plane, no edge where it may.

    On a plane nᵀ X = d the inverse range is linear in the direction u, 1/r = (n/d)ᵀ u. Where that
    fits 2k + 1 points to within the noise they are of one plane, however the beam went.
    """
    H, g, a = np.empty((3, 3)), np.empty(3), np.empty(3)
    for n in range(k, p.shape[0] - k):
        if c[n] == FRONT:
            continue
        mean = 0.0
        H[:], g[:] = 0.0, 0.0
        for j in range(n - k, n + k + 1):
            r = np.sqrt(p[j, 0] ** 2 + p[j, 1] ** 2 + p[j, 2] ** 2)
            mean += r / (2 * k + 1)
            for i in range(3):
                g[i] += p[j, i] / (r * r)
                for m in range(3):
                    H[i, m] += p[j, i] * p[j, m] / (r * r)
        for i in range(3):
            H[i, i] += RIDGE * (2 * k + 1)
        if not cholesky_solve(H, g, a):
            continue
        square = 0.0
        for j in range(n - k, n + k + 1):
            along = a[0] * p[j, 0] + a[1] * p[j, 1] + a[2] * p[j, 2]  # 1 on the plane
            r = np.sqrt(p[j, 0] ** 2 + p[j, 1] ** 2 + p[j, 2] ** 2)
            square += ((1.0 - along) * r) ** 2 / (2 * k - 2)
        off = np.sqrt(square) / (noise * (1.0 + mean / 50.0))
        if off < ON_PLANE:
            c[n] = min(abs(c[n]), 0.999 * flat * off / ON_PLANE)
        elif off < BY_PLANE and c[n] >= sharp:
            c[n] = 0.999 * sharp


def warm_up() -> None:
    """Compile the kernels of this file."""
    points = np.array([[5.0, 0.01 * n, 0.0] for n in range(12)])
    order, start = np.arange(12), np.array([0, 12])
    lines = ScanLines(points, order, start, True, 0.002)
    curvatures(lines, CurvatureConfig())
    curvatures(ScanLines(points, order, start, False, 0.002), CurvatureConfig())
