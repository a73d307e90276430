"""Where a pose graph's descent begins: the poses given, a spanning tree, or the chordal start.

"auto" takes the better of what is given and chordal. Better is what costs less, and with a robust
loss care is needed: at the poses of odometry all loops are off, a loss that lets go counts none of
them, and a wrong start looks cheap. So starts are judged by Huber's loss, which never lets go, and
by loop edges that others confirm (`consensus`) alone, as false ones must not decide.

Landmarks come to lie where they were seen on average; with the poses given, only those whose
position is not known.

Reference: L. Carlone, R. Tron, K. Daniilidis, F. Dellaert, "Initialization techniques for 3D SLAM:
a survey on rotation estimation and its use in pose graph optimization", ICRA 2015.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.consensus import find_consensus
from odomap.backend.graphs.graphproblem import GraphProblem, GraphState
from odomap.backend.graphs.initialization import chordal, place_landmarks, spanning_tree
from odomap.backend.sparse.blockcholesky import BlockCholesky
from odomap.errors import InputError
from odomap.geometry.robust import Loss

__all__ = ["INITIALS", "Initial", "choose_start"]

Array = NDArray[np.float64]
Bool = NDArray[np.bool_]
Initial = Literal["auto", "given", "spanning_tree", "chordal"]
INITIALS = ("auto", "given", "spanning_tree", "chordal")


def choose_start(
    problem: GraphProblem, initial: Initial, is_held: Bool, nodes: BlockCholesky
) -> tuple[GraphState, str]:
    """Return the state to begin at, and what it is.

    Args:
        problem: the graph with its loss and weights.
        initial: what is asked for.
        is_held: (N,) nodes that stay.
        nodes: room for a factor of one unknown per node (`initialization.node_factor`).

    Raises:
        InputError: "given" is asked for, and some poses are not known.
    """
    graph = problem.graph
    weights = problem.edges.weight[: graph.num_edges]
    is_known = bool(np.isfinite(graph.Ts_world_node).all())
    if initial == "given" and not is_known:
        raise InputError("solve: initial 'given' asks for poses, and some are not known")
    if initial == "given":
        return _given(problem), initial
    if initial == "spanning_tree":
        return _placed(problem, spanning_tree(graph, weights)), initial
    judge = problem
    if initial == "auto" and problem.edges.is_robust.any():
        weights = weights * (~graph.is_loop | find_consensus(graph, weights).is_confirmed)
        judge = GraphProblem(
            graph, is_held, problem.is_chordal, Loss("huber"), graph.is_loop, weights
        )
    relaxed = _placed(problem, chordal(graph, nodes, weights))
    if initial == "chordal" or not is_known:
        return relaxed, "chordal"
    given = _given(problem)
    is_better = judge.cost(given) <= judge.cost(relaxed)
    return (given, "given") if is_better else (relaxed, "chordal")


def _given(problem: GraphProblem) -> GraphState:
    """Return the poses and landmarks a graph holds, those not known where they were seen."""
    graph = problem.graph
    points, known = graph.points.points_world, np.isfinite(graph.points.points_world)
    seen = points if known.all() else place_landmarks(graph, graph.Ts_world_node)
    return problem.state(graph.Ts_world_node, np.where(known, points, seen))


def _placed(problem: GraphProblem, Ts: Array) -> GraphState:
    """Return other poses, and landmarks where they were seen from them."""
    return problem.state(Ts, place_landmarks(problem.graph, Ts))
