"""A proof that poses are the best there are.

Least squares on rotations only ever finds a local minimum, but the chordal cost f of `chordal` is
quadratic in X = [R_1 t_1 … R_N t_N], f = tr(X M Xᵀ), and R_iᵀ R_i = I is quadratic, too. So every
choice of symmetric multipliers Λ_i and of scales D_i > 0 bounds f for all poses whatever,

    f ≥ Σ tr Λ_i − d |λ| Σ D_i,      S = M − diag(Λ_i, 0),

λ the smallest eigenvalue of D^−½ S̃ D^−½, S̃ being S after positions are eliminated. At a critical
point the multipliers are known, Λ_i = sym(R_iᵀ (X M)_i), and Σ tr Λ_i is f itself: if S has no
negative eigenvalue, no poses are better. It always has the d rows of X for eigenvectors of zero.

What is proven is that poses are optimal within x = f − bound. Two scales are tried: D = 1, whose λ
is SE-Sync's, and each node's stiffness (`dualmatrix`), since beside stiff edges no eigenvalue of
soft ones looks negative. "Globally optimal" asks of each connected component by itself that both λ
are zero to rounding and to what a solver leaves, and that x is negligible beside its own cost.

S̃ is full; S has the sparsity of the graph, is positive semidefinite exactly if S̃ is, and shifting
the rotations' diagonal by η shifts S̃: a Cholesky factorisation of S + η diag(D, 0) succeeds exactly
if λ > −η, and Lanczos' method on its inverse finds λ. Cost: two factorisations, thirty solves.

Reference: D. M. Rosen, L. Carlone, A. S. Bandeira, J. J. Leonard, "SE-Sync: A certifiably correct
algorithm for synchronization over the special Euclidean group", IJRR 38(2-3), 2019.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.chordal import isotropic_costs, isotropic_weights
from odomap.backend.graphs.components import connected_components
from odomap.backend.graphs.dualmatrix import DualMatrix, IsotropicEdges
from odomap.backend.graphs.posegraph import PoseGraph
from odomap.backend.graphs.projection import nearest_rotations
from odomap.backend.sparse.blockcholesky import BlockCholesky
from odomap.errors import InputError

__all__ = ["Certificate", "certify", "check_certifiable", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_SHIFTS = (1e-9, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Shifts tried, relative to the norm: the smaller, the sharper Lanczos sees what is beyond it."""

_NEGATIVE = 1e-6
"""How negative the smallest eigenvalue may be, relative to the norm and to nodes' stiffness."""

_SUBOPTIMAL = 3e-4
"""How far the cost may be above its lower bound, relative to it."""

_ROUNDING = 1e-13
"""What rounding adds to that, relative to the stiffness of all rotations together."""

_SQUARABLE = 1e145
"""The largest entry of which a sum of squares can be represented."""


@dataclass(frozen=True)
class Certificate:
    """What is proven about how good the poses of a graph are: optimal within `suboptimality`.

    Attributes:
        certified: whether, in every component, no eigenvalue is negative beyond rounding and what
            is left open, `suboptimality`, is below 3e-4 of the component's cost.
        reason: why, or why not, as a sentence.
        cost: chordal cost f of the poses, priors counted as edges from the world.
        lower_bound: no poses whatever cost less than this; holds whether certified or not.
        smallest_eigenvalue: λ_min of SE-Sync's certificate matrix S̃, positions eliminated; −inf if
            rounding leaves nothing to be said.
        norm: largest eigenvalue of the same matrix before positions are eliminated, |S|.
        scaled_eigenvalue: λ_min of D^−½ S̃ D^−½, the entries of S̃ relative to the stiffness D of
            their nodes, or a number below it that is close enough to zero.
        decrease: about what further descent would take off the cost; 0 at a critical point.
        num_components: how many connected components the edges that have information make.
    """

    certified: bool
    reason: str
    cost: float
    lower_bound: float
    smallest_eigenvalue: float
    norm: float
    scaled_eigenvalue: float
    decrease: float
    num_components: int

    @property
    def suboptimality(self) -> float:
        """How much less than these, at most, other poses may cost."""
        return max(self.cost - self.lower_bound, 0.0)


class _Proof(NamedTuple):
    """Of one component: as `Certificate`, and what may be left open if it is to be certified."""

    cost: float
    lower_bound: float
    smallest: float
    norm: float
    scaled: float
    decrease: float
    slack: float

    @property
    def is_closed(self) -> bool:
        return (
            self.smallest >= -_NEGATIVE * self.norm
            and self.scaled >= -_NEGATIVE
            and self.cost - self.lower_bound <= self.slack
        )


def certify(graph: PoseGraph, order: Index | None = None) -> Certificate:
    """Prove that no poses of a graph have a lower chordal cost, or tell how much lower it may be.

    Args:
        graph: of poses in SE2 or SE3 at a minimum of the chordal cost, as `solve(graph,
            cost="chordal")` finds it. At a minimum of the geodesic cost there is nothing to prove.
            Edges and priors without information count as absent.
        order: (N,) elimination order of the nodes; approximate minimum degree unless given.

    Returns:
        Certificate: other poses cost less by at most its `suboptimality`.

    Raises:
        InputError: as `check_certifiable`, or poses are not known.

    Example:
        >>> Ts = np.stack([np.eye(3)] * 3)
        >>> graph = PoseGraph("SE2", Ts, [0, 1, 2], [1, 2, 0], Ts, [np.eye(3)] * 3)
        >>> certify(graph).certified
        True
    """
    count = check_certifiable(graph)
    if not np.isfinite(graph.Ts_world_node).all():
        raise InputError("certificate: poses are not known, initialise and solve first")
    edges = _measured(graph)
    d = graph.space
    Ts = np.concatenate([graph.Ts_world_node, np.eye(d + 1)[None]])
    Ts[:, :d, :d] = nearest_rotations(Ts[:, :d, :d])
    if order is not None:
        order = np.append(order, graph.num_nodes)
    return _certificate([_prove(*part) for part in _parts(Ts, edges, order)], count)


def check_certifiable(graph: PoseGraph) -> int:
    """Return how many components a graph has, if it is of a kind that can be certified.

    Raises:
        InputError: it is in Sim3, has landmarks, measures nothing, has lengths or information too
            large to be squared, or a component that more than one fixed node or both a fixed node
            and a prior hold.
    """
    if graph.group == "Sim3":
        raise InputError("certificate: there is none for Sim3, only for SE2 and SE3")
    if len(graph.points.node):
        raise InputError("certificate: there is none for landmarks, only for poses")
    edges, world = _measured(graph), graph.num_nodes
    if not len(edges.first):
        raise InputError(
            "certificate: there is nothing to prove: no edge and no prior has information"
        )
    is_prior = edges.first == world
    label = connected_components(world, edges.first[~is_prior], edges.second[~is_prior])
    count = int(label.max()) + 1
    holds = np.bincount(label[graph.is_fixed], minlength=count)
    # All priors are edges from the same node, the world, which holds every component they are in.
    holds[np.unique(label[edges.second[is_prior]])] += 1
    if (holds > 1).any():
        node = graph.ids[np.argmax(holds[label] > 1)]
        raise InputError(
            f"certificate: more than one fixed node, or one beside priors, holds node {node} and "
            "those tied to it; fix one only, as the proof knows nothing of fixed nodes"
        )
    return count


def _measured(graph: PoseGraph) -> IsotropicEdges:
    """Return edges and, from the world as node N, priors; those that weigh nothing are left out."""
    priors, d = graph.priors, graph.space
    Zs = np.concatenate([graph.Ts_first_second, priors.Ts_world_node])
    information = np.concatenate([graph.information, priors.information])
    kappa, tau = isotropic_weights(information, d)
    with np.errstate(over="ignore", invalid="ignore"):
        size = kappa + tau * (1.0 + np.sum(Zs[:, :d, d] ** 2, axis=1))
    bad = np.flatnonzero(~(size < _SQUARABLE))
    if len(bad):
        e = int(bad[0])
        name = graph.name_of_edge(e) if e < graph.num_edges else f"prior {e - graph.num_edges}"
        raise InputError(f"certificate: {name}: its length or information is too large for a proof")
    first = np.concatenate([graph.first, np.full(len(priors.node), graph.num_nodes)])
    second = np.concatenate([graph.second, priors.node])
    keep = (kappa > 0.0) | (tau > 0.0)
    return IsotropicEdges(first[keep], second[keep], Zs[keep], kappa[keep], tau[keep])


def _parts(
    Ts: Array, edges: IsotropicEdges, order: Index | None
) -> Iterator[tuple[Array, IsotropicEdges, Index | None]]:
    """Yield poses, edges and elimination order of each connected component that has edges."""
    label = connected_components(len(Ts), edges.first, edges.second)
    local = np.empty(len(Ts), np.int64)
    nodes_of = _grouped(label, np.arange(len(Ts)))
    edges_of = _grouped(label[edges.first], np.arange(len(edges.first)), len(nodes_of))
    order_of = nodes_of if order is None else _grouped(label[order], order)
    for nodes, inner, eliminated in zip(nodes_of, edges_of, order_of, strict=True):
        if len(inner):
            local[nodes] = np.arange(len(nodes))
            ends = local[edges.first[inner]], local[edges.second[inner]]
            part = IsotropicEdges(*ends, edges.Zs[inner], edges.kappa[inner], edges.tau[inner])
            yield Ts[nodes], part, None if order is None else local[eliminated]


def _grouped(label: Index, items: Index, count: int = 0) -> list[Index]:
    """Return the items of each label, 0 and up, in the order given."""
    ends = np.cumsum(np.bincount(label, minlength=count))
    return np.split(items[np.argsort(label, kind="stable")], ends[:-1])


def _prove(Ts: Array, edges: IsotropicEdges, order: Index | None) -> _Proof:
    """Prove what can be proven about the poses of one connected component."""
    cost = float(isotropic_costs(Ts, *edges).sum())
    matrix = DualMatrix.at(edges, Ts)
    factor = BlockCholesky(matrix.pattern, order)
    d, norm, stiffness = matrix.space, matrix.norm(), matrix.stiffness
    slack = _SUBOPTIMAL * cost + _ROUNDING * 2.0 * d * float(edges.kappa.sum())
    smallest, shift = -np.inf, _shift(matrix, factor, np.full(len(Ts), norm))
    decrease, bound = np.inf, 0.0
    if shift is not None:
        smallest = norm * matrix.smallest_eigenvalue(factor, shift, np.full(len(Ts), norm))
        decrease = matrix.decrease(factor)
        # X is null: what rounding makes of that zero may be positive, and is as much off below.
        bound = max(matrix.trace - matrix.size * abs(smallest), 0.0)
    # xᵀ S̃ x ≥ −|λ| |x|² ≥ −|λ| xᵀ D x / min D: where that says enough, stop.
    scaled = -abs(smallest) / float(stiffness.min())
    proof = _Proof(cost, bound, smallest, norm, scaled, decrease, slack)
    if proof.is_closed:
        return proof
    scaled, shift = -np.inf, _shift(matrix, factor, stiffness)
    if shift is not None:
        scaled = matrix.smallest_eigenvalue(factor, shift, stiffness)
        bound = max(bound, matrix.trace - d * float(stiffness.sum()) * abs(scaled))
        smallest = max(smallest, min(scaled, 0.0) * float(stiffness.max()))
    return proof._replace(lower_bound=bound, smallest=smallest, scaled=scaled)


def _shift(matrix: DualMatrix, factor: BlockCholesky, scale: Array) -> float | None:
    """Factor S + η diag(D, 0), D = scale (N,), with the least η that makes it definite."""
    for shift in _SHIFTS:
        if factor.factor(matrix.shifted(shift * scale)):
            return shift
    return None


def _certificate(proofs: list[_Proof], count: int) -> Certificate:
    """Return what the proofs of components say together."""
    is_certified = all(proof.is_closed for proof in proofs)
    cost, bound = sum(p.cost for p in proofs), sum(p.lower_bound for p in proofs)
    smallest, scaled = min(p.smallest for p in proofs), min(p.scaled for p in proofs)
    norm, decrease = max(p.norm for p in proofs), sum(p.decrease for p in proofs)
    if is_certified:
        reason = "globally optimal"
    elif not np.isfinite(smallest + scaled):
        reason = (
            "not certified: information or lengths of edges differ too much for a factorisation; "
            "leave out edges of negligible information"
        )
    elif any(p.decrease > p.slack for p in proofs):
        reason = (
            f"not certified: no minimum of the chordal cost, a step would take {decrease:.3g} off "
            f"{cost:.6g}; solve with cost 'chordal' first"
        )
    else:
        reason = (
            f"not certified: the smallest eigenvalue is {smallest:.3g}, {smallest / norm:.1e} of "
            f"the norm and {scaled:.1e} of nodes' stiffness: a local minimum, or too much noise "
            "for a proof"
        )
    return Certificate(is_certified, reason, cost, bound, smallest, norm, scaled, decrease, count)


def warm_up() -> None:
    """Compile what proofs need."""
    Ts = np.stack([np.eye(3), np.eye(3)])
    certify(PoseGraph("SE2", Ts, np.array([0]), np.array([1]), Ts[:1], Ts[:1]))
