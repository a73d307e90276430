"""Small bundles with known truth."""

from dataclasses import dataclass

import numpy as np
import pytest

from odomap.backend.bundle import Bundle
from odomap.geometry.lie import se3_exp, se3_inverse

FOCAL = 420.0
BASELINE = 0.12


@dataclass(frozen=True)
class Scene:
    """Poses along a curve that see points before them, without noise."""

    Ts_world_body: np.ndarray
    points_world: np.ndarray
    T_camera_body: np.ndarray
    pose: np.ndarray
    point: np.ndarray
    xy: np.ndarray
    disparity: np.ndarray

    def bundle(self, rng=None, noise=0.0, start=None, fixed=1, sigma=(0.5, 0.8), mono=False):
        """Return the problem: `noise` times sigma on what is measured, `start` on what is sought.

        Args:
            rng: of the noise.
            noise: in standard deviations.
            start: (standard deviation of the poses' tangents, of the points) or None for truth.
            fixed: how many of the first poses are held.
            sigma: of position and disparity, pixels.
            mono: leave disparities out.
        """
        weights = np.tile(FOCAL / np.array(sigma), (len(self.pose), 1))
        xy, disparity = self.xy.copy(), self.disparity.copy()
        Ts, points = self.Ts_world_body.copy(), self.points_world.copy()
        if noise:
            xy += noise * rng.normal(size=xy.shape) / weights[:, :1]
            disparity += noise * rng.normal(size=len(xy)) / weights[:, 1]
        if mono:
            disparity[:] = np.nan
        is_fixed = np.arange(len(Ts)) < fixed
        if start is not None:
            Ts[fixed:] = Ts[fixed:] @ se3_exp(rng.normal(0, start[0], (len(Ts) - fixed, 6)))
            points += rng.normal(0, start[1], points.shape)
        return Bundle(
            Ts,
            is_fixed,
            points,
            self.T_camera_body[None],
            np.array([BASELINE]),
            self.pose,
            self.point,
            np.zeros(len(self.pose), np.int64),
            xy,
            disparity,
            weights,
        )


def make_scene(poses=5, points=60, seed=0, share=0.8):
    """Return a scene in which each pose sees each point with probability `share`."""
    rng = np.random.default_rng(seed)
    steps = rng.normal([0.15, 0.0, 0.02, 0.0, 0.01, 0.03], 0.03, (poses, 6))
    Ts = [se3_exp(rng.normal(0, 0.4, 6))]
    T_camera_body = se3_exp(np.array([0.05, -0.1, 0.02, 0.9, -0.7, 0.6]))
    for step in steps[1:]:
        Ts.append(Ts[-1] @ se3_inverse(T_camera_body) @ se3_exp(step) @ T_camera_body)
    Ts = np.array(Ts)
    middle = Ts[poses // 2] @ se3_inverse(T_camera_body)
    z = rng.uniform(2.5, 7.0, points)
    local = np.column_stack([rng.uniform(-0.5, 0.5, (points, 2)) * z[:, None], z])
    world = local @ middle[:3, :3].T + middle[:3, 3]
    pose, point = np.nonzero(rng.random((poses, points)) < share)
    order = rng.permutation(len(pose))  # observations come in any order
    pose, point = pose[order], point[order]
    T_camera_world = T_camera_body @ se3_inverse(Ts)[pose]
    local = (
        np.einsum("nij,nj->ni", T_camera_world[:, :3, :3], world[point]) + T_camera_world[:, :3, 3]
    )
    assert local[:, 2].min() > 1.0
    xy = local[:, :2] / local[:, 2:]
    return Scene(Ts, world, T_camera_body, pose, point, xy, BASELINE / local[:, 2])


@pytest.fixture(scope="session")
def scene():
    return make_scene()
