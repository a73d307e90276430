"""How sure the poses of a graph are: marginal, joint and relative covariances.

At its minimum a graph's cost rises as ½ δᵀ H δ, with δ the tangents of all poses on the right,
T exp(δ); so H is the information of the whole estimate, and Σ = H⁻¹ its covariance. Σ is dense and
far too large to form; the few blocks wanted are recovered from the sparse factor of H. Of two
nodes, the motion D = T_i⁻¹ T_j between them varies in its own tangent by

    δ_D = δ_j - M δ_i,   M = Ad(D⁻¹),   Σ_D = [-M I] Σ_(ij)(ij) [-M I]ᵀ,

which no longer depends on where the graph is held. A marginal covariance does: it is relative to
the nodes that are held, a fixed node or the anchor of each connected part, and these have none.

Edges and sights count as they did in the end: by their information, times the weight a robust
solution gave. Landmarks that nothing sees in the end are left out; they say nothing of the poses.
Cost: one factorisation, O(N^1.5) for maps, and less for a selected inverse of the factor's pattern.

Reference: M. Kaess, F. Dellaert, "Covariance recovery from a square root information matrix for
data association", Robotics and Autonomous Systems 57(12), 2009.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.backend.descent import Linear
from odomap.backend.graphs.components import Components, find_components
from odomap.backend.graphs.consensus import LIE
from odomap.backend.graphs.graphproblem import GraphProblem
from odomap.backend.graphs.posegraph import PoseGraph, Sights
from odomap.backend.graphs.solve import Solution
from odomap.backend.sparse import marginals
from odomap.backend.sparse.blockcholesky import BlockCholesky
from odomap.errors import InputError
from odomap.geometry.robust import Loss

__all__ = ["GraphCovariances", "covariances", "joint_covariance", "relative_covariance"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_TRACE = 1e-16
"""Share of its largest below which information of a direction of a part's place is rounding."""

_TIED = 1e-9
"""Least eigenvalue of a part's information, its diagonal scaled to 1, that is not."""


def covariances(solution: Solution | PoseGraph, nodes: ArrayLike | None = None) -> Array:
    """Return the covariance of each pose, in its tangent on the right.

    Args:
        solution: what `solve` returned, or a graph at the poses found.
        nodes: (K,) indices of nodes; all unless given.

    Returns:
        (K, k, k), relative to the nodes that are held, which have zeros.

    Raises:
        InputError: a node does not exist, or is not determined by what was measured.

    Example:
        >>> steps = np.tile(np.eye(3), (2, 1, 1))
        >>> graph = PoseGraph("SE2", np.tile(np.eye(3), (3, 1, 1)), [0, 1], [1, 2], steps, steps)
        >>> covariances(graph)[:, 2, 2].round(6).tolist()        # of the heading: 0, 1, 2 steps
        [0.0, 1.0, 2.0]
    """
    return GraphCovariances(solution).marginals(nodes)


def joint_covariance(solution: Solution | PoseGraph, i: int, j: int) -> Array:
    """Return the (2k, 2k) covariance of two poses, in their tangents one after the other."""
    return GraphCovariances(solution).joint(i, j)


def relative_covariance(solution: Solution | PoseGraph, i: int, j: int) -> Array:
    """Return the (k, k) covariance of T_i⁻¹ T_j in its tangent on the right.

    Raises:
        InputError: the nodes are in parts of the graph that nothing ties to each other.
    """
    return GraphCovariances(solution).relative(i, j)


class GraphCovariances:
    """The covariance of a pose graph's estimate, factored once and asked often.

    Args:
        solution: what `solve` returned, or a graph at the poses found (all edges then count fully).

    Raises:
        InputError: poses are not known, or not determined by what was measured.
    """

    def __init__(self, solution: Solution | PoseGraph) -> None:
        graph, weights = _counting(solution)
        for values, name in (
            (graph.Ts_world_node, "pose"),
            (graph.points.points_world, "landmark"),
        ):
            if not np.isfinite(values).all():
                raise InputError(f"covariances: a {name} is not known; solve the graph first")
        self.graph = graph
        self._components = find_components(graph, through_landmarks=True)
        _refuse_loose(graph, self._components)
        held = np.array(graph.is_fixed)
        held[self._components.anchor[self._components.is_free]] = True
        self._column, self._factor = _factor(graph, weights, held)

    def marginals(self, nodes: ArrayLike | None = None) -> Array:
        """Return (K, k, k) covariances of nodes (K,), all unless given."""
        chosen = self._indices(np.arange(self.graph.num_nodes) if nodes is None else nodes)
        out = np.zeros((len(chosen), self.graph.dim, self.graph.dim))
        columns = self._column[chosen]
        is_free = columns >= 0
        wanted, back = np.unique(columns[is_free], return_inverse=True)
        if len(wanted):
            out[is_free] = marginals.marginal_blocks(self._factor, wanted)[back]
        return out

    def joint(self, i: int, j: int) -> Array:
        """Return the (2k, 2k) covariance of two poses, tangents one after the other."""
        k = self.graph.dim
        columns = self._column[self._indices([i, j])]
        out = np.zeros((2, k, 2, k))
        free = np.flatnonzero(columns >= 0)
        if len(free) == 2 and columns[0] == columns[1]:
            out[:] = self.marginals([i])[0][None, :, None, :]
        elif len(free):
            found = marginals.joint_covariance(self._factor, columns[free]).reshape(
                len(free), k, len(free), k
            )
            out[free[:, None], :, free] = found.transpose(0, 2, 1, 3)
        return out.reshape(2 * k, 2 * k)

    def relative(self, i: int, j: int) -> Array:
        """Return the (k, k) covariance of T_i⁻¹ T_j in its tangent."""
        a, b = (int(node) for node in self._indices([i, j]))
        self._refuse_apart(a, b)
        lie, Ts = LIE[self.graph.group], self.graph.Ts_world_node
        M = lie.adjoint(lie.inverse(Ts[b]) @ Ts[a])
        J = np.hstack([-M, np.eye(self.graph.dim)])
        return np.asarray(J @ self.joint(a, b) @ J.T)

    def _refuse_apart(self, i: int, j: int) -> None:
        """Refuse nodes of two parts if one of these may move as a whole."""
        parts: Components = self._components
        a, b = parts.label[i], parts.label[j]
        if a != b and parts.is_free[[a, b]].any():
            ids = self.graph.ids
            raise InputError(
                f"covariances: nodes {ids[i]} and {ids[j]} are in parts of the graph that nothing "
                "ties to each other; add an edge between them, or priors"
            )

    def _indices(self, nodes: ArrayLike) -> Index:
        """Return indices of nodes, or refuse them."""
        array = np.atleast_1d(np.asarray(nodes))
        if array.size == 0:
            return np.zeros(0, np.int64)
        if array.ndim != 1 or array.dtype.kind not in "iu":
            raise InputError("covariances: nodes must be a list of whole numbers")
        if not 0 <= array.min() <= array.max() < self.graph.num_nodes:
            wrong = array[(array < 0) | (array >= self.graph.num_nodes)][0]
            raise InputError(
                f"covariances: node {wrong} does not exist; there are {self.graph.num_nodes}"
            )
        return array.astype(np.int64)


def _counting(solution: Solution | PoseGraph) -> tuple[PoseGraph, Array]:
    """Return the graph of what counted in the end, and weights of its edges."""
    if not isinstance(solution, Solution):
        every = np.ones(len(solution.points.node))
        return _with_sights(solution, every), np.ones(solution.num_edges)
    weights = solution.weights
    graph = solution.graph.without(weights <= 0.0)
    return _with_sights(graph, solution.sight_weights), weights[weights > 0.0]


def _with_sights(graph: PoseGraph, weights: Array) -> PoseGraph:
    """Return a graph whose sights count by weights (S,), without landmarks that none is left of."""
    points, keep = graph.points, weights > 0.0
    if not len(points.points_world):
        return graph
    seen, point = np.unique(points.point[keep], return_inverse=True)
    sights = Sights(
        points.points_world[seen],
        points.ids[seen],
        points.node[keep],
        point,
        points.points_node[keep],
        points.information[keep] * weights[keep, None, None],
    )
    return replace(graph, points=sights)


def _refuse_loose(graph: PoseGraph, components: Components) -> None:
    """Refuse parts whose priors do not hold them.

    All poses of a part may move together, by ξ at its anchor a: then a node p moves by
    Ad(T_p⁻¹ T_a) ξ, of which the priors must see every direction between them.
    """
    node, k = graph.priors.node, graph.dim
    part = components.label[node]
    lie, Ts = LIE[graph.group], graph.Ts_world_node
    J = lie.adjoint(lie.inverse(Ts[node]) @ Ts[components.anchor[part]])
    held = np.zeros((components.count, k, k))
    np.add.at(held, part, np.swapaxes(J, 1, 2) @ graph.priors.information @ J)
    diagonal = np.diagonal(held, axis1=1, axis2=2)
    size = np.sqrt(np.maximum(diagonal, _TRACE * diagonal.max(axis=1, initial=0.0)[:, None]))
    size = np.where(size > 0.0, size, 1.0)
    known = np.linalg.eigvalsh(held / (size[:, :, None] * size[:, None, :])) > _TIED
    loose = components.has_prior & ~components.has_fixed & ~known.all(axis=1)
    if loose.any():
        which = int(np.argmax(loose))
        nodes = np.flatnonzero(components.label == which)
        raise InputError(
            f"covariances: the part of node {graph.ids[nodes[0]]} ({len(nodes)} nodes) is not "
            f"determined: its priors leave {int((~known[which]).sum())} of {k} directions free; "
            "fix a node or give a prior with full information"
        )


def _factor(
    graph: PoseGraph, weights: Array, held: NDArray[np.bool_]
) -> tuple[Index, BlockCholesky]:
    """Return the column of each node, -1 if held, and the factor of H at the graph's poses."""
    none = np.zeros(graph.num_edges, bool)
    problem = GraphProblem(graph, held, False, Loss(), none, weights)
    problem.analyse()
    linear = Linear.empty(problem.pattern)
    problem.linearise(problem.state(graph.Ts_world_node, graph.points.points_world), linear)
    if not problem.factor.factor(linear.values):
        raise InputError(_undetermined(problem))
    return problem.column[:-1], problem.factor


def _undetermined(problem: GraphProblem) -> str:
    """Say which unknown no measurement determines."""
    column, graph = problem.factor.failed_block, problem.graph
    if column >= problem.num_free:
        name = f"landmark {graph.points.ids[column - problem.num_free]}"
    else:
        name = f"node {graph.ids[np.flatnonzero(problem.column[:-1] == column)[0]]}"
    return (
        f"covariances: {name} is not determined by what was measured: does its information have "
        "a direction without weight?"
    )
