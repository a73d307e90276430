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

from odomap.backend.blockcholesky import BlockCholesky
from odomap.backend.blocks import BlockPattern
from odomap.backend.chordal import isotropic_weights
from odomap.backend.components import Components, find_components
from odomap.backend.posegraph import PoseGraph
from odomap.backend.projection import nearest_rotations
from odomap.backend.spanning import follow_tree, held_nodes
from odomap.errors import InputError
from odomap.kernels import kernel

__all__ = ["chordal", "place_landmarks", "spanning_tree", "warm_up"]

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
    return _moved_to_priors(graph, follow_tree(graph, components, weights), components)


def chordal(graph: PoseGraph, order: Index | None = None, weights: Array | None = None) -> Array:
    """Place the nodes of a graph by the relaxed chordal cost: rotations, scales, positions.

    Args:
        graph: of poses; of those it holds only fixed nodes and anchors count.
        order: (N,) elimination order of the nodes; approximate minimum degree unless given.
        weights: (E,) of its edges; edges of weight 0 are left out.

    Returns:
        Ts_world_node (N, m, m).

    Raises:
        InputError: weights do not fit, or are negative.
    """
    weights = _checked(weights, graph)
    components = find_components(graph, weights)
    held, Ts = held_nodes(graph, components)
    kappa, tau = (
        _with_trace(w, weights) for w in isotropic_weights(graph.information, graph.space)
    )
    d, sim3 = graph.space, graph.group == "Sim3"
    Zs, scales = graph.Ts_first_second, np.ones(graph.num_edges)
    if sim3:
        scales = np.cbrt(np.linalg.det(Zs[:, :d, :d]))
    Zs_R = Zs[:, :d, :d] / scales[:, None, None]
    known = np.where(held[:, None, None], Ts, np.eye(d + 1))
    s = np.cbrt(np.linalg.det(known[:, :d, :d])) if sim3 else np.ones(len(Ts))
    R, order = _rotations(graph, Zs_R, kappa, held, known[:, :d, :d] / s[:, None, None], order)
    line = _Line(graph, held, order)
    if sim3:
        omega = _with_trace(graph.information[:, 6, 6], weights)
        s = np.exp(line.solve(np.log(scales)[:, None], omega, np.log(s)[:, None])[:, 0])
        R = s[:, None, None] * R
        tau = tau / s[graph.second] ** 2
    steps = (R[graph.first] @ Zs[:, :d, d:])[:, :, 0]
    out = np.zeros(Ts.shape)
    out[:, :d, :d], out[:, d, d] = R, 1.0
    out[:, :d, d] = line.solve(steps, tau, known[:, :d, d])
    out[held] = Ts[held]
    return _moved_to_priors(graph, out, components)


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


def _rotations(
    graph: PoseGraph, Zs: Array, kappa: Array, held: Bool, known: Array, order: Index | None
) -> tuple[Array, Index]:
    """Return rotations (N, d, d) by relaxation and projection, and the order of elimination."""
    n, d = graph.num_nodes, graph.space
    pattern = BlockPattern.of(np.full(n, d), graph.first, graph.second)
    factor = BlockCholesky(pattern, order)
    values, b = np.zeros(pattern.num_values), np.zeros((n, d, d))
    _rotation_equations(
        graph.first,
        graph.second,
        np.ascontiguousarray(Zs),
        kappa,
        held,
        np.ascontiguousarray(np.swapaxes(known, 1, 2)),
        pattern.pair_start[pattern.pair_of(graph.first, graph.second)],
        pattern.diagonal_start,
        values,
        b,
    )
    _factored(factor, values)
    X = factor.solve(b.reshape(n * d, d)).reshape(n, d, d)
    return nearest_rotations(np.swapaxes(X, 1, 2)), factor.order


class _Line:
    """Weighted least squares x_j − x_i ≈ steps on the edges of a graph, some x held."""

    def __init__(self, graph: PoseGraph, held: Bool, order: Index) -> None:
        self.pattern = BlockPattern.of(np.ones(graph.num_nodes), graph.first, graph.second)
        self.pair = self.pattern.pair_start[self.pattern.pair_of(graph.first, graph.second)]
        self.factor = BlockCholesky(self.pattern, order)
        self.ends = graph.first, graph.second
        self.held = held

    def solve(self, steps: Array, weights: Array, known: Array) -> Array:
        """Return x (N, k), given steps (E, k), weights (E,) and x (N, k) of nodes held."""
        values, b = np.zeros(self.pattern.num_values), np.zeros(known.shape)
        steps, known = np.ascontiguousarray(steps), np.ascontiguousarray(known)
        _step_equations(*self.ends, steps, weights, self.held, known, self.pair, values, b)
        _factored(self.factor, values)
        return self.factor.solve(b)


def _factored(factor: BlockCholesky, values: Array) -> None:
    if not factor.factor(values):
        raise InputError(
            "initialisation: weights of edges differ too much for linear equations "
            f"(at node {factor.failed_block}): leave out edges of negligible information"
        )


def _moved_to_priors(graph: PoseGraph, Ts: Array, components: Components) -> Array:
    """Return poses, every component without a fixed node moved as a whole to fit its priors.

    The motion A minimises Σ κ |R_p − A_R R_i|² + τ |t_p − A t_i|², scales matched first.
    """
    priors, d, count = graph.priors, graph.space, components.count
    label = components.label[priors.node]
    use = ~components.has_fixed[label]
    if not use.any():
        return Ts
    label, target, own = label[use], priors.Ts_world_node[use], Ts[priors.node[use]]
    information = priors.information[use]
    kappa, tau = isotropic_weights(information, d)

    def total(weight: Array, of: Array) -> Array:
        sums = np.zeros((count, *of.shape[1:]))
        np.add.at(sums, label, weight.reshape(-1, *[1] * (of.ndim - 1)) * of)
        return sums

    def mean(weight: Array, of: Array) -> Array:
        norm = total(weight, np.ones(len(of))).reshape(-1, *[1] * (of.ndim - 1))
        return np.asarray(total(weight, of) / np.where(norm > 0.0, norm, 1.0))

    R_p, R_i, t_p, t_i = target[:, :d, :d], own[:, :d, :d], target[:, :d, d], own[:, :d, d]
    s = np.ones(count)
    if graph.group == "Sim3":
        ratio = np.log(np.linalg.det(R_p) / np.linalg.det(R_i)) / 3.0
        s = np.exp(mean(information[:, 6, 6], ratio))
    p_mean, i_mean = mean(tau, t_p), mean(tau, t_i)
    lever = s[label, None] * (t_i - i_mean[label])
    M = total(kappa, R_p @ np.swapaxes(R_i, 1, 2))
    M += total(tau, (t_p - p_mean[label])[:, :, None] * lever[:, None, :])
    # Turns that no prior measures are not made.
    M += 1e-9 * np.maximum(np.abs(M).max(axis=(1, 2)), 1e-300)[:, None, None] * np.eye(d)
    A = nearest_rotations(M)
    shift = p_mean - (s[:, None, None] * A @ i_mean[:, :, None])[:, :, 0]
    shift[total(tau, np.ones(len(own))) <= 0.0] = 0.0
    moves = np.zeros((count, d + 1, d + 1))
    moves[:, :d, :d], moves[:, :d, d], moves[:, d, d] = s[:, None, None] * A, shift, 1.0
    moves[np.bincount(label, minlength=count) == 0] = np.eye(d + 1)
    return np.asarray(moves[components.label] @ Ts)


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
    """Normal equations of Σ κ |X_j − Zᵀ X_i|², X = Rᵀ: A_ii, A_jj += κ I, A_ij −= κ Z.

    Rows of nodes held say X = known, and their columns go to the right-hand side.
    """
    d = Zs.shape[1]
    for e in range(len(first)):
        i, j, w = first[e], second[e], kappa[e]
        for a in range(d):
            if not held[i]:
                values[diagonal[i] + a * (d + 1)] += w
            if not held[j]:
                values[diagonal[j] + a * (d + 1)] += w
            for c in range(d):
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
