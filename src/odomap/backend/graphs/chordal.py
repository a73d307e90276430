"""The chordal cost of a pose graph: distances between matrices instead of angles.

An edge measured R̃, t̃ between the poses (R_i, t_i) and (R_j, t_j). Measured along straight chords
through the space of matrices rather than along the group, all errors of a graph are

    f = Σ κ |R_j − R_i R̃|²_F + τ |t_j − t_i − R_i t̃|²,

which is quadratic in the entries of R and t: nothing but the condition that R are rotations makes
the problem hard. Dropped, it leaves linear least squares (`initialization`); kept, it has a dual
bound that is often tight (`certificate`). κ and τ are the precisions of the isotropic noise that
stands for an information matrix Ω, by the harmonic means of its eigenvalues:

    plane: κ = Ω_θθ, τ = 2 / tr(Ω_t⁻¹);     space: κ = 3 / (2 tr(Ω_R⁻¹)), τ = 3 / tr(Ω_t⁻¹)

(|R̃ − R|²_F is 2θ², of three degrees of freedom in space, where Ω measures θ²). O(E).

Reference: D. M. Rosen, L. Carlone, A. S. Bandeira, J. J. Leonard, "SE-Sync: A certifiably correct
algorithm for synchronization over the special Euclidean group", IJRR 38(2-3), 2019.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.posegraph import PoseGraph
from odomap.errors import InputError
from odomap.kernels import kernel

__all__ = ["chordal_cost", "chordal_costs", "isotropic_costs", "isotropic_weights", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def chordal_cost(graph: PoseGraph) -> float:
    """Return the chordal cost f of a graph at its poses.

    Args:
        graph: of poses in SE2 or SE3, all known; priors and landmarks do not count.

    Raises:
        InputError: the group is Sim3, or poses are not known.

    Example:
        >>> T, Ts = np.eye(3), np.stack([np.eye(3)] * 2)
        >>> T[0, 2] = 3.0
        >>> chordal_cost(PoseGraph("SE2", Ts, [0], [1], [T], [np.eye(3)]))
        9.0
    """
    return float(chordal_costs(graph).sum())


def chordal_costs(graph: PoseGraph) -> Array:
    """Return what each edge (E,) adds to the chordal cost; raises as `chordal_cost`."""
    if graph.group == "Sim3":
        raise InputError("chordal cost: is not defined for Sim3, fix the scale or use 'geodesic'")
    if not np.isfinite(graph.Ts_world_node).all():
        raise InputError("chordal cost: poses are not known, initialise them first")
    kappa, tau = isotropic_weights(graph.information, graph.space)
    edges = graph.first, graph.second, graph.Ts_first_second, kappa, tau
    return isotropic_costs(graph.Ts_world_node, *edges)


def isotropic_costs(
    Ts: Array, first: Index, second: Index, Zs: Array, kappa: Array, tau: Array
) -> Array:
    """Return the chordal cost (E,) of edges measured as Zs (E, m, m) between poses Ts (N, m, m)."""
    costs = np.empty(len(first))
    _costs(Ts, first, second, Zs, kappa, tau, costs)
    return costs


def isotropic_weights(information: Array, space: int) -> tuple[Array, Array]:
    """Return the precisions that stand for information matrices.

    Args:
        information: (E, k, k) in the tangent (translation, rotation[, log scale]).
        space: 2 or 3 dimensions.

    Returns:
        κ (E,) of rotations and τ (E,) of translations; 0 where the information is singular.
    """
    kappa, tau = np.empty(len(information)), np.empty(len(information))
    _weights(np.ascontiguousarray(information), space, kappa, tau)
    return kappa, tau


@kernel
def _harmonic_mean(A: Array, at: int, space: int) -> float:
    """d / tr(B⁻¹) of the d×d block B at (at, at): d det B / the sum of its principal minors."""
    a, b, c = A[at, at], A[at + 1, at + 1], A[at, at + 1]
    if space == 2:
        determinant, minors = a * b - c * c, a + b
    else:
        f, d, e = A[at + 2, at + 2], A[at, at + 2], A[at + 1, at + 2]
        determinant = a * (b * f - e * e) - c * (c * f - d * e) + d * (c * e - b * d)
        minors = a * b - c * c + a * f - d * d + b * f - e * e
    if not (determinant > 0.0 and minors > 0.0):
        return 0.0
    return float(space * determinant / minors)


@kernel
def _weights(information: Array, space: int, kappa: Array, tau: Array) -> None:
    """κ, τ as the docstring of the module has them."""
    here = space - space  # a literal zero would compile `_harmonic_mean` once more
    for e in range(len(information)):
        tau[e] = _harmonic_mean(information[e], here, space)
        if space == 2:
            kappa[e] = max(information[e, 2, 2], 0.0)
        else:
            kappa[e] = 0.5 * _harmonic_mean(information[e], here + 3, space)


@kernel
def _costs(
    Ts: Array, first: Index, second: Index, Zs: Array, kappa: Array, tau: Array, costs: Array
) -> None:
    """κ |R_j − R_i R̃|²_F + τ |t_j − t_i − R_i t̃|² of each edge."""
    d = Ts.shape[1] - 1
    for e in range(len(first)):
        i, j = first[e], second[e]
        turn, shift = 0.0, 0.0
        for a in range(d):
            for b in range(d + 1):
                off = Ts[j, a, b]
                for c in range(d):
                    off -= Ts[i, a, c] * Zs[e, c, b]
                if b < d:
                    turn += off * off
                else:
                    off -= Ts[i, a, d]
                    shift += off * off
        costs[e] = kappa[e] * turn + tau[e] * shift


def warm_up() -> None:
    """Compile the kernels of this module."""
    Ts = np.stack([np.eye(3), np.eye(3)])
    graph = PoseGraph("SE2", Ts, np.array([0]), np.array([1]), Ts[:1], Ts[:1])
    chordal_cost(graph)
