"""The essential graph: a path is corrected by a loop through few edges that say all.

What ties keyframes together are thousands of landmarks, but where a loop bends the path a graph of
poses tells enough. Its edges are relative placements S_i⁻¹ S_j of

    tree          each keyframe and its parent, as they are now; as unsure as odometry was between
    covisibility  keyframes of two branches that share many landmarks, as they are now
    loop          as measured when it was closed, never as it is now

S is of SE(3), or of Sim(3) for a single camera. A new loop is believed if odometry and the earlier
loops do not contradict it: graduated non-convexity on tree and loops. Then all edges give the
poses; marginals of tree and loops say how sure these are,

    Σ_k = (H⁻¹)_kk + Ad(T_k_root) Σ_root Ad(T_k_root)ᵀ,

without the covisibility edges, which hold branches together but measured nothing new. With no loop
that is what odometry claimed. Covisible keyframes of one branch have no edge, unlike in the paper:
it would say again what the tree says. Across gaps nothing was measured: each piece of a map
(`maps/atlas`) is held by its oldest keyframe, until a loop to an older piece, which nothing
contradicts, holds it instead, and so moves and scales it as a whole.

Cost: a handful of sparse factorisations, O(K^1.5).

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015; Strasdat, Montiel, Davison, "Scale drift-aware large scale monocular SLAM", RSS 2010.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from odomap.backend.descent import SolverConfig
from odomap.backend.graphs.components import connected_components, find_components
from odomap.backend.graphs.covariances import GraphCovariances
from odomap.backend.graphs.gnc import find_inliers
from odomap.backend.graphs.posegraph import Group, PoseGraph
from odomap.backend.graphs.solve import solve
from odomap.geometry.lie import se3_adjoint, se3_inverse, sim3_inverse, so3_log
from odomap.maps.states import stretched

__all__ = ["Corrected", "EssentialGraph", "Essentials", "LoopEdges", "correct"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bool = NDArray[np.bool_]

STEP_LENGTH = 0.05
"""σ of a tree edge's translation where nobody told, relative to the median length of the edges."""
STEP_ANGLE = 0.005
"""σ of its rotation, radians."""
STEP_SCALE = 0.01
"""σ of the logarithm of its scale, which no covariance of the map tells."""
LOOP_SCALE = 0.005
"""σ of the logarithm of a measured loop's scale, which edges of the map do not keep."""
FLOOR = 0.05
"""No tree edge is surer than this share of what it would be if nobody told."""
DOUBT = 5.0
"""Factor on all standard deviations while it is asked whether a loop is to be believed. What they
do not know (a rolling shutter, images at other instants than depth) makes real paths that much
worse: normalised errors squared of 30 to 80 per degree of freedom where true loops are closed."""
LEAST_FACTOR = 0.1
"""To no less than this part of their variance steps are made surer where the map says so."""
FAR = 10
"""Steps of the tree within which covisibility says nothing that the tree does not say."""
ITERATIONS = 20
"""Steps that the last solution takes at most; those before have brought it near."""


class LoopEdges(NamedTuple):
    """Measured loops.

    Attributes:
        i, j: (L,) rows of the keyframes.
        Ts_i_j: (L, 4, 4) pose of j in i, in the units of i.
        scales_i_j: (L,) units of i per unit of j.
        information: (L, 6, 6), right tangent, in the units of i.
        ends: (L, 2) keyframes that came back, and those they came back to, as the map names them;
            where these are gone, i and j hold them.
    """

    i: Index
    j: Index
    Ts_i_j: Array
    scales_i_j: Array
    information: Array
    ends: Index


@dataclass(frozen=True, eq=False)
class Essentials:
    """What the graph is made of, read from the map.

    Attributes:
        keyframe_ids: (K,) ascending.
        Ts_world_body: (K, 4, 4).
        scales: (K,) world units per unit of the keyframe.
        covariances: (K, 6, 6) as the map has them, NaN where unknown.
        parent: (K,) rows in the spanning tree, −1 for the root, and where a piece begins.
        growth: (K, 6, 6) by what each is less sure than its parent, in its own units; NaN where
            unknown.
        pairs: (C, 2) rows of keyframes that share many landmarks.
        loops: closed before.
        version: of the map.
    """

    keyframe_ids: Index
    Ts_world_body: Array
    scales: Array
    covariances: Array
    parent: Index
    growth: Array
    pairs: Index
    loops: LoopEdges
    version: int

    @property
    def root(self) -> int:
        """Row of the oldest root, which stays where it is."""
        return int(np.flatnonzero(self.parent < 0)[0])


@dataclass(frozen=True, eq=False)
class EssentialGraph(PoseGraph):
    """A pose graph that is told which of its edges are doubted; by name it could not tell.

    Attributes:
        is_doubted: (E,) loop edges.
    """

    is_doubted: Bool = None  # type: ignore[assignment]

    @property
    def is_loop(self) -> Bool:
        """(E,) whether an edge is a loop."""
        return self.is_doubted

    def without(self, edges: Bool) -> Self:
        """Return the graph without the edges marked (E,)."""
        other = super().without(edges)
        other._set("is_doubted", self.is_doubted[~np.asarray(edges, bool)])
        return other


@dataclass(frozen=True, eq=False)
class Corrected:
    """What a new loop makes of the path.

    Attributes:
        Ts_world_body: (K, 4, 4) poses.
        scales: (K,) world units per unit of the keyframe.
        covariances: (K, 6, 6) of the poses; None where the map knew none.
        is_accepted: whether the loop is believed; if not, all is as it was.
        doubted: (D, 2) ends of earlier loops that contradict the new ones: they are not believed.
        reason: why the new loop is not.
        is_believed: (L,) which of the new loops are.
        is_merging: (L,) which of the new loops tie pieces that nothing tied before.
    """

    Ts_world_body: Array
    scales: Array
    covariances: Array | None
    is_accepted: bool
    doubted: Index = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    reason: str = ""
    is_believed: Bool = field(default_factory=lambda: np.zeros(0, bool))
    is_merging: Bool = field(default_factory=lambda: np.zeros(0, bool))


def correct(parts: Essentials, new: LoopEdges, with_scale: bool) -> Corrected:
    """Correct a path by new loops.

    Args:
        parts: the map's keyframes and what ties them.
        new: a loop, or several that are found together.
        with_scale: whether scale drifts: a single camera.

    Returns:
        Where the keyframes are then, or why none of the loops is believed.
    """
    loops = LoopEdges(*(np.concatenate(both) for both in zip(parts.loops, new)))
    count = len(new.i)
    sparse = _as_unsure_as_told(parts, _graph(parts, loops, with_scale), count)
    is_merging = _is_apart(sparse, count)
    doubts = np.full(sparse.num_edges, DOUBT**-2)
    inliers = find_inliers(sparse, doubts)
    is_true = inliers.is_inlier | ~sparse.is_doubted
    is_loop_true = is_true[sparse.is_doubted]
    doubted, is_believed = loops.ends[:-count][~is_loop_true[:-count]], is_loop_true[-count:]
    told = doubted, "", is_believed, is_merging
    if not is_believed.any():
        told = doubted, _contradiction(sparse), is_believed, is_merging
        return Corrected(parts.Ts_world_body, parts.scales, None, False, *told)
    whole = _with_covisibility(sparse.placed(inliers.Ts_world_node), parts)
    weights = np.concatenate([is_true, np.ones(whole.num_edges - len(is_true))])
    config = SolverConfig(iterations=ITERATIONS)
    solution = solve(whole, initial="given", weights=weights, config=config)
    Ts, scales = _rigid(solution.Ts_world_node, with_scale)
    believed = sparse.without(~is_true).placed(solution.Ts_world_node)
    return Corrected(Ts, scales, _covariances(parts, believed, Ts, scales), True, *told)


# ---- the graph ----


def _graph(parts: Essentials, loops: LoopEdges, with_scale: bool) -> EssentialGraph:
    """Return tree and loops as a graph, the loops last."""
    group: Group = "Sim3" if with_scale else "SE3"
    Ts = _similar(parts.Ts_world_body, parts.scales, with_scale)
    child = np.flatnonzero(parts.parent >= 0)
    parent = parts.parent[child]
    steps = _between(Ts, parent, child, with_scale)
    is_fixed = np.zeros(len(Ts), bool)
    is_fixed[parts.root] = True
    measured = _similar(loops.Ts_i_j, loops.scales_i_j, with_scale)
    ties = loops.information
    if with_scale:  # tangents are those of j, in its units; information goes the other way
        ties = stretched(ties, loops.scales_i_j)
    ties = _with_log_scale(ties, LOOP_SCALE**-2, with_scale)
    return EssentialGraph(
        group,
        Ts,
        np.concatenate([parent, loops.i]),
        np.concatenate([child, loops.j]),
        np.concatenate([steps, measured]),
        np.concatenate([_step_information(parts, steps, child, with_scale), ties]),
        is_fixed=is_fixed,
        is_doubted=np.arange(len(child) + len(loops.i)) >= len(child),
    )


def _as_unsure_as_told(parts: Essentials, graph: EssentialGraph, count: int) -> EssentialGraph:
    """Return the graph with steps by which the path is as unsure as the map says that it is.

    Errors that go on as they were are taken for a walk at random, step by step, and what the steps
    are less sure by adds up to more than all of it. They are made surer by one factor.

    Args:
        parts: what the map says.
        graph: tree and loops.
        count: of the loops, the last, of which the map does not know yet.
    """
    is_new = np.arange(graph.num_edges) >= graph.num_edges - count
    told = stretched(parts.covariances, 1.0 / parts.scales)
    rows = np.flatnonzero(np.isfinite(told).all(axis=(1, 2)) & (parts.parent >= 0))
    if not (len(rows) and np.isfinite(told[parts.root]).all()):
        return graph
    walk = GraphCovariances(graph.without(is_new)).marginals()[rows, :6, :6]
    T = parts.Ts_world_body
    Ad = se3_adjoint(se3_inverse(T[rows]) @ T[parts.root])
    held = Ad @ parts.covariances[parts.root] @ np.swapaxes(Ad, 1, 2)
    walk = walk + stretched(held, 1.0 / parts.scales[rows])
    ratio = np.trace(np.linalg.solve(walk, told[rows]), axis1=1, axis2=2) / 6.0
    factor = float(np.clip(np.median(ratio), LEAST_FACTOR, 1.0))
    surer = np.where(graph.is_doubted, 1.0, 1.0 / factor)
    return replace(graph, information=graph.information * surer[:, None, None])


def _with_covisibility(graph: EssentialGraph, parts: Essentials) -> EssentialGraph:
    """Return the graph with its covisibility edges, last, as the map places them now."""
    i, j = parts.pairs[_is_across(parts)].T
    is_step = ~graph.is_doubted
    steps = np.zeros((graph.num_nodes, graph.dim, graph.dim))
    steps[graph.second[is_step]] = graph.information[is_step]
    with_scale = graph.group == "Sim3"
    Ts = _similar(parts.Ts_world_body, parts.scales, with_scale)
    return replace(
        graph,
        first=np.concatenate([graph.first, i]),
        second=np.concatenate([graph.second, j]),
        Ts_first_second=np.concatenate([graph.Ts_first_second, _between(Ts, i, j, with_scale)]),
        information=np.concatenate([graph.information, steps[j]]),
        is_doubted=np.concatenate([graph.is_doubted, np.zeros(len(i), bool)]),
    )


def _is_across(parts: Essentials) -> Bool:
    """Say which pairs (C,) of keyframes are in different branches of the tree.

    The way from one to the other leads over their nearest common ancestor; parents are older.
    """
    i, j = parts.pairs.T
    is_other = parts.parent[j] >= 0
    for _ in range(FAR):
        low, high = np.minimum(i, j), np.maximum(i, j)
        up = np.where((low == high) | (parts.parent[high] < 0), high, parts.parent[high])
        i, j = low, up
    return np.asarray(is_other & (i != j))


def _step_information(parts: Essentials, steps: Array, child: Index, with_scale: bool) -> Array:
    """Return the information of tree edges, (n, k, k), from how odometry grew less sure."""
    sigma = np.full((len(child), 6), STEP_ANGLE)
    sigma[:, :3] = STEP_LENGTH * _usual_lengths(parts, steps, child)[:, None]
    untold = sigma[:, :, None] ** 2 * np.eye(6)
    growth = parts.growth[child]
    is_told = np.isfinite(growth).all(axis=(1, 2), keepdims=True)
    kept = _positive(np.where(is_told, growth, untold), sigma)
    information = np.asarray(np.linalg.inv(kept + FLOOR**2 * untold), np.float64)
    information = 0.5 * (information + np.swapaxes(information, 1, 2))
    return _with_log_scale(information, STEP_SCALE**-2, with_scale)


def _usual_lengths(parts: Essentials, steps: Array, child: Index) -> Array:
    """Return of each tree edge (n,) the median length in its piece, which has units of its own."""
    piece = connected_components(len(parts.keyframe_ids), parts.parent[child], child)[child]
    lengths, usual = np.linalg.norm(steps[:, :3, 3], axis=1), np.ones(len(child))
    for one in np.unique(piece[lengths > 0.0]).tolist():
        usual[piece == one] = np.median(lengths[(piece == one) & (lengths > 0.0)])
    return usual


def _positive(growth: Array, unit: Array) -> Array:
    """Return the nearest positive semidefinite (n, 6, 6) with the same trace in units (n, 6).

    Errors that go on as they were, of the calibration, make a covariance grow by g δᵀ + δ gᵀ, which
    is indefinite; a walk at random that is as unsure in the end grows by its trace.
    """
    units = unit[:, :, None] * unit[:, None, :]
    scaled = 0.5 * (growth + np.swapaxes(growth, 1, 2)) / units
    values, axes = np.linalg.eigh(scaled)
    positive = np.maximum(values, 0.0)
    share = np.maximum(values.sum(axis=1), 0.0) / np.maximum(positive.sum(axis=1), 1e-300)
    kept = (axes * (share[:, None] * positive)[:, None, :]) @ np.swapaxes(axes, 1, 2)
    return np.asarray(kept * units)


def _with_log_scale(information: Array, of_scale: float, with_scale: bool) -> Array:
    """Return (n, 7, 7) of (n, 6, 6) for similarities, which measure their scale, too."""
    if not with_scale:
        return information
    wider = np.zeros((len(information), 7, 7))
    wider[:, :6, :6] = information
    wider[:, 6, 6] = of_scale
    return wider


def _similar(Ts: Array, scales: Array, with_scale: bool) -> Array:
    """Return placements as matrices, (n, 4, 4) with s R for similarities."""
    similar = Ts.copy()
    if with_scale:
        similar[:, :3, :3] *= scales[:, None, None]
    return similar


def _rigid(Ts: Array, with_scale: bool) -> tuple[Array, Array]:
    """Return matrices (n, 4, 4) as poses and scales."""
    if not with_scale:
        return Ts, np.ones(len(Ts))
    scales, rigid = np.cbrt(np.linalg.det(Ts[:, :3, :3])), Ts.copy()
    rigid[:, :3, :3] /= scales[:, None, None]
    return rigid, scales


def _between(Ts: Array, i: Index, j: Index, with_scale: bool) -> Array:
    inverse = sim3_inverse if with_scale else se3_inverse
    return np.asarray(inverse(Ts[i]) @ Ts[j])


def _is_apart(graph: EssentialGraph, count: int) -> Bool:
    """Say which of the last `count` loops tie parts that nothing else ties."""
    label = find_components(
        graph.without(np.arange(graph.num_edges) >= graph.num_edges - count)
    ).label
    return np.asarray((label[graph.first] != label[graph.second])[-count:])


# ---- what comes of it ----


def _contradiction(graph: EssentialGraph) -> str:
    """Say how far the last loop is from what the graph says without it."""
    inverse = sim3_inverse if graph.group == "Sim3" else se3_inverse
    i, j = graph.first[-1], graph.second[-1]
    off = inverse(graph.Ts_first_second[-1]) @ inverse(graph.Ts_world_node[i])
    Ts, scales = _rigid((off @ graph.Ts_world_node[j])[None], graph.group == "Sim3")
    angle = np.degrees(np.linalg.norm(so3_log(Ts[0, :3, :3])))
    return (
        f"contradicts the path: {np.linalg.norm(Ts[0, :3, 3]):.2g} away and {angle:.1f}° turned"
        + (f", {100.0 * (scales[0] - 1.0):+.1f} % in scale" if graph.group == "Sim3" else "")
        + ", more than odometry and other loops allow"
    )


def _covariances(
    parts: Essentials, graph: EssentialGraph, Ts: Array, scales: Array
) -> Array | None:
    """Return how sure the poses are, (K, 6, 6); None where the map knew nothing of it."""
    if not np.isfinite(parts.growth).all(axis=(1, 2)).any():
        return None
    found = stretched(GraphCovariances(graph).marginals()[:, :6, :6], scales)
    parted = find_components(graph)
    roots = parted.anchor[parted.label]  # each held by the oldest of its piece, as sure as that is
    known = np.where(np.isfinite(parts.covariances[roots]), parts.covariances[roots], 0.0)
    Ad = se3_adjoint(se3_inverse(Ts) @ Ts[roots])
    found = found + Ad @ known @ np.swapaxes(Ad, 1, 2)
    return np.asarray(0.5 * (found + np.swapaxes(found, 1, 2)))
