"""Edges of a pose graph, linearised: what one measured relative motion adds to H δ = -g.

With D = T_i⁻¹ T_j and the error E = Z⁻¹ D, both costs depend on E alone. Moving node j by δ on the
right moves E to E exp(δ); moving node i by δ is the same as moving j by -M δ, M = Ad(D⁻¹). So an
edge is a small symmetric A and a gradient b at E, and

    H_jj += A,   H_ij += -Mᵀ A,   H_ii += Mᵀ A M,   g_j += b,   g_i += -Mᵀ b.

    geodesic   ½ ρ(rᵀ Ω r), r = log E:    A = w Jᵀ Ω J,  b = w Jᵀ Ω r,  J = J_r⁻¹(r),  w = ρ'
    chordal    ½ ρ(2f), f = κ |E_R - I|² + τ |E_t|²:
               A = w 2 diag(τ I, 2κ I) (the plane: κ ½),  b = w 2 (τ E_Rᵀ E_t, κ vee(E_R - E_Rᵀ))

The exact J matters: J ≈ I ends above the minimum where residuals stay large. O(edges).

Reference: J. Solà, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics",
arXiv:1812.01537, 2018; chordal: D. M. Rosen et al., "SE-Sync", IJRR 38(2-3), 2019.
"""

from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie_kernels import half_cot, se3_log_into, se3_right_jacobian_inverse_into
from odomap.geometry.robust_kernels import loss_cost, loss_weight
from odomap.kernels import kernel

__all__ = [
    "TANGENT",
    "EdgeArrays",
    "TargetArrays",
    "compile_edges",
    "cost_of_edges",
    "linearise_edges",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Size = tuple[int, ...]

TANGENT = MappingProxyType({"SE2": (0, 0, 0), "SE3": (0,) * 6, "Sim3": (0,) * 7})
"""As many zeros as a pose has unknowns: kernels know the length of a tuple when they are compiled,
and their loops over it are unrolled."""


class EdgeArrays(NamedTuple):
    """Edges: nodes (E,), Z⁻¹ (E, m, m), Ω (E, k, k), weight (E,) and whether the loss applies.

    For the chordal cost Ω is (E, 1, 2) with κ and τ.
    """

    first: Index
    second: Index
    Ts_inverse: Array
    information: Array
    weight: Array
    is_robust: NDArray[np.bool_]


class TargetArrays(NamedTuple):
    """Where to write: values of H and g, and where in them nodes and pairs are.

    Attributes:
        pair: (E,) offset in `values` of each edge's block, -1 if a node of it is held.
        diagonal: (N,) offset in `values` of each node's own block.
        row: (N,) first row of each node, -1 where it is held.
        values: (V,) of H.
        gradient: (n,).
    """

    pair: Index
    diagonal: Index
    row: Index
    values: Array
    gradient: Array


@kernel(reorder=True)
def relative_motion(
    tangent: Size, Ts: Array, i: int, j: int, Zs_inverse: Array, e: int, D: Array, E: Array
) -> None:
    """D = T_i⁻¹ T_j and E = Z_e⁻¹ D, rigid motions of the plane (3, 3) or of space (4, 4)."""
    d = 2 if len(tangent) == 3 else 3
    for a in range(d):
        for b in range(d + 1):
            total = 0.0
            for c in range(d):
                moved = Ts[j, c, b] - Ts[i, c, b] if b == d else Ts[j, c, b]
                total += Ts[i, c, a] * moved
            D[a, b] = total
    for a in range(d):
        for b in range(d + 1):
            total = Zs_inverse[e, a, d] if b == d else 0.0
            for c in range(d):
                total += Zs_inverse[e, a, c] * D[c, b]
            E[a, b] = total


@kernel(reorder=True)
def adjoint_of_inverse(tangent: Size, D: Array, M: Array) -> None:
    """M = Ad(D⁻¹): [[Rᵀ, -Rᵀ t^], [0, Rᵀ]], or in the plane [[Rᵀ, -Rᵀ (t_y, -t_x)], [0, 1]]."""
    if len(tangent) == 3:
        for a in range(2):
            M[a, 0], M[a, 1] = D[0, a], D[1, a]
            M[a, 2] = -D[0, a] * D[1, 2] + D[1, a] * D[0, 2]
            M[2, a] = 0.0
        M[2, 2] = 1.0
        return
    x, y, z = D[0, 3], D[1, 3], D[2, 3]
    for a in range(3):
        u, v, w = D[0, a], D[1, a], D[2, a]
        M[a, 0], M[a, 1], M[a, 2] = u, v, w
        M[3 + a, 3], M[3 + a, 4], M[3 + a, 5] = u, v, w
        M[3 + a, 0], M[3 + a, 1], M[3 + a, 2] = 0.0, 0.0, 0.0
        # A row m of Rᵀ times -t^ is t × m.
        M[a, 3], M[a, 4], M[a, 5] = y * w - z * v, z * u - x * w, x * v - y * u


@kernel
def _log_in_the_plane(E: Array, r: Array) -> None:
    """r = (V⁻¹ t, θ), V⁻¹ = (1 - h θ²) I - θ/2 [[0, -1], [1, 0]]."""
    theta = np.arctan2(E[1, 0], E[0, 0])
    c = 1.0 - theta * theta * half_cot(theta * theta)
    r[0] = c * E[0, 2] + 0.5 * theta * E[1, 2]
    r[1] = c * E[1, 2] - 0.5 * theta * E[0, 2]
    r[2] = theta


@kernel
def _inverse_right_jacobian_in_the_plane(r: Array, J: Array) -> None:
    """J = I + ad/2 + h ad², since ad³ = -θ² ad."""
    x, y, theta = r[0], r[1], r[2]
    h = half_cot(theta * theta)
    c = 1.0 - h * theta * theta
    J[0, 0], J[0, 1], J[0, 2] = c, -0.5 * theta, 0.5 * y + h * theta * x
    J[1, 0], J[1, 1], J[1, 2] = 0.5 * theta, c, -0.5 * x + h * theta * y
    J[2, 0], J[2, 1], J[2, 2] = 0.0, 0.0, 1.0


@kernel
def log_of_error(tangent: Size, E: Array, R: Array, t: Array, r: Array) -> None:
    """r = log E; R and t are room for the parts of E."""
    if len(tangent) == 3:
        _log_in_the_plane(E, r)
        return
    for a in range(3):
        t[a] = E[a, 3]
        for b in range(3):
            R[a, b] = E[a, b]
    se3_log_into(R, t, r)


@kernel(reorder=True)
def _geodesic(
    tangent: Size, r: Array, information: Array, e: int, J: Array, WJ: Array, A: Array, b: Array
) -> float:
    """A = Jᵀ Ω J, b = Jᵀ Ω r; return rᵀ Ω r."""
    k, chi2 = len(tangent), 0.0
    if k == 3:
        _inverse_right_jacobian_in_the_plane(r, J)
    else:
        se3_right_jacobian_inverse_into(r, J)
    for p in range(k):
        total = 0.0
        for q in range(k):
            total += information[e, p, q] * r[q]
        chi2 += r[p] * total
        b[p] = total
        for q in range(k):
            WJ[p, q] = 0.0
        for c in range(k):
            for q in range(k):
                WJ[p, q] += information[e, p, c] * J[c, q]
    for p in range(k):
        for q in range(k):
            A[p, q] = 0.0
    for c in range(k):
        for p in range(k):
            for q in range(k):
                A[p, q] += J[c, p] * WJ[c, q]
    for p in range(k):
        WJ[0, p] = b[p]
    for p in range(k):
        b[p] = 0.0
        for c in range(k):
            b[p] += J[c, p] * WJ[0, c]
    return chi2


@kernel(reorder=True)
def _chordal(tangent: Size, E: Array, kappa: float, tau: float, A: Array, b: Array) -> float:
    """Twice Gauss-Newton's A and b of f = κ |E_R - I|² + τ |E_t|²; return 2 f."""
    k, f = len(tangent), 0.0
    d = 2 if k == 3 else 3
    for p in range(k):
        for q in range(k):
            A[p, q] = 0.0
    for p in range(d):
        A[p, p] = 2.0 * tau
        b[p] = 0.0
        for q in range(d):
            b[p] += 2.0 * tau * E[q, p] * E[q, d]
            off = E[p, q] - (1.0 if p == q else 0.0)
            f += kappa * off * off
        f += tau * E[p, d] * E[p, d]
    for p in range(d, k):
        A[p, p] = 4.0 * kappa
    if d == 2:
        b[2] = 2.0 * kappa * (E[1, 0] - E[0, 1])
    else:
        b[3] = 2.0 * kappa * (E[2, 1] - E[1, 2])
        b[4] = 2.0 * kappa * (E[0, 2] - E[2, 0])
        b[5] = 2.0 * kappa * (E[1, 0] - E[0, 1])
    return 2.0 * f


@kernel(reorder=True)
def scatter(
    tangent: Size,
    w: float,
    rows: tuple[int, int],
    places: tuple[int, int, int],
    A: Array,
    b: Array,
    M: Array,
    MA: Array,
    values: Array,
    gradient: Array,
) -> None:
    """Add w times an edge's A, b to H and g at its nodes; MA is room for Mᵀ A.

    `rows` are those of i and j, -1 where held; `places` are of H_ii, H_jj and the pair, which is
    H_ij if row i comes first, else H_ji.
    """
    k = len(tangent)
    row_i, row_j = rows
    at_i, at_j, pair = places
    if row_j >= 0:
        for p in range(k):
            gradient[row_j + p] += w * b[p]
            for q in range(k):
                values[at_j + k * p + q] += w * A[p, q]
    if row_i < 0:
        return
    for p in range(k):
        for q in range(k):
            MA[p, q] = 0.0
    for c in range(k):
        for p in range(k):
            for q in range(k):
                MA[p, q] += M[c, p] * A[c, q]
    for p in range(k):
        total = 0.0
        for c in range(k):
            total += M[c, p] * b[c]
            for q in range(k):
                values[at_i + k * p + q] += w * MA[p, c] * M[c, q]
        gradient[row_i + p] -= w * total
    if pair < 0:
        return
    if row_i < row_j:
        for p in range(k):
            for q in range(k):
                values[pair + k * p + q] -= w * MA[p, q]
    else:
        for p in range(k):
            for q in range(k):
                values[pair + k * q + p] -= w * MA[p, q]


@kernel
def linearise_edges(
    tangent: Size,
    Ts: Array,
    edges: EdgeArrays,
    is_chordal: bool,
    loss: int,
    width: float,
    into: TargetArrays,
    chi2: Array,
) -> float:
    """Add all edges to H and g at poses Ts (N, m, m); return the cost, write r² of each edge."""
    k = len(tangent)
    m = 3 if k == 3 else 4
    D, E, R, t = np.eye(m), np.eye(m), np.empty((3, 3)), np.empty(3)
    r, b, J, WJ = np.empty(k), np.empty(k), np.empty((k, k)), np.empty((k, k))
    A, M, MA = np.empty((k, k)), np.empty((k, k)), np.empty((k, k))
    # Fields read once: inside the loop each would cost a count of references.
    first, second, Zs, weights = edges.first, edges.second, edges.Ts_inverse, edges.weight
    information, is_robust = edges.information, edges.is_robust
    row, diagonal, pair, values, gradient = (
        into.row,
        into.diagonal,
        into.pair,
        into.values,
        into.gradient,
    )
    cost = 0.0
    for e in range(len(first)):
        i, j = first[e], second[e]
        relative_motion(tangent, Ts, i, j, Zs, e, D, E)
        if is_chordal:
            s = _chordal(tangent, E, information[e, 0, 0], information[e, 0, 1], A, b)
        else:
            log_of_error(tangent, E, R, t, r)
            s = _geodesic(tangent, r, information, e, J, WJ, A, b)
        chi2[e] = s
        w = weights[e]
        if is_robust[e]:
            cost += 0.5 * w * loss_cost(loss, width, s)
            w *= loss_weight(loss, width, s)
        else:
            cost += 0.5 * w * s
        if w > 0.0:
            adjoint_of_inverse(tangent, D, M)
            places = (diagonal[i], diagonal[j], pair[e])
            scatter(tangent, w, (row[i], row[j]), places, A, b, M, MA, values, gradient)
    return cost


@kernel
def cost_of_edges(
    tangent: Size,
    Ts: Array,
    edges: EdgeArrays,
    is_chordal: bool,
    loss: int,
    width: float,
    chi2: Array,
) -> float:
    """Return the cost of all edges at poses Ts (N, m, m), and write r² of each."""
    k = len(tangent)
    m = 3 if k == 3 else 4
    D, E, R, t, r = np.eye(m), np.eye(m), np.empty((3, 3)), np.empty(3), np.empty(k)
    first, second, Zs, weights = edges.first, edges.second, edges.Ts_inverse, edges.weight
    information, is_robust = edges.information, edges.is_robust
    cost = 0.0
    for e in range(len(first)):
        relative_motion(tangent, Ts, first[e], second[e], Zs, e, D, E)
        s = 0.0
        if is_chordal:
            rotation = 0.0
            for p in range(m - 1):
                s += E[p, m - 1] * E[p, m - 1]
                for q in range(m - 1):
                    off = E[p, q] - (1.0 if p == q else 0.0)
                    rotation += off * off
            s = 2.0 * (information[e, 0, 0] * rotation + information[e, 0, 1] * s)
        else:
            log_of_error(tangent, E, R, t, r)
            for p in range(k):
                for q in range(k):
                    s += r[p] * information[e, p, q] * r[q]
        chi2[e] = s
        rho = loss_cost(loss, width, s) if is_robust[e] else s
        cost += 0.5 * weights[e] * rho
    return cost


def compile_edges(group: str) -> None:
    """Compile the kernels for motions of one group, of the plane (SE2) or of space (SE3)."""
    tangent = TANGENT[group]
    k = len(tangent)
    Ts = np.tile(np.eye(3 if k == 3 else 4), (2, 1, 1))
    first, second, one, no = np.array([0]), np.array([1]), np.ones(1), np.zeros(1, np.bool_)
    edges = EdgeArrays(first, second, Ts[:1], np.eye(k)[None], one, no)
    diagonal, row = np.array([-1, 0]), np.array([-1, 0])
    into = TargetArrays(np.array([-1]), diagonal, row, np.zeros(k * k), np.zeros(k))
    linearise_edges(tangent, Ts, edges, False, 0, 1.0, into, np.empty(1))
    cost_of_edges(tangent, Ts, edges, False, 0, 1.0, np.empty(1))
