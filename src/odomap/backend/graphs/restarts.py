"""Another start for poses that a descent may have left in the wrong valley.

A growing graph goes on from where it is, which a large loop makes a bad place to begin at: the
chordal relaxation is tried beside it. Under a loss that lets go that is not enough, for what is far
off pulls no more, and poses at which all loops are let go look cheap. Then the start is that of the
loops which others confirm (`consensus`), and of two solutions

    fewer confirmed loops let go  beats  less cost.

Cost: one consensus where a loop is let go; a relaxation and a descent where that contradicts it.

Reference: N. Sünderhauf, P. Protzel, "Switchable constraints for robust pose graph SLAM", IROS
2012 (what a loop that is let go wrongly does to a map).
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from odomap.backend.descent import Descent, SolverConfig, descend
from odomap.backend.graphs.consensus import find_consensus
from odomap.backend.graphs.graphproblem import GraphProblem, GraphState
from odomap.backend.graphs.initialization import chordal
from odomap.geometry.robust import Loss

__all__ = ["is_let_go", "or_from_chordal", "or_from_confirmed"]

Bool = NDArray[np.bool_]
Found = Descent[GraphState]
Asked = Callable[[], bool] | None

_LET_GO = 0.1
"""Weight under a loss below which a loop hardly counts any more."""


def is_let_go(problem: GraphProblem, loss: Loss) -> Bool:
    """Return which edges (E,) a loss takes nearly all weight from, by the χ² last evaluated."""
    edges = slice(0, problem.graph.num_edges)
    is_robust = problem.edges.is_robust[edges]
    return np.asarray(is_robust & (loss.weight(problem.chi2[edges]) < _LET_GO))


def or_from_chordal(
    problem: GraphProblem, present: Found, config: SolverConfig, stop: Asked
) -> Found:
    """Return the cheaper of what was found and what the chordal start leads to."""
    other = _descended(problem, np.ones(problem.graph.num_edges), config, stop)
    return min(present, other, key=lambda one: one.cost_after)


def or_from_confirmed(
    problem: GraphProblem, loss: Loss, present: Found, config: SolverConfig, stop: Asked
) -> Found:
    """Return what was found, or poses that keep more of the loops that confirm each other.

    Args:
        problem: of the whole graph under the loss, analysed.
        loss: of its loops.
        present: solution from where the poses were.
        config: of the descent from the other start.
        stop: asked before each step; true ends it.
    """
    graph = problem.graph
    problem.cost_of_edges(present.x)
    missed = is_let_go(problem, loss)
    if not missed.any():
        return present
    is_confirmed = find_consensus(graph).is_confirmed
    missed &= is_confirmed
    if not missed.any():
        return present
    weights = (~graph.is_loop | is_confirmed).astype(np.float64)
    other = _descended(problem, weights, config, stop)
    problem.cost_of_edges(other.x)
    missed_there = is_let_go(problem, loss) & is_confirmed
    ours, theirs = (
        (int(lost.sum()), one.cost_after)
        for lost, one in ((missed, present), (missed_there, other))
    )
    return other if theirs < ours else present


def _descended(
    problem: GraphProblem, weights: NDArray[np.float64], config: SolverConfig, stop: Asked
) -> Found:
    """Return where the relaxation with weights (E,) leads to."""
    graph = problem.graph
    start = problem.state(chordal(graph, weights=weights), graph.points.points_world)
    return descend(problem, start, config, stop)
