"""Bundle adjustment: poses and landmarks that agree best with all observations.

    min_{T, p}  Σ_o ρ( ‖r_o(T_world_body[pose_o], p[landmark_o])‖² )

over a window of poses, some of them held fixed to tie the gauge, by Levenberg-Marquardt: each step
solves the Schur complement on the poses (see `schur`) and is taken if the cost falls. ρ is Huber's
loss. The whole loop is one compiled call without the interpreter's lock.

The covariance of the free poses, given the fixed ones, is the inverse of the undamped reduced
system at the solution; landmarks are marginalised by the elimination itself.

Reference: Triggs et al., "Bundle Adjustment - A Modern Synthesis", 1999; Mouragnon et al., "Real
Time Localization and 3D Reconstruction", CVPR 2006 (windows).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.backend.bundleconfig import BundleConfig
from odomap.backend.cholesky import factor, invert, solve
from odomap.backend.schur import (
    CameraArrays,
    PoseArrays,
    SightArrays,
    SystemArrays,
    back_substitute,
    disparity_response,
    reduced_system,
    robust_cost,
)
from odomap.errors import InputError
from odomap.geometry.lie_kernels import se3_retract
from odomap.kernels import kernel

__all__ = ["Bundle", "BundleConfig", "BundleSolution", "solve_bundle", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

REASONS = ("iteration limit", "converged", "no step lowers the cost", "the system is singular")


@dataclass(frozen=True)
class Bundle:
    """A bundle adjustment problem, as arrays.

    Attributes:
        Ts_world_body: (K, 4, 4).
        is_fixed: (K,) bool, poses held fixed.
        points_world: (M, 3).
        Ts_camera_body: (C, 4, 4).
        baselines: (C,) metres; of no meaning for observations without disparity.
        pose, point, camera: (N,) int64 indices of each observation.
        xy: (N, 2) measured normalised image coordinates.
        disparity: (N,) measured disparity over focal length, NaN where there is none.
        weights: (N, 2) inverse standard deviations of xy and of the disparity.
        is_scale_free: nothing measures how large the scene is: a single camera whose poses held
            are one, or at one place. The size of the path is then held too, that of the poses as
            they come.
    """

    Ts_world_body: Array
    is_fixed: NDArray[np.bool_]
    points_world: Array
    Ts_camera_body: Array
    baselines: Array
    pose: Index
    point: Index
    camera: Index
    xy: Array
    disparity: Array
    weights: Array
    is_scale_free: bool = False

    def __post_init__(self) -> None:
        n = len(self.pose)
        lengths = {len(a) for a in (self.point, self.camera, self.xy, self.disparity, self.weights)}
        if lengths != {n}:
            raise InputError(
                f"bundle: observation arrays differ in length ({n} and {sorted(lengths)})"
            )
        if len(self.is_fixed) != len(self.Ts_world_body):
            raise InputError("bundle: is_fixed and Ts_world_body differ in length")
        for name, known in (
            ("pose", self.Ts_world_body),
            ("point", self.points_world),
            ("camera", self.Ts_camera_body),
        ):
            named = getattr(self, name)
            if n and not 0 <= named.min() <= named.max() < len(known):
                raise InputError(f"bundle: an observation names a {name} that does not exist")
        real = "Ts_world_body", "points_world", "Ts_camera_body", "baselines", "xy", "weights"
        for name in real:
            if not np.isfinite(getattr(self, name)).all():
                raise InputError(f"bundle: {name} holds a value that is not finite")
        if np.isinf(self.disparity).any():
            raise InputError("bundle: a disparity is infinite; one that is not known is NaN")


@dataclass(frozen=True)
class BundleSolution:
    """What a bundle adjustment found.

    Attributes:
        Ts_world_body: (K, 4, 4), fixed poses unchanged.
        points_world: (M, 3).
        cost_before, cost_after: half the sum of robust squared residuals.
        iterations: steps tried.
        reason: why it stopped.
        chi2: (N,) squared residuals in standard deviations; infinite behind the camera.
        covariances: (K, 6, 6) of each pose given the fixed ones, right tangent; zero for those.
        joint_covariance: (6F, 6F) of all free poses in order; zero if the system is singular.
        disparity_responses: (K, 3, 6) by which each pose moves, right tangent, per unit of error in
            all disparities over focal length: an offset, and slopes in x and in y of the normalised
            image. What errors of the calibration would do.
        variance_factor: χ² per degree of freedom of the inlying observations: about 1 where the
            weights say the truth.
        disparity_gradient: (3,) of the cost by those errors, at the solution.
        disparity_curvature: (3, 3) of the cost by those errors, with poses and points following:
            the observations ask for errors of −curvature⁻¹ gradient.
    """

    Ts_world_body: Array
    points_world: Array
    cost_before: float
    cost_after: float
    iterations: int
    reason: str
    chi2: Array
    covariances: Array
    joint_covariance: Array
    disparity_responses: Array
    variance_factor: float
    disparity_gradient: Array
    disparity_curvature: Array


def solve_bundle(bundle: Bundle, config: BundleConfig | None = None) -> BundleSolution:
    """Adjust poses and landmarks.

    Args:
        bundle: the problem.
        config: iterations and loss.

    Returns:
        The solution; check `reason` and the costs.

    Raises:
        InputError: if no pose is held fixed (the gauge would be free) or arrays do not match.
    """
    config = BundleConfig() if config is None else config
    if not bundle.is_fixed.any():
        raise InputError("bundle: hold at least one pose fixed, or the whole scene can drift")
    order = np.argsort(bundle.point, kind="stable")
    free = int((~bundle.is_fixed).sum())
    poses, cameras, seen = _arrays(bundle, order)
    points = np.array(bundle.points_world, np.float64, order="C")
    chi2, joint, costs = np.empty(len(order)), np.zeros((6 * free, 6 * free)), np.zeros(2)
    response, evidence = np.zeros((3, 6 * free)), np.zeros((4, 3))
    tried, why = _solve_kernel(
        poses,
        points,
        cameras,
        seen,
        (config.huber_width, config.iterations, config.tolerance, bundle.is_scale_free),
        chi2,
        joint,
        response,
        evidence,
        costs,
    )
    Ts = np.array(bundle.Ts_world_body)
    Ts[:, :3, :3], Ts[:, :3, 3] = poses.R, poses.t
    covariances, responses = np.zeros((len(Ts), 6, 6)), np.zeros((len(Ts), 3, 6))
    for k in np.flatnonzero(poses.column >= 0):
        f = 6 * poses.column[k]
        covariances[k] = joint[f : f + 6, f : f + 6]
        responses[k] = response[:, f : f + 6]
    unsorted = np.empty(len(order))
    unsorted[order] = chi2
    factor = _variance_factor(bundle, unsorted, config.huber_width, free)
    return BundleSolution(
        Ts,
        points,
        costs[0],
        costs[1],
        tried,
        REASONS[why],
        unsorted,
        covariances,
        joint,
        responses,
        factor,
        evidence[0],
        evidence[1:],
    )


def _arrays(bundle: Bundle, order: Index) -> tuple[PoseArrays, CameraArrays, SightArrays]:
    """Lay a bundle out as the kernels want it, observations sorted by landmark."""
    column = np.where(bundle.is_fixed, -1, np.cumsum(~bundle.is_fixed) - 1).astype(np.int64)
    Ts, mounts = bundle.Ts_world_body, bundle.Ts_camera_body
    start = np.searchsorted(bundle.point[order], np.arange(len(bundle.points_world) + 1))
    return (
        PoseArrays(_contiguous(Ts[:, :3, :3]), _contiguous(Ts[:, :3, 3]), column),
        CameraArrays(
            _contiguous(mounts[:, :3, :3]),
            _contiguous(mounts[:, :3, 3]),
            _contiguous(bundle.baselines),
        ),
        SightArrays(
            start.astype(np.int64),
            bundle.pose[order].astype(np.int64),
            bundle.camera[order].astype(np.int64),
            _contiguous(bundle.xy[order]),
            _contiguous(bundle.disparity[order]),
            _contiguous(bundle.weights[order]),
        ),
    )


def _contiguous(values: Array) -> Array:
    """Return a fresh, writable copy, rows together in memory."""
    return np.array(values, np.float64, order="C")


def _variance_factor(bundle: Bundle, chi2: Array, width: float, free: int) -> float:
    inlier = chi2 <= width * width
    rows = 2 * inlier.sum() + np.isfinite(bundle.disparity[inlier]).sum()
    unknowns = 6 * free + 3 * len(np.unique(bundle.point[inlier]))
    return float(chi2[inlier].sum() / (rows - unknowns)) if rows > unknowns else 1.0


@kernel
def _retract(poses: PoseArrays, step: Array, R_new: Array, t_new: Array) -> None:
    """T ← T exp(δξ) for the free poses."""
    for i in range(len(poses.R)):
        f = 6 * poses.column[i]
        if f < 0:
            for a in range(3):
                t_new[i, a] = poses.t[i, a]
                for b in range(3):
                    R_new[i, a, b] = poses.R[i, a, b]
        else:
            se3_retract(poses.R[i], poses.t[i], step[f : f + 6], R_new[i], t_new[i])


@kernel
def _take_step(poses: PoseArrays, points: Array, trial: PoseArrays, moved: Array) -> None:
    """Copy a step that was tried; in loops, since whole arrays take seconds to compile."""
    for i in range(len(poses.R)):
        for a in range(3):
            poses.t[i, a] = trial.t[i, a]
            for b in range(3):
                poses.R[i, a, b] = trial.R[i, a, b]
    for m in range(len(points)):
        for a in range(3):
            points[m, a] = moved[m, a]


@kernel
def _hold_scale(poses: PoseArrays, S: Array) -> None:
    """S += λ g gᵀ, g the motion of all poses when the scene grows around the one held fixed."""
    held = 0
    while poses.column[held] >= 0:
        held += 1
    g, size, trace = np.zeros(len(S)), 0.0, 0.0
    for i in range(len(poses.t)):
        f = 6 * poses.column[i]
        if f < 0:
            continue
        for a in range(3):
            for b in range(3):
                g[f + a] += poses.R[i, b, a] * (poses.t[i, b] - poses.t[held, b])
            size += g[f + a] * g[f + a]
    if not size > 0.0:
        return
    for a in range(len(S)):
        trace += S[a, a]
    for a in range(len(S)):
        for b in range(a + 1):
            S[a, b] += trace / size * g[a] * g[b]


@kernel
def _solve_kernel(
    poses: PoseArrays,
    points: Array,
    cameras: CameraArrays,
    seen: SightArrays,
    limits: tuple[float, int, float, bool],
    chi2: Array,
    joint: Array,
    response: Array,
    evidence: Array,
    costs: Array,
) -> tuple[int, int]:
    """Levenberg-Marquardt, poses and points in place; returns steps tried and a reason's index."""
    width, iterations, tolerance, is_scale_free = limits
    size = len(joint)
    system = SystemArrays(
        np.empty((size, size)),
        np.empty(size),
        np.empty((len(seen.pose), 6, 3)),
        np.empty((len(points), 3, 3)),
        np.empty((len(points), 3)),
        np.empty((len(seen.pose), 3)),
        np.empty((len(seen.pose), 3, 6)),
        np.empty((len(seen.pose), 3, 3)),
    )
    moved = np.empty_like(points)
    trial_poses = PoseArrays(np.empty_like(poses.R), np.empty_like(poses.t), poses.column)
    cost = robust_cost(poses, points, cameras, seen, width, chi2)
    costs[0] = cost
    damping, grow = 1e-5, 4.0
    reason, tried = 0, 0
    while tried < iterations:
        tried += 1
        reduced_system(poses, points, cameras, seen, width, damping, system)
        if is_scale_free:
            _hold_scale(poses, system.S)
        trial = np.inf
        if factor(system.S):
            for a in range(size):
                system.s[a] = -system.s[a]
            solve(system.S, system.s)
            _retract(poses, system.s, trial_poses.R, trial_poses.t)
            back_substitute(poses, seen, system, points, moved)
            trial = robust_cost(trial_poses, moved, cameras, seen, width, chi2)
        if trial < cost:
            _take_step(poses, points, trial_poses, moved)
            small = cost - trial < tolerance * cost
            cost, damping, grow = trial, max(0.2 * damping, 1e-9), 4.0
            if small:
                reason = 1
                break
        else:
            if damping > 1e6:
                reason = 2
                break
            damping, grow = max(damping, 1e-5) * grow, 2.0 * grow
    costs[1] = robust_cost(poses, points, cameras, seen, width, chi2)
    reduced_system(poses, points, cameras, seen, width, 0.0, system)
    if is_scale_free:
        _hold_scale(poses, system.S)
    if factor(system.S):
        invert(system.S, joint)
        disparity_response(poses, seen, width, system, response, evidence)
        pulls = response.copy()
        for e in range(3):
            for a in range(size):
                response[e, a] = -response[e, a]
            solve(system.S, response[e])
            for d in range(3):
                for a in range(size):
                    evidence[1 + d, e] += pulls[d, a] * response[e, a]
    else:
        reason = 3
    return tried, reason


def warm_up() -> None:
    """Compile the kernels of this module."""
    Ts = np.tile(np.eye(4), (2, 1, 1))
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, -1, 3], [1, 1, 5], (10, 3))
    pose, point = np.repeat([0, 1], 10), np.tile(np.arange(10), 2)
    xy = points[point, :2] / points[point, 2:]
    bundle = Bundle(
        Ts,
        np.array([True, False]),
        points,
        np.eye(4)[None],
        np.array([0.1]),
        pose,
        point,
        np.zeros(20, np.int64),
        xy,
        0.1 / points[point, 2],
        np.full((20, 2), 400.0),
    )
    solve_bundle(bundle)
