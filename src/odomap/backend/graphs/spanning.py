"""Spanning trees: poses of a graph by following as few edges as possible.

From what holds each connected component (its fixed nodes, else its anchor) the graph is searched
breadth first. A node found at depth k + 1 hangs from a node of depth k by one edge, and its pose is

    T_child = T_parent Z,   or   T_parent Z⁻¹   against the direction of the edge.

Errors add up along the way, so the shallowest tree keeps them smallest; among the edges that reach
a node at the same depth odometry goes before loops, and higher information before lower. One
measurement per node is used and the rest is ignored, loops included: `initialization` does better
at the cost of two linear systems.

Cost: O(N + E).

Reference: L. Carlone, R. Tron, K. Daniilidis, F. Dellaert, "Initialization techniques for 3D SLAM:
a survey on rotation estimation and its use in pose graph optimization", ICRA 2015.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.chordal import isotropic_weights
from odomap.backend.graphs.components import Components
from odomap.backend.graphs.posegraph import PoseGraph
from odomap.backend.graphs.projection import nearest_rotations
from odomap.kernels import kernel

__all__ = ["follow_tree", "held_nodes", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bool = NDArray[np.bool_]


def held_nodes(graph: PoseGraph, components: Components) -> tuple[Bool, Array]:
    """Return which nodes (N,) hold the components, and poses (N, m, m) of which theirs count.

    These are the fixed nodes, and the anchors of components without one. An anchor whose pose is
    not known is put at the identity.
    """
    held = graph.is_fixed.copy()
    held[components.anchor[~components.has_fixed]] = True
    Ts = graph.Ts_world_node.copy()
    unknown = held & ~np.isfinite(Ts).all(axis=(1, 2))
    Ts[unknown] = np.eye(graph.space + 1)
    return held, Ts


def follow_tree(graph: PoseGraph, components: Components, weights: Array | None) -> Array:
    """Return poses (N, m, m) by the shallowest spanning trees.

    Args:
        graph: of poses.
        components: of it with the same weights, which say where the trees begin.
        weights: (E,) of its edges; edges of weight 0 are left out.
    """
    held, Ts = held_nodes(graph, components)
    kappa, _ = isotropic_weights(graph.information, graph.space)
    weight = np.ones(graph.num_edges) if weights is None else weights
    # At most 1 for loops and more for odometry, so that odometry goes first.
    rank = kappa * weight
    rank = np.where(weight > 0.0, rank / max(rank.max(initial=0.0), 1e-300) + ~graph.is_loop, -1.0)
    through = np.full(graph.num_nodes, -1, np.int64)
    order = _grow(graph.first, graph.second, rank, held, through)
    _follow(order, through, graph.first, graph.second, graph.Ts_first_second, Ts)
    moved = ~held
    d = graph.space
    A = Ts[moved, :d, :d]
    scale = np.cbrt(np.linalg.det(A)) if graph.group == "Sim3" else np.ones(len(A))
    Ts[moved, :d, :d] = scale[:, None, None] * nearest_rotations(A)
    return Ts


@kernel
def _grow(first: Index, second: Index, rank: Array, is_root: Bool, through: Index) -> Index:
    """Breadth-first search: through[v] = the edge of highest rank that reaches v at least depth.

    Returns the nodes in the order of their depth. Edges of negative rank are left out.
    """
    n = len(is_root)
    start = np.zeros(n + 2, np.int64)  # edges of node v end up in start[v] .. start[v + 1]
    for e in range(len(first)):
        start[first[e] + 2] += 1
        start[second[e] + 2] += 1
    for v in range(n + 1):
        start[v + 1] += start[v]
    edges = np.empty(2 * len(first), np.int64)
    for e in range(len(first)):
        for v in (first[e], second[e]):
            edges[start[v + 1]] = e
            start[v + 1] += 1
    order, depth = np.empty(n, np.int64), np.full(n, -1, np.int64)
    count = 0
    for v in range(n):
        if is_root[v]:
            order[count], depth[v] = v, 0
            count += 1
    done = 0
    while done < count:
        u = order[done]
        done += 1
        for k in range(start[u], start[u + 1]):
            e = edges[k]
            if rank[e] < 0.0:
                continue
            v = first[e] + second[e] - u
            if depth[v] < 0:
                order[count], depth[v], through[v] = v, depth[u] + 1, e
                count += 1
            elif depth[v] == depth[u] + 1 and rank[e] > rank[through[v]]:
                through[v] = e
    return order[:count]


@kernel
def _follow(
    order: Index, through: Index, first: Index, second: Index, Zs: Array, Ts: Array
) -> None:
    """T_child = T_parent Z or T_parent Z⁻¹, (sR)⁻¹ = (sR)ᵀ / s²."""
    m = Ts.shape[1]
    d = m - 1
    step = np.zeros((m, m))
    for child in order:
        e = through[child]
        if e < 0:
            continue
        if second[e] == child:
            parent = first[e]
            for a in range(d):
                for b in range(m):
                    step[a, b] = Zs[e, a, b]
        else:
            parent = second[e]
            square = 0.0
            for a in range(d):
                square += Zs[e, a, 0] * Zs[e, a, 0]
            for a in range(d):
                step[a, d] = 0.0
                for b in range(d):
                    step[a, b] = Zs[e, b, a] / square
                    step[a, d] -= step[a, b] * Zs[e, b, d]
        for a in range(d):
            for b in range(m):
                value = Ts[parent, a, d] if b == d else 0.0
                for c in range(d):
                    value += Ts[parent, a, c] * step[c, b]
                Ts[child, a, b] = value
        for b in range(m):
            Ts[child, d, b] = 1.0 if b == d else 0.0


def warm_up() -> None:
    """Compile the kernels of this module."""
    one = np.zeros(1, np.int64)
    through = np.full(2, -1, np.int64)
    Ts = np.stack([np.eye(3)] * 2)
    order = _grow(one, one + 1, np.ones(1), np.array([True, False]), through)
    _follow(order, through, one, one + 1, Ts[:1], Ts)
