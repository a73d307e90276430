"""The atlas: a map as its pieces, parts whose place to each other is not known.

Where tracking starts anew after a long loss, or another map is taken in, keyframes follow whose
place relative to all before was never measured. They hang from the spanning tree like others, so
that nothing else need know, but an edge of kind "gap" says that this step of the tree measured
nothing. Cut at its gaps, the tree falls into pieces; loops tie some of them again:

    pieces = components of (tree \\ gaps) ∪ loops.

A piece is named by its first keyframe. The oldest stays where it is when two become one. Neither
end of a gap is ever culled (`Map.cull_keyframes`), so that no child comes to hang from across one.

Cost: O(K log K) over a few numbers per keyframe.

Reference: Elvira, Tardós, Montiel, "ORBSLAM-Atlas: a robust and accurate multi-map system", IROS
2019; Campos et al., "ORB-SLAM3", T-RO 2021, section VI.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.maps.edges import GAP, LOOP
from odomap.maps.map import Map
from odomap.maps.tree import ABSENT, ALIVE, STUB

__all__ = ["Atlas", "Piece", "beginnings"]

Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of a map whose keyframes are placed relative to each other.

    Attributes:
        first_id: its oldest keyframe, which stays where it is when the piece is merged with others
            that are newer.
        keyframe_ids: (K,) its living keyframes, ascending.
        after_id: the keyframe before the gap that it began with; −1 where the map began.
        merged: first keyframes of newer pieces that loops have made part of it.
    """

    first_id: int
    keyframe_ids: Index
    after_id: int
    merged: tuple[int, ...] = ()


class Atlas:
    """The pieces of a map as it is now; a copy.

    Attributes:
        pieces: the oldest first.
    """

    def __init__(self, map: Map) -> None:
        with map.lock:
            tree, edges = map.tree(), map.edges()
        self._alive, stub = tree.status == ALIVE, tree.status == STUB
        kinds = np.array(edges.kind, str)
        gaps = {int(edges.j[n]): int(edges.i[n]) for n in np.flatnonzero(kinds == GAP)}
        first = _first_of(tree.parent, self._alive, np.array(sorted(gaps), np.int64))
        first[stub] = first[tree.parent[stub]]
        named = _joined(first, edges.i[kinds == LOOP], edges.j[kinds == LOOP])
        self._piece = np.where(tree.status == ABSENT, -1, named)
        self.pieces = tuple(
            self._described(k, np.unique(first[self._piece == k]), gaps)
            for k in np.unique(self._piece[self._alive]).tolist()
        )

    def _described(self, name: int, first: Index, gaps: dict[int, int]) -> Piece:
        ids = np.flatnonzero(self._alive & (self._piece == name))
        merged = tuple(k for k in first.tolist() if k != name)
        return Piece(name, ids, gaps.get(name, -1), merged)

    def piece_of(self, keyframe_id: int) -> Piece:
        """Return the piece that a keyframe is in, or was before it was culled.

        Raises:
            KeyError: it was never in the map.
        """
        known = 0 <= keyframe_id < len(self._piece) and self._piece[keyframe_id] >= 0
        if not known:
            raise KeyError(f"keyframe {keyframe_id} was never in the map")
        return next(p for p in self.pieces if p.first_id == self._piece[keyframe_id])


def beginnings(map: Map) -> Index:
    """Return the (n,) keyframes that pieces begin with after a gap, ascending."""
    edges = map.edges()
    return np.unique(edges.j[np.array(edges.kind, str) == GAP])


def _first_of(parent: Index, alive: NDArray[np.bool_], begins: Index) -> Index:
    """Return of every living keyframe (R,) the root of the tree, cut where pieces begin."""
    up = np.where(alive & (parent >= 0), parent, np.arange(len(parent)))
    up[begins] = begins
    while not np.array_equal(further := up[up], up):
        up = further
    return up


def _joined(first: Index, i: Index, j: Index) -> Index:
    """Return the names (R,) of pieces when loops between keyframes i and j (L,) have tied them."""
    named = first.copy()
    for a, b in zip(first[i].tolist(), first[j].tolist()):
        low, high = sorted((int(named[a]), int(named[b])))
        named[named == high] = low
    return named
