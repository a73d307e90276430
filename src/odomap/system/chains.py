"""Chains: how many measured steps lie between two keyframes, and which parts landmarks alone tie.

What was measured between keyframes are the steps of the spanning tree and the loops closed. A
camera that comes back may be tracked against what was mapped there at once, without a loop: then
its keyframes share landmarks with ones that are far from it along all that was measured. Such a tie
joins two parts of the map,

    near  = keyframes that are reached in STEPS steps, from the new one or a neighbour reached,
    other = neighbours that share landmarks with it all the same,

between which lies the drift of the way round. Where the same things have been seen all along each
neighbour leads on to the next, and there is one part only. Across a gap nothing was measured.

Cost: O(K) over an integer per keyframe, and O(keyframes reached).

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section III-D (spanning tree).
"""

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from odomap.maps.edges import GAP, LOOP
from odomap.maps.map import Map

__all__ = ["STEPS", "Chains", "older_part"]

Index = NDArray[np.int64]

STEPS = 30
"""Measured steps within which keyframes are near: the span of a few windows of local mapping."""


class Chains:
    """The measured steps between the keyframes of a map, a copy.

    Args:
        map: the map.
    """

    def __init__(self, map: Map) -> None:
        with map.lock:
            tree, edges = map.tree(), map.edges()
        kind, parent = np.array(edges.kind, str), tree.parent
        begins, is_loop = edges.j[kind == GAP], kind == LOOP
        child = np.flatnonzero(parent >= 0)
        child = child[~np.isin(child, begins)]
        i = np.concatenate([parent[child], edges.i[is_loop]])
        j = np.concatenate([child, edges.j[is_loop]])
        ends = np.concatenate([i, j])
        order = np.argsort(ends, kind="stable")
        self._first = np.searchsorted(ends[order], np.arange(len(parent) + 1))
        self._to = np.concatenate([j, i])[order]

    def near(self, keyframe_id: int, neighbours: Collection[int] = ()) -> set[int]:
        """Return keyframes, and stubs, that are near one along what was measured; with itself.

        Args:
            keyframe_id: the keyframe.
            neighbours: what is near to one of these that is near, is near too.
        """
        wanted, left = set(neighbours), {keyframe_id: STEPS}
        front = [keyframe_id]
        while front:
            reached: list[int] = []
            for k in front:
                steps = left[k] - 1
                for other in self._to[self._first[k] : self._first[k + 1]].tolist():
                    more = STEPS if other in wanted else steps
                    if more > left.get(other, -1):
                        left[other] = more
                        reached.append(other)
            front = [k for k in dict.fromkeys(reached) if left[k] > 0]
        return set(left)


def older_part(near: set[int], neighbours: Collection[int]) -> set[int]:
    """Return the neighbours of the older of two parts that landmarks alone tie; none if it is one.

    Args:
        near: of the new keyframe.
        neighbours: those that share landmarks with it.
    """
    here = {k for k in neighbours if k in near}
    there = {k for k in neighbours if k not in near}
    if not there:
        return set()
    return there if not here or min(there) < min(here) else here
