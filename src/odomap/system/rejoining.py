"""Rejoining: what landmarks alone tie to an old part of the map is measured as a loop.

A camera that comes back with little drift is tracked against the old map at once. Nobody looks for
a place there, since landmarks tie it, and no loop would be measured: of the way round only the last
keyframes would be bent to fit, and all between stay as wrong as they were. So where a keyframe k
shares landmarks with a part of the map that is far from it along what was measured (`chains`), it
is a candidate like one that words point at, with the keyframe n it shares most with:

    landmarks of n's part, which keyframes there made        ─┐
    pixels of k, and landmarks of its own part                ├─▶ verified without knowing the tie
                                                              ─┘   → T_n_k, a loop edge

What both parts know is left out of k's, and found anew by how it looks. The steps before k are
those that were written down last when nothing tied them (`Unbent`): since then local mapping
has put all of the drift into them, which they would report as measured. Where k hangs from the
old part in the tree, the way round ends in the keyframe before it, and that one is k here.

Once it is a loop the two parts are near each other, and there is no tie until the next return.

Cost: O(recent keyframes), O(K) over an integer per keyframe; sides are read only where there is a
tie.

Reference: Strasdat, Davison, Montiel, Konolige, "Double window optimisation for constant time
visual SLAM", ICCV 2011 (what is far along the graph, though it is near).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odomap.maps.map import Map
from odomap.maps.states import compose, inverse
from odomap.system.chains import Chains, older_part
from odomap.system.covisibility import Covisibility
from odomap.system.essentialgraph import Essentials

__all__ = ["Rejoined", "Rejoining", "Unbent"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

BENT = 20
"""Newest keyframes that local mapping may move where it finds a tie."""


@dataclass(frozen=True, eq=False)
class Unbent:
    """Where the newest keyframes were to each other before local mapping knew of a tie.

    Attributes:
        first_id: the oldest of the keyframes that it may have moved since.
        keyframe_ids: (n,) those, as far as they were there, and what they hang from; ascending.
        Ts_world_body: (n, 4, 4).
        scales: (n,) world units per unit of the keyframe.
    """

    first_id: int
    keyframe_ids: Index
    Ts_world_body: Array
    scales: Array

    def of(self, parts: Essentials) -> Essentials:
        """Return a path with these steps of the tree; what is newer hangs as it does now."""
        Ts, scales, ids = parts.Ts_world_body.copy(), parts.scales.copy(), parts.keyframe_ids
        first = int(np.searchsorted(ids, self.first_id))
        kept = {k: n for n, k in enumerate(self.keyframe_ids.tolist())}
        for row in range(first, len(ids)):
            if (parent := int(parts.parent[row])) < 0:
                continue
            before = [kept.get(int(ids[end]), -1) for end in (parent, row)]
            if min(before) >= 0:
                S = (self.Ts_world_body[before], self.scales[before])
            else:
                S = (parts.Ts_world_body[[parent, row]], parts.scales[[parent, row]])
            holder, own = ((S[0][n], S[1][n]) for n in (0, 1))
            step = compose(inverse(holder), own)
            Ts[row], scales[row] = compose((Ts[parent], scales[parent]), step)
        is_older = (parts.pairs < first).all(axis=1)
        return replace(parts, Ts_world_body=Ts, scales=scales, pairs=parts.pairs[is_older])


@dataclass(frozen=True, eq=False)
class Rejoined:
    """A keyframe that landmarks tie to a part of the map far from it.

    Attributes:
        keyframe_id: the keyframe; the one before it where it hangs from the other part.
        matched_id: the keyframe of the other part, the older one, that shares most landmarks.
        here: keyframes of its own part.
        there: keyframes of the other part.
        unbent: what odometry said before the tie.
    """

    keyframe_id: int
    matched_id: int
    here: set[int]
    there: set[int]
    unbent: Unbent


class Rejoining:
    """Notices ties, and keeps what odometry said before them.

    Args:
        known: what was written down of the map's keyframes.
    """

    def __init__(self, known: Covisibility) -> None:
        self._known = known
        self._unbent: Unbent | None = None

    def follow(self, map: Map, keyframe_id: int) -> Rejoined | None:
        """Take in the newest keyframe that was written down; return the tie that it has, if any."""
        known, chains = self._known, Chains(map)
        neighbours = known.neighbours(keyframe_id).tolist()
        here = chains.near(keyframe_id, neighbours)
        far = [k for k in neighbours if k not in here]
        if not far or self._unbent is None:
            self._unbent = _read_unbent(map, np.sort(known.keyframe_ids)[-BENT:])
            return None
        there = chains.near(far[0], far) - here
        older = older_part(here, neighbours)
        matched = next(k for k in neighbours if k in older)
        if older <= there:
            return Rejoined(keyframe_id, matched, here, there, self._unbent)
        return Rejoined(far[0], matched, there, here, self._unbent)


def _read_unbent(map: Map, newest: Index) -> Unbent:
    """Read where the newest keyframes (n,) are, and what they hang from."""
    with map.lock:
        parents = map.tree().parent[newest]
        ids = np.union1d(newest, parents[parents >= 0])
        Ts, scales = map.states.placements(ids)
    return Unbent(int(newest[0]), ids, Ts, scales)
