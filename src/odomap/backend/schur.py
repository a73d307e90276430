"""The Schur complement: a bundle's normal equations with the landmarks eliminated.

With poses ξ and landmarks p the damped normal equations are

    | A   W | | δξ |     | a |
    | Wᵀ  C | | δp |  = −| c |,      C block-diagonal (one 3x3 block per landmark),

so S δξ = −(a − W C⁻¹ c) with S = A − W C⁻¹ Wᵀ, and δp = −C⁻¹ (c + Wᵀ δξ). Observations come
sorted by landmark; a landmark seen n times adds n² blocks of 6x6 to S. Levenberg's damping is
Marquardt's: the diagonal is multiplied by 1 + λ. Sums run in a fixed order, so the result is the
same on every run.

Cost: O(observations) to linearise, O(Σ n²) to eliminate, O(poses³) to solve.

Reference: Triggs et al., "Bundle Adjustment - A Modern Synthesis", 1999, section 6.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.backend.residuals import huber_cost, huber_weight, linearize, reproject
from odomap.kernels import kernel

__all__ = [
    "CameraArrays",
    "PoseArrays",
    "SightArrays",
    "SystemArrays",
    "back_substitute",
    "disparity_response",
    "reduced_system",
    "robust_cost",
    "warm_up",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class PoseArrays(NamedTuple):
    """Poses of bodies: R (K, 3, 3), t (K, 3), and column (K,), the block in S or −1 if fixed."""

    R: Array
    t: Array
    column: Index


class CameraArrays(NamedTuple):
    """Cameras on the body, T_camera_body: R (C, 3, 3), t (C, 3), and baseline (C,)."""

    R: Array
    t: Array
    baseline: Array


class SightArrays(NamedTuple):
    """Observations sorted by landmark: those of landmark m are start[m] to start[m + 1]."""

    start: Index
    pose: Index
    camera: Index
    xy: Array
    disparity: Array
    weight: Array


class SystemArrays(NamedTuple):
    """The reduced system S (6F, 6F), s = a − W C⁻¹ c, and what it was made of.

    W (N, 6, 3), C_inverse (M, 3, 3) and c (M, 3) are needed for back-substitution; r (N, 3),
    J (N, 3, 6) and P (N, 3, 3) are residuals and their derivatives by poses and points.
    """

    S: Array
    s: Array
    W: Array
    C_inverse: Array
    c: Array
    r: Array
    J: Array
    P: Array


@kernel(reorder=True)
def invert_3x3(C: Array, inverse: Array) -> bool:
    """Write the inverse of a symmetric 3x3 by its adjugate; False where it is singular."""
    c00 = C[1, 1] * C[2, 2] - C[1, 2] * C[1, 2]
    c01 = C[0, 2] * C[1, 2] - C[0, 1] * C[2, 2]
    c02 = C[0, 1] * C[1, 2] - C[0, 2] * C[1, 1]
    det = C[0, 0] * c00 + C[0, 1] * c01 + C[0, 2] * c02
    if not det > 1e-9 * C[0, 0] * C[1, 1] * C[2, 2]:
        return False
    scale = 1.0 / det
    inverse[0, 0], inverse[0, 1], inverse[0, 2] = c00 * scale, c01 * scale, c02 * scale
    inverse[1, 0], inverse[2, 0] = inverse[0, 1], inverse[0, 2]
    inverse[1, 1] = (C[0, 0] * C[2, 2] - C[0, 2] * C[0, 2]) * scale
    inverse[1, 2] = (C[0, 1] * C[0, 2] - C[0, 0] * C[1, 2]) * scale
    inverse[2, 1] = inverse[1, 2]
    inverse[2, 2] = (C[0, 0] * C[1, 1] - C[0, 1] * C[0, 1]) * scale
    return True


@kernel(reorder=True)
def reduced_system(
    poses: PoseArrays,
    points: Array,
    cameras: CameraArrays,
    seen: SightArrays,
    width: float,
    damping: float,
    system: SystemArrays,
) -> float:
    """Fill `system` at the given poses and landmarks; return the robust cost."""
    S, s, W, c, r, J, P = system.S, system.s, system.W, system.c, system.r, system.J, system.P
    linearize(
        poses.R,
        poses.t,
        cameras.R,
        cameras.t,
        cameras.baseline,
        points,
        seen.start,
        seen.pose,
        seen.camera,
        seen.xy,
        seen.disparity,
        seen.weight,
        r,
        J,
        P,
    )
    A, C, WC = np.zeros((len(s) // 6, 6, 6)), np.empty((3, 3)), np.empty((6, 3))
    S[:, :] = 0.0
    s[:] = 0.0
    cost = 0.0
    for m in range(len(points)):
        c0, c1, c2 = 0.0, 0.0, 0.0
        C00, C01, C02, C11, C12, C22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for o in range(seen.start[m], seen.start[m + 1]):
            chi2 = r[o, 0] * r[o, 0] + r[o, 1] * r[o, 1] + r[o, 2] * r[o, 2]
            w = huber_weight(chi2, width)
            cost += huber_cost(chi2, width)
            r0, r1, r2 = w * r[o, 0], w * r[o, 1], w * r[o, 2]
            P00, P01, P02 = P[o, 0, 0], P[o, 0, 1], P[o, 0, 2]
            P10, P11, P12 = P[o, 1, 0], P[o, 1, 1], P[o, 1, 2]
            P20, P21, P22 = P[o, 2, 0], P[o, 2, 1], P[o, 2, 2]
            C00 += w * (P00 * P00 + P10 * P10 + P20 * P20)
            C01 += w * (P00 * P01 + P10 * P11 + P20 * P21)
            C02 += w * (P00 * P02 + P10 * P12 + P20 * P22)
            C11 += w * (P01 * P01 + P11 * P11 + P21 * P21)
            C12 += w * (P01 * P02 + P11 * P12 + P21 * P22)
            C22 += w * (P02 * P02 + P12 * P12 + P22 * P22)
            c0 += P00 * r0 + P10 * r1 + P20 * r2
            c1 += P01 * r0 + P11 * r1 + P21 * r2
            c2 += P02 * r0 + P12 * r1 + P22 * r2
            f = poses.column[seen.pose[o]]
            if f < 0:
                continue
            for a in range(6):
                s[6 * f + a] += J[o, 0, a] * r0 + J[o, 1, a] * r1 + J[o, 2, a] * r2
                j0, j1, j2 = w * J[o, 0, a], w * J[o, 1, a], w * J[o, 2, a]
                for b in range(a + 1):
                    A[f, a, b] += j0 * J[o, 0, b] + j1 * J[o, 1, b] + j2 * J[o, 2, b]
                W[o, a, 0] = j0 * P00 + j1 * P10 + j2 * P20
                W[o, a, 1] = j0 * P01 + j1 * P11 + j2 * P21
                W[o, a, 2] = j0 * P02 + j1 * P12 + j2 * P22
        c[m, 0], c[m, 1], c[m, 2] = c0, c1, c2
        C[0, 0], C[1, 1], C[2, 2] = C00, C11, C22
        C[0, 1], C[0, 2], C[1, 2] = C01, C02, C12
        _invert_landmark(C, damping, system.C_inverse[m])
        _eliminate(poses.column, seen, m, system, WC)
    for f in range(len(A)):
        for a in range(6):
            for b in range(a + 1):
                S[6 * f + a, 6 * f + b] += A[f, a, b]
            if damping > 0.0:  # a pose that nothing sees stays where it is
                S[6 * f + a, 6 * f + a] += damping * A[f, a, a] + 1e-12
    return cost


@kernel(reorder=True)
def _invert_landmark(C: Array, damping: float, inverse: Array) -> None:
    """Write the inverse of a damped block C, of which the upper half is given; zero if unseen."""
    for a in range(3):
        C[a, a] *= 1.0 + damping
    if invert_3x3(C, inverse):
        return
    # Seen from one place only, its depth is unknown, and rounding errors in place of the zero would
    # spoil S; a ten-millionth of what is known does not.
    trace = C[0, 0] + C[1, 1] + C[2, 2]
    for a in range(3):
        C[a, a] += 1e-7 * trace
    if not invert_3x3(C, inverse):
        inverse[:, :] = 0.0


@kernel(reorder=True)
def _eliminate(column: Index, seen: SightArrays, m: int, system: SystemArrays, WC: Array) -> None:
    """S_ij −= W_i C⁻¹ W_jᵀ and s_i −= W_i C⁻¹ c for all pairs of observations of landmark m."""
    S, s, W, C, c = system.S, system.s, system.W, system.C_inverse[m], system.c[m]
    for o in range(seen.start[m], seen.start[m + 1]):
        f = 6 * column[seen.pose[o]]
        if f < 0:
            continue
        for a in range(6):
            for b in range(3):
                WC[a, b] = W[o, a, 0] * C[0, b] + W[o, a, 1] * C[1, b] + W[o, a, 2] * C[2, b]
            s[f + a] -= WC[a, 0] * c[0] + WC[a, 1] * c[1] + WC[a, 2] * c[2]
        for q in range(seen.start[m], seen.start[m + 1]):
            g = 6 * column[seen.pose[q]]
            if g < 0 or g > f:  # the lower triangle is enough
                continue
            for a in range(6):
                x, y, z = WC[a, 0], WC[a, 1], WC[a, 2]
                for b in range(6):
                    S[f + a, g + b] -= x * W[q, b, 0] + y * W[q, b, 1] + z * W[q, b, 2]


@kernel(reorder=True)
def disparity_response(
    poses: PoseArrays,
    seen: SightArrays,
    width: float,
    system: SystemArrays,
    response: Array,
    evidence: Array,
) -> None:
    """Write g (3, 6F), gradients of the reduced problem per unit of error in all disparities.

    `system` was filled at these poses, undamped. The error is an offset, or a slope in x or y:
    δ(x, y) = 1, x, y. With ∂r/∂δ = (0, 0, −w_d δ) it adds a = Σ Jᵀ w ∂r/∂δ and c = Σ Pᵀ w ∂r/∂δ, so
    that g = a − W C⁻¹ c and poses move by −S⁻¹ g.

    What the observations say about the error itself goes into `evidence` (4, 3): the gradient of
    the cost, Σ w r ∂r/∂δ, and its curvature with landmarks eliminated, Σ w ∂r/∂δ² − cᵀ C⁻¹ c.
    """
    r, J, P = system.r, system.J, system.P
    c, shape = np.empty((3, 3)), np.ones(3)
    response[:, :] = 0.0
    evidence[:, :] = 0.0
    for m in range(len(system.c)):
        c[:, :] = 0.0
        for o in range(seen.start[m], seen.start[m + 1]):
            f = poses.column[seen.pose[o]]
            if np.isnan(seen.disparity[o]) or P[o, 2, 0] == P[o, 2, 1] == P[o, 2, 2] == 0.0:
                continue
            w = huber_weight(r[o, 0] * r[o, 0] + r[o, 1] * r[o, 1] + r[o, 2] * r[o, 2], width)
            shape[1], shape[2] = seen.xy[o, 0], seen.xy[o, 1]
            for e in range(3):
                pull = -w * seen.weight[o, 1] * shape[e]
                evidence[0, e] += pull * r[o, 2]
                for d in range(3):
                    evidence[1 + e, d] -= pull * seen.weight[o, 1] * shape[d]
                for a in range(3):
                    c[e, a] += pull * P[o, 2, a]
                if f >= 0:
                    for a in range(6):
                        response[e, 6 * f + a] += pull * J[o, 2, a]
        for e in range(3):
            for b in range(3):
                y = 0.0
                for a in range(3):
                    y += system.C_inverse[m, b, a] * c[e, a]
                for d in range(3):
                    evidence[1 + d, e] -= y * c[d, b]
        for o in range(seen.start[m], seen.start[m + 1]):
            f = 6 * poses.column[seen.pose[o]]
            if f < 0:
                continue
            for e in range(3):
                for b in range(3):
                    y = 0.0
                    for a in range(3):
                        y += system.C_inverse[m, b, a] * c[e, a]
                    for a in range(6):
                        response[e, f + a] -= system.W[o, a, b] * y


@kernel(reorder=True)
def back_substitute(
    poses: PoseArrays, seen: SightArrays, system: SystemArrays, points: Array, moved: Array
) -> None:
    """Write the moved landmarks p − C⁻¹ (c + Wᵀ δξ), where `system.s` holds δξ (6F,)."""
    b, C = np.empty(3), system.C_inverse
    for m in range(len(points)):
        b[0], b[1], b[2] = system.c[m, 0], system.c[m, 1], system.c[m, 2]
        for o in range(seen.start[m], seen.start[m + 1]):
            f = 6 * poses.column[seen.pose[o]]
            if f < 0:
                continue
            for k in range(3):
                for a in range(6):
                    b[k] += system.W[o, a, k] * system.s[f + a]
        for k in range(3):
            moved[m, k] = points[m, k] - (C[m, k, 0] * b[0] + C[m, k, 1] * b[1] + C[m, k, 2] * b[2])


@kernel(reorder=True)
def robust_cost(
    poses: PoseArrays,
    points: Array,
    cameras: CameraArrays,
    seen: SightArrays,
    width: float,
    chi2: Array,
) -> float:
    """Return Σ ρ(χ²)/2 and write χ² (N,) of each observation, infinite behind the camera."""
    r = np.empty(3)
    cost = 0.0
    for m in range(len(points)):
        for o in range(seen.start[m], seen.start[m + 1]):
            i, k = seen.pose[o], seen.camera[o]
            in_front = reproject(
                poses.R[i],
                poses.t[i],
                cameras.R[k],
                cameras.t[k],
                cameras.baseline[k],
                points[m],
                seen.xy[o],
                seen.disparity[o],
                seen.weight[o],
                r,
            )
            chi2[o] = r[0] * r[0] + r[1] * r[1] + r[2] * r[2] if in_front else np.inf
            # A landmark pushed behind a camera must not look like progress.
            cost += huber_cost(chi2[o], width) if in_front else 1e6
    return cost


def warm_up() -> None:
    """Compile the kernels of this module."""
    none = np.zeros(1, np.int64)
    poses = PoseArrays(np.eye(3)[None], np.zeros((1, 3)), none)
    cameras = CameraArrays(np.eye(3)[None], np.zeros((1, 3)), np.ones(1))
    seen = SightArrays(np.array([0, 1]), none, none, np.zeros((1, 2)), np.ones(1), np.ones((1, 2)))
    system = SystemArrays(
        np.empty((6, 6)),
        np.empty(6),
        np.empty((1, 6, 3)),
        np.empty((1, 3, 3)),
        np.empty((1, 3)),
        np.empty((1, 3)),
        np.empty((1, 3, 6)),
        np.empty((1, 3, 3)),
    )
    points = np.array([[0.0, 0.0, 2.0]])
    robust_cost(poses, points, cameras, seen, 2.5, np.empty(1))
    reduced_system(poses, points, cameras, seen, 2.5, 1.0, system)
    back_substitute(poses, seen, system, points, np.empty((1, 3)))
    response, evidence = np.empty((3, 6)), np.empty((4, 3))
    disparity_response(poses, seen, 2.5, system, response, evidence)
