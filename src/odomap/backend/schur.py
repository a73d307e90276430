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

import numpy as np
from numpy.typing import NDArray

from odomap.backend.residuals import huber_cost, huber_weight, reproject, reproject_with_jacobians
from odomap.kernels import kernel

__all__ = ["back_substitute", "reduced_system", "robust_cost", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@kernel(reorder=True)
def invert_3x3(C: Array, inverse: Array) -> bool:
    """Write the inverse of a symmetric 3x3 by its adjugate; False unless positive definite."""
    c00 = C[1, 1] * C[2, 2] - C[1, 2] * C[1, 2]
    c01 = C[0, 2] * C[1, 2] - C[0, 1] * C[2, 2]
    c02 = C[0, 1] * C[1, 2] - C[0, 2] * C[1, 1]
    det = C[0, 0] * c00 + C[0, 1] * c01 + C[0, 2] * c02
    if not det > 1e-18 * C[0, 0] * C[1, 1] * C[2, 2]:
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
    Rs: Array,
    ts: Array,
    column: Index,
    points: Array,
    Rs_cb: Array,
    ts_cb: Array,
    baselines: Array,
    start: Index,
    pose: Index,
    camera: Index,
    xy: Array,
    disparity: Array,
    weights: Array,
    width: float,
    damping: float,
    S: Array,
    s: Array,
    W: Array,
    C_inverse: Array,
    c: Array,
) -> float:
    """Write S (6F, 6F), s = a − W C⁻¹ c, and what back-substitution needs; return the robust cost.

    `column` maps a pose to its block in S, −1 if it is held fixed; `start` (M + 1) delimits each
    landmark's observations.
    """
    r, J, P = np.empty(3), np.empty((3, 6)), np.empty((3, 3))
    C, WC, diagonal = np.empty((3, 3)), np.empty((6, 3)), np.zeros(len(s))
    S[:, :] = 0.0
    s[:] = 0.0
    cost = 0.0
    for m in range(len(points)):
        C[:, :] = 0.0
        for k in range(3):
            c[m, k] = 0.0
        for o in range(start[m], start[m + 1]):
            i, cam, f = pose[o], camera[o], column[pose[o]]
            W[o, :, :] = 0.0
            if not reproject_with_jacobians(
                Rs[i],
                ts[i],
                Rs_cb[cam],
                ts_cb[cam],
                baselines[cam],
                points[m],
                xy[o],
                disparity[o],
                weights[o],
                r,
                J,
                P,
            ):
                continue
            chi2 = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
            w = huber_weight(chi2, width)
            cost += huber_cost(chi2, width)
            for a in range(3):
                for b in range(3):
                    C[a, b] += w * (P[0, a] * P[0, b] + P[1, a] * P[1, b] + P[2, a] * P[2, b])
                c[m, a] += w * (P[0, a] * r[0] + P[1, a] * r[1] + P[2, a] * r[2])
            if f < 0:
                continue
            for a in range(6):
                s[6 * f + a] += w * (J[0, a] * r[0] + J[1, a] * r[1] + J[2, a] * r[2])
                for b in range(6):
                    S[6 * f + a, 6 * f + b] += w * (
                        J[0, a] * J[0, b] + J[1, a] * J[1, b] + J[2, a] * J[2, b]
                    )
                for b in range(3):
                    W[o, a, b] = w * (J[0, a] * P[0, b] + J[1, a] * P[1, b] + J[2, a] * P[2, b])
                diagonal[6 * f + a] += w * (J[0, a] ** 2 + J[1, a] ** 2 + J[2, a] ** 2)
        for a in range(3):
            C[a, a] *= 1.0 + damping
        if not invert_3x3(C, C_inverse[m]):
            # A direction that no observation constrains: hold the landmark in this step.
            C_inverse[m, :, :] = 0.0
        _eliminate(column, start[m], start[m + 1], pose, W, C_inverse[m], c[m], WC, S, s)
    for a in range(len(s)):
        S[a, a] += damping * diagonal[a] + 1e-12
    return cost


@kernel(reorder=True)
def _eliminate(
    column: Index,
    first: int,
    last: int,
    pose: Index,
    W: Array,
    C_inverse: Array,
    c: Array,
    WC: Array,
    S: Array,
    s: Array,
) -> None:
    """S_ij −= W_i C⁻¹ W_jᵀ and s_i −= W_i C⁻¹ c for all pairs of observations of one landmark."""
    for o in range(first, last):
        f = 6 * column[pose[o]]
        if f < 0:
            continue
        for a in range(6):
            for b in range(3):
                WC[a, b] = (
                    W[o, a, 0] * C_inverse[0, b]
                    + W[o, a, 1] * C_inverse[1, b]
                    + W[o, a, 2] * C_inverse[2, b]
                )
            s[f + a] -= WC[a, 0] * c[0] + WC[a, 1] * c[1] + WC[a, 2] * c[2]
        for other in range(first, last):
            g = 6 * column[pose[other]]
            if g < 0 or g > f:  # the lower triangle is enough
                continue
            for a in range(6):
                for b in range(6):
                    S[f + a, g + b] -= (
                        WC[a, 0] * W[other, b, 0]
                        + WC[a, 1] * W[other, b, 1]
                        + WC[a, 2] * W[other, b, 2]
                    )


@kernel(reorder=True)
def back_substitute(
    column: Index,
    start: Index,
    pose: Index,
    W: Array,
    C_inverse: Array,
    c: Array,
    step: Array,
    points: Array,
    moved: Array,
) -> None:
    """Write the moved landmarks p − C⁻¹ (c + Wᵀ δξ), given step = δξ (6F,)."""
    b = np.empty(3)
    for m in range(len(points)):
        for k in range(3):
            b[k] = c[m, k]
        for o in range(start[m], start[m + 1]):
            f = 6 * column[pose[o]]
            if f < 0:
                continue
            for k in range(3):
                for a in range(6):
                    b[k] += W[o, a, k] * step[f + a]
        for k in range(3):
            moved[m, k] = points[m, k] - (
                C_inverse[m, k, 0] * b[0] + C_inverse[m, k, 1] * b[1] + C_inverse[m, k, 2] * b[2]
            )


@kernel(reorder=True)
def robust_cost(
    Rs: Array,
    ts: Array,
    points: Array,
    Rs_cb: Array,
    ts_cb: Array,
    baselines: Array,
    start: Index,
    pose: Index,
    camera: Index,
    xy: Array,
    disparity: Array,
    weights: Array,
    width: float,
    chi2: Array,
) -> float:
    """Return Σ ρ(χ²)/2 and write χ² (N,) of each observation, infinite behind the camera."""
    r = np.empty(3)
    cost = 0.0
    for m in range(len(points)):
        for o in range(start[m], start[m + 1]):
            i, cam = pose[o], camera[o]
            in_front = reproject(
                Rs[i],
                ts[i],
                Rs_cb[cam],
                ts_cb[cam],
                baselines[cam],
                points[m],
                xy[o],
                disparity[o],
                weights[o],
                r,
            )
            chi2[o] = r[0] * r[0] + r[1] * r[1] + r[2] * r[2] if in_front else np.inf
            # A landmark pushed behind a camera must not look like progress.
            cost += huber_cost(chi2[o], width) if in_front else 1e6
    return cost


def warm_up() -> None:
    """Compile the kernels of this module, by way of a bundle of two poses."""
    from odomap.backend import bundle

    bundle.warm_up()
