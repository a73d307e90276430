"""Folding: nodes go from a pose graph, and few edges between the others say what theirs said.

What edges to nodes that go say about those that stay is the marginal of all of them. With the first
of n that stay held, it has a dense covariance over the others; as a graph it would have an edge
between any two. A tree of n - 1 edges is kept instead, each the pose of j in i with its marginal
covariance,

    z_ij = T_i⁻¹ T_j,    Σ_ij = [-M I] P_(ij)(ij) [-M I]ᵀ,    M = Ad(T_j⁻¹ T_i),

of all trees the one of least Σ log det Σ_ij: none is nearer to the marginal in the sense of
Kullback and Leibler, if its edges are to be independent. Of two nodes it says no more than the
marginal did, of those far apart in the tree rather less.

Poses are first solved with these edges alone, so that what others measured is not in z as well.
Cost: O(nodes³) of each connected part, which is small.

Reference: H. Kretzschmar, C. Stachniss, "Information-theoretic compression of pose graphs for
laser-based SLAM", International Journal of Robotics Research 31(11), 2012.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.components import find_components
from odomap.backend.graphs.consensus import LIE
from odomap.backend.graphs.posegraph import PoseGraph
from odomap.backend.graphs.solve import solve

__all__ = ["Folded", "fold"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bool = NDArray[np.bool_]


class Folded(NamedTuple):
    """Edges between nodes that stay.

    Attributes:
        first, second: (E,) nodes.
        Ts_first_second: (E, m, m) pose of the second in the first.
        information: (E, k, k), right tangent.
    """

    first: Index
    second: Index
    Ts_first_second: Array
    information: Array


def fold(graph: PoseGraph, is_gone: Bool) -> Folded:
    """Let nodes go from a graph.

    Args:
        graph: those nodes with all their edges, and the nodes at the other ends, near where they
            belong; edges between these are folded in as well.
        is_gone: (N,) nodes that go.

    Returns:
        At most one edge less than there are nodes that stay. Parts of the graph that were not
        connected are not connected by it, and of a part that no two nodes stay of nothing is left.

    Example:
        >>> Ts = np.tile(np.eye(3), (3, 1, 1))
        >>> Ts[:, 0, 2] = 0, 1, 2
        >>> steps = Ts[[1, 1]]
        >>> chain = PoseGraph("SE2", Ts, [0, 1], [1, 2], steps, np.tile(4 * np.eye(3), (2, 1, 1)))
        >>> folded = fold(chain, np.array([False, True, False]))
        >>> folded.Ts_first_second[0, 0, 2].round(9), folded.information[0, 0, 0].round(9)
        (np.float64(2.0), np.float64(2.0))
    """
    graph = graph.placed(solve(graph, initial="given").Ts_world_node) if graph.num_edges else graph
    first: list[Index] = []
    second: list[Index] = []
    information: list[Array] = [np.zeros((0, graph.dim, graph.dim))]
    label = find_components(graph).label
    for part in range(label.max(initial=-1) + 1):
        nodes = np.flatnonzero(label == part)
        stay = nodes[~is_gone[nodes]]
        if len(stay) < 2:
            continue
        covariances = _relative_covariances(graph, np.r_[stay, nodes[is_gone[nodes]]], len(stay))
        pairs = _cheapest_tree(np.linalg.slogdet(covariances)[1])
        first.append(stay[pairs[:, 0]])
        second.append(stay[pairs[:, 1]])
        information.append(np.asarray(np.linalg.inv(covariances[tuple(pairs.T)])))
    none = np.zeros(0, np.int64)
    i, j = np.concatenate([none, *first]), np.concatenate([none, *second])
    Ts = graph.Ts_world_node
    matrices = np.concatenate(information)
    symmetric = 0.5 * (matrices + np.swapaxes(matrices, 1, 2))
    return Folded(i, j, LIE[graph.group].inverse(Ts[i]) @ Ts[j], symmetric)


def _relative_covariances(graph: PoseGraph, nodes: Index, count: int) -> Array:
    """Return (n, n, k, k) covariances of T_i⁻¹ T_j of the first n of the nodes of a part.

    Those of a node and itself are the identity.
    """
    k, lie, Ts = graph.dim, LIE[graph.group], graph.Ts_world_node
    row = np.full(graph.num_nodes, -1)
    row[nodes] = np.arange(len(nodes))
    used = row[graph.first] >= 0
    i, j, information = row[graph.first[used]], row[graph.second[used]], graph.information[used]
    between = lie.inverse(Ts[nodes[i]]) @ Ts[nodes[j]]
    J = lie.right_jacobian_inverse(lie.log(lie.inverse(graph.Ts_first_second[used]) @ between))
    information = np.swapaxes(J, 1, 2) @ information @ J
    M = lie.adjoint(lie.inverse(between))
    H = np.zeros((len(nodes), len(nodes), k, k))
    across = -np.swapaxes(M, 1, 2) @ information
    np.add.at(H, (i, i), -across @ M)
    np.add.at(H, (i, j), across)
    np.add.at(H, (j, i), np.swapaxes(across, 1, 2))
    np.add.at(H, (j, j), information)
    whole = H.transpose(0, 2, 1, 3).reshape(k * len(nodes), -1)
    P = np.zeros((count, k, count, k))
    free = slice(k, k * count)
    P.reshape(k * count, -1)[free, free] = np.linalg.inv(whole[k:, k:])[
        : free.stop - k, : free.stop - k
    ]
    P = P.transpose(0, 2, 1, 3)
    at = Ts[nodes[:count]]
    M = lie.adjoint(lie.inverse(at)[None] @ at[:, None])
    own = P[np.arange(count), np.arange(count)]
    cross = M @ P
    out = M @ own[:, None] @ np.swapaxes(M, 2, 3) + own[None] - cross - np.swapaxes(cross, 2, 3)
    out[np.arange(count), np.arange(count)] = np.eye(k)
    return np.asarray(out)


def _cheapest_tree(cost: Array) -> Index:
    """Return the pairs (n - 1, 2) of the tree of least cost over n nodes, costs (n, n)."""
    n = len(cost)
    nearest, least = np.zeros(n, np.int64), cost[0].copy()
    outside = np.ones(n, np.bool_)
    outside[0] = False
    pairs = np.zeros((n - 1, 2), np.int64)
    for row in range(n - 1):
        new = int(np.where(outside, least, np.inf).argmin())
        pairs[row] = nearest[new], new
        outside[new] = False
        nearer = outside & (cost[new] < least)
        least[nearer], nearest[nearer] = cost[new][nearer], new
    return pairs
