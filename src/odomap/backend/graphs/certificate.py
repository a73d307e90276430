"""A proof that poses are the best there are.

Least squares on rotations only ever finds a local minimum, but the chordal cost f of `chordal` is
quadratic in X = [R_1 t_1 … R_N t_N], f = tr(X M Xᵀ), and R_iᵀ R_i = I is quadratic, too. So every
choice of symmetric multipliers Λ_i bounds f from below for all graphs of poses at once,

    f ≥ Σ tr Λ_i + d N min(0, λ_min),      S = M − diag(Λ_i, 0),

with λ_min the smallest eigenvalue of S after the positions are eliminated. At a critical point the
multipliers are known, Λ_i = sym(R_iᵀ (X M)_i), and Σ tr Λ_i is f itself: if S has no negative
eigenvalue, no other poses are better. S always has the d rows of X for eigenvectors of zero.

Eliminating the positions gives SE-Sync's matrix S̃ of dN rows, which is full, and whose eigenvalues
do not depend on the unit of length. Here they stay in, S has blocks of d + 1 and the sparsity of
the graph, and is positive semidefinite exactly if S̃ is. Positions have quadratic terms alone, so
shifting the rotations' diagonal by η shifts the eigenvalues of S̃: a Cholesky factorisation of
S + η diag(I, 0) succeeds exactly if λ_min(S̃) > −η, and the inverse of S̃ + ηI is a solve with it of
which the rotations are kept. Lanczos' method on that inverse finds λ_min itself (`lanczos`).

Cost: one factorisation of the graph, and about fifteen solves.

Reference: D. M. Rosen, L. Carlone, A. S. Bandeira, J. J. Leonard, "SE-Sync: A certifiably correct
algorithm for synchronization over the special Euclidean group", IJRR 38(2-3), 2019.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.chordal import chordal_cost, isotropic_weights
from odomap.backend.graphs.components import connected_components, find_components
from odomap.backend.graphs.posegraph import PoseGraph
from odomap.backend.graphs.projection import nearest_rotations
from odomap.backend.sparse.blockcholesky import BlockCholesky
from odomap.backend.sparse.blocks import BlockPattern
from odomap.backend.sparse.lanczos import largest_eigenvalue
from odomap.errors import InputError
from odomap.kernels import kernel

__all__ = ["Certificate", "certify", "check_certifiable", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bool = NDArray[np.bool_]

_SHIFTS = (1e-9, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Shifts tried, relative to the norm: the smaller, the sharper Lanczos sees what is beyond it."""

_NEGATIVE = 1e-6
"""How negative the smallest eigenvalue may be, relative to the norm."""

_SUBOPTIMAL = 1e-3
"""How far the cost may be above its lower bound, relative to it."""

_ROUNDING = 1e-13
"""What rounding adds to that, relative to the sum of all eigenvalues at most."""


@dataclass(frozen=True)
class Certificate:
    """What is known about how good the poses of a graph are.

    Attributes:
        certified: whether the poses are proven to be the global minimum of the chordal cost.
        reason: why, or why not, as a sentence.
        cost: chordal cost f of the poses, priors counted as edges from the world.
        lower_bound: no poses whatever cost less than this.
        smallest_eigenvalue: λ_min of SE-Sync's certificate matrix S̃, positions eliminated.
        norm: largest eigenvalue of the same matrix before positions are eliminated, |S|.
        decrease: what one Newton step would take off the cost; 0 at a critical point.
        num_components: how many connected components the graph has; all are proven together.
    """

    certified: bool
    reason: str
    cost: float
    lower_bound: float
    smallest_eigenvalue: float
    norm: float
    decrease: float
    num_components: int

    @property
    def suboptimality(self) -> float:
        """How much less, at most, other poses may cost."""
        return max(self.cost - self.lower_bound, 0.0)


def certify(graph: PoseGraph, order: Index | None = None) -> Certificate:
    """Prove that the poses of a graph are the global minimum of its chordal cost, or fail to.

    Args:
        graph: of poses in SE2 or SE3 at a minimum of the chordal cost, as `solve(graph,
            cost="chordal")` finds it. At a minimum of the geodesic cost there is nothing to prove.
        order: (N,) elimination order of the nodes; approximate minimum degree unless given.

    Returns:
        Certificate.

    Raises:
        InputError: the graph is in Sim3, has landmarks, a component that more than one fixed node
            or both a fixed node and a prior hold, or poses that are not known.

    Example:
        >>> Ts = np.stack([np.eye(3)] * 3)
        >>> graph = PoseGraph("SE2", Ts, [0, 1, 2], [1, 2, 0], Ts, [np.eye(3)] * 3)
        >>> certify(graph).certified
        True
    """
    count = check_certifiable(graph)
    if len(graph.priors.node):
        graph, order = _with_world(graph), None
    d = graph.space
    Ts = graph.Ts_world_node.copy()
    Ts[:, :d, :d] = nearest_rotations(Ts[:, :d, :d])
    cost = chordal_cost(graph.placed(Ts))
    matrix = _Matrix.at(graph, Ts)
    norm = matrix.norm()
    factor = BlockCholesky(matrix.pattern, order)
    shift = _shift(matrix, factor, norm)
    smallest = matrix.smallest_eigenvalue(factor, shift)
    decrease = matrix.decrease(factor)
    bound = max(matrix.trace + matrix.size * min(smallest, 0.0), 0.0)
    slack = _SUBOPTIMAL * cost + _ROUNDING * norm * matrix.size
    is_certified = smallest >= -_NEGATIVE * norm and cost - bound <= slack
    if is_certified:
        reason = "globally optimal"
    elif decrease > slack:
        reason = (
            f"not certified: no minimum of the chordal cost, a step would take {decrease:.3g} off "
            f"{cost:.6g}; solve with cost 'chordal' first"
        )
    else:
        reason = (
            f"not certified: the smallest eigenvalue is {smallest:.3g}, {smallest / norm:.1e} of "
            "the norm: a local minimum, or too much noise for a proof"
        )
    return Certificate(is_certified, reason, cost, bound, smallest, norm, decrease, count)


def check_certifiable(graph: PoseGraph) -> int:
    """Return how many components a graph has, if it is of a kind that can be certified.

    Raises:
        InputError: it is in Sim3, has landmarks, or a component that more than one fixed node or
            both a fixed node and a prior hold.
    """
    if graph.group == "Sim3":
        raise InputError("certificate: there is none for Sim3, only for SE2 and SE3")
    if len(graph.points.node):
        raise InputError("certificate: there is none for landmarks, only for poses")
    components = find_components(graph)
    holds = np.bincount(components.label[graph.is_fixed], minlength=components.count)
    # All priors are edges from the same node, the world, which holds every component they are in.
    holds += components.has_prior
    if (holds > 1).any():
        node = graph.ids[components.anchor[np.argmax(holds > 1)]]
        raise InputError(
            f"certificate: more than one fixed node, or one beside priors, holds node {node} and "
            "those tied to it; fix one only, as the proof knows nothing of fixed nodes"
        )
    return components.count


def _with_world(graph: PoseGraph) -> PoseGraph:
    """Return the graph with the world as its last node, and priors as edges from there."""
    priors, n = graph.priors, graph.num_nodes
    world = np.full(len(priors.node), n)
    return PoseGraph(
        graph.group,
        np.concatenate([graph.Ts_world_node, np.eye(graph.space + 1)[None]]),
        np.concatenate([graph.first, world]),
        np.concatenate([graph.second, priors.node]),
        np.concatenate([graph.Ts_first_second, priors.Ts_world_node]),
        np.concatenate([graph.information, priors.information]),
    )


def _shift(matrix: "_Matrix", factor: BlockCholesky, norm: float) -> float:
    """Return the least of the shifts that makes the matrix definite, and leave it factored."""
    for relative in _SHIFTS:
        shift = relative * (norm if norm > 0.0 else 1.0)
        if factor.factor(matrix.shifted(shift)):
            return shift
    raise InputError(
        "certificate: information of edges differs too much for a factorisation "
        f"(at node {factor.failed_block}): leave out edges of negligible information"
    )


@dataclass(frozen=True)
class _Matrix:
    """S with the position of one node per component struck out, and what belongs to it."""

    pattern: BlockPattern
    values: Array
    gradient: Array  # (N, d, d + 1) X S, half the gradient of f; 0 where struck out
    trace: float  # Σ tr Λ_i
    space: int

    @classmethod
    def at(cls, graph: PoseGraph, Ts: Array) -> "_Matrix":
        """Return the matrix at poses whose rotations are exact."""
        n, d = graph.num_nodes, graph.space
        kappa, tau = isotropic_weights(graph.information, d)
        pattern = BlockPattern.of(np.full(n, d + 1), graph.first, graph.second)
        pair = pattern.pair_start[pattern.pair_of(graph.first, graph.second)]
        values, G = np.zeros(pattern.num_values), np.zeros((n, d, d + 1))
        edges = graph.first, graph.second, graph.Ts_first_second, kappa, tau
        _cost_matrix(*edges, Ts, pair, pattern.diagonal_start, values, G)
        trace = _subtract_multipliers(Ts, pattern.diagonal_start, values, G)
        moves = connected_components(n, graph.first[tau > 0.0], graph.second[tau > 0.0])
        struck = np.zeros(n, np.bool_)
        struck[np.unique(moves, return_index=True)[1]] = True
        _strike_out(
            pattern.first,
            pattern.second,
            struck,
            d,
            pattern.pair_start,
            pattern.diagonal_start,
            values,
        )
        G[struck, :, d] = 0.0
        return cls(pattern, values, G, trace, d)

    @property
    def size(self) -> int:
        """Rows of S̃."""
        return len(self.pattern.sizes) * self.space

    def shifted(self, shift: float) -> Array:
        """Return the values of S + shift diag(I, 0)."""
        values = self.values.copy()
        values[self.pattern.diagonal.reshape(-1, self.space + 1)[:, : self.space]] += shift
        return values

    def with_positions(self, x: Array) -> Array:
        """Return a vector of rotations (dN,) with zeros for positions put between."""
        y = np.zeros((len(self.pattern.sizes), self.space + 1))
        y[:, : self.space] = x.reshape(-1, self.space)
        return y.reshape(-1)

    def rotations(self, y: Array) -> Array:
        """Return a vector without the entries of positions."""
        return y.reshape(-1, self.space + 1)[:, : self.space].reshape(-1)

    def norm(self) -> float:
        """Return the largest eigenvalue of the rotations' part of S, which bounds that of S̃."""
        if not self.size:
            return 0.0
        multiply = self.pattern.multiply
        return largest_eigenvalue(
            lambda x: self.rotations(multiply(self.values, self.with_positions(x))),
            self.size,
            tolerance=0.1,
        )

    def smallest_eigenvalue(self, factor: BlockCholesky, shift: float) -> float:
        """Return λ_min of S̃, given the factor of S + shift diag(I, 0)."""
        if not self.size:
            return 0.0
        inverse = largest_eigenvalue(
            lambda x: self.rotations(factor.solve(self.with_positions(x))), self.size
        )
        return 1.0 / inverse - shift

    def decrease(self, factor: BlockCholesky) -> float:
        """Return tr(G S⁻¹ Gᵀ), what the step X − G S⁻¹ takes off tr(X S Xᵀ)."""
        rows = np.ascontiguousarray(np.moveaxis(self.gradient, 1, 0)).reshape(self.space, -1)
        return float(sum(np.sum(row * factor.solve(row)) for row in rows))


@kernel
def _cost_matrix(
    first: Index,
    second: Index,
    Zs: Array,
    kappa: Array,
    tau: Array,
    Ts: Array,
    pair: Index,
    diagonal: Index,
    values: Array,
    G: Array,
) -> None:
    """M += V Vᵀ, G += X V Vᵀ; V = √κ (−R̃ at i, I at j) and √τ ((−t̃, −1) at i, (0, 1) at j)."""
    d = Zs.shape[1] - 1
    m = d + 1
    row = np.empty(m)
    for e in range(len(first)):
        i, j, k, w = first[e], second[e], kappa[e], tau[e]
        Z = Zs[e]
        for a in range(d):
            values[diagonal[j] + a * (m + 1)] += k
            for b in range(d):
                turned = w * Z[a, d] * Z[b, d]
                for c in range(d):
                    turned += k * Z[a, c] * Z[b, c]
                values[diagonal[i] + a * m + b] += turned
                values[pair[e] + (a * m + b if i < j else b * m + a)] -= k * Z[a, b]
            values[diagonal[i] + a * m + d] += w * Z[a, d]
            values[diagonal[i] + d * m + a] += w * Z[a, d]
            values[pair[e] + (a * m + d if i < j else d * m + a)] -= w * Z[a, d]
        values[diagonal[i] + m * m - 1] += w
        values[diagonal[j] + m * m - 1] += w
        values[pair[e] + m * m - 1] -= w
        for a in range(d):
            for b in range(m):  # row a of R_j − R_i R̃ and t_j − t_i − R_i t̃, weighted
                row[b] = Ts[j, a, b] - (Ts[i, a, d] if b == d else 0.0)
                for c in range(d):
                    row[b] -= Ts[i, a, c] * Z[c, b]
                row[b] *= w if b == d else k
                G[j, a, b] += row[b]
            for c in range(d):
                for b in range(m):
                    G[i, a, c] -= row[b] * Z[c, b]
            G[i, a, d] -= row[d]


@kernel
def _subtract_multipliers(Ts: Array, diagonal: Index, values: Array, G: Array) -> float:
    """S_ii −= Λ_i = sym(R_iᵀ G_i) and G_i −= R_i Λ_i; returns Σ tr Λ_i."""
    d = Ts.shape[1] - 1
    m = d + 1
    L = np.empty((d, d))
    trace = 0.0
    for i in range(len(Ts)):
        for a in range(d):
            for b in range(d):
                L[a, b] = 0.0
                for c in range(d):
                    L[a, b] += 0.5 * (Ts[i, c, a] * G[i, c, b] + Ts[i, c, b] * G[i, c, a])
        for a in range(d):
            trace += L[a, a]
            for b in range(d):
                values[diagonal[i] + a * m + b] -= L[a, b]
                for c in range(d):
                    G[i, a, b] -= Ts[i, a, c] * L[c, b]
    return trace


@kernel
def _strike_out(
    first: Index,
    second: Index,
    struck: Bool,
    row: int,
    pair: Index,
    diagonal: Index,
    values: Array,
) -> None:
    """Make `row` of each block struck, and its column, those of the unit matrix."""
    m = row + 1
    for i in range(len(struck)):
        if struck[i]:
            for a in range(m):
                values[diagonal[i] + a * m + row] = 0.0
                values[diagonal[i] + row * m + a] = 0.0
            values[diagonal[i] + row * m + row] = 1.0
    for p in range(len(first)):
        for a in range(m):
            if struck[first[p]]:
                values[pair[p] + row * m + a] = 0.0
            if struck[second[p]]:
                values[pair[p] + a * m + row] = 0.0


def warm_up() -> None:
    """Compile the kernels of this module."""
    Ts = np.stack([np.eye(3), np.eye(3)])
    certify(PoseGraph("SE2", Ts, np.array([0]), np.array([1]), Ts[:1], Ts[:1]))
