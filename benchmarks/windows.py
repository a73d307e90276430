"""Problems of the size that stereo odometry solves, made from a seed, for timing solvers."""

import numpy as np
from numpy.typing import NDArray

from odomap.backend.bundle import Bundle
from odomap.backend.motion import Sightings
from odomap.geometry.lie import se3_exp, se3_inverse
from odomap.system.mapping import WindowConfig
from odomap.system.uncertainty import NoiseConfig
from odomap.vision.stereo import StereoConfig

FOCAL = 450.0
BASELINE = 0.11
SIZE = (752, 480)

Array = NDArray[np.float64]


def window_problem(per_keyframe: int = 300, seed: int = 0) -> Bundle:
    """Return the bundle of one window: a camera goes forward, new points replace those it loses."""
    rng = np.random.default_rng(seed)
    window, noise, disparity_px = WindowConfig(), NoiseConfig(), StereoConfig().noise_px
    count = window.size + window.fixed
    Ts = np.array(
        [se3_exp(np.array([0.02 * k, 0.0, 0.08 * k, 0.0, 0.01 * k, 0.0])) for k in range(count)]
    )
    points = np.empty((0, 3))
    pose, point, xy, disparity = [], [], [], []
    for k, T in enumerate(Ts):
        seen, pixels, depth = _visible(points, T)
        born = per_keyframe - len(seen)
        if born > 0:
            points = np.vstack([points, _points_ahead(rng, born, T)])
            seen, pixels, depth = _visible(points, T)
        pose.append(np.full(len(seen), k))
        point.append(seen)
        xy.append((pixels + rng.normal(0.0, noise.position_px, pixels.shape)) / FOCAL)
        disparity.append(BASELINE / depth + rng.normal(0.0, disparity_px, len(seen)) / FOCAL)
    off = rng.normal(0.0, 1.0, (count, 6)) * [0.01, 0.01, 0.01, 0.003, 0.003, 0.003]
    is_fixed = np.arange(count) < window.fixed
    off[is_fixed] = 0.0
    rows = sum(map(len, pose))
    return Bundle(
        Ts @ se3_exp(off),
        is_fixed,
        points * (1.0 + rng.normal(0.0, 0.01, (len(points), 1))),
        np.eye(4)[None],
        np.array([BASELINE]),
        np.concatenate(pose).astype(np.int64),
        np.concatenate(point).astype(np.int64),
        np.zeros(rows, np.int64),
        np.concatenate(xy),
        np.concatenate(disparity),
        np.tile(FOCAL / np.array([noise.position_px, disparity_px]), (rows, 1)),
    )


def motion_problem(count: int = 300, seed: int = 0) -> tuple[Array, Array, float, Sightings]:
    """Return T_world_body, T_camera_body, the baseline, and what is seen from there."""
    rng = np.random.default_rng(seed)
    noise, disparity_px = NoiseConfig(), StereoConfig().noise_px
    T = se3_exp(np.array([0.3, -0.1, 0.5, 0.05, -0.1, 0.02]))
    points = _points_ahead(rng, count, T)
    local = (points - T[:3, 3]) @ T[:3, :3]
    xy = local[:, :2] / local[:, 2:] + rng.normal(0.0, noise.position_px / FOCAL, (count, 2))
    disparity = BASELINE / local[:, 2] + rng.normal(0.0, disparity_px / FOCAL, count)
    weights = np.tile(FOCAL / np.array([noise.position_px, disparity_px]), (count, 1))
    return T, np.eye(4), BASELINE, Sightings(points, xy, disparity, weights)


def _points_ahead(rng: np.random.Generator, count: int, T_world_camera: Array) -> Array:
    """Return points spread over the image of a camera, from 2 to 10 m deep."""
    depth = rng.uniform(2.0, 10.0, (count, 1))
    half = np.array(SIZE) / 2 * 0.95
    rays = np.hstack([rng.uniform(-half, half, (count, 2)) / FOCAL, np.ones((count, 1))])
    return np.asarray(depth * rays @ T_world_camera[:3, :3].T + T_world_camera[:3, 3])


def _visible(points: Array, T_world_camera: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """Return which points a camera sees, at which pixels (from its centre), at which depth."""
    T = se3_inverse(T_world_camera)
    local = points @ T[:3, :3].T + T[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = FOCAL * local[:, :2] / local[:, 2:]
    inside = (local[:, 2] > 0.5) & (np.abs(pixels) < np.array(SIZE) / 2).all(axis=1)
    seen = np.flatnonzero(inside)
    return seen, pixels[seen], local[seen, 2]
