"""Compiled alignment of two cameras by points that both know.

Points p of one camera and q of the other are one point each of the world, q ≈ s R p + t, seen at x
in the one image and at y in the other, on the plane z = 1. Both sides count,

    e = x - π(Rᵀ (q - t) / s),     f = y - π(s R p + t),

each with a weight (inverse variance) of its own; where a point is known or seen by one side only,
the other half has weight 0. Two cameras in one place say nothing of s by that: where the scale is
sought, depths count as well, log q_z - log (s R p + t)_z. For (R, t, s) ⊞ (ρ, φ, λ) =
(R exp φ, t + R ρ, s e^λ) points move by

    d(s R p + t) = R (ρ - s p^ φ + s λ p),     dz = -ρ/s + z^ φ - λ z   at z = Rᵀ (q - t) / s.

A search fits three pairs (`horn_kernels`), and stops when a clean sample was drawn with the wanted
confidence. O(samples · N), no allocation per sample.

Reference: O. Chum, J. Matas, J. Kittler, "Locally optimized RANSAC", DAGM 2003.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.horn_kernels import horn_into
from odomap.geometry.lie_kernels import so3_exp_into, so3_orthonormalize_into
from odomap.geometry.pnp_kernels import cholesky_solve
from odomap.kernels import kernel

__all__ = [
    "gather_alignment",
    "refine_alignment_into",
    "score_alignment",
    "search_alignment",
    "warm_up",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bools = NDArray[np.bool_]

_NEAREST = 1e-9
"""Depth below which a point is not in front of a camera."""
LEAST_STEP = 0.01
"""Steps smaller than this, in standard deviations of the alignment, change nothing that matters."""
_BEHIND = 1e6
"""Cost of a point behind a camera: a step that puts one there is refused."""


@kernel
def score_alignment(
    R: Array,
    t: Array,
    s: float,
    p: Array,
    x: Array,
    wx: Array,
    q: Array,
    y: Array,
    wy: Array,
    gate: float,
    inliers: Bools,
) -> float:
    """Σ min(r², g), r² the larger of wx |e|² and wy |f|²; marks r² ≤ g in `inliers`."""
    cost = 0.0
    for i in range(len(p)):
        r2 = 0.0
        if wx[i] > 0.0:
            a, b, c = q[i, 0] - t[0], q[i, 1] - t[1], q[i, 2] - t[2]
            z = R[0, 2] * a + R[1, 2] * b + R[2, 2] * c
            if z > _NEAREST:
                u = (R[0, 0] * a + R[1, 0] * b + R[2, 0] * c) / z - x[i, 0]
                v = (R[0, 1] * a + R[1, 1] * b + R[2, 1] * c) / z - x[i, 1]
                r2 = wx[i] * (u * u + v * v)
            else:
                r2 = np.inf
        if wy[i] > 0.0:
            a, b, c = p[i, 0], p[i, 1], p[i, 2]
            z = s * (R[2, 0] * a + R[2, 1] * b + R[2, 2] * c) + t[2]
            if z > _NEAREST:
                u = (s * (R[0, 0] * a + R[0, 1] * b + R[0, 2] * c) + t[0]) / z - y[i, 0]
                v = (s * (R[1, 0] * a + R[1, 1] * b + R[1, 2] * c) + t[1]) / z - y[i, 1]
                r2 = max(r2, wy[i] * (u * u + v * v))
            else:
                r2 = np.inf
        inliers[i] = r2 <= gate
        cost += min(r2, gate)
    return cost


@kernel
def search_alignment(
    samples: Index,
    p: Array,
    x: Array,
    wx: Array,
    q: Array,
    y: Array,
    wy: Array,
    gate: float,
    confidence: float,
    with_scale: bool,
    R_best: Array,
    t_best: Array,
    inliers: Bools,
) -> tuple[float, int]:
    """RANSAC over the rows of `samples` (S, 3): the alignment of least Σ min(r², g).

    Each new best one is fitted anew to its inliers, while that helps. Returns its scale, 0 if there
    was none, and how many samples were tried.
    """
    n = len(p)
    A, V, R, t = np.empty((4, 4)), np.empty((4, 4)), np.empty((3, 3)), np.empty(3)
    marks, rows = np.zeros(n, np.bool_), np.empty(n, np.int64)
    best, scale, needed = n * gate, 0.0, len(samples)
    for trial in range(len(samples)):
        if trial >= needed:
            return scale, trial
        chosen = samples[trial]
        for _ in range(4):
            s = horn_into(p, q, chosen, with_scale, R, t, A, V)
            if not s > 0.0:
                break
            cost = score_alignment(R, t, s, p, x, wx, q, y, wy, gate, marks)
            if not cost < best:
                break
            best, scale, count = cost, s, 0
            for i in range(3):
                t_best[i] = t[i]
                for j in range(3):
                    R_best[i, j] = R[i, j]
            for i in range(n):
                inliers[i] = marks[i]
                if marks[i]:
                    rows[count] = i
                    count += 1
            clean = (count / n) ** 3
            if clean >= 1.0:
                needed = 0
            elif clean > 1e-12:
                needed = min(needed, int(np.log(1.0 - confidence) / np.log1p(-clean)) + 1)
            if count < 4:
                break
            chosen = rows[:count]
    return scale, len(samples)


@kernel
def gather_alignment(
    R: Array,
    t: Array,
    s: float,
    p: Array,
    x: Array,
    wx: Array,
    q: Array,
    y: Array,
    wy: Array,
    wd: Array,
    huber: float,
    with_scale: bool,
    H: Array,
    g: Array,
    M: Array,
) -> float:
    """H = Σ w ρ' JᵀJ, g = Σ g_i with g_i = Σ w ρ' Jᵀr of a pair, M = Σ g_i g_iᵀ; returns Σ ρ.

    `wd` are inverse variances of log depths, 0 for none. (7, 7), (7,), (7, 7); without scale the
    last row is that of the identity.
    """
    J, r, one, weight = np.zeros((2, 7)), np.zeros(2), np.zeros(7), np.zeros(2)
    for a in range(7):
        g[a] = 0.0
        for b in range(7):
            H[a, b], M[a, b] = 0.0, 0.0
    d = 7 if with_scale else 6
    cost = 0.0
    D = np.zeros((3, 7))
    for i in range(len(p)):
        weight[0], weight[1] = wx[i], wy[i]
        for a in range(7):
            one[a] = 0.0
        for half in range(2):
            w = weight[half]
            if not w > 0.0:
                continue
            if half == 0:
                a, b, c = q[i, 0] - t[0], q[i, 1] - t[1], q[i, 2] - t[2]
                X = (R[0, 0] * a + R[1, 0] * b + R[2, 0] * c) / s
                Y = (R[0, 1] * a + R[1, 1] * b + R[2, 1] * c) / s
                Z = (R[0, 2] * a + R[1, 2] * b + R[2, 2] * c) / s
            else:
                a, b, c = s * p[i, 0], s * p[i, 1], s * p[i, 2]
                X = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + t[0]
                Y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + t[1]
                Z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + t[2]
            if not Z > _NEAREST:
                cost += _BEHIND
                continue
            if half == 0:
                D[0, 0], D[0, 3], D[0, 4], D[0, 5], D[0, 6] = -1.0 / s, 0.0, -Z, Y, -X
                D[1, 1], D[1, 3], D[1, 4], D[1, 5], D[1, 6] = -1.0 / s, Z, 0.0, -X, -Y
                D[2, 2], D[2, 3], D[2, 4], D[2, 5], D[2, 6] = -1.0 / s, -Y, X, 0.0, -Z
                D[0, 1], D[0, 2], D[1, 0], D[1, 2], D[2, 0], D[2, 1] = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            else:
                for k in range(3):
                    D[k, 0], D[k, 1], D[k, 2] = R[k, 0], R[k, 1], R[k, 2]
                    D[k, 3] = R[k, 2] * b - R[k, 1] * c
                    D[k, 4] = R[k, 0] * c - R[k, 2] * a
                    D[k, 5] = R[k, 1] * a - R[k, 0] * b
                    D[k, 6] = R[k, 0] * a + R[k, 1] * b + R[k, 2] * c
            u, v = X / Z, Y / Z
            r[0] = u - (x[i, 0] if half == 0 else y[i, 0])
            r[1] = v - (x[i, 1] if half == 0 else y[i, 1])
            for k in range(d):
                J[0, k] = (D[0, k] - u * D[2, k]) / Z
                J[1, k] = (D[1, k] - v * D[2, k]) / Z
            r2 = w * (r[0] * r[0] + r[1] * r[1])
            if r2 <= huber * huber:
                cost += r2
            else:
                cost += 2.0 * huber * np.sqrt(r2) - huber * huber
                w *= huber / np.sqrt(r2)
            for k in range(d):
                one[k] += w * (J[0, k] * r[0] + J[1, k] * r[1])
                for m in range(k + 1):
                    H[k, m] += w * (J[0, k] * J[0, m] + J[1, k] * J[1, m])
            if half == 0 or not wd[i] > 0.0:
                continue
            deeper, w = np.log(Z / q[i, 2]), wd[i]
            r2 = w * deeper * deeper
            if r2 <= huber * huber:
                cost += r2
            else:
                cost += 2.0 * huber * np.sqrt(r2) - huber * huber
                w *= huber / np.sqrt(r2)
            w /= Z
            for k in range(d):
                one[k] += w * D[2, k] * deeper
                for m in range(k + 1):
                    H[k, m] += w / Z * D[2, k] * D[2, m]
        for k in range(d):
            g[k] += one[k]
            for m in range(d):
                M[k, m] += one[k] * one[m]
    for k in range(7):
        for m in range(k):
            H[m, k] = H[k, m]
    if not with_scale:
        H[6, 6] = 1.0
    return cost


@kernel
def refine_alignment_into(
    R: Array,
    t: Array,
    s: float,
    p: Array,
    x: Array,
    wx: Array,
    q: Array,
    y: Array,
    wy: Array,
    wd: Array,
    huber: float,
    with_scale: bool,
    max_iterations: int,
    H: Array,
    M: Array,
) -> tuple[float, float, bool]:
    """Levenberg-Marquardt on (R, t, s), R and t in place: (H + λ diag H) ξ = -g.

    Returns the scale, the cost and whether nothing was left to gain; H and M are those at the end.
    """
    g, step, A, h = np.zeros(7), np.zeros(7), np.zeros((7, 7)), np.zeros(7)
    R_new, t_new, E = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    H_new, M_new = np.zeros((7, 7)), np.zeros((7, 7))
    cost = gather_alignment(R, t, s, p, x, wx, q, y, wy, wd, huber, with_scale, H, g, M)
    damping, raise_by = 1e-5, 4.0
    for _ in range(max_iterations):
        for a in range(7):
            for b in range(7):
                A[a, b] = H[a, b]
            A[a, a] += damping * H[a, a]
            h[a] = -g[a]
        if not cholesky_solve(A, h, step):
            return s, cost, False
        so3_exp_into(step[3:6], E)
        for a in range(3):
            t_new[a] = t[a] + R[a, 0] * step[0] + R[a, 1] * step[1] + R[a, 2] * step[2]
            for b in range(3):
                R_new[a, b] = R[a, 0] * E[0, b] + R[a, 1] * E[1, b] + R[a, 2] * E[2, b]
        so3_orthonormalize_into(R_new, R_new)
        s_new = s * np.exp(step[6])
        new = gather_alignment(
            *(R_new, t_new, s_new, p, x, wx, q, y, wy, wd, huber, with_scale, H_new, h, M_new)
        )
        decrement = 0.0  # square of the step in standard deviations
        for a in range(7):
            decrement -= step[a] * g[a]
        if new <= cost:
            s, cost = s_new, new
            for a in range(3):
                t[a] = t_new[a]
                for b in range(3):
                    R[a, b] = R_new[a, b]
            for a in range(7):
                g[a] = h[a]
                for b in range(7):
                    H[a, b], M[a, b] = H_new[a, b], M_new[a, b]
            damping, raise_by = max(0.1 * damping, 1e-12), 4.0
        else:
            damping, raise_by = damping * raise_by, 2.0 * raise_by
        if decrement <= LEAST_STEP * LEAST_STEP:
            return s, cost, True
    return s, cost, False


def warm_up() -> None:
    """Compile the kernels of this file."""
    rng = np.random.default_rng(0)
    p = rng.uniform([-1, -1, 2], [1, 1, 4], (5, 3))
    x, w = np.ascontiguousarray(p[:, :2] / p[:, 2:]), np.ones(5)
    R, t, H, M = np.eye(3), np.zeros(3), np.zeros((7, 7)), np.zeros((7, 7))
    inliers, samples = np.zeros(5, np.bool_), np.array([[0, 1, 2]])
    search_alignment(samples, p, x, w, p, x, w, 1.0, 0.99, True, R, t, inliers)
    score_alignment(R, t, 1.0, p, x, w, p, x, w, 1.0, inliers)
    refine_alignment_into(R, t, 1.0, p, x, w, p, x, w, w, 2.0, True, 2, H, M)
