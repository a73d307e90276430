"""Graduated non-convexity: which loop edges of a pose graph are false.

The problem: minimise the truncated squares Σ min(r², c²) over loop edges, beside the full squares
of odometry, priors and sights, which are trusted. The truncation says which edges to leave out, but
has a minimum for every set of them. So it is grown from a convex cost (μ → 0): with

    w = 1 below c² μ / (μ + 1),  0 above c² (μ + 1) / μ,  c √(μ (μ + 1)) / r - μ between

weighted least squares alternates with these weights while μ grows from c² / (2 r_max² - c²), where
the worst edge still has a vote, until all weights are 0 or 1. Three stages of it:

    confirmed   only the loops that others confirm (`consensus`); the rest has no say yet
    admitted    and those that this graph does not contradict: e'(Σ + J P J')⁻¹ e, P its covariance
                again, by a narrower gate, where that has added much: few false ones are left
    checked     out goes what costs much more than c² by bending what little determines it

r² and c² are in the information as stated, unless it is too sure; predictions use the variance
factor that the first stage leaves, Σ r² / (equations - unknowns). Cost: some ten factorisations.

Reference: H. Yang, P. Antonante, V. Tzoumas, L. Carlone, "Graduated non-convexity for robust
spatial perception", IEEE RA-L 5(2), 2020; checks: W. Baarda, "A testing procedure", 1968.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from odomap.backend.descent import SolverConfig
from odomap.backend.graphs.consensus import (
    LEAST_VARIANCE,
    chi2_quantile,
    covariance_of,
    find_consensus,
)
from odomap.backend.graphs.posegraph import PoseGraph
from odomap.backend.graphs.subgraph import Subgraph, SubgraphSolution
from odomap.limits import Limits, check_limits

__all__ = ["GncConfig", "Inliers", "find_inliers", "graduated_weights"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bool = NDArray[np.bool_]

_WIDE = 9.0
"""How much wider gates are where more is known, or less: three times as far.

The gate of admission, since predictions far away are linear; and that of confirmed loops.
"""

_NEWS = 1.1
"""Growth of the loops believed that makes it worth while to ask again for those left out."""

_CHECK = 0.999
"""Share of true edges that pass the check: Baarda's, who takes nothing out on weak evidence."""

_FEWEST = 30
"""Redundant equations that a variance factor is estimated from, at least."""

_FIRST_STEPS = 20
"""Most steps of a weighted least squares problem of new edges."""

_STEPS = 2
"""Most steps of one whose weights have changed a little."""


@dataclass(frozen=True)
class GncConfig:
    """How false loop edges are found."""

    quantile: Annotated[float, Limits(least=0.5, most=0.999999)] = 0.99
    """Share of true edges whose χ² is below the gate, if their information is right."""
    growth: Annotated[float, Limits(least=1.05, most=10.0)] = 1.4
    """Factor of the convexity parameter from round to round."""
    rounds: Annotated[int, Limits(least=1)] = 100
    """Most rounds of each stage."""
    least_variance: Annotated[float, Limits(least=LEAST_VARIANCE, most=1.0)] = LEAST_VARIANCE
    """How modest the information may seem. What is trusted may say one measurement twice, and
    agrees with itself then: a graph of such, or one too modest on purpose, has 1."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True)
class Inliers:
    """Which edges are true.

    Attributes:
        is_inlier: (E,) edges to keep.
        Ts_world_node: (N, m, m) poses that they lead to.
        variance: factor by which covariances of what was measured seem to be off.
        rounds: weighted least squares problems solved.
    """

    is_inlier: Bool
    Ts_world_node: Array
    variance: float
    rounds: int


def find_inliers(
    graph: PoseGraph,
    weights: Array | None = None,
    config: GncConfig | None = None,
    stop: Callable[[], bool] | None = None,
) -> Inliers:
    """Find the edges of a graph that are true.

    Args:
        graph: of poses, which do not count; only loop edges (`PoseGraph.is_loop`) are doubted.
        weights: (E,) factors of the information; edges of weight 0 are left out.
        config: gate and schedule.
        stop: asked now and then; true ends the search with what there is.

    Returns:
        Which edges to keep, and poses.
    """
    config = GncConfig() if config is None else config
    w = np.ones(graph.num_edges) if weights is None else np.asarray(weights, np.float64)
    is_used = w > 0.0
    part = replace(
        graph.without(~is_used), information=graph.information[is_used] * w[is_used, None, None]
    )
    search = _Search(part, config, stop)
    is_inlier = np.zeros(graph.num_edges, bool)
    is_inlier[is_used] = search.run()
    return Inliers(is_inlier, search.now.x.Ts[:-1], search.variance, search.rounds)


def graduated_weights(chi2: Array, gate: float, convexity: float) -> Array:
    """Return the weights of truncated squares, graduated by μ; gate = c²."""
    low, high = gate * convexity / (convexity + 1.0), gate * (convexity + 1.0) / convexity
    falling = np.sqrt(gate * convexity * (convexity + 1.0) / np.maximum(chi2, low)) - convexity
    return np.where(chi2 <= low, 1.0, np.where(chi2 >= high, 0.0, falling))


class _Search:
    """The three stages, and what they know so far."""

    now: SubgraphSolution

    def __init__(
        self, graph: PoseGraph, config: GncConfig, stop: Callable[[], bool] | None
    ) -> None:
        self.graph, self.config, self.stop = graph, config, stop
        self.subgraph = Subgraph(graph, stop)
        self.consensus = find_consensus(graph, None, config.quantile)
        self.variance, self.rounds = max(self.consensus.variance, config.least_variance), 0
        self.quantile = chi2_quantile(graph.dim, config.quantile)
        self.gate = self.quantile * max(self.variance, 1.0)

    def run(self) -> Bool:
        """Return which edges (E,) are true."""
        chosen, widening = self._graduate(self.consensus.is_confirmed), _WIDE
        while not self._is_stopped():
            count = self._estimate_variance(chosen)
            admitted = self._admit(np.flatnonzero(~chosen), widening)
            if not len(admitted):
                break
            last, then, allowed = chosen, self.now, chosen.copy()
            allowed[admitted] = True
            chosen = self._graduate(allowed)
            if widening == 1.0 and self._truncated_squares() > self._truncated_squares(then):
                chosen, self.now = last, then
                break
            if int((chosen & self.graph.is_loop).sum()) <= _NEWS * count:
                break
            widening = 1.0
        return chosen if self._is_stopped() else self._check(chosen)

    def _estimate_variance(self, chosen: Bool) -> int:
        """Take the variance factor from the graph as it stands; return how many loops it has."""
        count = int((chosen & self.graph.is_loop).sum())
        if self.now.redundancy >= _FEWEST and count:
            self.variance = max(self.now.variance, self.config.least_variance)
        return count

    def _truncated_squares(self, solution: SubgraphSolution | None = None) -> float:
        """Return the truncated squares of edges, at the present poses unless others are given."""
        chi2 = self.subgraph.chi2(self.now if solution is None else solution)
        return float(np.where(self.graph.is_loop, np.minimum(chi2, self.gate), chi2).sum())

    def _is_stopped(self) -> bool:
        return self.stop is not None and self.stop()

    def _solve(self, weights: Array, steps: int) -> None:
        before = self.now if self.rounds else None
        self.rounds += 1
        self.now = self.subgraph.solve(weights, before, SolverConfig(iterations=steps))

    def _graduate(self, allowed: Bool) -> Bool:
        """Return which of the loops allowed, and what is trusted, minimise truncated squares."""
        allowed = allowed & self.graph.is_loop
        weights = np.where(self.graph.is_loop, allowed, 1.0).astype(np.float64)
        convexity = 0.0
        for count in range(self.config.rounds):
            self._solve(weights, _FIRST_STEPS if count == 0 else _STEPS)
            chi2 = self.subgraph.chi2(self.now)
            if count == 0:
                worst = chi2.max(where=allowed, initial=self.gate)
                convexity = self.gate / max(2.0 * worst - self.gate, self.gate * 1e-9)
            last = weights
            weights = np.where(allowed, graduated_weights(chi2, self.gate, convexity), 0.0)
            weights[~self.graph.is_loop] = 1.0
            if np.array_equal(weights, last) and np.isin(weights, (0.0, 1.0)).all():
                return np.asarray(weights == 1.0)
            if self._is_stopped():
                break
            convexity *= self.config.growth
        chosen = np.asarray(weights > 0.5)
        self._solve(chosen.astype(np.float64), _FIRST_STEPS)
        return chosen

    def _admit(self, edges: Index, widening: float) -> Index:
        """Return which edges (n,) the graph as it stands does not contradict."""
        now, gate = self.now, widening * self.quantile * self.variance
        is_apart = self.subgraph.is_apart(now, edges)
        apart, tied = edges[is_apart], edges[~is_apart]
        # Bounds first: most false edges are too far off for any more to be asked.
        S = covariance_of(self.graph.information[tied]) + self.subgraph.bounds(now, tied)
        tied = tied[_normalised(self.subgraph.errors(now, tied), S) < gate]
        S = covariance_of(self.graph.information[tied]) + self.subgraph.joint(now, tied)
        near = _normalised(self.subgraph.errors(now, tied), S) < gate
        return np.sort(np.concatenate([apart, tied[near]]))

    def _check(self, chosen: Bool) -> Bool:
        """Return the edges without those loops that bend the graph too much.

        What others confirm may be three times as far off.
        """
        dim, chosen = self.graph.dim, chosen.copy()
        far = _WIDE * self.quantile, chi2_quantile(dim, _CHECK)
        gates = self.variance * np.where(self.consensus.is_confirmed, *far)
        while True:
            loops = np.flatnonzero(chosen & self.graph.is_loop)
            if not len(loops) or self._is_stopped():
                return chosen
            excess = self._costs(loops) / gates[loops]
            order = np.argsort(-excess, kind="stable")
            bad = order[excess[order] > 1.0]
            if not len(bad):
                return chosen
            # What is false makes others look false: the worse half goes, the rest is asked again.
            chosen[loops[bad[: (len(bad) + 1) // 2]]] = False
            self._solve(chosen.astype(np.float64), _FIRST_STEPS)

    def _costs(self, edges: Index) -> Array:
        """Return by how much Σ r² of the graph would fall without each edge.

        With Ω = L Lᵀ, u = Lᵀ e and A = Lᵀ P L: uᵀ (I - A)⁻¹ u.
        """
        values, axes = np.linalg.eigh(self.graph.information[edges])
        L = axes * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        L_T = np.swapaxes(L, 1, 2)
        A = L_T @ self.subgraph.covariances(self.now, edges) @ L
        u = (L_T @ self.subgraph.errors(self.now, edges)[:, :, None])[:, :, 0]
        share, axes = np.linalg.eigh(0.5 * (A + np.swapaxes(A, 1, 2)))
        along = np.einsum("nab,na->nb", axes, u)
        return np.asarray((along**2 / np.maximum(1.0 - share, 1e-9)).sum(axis=1))


def _normalised(errors: Array, covariance: Array) -> Array:
    """Return eᵀ S⁻¹ e."""
    turned = np.linalg.solve(covariance, errors[:, :, None])[:, :, 0]
    return np.asarray(np.einsum("na,na->n", errors, turned))
