"""By how much a new measurement must raise the least cost of a graph, seen from nearby.

Where a graph's poses are optimal its cost is c + ½ δᵀ H δ, with covariance Σ = H⁻¹. A new edge of
residual r, Jacobian J and information Ω makes the least cost rise by that of its *innovation*,

    Δ  =  ½ rᵀ (Ω⁻¹ + J Σ Jᵀ)⁻¹ r  =  ½ rᵀ Ω r - ½ gᵀ (H + Jᵀ Ω J)⁻¹ g,     g = Jᵀ Ω r,

which is what the edge costs now, less what moving the poses can win back. Of a part of the graph
alone H is smaller and Σ larger: it never says too much. An edge between neighbours is judged by the
neighbourhood almost as by the whole, one that closes a large loop is not, and the neighbourhood,
in two pieces without it, says 0.

Cost: one small factorisation.

Reference: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and
Navigation", section 5.4 (normalised innovation squared), Wiley, 2001.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.backend.descent import Linear
from odomap.backend.graphs.graphproblem import GraphProblem

__all__ = ["least_rise"]


def least_rise(problem: GraphProblem, is_new: NDArray[np.bool_]) -> float:
    """Return by how much new edges raise the least cost at least, to first order.

    Args:
        problem: part of a graph at poses optimal without the new edges, analysed; held at one
            node if nothing ties it to the world.
        is_new: (E + P,) which of its edges, and then priors, are new.

    Returns:
        The rise, 0 where the part does not determine it.
    """
    x = problem.state(problem.graph.Ts_world_node, problem.graph.points.points_world)
    every, new = Linear.empty(problem.pattern), Linear.empty(problem.pattern)
    problem.linearise(x, every)
    problem.edges.weight[~is_new] = 0.0
    problem.linearise(x, new)
    if not problem.factor.factor(every.values):
        return 0.0
    won_back = 0.5 * float(new.gradient @ problem.factor.solve(new.gradient))
    return max(new.cost - won_back, 0.0)
