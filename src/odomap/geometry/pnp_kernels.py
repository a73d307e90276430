"""Compiled pose from points: scoring, refinement, and the search over samples.

The problem: RANSAC tries a hundred poses per frame on a thousand points. In one kernel a residual
costs 10 ns, so that the whole search fits into a frame, and the GIL is free meanwhile.

Residuals are in pixels: projection minus observation on the plane z = 1, times the 2x2 slope of the
lens at the observation (to first order the raw pixel error, without its fold). The refinement
minimises Σ w ρ(|r|²) over T_world_camera ⊞ ξ with Huber's ρ; with projection (u, v), depth z,

    ∂(u, v)/∂ξ = [-1/z   0   u/z   uv    -(1+u²)   v]
                 [ 0   -1/z  v/z  1+v²    -uv     -u]

A search stops when a clean sample was drawn with the wanted confidence; each new best pose is first
refined on its inliers. O(samples · N).

Reference: O. Chum, J. Matas, J. Kittler, "Locally optimized RANSAC", DAGM 2003.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie_kernels import se3_inverse_into, se3_retract
from odomap.geometry.p3p_kernels import p3p_into
from odomap.kernels import kernel

__all__ = [
    "cholesky_solve",
    "gather_pose",
    "refine_pose_into",
    "score_pose",
    "search_pose",
    "warm_up",
]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_BEHIND = 1e6
"""Cost of a point behind the camera: a step that puts one there is refused."""


@kernel
def score_pose(
    R: Array,
    t: Array,
    points: Array,
    plane: Array,
    slopes: Array,
    threshold2: float,
    inliers: Bools,
) -> float:
    """Σ min(|r|², τ²) over all points of p_camera = R p + t; marks |r|² ≤ τ² in `inliers`."""
    cost = 0.0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        pz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
        inliers[i] = False
        if pz > 1e-9:
            u = (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]) / pz - plane[i, 0]
            v = (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]) / pz - plane[i, 1]
            e = slopes[i, 0, 0] * u + slopes[i, 0, 1] * v
            f = slopes[i, 1, 0] * u + slopes[i, 1, 1] * v
            r2 = e * e + f * f
            if r2 <= threshold2:
                inliers[i] = True
                cost += r2
                continue
        cost += threshold2
    return cost


@kernel
def gather_pose(
    R: Array,
    t: Array,
    points: Array,
    plane: Array,
    slopes: Array,
    weights: Array,
    huber: float,
    H: Array,
    g: Array,
) -> float:
    """H = Σ w ρ' JᵀJ, g = Σ w ρ' Jᵀr; returns Σ ρ(w |r|²). R, t are T_world_camera.

    w = 1/σ²; `huber` in standard deviations.
    """
    for p in range(6):
        g[p] = 0.0
        for q in range(6):
            H[p, q] = 0.0
    J, r = np.zeros((2, 6)), np.zeros(2)
    cost = 0.0
    for i in range(points.shape[0]):
        if weights[i] == 0.0:
            continue
        dx, dy, dz = points[i, 0] - t[0], points[i, 1] - t[1], points[i, 2] - t[2]
        z = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
        if z < 1e-9:
            cost += _BEHIND
            continue
        u = (R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz) / z
        v = (R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz) / z
        for k in range(2):
            a, b = slopes[i, k, 0], slopes[i, k, 1]
            r[k] = a * (u - plane[i, 0]) + b * (v - plane[i, 1])
            J[k, 0] = -a / z
            J[k, 1] = -b / z
            J[k, 2] = (a * u + b * v) / z
            J[k, 3] = a * u * v + b * (1.0 + v * v)
            J[k, 4] = -a * (1.0 + u * u) - b * u * v
            J[k, 5] = a * v - b * u
        s = weights[i] * (r[0] * r[0] + r[1] * r[1])
        w = weights[i]
        if s <= huber * huber:
            cost += s
        else:
            cost += 2.0 * huber * np.sqrt(s) - huber * huber
            w *= huber / np.sqrt(s)
        for p in range(6):
            g[p] += w * (J[0, p] * r[0] + J[1, p] * r[1])
            for q in range(p + 1):
                H[p, q] += w * (J[0, p] * J[0, q] + J[1, p] * J[1, q])
    for p in range(6):
        for q in range(p):
            H[q, p] = H[p, q]
    return cost


@kernel
def cholesky_solve(A: Array, b: Array, x: Array) -> bool:
    """x = A⁻¹ b for a symmetric positive matrix, destroying A; False if it is not positive."""
    n = A.shape[0]
    for j in range(n):
        s = A[j, j]
        for k in range(j):
            s -= A[j, k] * A[j, k]
        if not s > 1e-14 * abs(A[j, j]):
            return False
        A[j, j] = np.sqrt(s)
        for i in range(j + 1, n):
            s = A[i, j]
            for k in range(j):
                s -= A[i, k] * A[j, k]
            A[i, j] = s / A[j, j]
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= A[i, k] * x[k]
        x[i] = s / A[i, i]
    for i in range(n - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, n):
            s -= A[k, i] * x[k]
        x[i] = s / A[i, i]
    return True


@kernel
def _copy_pose(R: Array, t: Array, R_out: Array, t_out: Array) -> None:
    """(R_out, t_out) = (R, t). Whole-array assignment would take seconds to compile."""
    for i in range(3):
        t_out[i] = t[i]
        for j in range(3):
            R_out[i, j] = R[i, j]


@kernel
def _copy_marks(marks: Bools, out: Bools) -> int:
    """out = marks; returns how many are set."""
    count = 0
    for i in range(marks.shape[0]):
        out[i] = marks[i]
        if marks[i]:
            count += 1
    return count


@kernel
def refine_pose_into(
    R: Array,
    t: Array,
    points: Array,
    plane: Array,
    slopes: Array,
    weights: Array,
    huber: float,
    max_iterations: int,
    H: Array,
) -> tuple[float, int, bool]:
    """Levenberg-Marquardt on T_world_camera = (R, t), in place.

    (H + λ diag H) ξ = -g; steps that raise the cost are refused. Returns the cost, the iterations
    and whether nothing was left to gain; H is the information at the solution.
    """
    g, step, A, g_new = np.zeros(6), np.zeros(6), np.zeros((6, 6)), np.zeros(6)
    R_new, t_new, H_new = np.empty((3, 3)), np.empty(3), np.zeros((6, 6))
    cost = gather_pose(R, t, points, plane, slopes, weights, huber, H, g)
    damping, raise_by = 1e-5, 4.0
    for iteration in range(max_iterations):
        for p in range(6):
            for q in range(6):
                A[p, q] = H[p, q]
            A[p, p] += damping * H[p, p]
            g_new[p] = -g[p]
        if not cholesky_solve(A, g_new, step):
            return cost, iteration, False
        se3_retract(R, t, step, R_new, t_new)
        new = gather_pose(R_new, t_new, points, plane, slopes, weights, huber, H_new, g_new)
        promised, size = 0.0, 0.0
        for p in range(6):
            promised -= step[p] * (2.0 * g[p] + H[p, p] * step[p])
            for q in range(p):
                promised -= 2.0 * step[p] * H[p, q] * step[q]
            size = max(size, abs(step[p]))
        if new <= cost:
            gained = cost - new
            _copy_pose(R_new, t_new, R, t)
            for p in range(6):
                g[p] = g_new[p]
                for q in range(6):
                    H[p, q] = H_new[p, q]
            cost = new
            damping, raise_by = max(0.1 * damping, 1e-12), 4.0
            if gained <= 1e-10 * cost or size < 1e-11:
                return cost, iteration + 1, True
        elif promised <= 1e-10 * cost or size < 1e-11:
            return cost, iteration + 1, True
        else:
            damping, raise_by = damping * raise_by, 2.0 * raise_by
    return cost, max_iterations, False


@kernel
def search_pose(
    samples: NDArray[np.int64],
    points: Array,
    rays: Array,
    plane: Array,
    slopes: Array,
    threshold2: float,
    confidence: float,
    local_steps: int,
    R_best: Array,
    t_best: Array,
    inliers: Bools,
) -> int:
    """RANSAC over the rows of `samples` (S, 3): the T_world_camera of least Σ min(|r|², τ²).

    Each new best pose makes `local_steps` refining steps on its inliers, twice at most. Stops after
    log(1 - confidence) / log(1 - p³) samples, p the share of inliers. Returns how many samples were
    tried; `inliers` belongs to the best pose, none if there was no pose.
    """
    n = points.shape[0]
    Rs, ts, y, x = np.empty((4, 3, 3)), np.empty((4, 3)), np.empty((3, 3)), np.empty((3, 3))
    R, t, R_cw, t_cw = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    H, weights, marks = np.zeros((6, 6)), np.zeros(n), np.zeros(n, dtype=np.bool_)
    for i in range(n):
        inliers[i] = False
    best, needed = n * threshold2, samples.shape[0]
    for trial in range(samples.shape[0]):
        if trial >= needed:
            return trial
        for k in range(3):
            for i in range(3):
                y[k, i], x[k, i] = rays[samples[trial, k], i], points[samples[trial, k], i]
        for c in range(p3p_into(y, x, Rs, ts)):
            cost = score_pose(Rs[c], ts[c], points, plane, slopes, threshold2, marks)
            if not cost < best:
                continue
            best = cost
            _copy_marks(marks, inliers)
            se3_inverse_into(Rs[c], ts[c], R_best, t_best)
            # Local optimisation: a minimal pose carries the noise of its three points.
            _copy_pose(R_best, t_best, R, t)
            for _ in range(2):
                for i in range(n):
                    weights[i] = 1.0 if marks[i] else 0.0
                refine_pose_into(R, t, points, plane, slopes, weights, 1e9, local_steps, H)
                se3_inverse_into(R, t, R_cw, t_cw)
                cost = score_pose(R_cw, t_cw, points, plane, slopes, threshold2, marks)
                if not cost < best:
                    break
                best = cost
                _copy_marks(marks, inliers)
                _copy_pose(R, t, R_best, t_best)
            clean = (_copy_marks(inliers, inliers) / n) ** 3
            if clean >= 1.0:
                return trial + 1
            if clean > 1e-12:
                needed = min(needed, int(np.log(1.0 - confidence) / np.log1p(-clean)) + 1)
    return int(samples.shape[0])


def warm_up() -> None:
    """Compile the kernels of this file."""
    points = np.array([[0.0, 0.0, 2.0], [1.0, 0.0, 2.0], [0.0, 1.0, 3.0], [1.0, 1.0, 2.5]])
    plane = np.ascontiguousarray(points[:, :2] / points[:, 2:])
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    slopes = np.tile(np.eye(2), (4, 1, 1))
    samples, inliers = np.array([[0, 1, 2]]), np.zeros(4, dtype=np.bool_)
    R, t, H, g = np.eye(3), np.zeros(3), np.zeros((6, 6)), np.zeros(6)
    data, weights = (points, plane, slopes), np.ones(4)
    score_pose(R, t, *data, 1e-4, inliers)
    gather_pose(R, t, *data, weights, 1.0, H, g)
    cholesky_solve(np.eye(6), g, np.zeros(6))
    search_pose(samples, points, rays, plane, slopes, 1e-4, 0.99, 4, R, t, inliers)
    refine_pose_into(R, t, *data, weights, 1.0, 2, H)
