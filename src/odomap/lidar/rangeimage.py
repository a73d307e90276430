"""Range images: a sweep as rows of beams and columns of directions, ground and clusters in it.

The problem: grass and leaves look like edges from everywhere, and lie nowhere again. LeGO-LOAM asks
first what is ground, and what is a thing. Neighbours in the image are neighbours in the world, or
one hides the other, so neither needs a search.

    ground   between rings the way up is less than a slope, to the ring below and to the one above,
             and so it is from the last ground of the column, beginning under the sensor
    things   the line between neighbours at d₁ ≥ d₂, α apart, is seen at β from the farther one,
             tan β = d₂ sin α / (d₁ - d₂ cos α): of one thing where β is large; joined by union-find

Things of few points are dropped, unless they stand upright across three rows, as posts do. Patterns
without rings are sorted into rows by elevation, as wide as the points are apart.

Cost: 60 ns a point.

Reference: T. Shan, B. Englot, "LeGO-LOAM: lightweight and ground-optimized lidar odometry and
mapping on variable terrain", IROS 2018; I. Bogoslavskyi, C. Stachniss, "Fast range image-based
segmentation of sparse 3D laser scans for online operation", IROS 2016.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.lidar.scanlines import ScanLines

__all__ = ["RangeImage", "find_clusters", "find_ground", "range_image", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bools = NDArray[np.bool_]

FEWEST_COLUMNS, MOST_COLUMNS = 180, 4096
MOST_ROWS = 256
LOOSE = 1.2
"""Side of a pixel where there are no rings, in distances of the points."""
SKIPPED = 4
"""Rows, and columns, without a return that a neighbour may be beyond."""
APART = 0.3
"""Least distance of rings between which a slope is measured, if there are such, metres."""
STEP = 0.1
"""What the ground may be off the slope, such as at a kerb, metres."""
NEAR_M, LEVEL_M = 15.0, 0.7
"""Where ground is that the height of the sensor is known by, and how far it may be off that."""
SPARSELY = 7
"""Every how many-th pixel is asked for the height of the sensor."""
UPRIGHT = 3
"""Rows of a thing of few points that is kept."""


@dataclass(frozen=True, eq=False)
class RangeImage:
    """A sweep as an image.

    Attributes:
        points: (N, 3) seen from the LiDAR, axes of the body: z is up.
        owner: (R, C) the nearest point of each pixel, -1 where there is none. Row 0 is the lowest.
        pixel: (N,) of each point, row after row.
    """

    points: Array
    owner: Index
    pixel: Index

    def spread(self, of_pixels: Bools) -> Bools:
        """Return (N,) what holds of each point, of what holds of the pixels (R, C) they are in.

        Points far behind the one that owns their pixel get nothing.
        """
        out = np.zeros(len(self.points), np.bool_)
        _spread(self.points, self.owner.reshape(-1), self.pixel, of_pixels.reshape(-1), out)
        return out


def range_image(lines: ScanLines, R_body_lidar: Array) -> RangeImage:
    """Sort points of lines into an image.

    Args:
        lines: of a sweep.
        R_body_lidar: (3, 3) how the LiDAR is turned.
    """
    p = lines.points
    azimuth = np.arctan2(p[:, 1], p[:, 0])
    if lines.turns:
        step, rows = lines.step, len(lines)
        row = np.repeat(np.arange(rows), np.diff(lines.start))
    else:
        elevation = np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1]))
        low, high = (float(elevation.min()), float(elevation.max())) if len(p) else (0.0, 0.0)
        width = float(np.ptp(azimuth)) if len(p) else 0.0
        step = LOOSE * np.sqrt(max((high - low) * width, 1e-6) / max(len(p), 1))
        rows = int(min((high - low) / step + 1, MOST_ROWS))
        row = np.minimum(((elevation - low) / step).astype(np.int64), rows - 1)
    columns = int(np.clip(round(2 * np.pi / max(step, 1e-6)), FEWEST_COLUMNS, MOST_COLUMNS))
    column = ((azimuth / (2 * np.pi) + 0.5) * columns).astype(np.int64) % columns
    pixel, owner = row * columns + column, np.full(rows * columns, -1, np.int64)
    _own(p, pixel, owner)
    level = np.ascontiguousarray(p @ R_body_lidar.T)
    return RangeImage(level, owner.reshape(rows, columns), pixel)


def find_ground(image: RangeImage, slope: float) -> Bools:
    """Return (R, C) which pixels are ground, no steeper than a slope in radians."""
    flat = np.zeros(image.owner.shape, np.bool_)
    tangent = float(np.tan(slope))
    _flat(image.points, image.owner, tangent, flat)
    some = image.points[image.owner[flat][::SPARSELY]]
    near = some[np.hypot(some[:, 0], some[:, 1]) < NEAR_M]
    ground = np.zeros(image.owner.shape, np.bool_)
    if len(near):
        _chain(image.points, image.owner, tangent, float(np.median(near[:, 2])), flat, ground)
    return ground


def find_clusters(image: RangeImage, ground: Bools, same: float, smallest: int, few: int) -> Index:
    """Return (R, C) which thing each pixel is of, -1 for none.

    Args:
        image: of a sweep.
        ground: (R, C) what is none.
        same: angle from which on neighbours are of one thing, radians.
        smallest: pixels of a thing.
        few: pixels of one that stands across three rows.
    """
    parent = np.where((image.owner >= 0) & ~ground, np.arange(image.owner.size).reshape(
        image.owner.shape), -1)  # fmt: skip
    _join(image.points, image.owner, float(np.tan(same)), parent)
    return _kept(parent, smallest, few)


@kernel
def _own(points: Array, pixel: Index, owner: Index) -> None:
    """The nearest point of each pixel."""
    for n in range(points.shape[0]):
        o = owner[pixel[n]]
        if o >= 0:
            a = points[n, 0] ** 2 + points[n, 1] ** 2 + points[n, 2] ** 2
            b = points[o, 0] ** 2 + points[o, 1] ** 2 + points[o, 2] ** 2
            if b <= a:
                continue
        owner[pixel[n]] = n


@kernel
def _spread(points: Array, owner: Index, pixel: Index, of_pixels: Bools, out: Bools) -> None:
    """What holds of a pixel holds of its points that are not far behind the nearest."""
    for n in range(points.shape[0]):
        if of_pixels[pixel[n]]:
            o, square = owner[pixel[n]], 0.0
            for c in range(3):
                square += (points[n, c] - points[o, c]) ** 2
            out[n] = square < APART * APART


@kernel
def _above(points: Array, owner: Index, row: int, column: int, way: int) -> int:
    """The next point up (way 1) or down (-1) a column, far enough to tell a slope; -1: none."""
    a, found = owner[row, column], -1
    for step in range(1, SKIPPED + 1):
        r = row + way * step
        if r < 0 or r >= owner.shape[0]:
            break
        b = owner[r, column]
        if b < 0:
            continue
        found = b
        x, y, z = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], 0.0
        z = points[b, 2] - points[a, 2]
        if x * x + y * y + z * z > APART * APART:
            break
    return found


@kernel
def _is_flat(points: Array, a: int, b: int, tangent: float) -> bool:
    """Whether the way from one point to the other is not steep."""
    x, y, z = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
    return bool(z * z < tangent * tangent * (x * x + y * y))


@kernel
def _flat(points: Array, owner: Index, tangent: float, flat: Bools) -> None:
    """Which pixels below the sensor have no steep way down, nor up."""
    for row in range(owner.shape[0]):
        for column in range(owner.shape[1]):
            a = owner[row, column]
            if a < 0 or points[a, 2] >= 0.0:
                continue
            up = _above(points, owner, row, column, 1)
            if up >= 0 and not _is_flat(points, a, up, tangent):
                continue
            down = _above(points, owner, row, column, -1)
            if down < 0:
                flat[row, column] = up >= 0
            else:
                flat[row, column] = _is_flat(points, a, down, tangent)


@kernel
def _chain(
    points: Array, owner: Index, tangent: float, height: float, flat: Bools, ground: Bools
) -> None:
    """Ground: flat, and no steep way from the ground before; at first that under the sensor."""
    before = np.full(owner.shape[1], -1, np.int64)
    for row in range(owner.shape[0]):
        for column in range(owner.shape[1]):
            if not flat[row, column]:
                continue
            n, b = owner[row, column], before[column]
            x, y, z = points[n, 0], points[n, 1], points[n, 2]
            if b < 0:
                limit, z = min(tangent * np.sqrt(x * x + y * y) + STEP, LEVEL_M), z - height
            else:
                u, v = x - points[b, 0], y - points[b, 1]
                limit, z = tangent * np.sqrt(u * u + v * v) + STEP, z - points[b, 2]
            if abs(z) <= limit:
                ground[row, column] = True
                before[column] = n


@kernel
def _root(parent: Index, at: int) -> int:
    """The pixel that stands for a thing; the way to it is made shorter."""
    while parent[at] != at:
        parent[at] = parent[parent[at]]
        at = parent[at]
    return at


@kernel
def _join(points: Array, owner: Index, tangent: float, parents: Index) -> None:
    """Join pixels with the next to the right, and above; the smaller number stands for both."""
    rows, columns = owner.shape
    parent = parents.reshape(-1)
    for row in range(rows):
        for column in range(columns):
            at = row * columns + column
            if parent[at] < 0:
                continue
            for way in range(2):
                other = -1
                for step in range(1, SKIPPED + 1):
                    r, c = row + way * step, (column + (1 - way) * step) % columns
                    if r >= rows:
                        break
                    if owner[r, c] >= 0:
                        other = r * columns + c
                        break
                if other < 0 or parent[other] < 0:
                    continue
                if _is_same(points, owner[row, column], owner.reshape(-1)[other], tangent):
                    a, b = _root(parent, at), _root(parent, other)
                    parent[max(a, b)] = min(a, b)


@kernel
def _is_same(points: Array, a: int, b: int, tangent: float) -> bool:
    """Whether d₂ sin α > tan β (d₁ - d₂ cos α)."""
    x, y, z = points[a, 0], points[a, 1], points[a, 2]
    u, v, w = points[b, 0], points[b, 1], points[b, 2]
    i, j, k = y * w - z * v, z * u - x * w, x * v - y * u
    cross, dot = np.sqrt(i * i + j * j + k * k), x * u + y * v + z * w
    far2 = max(x * x + y * y + z * z, u * u + v * v + w * w)
    return bool(cross > tangent * (far2 - dot))  # both sides times d₁


@kernel
def _kept(parents: Index, smallest: int, few: int) -> Index:
    """The pixel that stands for each thing that is kept, -1 for what is of none."""
    rows, columns = parents.shape
    parent = parents.reshape(-1)
    count, low = np.zeros(parent.shape[0], np.int64), np.empty(parent.shape[0], np.int64)
    high = np.zeros(parent.shape[0], np.int64)
    for at in range(parent.shape[0]):
        if parent[at] < 0:
            continue
        root = _root(parent, at)
        if count[root] == 0:
            low[root] = at // columns
        count[root] += 1
        high[root] = at // columns
    out = np.full((rows, columns), -1)
    flat = out.reshape(-1)
    for at in range(parent.shape[0]):
        if parent[at] < 0:
            continue
        root = _root(parent, at)
        tall = high[root] - low[root] + 1 >= UPRIGHT
        if count[root] >= smallest or (tall and count[root] >= few):
            flat[at] = root
    return out


def warm_up() -> None:
    """Compile the kernels of this file."""
    points = np.array([[5.0, 0.0, -1.0], [6.0, 0.0, -1.0], [7.0, 0.0, -1.0]])
    lines = ScanLines(points, np.arange(3), np.arange(4), True, 0.002)
    image = range_image(lines, np.eye(3))
    image.spread(find_ground(image, 0.2))
    find_clusters(image, np.zeros(image.owner.shape, np.bool_), 0.2, 2, 1)
