"""Scans of the plane as points: what beams hit, the surfaces between, and how far the way is free.

A scanner turns in a plane and says how far each beam went. In the body,

    p_i = T_body_lidar (r_i cos φ_i, r_i sin φ_i, 0),

of which the plane of the floor keeps x and y, so that a scanner may be mounted turned or head down.
Far away beams are wide apart, and a wall would be a row of dots that the next scan's dots do not
meet: whoever matches them is drawn to where dot lies on dot, and does not move. So neighbours are
joined where they can be of one surface: near each other, and not seen at too flat an angle,

    |p_{i+1} - p_i| < gap,    |p_{i+1} - p_i| < ratio · r Δφ,

by points as close as the map's cells. Along such a surface its normal is known, from a point to
either side of it a little away; not at corners. Where nothing came back, the way may be free.

Cost: O(beams + points between).

Reference: S. Kohlbrecher et al., "A flexible and scalable SLAM system with full 3D motion
estimation", SSRR 2011 (scans in a plane of the body).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.lidar.scanconfig import ScanConfig
from odomap.sensors.rig import LidarMount

__all__ = ["Beams", "ScanPoints", "ScanRays"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Count = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ScanRays:
    """What a scan tells of what is free and what is not, in the plane of the body.

    Attributes:
        origin: (2,) the scanner.
        hits: (N, 2) where beams came back from, metres.
        between: (M, 2) points on the surfaces between them.
        free: (F, 2) how far the way is free where nothing came back.
    """

    origin: Array
    hits: Array
    between: Array
    free: Array


@dataclass(frozen=True, eq=False)
class ScanPoints(ScanRays):
    """A scan in the plane of the body, to be laid onto others.

    Attributes:
        normals: (N, 2) of unit length across the surfaces hit, zero where there is none.
        weights: (N,) how much each says: less than 1 for those of no surface far away, which may be
            anywhere between beams.
        num_beams: beams of the scanner.
        num_invalid: those that said nothing: NaN.
    """

    normals: Array
    weights: Array
    num_beams: int
    num_invalid: int

    def __len__(self) -> int:
        return len(self.hits)


@dataclass(frozen=True, eq=False)
class _Laid:
    """Ends of beams (beams, 2), which of them came back, which are of one surface with the next,
    points between these (M, 2), and where the way is free to (F, 2)."""

    p: Array
    is_hit: Mask
    is_one: Mask
    between: Array
    free: Array


class Beams:
    """The directions of a scanner's beams, on the body.

    Args:
        mount: of a 2D scanner.
        config: what is used.

    Attributes:
        mount: of the scanner.
        config: what is used.
    """

    def __init__(self, mount: LidarMount, config: ScanConfig | None = None) -> None:
        self.mount, self.config = mount, ScanConfig() if config is None else config
        first, last, count = mount.angles
        angles = np.linspace(first, last, count)
        T = mount.T_body_lidar.matrix
        directions = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(count)])
        self._directions = np.ascontiguousarray((directions @ T[:3, :3].T)[:, :2])
        self._origin = np.array(T[:2, 3])
        self._step = abs(last - first) / max(count - 1, 1)
        self._near, far = mount.range_m
        self._far = min(far, self.config.farthest)

    def __len__(self) -> int:
        return len(self._directions)

    def rays(self, ranges: Array) -> ScanRays:
        """Return what a scan tells of what is free and what is not.

        Args:
            ranges: (beams,) metres, NaN where invalid, inf where nothing came back.

        Raises:
            ValueError: it has another number of beams.
        """
        ranges, laid = self._laid(ranges)
        return ScanRays(self._origin, laid.p.compress(laid.is_hit, 0), laid.between, laid.free)

    def points(self, ranges: Array) -> ScanPoints:
        """Return a scan as points; argument and errors as those of `rays`."""
        ranges, laid = self._laid(ranges)
        config, normals = self.config, np.zeros((len(self), 2))
        along = config.baseline, np.cos(config.bend)
        find_normals(laid.p, laid.is_hit, laid.is_one, *along, normals)
        normals = normals.compress(laid.is_hit, 0)
        apart = self._step * ranges.compress(laid.is_hit)
        of_none = ~normals.any(axis=1)
        return ScanPoints(
            origin=self._origin,
            hits=laid.p.compress(laid.is_hit, 0),
            between=laid.between,
            free=laid.free,
            normals=normals,
            weights=np.where(of_none, np.minimum(1.0, (config.grain / apart) ** 2), 1.0),
            num_beams=len(ranges),
            num_invalid=int(np.count_nonzero(np.isnan(ranges))),
        )

    def _laid(self, ranges: Array) -> tuple[Array, "_Laid"]:
        """Return ranges that kernels may read, and beams laid onto the body."""
        if ranges.shape != (len(self),):
            raise ValueError(f"a scan of {len(ranges)} beams, expected {len(self)}")
        ranges, config = np.array(ranges, np.float64), self.config  # kernels want it writable
        p = np.empty((len(self), 2))
        is_hit, is_one = np.empty(len(self), bool), np.empty(max(len(self) - 1, 0), bool)
        parts = np.empty(len(is_one), np.int64)
        beams = self._directions, self._origin, self._step
        surfaces = config.gap, config.ratio, config.spacing
        count = lay_beams(
            ranges, *beams, self._near, self._far, *surfaces, p, is_hit, is_one, parts
        )
        between = np.empty((count, 2))
        fill_between(p, parts, between)
        return ranges, _Laid(p, is_hit, is_one, between, self._free(ranges))

    def nothing(self) -> ScanPoints:
        """Return a scan that says nothing."""
        return self.points(np.full(len(self), np.nan))

    def _free(self, ranges: Array) -> Array:
        """Return how far the way is free (F, 2) where nothing came back."""
        reach = min(self.config.free, self._far)
        if not reach:
            return np.zeros((0, 2))
        nothing = np.isposinf(ranges) | (ranges > self._far)
        return np.asarray(self._origin + reach * self._directions[nothing])


@kernel
def lay_beams(
    ranges: Array,
    directions: Array,
    origin: Array,
    angle: float,
    near: float,
    far: float,
    gap: float,
    ratio: float,
    spacing: float,
    p: Array,
    is_hit: Mask,
    is_one: Mask,
    parts: Count,
) -> int:
    """p ← o + r d where a beam came back; is_one: whether it and the next may be of one surface,
    and parts: into how many that is cut. Returns how many points lie between all."""
    count = 0
    for i in range(len(ranges)):
        is_hit[i] = near <= ranges[i] <= far
        r = ranges[i] if is_hit[i] else 0.0
        p[i, 0], p[i, 1] = origin[0] + directions[i, 0] * r, origin[1] + directions[i, 1] * r
    for i in range(len(ranges) - 1):
        x, y = p[i + 1, 0] - p[i, 0], p[i + 1, 1] - p[i, 1]
        step = np.sqrt(x * x + y * y)
        nearer = min(ranges[i], ranges[i + 1]) if is_hit[i] and is_hit[i + 1] else 0.0
        is_one[i] = step < gap and step < ratio * nearer * angle
        parts[i] = int(np.ceil(step / spacing)) if is_one[i] else 1
        count += max(parts[i] - 1, 0)
    return count


@kernel
def fill_between(p: Array, parts: Count, between: Array) -> None:
    """between ← the points that cut the ways to the next."""
    m = 0
    for i in range(len(parts)):
        for n in range(1, parts[i]):
            share = n / parts[i]
            for k in range(2):
                between[m, k] = (1.0 - share) * p[i, k] + share * p[i + 1, k]
            m += 1


@kernel
def way_along(
    p: Array, is_hit: Mask, is_one: Mask, i: int, by: int, baseline: float, straight: float
) -> tuple[float, float, int]:
    """Return the way from p_i along its surface to one side, and what that is: 2 where points in
    between lie on it, 1 where it leads to the next beam only, 0 where the surface ends or bends.

    by is 1 or -1; the way is at least a baseline long, but for the next beam across a gap: beams
    too wide apart to be of one surface still are of one line where they are straight.
    """
    end, x, y = i, 0.0, 0.0
    while 0 <= end + by < len(p) and is_one[min(end, end + by)] and x * x + y * y < baseline**2:
        end += by
        x, y = p[end, 0] - p[i, 0], p[end, 1] - p[i, 1]
    if end == i:
        if not (0 <= i + by < len(p) and is_hit[i + by]):
            return 0.0, 0.0, 0
        return p[i + by, 0] - p[i, 0], p[i + by, 1] - p[i, 1], 1
    length = np.hypot(x, y)
    for k in range(i + by, end, by):
        a, b = p[k, 0] - p[i, 0], p[k, 1] - p[i, 1]
        if np.hypot(a, b) > 0.5 * length and a * x + b * y < straight * np.hypot(a, b) * length:
            return x, y, 0
    if length < 0.3 * baseline:
        return x, y, 0
    return x, y, 1 if abs(end - i) == 1 else 2


@kernel
def find_normals(
    p: Array, is_hit: Mask, is_one: Mask, baseline: float, straight: float, normals: Array
) -> None:
    """n ⊥ the surface at p_i, where the ways along it to both sides are straight, cos of the angle
    between them; where it ends on one side, or bends before the baseline, ⊥ the other. At a corner
    between two straight ways there is none, nor where too little is seen."""
    for i in range(len(p)):
        if not is_hit[i]:
            continue
        l_x, l_y, left = way_along(p, is_hit, is_one, i, -1, baseline, straight)
        r_x, r_y, right = way_along(p, is_hit, is_one, i, 1, baseline, straight)
        if left > 0 and right > 0:
            along = -(l_x * r_x + l_y * r_y)
            if along >= straight * np.hypot(l_x, l_y) * np.hypot(r_x, r_y):
                set_normal(normals, i, r_x - l_x, r_y - l_y)
            elif left < 2 and right == 2:
                set_normal_by(normals, p, is_hit, is_one, i, 1, baseline, straight)
            elif right < 2 and left == 2:
                set_normal_by(normals, p, is_hit, is_one, i, -1, baseline, straight)
        elif right == 2:
            set_normal_by(normals, p, is_hit, is_one, i, 1, baseline, straight)
        elif left == 2:
            set_normal_by(normals, p, is_hit, is_one, i, -1, baseline, straight)


@kernel
def set_normal_by(
    normals: Array,
    p: Array,
    is_hit: Mask,
    is_one: Mask,
    i: int,
    by: int,
    baseline: float,
    straight: float,
) -> None:
    """n_i ← that of the surface from the next point on, without p_i: were it across the way from
    p_i itself, each point's noise would turn its normal, and all together push the body along."""
    x, y, seen = way_along(p, is_hit, is_one, i + by, by, baseline, straight)
    if seen > 0 and x * x + y * y >= baseline**2:
        set_normal(normals, i, x, y)


@kernel
def set_normal(normals: Array, i: int, x: float, y: float) -> None:
    """n_i ← across (x, y)."""
    length = np.hypot(x, y)
    normals[i, 0], normals[i, 1] = -y / length, x / length


def warm_up() -> None:
    """Compile the kernels of this module."""
    Beams(LidarMount("laser", angles=(-0.1, 0.1, 3))).points(np.ones(3))
