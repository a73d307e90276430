"""Moving the parts of a pose graph to where their priors say they are.

An initialisation places the nodes of a connected component relative to each other; where the whole
lies is only known from its priors (measured poses: a surveyed marker, a satellite fix). The motion
A = (s, R, t) that fits them best minimises

    Σ κ |R_p − R R_i|²_F + τ |t_p − (s R t_i + t)|²,

κ and τ as in `chordal`. In similarities s comes first, from the mean of log scales; t takes the
weighted mean of the positions to that of the priors; and R is the rotation nearest to

    Σ κ R_p R_iᵀ + τ s (t_p − t̄_p)(t_i − t̄_i)ᵀ,

orientations and lever arms alike: priors of positions alone turn a component as well. O(P).

Reference: S. Umeyama, "Least-squares estimation of transformation parameters between two point
patterns", IEEE T-PAMI 13(4), 1991.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.chordal import isotropic_weights
from odomap.backend.graphs.components import Components
from odomap.backend.graphs.posegraph import PoseGraph
from odomap.backend.graphs.projection import nearest_rotations

__all__ = ["fit_to_priors"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def fit_to_priors(graph: PoseGraph, Ts_world_node: Array, components: Components) -> Array:
    """Move every component without a fixed node as a whole, so that it fits its priors.

    Args:
        graph: with the priors.
        Ts_world_node: (N, m, m) poses, all known.
        components: of the graph.

    Returns:
        Ts_world_node (N, m, m); a component without priors, or with information on none, stays.
    """
    priors, d, count = graph.priors, graph.space, components.count
    label = components.label[priors.node]
    use = ~components.has_fixed[label]
    if not use.any():
        return Ts_world_node
    label, target, own = label[use], priors.Ts_world_node[use], Ts_world_node[priors.node[use]]
    kappa, tau = isotropic_weights(priors.information[use], d)
    R_p, R_i, t_p, t_i = target[:, :d, :d], own[:, :d, :d], target[:, :d, d], own[:, :d, d]
    s = np.ones(count)
    if graph.group == "Sim3":
        ratio = np.log(np.linalg.det(R_p) / np.linalg.det(R_i)) / 3.0
        s = np.exp(_means(priors.information[use, 6, 6], ratio, label, count))
    p_mean, i_mean = _means(tau, t_p, label, count), _means(tau, t_i, label, count)
    lever = s[label, None] * (t_i - i_mean[label])
    M = _sums(kappa, R_p @ np.swapaxes(R_i, 1, 2), label, count)
    M += _sums(tau, (t_p - p_mean[label])[:, :, None] * lever[:, None, :], label, count)
    # A turn that no prior measures is not made.
    M += 1e-12 * np.maximum(np.abs(M).max(axis=(1, 2)), 1e-200)[:, None, None] * np.eye(d)
    R = s[:, None, None] * nearest_rotations(M)
    moves = np.zeros((count, d + 1, d + 1))
    moves[:, :d, :d], moves[:, d, d] = R, 1.0
    moves[:, :d, d] = p_mean - (R @ i_mean[:, :, None])[:, :, 0]
    return np.asarray(moves[components.label] @ Ts_world_node)


def _sums(weights: Array, values: Array, label: Index, count: int) -> Array:
    """Return Σ w v over the items of each label (count, ...)."""
    sums = np.zeros((count, *values.shape[1:]))
    np.add.at(sums, label, weights.reshape(-1, *[1] * (values.ndim - 1)) * values)
    return sums


def _means(weights: Array, values: Array, label: Index, count: int) -> Array:
    """Return Σ w v / Σ w over the items of each label, 0 where there is no weight."""
    total = np.bincount(label, weights, minlength=count)
    total = np.where(total > 0.0, total, 1.0).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(_sums(weights, values, label, count) / total)
