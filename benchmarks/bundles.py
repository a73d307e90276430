"""Bundle adjustment problems as all solvers get them, the one judge, and a street of any size.

A problem holds cameras of the BAL data sets, each with its own f, k₁ and k₂ to adjust:

    P = R p + t,   q = -(P_x, P_y) / P_z,   pixel = f (1 + k₁|q|² + k₂|q|⁴) q.

It travels to the processes of the solvers as .npz; a peer's process needs no odomap to read it.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.backend.adjustment_problem import BAL, Adjustment
from odomap.files.bal import read_bal
from odomap.geometry.lie import se3_exp, so3_exp

Array = NDArray[np.float64]
Index = NDArray[np.int64]

HALF_IMAGE = np.array([640.0, 480.0])
FOCAL = 800.0
NEAR, FAR = 4.0, 25.0
"""Metres at which points are seen."""
LEAST_SEEN, MOST_SEEN = 5, 8
"""Observations of each point."""
LAPS = 2
"""Times the street is driven: views of other laps see the same points."""
REACH = 24
"""Views before and after the first one that may see its points."""


@dataclass(frozen=True)
class Bundle:
    """A problem and its start.

    Attributes:
        name: of the problem.
        poses: (K, 4, 4) T_camera_world.
        points: (M, 3) in the world.
        view, point: (N,) which view saw which point.
        pixels: (N, 2) where.
        intrinsics: (K, 3) f, k1, k2 of each view.
    """

    name: str
    poses: Array
    points: Array
    view: Index
    point: Index
    pixels: Array
    intrinsics: Array

    def save(self, path: Path) -> None:
        """Write it for the solvers' processes."""
        np.savez(
            path,
            poses=self.poses,
            points=self.points,
            view=self.view,
            point=self.point,
            pixels=self.pixels,
            intrinsics=self.intrinsics,
        )

    def adjustment(self) -> Adjustment:
        """Return it as odomap's type, all intrinsics free."""
        return Adjustment(
            self.poses,
            self.points,
            self.view,
            self.point,
            self.pixels,
            self.intrinsics,
            model=BAL,
            is_free_intrinsic=True,
        )


def load(path: str | Path) -> Bundle:
    """Read what `Bundle.save` wrote."""
    with np.load(path) as arrays:
        return Bundle(Path(path).stem, **arrays)


def read(path: Path) -> Bundle:
    """Read a BAL file."""
    problem = read_bal(path)
    intrinsics = problem.intrinsics[problem.lens]
    name = path.name.split(".")[0].removesuffix("-pre")
    return Bundle(
        name,
        problem.Ts_camera_world,
        problem.points_world,
        problem.view,
        problem.point,
        problem.pixels,
        intrinsics,
    )


def project(poses: Array, points: Array, intrinsics: Array) -> Array:
    """Return pixels (n, 2) of points (n, 3) in views (n, 4, 4) with intrinsics (n, 3)."""
    P = np.einsum("nij,nj->ni", poses[:, :3, :3], points) + poses[:, :3, 3]
    q = -P[:, :2] / P[:, 2:]
    r2 = (q * q).sum(axis=1)
    f, k1, k2 = intrinsics.T
    return (f * (1 + k1 * r2 + k2 * r2 * r2))[:, None] * q


def cost(bundle: Bundle, poses: Array, points: Array, intrinsics: Array) -> float:
    """Return ½ Σ |pixel found - pixel seen|²: every solver's result goes through this function."""
    seen = project(poses[bundle.view], points[bundle.point], intrinsics[bundle.view])
    return 0.5 * float(((seen - bundle.pixels) ** 2).sum())


def street(views: int = 1000, points: int = 200_000, seed: int = 0) -> Bundle:
    """Return a problem from a drive round a block, with 1 px of noise and a start that is off.

    Views look around; every point has 5 to 8 observations, most by views that follow each other,
    some by the other lap. The start is off by about 0.3° and 5 cm per view, 15 cm per point and
    1 % of the focal length.
    """
    rng = np.random.default_rng(seed)
    poses = _drive(views, rng)
    intrinsics = np.tile([FOCAL, -0.05, 0.01], (views, 1))
    intrinsics[:, 0] += rng.normal(size=views) * 5.0
    world, view, point = _seen(poses, intrinsics, points, rng)
    exact = project(poses[view], world[point], intrinsics[view])
    pixels = exact + rng.normal(size=exact.shape)
    off = rng.normal(size=(views, 6)) * np.repeat([0.05, 0.005], 3)
    start = intrinsics * [1.0, 0.0, 0.0]
    start[:, 0] *= 1.0 + 0.01 * rng.normal(size=views)
    return Bundle(
        f"street_{views}",
        poses @ se3_exp(off),
        world + 0.15 * rng.normal(size=world.shape),
        view,
        point,
        pixels,
        start,
    )


def _drive(views: int, rng: np.random.Generator) -> Array:
    """Return T_camera_world (K, 4, 4) of a drive round a block, half a metre per view."""
    turn = 2 * np.pi * LAPS * np.arange(views) / views
    radius = 0.5 * views / (2 * np.pi * LAPS)
    aside = 0.5 * rng.normal(size=views)
    centre = np.stack([np.cos(turn), np.sin(turn), np.zeros(views)], axis=1)
    place = (radius + aside)[:, None] * centre + 0.1 * rng.normal(size=(views, 3))
    heading = turn + np.pi / 2 + 0.6 * rng.normal(size=views)
    # The BAL camera looks along -z with y up: x right, y up, z back.
    ahead = np.stack([np.cos(heading), np.sin(heading), np.zeros(views)], axis=1)
    up = np.tile([0.0, 0.0, 1.0], (views, 1))
    rows = np.stack([np.cross(ahead, up), up, -ahead], axis=1)
    poses = np.tile(np.eye(4), (views, 1, 1))
    poses[:, :3, :3] = so3_exp(0.05 * rng.normal(size=(views, 3))) @ rows
    poses[:, :3, 3] = -np.einsum("kij,kj->ki", poses[:, :3, :3], place)
    return poses


def _seen(
    poses: Array, intrinsics: Array, count: int, rng: np.random.Generator
) -> tuple[Array, Index, Index]:
    """Return points (M, 3) that enough views see, and view (N,) and point (N,) of each sight."""
    kept: list[Array] = []
    views: list[Index] = []
    owners: list[Index] = []
    found = 0
    while found < count:
        world, near, sees = _candidates(poses, intrinsics, 20_000, rng)
        # Random views of those that see it, at most MOST_SEEN.
        rank = np.argsort(np.argsort(np.where(sees, rng.random(sees.shape), 2.0), axis=1), axis=1)
        rows = np.flatnonzero(sees.sum(axis=1) >= LEAST_SEEN)[: count - found]
        chosen = (sees & (rank < MOST_SEEN))[rows]
        owner, which = np.nonzero(chosen)
        kept.append(world[rows])
        views.append(near[rows][owner, which])
        owners.append(owner + found)
        found += len(rows)
    view, point = np.concatenate(views), np.concatenate(owners)
    return np.concatenate(kept), view.astype(np.int64), point.astype(np.int64)


def _candidates(
    poses: Array, intrinsics: Array, count: int, rng: np.random.Generator
) -> tuple[Array, Index, NDArray[np.bool_]]:
    """Return points (n, 3) before random views, views (n, w) near those, and which see them."""
    total = len(poses)
    anchor = rng.integers(total, size=count)
    depth = rng.uniform(NEAR, FAR, count)
    pixel = rng.uniform(-0.9, 0.9, (count, 2)) * HALF_IMAGE
    local = np.column_stack([pixel / FOCAL, -np.ones(count)]) * depth[:, None]
    T = poses[anchor]
    world = np.einsum("nji,nj->ni", T[:, :3, :3], local - T[:, :3, 3])
    reach = min(REACH, (total // LAPS - 1) // 2)
    window = np.concatenate(
        [np.arange(-reach, reach + 1) + lap * (total // LAPS) for lap in range(LAPS)]
    )
    near = (anchor[:, None] + window) % total
    repeated = np.repeat(world, near.shape[1], axis=0)
    flat = near.ravel()
    P = np.einsum("nij,nj->ni", poses[flat, :3, :3], repeated) + poses[flat, :3, 3]
    inside = np.abs(P[:, :2]) * FOCAL <= HALF_IMAGE * -P[:, 2:]
    sees = inside.all(axis=1) & (P[:, 2] < -NEAR) & (P[:, 2] > -FAR)
    return world, near, sees.reshape(near.shape)
