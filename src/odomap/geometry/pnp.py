"""Pose from points (PnP): where a camera is, given what it sees of a known map.

The problem: N known points are seen at N pixels, some of them matched wrongly. Three points leave
at most four poses (`p3p`); RANSAC finds one that most points agree with; Levenberg-Marquardt on its
inliers minimises

    Σ |Lᵢ (π(T_world_camera⁻¹ pᵢ) - xᵢ)|² / σ²

with xᵢ the undistorted observation and Lᵢ the slope of the lens there, so that errors count in raw
pixels. The covariance is the inverse of the final normal matrix, for the tangent (translation,
rotation) on the right of T_world_camera; it is honest if σ is. Samples come from the caller's seed.
About 1 ms for 300 points, a third of them wrong.

Reference: M. Persson, K. Nordberg, "Lambda Twist: an accurate fast robust perspective three point
(P3P) solver", ECCV 2018.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import InputError
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.geometry.ransac import check_search, draw_samples
from odomap.geometry.so3 import Array, orthonormalize, tail_shape

__all__ = ["PnpResult", "p3p", "refine_pose", "solve_pnp"]


@dataclass(frozen=True)
class PnpResult:
    """A pose, and how sure it is.

    Attributes:
        T_world_camera: the pose; the identity (or the start, when refining) if none was found.
        inliers: (N,) bool, reprojection error within the threshold.
        covariance: (6, 6) of T_world_camera, tangent (translation, rotation), right update, metres
            and radians; infinite if the pose is not determined.
        converged: whether there is a pose to rely on.
        rms_px: root mean square reprojection error of the inliers, pixels.
        iterations: samples drawn, or steps made when refining.
        reason: what went wrong; empty when nothing did.
    """

    T_world_camera: SE3
    inliers: NDArray[np.bool_]
    covariance: Array
    converged: bool
    rms_px: float
    iterations: int
    reason: str

    @property
    def num_inliers(self) -> int:
        """How many points agree with the pose."""
        return int(np.count_nonzero(self.inliers))


@dataclass(frozen=True)
class _Sight:
    """The usable observations: rows of the input, and what the kernels need of them."""

    rows: NDArray[np.int64]
    count: int
    points: Array
    plane: Array
    slopes: Array
    weights: Array

    def spread(self, inliers: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return marks of the usable rows as marks of all rows."""
        out = np.zeros(self.count, dtype=np.bool_)
        out[self.rows] = inliers
        return out


def p3p(points_world: ArrayLike, bearings: ArrayLike) -> list[SE3]:
    """Return the poses that see three points along three rays.

    Args:
        points_world: (3, 3) metres.
        bearings: (3, 3) unit vectors, camera axes.

    Returns:
        Up to four T_world_camera.
    """
    from odomap.geometry.p3p_kernels import p3p_into

    x, y = (
        tail_shape(points_world, (3, 3), "points_world"),
        tail_shape(bearings, (3, 3), "bearings"),
    )
    y = y / np.linalg.norm(y, axis=1, keepdims=True)
    Rs, ts = np.empty((4, 3, 3)), np.empty((4, 3))
    count = p3p_into(y, np.array(x), Rs, ts)
    return [SE3.from_parts(orthonormalize(Rs[i]), ts[i]).inverse() for i in range(count)]


def solve_pnp(
    points_world: ArrayLike,
    pixels: ArrayLike,
    camera: Camera,
    *,
    seed: int = 0,
    threshold_px: float = 4.0,
    sigma_px: ArrayLike = 1.0,
    confidence: float = 0.999,
    max_iterations: int = 500,
    min_inliers: int = 6,
) -> PnpResult:
    """Find a camera's pose from points it sees, some of them matched wrongly.

    Args:
        points_world: (N, 3) metres; rows with NaN are outliers.
        pixels: (N, 2) where the camera saw them, raw image; rows with NaN are outliers.
        camera: the camera.
        seed: of the samples.
        threshold_px: largest reprojection error of an inlier; at least 3 σ, or the covariance is
            too small.
        sigma_px: standard deviation of a pixel coordinate, one for all or (N,).
        confidence: probability of a clean sample at which the search stops.
        max_iterations: samples at most.
        min_inliers: fewer mean that no pose was found.

    Returns:
        The pose, its inliers and covariance; `converged` is False if there is none.

    Example:
        >>> camera = Camera(intrinsics=(500.0, 500.0, 320.0, 240.0), resolution=(640, 480))
        >>> points = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 5), (20, 3))
        >>> solve_pnp(points, camera.project(points), camera).num_inliers
        20
    """
    from odomap.geometry.pnp_kernels import refine_pose_into, score_pose, search_pose

    check_search(threshold_px, confidence)
    sight = _sight(points_world, pixels, camera, sigma_px)
    n, wanted = len(sight.rows), max(4, min_inliers)
    if n < wanted:
        return _nothing(SE3.identity(), sight.count, f"{n} usable points of {wanted} needed")
    samples = draw_samples(n, 3, max_iterations, np.random.default_rng(seed))
    rays = np.concatenate([sight.plane, np.ones((n, 1))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    R, t, inliers, H = np.eye(3), np.zeros(3), np.zeros(n, dtype=np.bool_), np.zeros((6, 6))
    data, limit = (sight.points, sight.plane, sight.slopes), threshold_px**2
    tried = search_pose(samples, data[0], rays, *data[1:], limit, confidence, 4, R, t, inliers)
    steady = False
    for _ in range(5):
        if np.count_nonzero(inliers) < wanted:
            reason = f"{inliers.sum()} inliers of {wanted} needed: moved too far?"
            return _nothing(SE3.identity(), sight.count, reason, tried)
        used = inliers.copy()
        _, _, steady = refine_pose_into(R, t, *data, sight.weights * used, 1e9, 20, H)
        score_pose(np.ascontiguousarray(R.T), -R.T @ t, *data, limit, inliers)
        if np.array_equal(used, inliers):
            break
    return _pnp_result(sight, R, t, H, inliers, tried, steady)


def refine_pose(
    points_world: ArrayLike,
    pixels: ArrayLike,
    camera: Camera,
    T_world_camera: SE3,
    *,
    threshold_px: float = np.inf,
    sigma_px: ArrayLike = 1.0,
    huber: float = 0.0,
    max_iterations: int = 20,
) -> PnpResult:
    """Improve a pose on all its points, with Huber's loss for those that disagree.

    Args:
        points_world: (N, 3) metres.
        pixels: (N, 2) raw image.
        camera: the camera.
        T_world_camera: the start.
        threshold_px: largest reprojection error of what is called an inlier afterwards.
        sigma_px: standard deviation of a pixel coordinate, one for all or (N,).
        huber: constant of the loss in standard deviations; 0 for plain least squares.
        max_iterations: steps at most.

    Returns:
        The pose with its covariance, and which points agree.

    Raises:
        InputError: shapes do not agree, or numbers outside their range.
    """
    from odomap.geometry.pnp_kernels import refine_pose_into, score_pose

    sight = _sight(points_world, pixels, camera, sigma_px)
    if len(sight.rows) < 3:
        reason = f"{len(sight.rows)} usable points of 3 needed"
        return _nothing(T_world_camera, sight.count, reason)
    R, t, H = T_world_camera.R.copy(), T_world_camera.t.copy(), np.zeros((6, 6))
    data, loss = (sight.points, sight.plane, sight.slopes), huber if huber > 0 else 1e9
    _, steps, steady = refine_pose_into(R, t, *data, sight.weights, loss, max_iterations, H)
    inliers = np.zeros(len(sight.rows), dtype=np.bool_)
    limit = min(threshold_px**2, 1e18)
    score_pose(np.ascontiguousarray(R.T), -R.T @ t, *data, limit, inliers)
    return _pnp_result(sight, R, t, H, inliers, steps, steady)


def _sight(points: ArrayLike, pixels: ArrayLike, camera: Camera, sigma_px: ArrayLike) -> _Sight:
    """Undistort the observations and take the slope of the lens at each."""
    p, uv = tail_shape(points, (3,), "points_world"), tail_shape(pixels, (2,), "pixels")
    if p.ndim != 2 or uv.ndim != 2 or len(p) != len(uv):
        raise InputError(f"points_world, pixels: shapes {p.shape}, {uv.shape}, give (N, 3), (N, 2)")
    sigma = np.asarray(sigma_px, dtype=np.float64)
    if sigma.shape not in ((), (len(p),)) or not np.all(sigma > 0):
        raise InputError("sigma_px: give one number or (N,), all above 0")
    plane = camera.undistort(uv)
    rows = np.flatnonzero(np.isfinite(plane).all(axis=1) & np.isfinite(p).all(axis=1))
    plane = np.ascontiguousarray(plane[rows])
    ahead = np.concatenate([plane, np.ones((len(rows), 1))], axis=1)
    slopes = np.ascontiguousarray(camera.project_jacobian(ahead)[:, :, :2])
    weights = np.broadcast_to(1.0 / sigma**2, (len(p),))[rows]
    return _Sight(
        rows, len(p), np.ascontiguousarray(p[rows]), plane, slopes, np.ascontiguousarray(weights)
    )


def _nothing(start: SE3, count: int, reason: str, iterations: int = 0) -> PnpResult:
    inliers, covariance = np.zeros(count, dtype=np.bool_), np.full((6, 6), np.inf)
    return PnpResult(start, inliers, covariance, False, np.nan, iterations, reason)


def _pnp_result(
    sight: _Sight,
    R: Array,
    t: Array,
    H: Array,
    inliers: NDArray[np.bool_],
    iterations: int,
    steady: bool,
) -> PnpResult:
    """Turn what the kernels left into a value; H is the information of the inliers."""
    T_world_camera = SE3.from_parts(orthonormalize(R), t)
    # Unit diagonal first: metres and radians may differ by orders of magnitude.
    d = np.sqrt(np.maximum(np.diag(H), 1e-300))
    values, vectors = np.linalg.eigh(H / np.outer(d, d))
    covariance, reason = np.full((6, 6), np.inf), ""
    if values[0] > 1e-10:
        covariance = (vectors / values) @ vectors.T / np.outer(d, d)
    else:
        reason = "the points do not determine the pose: all on a line, or too few?"
    if not steady and not reason:
        reason = "the refinement did not settle"
    p = sight.points[inliers] @ R - R.T @ t
    gap = p[:, :2] / np.where(p[:, 2:] > 0, p[:, 2:], np.nan) - sight.plane[inliers]
    error = (sight.slopes[inliers] @ gap[:, :, None])[:, :, 0]
    rms = float(np.sqrt(np.mean(np.sum(error * error, axis=1)))) if len(error) else np.nan
    marks = sight.spread(inliers)
    return PnpResult(T_world_camera, marks, covariance, not reason, rms, iterations, reason)
