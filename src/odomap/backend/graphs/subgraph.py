"""A pose graph of which only some edges count: solved, and how sure it is of each edge.

Choosing edges means solving the graph again and again, each time with other weights, from nearly
the right poses. Edges of weight 0 are taken out before the equations are laid out: a false loop
ties far parts of the graph together and may cost more to eliminate than all true ones. The start is
the better of where the poses were and of the relaxation (`initialization`), which no false loop
that has lost its weight can hold in a wrong valley.

How sure the graph is of the error e = log(Z⁻¹ D) of any edge is the covariance P of its change
J (δ_j - M δ_i), M = Ad(D⁻¹), J = J_r⁻¹(e). Neighbours in the factor have it from one selected
inversion; any two nodes from a few columns of the inverse; and it is never more than
2 J (M P_i Mᵀ + P_j) Jᵀ. O(N^1.5) for maps.

Reference: M. Kaess, F. Dellaert, "Covariance recovery from a square root information matrix for
data association", Robotics and Autonomous Systems 57(12), 2009.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.backend.descent import Linear, SolverConfig, descend
from odomap.backend.graphs.components import Components, find_components
from odomap.backend.graphs.consensus import LIE
from odomap.backend.graphs.graphproblem import GraphProblem, GraphState
from odomap.backend.graphs.initialization import chordal, place_landmarks
from odomap.backend.graphs.posegraph import PoseGraph
from odomap.backend.sparse.blockcholesky import BlockCholesky
from odomap.backend.sparse.crossblocks import cross_blocks
from odomap.backend.sparse.marginals import Marginals
from odomap.geometry.robust import Loss

__all__ = ["Subgraph", "SubgraphSolution"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class SubgraphSolution:
    """Where the poses of a subgraph ended.

    Attributes:
        x: poses and landmarks.
        problem: of the edges that count, its factor analysed.
        components: of them.
        variance: Σ r² over redundant equations.
        redundancy: equations beyond the unknowns.
    """

    x: GraphState
    problem: GraphProblem
    components: Components
    variance: float
    redundancy: int


class Subgraph:
    """A pose graph to be solved with one choice of edges after the other.

    Args:
        graph: with all edges.
        stop: asked before each step; true ends every descent with what there is.
    """

    def __init__(self, graph: PoseGraph, stop: Callable[[], bool] | None = None) -> None:
        self.graph, self.stop = graph, stop
        self._whole = _problem(graph, np.ones(graph.num_edges), find_components(graph))
        self._sure: tuple[SubgraphSolution, BlockCholesky, Marginals] | None = None

    def solve(
        self,
        weights: Array,
        before: SubgraphSolution | None,
        config: SolverConfig,
    ) -> SubgraphSolution:
        """Solve with weights (E,), from the better of the last solution and the relaxation."""
        used = self.graph.without(weights <= 0.0)
        w = weights[weights > 0.0]
        components = find_components(used, through_landmarks=True)
        problem = _problem(used, w, components)
        problem.analyse()
        starts = [problem.state(*_placed(used, chordal(used, None, w)))]
        if before is not None:
            starts.insert(0, before.x)
        start = min(starts, key=problem.cost_of_edges)
        descent = descend(problem, start, config, self.stop)
        equations = used.dim * (used.num_edges + len(used.priors.node))
        redundancy = equations + used.space * len(used.points.node) - problem.pattern.size
        variance = 2.0 * descent.cost_after / max(redundancy, 1)
        return SubgraphSolution(descent.x, problem, components, variance, redundancy)

    def chi2(self, solution: SubgraphSolution) -> Array:
        """Return r² of every edge (E,), of those left out, too."""
        self._whole.cost_of_edges(solution.x)
        return self._whole.chi2[: self.graph.num_edges].copy()

    def errors(self, solution: SubgraphSolution, edges: Index) -> Array:
        """Return log(Z⁻¹ T_i⁻¹ T_j) of edges (n,), (n, k)."""
        lie = LIE[self.graph.group]
        Z = self.graph.Ts_first_second[edges]
        return lie.log(lie.inverse(Z) @ self._motions(solution, edges))

    def covariances(self, solution: SubgraphSolution, edges: Index) -> Array:
        """Return P (n, k, k) of the errors of edges that count in the solution."""
        _, marginals = self._certainty(solution)
        return self._relative(solution, edges, marginals.pairs)

    def bounds(self, solution: SubgraphSolution, edges: Index) -> Array:
        """Return upper bounds (n, k, k) of P, of any edges."""
        return 2.0 * self._relative(solution, edges, None)

    def joint(self, solution: SubgraphSolution, edges: Index) -> Array:
        """Return P (n, k, k) of any edges."""
        factor, _ = self._certainty(solution)
        return self._relative(solution, edges, lambda i, j: cross_blocks(factor, i, j))

    def is_apart(self, solution: SubgraphSolution, edges: Index) -> NDArray[np.bool_]:
        """Return which edges (n,) would tie parts that nothing ties to each other."""
        label, is_free = solution.components.label, solution.components.is_free
        i, j = label[self.graph.first[edges]], label[self.graph.second[edges]]
        return np.asarray((i != j) & (is_free[i] | is_free[j]))

    def _motions(self, solution: SubgraphSolution, edges: Index) -> Array:
        Ts, inverse = solution.x.Ts, LIE[self.graph.group].inverse
        return np.asarray(inverse(Ts[self.graph.first[edges]]) @ Ts[self.graph.second[edges]])

    def _derivatives(self, solution: SubgraphSolution, edges: Index) -> tuple[Array, Array]:
        """Return M and J (n, k, k) of edges."""
        lie = LIE[self.graph.group]
        M = lie.adjoint(lie.inverse(self._motions(solution, edges)))
        return M, lie.right_jacobian_inverse(self.errors(solution, edges))

    def _certainty(self, solution: SubgraphSolution) -> tuple[BlockCholesky, Marginals]:
        """Return the factor of H at a solution and its marginals, found once for each solution."""
        if self._sure is None or self._sure[0] is not solution:
            factor = _factored(solution)
            self._sure = solution, factor, Marginals(factor)
        return self._sure[1:]

    def _relative(
        self,
        solution: SubgraphSolution,
        edges: Index,
        shared: Callable[[Index, Index], Array] | None,
    ) -> Array:
        """Return J (M P_i Mᵀ + P_j) Jᵀ of edges, less what both ends share where that is asked."""
        k, (_, marginals) = self.graph.dim, self._certainty(solution)
        i = solution.problem.column[self.graph.first[edges]]
        j = solution.problem.column[self.graph.second[edges]]

        def block(a: Index, b: Index, between: Callable[[Index, Index], Array]) -> Array:
            free = (a >= 0) & (b >= 0)
            found = np.zeros((len(a), k, k))
            if free.any():
                found[free] = between(a[free], b[free])
            return found

        M, J = self._derivatives(solution, edges)
        P = M @ block(i, i, marginals.pairs) @ np.swapaxes(M, 1, 2) + block(j, j, marginals.pairs)
        if shared is not None:
            both = M @ block(i, j, shared)
            P -= both + np.swapaxes(both, 1, 2)
        return np.asarray(J @ P @ np.swapaxes(J, 1, 2))


def _problem(graph: PoseGraph, weights: Array, components: Components) -> GraphProblem:
    held = np.array(graph.is_fixed)
    held[components.anchor[components.is_free]] = True
    return GraphProblem(graph, held, False, Loss(), np.zeros(graph.num_edges, bool), weights)


def _placed(graph: PoseGraph, Ts: Array) -> tuple[Array, Array]:
    return Ts, place_landmarks(graph, Ts)


def _factored(solution: SubgraphSolution) -> BlockCholesky:
    """Return the factor of H at the solution, of H plus a trace where that is singular."""
    problem = solution.problem
    linear = Linear.empty(problem.pattern)
    problem.linearise(solution.x, linear)
    largest = float(linear.values[problem.pattern.diagonal].max(initial=1.0))
    if not problem.factor.factor(linear.values):
        problem.factor.factor(linear.values, 1e-9 * largest)
    return problem.factor
