"""The neighbourhood of some nodes in a graph that grows: found without looking at the rest.

Every edge e hangs twice in lists: as half 2e in the list of its first node, as half 2e + 1 in that
of its second. The head of a node's list and the next of each half are all that is kept, so that an
edge is added by writing four numbers:

    next[h] = head[node],   head[node] = h;     the node across is second[h / 2] or first[h / 2].

The ball of n nodes around some seeds is found breadth first; the nodes across its edges which are
not in it are its border. Held nodes never belong to the ball.

Cost: O(edges of the ball and of its border), whatever the size of the graph.

Reference: E. F. Moore, "The shortest path through a maze", Proc. International Symposium on the
Theory of Switching, 1959.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.growing import GrowingArray
from odomap.kernels import kernel

__all__ = ["EdgeLists", "Neighbourhood", "warm_up"]

Index = NDArray[np.int64]
Bool = NDArray[np.bool_]


class Neighbourhood(NamedTuple):
    """Part of a graph: nodes, those of the ball first, and the edges that touch the ball.

    Attributes:
        nodes: (n,) of the graph; the ball, then its border.
        num_inner: how many are of the ball.
        edges: (e,) of the graph.
        first, second: (e,) places in `nodes`.
    """

    nodes: Index
    num_inner: int
    edges: Index
    first: Index
    second: Index


class EdgeLists:
    """Which edges touch each node of a graph that grows."""

    def __init__(self) -> None:
        self._head = GrowingArray((), np.int64)
        self._next = GrowingArray((), np.int64)
        self._place = GrowingArray((), np.int64)
        self._across = GrowingArray((), np.int64)

    def add_node(self) -> None:
        """Add a node without edges."""
        self._head.append(-1)
        self._place.append(-1)

    def add_edge(self, first: int, second: int) -> None:
        """Add an edge between two nodes."""
        for node, other in ((first, second), (second, first)):
            self._next.append(self._head.rows[node])
            self._across.append(other)
            self._head.rows[node] = len(self._next) - 1

    def around(self, seeds: Index, size: int, is_held: Bool) -> Neighbourhood:
        """Return the ball of at most `size` nodes around some, and its edges.

        Args:
            seeds: (s,) nodes to begin at; if more than `size`, only the first are in the ball.
            size: most nodes in the ball.
            is_held: (N,) nodes that stay out of it.
        """
        head, after, across = self._head.rows, self._next.rows, self._across.rows
        nodes, inner = _ball(seeds, size, is_held, head, after, across, self._place.rows)
        return Neighbourhood(
            nodes, int(inner), *_edges(nodes, inner, head, after, across, self._place.rows)
        )


@kernel
def _ball(
    seeds: Index,
    size: int,
    is_held: Bool,
    head: Index,
    after: Index,
    across: Index,
    place: Index,
) -> tuple[Index, int]:
    """List the ball breadth first, then its border; place[node] is left at each one's place.

    The queue holds the ball so far and what is seen of its border; a held node is seen only.
    """
    nodes, count, inner = np.empty(2 * size + 8, np.int64), 0, 0
    for node in seeds:
        if place[node] < 0:
            if count == len(nodes):
                nodes = np.append(nodes, nodes)
            nodes[count], place[node] = node, count
            count += 1
    at = 0
    while at < count and inner < size:
        node = nodes[at]
        if not is_held[node]:
            # To the end of the ball, which pushes the held nodes before it back.
            other = nodes[inner]
            nodes[inner], nodes[at] = node, other
            place[node], place[other] = inner, at
            inner += 1
            half = head[node]
            while half >= 0:
                other = across[half]
                if place[other] < 0:
                    if count == len(nodes):
                        nodes = np.append(nodes, nodes)
                    nodes[count], place[other] = other, count
                    count += 1
                half = after[half]
        at += 1
    return nodes[:count].copy(), inner


@kernel
def _edges(
    nodes: Index, inner: int, head: Index, after: Index, across: Index, place: Index
) -> tuple[Index, Index, Index]:
    """List each edge of the ball once, by its first and second places; clear `place`."""
    count = 0
    for at in range(inner):
        half = head[nodes[at]]
        while half >= 0:
            # Between two nodes of the ball an edge is listed at the half that is its first.
            count += 1 if half % 2 == 0 or place[across[half]] >= inner else 0
            half = after[half]
    edges, first, second = (
        np.empty(count, np.int64),
        np.empty(count, np.int64),
        np.empty(count, np.int64),
    )
    count = 0
    for at in range(inner):
        half = head[nodes[at]]
        while half >= 0:
            other = place[across[half]]
            if half % 2 == 0 or other >= inner:
                edges[count] = half // 2
                first[count] = at if half % 2 == 0 else other
                second[count] = other if half % 2 == 0 else at
                count += 1
            half = after[half]
    for node in nodes:
        place[node] = -1
    return edges, first, second


def warm_up() -> None:
    """Compile the kernels of this module."""
    lists = EdgeLists()
    lists.add_node()
    lists.add_node()
    lists.add_edge(0, 1)
    lists.around(np.zeros(1, np.int64), 1, np.zeros(2, np.bool_))
