"""Consensus of loop edges: which of them another one confirms.

A wrong loop edge can claim anything, and odometry over a long way contradicts nothing. But two loop
edges (a, b) and (c, d) that begin near each other and end near each other close a cycle with two
short ways of odometry, and random errors hardly ever agree. With the poses T of odometry alone,

    G_ab = T_a Z_ab T_b⁻¹,   e = log(G_ab G_cd⁻¹),   S = Σ_ab + Σ_cd + Σ_a..c + Ad(G) Σ_b..d Ad(G)ᵀ

G is the correction the edge asks of the world; all covariances are in the world's frame, where
those along a path simply add up, so that each is a difference of two running sums. The edges agree
if eᵀ S⁻¹ e < v χ². One edge may also agree with odometry alone, where that is sure enough.

Agreement counts only where chance would hardly bring it about: the ellipsoid of the test must be
small among all errors that a cycle of that length could have. The variance factor v mends an
information that is too sure or too modest throughout; it is the fixed point of v = median of the
agreeing eᵀ S⁻¹ e over the median of χ², believed where most tests agree. O(E log E + E k³).

Reference: J. G. Mangelson, D. Dominic, R. M. Eustice, R. Vasudevan, "Pairwise consistent
measurement set maximization for robust multi-robot map merging", ICRA 2018.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import gamma, pi
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.initialization import spanning_tree
from odomap.backend.graphs.posegraph import PoseGraph
from odomap.geometry.lie import (
    se2_adjoint,
    se2_inverse,
    se2_log,
    se2_right_jacobian_inverse,
    se3_adjoint,
    se3_inverse,
    se3_log,
    se3_right_jacobian_inverse,
    sim3_adjoint,
    sim3_inverse,
    sim3_log,
    sim3_right_jacobian_inverse,
)
from odomap.kernels import kernel

__all__ = [
    "LEAST_VARIANCE",
    "LIE",
    "Consensus",
    "chi2_quantile",
    "covariance_of",
    "find_consensus",
    "warm_up",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bool = NDArray[np.bool_]

_PARTNERS = 8
"""With how many of the nearest loop edges each is compared."""

_CHANCE = 1e-3
"""A test that an error drawn at random would pass more often than this confirms nothing."""

_ACCIDENTS = 0.1
"""How many tests of a graph of random edges may pass by accident and count as sure."""

_FEWEST = 10
"""Tests that a variance factor is estimated from, at least."""

_TOO_WIDE = 0.1
"""A variance factor at which half of all errors drawn at random agree more often says nothing."""

LEAST_VARIANCE = 1e-6
"""Least variance factor: residuals below a thousandth of what is stated are rounding."""

_TRACE = 1e-6
"""Information where an edge measured nothing, relative to the largest of its diagonal."""


@dataclass(frozen=True)
class Consensus:
    """What loop edges say of each other.

    Attributes:
        is_confirmed: (E,) loop edges that agree with another one, or with odometry.
        variance: factor of all covariances, 1 where it cannot be told.
    """

    is_confirmed: Bool
    variance: float


class LieFunctions(NamedTuple):
    """What is asked of a group, batched over leading dimensions."""

    inverse: Callable[[Array], Array]
    log: Callable[[Array], Array]
    adjoint: Callable[[Array], Array]
    right_jacobian_inverse: Callable[[Array], Array]


LIE = MappingProxyType(
    {
        "SE2": LieFunctions(se2_inverse, se2_log, se2_adjoint, se2_right_jacobian_inverse),
        "SE3": LieFunctions(se3_inverse, se3_log, se3_adjoint, se3_right_jacobian_inverse),
        "Sim3": LieFunctions(sim3_inverse, sim3_log, sim3_adjoint, sim3_right_jacobian_inverse),
    }
)
"""Functions of each group of poses."""


def chi2_quantile(dim: int, share: float) -> float:
    """Return the value below which a χ² variable of `dim` degrees of freedom stays so often."""
    from scipy.special import gammaincinv  # slow to import, and only robust solving needs it

    return float(2.0 * gammaincinv(0.5 * dim, share))


def covariance_of(information: Array) -> Array:
    """Return inverses of information matrices (E, k, k); what was not measured is very unsure."""
    k = information.shape[1]
    largest = np.diagonal(information, axis1=1, axis2=2).max(axis=1, initial=0.0)
    trace = _TRACE * np.where(largest > 0.0, largest, 1.0)
    return np.asarray(np.linalg.inv(information + trace[:, None, None] * np.eye(k)))


def find_consensus(
    graph: PoseGraph, weights: Array | None = None, quantile: float = 0.99
) -> Consensus:
    """Find the loop edges that others confirm.

    Args:
        graph: of poses, which do not count; edges that are not loops are trusted.
        weights: (E,) of its edges; edges of weight 0 are left out.
        quantile: share of the true errors that a test lets pass.

    Returns:
        Which loop edges are confirmed, and a variance factor.

    Example:
        >>> steps = np.tile(np.eye(3), (5, 1, 1))
        >>> steps[:, 0, 2] = 1.0, 1.0, 1.0, 1.0, -4.0
        >>> steps[4, 1, 2] = 3.0                       # back at the start, and 3 m beside it?
        >>> unknown, sure = np.full((5, 3, 3), np.nan), 1e4 * np.tile(np.eye(3), (5, 1, 1))
        >>> graph = PoseGraph("SE2", unknown, [0, 1, 2, 3, 4], [1, 2, 3, 4, 0], steps, sure)
        >>> bool(find_consensus(graph).is_confirmed.any())
        False
    """
    weights = np.ones(graph.num_edges) if weights is None else np.asarray(weights, np.float64)
    confirmed = np.zeros(graph.num_edges, bool)
    loops = np.flatnonzero(graph.is_loop & (weights > 0.0))
    if not len(loops):
        return Consensus(confirmed, 1.0)
    dim, chain = graph.dim, _Chain(graph, weights)
    loop = _corrections(graph, chain, loops)
    with_others = _pairs(graph, chain, loop)
    with_odometry = _against_odometry(graph, chain, loop)
    variance = _variance_factor(graph, with_others, quantile)
    gate = variance * chi2_quantile(dim, quantile)
    tests = with_others, with_odometry
    sure = min(_CHANCE, _ACCIDENTS / max(sum(len(test.chi2) for test in tests), 1))
    votes = np.zeros(len(loops))
    for test in tests:
        chance = _chance_of_agreement(graph, gate, test.spread, test.length)
        agree = (test.chi2 < gate) & (chance < _CHANCE)
        # Two votes of any kind are needed, and one that is hardly an accident counts as two.
        vote = np.where(agree, np.where(chance < sure, 2.0, 1.0), 0.0)
        votes += np.bincount(test.one, vote, len(loops))
        votes += np.bincount(test.other, np.where(test.one != test.other, vote, 0.0), len(loops))
    confirmed[loops[votes >= 2.0]] = True
    return Consensus(confirmed, variance)


class _Chain:
    """Odometry as a line of nodes ordered by name, and running sums along it.

    Attributes:
        Ts: (N, m, m) poses by odometry alone.
        rank: (N,) place of each node on the line.
        position: (N,) rank, and far apart where nothing trusted ties neighbours on the line.
        covariance: (N, k, k) sum of the covariances of steps up to a rank, in the world's frame.
    """

    def __init__(self, graph: PoseGraph, weights: Array) -> None:
        n = graph.num_nodes
        steps = np.flatnonzero(~graph.is_loop & (weights > 0.0))
        self.Ts = spanning_tree(graph, np.where(graph.is_loop, 0.0, weights))
        self.rank = np.empty(n, np.int64)
        self.rank[np.argsort(graph.ids, kind="stable")] = np.arange(n)
        second = graph.second[steps]
        after = np.maximum(self.rank[graph.first[steps]], self.rank[second])
        covariance = np.zeros((n, graph.dim, graph.dim))
        covariance[after] = _in_world(
            graph, self.Ts[second], covariance_of(graph.information[steps])
        )
        self.covariance = np.cumsum(covariance, axis=0)
        is_tied = np.zeros(n, bool)
        is_tied[after] = True
        self.position = (np.arange(n) + 4 * n * np.cumsum(~is_tied))[self.rank]

    def between(self, i: Index, j: Index) -> tuple[Array, Array]:
        """Return covariances (P, k, k) of the ways from nodes i to j, and their distances."""
        low, high = np.minimum(self.rank[i], self.rank[j]), np.maximum(self.rank[i], self.rank[j])
        apart = self.Ts[j, :-1, -1] - self.Ts[i, :-1, -1]
        return self.covariance[high] - self.covariance[low], np.linalg.norm(apart, axis=1)


class _Corrections(NamedTuple):
    """Loop edges, from the node that comes first on the line.

    Attributes:
        begin, end: (L,) nodes.
        G: (L, m, m) corrections T_a Z_ab T_b⁻¹.
        adjoint: (L, k, k) of G.
        covariance: (L, k, k) of the edge alone, in the world's frame.
        length: (L,) distance measured.
    """

    begin: Index
    end: Index
    G: Array
    adjoint: Array
    covariance: Array
    length: Array


class _Tests(NamedTuple):
    """Loop edges compared: which (P,), χ² = eᵀ S⁻¹ e, √det S, and how long the cycle is."""

    one: Index
    other: Index
    chi2: Array
    spread: Array
    length: Array


def _in_world(graph: PoseGraph, Ts: Array, covariance: Array) -> Array:
    """Return covariances of tangents at poses, moved to the world's frame."""
    adjoint = LIE[graph.group].adjoint(Ts)
    return np.asarray(adjoint @ covariance @ np.swapaxes(adjoint, 1, 2))


def _corrections(graph: PoseGraph, chain: _Chain, loops: Index) -> _Corrections:
    lie = LIE[graph.group]
    a, b, Z = graph.first[loops], graph.second[loops], graph.Ts_first_second[loops]
    G = chain.Ts[a] @ Z @ lie.inverse(chain.Ts[b])
    covariance = _in_world(graph, chain.Ts[a] @ Z, covariance_of(graph.information[loops]))
    # Seen from b the correction is the inverse, and its error moves through it.
    turned = chain.rank[a] > chain.rank[b]
    back = lie.inverse(G[turned])
    G[turned], covariance[turned] = back, _in_world(graph, back, covariance[turned])
    length = np.linalg.norm(Z[:, : graph.space, -1], axis=1)
    begin, end = np.where(turned, b, a), np.where(turned, a, b)
    return _Corrections(begin, end, G, lie.adjoint(G), covariance, length)


def _pairs(graph: PoseGraph, chain: _Chain, loop: _Corrections) -> _Tests:
    """Compare each loop edge with those nearest to it."""
    begin, end = chain.position[loop.begin], chain.position[loop.end]
    order = np.lexsort((end, begin))
    near = np.full((len(begin), _PARTNERS), -1, np.int64)
    _nearest(begin[order], end[order], 2 * graph.num_nodes, near)
    one, rank = np.nonzero(near >= 0)
    low, high = np.minimum(one, near[one, rank]), np.maximum(one, near[one, rank])
    keys = np.unique(low * len(order) + high)
    one, other = order[keys // len(order)], order[keys % len(order)]
    before, way = chain.between(loop.begin[one], loop.begin[other])
    after, way_back = chain.between(loop.end[one], loop.end[other])
    M = loop.adjoint[one]
    S = loop.covariance[one] + loop.covariance[other] + before
    S += M @ after @ np.swapaxes(M, 1, 2)
    lie = LIE[graph.group]
    e = lie.log(loop.G[one] @ lie.inverse(loop.G[other]))
    length = way + way_back + loop.length[one] + loop.length[other]
    return _Tests(one, other, *_chi2_and_spread(e, S), length)


def _against_odometry(graph: PoseGraph, chain: _Chain, loop: _Corrections) -> _Tests:
    """Compare each loop edge with the way between its ends."""
    begin, end = chain.position[loop.begin], chain.position[loop.end]
    one = np.flatnonzero(np.abs(end - begin) < 2 * graph.num_nodes)
    way, length = chain.between(loop.begin[one], loop.end[one])
    e = LIE[graph.group].log(loop.G[one])
    length = length + loop.length[one]
    return _Tests(one, one, *_chi2_and_spread(e, loop.covariance[one] + way), length)


def _chi2_and_spread(e: Array, S: Array) -> tuple[Array, Array]:
    """Return eᵀ S⁻¹ e and √det S."""
    chi2 = np.einsum("pa,pa->p", e, np.linalg.solve(S, e[:, :, None])[:, :, 0])
    return np.maximum(chi2, 0.0), np.sqrt(np.maximum(np.linalg.det(S), 0.0))


def _chance_of_agreement(graph: PoseGraph, gate: float, spread: Array, length: Array) -> Array:
    """Return how often an error drawn at random would have eᵀ S⁻¹ e below a gate.

    A cycle of straight sides that measure `length` together may miss by that length, any turn, and
    any scale between 1/e and e.

    Args:
        graph: of poses.
        gate: of the test.
        spread: (n,) √det S.
        length: (n,) of the cycle, metres.
    """
    k, d = graph.dim, graph.space
    ball = {n: pi ** (0.5 * n) / gamma(0.5 * n + 1.0) for n in (k, d)}
    turns_and_scales = {3: 2.0 * pi, 6: 8.0 * pi**2, 7: 16.0 * pi**2}[k]
    possible = np.maximum(ball[d] * length**d * turns_and_scales, 1e-300)
    return np.asarray(ball[k] * gate ** (0.5 * k) * spread / possible)


def _variance_factor(graph: PoseGraph, tests: _Tests, quantile: float) -> float:
    """Return v = median(χ² below the gate of v) / median of χ², 1 where it cannot be told.

    Only the surer half of the tests is asked. Most of these must agree, and not because the gate
    of v has become so wide that any edges would.
    """
    order = np.argsort(tests.spread, kind="stable")[: (len(tests.one) + 1) // 2]
    chi2, dim = tests.chi2[order], graph.dim
    if len(chi2) < _FEWEST:
        return 1.0
    middle, gate, variance = chi2_quantile(dim, 0.5), chi2_quantile(dim, quantile), 1.0
    # From a factor at which at least a few agree.
    variance = max(variance, float(np.partition(chi2, _FEWEST - 1)[_FEWEST - 1]) / gate)
    for _ in range(50):
        agreeing = chi2[chi2 <= variance * gate]
        last, variance = variance, max(float(np.median(agreeing)) / middle, LEAST_VARIANCE)
        if abs(variance - last) <= 0.01 * last:
            break
    chance = _chance_of_agreement(graph, variance * gate, tests.spread[order], tests.length[order])
    is_told = 2 * len(agreeing) > len(chi2) and np.median(chance) < _TOO_WIDE
    return variance if is_told else 1.0


@kernel
def _insert(distance: Index, near: Index, far: int, j: int) -> None:
    """Put j among the nearest, the last of which falls out."""
    m = len(distance) - 1
    while m > 0 and distance[m - 1] > far:
        distance[m], near[m] = distance[m - 1], near[m - 1]
        m -= 1
    distance[m], near[m] = far, j


@kernel
def _nearest(begin: Index, end: Index, reach: int, near: Index) -> None:
    """near (L, M) = others by |a - c| + |b - d|, nearest first; begin ascends, then end.

    Those that begin at one node are looked at from the end alike outwards, and no further than what
    is found already: many loops at one node cost no more than many at many.
    """
    count, partners = near.shape
    distance, first, last = np.empty(partners, np.int64), np.empty_like(begin), np.empty_like(begin)
    for i in range(count):
        first[i] = first[i - 1] if i > 0 and begin[i - 1] == begin[i] else i
    for i in range(count - 1, -1, -1):
        last[i] = last[i + 1] if i + 1 < count and begin[i + 1] == begin[i] else i
    for i in range(count):
        distance[:] = reach
        for way in (-1, 1):
            at = i if way < 0 else last[i] + 1
            while 0 <= at < count and abs(begin[at] - begin[i]) < distance[partners - 1]:
                apart = abs(begin[at] - begin[i])
                above = first[at] + np.searchsorted(end[first[at] : last[at] + 1], end[i])
                j = above - 1
                while j >= first[at] and apart + end[i] - end[j] < distance[partners - 1]:
                    if j != i:
                        _insert(distance, near[i], apart + end[i] - end[j], j)
                    j -= 1
                j = above
                while j <= last[at] and apart + end[j] - end[i] < distance[partners - 1]:
                    if j != i:
                        _insert(distance, near[i], apart + end[j] - end[i], j)
                    j += 1
                at = first[at] - 1 if way < 0 else last[at] + 1


def warm_up() -> None:
    """Compile the kernels of this module."""
    one = np.arange(2)
    _nearest(one, one, 2, np.full((2, _PARTNERS), -1, np.int64))
