"""Slices: what a cloud in space says of the floor under it, as a scan of the plane would.

Heights are counted from the floor; between two of them things are in a robot's way. A point in this
band is a hit. A beam from the eye e to a point p is at height h(t) = e_z + t (p_z - e_z), and what
it passes within the band is free,

    t with  low ≤ h(t) ≤ high,        and up to t = 1 where it ends on the floor.

The plane around the eye is parted into sectors. In each the way is free from where its beams come
into the band to where they leave it or end, and not beyond its nearest hit: what stands behind a
low thing may hang over it. So a table is occupied where its top is in the band, though its floor is
seen; something that lies below all beams is passed over; and of holes nothing is said.

Where the floor is not known, a plane of any height says what is level: around points planes are
fitted, those 50° off a guess of upwards at most tried, and the one taken on which most points lie,
times cos² of that angle. The floor is the lowest height at which many lie and hardly any below.

Cost: O(points); finding the floor O(samples · trials), some 50 ms.

Reference: M. Fischler, R. Bolles, "Random sample consensus", Comm. ACM 24(6), 1981; A. Hornung et
al., "OctoMap", Autonomous Robots 34, 2013 (maps projected to the floor).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.errors import ConfigError
from odomap.kernels import kernel
from odomap.limits import Count, Positive, check_limits

__all__ = ["Slice", "SliceConfig", "find_floor", "level", "slice_sweep"]

Array = NDArray[np.float64]

TRIALS, SAMPLES, AROUND = 500, 5000, 16
"""Planes tried at most, points looked at, and points to which one is fitted."""
ON_FLOOR_M = 0.15
"""How high, or low, a point of the floor may be: floors are not planes."""
NEAR_M = 0.04
"""How far a point of a plane may be off it."""
THIN, LONG = 0.1, 0.02
"""Variance of points across their plane at most, and of the lesser one along it at least, over the
next larger one: what is no plane, and what is a line."""
GUESS = np.cos(np.deg2rad(50.0))
"""How far off upwards may be guessed: heads and hands tilt cameras."""
BELOW_M, BELOW_SHARE = 0.15, 0.03
"""Hardly anything is lower than this below the floor: walls of glass and polished floors mirror."""
LEVEL_SHARE, FLOOR_SHARE = 0.03, 0.01
"""Of all points that must be on a plane that says what is level, and on the floor."""


@dataclass(frozen=True)
class SliceConfig:
    """What of a cloud is in the way."""

    low: float = 0.1
    """Height above the floor from which on things are in the way, metres."""
    high: float = 1.8
    """Height up to which they are."""
    nearest: Positive = 0.1
    """Points nearer to the eye, seen from above, are of the robot itself, metres."""
    farthest: Positive = 20.0
    """Points farther away are not used, metres."""
    sectors: Count = 1440
    """Into how many the plane around the eye is parted."""

    def __post_init__(self) -> None:
        check_limits(self)
        if not (np.isfinite([self.low, self.high]).all() and self.low < self.high):
            raise ConfigError(
                f"height: {self.low:g} to {self.high:g} m must be two heights, the lower one first"
            )


@dataclass(frozen=True, eq=False)
class Slice:
    """What a sweep says of the plane.

    Attributes:
        hits: (N, 2) points in the way, metres.
        free_from: (F, 2) from where a way is free.
        free: (F, 2) up to where.
    """

    hits: Array
    free_from: Array
    free: Array


def slice_sweep(points: Array, eye: Array, config: SliceConfig) -> Slice:
    """Return what a sweep says of the plane.

    Args:
        points: (N, 3) what beams met, x and y in the plane and z above the floor, metres.
        eye: (3,) from where.
        config: what is in the way.
    """
    is_hit = np.zeros(len(points), np.bool_)
    reach = np.empty((config.sectors, 3))
    band = config.low, config.high, ON_FLOOR_M, config.nearest, config.farthest
    x, y, z = (float(c) for c in eye)
    slice_kernel(np.ascontiguousarray(points, np.float64), x, y, z, *band, is_hit, reach)
    first, last, nearest = reach.T
    until = np.minimum(last, nearest)
    is_free = until > first
    angles = (np.flatnonzero(is_free) + 0.5) * (2.0 * np.pi / config.sectors) - np.pi
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    ways = (eye[:2] + directions * r[is_free, None] for r in (first, until))
    return Slice(points[is_hit, :2], *(np.ascontiguousarray(way) for way in ways))


def level(up: Array, height: float = 0.0) -> Array:
    """Return T_level_world (4, 4), turned as little as needed so that `up` becomes z.

    Args:
        up: (3,) of unit length, in the world.
        height: of the floor along it; it becomes z = 0.
    """
    v, c = np.cross(up, [0.0, 0.0, 1.0]), float(up[2])
    T = np.eye(4)
    if c < -1.0 + 1e-9:
        T[:3, :3] = np.diag([1.0, -1.0, -1.0])
    else:
        K = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
        T[:3, :3] += K + K @ K / (1.0 + c)
    T[2, 3] = -height
    return T


def find_floor(points: Array, eyes: Array, up: Array, seed: int = 0) -> tuple[Array, float | None]:
    """Find the plane that a sensor moves over.

    Args:
        points: (N, 3) what was seen, metres.
        eyes: (K, 3) from where.
        up: (3,) of unit length, 50° off at most.
        seed: of the samples.

    Returns:
        (3,) upwards, as guessed where nothing level is seen, and the floor's height along it; None
        where it is not seen.
    """
    rng = np.random.default_rng(seed)
    if len(points) > SAMPLES:
        points = points[np.sort(rng.choice(len(points), SAMPLES, replace=False))]
    n = _find_level(points, up, rng) if len(points) > AROUND else None
    if n is None:
        return up, None
    heights, count = points @ n, len(points)
    edges = np.arange(heights.min() - 2 * NEAR_M, heights.max() + 3 * NEAR_M, NEAR_M)
    within = np.convolve(np.histogram(heights, edges)[0], [1, 1, 1], "same")  # a bin to either side
    middles = 0.5 * (edges[:-1] + edges[1:])
    far = round(BELOW_M / NEAR_M)
    for k in range(1, len(within) - 1):
        above = np.median(within[k + far : k + 4 * far]) if k + far < len(within) else 0.0
        is_peak = within[k] == within[max(k - far, 0) : k + far].max() and within[k] > 2.0 * above
        if not is_peak or within[k] < FLOOR_SHARE * count:
            continue
        h, on = middles[k], np.abs(heights - middles[k]) < 1.5 * NEAR_M
        if np.mean(heights < h - BELOW_M) > BELOW_SHARE or np.mean(eyes @ n > h) < 0.9:
            break
        # A floor of which much is seen says itself what is level.
        return _plane(points, on, n) if on.mean() > LEVEL_SHARE else (n, float(heights[on].mean()))
    return n, None


def _find_level(points: Array, up: Array, rng: np.random.Generator) -> Array | None:
    """Return the normal of the plane that is level, whatever its height."""
    from scipy.spatial import cKDTree

    near = np.asarray(cKDTree(points).query(points, AROUND)[1])
    offsets = points[near] - points[near].mean(axis=1, keepdims=True)
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
    normals = axes[:, :, 0] * np.where(axes[:, :, 0] @ up < 0.0, -1.0, 1.0)[:, None]
    lesser, middle, larger = variances.T
    good = (lesser < THIN * middle) & (middle > LONG * larger) & (normals @ up > GUESS)
    tried = np.flatnonzero(good)
    if len(tried) > TRIALS:
        tried = np.sort(rng.choice(tried, TRIALS, replace=False))
    best, found = 0.0, None
    for i in tried:
        on = np.abs((points - points[near[i]].mean(axis=0)) @ normals[i]) < NEAR_M
        score = on.sum() * float(normals[i] @ up) ** 2
        if score > best and on.mean() > LEVEL_SHARE:
            best, found = score, on
    return None if found is None else _plane(points, found, up)[0]


def _plane(points: Array, on: NDArray[np.bool_], up: Array) -> tuple[Array, float]:
    """Return the plane through the points on it, by least squares, twice."""
    for _ in range(2):
        middle = points[on].mean(axis=0)
        n = np.linalg.svd(points[on] - middle, full_matrices=False)[2][2]
        n *= 1.0 if n @ up > 0.0 else -1.0
        h = float(n @ middle)
        on = np.abs(points @ n - h) < NEAR_M
    return n, h


@kernel
def slice_kernel(
    points: Array, eye_x: float, eye_y: float, eye_z: float, low: float, high: float,
    floor: float, nearest: float, farthest: float, is_hit: NDArray[np.bool_], reach: Array,
) -> None:  # fmt: skip
    """Say which points are hits; of each sector, where it is free from, to, and its nearest hit.

    t of low and high: (low - e_z) / (p_z - e_z), the lesser the beginning, within [0, 1].
    """
    sectors = reach.shape[0]
    for k in range(sectors):
        reach[k, 0], reach[k, 1], reach[k, 2] = np.inf, 0.0, np.inf
    for i in range(len(points)):
        dx, dy, z = points[i, 0] - eye_x, points[i, 1] - eye_y, points[i, 2]
        far = np.hypot(dx, dy)
        if not (nearest <= far <= farthest) or not np.isfinite(z):
            continue
        k = min(int((np.arctan2(dy, dx) + np.pi) / (2.0 * np.pi) * sectors), sectors - 1)
        begin, end, dz = 0.0, 1.0, z - eye_z
        if dz != 0.0:
            t_low, t_high = (low - eye_z) / dz, (high - eye_z) / dz
            begin, end = max(min(t_low, t_high), 0.0), min(max(t_low, t_high), 1.0)
        elif z < low or z > high:
            end = 0.0
        if low <= z <= high:
            is_hit[i] = True
            reach[k, 2] = min(reach[k, 2], far)
        elif abs(z) < floor:
            end = 1.0
        if end > begin:
            reach[k, 0] = min(reach[k, 0], begin * far)
            reach[k, 1] = max(reach[k, 1], end * far)


def warm_up() -> None:
    """Compile the kernel."""
    slice_sweep(np.array([[1.0, 0.0, 0.5]]), np.array([0.0, 0.0, 1.0]), SliceConfig())
