"""Solving a pose graph: a start, a descent, and an honest account of both.

    components   each connected part of a graph may move freely: one node of each is held
    start        the poses given, along a spanning tree, or chordal; "auto" takes the better one of
                 what is given and chordal (`start`)
    descent      Gauss-Newton, Levenberg-Marquardt or dogleg (`descent`), sparse and exact
    robust       a loss on the loop edges, or graduated non-convexity, which names the false ones

Poses come back in the frame of the first node of each component, which stays where it was.

Cost: each iteration is linear in the edges but for the factorisation, O(N^1.5) for graphs that are
nearly planar, as maps are.

Reference: G. Grisetti, R. Kümmerle, C. Stachniss, W. Burgard, "A tutorial on graph-based SLAM",
IEEE Intelligent Transportation Systems Magazine 2(4), 2010.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.backend.descent import Descent, IterationRecord, SolverConfig, descend
from odomap.backend.graphs.components import Components, find_components
from odomap.backend.graphs.gnc import GncConfig, find_inliers
from odomap.backend.graphs.graphproblem import GraphProblem, GraphState
from odomap.backend.graphs.initialization import node_factor
from odomap.backend.graphs.posegraph import PoseGraph, Priors
from odomap.backend.graphs.start import INITIALS, Initial, choose_start
from odomap.errors import InputError
from odomap.geometry.robust import Loss

__all__ = ["Cost", "Initial", "Solution", "Stop", "solve"]

Array = NDArray[np.float64]
Bool = NDArray[np.bool_]
Cost = Literal["geodesic", "chordal"]

LET_GO = 0.1
"""A loss that leaves an edge less than this share of its weight has found it to be false; Huber's
never does, as its pull does not end."""


class Stop(Protocol):
    """A flag that ends a descent early, such as `threading.Event`."""

    def is_set(self) -> bool:
        """Say whether to end."""
        ...


@dataclass(frozen=True)
class Solution:
    """The poses of a graph, and how they were found.

    Attributes:
        graph: the graph at the poses and landmarks found.
        cost_before: at the start that was chosen. cost_after: at the poses found.
        iterations: steps tried.
        converged: whether there was nothing left to gain.
        reason: why it stopped, in words.
        chi2: (E,) squared residual of each edge in standard deviations (chordal: twice its cost).
        weights: (E,) by which each edge counted in the end, times that of its loss.
        is_rejected: (E,) edges found to be false: left out by "gnc", or let go by a loss.
        sight_weights: (S,) by which each sight of a landmark counted in the end.
        num_components: connected parts; more than one cannot be placed relative to each other.
        initial: the start that was chosen.
        history: one record per step.
    """

    graph: PoseGraph
    cost_before: float
    cost_after: float
    iterations: int
    converged: bool
    reason: str
    chi2: Array
    weights: Array
    is_rejected: Bool
    sight_weights: Array
    num_components: int
    initial: str
    history: tuple[IterationRecord, ...] = field(repr=False)

    @property
    def Ts_world_node(self) -> Array:
        """(N, m, m) poses found."""
        return self.graph.Ts_world_node


def solve(
    graph: PoseGraph,
    *,
    cost: Cost = "geodesic",
    initial: Initial = "auto",
    loss: Loss | str | None = None,
    robust: Literal["gnc"] | GncConfig | None = None,
    weights: ArrayLike | None = None,
    config: SolverConfig | None = None,
    stop: Stop | None = None,
    progress: Callable[[IterationRecord], None] | None = None,
) -> Solution:
    """Find the poses of a graph that agree best with what was measured.

    Args:
        graph: the problem; poses may be unknown (NaN).
        cost: "geodesic", of distances along the group, or "chordal", of SE-Sync, isotropic.
        initial: where to begin; "auto" takes the better of what is given and chordal, judged with a
            loss by the loops that others confirm (`start`). "gnc" has a start of its own.
        loss: robust loss of loop edges (`PoseGraph.is_loop`) and sights, or its name; default none.
        robust: "gnc" finds false loop edges and leaves them out (`Solution.is_rejected`).
        weights: (E,) by which edges count; 0 leaves one out. Default 1.
        config: method and limits.
        stop: ends early, with what there is.
        progress: told of each step.

    Returns:
        The poses and why it stopped; look at `converged`.

    Raises:
        InputError: there is nothing to solve, weights do not fit, or the chordal cost is asked of
            similarities.

    Example:
        >>> step, unknown = np.eye(3), np.full((2, 3, 3), np.nan)
        >>> step[0, 2] = 1.0
        >>> graph = PoseGraph("SE2", unknown, [0], [1], [step], [np.eye(3)])
        >>> solve(graph).Ts_world_node[1, 0, 2].round(6)
        np.float64(1.0)
    """
    config = SolverConfig() if config is None else config
    loss = Loss(loss) if isinstance(loss, str) else loss or Loss()
    if initial not in INITIALS:
        raise InputError(f"solve: initial '{initial}' is unknown, give {', '.join(INITIALS)}")
    w = _checked_weights(graph, weights, cost)
    is_given = w > 0.0
    stopped = None if stop is None else stop.is_set
    whole = _without_empty_priors(graph)
    if robust is not None:
        whole, w = _without_false_loops(whole, w, loss, robust, stopped)
        initial = "given"
    is_out = w == 0.0  # what does not count is not to cost anything either
    graph = whole.without(is_out) if is_out.any() else whole
    components = find_components(graph, through_landmarks=True)
    held = _held(graph, components)
    is_robust = graph.is_loop & (loss.name != "quadratic")
    problem = GraphProblem(graph, held, cost == "chordal", loss, is_robust, w[~is_out])
    nodes = node_factor(graph)
    problem.analyse(nodes.order)
    start, chosen = choose_start(problem, initial, held, nodes)
    chosen = chosen if robust is None else "gnc"
    descent = descend(problem, start, config, stopped, progress)
    if is_out.any():
        is_robust = whole.is_loop & (loss.name != "quadratic")
        problem = GraphProblem(whole, held, cost == "chordal", loss, is_robust, w)
    return _solution(problem, loss, descent, components.count, chosen, is_given & is_out)


def _without_false_loops(
    graph: PoseGraph,
    weights: Array,
    loss: Loss,
    robust: Literal["gnc"] | GncConfig,
    stop: Callable[[], bool] | None,
) -> tuple[PoseGraph, Array]:
    """Return the graph near its solution without false loops, and weights without them."""
    if not (robust == "gnc" or isinstance(robust, GncConfig)):
        raise InputError(f"solve: robust '{robust}' is unknown, give gnc")
    if loss.name != "quadratic":
        raise InputError(f"solve: give robust or the loss {loss.name}, not both")
    inliers = find_inliers(graph, weights, None if robust == "gnc" else robust, stop)
    return graph.placed(inliers.Ts_world_node), np.where(inliers.is_inlier, weights, 0.0)


def _checked_weights(graph: PoseGraph, weights: ArrayLike | None, cost: Cost) -> Array:
    measured = graph.num_edges + len(graph.priors.node) + len(graph.points.node)
    if graph.num_nodes == 0 or measured == 0:
        raise InputError("pose graph: nothing was measured, there is nothing to solve")
    if cost not in ("geodesic", "chordal"):
        raise InputError(f"solve: cost '{cost}' is unknown, give geodesic or chordal")
    if cost == "chordal" and graph.group == "Sim3":
        raise InputError("solve: the chordal cost is for rigid motions; use geodesic for Sim3")
    try:
        w = np.ones(graph.num_edges) if weights is None else np.array(weights, np.float64)
    except (TypeError, ValueError):
        w = np.full(1, np.nan)
    if w.shape != (graph.num_edges,) or not (np.isfinite(w).all() and (w >= 0.0).all()):
        raise InputError(f"solve: weights must be {graph.num_edges} numbers of 0 or more")
    # An edge without information ties nothing, and must not seem to hold a graph together.
    return np.where(graph.information.any(axis=(1, 2)), w, 0.0)


def _without_empty_priors(graph: PoseGraph) -> PoseGraph:
    """Return the graph without priors that have no information: they hold nothing."""
    says = graph.priors.information.any(axis=(1, 2))
    if says.all():
        return graph
    p = graph.priors
    return graph.with_priors(Priors(p.node[says], p.Ts_world_node[says], p.information[says]))


def _held(graph: PoseGraph, components: Components) -> Bool:
    """Return which nodes stay: those fixed, and the anchor of each component that could move."""
    held = np.array(graph.is_fixed)
    held[components.anchor[components.is_free]] = True
    return held


def _solution(
    problem: GraphProblem,
    loss: Loss,
    descent: Descent[GraphState],
    num_components: int,
    initial: str,
    is_left_out: Bool,
) -> Solution:
    """Return what was found, with χ² and weight of all edges, of those left out, too."""
    problem.cost(descent.x)
    edges = slice(0, problem.graph.num_edges)
    chi2, weights = problem.chi2[edges].copy(), problem.edges.weight[edges].copy()
    is_robust = problem.edges.is_robust[edges]
    by_loss = np.where(is_robust, loss.weight(chi2), 1.0)
    is_let_go = (by_loss < LET_GO) & (loss.name != "huber")
    return Solution(
        problem.graph.placed(descent.x.Ts[:-1], descent.x.points),
        descent.cost_before,
        descent.cost_after,
        descent.iterations,
        descent.converged,
        descent.reason,
        chi2,
        weights * by_loss,
        is_left_out | is_let_go,
        loss.weight(problem.chi2_of_sights),
        num_components,
        initial,
        descent.history,
    )
