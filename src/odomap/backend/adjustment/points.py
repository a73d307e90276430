"""Each point for itself: what views that have moved ask of the points they see.

A step of bundle adjustment moves views and points by one linear model. With the views where they
now are, the points no longer know each other, and each can be looked at alone: if its step made
it worse than staying would, it stays; then one more Gauss-Newton step on its own three numbers is
taken if it helps,

    δp = -(Σ PᵀP + λ diag)⁻¹ Σ Pᵀr.

A few points near infinity, or matched wrongly, then no longer spoil a step that is good for all
others, and far fewer steps are needed. Points go along their ray by inverse distance (see
`retract`), in which pixels are nearly linear. O(N), less than linearising.

Reference: Y. Jeong, D. Nistér, D. Steedly, R. Szeliski, I. Kweon, "Pushing the envelope of modern
methods for bundle adjustment", CVPR 2010 (embedded point iterations); J. Civera, A. Davison, J.
Montiel, "Inverse depth parametrization for monocular SLAM", T-RO 2008.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.backend.adjustment.layout import Blocks, Incidences, Seen
from odomap.backend.adjustment.lenses import LensArrays, project
from odomap.backend.adjustment.normal import System, Views, cholesky_3
from odomap.geometry.robust_kernels import loss_cost, loss_weight
from odomap.kernels import kernel

__all__ = ["move_points", "refine_points", "retract"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

MOST = 0.9
"""A point goes away to 1 / (1 - this) of its distance in one step, at most."""


@kernel
def retract(
    R: Array,
    t: Array,
    i: int,
    p: tuple[float, float, float],
    z: tuple[float, float, float],
) -> tuple[float, float, float]:
    """Move p by δp = z: in inverse distance along its ray from view i, across the ray straight.

    With c the centre of the view, q = p - c and s = q·δp / |q|²: c + (q + δp - s q) / (1 - s).
    """
    c0 = -R[i, 0, 0] * t[i, 0] - R[i, 1, 0] * t[i, 1] - R[i, 2, 0] * t[i, 2]
    c1 = -R[i, 0, 1] * t[i, 0] - R[i, 1, 1] * t[i, 1] - R[i, 2, 1] * t[i, 2]
    c2 = -R[i, 0, 2] * t[i, 0] - R[i, 1, 2] * t[i, 1] - R[i, 2, 2] * t[i, 2]
    q0, q1, q2 = p[0] - c0, p[1] - c1, p[2] - c2
    d2 = q0 * q0 + q1 * q1 + q2 * q2
    s = (q0 * z[0] + q1 * z[1] + q2 * z[2]) / d2 if d2 > 0.0 else 0.0
    stretch = 1.0 / (1.0 - min(s, MOST))
    return (
        c0 + (q0 + z[0] - s * q0) * stretch,
        c1 + (q1 + z[1] - s * q1) * stretch,
        c2 + (q2 + z[2] - s * q2) * stretch,
    )


@kernel(reorder=True)
def move_points(
    views: Views,
    points: Array,
    is_free_point: Mask,
    seen: Seen,
    blocks: Blocks,
    incidences: Incidences,
    system: System,
    delta: Array,
    damping: float,
    moved: Array,
) -> tuple[float, float]:
    """Move p by δp = -L⁻ᵀ (y + Vᵀ δ); return Σ δpᵀ(λ d δp - c) and the largest part of a move."""
    R, t, start, of_view = views.R, views.t, seen.start, seen.of_view
    size, row = blocks.size, blocks.row
    first, touched, _, slab_at, _, _ = incidences
    _, _, _, _, V, L, y, c, d = system
    fall, largest = 0.0, 0.0
    for m in range(len(points)):
        p = points[m, 0], points[m, 1], points[m, 2]
        if is_free_point[m]:
            z0, z1, z2 = y[m, 0], y[m, 1], y[m, 2]
            for e in range(first[m], first[m + 1]):
                n, to, at = size[touched[e]], row[touched[e]], slab_at[e]
                for i in range(n):
                    z0 += V[at + i] * delta[to + i]
                    z1 += V[at + n + i] * delta[to + i]
                    z2 += V[at + 2 * n + i] * delta[to + i]
            z2 = -z2 * L[m, 5]
            z1 = (-z1 - L[m, 2] * z2) * L[m, 4]
            z0 = (-z0 - L[m, 0] * z1 - L[m, 1] * z2) * L[m, 3]
            p = retract(R, t, of_view[start[m]], p, (z0, z1, z2))
            fall += z0 * (damping * d[m, 0] * z0 - c[m, 0])
            fall += z1 * (damping * d[m, 1] * z1 - c[m, 1])
            fall += z2 * (damping * d[m, 2] * z2 - c[m, 2])
            largest = max(largest, abs(z0), abs(z1), abs(z2))
        moved[m, 0], moved[m, 1], moved[m, 2] = p[0], p[1], p[2]
    return fall, largest


@kernel(reorder=True)
def _add_ray(
    R: Array, i: int, D: Array, scale: float, u0: float, u1: float, w: float, C: Array, c: Array
) -> None:
    """C += w PᵀP, packed by rows of the lower triangle, c += Pᵀ(u0, u1); P = s G R_cw, G of D."""
    for j in range(3):
        a = D[0, 1] * R[i, 0, j] + D[0, 2] * R[i, 1, j] + D[0, 3] * R[i, 2, j]
        b = D[1, 1] * R[i, 0, j] + D[1, 2] * R[i, 1, j] + D[1, 3] * R[i, 2, j]
        # Behind G there is room: by the lens nothing is asked here.
        D[0, 4 + j], D[1, 4 + j] = scale * a, scale * b
    at = 0
    for j in range(3):
        c[j] += D[0, 4 + j] * u0 + D[1, 4 + j] * u1
        for k in range(j + 1):
            C[at] += w * (D[0, 4 + j] * D[0, 4 + k] + D[1, 4 + j] * D[1, 4 + k])
            at += 1


@kernel(reorder=True)
def _add_depth(R: Array, i: int, slope: float, u2: float, w: float, C: Array, c: Array) -> None:
    """The same of a measured depth: P = slope (R_cw)₂, the slope by the third of camera axes."""
    at = 0
    for j in range(3):
        c[j] += slope * R[i, 2, j] * u2
        for k in range(j + 1):
            C[at] += w * slope * slope * R[i, 2, j] * R[i, 2, k]
            at += 1


@kernel
def _own_step(C: Array, c: Array, damping: float) -> tuple[float, float, float]:
    """-(C + λ diag C)⁻¹ c."""
    l10, l20, l21, i0, i1, i2 = cholesky_3(C, damping)
    y0 = c[0] * i0
    y1 = (c[1] - l10 * y0) * i1
    y2 = (c[2] - l20 * y0 - l21 * y1) * i2
    z2 = -y2 * i2
    z1 = (-y1 - l21 * z2) * i1
    return (-y0 - l10 * z1 - l20 * z2) * i0, z1, z2


@kernel
def refine_points(
    views: Views,
    lenses: LensArrays,
    old: Array,
    points: Array,
    is_free_point: Mask,
    seen: Seen,
    loss: tuple[int, float],
    charge: float,
    damping: float,
    before: Array,
    costs: Array,
) -> tuple[float, int]:
    """Better each of the points moved from `old`; return the cost of what is seen, and the unseen.

    costs (M,) of each point, with a charge per view that does not see it; before: of the old ones,
    where the views were.
    """
    R, t, lens = views
    theta, kind, _, reach = lenses
    start, of_view, pixels, weight, _, _, inverse_depth, deep = seen
    D, C, c = np.zeros((2, 16)), np.empty(6), np.empty(3)
    total, lost = 0.0, 0
    for m in range(len(points)):
        p, step, least, unseen = (old[m, 0], old[m, 1], old[m, 2]), (0.0, 0.0, 0.0), np.inf, 0
        # Where the joint step put it, where it was, and one step of its own from the better one.
        for attempt in range(3 if is_free_point[m] else 1):
            x = points[m, 0], points[m, 1], points[m, 2]
            if attempt == 1:
                if least <= before[m]:
                    continue
                x = old[m, 0], old[m, 1], old[m, 2]
            elif attempt == 2:
                x = retract(R, t, of_view[start[m]], p, step)
            cost, away = 0.0, 0
            for j in range(6):
                C[j] = 0.0
            c[0], c[1], c[2] = 0.0, 0.0, 0.0
            for o in range(start[m], start[m + 1]):
                i = of_view[o]
                q = lens[i]
                X = R[i, 0, 0] * x[0] + R[i, 0, 1] * x[1] + R[i, 0, 2] * x[2] + t[i, 0]
                Y = R[i, 1, 0] * x[0] + R[i, 1, 1] * x[1] + R[i, 1, 2] * x[2] + t[i, 1]
                Z = R[i, 2, 0] * x[0] + R[i, 2, 1] * x[1] + R[i, 2, 2] * x[2] + t[i, 2]
                if not project(kind[q], theta, q, reach[q], X, Y, Z, attempt < 2, D):
                    away += 1
                    continue
                u0 = weight[o] * (D[0, 0] - pixels[o, 0])
                u1 = weight[o] * (D[1, 0] - pixels[o, 1])
                u2 = deep[o] * (1.0 / Z - inverse_depth[o]) if deep[o] > 0.0 else 0.0
                s = u0 * u0 + u1 * u1 + u2 * u2
                cost += 0.5 * loss_cost(loss[0], loss[1], s)
                if attempt < 2:
                    w = loss_weight(loss[0], loss[1], s)
                    _add_ray(R, i, D, weight[o], w * u0, w * u1, w, C, c)
                    if deep[o] > 0.0:
                        _add_depth(R, i, -deep[o] / (Z * Z), w * u2, w, C, c)
            if cost + charge * away < least:
                p, least, unseen = x, cost + charge * away, away
                if attempt < 2:
                    step = _own_step(C, c, damping)
        points[m, 0], points[m, 1], points[m, 2], costs[m] = p[0], p[1], p[2], least
        total += least - charge * unseen
        lost += unseen
    return total, lost
