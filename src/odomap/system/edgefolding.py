"""Keyframes go from a map: what becomes of the edges to them.

Edges to keyframes that go, go as well. Only where nothing else ties what is left together, they are
folded into the surest edges that do (`backend/graphs/folding`): to keep all they said would make
the path surer than it is, and worse, since matches of many scans to the same walls are not
independent. Where submaps do not hold a place together, "nothing else" is to be taken with care: a
round is closed by the next one alone, and if that goes, its end is still tied to its beginning, all
the way round. So an edge is folded, too, where the way between its ends, through what is left, is
far. Loops that the path does not believe are not folded in.

Cost: that of the nodes around what goes, cubed; they are few. O(E log K) for the ways.

Reference: H. Kretzschmar, C. Stachniss, "Information-theoretic compression of pose graphs for
laser-based SLAM", International Journal of Robotics Research 31(11), 2012.
"""

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from odomap.backend.graphs.consensus import LIE
from odomap.backend.graphs.folding import fold
from odomap.backend.graphs.posegraph import PoseGraph
from odomap.geometry.lie import se3_inverse
from odomap.geometry.planar import (
    IN_PLANE,
    from_plane,
    lift_information,
    planar_matrix,
    to_plane,
)
from odomap.maps.edges import FOLDED, LOOP, EdgeTable

__all__ = ["folded_ties", "joined_edges", "with_kind"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bool = NDArray[np.bool_]

DOUBTED = 10.0
"""Standard deviations by which a loop contradicts the path that does not believe it."""
SHORTEST = 1e-3
"""Length of an edge at least, metres: what is 0 would be no edge."""


def folded_ties(
    edges: EdgeTable,
    ids: Index,
    Ts: Array,
    gone: Index,
    group: Literal["SE2", "SE3"],
    far: float = np.inf,
) -> EdgeTable:
    """Return what ties together what would fall apart without keyframes.

    Args:
        edges: all there are.
        ids: (K,) living keyframes, ascending.
        Ts: (K, 4, 4) where they are.
        gone: (n,) those that go.
        group: whether they move in the plane or in space.
        far: way through what is left beyond which it does not tie its ends, metres.
    """
    left = np.setdiff1d(ids, gone)
    alive = np.isin(edges.i, ids) & np.isin(edges.j, ids)
    is_gone = alive & (np.isin(edges.i, gone) | np.isin(edges.j, gone))
    believed = alive & _is_believed(edges, ids, Ts, alive, group)
    stay = believed & ~is_gone & (edges.information[:, 0, 0] > 0.0)
    ways = _Ways(len(left), far)
    ends = np.searchsorted(left, edges.i[stay]), np.searchsorted(left, edges.j[stay])
    ways.add(*ends, np.linalg.norm(edges.Ts_i_j[stay, :3, 3], axis=1))
    used = np.flatnonzero(is_gone & believed)
    nodes = np.union1d(edges.i[used], edges.j[used])
    around = np.searchsorted(left, np.setdiff1d(nodes, gone))
    # Where all hang together no matter how far, each is as near to the first as to any.
    if not ways.are_far(around[:1] if far == np.inf else around, around).any():
        return with_kind(edges, used[:0], FOLDED)
    graph = PoseGraph(
        group,
        _poses(Ts[np.searchsorted(ids, nodes)], group),
        np.searchsorted(nodes, edges.i[used]),
        np.searchsorted(nodes, edges.j[used]),
        _poses(edges.Ts_i_j[used], group),
        _information(edges.information[used], group),
    )
    tree = fold(graph, np.isin(nodes, gone))
    i, j = nodes[tree.first], nodes[tree.second]
    length = np.linalg.norm(tree.Ts_first_second[:, :-1, -1], axis=1)
    chosen = ways.joined(
        np.searchsorted(left, i),
        np.searchsorted(left, j),
        length,
        np.linalg.slogdet(tree.information)[1],
    )
    Ts_i_j, information = tree.Ts_first_second[chosen], tree.information[chosen]
    if group == "SE2":
        headings = np.arctan2(Ts_i_j[:, 1, 0], Ts_i_j[:, 0, 0])
        Ts_i_j = from_plane(np.column_stack([Ts_i_j[:, :2, 2], headings]))
        information = lift_information(information)
    ones = np.ones(len(chosen))
    return EdgeTable(i[chosen], j[chosen], Ts_i_j, ones, information, (FOLDED,) * len(chosen))


def with_kind(edges: EdgeTable, rows: Index, kind: str) -> EdgeTable:
    """Return some edges, as those of another kind."""
    return replace(
        edges,
        i=edges.i[rows],
        j=edges.j[rows],
        Ts_i_j=edges.Ts_i_j[rows],
        scales_i_j=edges.scales_i_j[rows],
        information=edges.information[rows],
        kind=(kind,) * len(rows),
    )


def joined_edges(a: EdgeTable, b: EdgeTable) -> EdgeTable:
    """Return the edges of both."""
    return EdgeTable(
        np.concatenate([a.i, b.i]),
        np.concatenate([a.j, b.j]),
        np.concatenate([a.Ts_i_j, b.Ts_i_j]),
        np.concatenate([a.scales_i_j, b.scales_i_j]),
        np.concatenate([a.information, b.information]),
        (*a.kind, *b.kind),
    )


def _is_believed(edges: EdgeTable, ids: Index, Ts: Array, chosen: Bool, group: str) -> Bool:
    """Say of each edge (E,) whether the path does not contradict it; only loops may be."""
    rows = np.flatnonzero(chosen & (np.array(edges.kind, str) == LOOP))
    i, j = (Ts[np.searchsorted(ids, end[rows])] for end in (edges.i, edges.j))
    off = se3_inverse(edges.Ts_i_j[rows]) @ se3_inverse(i) @ j
    errors = LIE["SE2" if group == "SE2" else "SE3"].log(_poses(off, group))
    information = _information(edges.information[rows], group)
    believed = np.ones(len(edges.kind), np.bool_)
    believed[rows] = np.einsum("ni,nij,nj->n", errors, information, errors) < DOUBTED**2
    return believed


def _poses(Ts: Array, group: str) -> Array:
    return planar_matrix(to_plane(Ts)) if group == "SE2" else Ts


def _information(information: Array, group: str) -> Array:
    return information[:, IN_PLANE[:, None], IN_PLANE] if group == "SE2" else information


class _Ways:
    """The ways between nodes of a graph, along its edges.

    Args:
        count: of the nodes.
        far: longest way that counts, metres.
    """

    def __init__(self, count: int, far: float) -> None:
        self._count, self._far = count, far
        self._i, self._j, self._lengths = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)

    def add(self, i: Index, j: Index, lengths: Array) -> None:
        """Add edges; of several between the same two nodes the shortest counts."""
        low = np.append(self._i, np.minimum(i, j))
        high = np.append(self._j, np.maximum(i, j))
        lengths = np.append(self._lengths, np.maximum(lengths, SHORTEST))
        order = np.lexsort((lengths, high, low))
        low, high, lengths = low[order], high[order], lengths[order]
        is_new = np.append(True, (np.diff(low) != 0) | (np.diff(high) != 0))[: len(low)]
        self._i, self._j, self._lengths = low[is_new], high[is_new], lengths[is_new]

    def are_far(self, some: Index, others: Index) -> Bool:
        """Say of each of some nodes (n,) whether the way to any of others (m,) is far."""
        shape = self._count, self._count
        graph = csr_array((self._lengths, (self._i, self._j)), shape=shape)
        ways = dijkstra(graph, directed=False, indices=some, limit=self._far)
        return np.asarray(np.isinf(ways[:, others]).any(axis=1))

    def joined(self, i: Index, j: Index, lengths: Array, sure: Array) -> Index:
        """Add the surest edges (n,) whose ends are far apart, and return which they are."""
        chosen = []
        for row in np.argsort(-sure, kind="stable").tolist():
            one = slice(row, row + 1)
            if self.are_far(i[one], j[one])[0]:
                self.add(i[one], j[one], lengths[one])
                chosen.append(row)
        return np.array(chosen, np.int64)
