"""Edges between similarities: the exact derivatives of `edges` for poses with a scale.

A map made by a single camera drifts in scale; closing its loops is a pose graph over Sim(3), seven
unknowns per keyframe. Its logarithm and the inverse Jacobian have no short closed form, and such
graphs have thousands of edges, not a hundred thousand: so r, J and M = Ad(D⁻¹) come from the
batched functions of `lie`, and only the sums into H and g are a kernel. O(edges).

Reference: H. Strasdat, J. M. M. Montiel, A. J. Davison, "Scale drift-aware large scale monocular
SLAM", RSS 2010.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.edges import EdgeArrays, TargetArrays, scatter
from odomap.geometry.lie import (
    sim3_adjoint,
    sim3_inverse,
    sim3_log,
    sim3_right_jacobian_inverse,
)
from odomap.geometry.robust_kernels import loss_cost, loss_weight
from odomap.kernels import kernel

__all__ = ["cost_of_similarities", "linearise_similarities", "warm_up"]

Array = NDArray[np.float64]


def linearise_similarities(
    Ts: Array, edges: EdgeArrays, loss: int, width: float, into: TargetArrays, chi2: Array
) -> float:
    """Add all edges to H and g at poses Ts (N, 4, 4); return the cost, write rᵀ Ω r of each."""
    Ds, r = _errors(Ts, edges)
    J, M = sim3_right_jacobian_inverse(r), sim3_adjoint(sim3_inverse(Ds))
    WJ = edges.information @ J
    A = np.swapaxes(J, 1, 2) @ WJ
    b = np.einsum("eab,ea->eb", WJ, r)
    chi2[:] = np.einsum("ea,eab,eb->e", r, edges.information, r)
    return float(_accumulate(edges, loss, width, A, b, np.ascontiguousarray(M), into, chi2))


def cost_of_similarities(
    Ts: Array, edges: EdgeArrays, loss: int, width: float, chi2: Array
) -> float:
    """Return the cost of all edges at poses Ts (N, 4, 4), and write rᵀ Ω r of each."""
    _, r = _errors(Ts, edges)
    chi2[:] = np.einsum("ea,eab,eb->e", r, edges.information, r)
    return float(_weigh(edges, loss, width, chi2))


def _errors(Ts: Array, edges: EdgeArrays) -> tuple[Array, Array]:
    """Return D = T_i⁻¹ T_j (E, 4, 4) and r = log(Z⁻¹ D) (E, 7)."""
    Ds = sim3_inverse(Ts[edges.first]) @ Ts[edges.second]
    return Ds, sim3_log(edges.Ts_inverse @ Ds)


@kernel
def _weigh(edges: EdgeArrays, loss: int, width: float, chi2: Array) -> float:
    """½ Σ w ρ(r²)."""
    cost = 0.0
    for e in range(len(chi2)):
        rho = loss_cost(loss, width, chi2[e]) if edges.is_robust[e] else chi2[e]
        cost += 0.5 * edges.weight[e] * rho
    return cost


@kernel
def _accumulate(
    edges: EdgeArrays,
    loss: int,
    width: float,
    A: Array,
    b: Array,
    M: Array,
    into: TargetArrays,
    chi2: Array,
) -> float:
    """Scatter A (E, k, k) and b (E, k) of each edge, weighed by its loss; return the cost."""
    MA, tangent = np.empty(A.shape[1:]), (0, 0, 0, 0, 0, 0, 0)
    for e in range(len(chi2)):
        w = edges.weight[e]
        if edges.is_robust[e]:
            w *= loss_weight(loss, width, chi2[e])
        if w > 0.0:
            i, j = edges.first[e], edges.second[e]
            places = (into.diagonal[i], into.diagonal[j], into.pair[e])
            rows = (into.row[i], into.row[j])
            scatter(tangent, w, rows, places, A[e], b[e], M[e], MA, into.values, into.gradient)
    return float(_weigh(edges, loss, width, chi2))


def warm_up() -> None:
    """Compile the kernels of this module."""
    Ts, held = np.tile(np.eye(4), (2, 1, 1)), np.array([-1, -1])
    edges = EdgeArrays(
        np.array([0]), np.array([1]), Ts[:1], np.eye(7)[None], np.ones(1), np.zeros(1, np.bool_)
    )
    into = TargetArrays(held[:1], held, held, np.zeros(49), np.zeros(7))
    linearise_similarities(Ts, edges, 0, 1.0, into, np.empty(1))
    cost_of_similarities(Ts, edges, 0, 1.0, np.empty(1))
