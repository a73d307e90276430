"""Pose graphs that grow: solved again from where they were, and no more than it takes.

Adding a measurement can only raise the least cost a graph may have. So the cost at the last whole
solution, less what one more step promised there, stays a lower bound b for ever after, and poses
of cost c are within a fraction ε of the optimum as long as

    c  ≤  (1 + ε) b.

    node and its edge     placed by the edge, at no cost: nothing to solve
    further edges         b rises by what their neighbourhood says they must cost (`innovation`);
                          the nodes around them are solved, the rest held: a window of fixed size
    c > (1 + ε) b         all is solved, from where it is, and the bound renewed; where the windows
                          have left nothing to gain, one factorisation proves it

A loop that brings news breaks the bound at once; one that agrees with the map does not. Where the
cost rises by more than noise explains, or a loss lets go of a new loop, another start is tried
beside the present poses (`restarts`).

Cost: O(window) per addition, whatever the size of the graph, but for loops that move all of it.

Reference: K. Konolige, M. Agrawal, "FrameSLAM: from bundle adjustment to real-time visual mapping",
IEEE Transactions on Robotics 24(5), 2008 (windows); compare M. Kaess et al., "iSAM2", IJRR 31(2),
2012, which keeps the factor of everything up to date instead.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.backend.descent import Descent, SolverConfig, descend
from odomap.backend.graphs.graphproblem import GraphProblem, GraphState
from odomap.backend.graphs.growing import GrowingArray
from odomap.backend.graphs.growinggraph import GrowingGraph
from odomap.backend.graphs.innovation import least_rise
from odomap.backend.graphs.neighbourhood import Neighbourhood
from odomap.backend.graphs.posegraph import Group, PoseGraph
from odomap.backend.graphs.restarts import is_let_go, or_from_chordal, or_from_confirmed
from odomap.backend.graphs.solve import Stop
from odomap.errors import InputError
from odomap.geometry.robust import Loss
from odomap.limits import Limits, Positive, check_limits

__all__ = ["IncrementalConfig", "IncrementalPoseGraph", "UpdateRecord"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bool = NDArray[np.bool_]
Scope = Literal["none", "placed", "window", "whole"]

_RELIED_ON = 0.9
"""Part of a rise found to first order that raises the bound."""
_NOTHING = 1e-9
"""A cost that says nothing: half a squared deviation of no measurement."""


@dataclass(frozen=True)
class IncrementalConfig:
    """How a growing graph is kept solved."""

    tolerance: Positive = 0.008
    """How far the cost may be above its lower bound, as a fraction of it."""
    window: Annotated[int, Limits(least=1)] = 30
    """Poses solved around what is new."""
    surprise: Positive = 10.0
    """Rise of the cost per degree of freedom added (noise: ½) that calls for another start."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class UpdateRecord:
    """What an update did.

    Attributes:
        scope: "none", "placed" (nothing had to be solved), "window" or "whole".
        cost: of all edges and priors at the poses now.
        bound: from below on the cost of any poses nearby.
        iterations: steps of the whole solution; 0 if what there was proved good enough.
        converged: whether the cost is within the tolerance.
        reason: why solving stopped, in words.
        moved: ids of nodes whose poses may have changed.
    """

    scope: Scope
    cost: float
    bound: float
    iterations: int
    converged: bool
    reason: str
    moved: Index


class IncrementalPoseGraph:
    """A pose graph that is added to and kept solved.

    Args:
        group: "SE2", "SE3" or "Sim3".
        loss: robust loss of loop edges (ids that do not follow each other); default none.
        config: how.

    Example:
        >>> graph, step = IncrementalPoseGraph("SE2"), np.eye(3)
        >>> step[0, 2] = 1.0
        >>> for node in range(3):
        ...     if graph.add_node() > 0:
        ...         graph.add_edge(node - 1, node, step, np.eye(3))
        >>> graph.update().scope
        'placed'
        >>> graph.T_world_node(2)[0, 2]
        np.float64(2.0)
        >>> step[0, 2] = 2.1
        >>> graph.add_edge(0, 2, step, np.eye(3))
        >>> graph.update().scope, round(graph.cost, 6)
        ('whole', 0.001667)
    """

    def __init__(
        self, group: Group, loss: Loss | None = None, config: IncrementalConfig | None = None
    ) -> None:
        self.config = IncrementalConfig() if config is None else config
        self.loss = Loss() if loss is None else loss
        self._solver = SolverConfig(tolerance=self.config.tolerance / 8.0)
        self._graph = GrowingGraph(group)
        self._edge_cost, self._prior_cost = (GrowingArray((), np.float64) for _ in range(2))
        self._new_edges: list[int] = []
        self._new_priors: list[int] = []
        self._cost = self._bound = 0.0
        self._moved: list[int] = []
        self._seeds: list[int] = []
        self._num_redundant = 0
        self._is_between_held = False  # a measurement no window sees
        self._num_solved = 0, 0
        self._num_doubted = 0  # edges there were when loops were last asked to confirm each other

    def add_node(
        self,
        T_world_node: ArrayLike | None = None,
        *,
        node: int | None = None,
        is_fixed: bool = False,
    ) -> int:
        """Add a node.

        Args:
            T_world_node: (m, m) where it begins; an edge to older nodes overrides it. The first
                node is at the identity unless given, others wait for an edge.
            node: its id; the next number unless given.
            is_fixed: whether it stays where it is.

        Returns:
            Its id.

        Raises:
            InputError: the id is taken, the pose is none, or it is to be fixed and has none.
        """
        return self._graph.add_node(T_world_node, node, is_fixed)

    def add_edge(self, i: int, j: int, T_i_j: ArrayLike, information: ArrayLike) -> None:
        """Add a measured motion T_i⁻¹ T_j between two nodes; `update` takes it into account.

        Args:
            i, j: ids of nodes.
            T_i_j: (m, m) measured.
            information: (k, k) inverse covariance in the tangent at T_i_j, on the right.

        Raises:
            InputError: a node is unknown, values are not finite, not a rotation, not semidefinite.
        """
        self._new_edges.append(self._graph.add_edge(i, j, T_i_j, information))
        self._edge_cost.append(0.0)

    def add_prior(self, i: int, T_world_node: ArrayLike, information: ArrayLike) -> None:
        """Add a measured pose of a node in the world; see `add_edge`."""
        self._new_priors.append(self._graph.add_prior(i, T_world_node, information))
        self._prior_cost.append(0.0)

    def update(self, stop: Stop | None = None) -> UpdateRecord:
        """Take all that was added into account.

        Args:
            stop: ends a whole solution early, with what there is; the next update goes on.

        Returns:
            What was done.

        Raises:
            InputError: a node has neither a pose nor an edge that places it; nothing is lost, add
                one and update again.
        """
        self._settle()
        if not self._seeds:
            return self._record("placed" if self._moved else "none", 0, True, "nothing to solve")
        if len(self._seeds) <= self.config.window and not self._is_between_held:
            is_held_on = self._solve_window()
            if is_held_on and self._cost <= self._limit:
                return self._record("window", 0, True, "within the bound")
        descent = self._solve_whole(stop)
        return self._record("whole", descent.iterations, descent.converged, descent.reason)

    @property
    def Ts_world_node(self) -> Array:
        """(N, m, m) poses of all nodes, a copy."""
        return self._graph.Ts_world_node.copy()

    @property
    def ids(self) -> Index:
        """(N,) ids of all nodes, in the order they were added, a copy."""
        return self._graph.ids.copy()

    @property
    def num_nodes(self) -> int:
        """How many poses there are."""
        return self._graph.num_nodes

    @property
    def num_edges(self) -> int:
        """How many relative motions were measured."""
        return self._graph.num_edges

    @property
    def cost(self) -> float:
        """Cost of all edges and priors at the last update."""
        return self._cost

    def T_world_node(self, i: int) -> Array:
        """Return (m, m), the pose of a node known by its id."""
        return np.array(self._graph.Ts_world_node[self._graph.index_of(i)])

    def graph(self) -> PoseGraph:
        """Return the graph at its poses, a copy."""
        whole = self._graph.whole()
        return replace(whole, Ts_world_node=whole.Ts_world_node.copy())

    @property
    def _limit(self) -> float:
        """Return the cost above which all is solved."""
        return (1.0 + self.config.tolerance) * self._bound + _NOTHING

    def _settle(self) -> None:
        """Place what is new; note the nodes where something is left to solve."""
        graph = self._graph
        for prior in self._new_priors:
            moved = graph.settle_prior(prior)
            self._moved += moved
            if not moved:
                self._note([graph.node_of_prior(prior)])
        self._new_priors.clear()
        while self._new_edges:
            waiting = [edge for edge in self._new_edges if not self._settle_edge(edge)]
            if len(waiting) == len(self._new_edges):
                break
            self._new_edges = waiting
        if graph.unplaced:
            node = graph.ids[min(graph.unplaced)]
            raise InputError(
                f"pose graph: node {node} is nowhere: give it a pose, or an edge to one that has"
            )

    def _settle_edge(self, edge: int) -> bool:
        """Place what an edge places; say whether it could be done."""
        moved = self._graph.settle_edge(edge)
        if moved is None:
            return False
        self._moved += moved
        if not moved:
            self._note(self._graph.nodes_of_edge(edge))
        return True

    def _note(self, nodes: list[int]) -> None:
        """Note the nodes of a measurement that may cost something."""
        self._seeds += nodes
        self._num_redundant += 1
        self._is_between_held |= bool(self._graph.is_held[nodes].all())

    def _problem(self, graph: PoseGraph, is_held: Bool) -> GraphProblem:
        """Return the cost of a graph, analysed."""
        is_robust = (
            graph.is_loop if self.loss.name != "quadratic" else np.zeros(graph.num_edges, bool)
        )
        weights = np.ones(graph.num_edges)
        problem = GraphProblem(graph, is_held, False, self.loss, is_robust, weights)
        problem.analyse()
        return problem

    def _solve_window(self) -> bool:
        """Solve the nodes around what is new, the rest held; say whether all that is new counts."""
        seeds = list(dict.fromkeys(reversed(self._seeds)))
        graph, near, priors = self._graph.around(seeds, self.config.window)
        self._bound += _RELIED_ON * self._rise(graph, near, priors)
        problem = self._problem(graph, np.arange(graph.num_nodes) >= near.num_inner)
        descent = descend(problem, _state(problem), self._solver)
        inner = near.nodes[: near.num_inner]
        self._graph.Ts_world_node[inner] = descent.x.Ts[: near.num_inner]
        self._moved += inner.tolist()
        costs = self._costs(problem, descent.x)
        edges = self._edge_cost.rows, near.edges, costs[: len(near.edges)]
        for rows, which, now in (edges, (self._prior_cost.rows, priors, costs[len(near.edges) :])):
            self._cost += float(now.sum() - rows[which].sum())
            rows[which] = now
        return not (is_let_go(problem, self.loss) & (near.edges >= self._num_solved[0])).any()

    def _rise(self, graph: PoseGraph, near: Neighbourhood, priors: list[int]) -> float:
        """Return by how much what is new around here raises the least cost at least."""
        if self.loss.name != "quadratic":
            return 0.0  # a loss that levels off is not bounded by its quadratic model
        is_held = self._graph.is_held[near.nodes]
        if not (is_held.any() or priors):
            is_held[-1] = True
        is_new = np.append(
            near.edges >= self._num_solved[0], np.array(priors) >= self._num_solved[1]
        )
        return least_rise(self._problem(graph, is_held), is_new)

    def _solve_whole(self, stop: Stop | None) -> Descent[GraphState]:
        """Solve all nodes from where they are, and renew the bound."""
        graph = self._graph.whole()
        problem = self._problem(graph, self._graph.is_held)
        stopped = None if stop is None else stop.is_set
        descent = present = descend(problem, _state(problem), self._solver, stopped)
        if not (stopped and stopped()):
            descent = self._or_from_elsewhere(problem, present, stopped)
        if descent.iterations or descent is not present:
            self._graph.Ts_world_node[:] = descent.x.Ts[:-1]
            self._moved = list(range(graph.num_nodes))
        costs = self._costs(problem, descent.x)
        self._edge_cost.rows[:] = costs[: graph.num_edges]
        self._prior_cost.rows[:] = costs[graph.num_edges :]
        self._cost = float(costs.sum())
        if descent.converged:
            self._bound = (1.0 - self._solver.tolerance) * self._cost
            self._num_redundant = 0
        return descent

    def _or_from_elsewhere(
        self, problem: GraphProblem, present: Descent[GraphState], stop: Callable[[], bool] | None
    ) -> Descent[GraphState]:
        """Return what was found, or better poses from another start if news came as a surprise."""
        graph, loss = problem.graph, self.loss
        if loss.name != "quadratic":
            has_news = bool(graph.is_loop[self._num_doubted :].any())
            self._num_doubted = graph.num_edges
            if not has_news:
                return present
            return or_from_confirmed(problem, loss, present, self._solver, stop)
        expected = self.config.surprise * graph.dim * self._num_redundant
        if present.cost_after - self._bound <= expected:
            return present
        return or_from_chordal(problem, present, self._solver, stop)

    def _costs(self, problem: GraphProblem, x: GraphState) -> Array:
        """Return the cost of each edge, and then of each prior."""
        problem.cost_of_edges(x)
        costs = np.array(problem.chi2)
        robust = problem.edges.is_robust
        costs[robust] = self.loss.cost(costs[robust])
        return np.asarray(0.5 * costs)

    def _record(self, scope: Scope, iterations: int, converged: bool, reason: str) -> UpdateRecord:
        """Return what was done, and forget what was new."""
        self._is_between_held = False
        self._num_solved = self.num_edges, self._graph.num_priors
        moved = np.unique(np.array(self._moved, np.int64))
        self._moved, self._seeds = [], self._seeds if not converged else []
        ids = self._graph.ids[moved]
        return UpdateRecord(scope, self._cost, self._bound, iterations, converged, reason, ids)


def _state(problem: GraphProblem) -> GraphState:
    """Return the poses of a problem's graph as a state."""
    return problem.state(problem.graph.Ts_world_node, problem.graph.points.points_world)
