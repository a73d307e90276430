"""Bundle adjustment of a calibration: lenses, mounts and board poses at once.

The problem: with the corners q_n of a board known, find the lenses θ_c, the place of the second
camera and a pose per view that minimise

    ½ Σ_cvn ρ( |π(θ_c, T_c_first T_v q_n) - x_cvn|² / σ² ),    T_v = T_first_board of view v.

Views do not know each other: the normal matrix is an arrow, a dense corner A for what all views
share (10 to 30 numbers), a block C_v of 6 x 6 per view, and B_v between the two. Each step solves

    (A - Σ B_v C_v⁻¹ B_vᵀ) δ = -(a - Σ B_v C_v⁻¹ c_v),    ξ_v = -C_v⁻¹ (c_v + B_vᵀ δ),

damped as Levenberg and Marquardt do. The inverse of the corner is the covariance of the lenses with
all poses unknown. Derivatives by points come from `Camera.project_jacobian`, those by fx fy cx cy
are the distorted plane itself, those by the coefficients of any lens central differences.
O(V N) per step: 100 views take some milliseconds.

Reference: B. Triggs, P. McLauchlan, R. Hartley, A. Fitzgibbon, "Bundle adjustment: a modern
synthesis", 1999.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError
from odomap.geometry.camera import MODELS, Camera
from odomap.geometry.lie import hat, se3_exp, se3_inverse
from odomap.geometry.robust import huber_cost, huber_weight

__all__ = ["ArrowProblem", "ArrowSolution", "ArrowState", "residuals", "solve_arrow"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

LOST_PX2 = 1e6
"""Squared error of a corner where the lens sees nothing: no step there may look like progress."""


@dataclass(frozen=True)
class ArrowProblem:
    """What is seen.

    Attributes:
        points_board: (N, 3) corners, metres.
        pixels: (C, V, N, 2), NaN where camera c does not see the board in view v.
        sigma_px: standard deviation of a corner's coordinate.
        huber: width of the loss, standard deviations.
    """

    points_board: Array
    pixels: Array
    sigma_px: float = 1.0
    huber: float = 2.5


@dataclass(frozen=True)
class ArrowState:
    """What is to be found.

    Attributes:
        cameras: one lens per camera.
        Ts_first_camera: (C, 4, 4), the first one the identity.
        Ts_first_board: (V, 4, 4).
    """

    cameras: tuple[Camera, ...]
    Ts_first_camera: Array
    Ts_first_board: Array


@dataclass(frozen=True)
class ArrowSolution:
    """Where the iteration ended.

    Attributes:
        state: the solution.
        covariance: of what all views share: fx fy cx cy and coefficients of each camera, then the
            tangent of T_first_second, for σ as given.
        cost: ½ Σ ρ.
        iterations: systems solved.
        converged: whether the cost no longer fell.
    """

    state: ArrowState
    covariance: Array
    cost: float
    iterations: int
    converged: bool


@dataclass(frozen=True)
class _Normal:
    """The problem linearised: the arrow and its gradient."""

    cost: float
    A: Array
    a: Array
    B: Array
    C: Array
    c: Array


def solve_arrow(
    problem: ArrowProblem, start: ArrowState, max_iterations: int = 100, tolerance: float = 1e-9
) -> ArrowSolution:
    """Minimise by damped steps that never raise the cost.

    Args:
        problem: what is seen; views that nobody sees keep their pose.
        start: the start.
        max_iterations: systems to solve at most.
        tolerance: stop when the cost falls by a smaller fraction.

    Returns:
        The solution and its covariance.
    """
    live = np.isfinite(problem.pixels[:, :, 0, 0]).any(axis=0)
    if not live.all():
        part = replace(problem, pixels=problem.pixels[:, live])
        begun = replace(start, Ts_first_board=start.Ts_first_board[live])
        found = solve_arrow(part, begun, max_iterations, tolerance)
        Ts = start.Ts_first_board.copy()
        Ts[live] = found.state.Ts_first_board
        return replace(found, state=replace(found.state, Ts_first_board=Ts))
    state, now = start, _linearise(problem, start)
    damping, raise_by = 1e-4, 2.0
    for iteration in range(1, max_iterations + 1):
        step = _step(now, damping)
        moved = None if step is None else _moved(state, *step[:2])
        predicted = 0.0 if step is None else step[2]
        gained = -np.inf if moved is None else now.cost - _cost(problem, moved)
        if moved is not None and gained >= 0.0:
            state, now = moved, _linearise(problem, moved)
            share = gained / max(predicted, 1e-300)
            damping *= max(1.0 / 3.0, 1.0 - (2.0 * share - 1.0) ** 3)
            damping, raise_by = max(damping, 1e-12), 2.0
        else:
            damping, raise_by = damping * raise_by, 2.0 * raise_by
        # A refused step that promised less than rounding can deliver also means the minimum.
        promised = gained if gained >= 0.0 else predicted
        if moved is not None and promised <= tolerance * now.cost:
            return ArrowSolution(state, _covariance(now), now.cost, iteration, True)
        if damping > 1e10:
            break
    return ArrowSolution(state, _covariance(now), now.cost, iteration, False)


def residuals(problem: ArrowProblem, state: ArrowState) -> Array:
    """Return the reprojection errors (C, V, N, 2) in pixels, NaN where nothing is seen."""
    out = np.full(problem.pixels.shape, np.nan)
    for c, camera in enumerate(state.cameras):
        views, _, points = _points(problem, state, c)
        out[c, views] = camera.project(points.reshape(-1, 3)).reshape(*points.shape[:2], 2)
    return np.asarray(out - problem.pixels)


def _points(problem: ArrowProblem, state: ArrowState, c: int) -> tuple[Index, Array, Array]:
    """Return the views of camera c, T_camera_board (K, 4, 4), and corners (K, N, 3) in its axes."""
    views = np.flatnonzero(np.isfinite(problem.pixels[c, :, 0, 0]))
    Ts = se3_inverse(state.Ts_first_camera[c]) @ state.Ts_first_board[views]
    points = problem.points_board @ np.swapaxes(Ts[:, :3, :3], 1, 2) + Ts[:, None, :3, 3]
    return views, Ts, points


def _chi2(problem: ArrowProblem, c: int, views: Index, uv: Array) -> tuple[Array, Array, Mask]:
    """Return r / σ (K, N, 2), its squared length (K, N), and where the lens sees nothing."""
    r = (uv - problem.pixels[c, views]) / problem.sigma_px
    lost = ~np.isfinite(r).all(axis=2)
    r[lost] = 0.0
    chi2 = np.where(lost, LOST_PX2 / problem.sigma_px**2, np.sum(r * r, axis=2))
    return r, chi2, lost


def _cost(problem: ArrowProblem, state: ArrowState) -> float:
    total = 0.0
    for c, camera in enumerate(state.cameras):
        views, _, points = _points(problem, state, c)
        uv = camera.project(points.reshape(-1, 3)).reshape(*points.shape[:2], 2)
        total += 0.5 * float(np.sum(huber_cost(_chi2(problem, c, views, uv)[1], problem.huber)))
    return total if np.isfinite(total) else np.inf


def _linearise(problem: ArrowProblem, state: ArrowState) -> _Normal:
    shared = sum(map(_size, state.cameras)) + 6 * (len(state.cameras) - 1)
    count = problem.pixels.shape[1]
    A, a, cost = np.zeros((shared, shared)), np.zeros(shared), 0.0
    B, C, b = np.zeros((count, shared, 6)), np.zeros((count, 6, 6)), np.zeros((count, 6))
    for c in range(len(state.cameras)):
        views, part, e, J, P = _rows_of(problem, state, c, shared)
        cost += part
        Jt, Pt = np.swapaxes(J, 1, 2), np.swapaxes(P, 1, 2)
        A += np.sum(Jt @ J, axis=0)
        a += np.sum(Jt @ e, axis=0)[:, 0]
        B[views] += Jt @ P
        C[views] += Pt @ P
        b[views] += (Pt @ e)[:, :, 0]
    return _Normal(cost, A, a, B, C, b)


def _rows_of(
    problem: ArrowProblem, state: ArrowState, c: int, shared: int
) -> tuple[Index, float, Array, Array, Array]:
    """Linearise what camera c sees, weights and σ applied.

    Returns:
        Its views (K,), its cost, residuals (K, 2N, 1), their derivatives by what is shared
        (K, 2N, G) and by the pose of the view (K, 2N, 6).
    """
    camera = state.cameras[c]
    views, Ts, points = _points(problem, state, c)
    k, n = points.shape[:2]
    flat = points.reshape(-1, 3)
    uv = camera.project(flat)
    r, chi2, lost = _chi2(problem, c, views, uv.reshape(k, n, 2))
    root = np.where(lost, 0.0, np.sqrt(huber_weight(chi2, problem.huber)))[:, :, None, None]
    scale = root / problem.sigma_px
    by_point = np.nan_to_num(camera.project_jacobian(flat)).reshape(k, n, 2, 3) * scale
    J = np.zeros((k, n, 2, shared))
    at = sum(map(_size, state.cameras[:c]))
    by_lens = np.nan_to_num(_by_lens(camera, flat, uv)).reshape(k, n, 2, -1)
    J[:, :, :, at : at + _size(camera)] = by_lens * scale
    if c > 0:
        # exp(-ζ) T⁻¹ p: the tangent of T_first_camera moves its points the other way.
        at = shared - 6 * (len(state.cameras) - c)
        J[:, :, :, at : at + 3] = -by_point
        J[:, :, :, at + 3 : at + 6] = by_point @ hat(points)
    turned = by_point @ Ts[:, None, :3, :3]
    P = np.concatenate([turned, -turned @ hat(problem.points_board)], axis=3)
    cost = 0.5 * float(np.sum(huber_cost(chi2, problem.huber)))
    e = (r * root[:, :, :, 0]).reshape(k, 2 * n, 1)
    return views, cost, e, J.reshape(k, 2 * n, shared), P.reshape(k, 2 * n, 6)


def _size(camera: Camera) -> int:
    return 4 + len(camera.distortion)


def _by_lens(camera: Camera, points: Array, uv: Array) -> Array:
    """Return the derivative of pixels by fx fy cx cy and the coefficients, (N, 2, 4 + n)."""
    out = np.zeros((len(points), 2, _size(camera)))
    plane = (uv - camera.intrinsics[2:]) / camera.intrinsics[:2]
    out[:, 0, 0], out[:, 1, 1] = plane[:, 0], plane[:, 1]
    out[:, 0, 2] = out[:, 1, 3] = 1.0
    lens, step = MODELS[camera.model], 1e-6
    # Reach is that of the lens as it is: a derivative does not ask where the model ends.
    reach = lens.reach(camera.distortion)
    for k, unit in enumerate(np.eye(len(camera.distortion))):
        ends = [lens.to_plane(points, camera.distortion + h * unit, reach) for h in (step, -step)]
        out[:, :, 4 + k] = (ends[0] - ends[1]) / (2 * step) * camera.intrinsics[:2]
    return out


def _step(now: _Normal, damping: float) -> tuple[Array, Array, float] | None:
    """Return δ, ξ (V, 6) and the predicted fall of the cost; None where the system is singular."""
    A, C = now.A.copy(), now.C.copy()
    scale_A = np.maximum(np.diag(A), 1e-12)
    scale_C = np.maximum(np.diagonal(C, axis1=1, axis2=2), 1e-12)
    A[np.diag_indices(len(A))] += damping * scale_A
    diagonal = np.arange(6)
    C[:, diagonal, diagonal] += damping * scale_C
    try:
        S, s, CB, Cc = _eliminated(A, now.a, now.B, C, now.c)
        L = np.linalg.cholesky(S)
        delta = -np.linalg.solve(L.T, np.linalg.solve(L, s))
    except np.linalg.LinAlgError:
        return None
    xi = -Cc - CB @ delta
    fall = float(delta @ (damping * scale_A * delta - now.a))
    fall += float(np.sum(xi * (damping * scale_C * xi - now.c)))
    if not (np.all(np.isfinite(delta)) and np.all(np.isfinite(xi))):
        return None
    return delta, xi, 0.5 * fall


def _eliminated(
    A: Array, a: Array, B: Array, C: Array, c: Array
) -> tuple[Array, Array, Array, Array]:
    """Return S = A - Σ B C⁻¹ Bᵀ, s = a - Σ B C⁻¹ c, C⁻¹ Bᵀ (V, 6, G) and C⁻¹ c (V, 6)."""
    inverse = np.linalg.inv(C)
    CB = inverse @ np.swapaxes(B, 1, 2)
    Cc = (inverse @ c[:, :, None])[:, :, 0]
    S = A - np.sum(B @ CB, axis=0)
    s = a - np.einsum("vgk,vk->g", B, Cc)
    return 0.5 * (S + S.T), s, CB, Cc


def _moved(state: ArrowState, delta: Array, xi: Array) -> ArrowState | None:
    """Return the state after a step, or None where no lens has the new numbers."""
    cameras, at = [], 0
    for camera in state.cameras:
        size = _size(camera)
        numbers = np.concatenate([camera.intrinsics, camera.distortion]) + delta[at : at + size]
        at += size
        try:
            cameras.append(replace(camera, intrinsics=numbers[:4], distortion=numbers[4:]))
        except CalibrationError:
            return None
    mounts = state.Ts_first_camera.copy()
    mounts[1:] = mounts[1:] @ se3_exp(delta[at:].reshape(-1, 6))
    return ArrowState(tuple(cameras), mounts, state.Ts_first_board @ se3_exp(xi))


def _covariance(now: _Normal) -> Array:
    """Return the inverse of the eliminated corner; very large in directions nothing holds."""
    C = now.C + 1e-12 * np.eye(6) * np.trace(now.C, axis1=1, axis2=2)[:, None, None]
    S = _eliminated(now.A, now.a, now.B, C, now.c)[0]
    # Unit diagonal of A: pixels, coefficients and metres differ by orders of magnitude.
    d = np.sqrt(np.maximum(np.diag(now.A), 1e-300))
    values, vectors = np.linalg.eigh(S / np.outer(d, d))
    return np.asarray((vectors / np.maximum(values, 1e-15)) @ vectors.T / np.outer(d, d))
