"""Landmarks beside poses: a point seen in the frame of a node.

A sight says that node i, at T_i = [[s R, t], [0, 1]], has landmark p at z in its own frame,

    r = q - z,   q = (s R)⁻¹ (p - t),   chi² = rᵀ Ω r,

linear in the point, ∂r/∂p = (s R)⁻¹; moving the node by ξ = (ρ, φ, λ) on the right changes q by
-(ρ + φ × q + λ q), the plane and rigid motions having fewer of these terms. O(sights).

Reference: F. Dellaert, M. Kaess, "Square root SAM", IJRR 25(12), 2006.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.robust_kernels import loss_cost, loss_weight
from odomap.kernels import kernel

__all__ = ["SightArrays", "SightTargets", "cost_of_sights", "linearise_sights", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class SightArrays(NamedTuple):
    """Sights: node and point (S,), measured (S, d), Ω (S, d, d)."""

    node: Index
    point: Index
    measured: Array
    information: Array


class SightTargets(NamedTuple):
    """Where to write, as `edges.TargetArrays`: of nodes (N,), of points (M,), of pairs (S,)."""

    node_row: Index
    node_diagonal: Index
    point_row: Index
    point_diagonal: Index
    pair: Index
    values: Array
    gradient: Array


@kernel
def residual(T: Array, p: Array, z: Array, q: Array, r: Array) -> float:
    """q = (s R)⁻¹ (p - t), r = q - z; returns 1/s², so that (s R)⁻¹ = (s R)ᵀ / s²."""
    d, size = len(p), 0.0
    for c in range(d):
        size += T[c, 0] * T[c, 0]
    inverse = 1.0 / size
    for a in range(d):
        total = 0.0
        for c in range(d):
            total += T[c, a] * (p[c] - T[c, d])
        q[a] = total * inverse
        r[a] = q[a] - z[a]
    return inverse


@kernel
def _quadratic(r: Array, information: Array, Wr: Array) -> float:
    """Wr = Ω r; returns rᵀ Ω r."""
    s = 0.0
    for a in range(len(r)):
        Wr[a] = 0.0
        for b in range(len(r)):
            Wr[a] += information[a, b] * r[b]
        s += r[a] * Wr[a]
    return s


@kernel
def _jacobian_of_node(q: Array, J: Array) -> None:
    """∂r/∂ξ = -(I, -q^, q), columns (translation, rotation, log scale); J (d, k) holds zeros."""
    d, k = J.shape
    for a in range(d):
        J[a, a] = -1.0
    if d == 2:
        J[0, 2], J[1, 2] = q[1], -q[0]
        return
    J[0, 4], J[0, 5] = -q[2], q[1]
    J[1, 3], J[1, 5] = q[2], -q[0]
    J[2, 3], J[2, 4] = -q[1], q[0]
    if k == 7:
        for a in range(3):
            J[a, 6] = -q[a]


@kernel
def linearise_sights(
    Ts: Array,
    points: Array,
    sights: SightArrays,
    k: int,
    loss: int,
    width: float,
    into: SightTargets,
    chi2: Array,
) -> float:
    """Add all sights to H and g; return the cost, write rᵀ Ω r of each."""
    d, cost = points.shape[1], 0.0
    q, r, Wr = np.empty(d), np.empty(d), np.empty(d)
    J, WJ, P, WP = np.zeros((d, k)), np.empty((d, k)), np.empty((d, d)), np.empty((d, d))
    values, gradient = into.values, into.gradient
    for o in range(len(sights.node)):
        i, m = sights.node[o], sights.point[o]
        inverse = residual(Ts[i], points[m], sights.measured[o], q, r)
        s = _quadratic(r, sights.information[o], Wr)
        chi2[o] = s
        cost += 0.5 * loss_cost(loss, width, s)
        w = loss_weight(loss, width, s)
        _jacobian_of_node(q, J)
        for a in range(d):
            for b in range(d):
                P[a, b] = Ts[i, b, a] * inverse
        for a in range(d):
            for b in range(d):
                WP[a, b] = 0.0
                for c in range(d):
                    WP[a, b] += w * sights.information[o, a, c] * P[c, b]
            for b in range(k):
                WJ[a, b] = 0.0
                for c in range(d):
                    WJ[a, b] += w * sights.information[o, a, c] * J[c, b]
        row, at = into.point_row[m], into.point_diagonal[m]
        for a in range(d):
            for c in range(d):
                gradient[row + a] += w * P[c, a] * Wr[c]
                for b in range(d):
                    values[at + d * a + b] += P[c, a] * WP[c, b]
        row, at = into.node_row[i], into.node_diagonal[i]
        if row < 0:
            continue
        pair = into.pair[o]
        for a in range(k):
            for c in range(d):
                gradient[row + a] += w * J[c, a] * Wr[c]
                for b in range(k):
                    values[at + k * a + b] += J[c, a] * WJ[c, b]
                for b in range(d):
                    values[pair + d * a + b] += J[c, a] * WP[c, b]
    return cost


@kernel
def cost_of_sights(
    Ts: Array, points: Array, sights: SightArrays, loss: int, width: float, chi2: Array
) -> float:
    """Return the cost of all sights, and write rᵀ Ω r of each."""
    d, cost = points.shape[1], 0.0
    q, r, Wr = np.empty(d), np.empty(d), np.empty(d)
    for o in range(len(sights.node)):
        m = sights.point[o]
        residual(Ts[sights.node[o]], points[m], sights.measured[o], q, r)
        chi2[o] = _quadratic(r, sights.information[o], Wr)
        cost += 0.5 * loss_cost(loss, width, chi2[o])
    return cost


def warm_up() -> None:
    """Compile the kernels of this module."""
    zero, held = np.array([0]), np.array([-1])
    for m, k in ((3, 3), (4, 6)):
        d = m - 1
        Ts, points = np.eye(m)[None].copy(), np.ones((1, d))
        sights = SightArrays(zero, zero, np.zeros((1, d)), np.eye(d)[None].copy())
        into = SightTargets(held, held, zero, zero, held, np.zeros(d * d), np.zeros(d))
        linearise_sights(Ts, points, sights, k, 0, 1.0, into, np.empty(1))
        cost_of_sights(Ts, points, sights, 0, 1.0, np.empty(1))
