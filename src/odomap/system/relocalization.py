"""Relocalisation: finding the way back without a prediction.

When tracking fails, features of the new image are matched by descriptor alone with those of a
keyframe whose landmarks are known, and the pose follows from the landmarks by P3P in RANSAC. Random
draws are seeded by the frame's number, so the same recording always recovers in the same way.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM", T-RO 2015, section V-C.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.camera import Camera
from odomap.geometry.pnp import solve_pnp
from odomap.system.association import Reference, View
from odomap.vision.features import Corners, FeatureConfig, describe, detect
from odomap.vision.matching import MatchConfig, match_all

__all__ = ["relocalize"]

Array = NDArray[np.float64]


def relocalize(
    view: View,
    reference: Reference,
    points_world: Array,
    camera: Camera,
    features: FeatureConfig,
    matching: MatchConfig,
    mask: NDArray[np.bool_],
    min_inliers: int,
) -> Array | None:
    """Find the camera's pose at a view by descriptors.

    Args:
        view: the image.
        reference: a keyframe that may show the same place.
        points_world: (N, 3) its landmarks; NaN where gone.
        camera: the rectified camera.
        features, matching: how features are found and matched.
        mask: (H, W) bool, where the image holds something.
        min_inliers: landmarks that must agree.

    Returns:
        T_world_camera (4, 4), or None if too few landmarks agree.
    """
    known = np.flatnonzero(np.isfinite(points_world).all(axis=1))
    at = reference.keypoints[known].astype(np.float32)
    level = np.zeros(len(at), np.uint8)
    there, kept = describe(reference.view.image, Corners(at, np.zeros(len(at)), level), "orb")
    config = replace(features, detector="fast", count=3 * features.count)
    corners = detect(view.image, config, mask=mask)
    here, of_corner = describe(view.image, corners, "orb")
    matches = match_all(there, here, matching)
    good = np.flatnonzero(matches >= 0)
    if good.size < min_inliers:
        return None
    pixels = corners.keypoints[of_corner[matches[good]]].astype(np.float64)
    result = solve_pnp(
        points_world[known[kept[good]]],
        pixels,
        camera,
        seed=view.frame_id,
        threshold_px=3.0,
        min_inliers=min_inliers,
    )
    return result.T_world_camera.matrix if result.converged else None
