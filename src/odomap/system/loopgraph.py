"""Solving a path with loops, some of which may be false: who is believed, and how sure all is.

    decide   graduated non-convexity says which loops the path and the others contradict, with all
             standard deviations larger, as errors go on from step to step, which nobody told of
    solve    from there, with Cauchy's loss on loops
    say      covariances are the marginals of what counted, by as much as it did

Cost: O(K) for a solution, some ten of them to decide.

Reference: H. Yang, P. Antonante, V. Tzoumas, L. Carlone, "Graduated non-convexity for robust
spatial perception", RA-L 5(2), 2020.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odomap.backend.descent import SolverConfig
from odomap.backend.graphs.covariances import GraphCovariances
from odomap.backend.graphs.gnc import GncConfig, find_inliers
from odomap.backend.graphs.solve import solve
from odomap.geometry.robust import Loss
from odomap.system.essentialgraph import EssentialGraph

__all__ = ["SolvedLoops", "solve_loops"]

Array = NDArray[np.float64]
Bool = NDArray[np.bool_]

STEPS = 10
"""Steps of a solution at most; the path as it is is near."""


@dataclass(frozen=True, eq=False)
class SolvedLoops:
    """A path that was solved.

    Attributes:
        Ts_world_node: (K, m, m) poses, rotations to the digits of a solver.
        covariances: (K, k, k) of them.
        is_true: (E,) edges that are believed.
    """

    Ts_world_node: Array
    covariances: Array
    is_true: Bool


def solve_loops(
    graph: EssentialGraph,
    is_false: Bool,
    doubt: float,
    outlying: float,
    decides: bool,
    gnc: GncConfig | None = None,
    deciding: EssentialGraph | None = None,
) -> SolvedLoops:
    """Find the poses that agree best with steps and loops.

    Args:
        graph: at the path as it is.
        is_false: (E,) loops that were not believed the last time.
        doubt: factor on all standard deviations while it is decided who is.
        outlying: standard deviations at which a loop counts half.
        decides: whether it is decided anew.
        gnc: how.
        deciding: the same graph with what is known while it is decided, if that is less.
    """
    is_true = ~is_false
    if decides and graph.is_doubted.any():
        inliers = find_inliers(deciding or graph, np.full(graph.num_edges, doubt**-2), gnc)
        is_true = inliers.is_inlier | ~graph.is_doubted
        graph = graph.placed(inliers.Ts_world_node)
    solution = solve(
        graph,
        initial="given",
        loss=Loss("cauchy", outlying),
        weights=is_true.astype(np.float64),
        config=SolverConfig(iterations=STEPS),
    )
    information = graph.information * solution.weights[:, None, None]
    weighed = replace(solution.graph, information=information).without(~is_true)
    return SolvedLoops(solution.Ts_world_node, GraphCovariances(weighed).marginals(), is_true)
