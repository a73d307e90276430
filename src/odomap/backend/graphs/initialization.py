"""A good start for a pose graph: rotations first, then positions, both by linear least squares.

Pose graphs have local minima, nearly all of them from wrong rotations. The chordal cost without the
condition that the R_i are rotations is linear least squares,

    min Σ κ |R_j − R_i R̃|²_F      over matrices, those of anchors held,

whose solution sees all edges and loops at once; each matrix is then replaced by the nearest
rotation. With rotations known, log scales λ (Sim3) and positions are linear least squares as well:

    min Σ ω (λ_j − λ_i − λ̃)²,      min Σ τ |t_j − t_i − s_i R_i t̃|² / s_j².

All three have one block per node and the pattern of the graph, so one elimination order serves
them. What has no rotation information at all gets a trace of weight, to keep the systems regular.
A component without a fixed node is at last moved as a whole to fit its priors, and landmarks go to
the mean of where they were seen. Cost: three sparse factorisations, the first of block size d.

Reference: L. Carlone, R. Tron, K. Daniilidis, F. Dellaert, "Initialization techniques for 3D SLAM:
a survey on rotation estimation and its use in pose graph optimization", ICRA 2015.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.chordal import isotropic_weights
from odomap.backend.graphs.components import find_components
from odomap.backend.graphs.posegraph import PoseGraph
from odomap.backend.graphs.priorfit import fit_to_priors
from odomap.backend.graphs.projection import nearest_rotations
from odomap.backend.graphs.spanning import follow_tree, held_nodes
from odomap.backend.sparse.blockcholesky import BlockCholesky
from odomap.backend.sparse.blocks import BlockPattern
from odomap.errors import InputError
from odomap.kernels import kernel

__all__ = ["chordal", "node_factor", "place_landmarks", "spanning_tree", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bool = NDArray[np.bool_]

_TRACE = 1e-9
"""Weight of an edge without information, relative to the median of the others."""


def spanning_tree(graph: PoseGraph, weights: Array | None = None) -> Array:
    """Place the nodes of a graph along its shallowest spanning trees.

    Args:
        graph: of poses; of those it holds only fixed nodes and anchors count.
        weights: (E,) of its edges; edges of weight 0 are left out.

    Returns:
        Ts_world_node (N, m, m).

    Raises:
        InputError: weights do not fit, or are negative.

    Example:
        >>> step, unknown = np.eye(3), np.full((3, 3, 3), np.nan)
        >>> step[0, 2] = 1.0
        >>> graph = PoseGraph("SE2", unknown, [0, 1], [1, 2], [step] * 2, [np.eye(3)] * 2)
        >>> spanning_tree(graph)[:, 0, 2].tolist()
        [0.0, 1.0, 2.0]
    """
    weights = _checked(weights, graph)
    components = find_components(graph, weights)
    return fit_to_priors(graph, follow_tree(graph, components, weights), components)


def chordal(
    graph: PoseGraph, factor: BlockCholesky | None = None, weights: Array | None = None
) -> Array:
    """Place the nodes of a graph by the relaxed chordal cost: rotations, scales, positions.

    Args:
        graph: of poses; of those it holds only fixed nodes and anchors count.
        factor: room for the factor of one unknown per node (`node_factor`), if there is one; its
            order serves all systems.
        weights: (E,) of its edges; edges of weight 0 are left out.

    Returns:
        Ts_world_node (N, m, m).

    Raises:
        InputError: weights do not fit, or are negative.
    """
    weights = _checked(weights, graph)
    components = find_components(graph, weights)
    held, Ts = held_nodes(graph, components)
    d, Zs = graph.space, graph.Ts_first_second
    known = np.where(held[:, None, None], Ts, np.eye(d + 1))
    kappa, tau = (
        _with_trace(w, weights) for w in isotropic_weights(graph.information, graph.space)
    )
    relaxed = _Relaxation(graph, held, node_factor(graph) if factor is None else factor)
    scale_known, R_known = _scale_and_rotation(known, graph)
    scale_edge, R_edge = _scale_and_rotation(Zs, graph)
    R = relaxed.rotations(R_edge, kappa, R_known)
    if graph.group == "Sim3":
        omega = _with_trace(graph.information[:, 6, 6], weights)
        log_scale = relaxed.along(np.log(scale_edge)[:, None], omega, np.log(scale_known)[:, None])[
            :, 0
        ]
        R *= np.exp(log_scale)[:, None, None]
        tau = tau * np.exp(-2.0 * log_scale[graph.second])
    steps = (R[graph.first] @ Zs[:, :d, d:])[:, :, 0]
    out = np.zeros(Ts.shape)
    out[:, :d, :d], out[:, d, d] = R, 1.0
    out[:, :d, d] = relaxed.along(steps, tau, known[:, :d, d])
    out[held] = Ts[held]
    return fit_to_priors(graph, out, components)


def node_factor(graph: PoseGraph) -> BlockCholesky:
    """Return room for the factor of a matrix with one row per node, and an entry per edge."""
    nodes = np.ones(graph.num_nodes, np.int64)
    return BlockCholesky(BlockPattern.of(nodes, graph.first, graph.second))


def place_landmarks(graph: PoseGraph, Ts_world_node: Array) -> Array:
    """Return each landmark (M, d) at the mean of where the nodes saw it.

    Args:
        graph: with sights of landmarks.
        Ts_world_node: (N, m, m) poses of its nodes.

    Raises:
        InputError: a landmark was never seen, and its position is not known either.
    """
    sights, d = graph.points, graph.space
    T = Ts_world_node[sights.node]
    seen = (T[:, :d, :d] @ sights.points_node[:, :, None])[:, :, 0] + T[:, :d, d]
    count = np.bincount(sights.point, minlength=len(sights.points_world))
    out = sights.points_world.copy()
    out[count > 0] = 0.0
    np.add.at(out, sights.point, seen)
    out /= np.maximum(count, 1)[:, None]
    if not np.isfinite(out).all():
        which = int(np.argmin(np.isfinite(out).all(axis=1)))
        name = sights.ids[which]
        raise InputError(f"landmark {name}: was never seen and has no position, drop it")
    return out


def _checked(weights: Array | None, graph: PoseGraph) -> Array:
    """Return weights (E,), ones unless given."""
    if weights is None:
        return np.ones(graph.num_edges)
    weights = np.ascontiguousarray(weights, np.float64)
    if weights.shape != (graph.num_edges,) or not (weights >= 0.0).all():
        raise InputError(f"weights: give {graph.num_edges} numbers of at least 0, one per edge")
    return weights


def _with_trace(precision: Array, weights: Array) -> Array:
    """Return precisions times weights, never 0 where the weight is not."""
    some = precision[precision > 0.0]
    least = _TRACE * float(np.median(some)) if len(some) else 1.0
    return np.where(weights > 0.0, np.maximum(precision * weights, least), 0.0)


def _scale_and_rotation(Ts: Array, graph: PoseGraph) -> tuple[Array, Array]:
    """Return scales (n,), which are 1 but in Sim3, and rotations (n, d, d)."""
    A = Ts[:, : graph.space, : graph.space]
    if graph.group != "Sim3":
        return np.ones(len(A)), A
    scale = np.cbrt(np.linalg.det(A))
    return scale, A / scale[:, None, None]


class _Relaxation:
    """The linear systems of a graph, some nodes held: one pattern and order, two block sizes."""

    def __init__(self, graph: PoseGraph, held: Bool, factor: BlockCholesky) -> None:
        self.ends, self.held, self.space = (graph.first, graph.second), held, graph.space
        self.pattern, self.factor = factor.pattern, factor
        self.pair = self.pattern.pair_of(*self.ends)

    def rotations(self, Zs: Array, kappa: Array, known: Array) -> Array:
        """Return R (N, d, d), given those of edges (E, d, d), κ (E,) and R of nodes held."""
        d, n = self.space, len(known)
        pattern = BlockPattern(np.full(n, d), self.pattern.first, self.pattern.second)
        factor = BlockCholesky(pattern, self.factor.order)
        values, b = np.zeros(pattern.num_values), np.zeros((n, d, d))
        edges, X_known = np.ascontiguousarray(Zs), _transposed(known)
        places = pattern.pair_start[self.pair], pattern.diagonal_start
        _rotation_equations(*self.ends, edges, kappa, self.held, X_known, *places, values, b)
        X = _solved(factor, values, b.reshape(n * d, d)).reshape(n, d, d)
        return nearest_rotations(_transposed(X))

    def along(self, steps: Array, weights: Array, known: Array) -> Array:
        """Return x (N, k) with x_j − x_i ≈ steps (E, k), given weights (E,) and x of nodes held."""
        values, b = np.zeros(self.pattern.num_values), np.zeros(known.shape)
        steps, known = np.ascontiguousarray(steps), np.ascontiguousarray(known)
        pair = self.pattern.pair_start[self.pair]
        _step_equations(*self.ends, steps, weights, self.held, known, pair, values, b)
        return _solved(self.factor, values, b)


def _transposed(matrices: Array) -> Array:
    return np.ascontiguousarray(np.swapaxes(matrices, 1, 2))


def _solved(factor: BlockCholesky, values: Array, b: Array) -> Array:
    """Return x with A x = b, column by column: for two or three that is the fastest."""
    if not factor.factor(values):
        raise InputError(
            "initialisation: weights of edges differ too much for linear equations "
            f"(at node {factor.failed_block}): leave out edges of negligible information"
        )
    return np.stack([factor.solve(column) for column in np.ascontiguousarray(b.T)], axis=1)


@kernel
def _rotation_equations(
    first: Index,
    second: Index,
    Zs: Array,
    kappa: Array,
    held: Bool,
    known: Array,
    pair: Index,
    diagonal: Index,
    values: Array,
    b: Array,
) -> None:
    """Normal equations of Σ κ |X_j − Zᵀ X_i|², X = Rᵀ: A_ii += κ Z Zᵀ, A_jj += κ I, A_ij −= κ Z.

    Rows of nodes held say X = known, and their columns go to the right-hand side.
    """
    d = Zs.shape[1]
    for e in range(len(first)):
        i, j, w = first[e], second[e], kappa[e]
        for a in range(d):
            if not held[j]:
                values[diagonal[j] + a * (d + 1)] += w
            for c in range(d):
                if not held[i]:  # Z Zᵀ, as rotations in files are rounded
                    for k in range(d):
                        values[diagonal[i] + a * d + c] += w * Zs[e, a, k] * Zs[e, c, k]
                if held[i] or held[j]:
                    for k in range(d):
                        if not held[j]:
                            b[j, a, c] += w * Zs[e, k, a] * known[i, k, c]
                        if not held[i]:
                            b[i, a, c] += w * Zs[e, a, k] * known[j, k, c]
                elif i < j:
                    values[pair[e] + a * d + c] -= w * Zs[e, a, c]
                else:
                    values[pair[e] + a * d + c] -= w * Zs[e, c, a]
    for i in range(len(held)):
        if held[i]:
            for a in range(d):
                values[diagonal[i] + a * (d + 1)] = 1.0
                for c in range(d):
                    b[i, a, c] = known[i, a, c]


@kernel
def _step_equations(
    first: Index,
    second: Index,
    steps: Array,
    weights: Array,
    held: Bool,
    known: Array,
    pair: Index,
    values: Array,
    b: Array,
) -> None:
    """Normal equations of Σ w |x_j − x_i − step|² in blocks of one; nodes held as above."""
    for e in range(len(first)):
        i, j, w = first[e], second[e], weights[e]
        if not held[i]:
            values[i] += w
        if not held[j]:
            values[j] += w
        if not (held[i] or held[j]):
            values[pair[e]] -= w
        for c in range(steps.shape[1]):
            if not held[j]:
                b[j, c] += w * steps[e, c]
                if held[i]:
                    b[j, c] += w * known[i, c]
            if not held[i]:
                b[i, c] -= w * steps[e, c]
                if held[j]:
                    b[i, c] += w * known[j, c]
    for i in range(len(held)):
        if held[i]:
            values[i] = 1.0
            for c in range(steps.shape[1]):
                b[i, c] = known[i, c]


def warm_up() -> None:
    """Compile the kernels of this module."""
    Ts = np.stack([np.eye(3), np.eye(3)])
    chordal(PoseGraph("SE2", Ts, np.array([0]), np.array([1]), Ts[:1], Ts[:1]))
