"""Bootstrap: motion and points from two views of one camera, when that can be said at all.

From matches alone a camera's motion follows up to scale, but not always: without translation there
is nothing to triangulate, and a plane allows two motions that explain both views equally well. So

1. the parallax that no rotation explains is measured; below a threshold one waits;
2. an essential matrix (any scene) and a homography (a plane) are fitted by RANSAC. Each stands for
   several motions, and all of them compete. The winner explains most of the matches by points ahead
   of both cameras;
3. where another motion explains nearly as much, the views between the two decide: the points of
   the right motion are seen where they should be from there as well. If they cannot tell, one
   waits.

Cost: 0.1 to 0.2 s for 500 matches; the test for parallax, which is cheap, comes first.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM", T-RO 2015, section IV; Nistér, T-PAMI 2004.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.camera import Camera
from odomap.geometry.homography import motions_of_homography
from odomap.geometry.pnp import refine_pose
from odomap.geometry.pose import SE3
from odomap.geometry.triangulate import triangulate
from odomap.geometry.twoview import (
    essential_matrix,
    homography_ransac,
    refine_motion,
    relative_pose,
    sampson_distance,
)
from odomap.vision.visionconfig import BootstrapConfig

__all__ = [
    "BetweenView",
    "BootstrapConfig",
    "TwoViewMotion",
    "rotation_parallax",
    "two_view_motion",
]

Array = NDArray[np.float64]

VIEWS_BETWEEN = 3
"""Views asked where two motions explain the matches."""
CLEARLY = 0.8
"""The right motion misses points by this fraction of what the wrong one does, or less. Of 300 noisy
planes none was decided wrongly even at 0.95."""


@dataclass(frozen=True, eq=False)
class BetweenView:
    """A view between the two, where some of the points were seen.

    Attributes:
        rows: (n,) which of the matches.
        pixels: (n, 2) where.
    """

    rows: NDArray[np.int64]
    pixels: Array


@dataclass(frozen=True, eq=False)
class TwoViewMotion:
    """What two views tell.

    Attributes:
        T_second_first: the motion, translation of length 1; None if there is none to trust.
        points_first: (N, 3) in first-camera axes and units of the baseline; NaN for outliers.
        parallax: (N,) rad.
        parallax_px: median displacement that no rotation explains.
        is_plane: whether the motion came from a homography.
        reason: why there is none, for people.
    """

    T_second_first: SE3 | None
    points_first: Array
    parallax: Array
    parallax_px: float
    is_plane: bool
    reason: str


def rotation_parallax(first: Array, second: Array) -> float:
    """Return the median angle between rays that no rotation of the camera explains.

    Args:
        first: (N, 2) normalised image coordinates.
        second: (N, 2).

    Returns:
        Radians.
    """
    a, b = _rays(first), _rays(second)
    weight = np.ones(len(a))
    residual = np.zeros(len(a))
    for _ in range(5):  # reweighted, so that near points do not turn the far ones
        U, _, Vt = np.linalg.svd((b * weight[:, None]).T @ a)
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        residual = np.linalg.norm(b - a @ R.T, axis=1)
        weight = 1.0 / np.maximum(residual, 1e-3)
    return float(np.median(residual))


def two_view_motion(
    first_pixels: Array,
    second_pixels: Array,
    camera: Camera,
    config: BootstrapConfig,
    seed: int,
    between: Sequence[BetweenView] = (),
) -> TwoViewMotion:
    """Find the motion between two views and the points they see.

    Args:
        first_pixels: (N, 2) where points are in the first view.
        second_pixels: (N, 2) the same points in the second.
        camera: of all views, a pinhole.
        config: thresholds.
        seed: of the samples.
        between: views between the two.
    """
    first, second = camera.undistort(first_pixels), camera.undistort(second_pixels)
    if len(first) < config.min_points:
        return _none(len(first), f"{len(first)} matches of {config.min_points} needed")
    turned = camera.fx * rotation_parallax(first, second)
    if turned < config.min_parallax_px:
        wait = f"parallax of {turned:.1f} px, {config.min_parallax_px:.1f} px needed"
        return _none(len(first), f"{wait}: move the camera sideways", turned)
    threshold = config.max_error_px / camera.fx
    starts = [
        _judged(T, is_plane, first, second, threshold)
        for T, is_plane in _motions(first, second, threshold, seed)
    ]
    starts = sorted(starts, key=_explained, reverse=True)
    if not starts or _explained(starts[0]) < config.min_points:
        count = _explained(starts[0]) if starts else 0
        why = f"{count} points of {config.min_points} fit one motion"
        return _none(len(first), why, turned)
    best = _decided(starts, between, camera, config)
    if best is None:
        return _none(len(first), "two motions explain the views: a plane? Move on", turned)
    return replace(best, parallax_px=turned)


def _motions(first: Array, second: Array, threshold: float, seed: int) -> list[tuple[SE3, bool]]:
    """Return all motions that either model stands for, translations of length 1."""
    motions = []
    general = relative_pose(first, second, threshold, seed=seed)
    if general.converged:
        motions.append((general.T_second_first, False))
    plane = homography_ransac(first, second, threshold, seed=seed)
    # A few points on some plane are no reason to believe in one.
    if plane.model is not None and plane.inliers.sum() > 0.5 * len(first):
        for T in motions_of_homography(plane.model):
            length = np.linalg.norm(T.t)
            if length > 1e-3:
                T = SE3.from_parts(T.R, T.t / length)
                # Off the plane a motion made from it is only near one that fits: go there.
                motions.append((refine_motion(T, first, second, threshold), True))
    return motions


def _judged(T: SE3, is_plane: bool, first: Array, second: Array, threshold: float) -> TwoViewMotion:
    """Triangulate with a motion."""
    near = np.abs(sampson_distance(essential_matrix(T), first, second)) <= threshold
    poses = np.stack([np.eye(4), T.inverse().matrix])
    found = triangulate(poses, np.where(near[:, None], np.stack([first, second]), np.nan))
    good = near & found.ahead & (found.errors <= threshold)
    points = np.where(good[:, None], found.points_world, np.nan)
    return TwoViewMotion(T, points, np.where(good, found.parallax, 0.0), 0.0, is_plane, "")


def _explained(start: TwoViewMotion) -> int:
    return int(np.isfinite(start.points_first[:, 0]).sum())


def _decided(
    starts: list[TwoViewMotion],
    between: Sequence[BetweenView],
    camera: Camera,
    config: BootstrapConfig,
) -> TwoViewMotion | None:
    """Return the best motion if no other one is nearly as good."""
    enough = config.max_ambiguity * _explained(starts[0])
    rivals = [starts[0]]
    for start in starts[1:]:
        if _explained(start) > enough and all(_differ(start, other) for other in rivals):
            rivals.append(start)
    if len(rivals) == 1:
        return starts[0]
    errors = sorted((_error_between(start, between, camera), k) for k, start in enumerate(rivals))
    clear = errors[0][0] < CLEARLY * errors[1][0] and errors[0][0] < config.max_error_px
    return rivals[errors[0][1]] if clear else None


def _differ(a: TwoViewMotion, b: TwoViewMotion) -> bool:
    """Say whether two motions are more than a few degrees apart, in direction or rotation."""
    assert a.T_second_first is not None
    assert b.T_second_first is not None
    turn = (a.T_second_first.inverse() @ b.T_second_first).R
    angle = np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0))
    along = float(np.clip(a.T_second_first.t @ b.T_second_first.t, -1.0, 1.0))
    return bool(angle > np.radians(2.0) or np.arccos(along) > np.radians(8.0))


def _error_between(start: TwoViewMotion, between: Sequence[BetweenView], camera: Camera) -> float:
    """Return the distance in pixels at which points are seen from the views between."""
    assert start.T_second_first is not None
    known = np.isfinite(start.points_first[:, 0])
    T_first_second = start.T_second_first.inverse().log()
    errors: list[float] = []
    if not between:
        return np.inf
    for k in np.unique(np.linspace(0, len(between) - 1, VIEWS_BETWEEN).round().astype(int)):
        seen = between[k].rows[known[between[k].rows]]
        pixels = between[k].pixels[known[between[k].rows]]
        if len(seen) < 10:
            continue
        guess = SE3.exp((k + 1) / (len(between) + 1) * T_first_second)
        points = start.points_first[seen]
        pose = refine_pose(points, pixels, camera, guess, huber=2.0).T_world_camera
        off = np.linalg.norm(camera.project(pose.inverse() @ points) - pixels, axis=1)
        errors.append(float(np.median(np.nan_to_num(off, nan=np.inf))))
    return float(np.mean(errors)) if errors else np.inf


def _rays(xy: Array) -> Array:
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _none(count: int, reason: str, parallax_px: float = 0.0) -> TwoViewMotion:
    nowhere = np.full((count, 3), np.nan)
    return TwoViewMotion(None, nowhere, np.zeros(count), parallax_px, False, reason)
