"""Bundle adjustment problems as all solvers get them, and the one judge of what they return.

A problem holds cameras of the BAL data sets, each with its own f, k₁ and k₂ to adjust:

    P = R p + t,   q = -(P_x, P_y) / P_z,   pixel = f (1 + k₁|q|² + k₂|q|⁴) q.

It travels to the processes of the solvers as .npz; a peer's process needs no odomap to read it.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.backend.adjustment.problem import BAL, Adjustment
from odomap.files.bal import read_bal
from odomap.simulation.bundle import bundle_world

Array = NDArray[np.float64]
Index = NDArray[np.int64]


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
    return _bundle(path.name.split(".")[0].removesuffix("-pre"), read_bal(path))


def ring(views: int = 1000, points: int = 200_000, seed: int = 0) -> Bundle:
    """Return two laps of a ring, every point seen by 5 to 8 views, with 1 px of noise.

    The start is off by 5 cm and 0.3° per view, 20 cm per point and 1 % of each lens.
    """
    world = bundle_world(views, points, model=BAL, sigma_px=1.0, seed=seed)
    return _bundle(f"ring_{views}", world.problem)


def _bundle(name: str, problem: Adjustment) -> Bundle:
    return Bundle(
        name,
        problem.Ts_camera_world,
        problem.points_world,
        problem.view,
        problem.point,
        problem.pixels,
        problem.intrinsics[problem.lens],
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
