"""Bundle adjustment problems of any size with known truth.

A camera drives twice around a ring and looks outwards at points on all sides of its way: each point
is drawn in the view of one camera at a random depth, and seen by the next few that have it in
sight, those of the other lap among them, so that the problem closes its loops. Pixels get Gaussian
noise, views, points and lenses are moved off the truth. With noise of standard deviation σ and
weights 1/σ the least cost is expected to be

    ½ Σ ‖r‖²  =  ½ (2 N - U),      U unknowns less 7 of the gauge,

which says how near a solver came. The same seed gives the same arrays. O(points); a thousand views
and 200,000 points take some seconds.

Reference: B. Triggs et al., "Bundle adjustment - a modern synthesis", 1999, section 5 (error
modelling).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.backend.adjustment.problem import BAL, Adjustment
from odomap.errors import InputError
from odomap.geometry.lie import se3_exp, se3_inverse

__all__ = ["BundleWorld", "bundle_world"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

SIZE_PX = np.array([640.0, 480.0])
FOCAL_PX = 500.0
SPACING = 0.5
"""Metres between two views of a lap."""
DEPTHS = 4.0, 25.0
NEIGHBOURS = 12
"""Views before and after, of each lap, that may see a point."""
CHUNK = 20_000
"""Points handled at a time, which bounds the memory."""


@dataclass(frozen=True)
class BundleWorld:
    """A problem and the truth about it.

    Attributes:
        problem: to be adjusted, its unknowns off the truth.
        Ts_camera_world: (K, 4, 4) true.
        points_world: (M, 3) true.
        intrinsics: (L, P) true.
    """

    problem: Adjustment
    Ts_camera_world: Array
    points_world: Array
    intrinsics: Array


def bundle_world(
    num_views: int = 1000,
    num_points: int = 200_000,
    *,
    model: str = "pinhole",
    tracks: tuple[int, int] = (5, 8),
    sigma_px: float = 0.5,
    off: tuple[float, float, float] = (0.05, 0.005, 0.2),
    seed: int = 0,
) -> BundleWorld:
    """Make a problem.

    Args:
        num_views: on two laps, 60 or more.
        num_points: seen by several of them.
        model: "pinhole", one lens held, or "bal", a free lens per view.
        tracks: fewest and most views that see a point.
        sigma_px: standard deviation of a pixel coordinate.
        off: standard deviations by which places (m) and directions (rad) of views and places of
            points (m) begin off the truth.
        seed: of all that is random.

    Returns:
        The problem and the truth.

    Raises:
        InputError: fewer than 60 views, or a model that is not one of the two.

    Example:
        >>> world = bundle_world(60, 100)
        >>> world.problem.num_views, world.problem.num_points
        (60, 100)
    """
    if num_views < 60 or model not in ("pinhole", BAL):
        raise InputError(f"bundle world: {num_views} views, model '{model}': 60; pinhole or bal")
    rng = np.random.default_rng(seed)
    Ts = _laps(num_views, model == BAL)
    intrinsics = _lenses(num_views, model, rng)
    parts, found = [], 0
    while found < num_points:
        points, seen, pixels = _some_points(Ts, intrinsics, model, tracks, rng)
        kept = np.cumsum(np.ones(len(points), np.int64)) + found <= num_points
        parts.append((points[kept], seen[kept], pixels[kept]))
        found += int(kept.sum())
    points, seen, pixels = (np.concatenate(columns) for columns in zip(*parts))
    point, column = np.nonzero(seen >= 0)
    uv = pixels[point, column] + rng.normal(0.0, sigma_px, (len(point), 2))
    centre, turn, spread = off
    xi = rng.normal(0.0, 1.0, (num_views, 6)) * np.repeat([centre, turn], 3)
    guess = intrinsics * rng.normal(1.0, 0.01 * (model == BAL), intrinsics.shape)
    problem = Adjustment(
        se3_exp(-xi) @ Ts,
        points + rng.normal(0.0, spread, points.shape),
        seen[point, column],
        point,
        uv,
        guess,
        model,
        weights=np.array(1.0 / sigma_px),
        is_free_intrinsic=np.array(model == BAL),
    )
    return BundleWorld(problem, Ts, points, intrinsics)


def _laps(count: int, looks_back: bool) -> Array:
    """Return T_camera_world along two laps of a ring, looking outwards and a little forward."""
    lap = (count + 1) // 2
    radius = SPACING * lap / (2.0 * np.pi)
    angle = 2.0 * np.pi * np.arange(count) / lap
    out = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    along = np.stack([-np.sin(angle), np.cos(angle), np.zeros(count)], axis=1)
    z = out + 0.3 * along
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    down = np.tile([0.0, 0.0, -1.0], (count, 1))
    R_world_camera = np.stack([np.cross(down, z), down, z], axis=2)
    if looks_back:
        # A camera of BAL looks along -z, with y up.
        R_world_camera = R_world_camera * np.array([1.0, -1.0, -1.0])
    Ts = np.tile(np.eye(4), (count, 1, 1))
    Ts[:, :3, :3] = R_world_camera
    Ts[:, :3, 3] = (radius + 0.3 * (np.arange(count) >= lap))[:, None] * out
    Ts[:, 2, 3] = 0.2 * np.sin(3.0 * angle)
    return se3_inverse(Ts)


def _lenses(count: int, model: str, rng: np.random.Generator) -> Array:
    if model != BAL:
        return np.array([[FOCAL_PX, FOCAL_PX, *(0.5 * (SIZE_PX - 1.0))]])
    f = rng.normal(FOCAL_PX, 5.0, count)
    return np.stack([f, rng.normal(-0.05, 0.01, count), rng.normal(0.01, 0.002, count)], axis=1)


def _some_points(
    Ts: Array, intrinsics: Array, model: str, tracks: tuple[int, int], rng: np.random.Generator
) -> tuple[Array, Index, Array]:
    """Draw points in the views of cameras; return those seen often enough, by whom and where.

    Returns:
        (n, 3) points, (n, most) views or -1, (n, most, 2) pixels.
    """
    count, lap = len(Ts), (len(Ts) + 1) // 2
    fewest, most = tracks
    base = rng.integers(0, count, CHUNK)
    depth = rng.uniform(*DEPTHS, CHUNK)
    ray = (rng.uniform(0.0, 1.0, (CHUNK, 2)) - 0.5) * SIZE_PX / FOCAL_PX
    rays = np.concatenate([ray, np.ones((CHUNK, 1))], axis=1) * depth[:, None]
    if model == BAL:
        rays *= np.array([1.0, -1.0, -1.0])
    inverse = se3_inverse(Ts[base])
    points = (inverse[:, :3, :3] @ rays[:, :, None])[:, :, 0] + inverse[:, :3, 3]
    steps = np.arange(-NEIGHBOURS, NEIGHBOURS + 1)
    views = (base[:, None] + np.concatenate([steps, steps + lap])) % count
    pixels, is_seen = _project(Ts, intrinsics, model, points, views)
    # Of those that see a point a random few, so that tracks have gaps and cross the laps.
    rank = np.argsort(np.where(is_seen, rng.uniform(0.0, 1.0, is_seen.shape), 2.0), axis=1)
    length = np.minimum(is_seen.sum(axis=1), rng.integers(fewest, most + 1, CHUNK))
    chosen = rank[:, :most]
    rows = np.arange(CHUNK)[:, None]
    taken = np.where(np.arange(most) < length[:, None], views[rows, chosen], -1)
    kept = length >= fewest
    return points[kept], taken[kept], pixels[rows, chosen][kept]


def _project(
    Ts: Array, intrinsics: Array, model: str, points: Array, views: Index
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the pixels (n, c, 2) of points (n, 3) in views (n, c), and whether they are there."""
    X = np.einsum("ncij,nj->nci", Ts[views][:, :, :3, :3], points) + Ts[views][:, :, :3, 3]
    depth = -X[:, :, 2] if model == BAL else X[:, :, 2]
    q = X[:, :, :2] / np.where(depth > 0.0, depth, np.nan)[:, :, None]
    if model == BAL:
        f, k1, k2 = np.moveaxis(intrinsics[views], 2, 0)
        s = np.sum(q * q, axis=2)
        pixels = (f * (1.0 + s * (k1 + s * k2)))[:, :, None] * q
        inside = np.abs(pixels) <= 0.5 * SIZE_PX
    else:
        pixels = q * intrinsics[0, :2] + intrinsics[0, 2:]
        inside = (pixels >= 0.0) & (pixels < SIZE_PX)
    return pixels, inside.all(axis=2) & (depth > 1.0) & (depth < 2.0 * DEPTHS[1])
