"""The bundle of a local window: keyframes and landmarks adjusted together, and what disagrees.

Every observation of a landmark that an adjusted keyframe sees takes part: those in keyframes that
are held fixed tie the window to the rest of the map. A keypoint found on level l of the pyramid is
known to σ s^l; where its depth was measured, that is a second measurement.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section VI-D.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.backend.bundle import Bundle, BundleConfig, BundleSolution, solve_bundle
from odomap.geometry.lie import se3_inverse
from odomap.system.creating import Created
from odomap.system.depthbias import bias_at
from odomap.system.localmap import median_distance
from odomap.system.localwindow import LocalWindow
from odomap.system.ranging import UNIT_BASELINE

__all__ = ["Adjusted", "adjust_window", "at_one_place"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Adjusted:
    """A window adjusted.

    Attributes:
        Ts_world_body: (K, 4, 4).
        points_world: (M, 3) of the window's landmarks.
        created_world: (C, 3) of those just created.
        is_wrong: (N,) bool, observations of the window that disagree.
        is_created_wrong: (O,) bool, observations of those just created that disagree.
        solution: what the solver said.
        is_scale_free: nothing in the window measures its size.
        has_depth: some observation measures depth.
    """

    Ts_world_body: Array
    points_world: Array
    created_world: Array
    is_wrong: NDArray[np.bool_]
    is_created_wrong: NDArray[np.bool_]
    solution: BundleSolution
    is_scale_free: bool
    has_depth: bool


def adjust_window(
    window: LocalWindow,
    created: Created,
    T_body_camera: Array,
    config: BundleConfig,
    gate: float,
) -> Adjusted:
    """Adjust a window.

    Args:
        window: keyframes, landmarks, observations.
        created: landmarks that belong to it, though the map does not know them yet.
        T_body_camera: (4, 4) mount of the pinhole.
        config: of the solver.
        gate: residual beyond which an observation is wrong, standard deviations.
    """
    Ts_world_body = window.Ts_world_camera @ se3_inverse(T_body_camera)
    # A landmark that only fixed keyframes see tells nothing here.
    seen = np.zeros(len(window.points_world), np.bool_)
    seen[window.obs_landmark[~window.is_fixed[window.obs_keyframe]]] = True
    used = np.flatnonzero(seen[window.obs_landmark])
    kept = np.flatnonzero(seen)
    row = np.full(len(seen), -1)
    row[kept] = np.arange(len(kept))
    keyframe = np.concatenate([window.obs_keyframe[used], created.obs_keyframe])
    point = np.concatenate([row[window.obs_landmark[used]], len(kept) + created.obs_point])
    keypoint = np.concatenate([window.obs_keypoint[used], created.obs_keypoint])
    xy, inverse_depth, weights = _measured(window, keyframe, keypoint)
    points = np.concatenate([window.points_world[kept], created.points_world])
    has_depth = bool(np.isfinite(inverse_depth).any())
    sigma = window.sigma_px / window.camera.fx
    free = not has_depth and at_one_place(Ts_world_body[window.is_fixed], points, sigma)
    solution = solve_bundle(
        Bundle(
            Ts_world_body,
            window.is_fixed,
            points,
            se3_inverse(T_body_camera)[None],
            np.array([UNIT_BASELINE]),
            keyframe,
            point,
            np.zeros(len(keyframe), np.int64),
            xy,
            inverse_depth,
            weights,
            is_scale_free=free,
        ),
        config,
    )
    wrong = solution.chi2 > gate**2
    is_wrong = np.zeros(len(window.obs_keyframe), np.bool_)
    is_wrong[used] = wrong[: len(used)]
    points_world = np.array(window.points_world)
    points_world[kept] = solution.points_world[: len(kept)]
    return Adjusted(
        solution.Ts_world_body,
        points_world,
        solution.points_world[len(kept) :],
        is_wrong,
        wrong[len(used) :],
        solution,
        free,
        has_depth,
    )


def _measured(
    window: LocalWindow, keyframe: NDArray[np.int64], keypoint: NDArray[np.int64]
) -> tuple[Array, Array, Array]:
    """Return what keyframes measured: xy (N, 2), inverse depth (N,), weights (N, 2)."""
    at = window.first[keyframe] + keypoint
    bearings = window.bearings[at]
    xy = bearings[:, :2] / bearings[:, 2:]
    inverse_depth = 1.0 / window.depths[at] - bias_at(window.inverse_depth_bias, bearings)
    level = window.levels[at].astype(np.float64)
    sigma = window.sigma_px / window.camera.fx * window.level_scale**level
    depth = np.full(len(keyframe), window.inverse_depth_sigma)
    return xy, inverse_depth, 1.0 / np.stack([sigma, depth], axis=1)


def at_one_place(Ts_world_fixed: Array, points_world: Array, sigma: float) -> bool:
    """Say whether fixed keyframes are too near to each other to tell how large a scene is.

    One alone is, and so are two of a camera that stood still: their parallax is lost in the
    noise of a point.

    Args:
        Ts_world_fixed: (F, 4, 4) poses that are held.
        points_world: (M, 3) the scene.
        sigma: noise of a point in normalised image coordinates.
    """
    fixed = Ts_world_fixed[:, :3, 3]
    apart = np.linalg.norm(fixed - fixed[-1], axis=1).max()
    return bool(apart < sigma * median_distance(points_world, fixed[-1]))
