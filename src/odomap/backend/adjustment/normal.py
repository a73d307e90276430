"""Normal equations of bundle adjustment, each point eliminated as soon as it is linearised.

For an update T_world_camera exp(ξ), ξ = (translation, rotation), of a view, the point X = T_cw p
in camera axes and its pixel u change as

    ∂X/∂ξ = [-I | [X]ₓ],   ∂X/∂p = R_cw,   ∂u/∂(ξ, θ, p) = (G ∂X/∂ξ, H, G R_cw),

G and H from `lenses`; where depth was measured, 1/X_z changes by -∂X_z/X_z². Point m with
C = Σ PᵀP, c = Σ Pᵀr and W = Σ JᵀP at each block it touches is damped and factored, (1 + λ) diag C
added to C = L Lᵀ, and leaves

    V = W L⁻ᵀ,   y = L⁻¹ c :     S = A - V Vᵀ,   s = a - V y,   δp = -L⁻ᵀ (y + Vᵀ δ).

Nothing else is kept of a million Jacobians. A direction in which a point is not held by what is
seen (its pivot is rounding: seen once, or from one place) stays as it is: its row of V is zero.
Residuals are weighted by ρ' of the loss. O(N).

Reference: B. Triggs et al., "Bundle adjustment - a modern synthesis", 1999, section 6.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.backend.adjustment.layout import Blocks, Incidences, Seen
from odomap.backend.adjustment.lenses import WIDTH, LensArrays, project
from odomap.geometry.lie_kernels import se3_compose_into, se3_exp_into, so3_orthonormalize_into
from odomap.geometry.robust_kernels import loss_cost, loss_weight
from odomap.kernels import kernel

__all__ = ["System", "Views", "cholesky_3", "linearise", "move_views", "robust_cost"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

POINT = 6 + WIDTH
"""Column of a Jacobian where its derivative by the point begins."""
FLAT = 1e-10
"""A pivot that is this part of its diagonal is what rounding makes of zero."""


class Views(NamedTuple):
    """Views, T_camera_world: R (K, 3, 3), t (K, 3), and the lens (K,) of each."""

    R: Array
    t: Array
    lens: Index


class System(NamedTuple):
    """Normal equations with the points eliminated, in scaled unknowns of views and lenses.

    scale (n,): 0 where held, so that metres, radians and pixels compare. A: diagonal blocks, flat,
    lower triangles; coupling (K, 6, 12) of a pose with a lens that has a block to itself; a (n,)
    gradient; V: slabs (3, size) of the incidences, flat; L (M, 6): l₁₀ l₂₀ l₂₁ and the inverse
    pivots; y (M, 3); c (M, 3) gradient; d (M, 3) diagonal. A and d are without damping.
    """

    scale: Array
    A: Array
    coupling: Array
    a: Array
    V: Array
    L: Array
    y: Array
    c: Array
    d: Array


@kernel(reorder=True)
def _weigh(
    R: Array,
    i: int,
    x: float,
    y: float,
    z: float,
    scale: float,
    D: Array,
    J: Array,
) -> None:
    """J (2, 21) = s [-G | G [X]ₓ | H | G R_cw], D (2, 16) = [. | G | H]: by ξ, θ and p."""
    for k in range(2):
        a, b, c = scale * D[k, 1], scale * D[k, 2], scale * D[k, 3]
        J[k, 0], J[k, 1], J[k, 2] = -a, -b, -c
        J[k, 3], J[k, 4], J[k, 5] = b * z - c * y, c * x - a * z, a * y - b * x
        for j in range(WIDTH):
            J[k, 6 + j] = scale * D[k, 4 + j]
        for j in range(3):
            J[k, POINT + j] = a * R[i, 0, j] + b * R[i, 1, j] + c * R[i, 2, j]


@kernel(reorder=True)
def _add_block(
    J: Array,
    begin: int,
    size: int,
    u0: float,
    u1: float,
    scale: Array,
    row: int,
    A: Array,
    at: int,
    a: Array,
) -> None:
    """Scale columns of J; then A += JᵀJ, the lower triangle, and a += Jᵀr."""
    for i in range(size):
        J[0, begin + i] *= scale[row + i]
        J[1, begin + i] *= scale[row + i]
    for i in range(size):
        j0, j1 = J[0, begin + i], J[1, begin + i]
        a[row + i] += j0 * u0 + j1 * u1
        for j in range(i + 1):
            A[at + i * size + j] += j0 * J[0, begin + j] + j1 * J[1, begin + j]


@kernel(reorder=True)
def _add_slab(J: Array, begin: int, size: int, V: Array, at: int) -> None:
    """W += JᵀP, written as the (3, size) slab Wᵀ."""
    for k in range(3):
        p0, p1 = J[0, POINT + k], J[1, POINT + k]
        for i in range(size):
            V[at + k * size + i] += J[0, begin + i] * p0 + J[1, begin + i] * p1


@kernel(reorder=True)
def _add_point(J: Array, u0: float, u1: float, C: Array, c: Array, m: int) -> None:
    """C += PᵀP, packed by rows of the lower triangle, and c += Pᵀr."""
    at = 0
    for j in range(3):
        p0, p1 = J[0, POINT + j], J[1, POINT + j]
        c[m, j] += p0 * u0 + p1 * u1
        for k in range(j + 1):
            C[at] += p0 * J[0, POINT + k] + p1 * J[1, POINT + k]
            at += 1


@kernel(reorder=True)
def _add_depth(
    R: Array,
    i: int,
    X: tuple[float, float, float],
    r: float,
    slope: float,
    touches: tuple[int, int, int, int],
    scale: Array,
    A: Array,
    a: Array,
    V: Array,
    C: Array,
    c: Array,
    m: int,
    J: Array,
) -> None:
    """Add residual r of a measured depth, of the given slope by X_z, to all that `linearise` fills.

    touches: rows of the view's block and where it begins in a, in A and, its slab, in V; -1: none.
    J: room for (2, 9).
    """
    n, row, at, slab = touches
    J[0, 0], J[0, 1], J[0, 2] = 0.0, 0.0, -slope
    J[0, 3], J[0, 4], J[0, 5] = -slope * X[1], slope * X[0], 0.0
    for j in range(3):
        J[0, 6 + j] = slope * R[i, 2, j]
    if row >= 0:
        for j in range(6):
            J[0, j] *= scale[row + j]
            a[row + j] += J[0, j] * r
            for k in range(j + 1):
                A[at + j * n + k] += J[0, j] * J[0, k]
            if slab >= 0:
                for k in range(3):
                    V[slab + k * n + j] += J[0, j] * J[0, 6 + k]
    e = 0
    for j in range(3):
        c[m, j] += J[0, 6 + j] * r
        for k in range(j + 1):
            C[e] += J[0, 6 + j] * J[0, 6 + k]
            e += 1


@kernel(reorder=True)
def cholesky_3(C: Array, damping: float) -> tuple[float, float, float, float, float, float]:
    """C + λ diag C = L Lᵀ of a packed C (6,): l₁₀ l₂₀ l₂₁ and the inverse pivots.

    These are zero in a direction nothing holds.
    """
    lift = 1.0 + damping
    p0 = C[0] * lift
    i0 = 1.0 / np.sqrt(p0) if p0 > 0.0 else 0.0
    l10, l20 = C[1] * i0, C[3] * i0
    p1 = C[2] * lift - l10 * l10
    i1 = 1.0 / np.sqrt(p1) if p1 > FLAT * C[2] else 0.0
    l21 = (C[4] - l20 * l10) * i1
    p2 = C[5] * lift - l20 * l20 - l21 * l21
    i2 = 1.0 / np.sqrt(p2) if p2 > FLAT * C[5] else 0.0
    return l10, l20, l21, i0, i1, i2


@kernel(reorder=True)
def _factor_point(C: Array, c: Array, m: int, damping: float, L: Array, y: Array, d: Array) -> None:
    """C + λ diag C = L Lᵀ, y = L⁻¹ c, d = diag C."""
    l10, l20, l21, i0, i1, i2 = cholesky_3(C, damping)
    L[m, 0], L[m, 1], L[m, 2], L[m, 3], L[m, 4], L[m, 5] = l10, l20, l21, i0, i1, i2
    d[m, 0], d[m, 1], d[m, 2] = C[0], C[2], C[5]
    y[m, 0] = c[m, 0] * i0
    y[m, 1] = (c[m, 1] - l10 * y[m, 0]) * i1
    y[m, 2] = (c[m, 2] - l20 * y[m, 0] - l21 * y[m, 1]) * i2


@kernel(reorder=True)
def _whiten_slab(L: Array, m: int, size: int, V: Array, at: int) -> None:
    """Wᵀ becomes L⁻¹ Wᵀ = Vᵀ."""
    l10, l20, l21, i0, i1, i2 = L[m, 0], L[m, 1], L[m, 2], L[m, 3], L[m, 4], L[m, 5]
    for i in range(size):
        v0 = V[at + i] * i0
        v1 = (V[at + size + i] - l10 * v0) * i1
        v2 = (V[at + 2 * size + i] - l20 * v0 - l21 * v1) * i2
        V[at + i], V[at + size + i], V[at + 2 * size + i] = v0, v1, v2


@kernel
def _clear(values: Array) -> None:
    """Write zeros: assigning to a slice takes a second to compile."""
    for i in range(len(values)):
        values[i] = 0.0


@kernel
def linearise(
    views: Views,
    lenses: LensArrays,
    points: Array,
    is_free_point: Mask,
    seen: Seen,
    blocks: Blocks,
    incidences: Incidences,
    loss: tuple[int, float],
    damping: float,
    system: System,
) -> None:
    """Fill `system`."""
    # Fields are taken out of their tuples once: each access counts references, atomically.
    R, t, lens = views
    theta, kind, used, reach = lenses
    start, of_view, pixels, weight, pose_touch, lens_touch, inverse_depth, deep = seen
    pose_block, lens_block, _, size, row, block_at, _ = blocks
    first, touched, _, slab_at, _, _ = incidences
    scale, A, coupling, a, V, L, y, c, d = system
    D, J, C = np.zeros((2, 16)), np.zeros((2, POINT + 3)), np.empty(6)
    _clear(A)
    _clear(a)
    _clear(coupling.reshape(-1))
    for m in range(len(points)):
        for j in range(slab_at[first[m]], slab_at[first[m + 1]]):
            V[j] = 0.0
        _clear(C)
        c[m, 0], c[m, 1], c[m, 2] = 0.0, 0.0, 0.0
        p0, p1, p2 = points[m, 0], points[m, 1], points[m, 2]
        for o in range(start[m], start[m + 1]):
            i = of_view[o]
            q = lens[i]
            b, e = pose_block[i], lens_block[q]
            X = R[i, 0, 0] * p0 + R[i, 0, 1] * p1 + R[i, 0, 2] * p2 + t[i, 0]
            Y = R[i, 1, 0] * p0 + R[i, 1, 1] * p1 + R[i, 1, 2] * p2 + t[i, 1]
            Z = R[i, 2, 0] * p0 + R[i, 2, 1] * p1 + R[i, 2, 2] * p2 + t[i, 2]
            if not project(kind[q], theta, q, reach[q], X, Y, Z, True, D):
                continue
            u0, u1 = weight[o] * (D[0, 0] - pixels[o, 0]), weight[o] * (D[1, 0] - pixels[o, 1])
            u2 = deep[o] * (1.0 / Z - inverse_depth[o]) if deep[o] > 0.0 else 0.0
            root = np.sqrt(loss_weight(loss[0], loss[1], u0 * u0 + u1 * u1 + u2 * u2))
            u0, u1 = root * u0, root * u1
            _weigh(R, i, X, Y, Z, weight[o] * root, D, J)
            if b >= 0:
                n = size[b]
                _add_block(J, 0, n, u0, u1, scale, row[b], A, block_at[b], a)
                if pose_touch[o] >= 0:
                    _add_slab(J, 0, n, V, slab_at[pose_touch[o]])
            if e >= 0 and e != b:
                n = used[q]
                _add_block(J, 6, n, u0, u1, scale, row[e], A, block_at[e], a)
                if lens_touch[o] >= 0:
                    _add_slab(J, 6, n, V, slab_at[lens_touch[o]])
                if b >= 0:
                    for j in range(6):
                        for k in range(n):
                            coupling[i, j, k] += J[0, j] * J[0, 6 + k] + J[1, j] * J[1, 6 + k]
            _add_point(J, u0, u1, C, c, m)
            if deep[o] > 0.0:
                slope, slab = -root * deep[o] / (Z * Z), -1
                if pose_touch[o] >= 0:
                    slab = slab_at[pose_touch[o]]
                touches = (size[b], row[b], block_at[b], slab) if b >= 0 else (0, -1, -1, -1)
                at = X, Y, Z
                _add_depth(R, i, at, root * u2, slope, touches, scale, A, a, V, C, c, m, J)
        if is_free_point[m]:
            _factor_point(C, c, m, damping, L, y, d)
            for j in range(first[m], first[m + 1]):
                _whiten_slab(L, m, size[touched[j]], V, slab_at[j])


@kernel
def robust_cost(
    views: Views,
    lenses: LensArrays,
    points: Array,
    seen: Seen,
    loss: tuple[int, float],
    charge: float,
    chi2: Array,
    costs: Array,
) -> tuple[float, int]:
    """Return ½ Σ ρ(χ²) of what is seen and how many are not; write χ² (N,), infinite for those.

    costs (M,): of each point, with a charge per view that does not see it.
    """
    R, t, lens = views
    theta, kind, _, reach = lenses
    start, of_view, pixels, weight, _, _, inverse_depth, deep = seen
    D = np.empty((2, 16))
    total, lost = 0.0, 0
    for m in range(len(points)):
        cost, away = 0.0, 0
        p0, p1, p2 = points[m, 0], points[m, 1], points[m, 2]
        for o in range(start[m], start[m + 1]):
            i = of_view[o]
            q = lens[i]
            X = R[i, 0, 0] * p0 + R[i, 0, 1] * p1 + R[i, 0, 2] * p2 + t[i, 0]
            Y = R[i, 1, 0] * p0 + R[i, 1, 1] * p1 + R[i, 1, 2] * p2 + t[i, 1]
            Z = R[i, 2, 0] * p0 + R[i, 2, 1] * p1 + R[i, 2, 2] * p2 + t[i, 2]
            chi2[o] = np.inf
            if project(kind[q], theta, q, reach[q], X, Y, Z, False, D):
                u0, u1 = D[0, 0] - pixels[o, 0], D[1, 0] - pixels[o, 1]
                chi2[o] = (u0 * u0 + u1 * u1) * weight[o] * weight[o]
                if deep[o] > 0.0:
                    chi2[o] += (deep[o] * (1.0 / Z - inverse_depth[o])) ** 2
                cost += 0.5 * loss_cost(loss[0], loss[1], chi2[o])
            else:
                away += 1
        costs[m] = cost + charge * away
        total += cost
        lost += away
    return total, lost


@kernel
def move_views(
    views: Views, lenses: LensArrays, blocks: Blocks, delta: Array, moved: Views, theta: Array
) -> None:
    """T_cw becomes exp(-ξ) T_cw, and θ becomes θ + δθ."""
    xi, R, t = np.empty(6), np.empty((3, 3)), np.empty(3)
    for i in range(len(views.R)):
        b = blocks.pose[i]
        for j in range(6):
            xi[j] = -delta[blocks.row[b] + j] if b >= 0 else 0.0
        se3_exp_into(xi, R, t)
        se3_compose_into(R, t, views.R[i], views.t[i], moved.R[i], moved.t[i])
        if b >= 0:
            so3_orthonormalize_into(moved.R[i], moved.R[i])
    for q in range(len(theta)):
        b = blocks.lens[q]
        for j in range(WIDTH):
            theta[q, j] = lenses.theta[q, j]
            if b >= 0 and j < lenses.used[q]:
                theta[q, j] += delta[blocks.row[b] + blocks.lens_row[q] + j]
