"""A pose graph laid out for descent: unknowns, the places of their blocks, and steps.

Unknown are the poses of all nodes that are not held, k numbers each, then the landmarks, d each.
A prior is an edge from the world, a node that is held at the identity: nothing else treats it
specially. Which edge adds to which block is looked up once, so that linearising walks through
memory and never searches. What only one group of poses needs is imported with the first problem of
that group, or before (`import_group`): what is imported is compiled before a run begins.

Reference: G. Grisetti, R. Kümmerle, C. Stachniss, W. Burgard, "A tutorial on graph-based SLAM",
IEEE Intelligent Transportation Systems Magazine 2(4), 2010.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.backend.descent import Linear
from odomap.backend.graphs.chordal import isotropic_weights
from odomap.backend.graphs.edges import (
    TANGENT,
    EdgeArrays,
    TargetArrays,
    cost_of_edges,
    linearise_edges,
)
from odomap.backend.graphs.posegraph import Group, PoseGraph
from odomap.backend.sparse.blockcholesky import BlockCholesky
from odomap.backend.sparse.blocks import BlockPattern
from odomap.geometry.lie import se2_inverse, se3_inverse, sim3_exp, sim3_inverse
from odomap.geometry.lie_kernels import se3_retract, stumpff_123
from odomap.geometry.robust import Loss
from odomap.geometry.robust_kernels import loss_code
from odomap.kernels import kernel

if TYPE_CHECKING:
    from odomap.backend.graphs.sights import SightArrays

__all__ = ["GraphProblem", "GraphState", "import_group", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bool = NDArray[np.bool_]


class GraphState(NamedTuple):
    """Ts (N + 1, m, m) of all nodes and, last, of the world; points (M, d)."""

    Ts: Array
    points: Array


def import_group(group: Group, with_sights: bool = False) -> None:
    """Import what is compiled for poses of one group alone, and for sights of landmarks."""
    if with_sights:
        import odomap.backend.graphs.sights
    if group == "SE2":
        import odomap.backend.graphs.planeedges
    elif group == "SE3":
        import odomap.backend.graphs.spaceedges
    else:
        import odomap.backend.graphs.similarities  # noqa: F401


class GraphProblem:
    """The cost of a pose graph, as `descent.Problem`.

    Args:
        graph: what was measured; its poses are not looked at.
        is_held: (N,) nodes that stay where they are.
        is_chordal: which cost; see `edges`.
        loss: of the edges marked `is_robust`, and of all sights.
        is_robust: (E,) edges to which the loss applies.
        weights: (E,) by which edges count; 0 leaves one out.
    """

    def __init__(
        self,
        graph: PoseGraph,
        is_held: Bool,
        is_chordal: bool,
        loss: Loss,
        is_robust: Bool,
        weights: Array,
    ) -> None:
        import_group(graph.group)
        self.graph, self.is_chordal, self.loss = graph, is_chordal, loss_code(loss)
        self.tangent = TANGENT[graph.group]
        self.edges = _edge_arrays(graph, is_chordal, is_robust, weights)
        points = graph.points
        self.sights = _sight_arrays(graph)
        n, m, k, d = graph.num_nodes, len(points.points_world), graph.dim, graph.space
        free = np.append(~is_held, False)
        self.column = np.where(free, np.cumsum(free) - 1, -1).astype(np.int64)
        self.num_free = int(free.sum())
        self._edge_columns = self.column[self.edges.first], self.column[self.edges.second]
        self._sight_columns = self.column[points.node], self.num_free + points.point
        sizes = np.repeat([k, d], [self.num_free, m])
        inner = [(i >= 0) & (j >= 0) for i, j in (self._edge_columns, self._sight_columns)]
        ends = [
            np.concatenate([self._edge_columns[a][inner[0]], self._sight_columns[a][inner[1]]])
            for a in (0, 1)
        ]
        self.pattern = BlockPattern.of(sizes, *ends)
        self._places(n + 1)
        self.chi2, self.chi2_of_sights = np.zeros(len(self.edges.first)), np.zeros(len(points.node))

    def _places(self, num_nodes: int) -> None:
        """Look up where each edge and sight adds to H and g."""
        pattern = self.pattern
        self._row = np.full(num_nodes, -1, np.int64)
        self._diagonal = np.full(num_nodes, -1, np.int64)
        free = self.column >= 0
        self._row[free] = pattern.row_start[: self.num_free]
        self._diagonal[free] = pattern.diagonal_start[: self.num_free]
        self._edge_pair = _places_of_pairs(pattern, *self._edge_columns)
        self._sight_pair = _places_of_pairs(pattern, *self._sight_columns)

    def analyse(self, order: Index | None = None) -> None:
        """Analyse the factor of H, by an elimination order (N,) of the nodes if one is known."""
        if order is not None:
            columns = self.column[order]
            order = columns[columns >= 0]
        has_points = len(self.graph.points.points_world) > 0
        self.factor = BlockCholesky(self.pattern, None if has_points else order)

    def linearise(self, x: GraphState, out: Linear) -> None:
        """Write cost, H and g at x, and χ² of each edge and sight beside."""
        out.values[:] = 0.0
        out.gradient[:] = 0.0
        into = TargetArrays(self._edge_pair, self._diagonal, self._row, out.values, out.gradient)
        if self.graph.group == "Sim3":
            from odomap.backend.graphs.similarities import linearise_similarities

            out.cost = linearise_similarities(x.Ts, self.edges, *self.loss, into, self.chi2)
        else:
            out.cost = linearise_edges(
                self.tangent, x.Ts, self.edges, self.is_chordal, *self.loss, into, self.chi2
            )
        if self.sights is not None:
            out.cost += self._linearise_sights(self.sights, x, out)

    def _linearise_sights(self, sights: "SightArrays", x: GraphState, out: Linear) -> float:
        from odomap.backend.graphs.sights import SightTargets, linearise_sights

        first = self.num_free
        into = SightTargets(
            self._row,
            self._diagonal,
            self.pattern.row_start[first:],
            self.pattern.diagonal_start[first:],
            self._sight_pair,
            out.values,
            out.gradient,
        )
        k = self.graph.dim
        return float(
            linearise_sights(x.Ts, x.points, sights, k, *self.loss, into, self.chi2_of_sights)
        )

    def cost_of_edges(self, x: GraphState) -> float:
        """Return the cost of edges and priors at x; sights are left out."""
        if self.graph.group == "Sim3":
            from odomap.backend.graphs.similarities import cost_of_similarities

            return cost_of_similarities(x.Ts, self.edges, *self.loss, self.chi2)
        return float(
            cost_of_edges(self.tangent, x.Ts, self.edges, self.is_chordal, *self.loss, self.chi2)
        )

    def cost(self, x: GraphState) -> float:
        """Return the cost of edges, priors and sights at x, and write χ² of each."""
        cost = self.cost_of_edges(x)
        if self.sights is not None:
            from odomap.backend.graphs.sights import cost_of_sights

            cost += cost_of_sights(x.Ts, x.points, self.sights, *self.loss, self.chi2_of_sights)
        return cost

    def state(self, Ts_world_node: Array, points_world: Array) -> GraphState:
        """Return poses (N, m, m) and landmarks (M, d) as a state."""
        world = np.eye(self.graph.space + 1)
        return GraphState(np.concatenate([Ts_world_node, world[None]]), np.array(points_world))

    def retract(self, x: GraphState, step: Array) -> GraphState:
        """Return T exp(ξ) of the nodes that are free, p + δ of the landmarks."""
        Ts, split = np.array(x.Ts), self.num_free * self.graph.dim
        points = x.points + step[split:].reshape(x.points.shape)
        if self.graph.group == "Sim3":
            free = self.column >= 0
            Ts[free] = Ts[free] @ sim3_exp(step[:split].reshape(-1, 7))
        else:
            _retract(Ts, self._row, step)
        return GraphState(Ts, points)


def _edge_arrays(graph: PoseGraph, is_chordal: bool, is_robust: Bool, weights: Array) -> EdgeArrays:
    """Return edges and, after them, priors as edges from the world."""
    priors, n = graph.priors, graph.num_nodes
    inverse = {"SE2": se2_inverse, "SE3": se3_inverse, "Sim3": sim3_inverse}[graph.group]
    information = np.concatenate([graph.information, priors.information])
    if is_chordal:
        information = np.stack(isotropic_weights(information, graph.space), axis=-1)[:, None]
    measured = np.concatenate([graph.Ts_first_second, priors.Ts_world_node])
    return EdgeArrays(
        np.concatenate([graph.first, np.full(len(priors.node), n)]),
        np.concatenate([graph.second, priors.node]),
        np.ascontiguousarray(inverse(measured)),
        np.ascontiguousarray(information),
        np.concatenate([weights, np.ones(len(priors.node))]),
        np.concatenate([is_robust, np.zeros(len(priors.node), bool)]),
    )


def _sight_arrays(graph: PoseGraph) -> "SightArrays | None":
    """Return sights of landmarks; None where there are none, which need no kernels then."""
    points = graph.points
    if not len(points.node):
        return None
    from odomap.backend.graphs.sights import SightArrays

    return SightArrays(points.node, points.point, points.points_node, points.information)


def _places_of_pairs(pattern: BlockPattern, i: Index, j: Index) -> Index:
    """Return offsets in `values` of the blocks of pairs of columns, -1 where one is held."""
    inner = (i >= 0) & (j >= 0)
    places = np.full(len(i), -1, np.int64)
    places[inner] = pattern.pair_start[pattern.pair_of(i[inner], j[inner])]
    return places


@kernel
def _retract(Ts: Array, row: Index, step: Array) -> None:
    """T ← T exp(ξ) of the nodes that have a row, in the plane or in space."""
    R, t = np.empty((3, 3)), np.empty(3)
    for i in range(len(Ts)):
        if row[i] < 0:
            continue
        xi, T = step[row[i] :], Ts[i]
        if len(T) == 3:
            c, s = np.cos(xi[2]), np.sin(xi[2])
            c1, c2, _ = stumpff_123(xi[2] * xi[2])
            x, y = c1 * xi[0] - xi[2] * c2 * xi[1], xi[2] * c2 * xi[0] + c1 * xi[1]
            for a in range(2):
                T[a, 2] += T[a, 0] * x + T[a, 1] * y
            u, v = T[0, 0] * c - T[1, 0] * s, T[1, 0] * c + T[0, 0] * s
            size = 1.0 / np.sqrt(u * u + v * v)
            T[0, 0], T[1, 0], T[0, 1], T[1, 1] = u * size, v * size, -v * size, u * size
            continue
        for a in range(3):
            t[a] = T[a, 3]
            for b in range(3):
                R[a, b] = T[a, b]
        se3_retract(R, t, xi[:6], R, t)
        for a in range(3):
            T[a, 3] = t[a]
            for b in range(3):
                T[a, b] = R[a, b]


def warm_up() -> None:
    """Compile the kernels of this module."""
    for m, k in ((3, 3), (4, 6)):
        _retract(np.eye(m)[None].copy(), np.array([0]), np.zeros(k))
