"""Connected components of a pose graph, and what holds each of them.

Edges measure how poses lie to each other, never where they lie: every connected component of the
graph may move as a whole at no cost. One node of each must be held still, or the normal equations
have no unique solution; which one does not matter to the cost. The anchor of a component is

    a fixed node, if it has one; else a node with a prior; else its node of lowest index.

Components are found by union-find: each node points to another of its set, an edge joins two sets
by pointing the higher root to the lower, and paths are halved while they are walked.

Cost: O((N + E) α(N)), which is as good as linear.

Reference: R. E. Tarjan, J. van Leeuwen, "Worst-case analysis of set union algorithms", Journal of
the ACM 31(2), 1984.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.posegraph import PoseGraph
from odomap.kernels import kernel

__all__ = ["Components", "connected_components", "find_components", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class Components:
    """The connected components of a pose graph.

    Attributes:
        label: (N,) which component each node is in; numbered by their lowest nodes.
        anchor: (C,) the node that holds each component.
        has_fixed: (C,) whether a node of it is fixed.
        has_prior: (C,) whether a node of it has a prior.
    """

    label: Index
    anchor: Index
    has_fixed: Bool
    has_prior: Bool

    @property
    def count(self) -> int:
        """How many components there are."""
        return len(self.anchor)

    @property
    def is_free(self) -> Bool:
        """(C,) whether a component may move as a whole: nothing in it is fixed or has a prior."""
        return np.asarray(~(self.has_fixed | self.has_prior))


def find_components(
    graph: PoseGraph, weights: Array | None = None, through_landmarks: bool = False
) -> Components:
    """Find the connected components of a pose graph and the anchor of each.

    Args:
        graph: of poses.
        weights: (E,) of its edges; edges of weight 0 do not connect.
        through_landmarks: whether nodes that see the same landmark are connected, too.

    Returns:
        Components of the nodes.

    Example:
        >>> T, unknown = np.eye(3), np.full((4, 3, 3), np.nan)
        >>> graph = PoseGraph("SE2", unknown, [0, 3], [1, 2], [T, T], np.eye(3)[None].repeat(2, 0))
        >>> found = find_components(graph)
        >>> found.label.tolist(), found.anchor.tolist()
        ([0, 0, 1, 1], [0, 2])
    """
    n, first, second = graph.num_nodes, graph.first, graph.second
    if weights is not None:
        first, second = first[weights > 0.0], second[weights > 0.0]
    if through_landmarks:
        sights = graph.points
        first = np.concatenate([first, sights.node])
        second = np.concatenate([second, n + sights.point])
    label = connected_components(n + len(graph.points.points_world), first, second)[:n]
    count = int(label.max()) + 1 if n else 0
    has_fixed, has_prior = np.zeros(count, bool), np.zeros(count, bool)
    anchor = np.full(count, n, np.int64)
    np.minimum.at(anchor, label, np.arange(n))
    # From the weakest claim to the strongest, each from the last node to the first: the last wins.
    claims = (np.unique(graph.priors.node), has_prior), (np.flatnonzero(graph.is_fixed), has_fixed)
    for nodes, has in claims:
        anchor[label[nodes[::-1]]] = nodes[::-1]
        has[label[nodes]] = True
    return Components(label, anchor, has_fixed, has_prior)


def connected_components(num_nodes: int, first: Index, second: Index) -> Index:
    """Number the connected components of a graph by their lowest nodes.

    Args:
        num_nodes: how many nodes there are.
        first, second: (E,) the nodes each edge connects.

    Returns:
        (num_nodes,) the component of each node, 0 being that of node 0.
    """
    label = np.arange(num_nodes, dtype=np.int64)
    _unite(np.ascontiguousarray(first), np.ascontiguousarray(second), label)
    return label


@kernel
def _root(parent: Index, node: int) -> int:
    """Follow parents to the root, pointing every other node on the way to its grandparent."""
    while parent[node] != node:
        parent[node] = parent[parent[node]]
        node = parent[node]
    return node


@kernel
def _unite(first: Index, second: Index, parent: Index) -> None:
    """Join the sets of both ends of each edge; then parent becomes the number of the set."""
    for e in range(len(first)):
        a, b = _root(parent, first[e]), _root(parent, second[e])
        if a < b:
            parent[b] = a
        else:
            parent[a] = b
    for node in range(len(parent)):  # all parents are lower: one pass leaves roots only
        parent[node] = parent[parent[node]]
    count = 0
    for node in range(len(parent)):
        if parent[node] == node:
            parent[node] = count
            count += 1
        else:
            parent[node] = parent[parent[node]]


def warm_up() -> None:
    """Compile the kernels of this module."""
    connected_components(2, np.zeros(1, np.int64), np.ones(1, np.int64))
