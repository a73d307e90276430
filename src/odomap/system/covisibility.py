"""Covisibility kept beside the map: who shared how many landmarks with whom when the later came.

Loops are looked for in a thread that must not touch the map, and when one is closed thousands of
keyframes have to be tied together at once. Neither can ask the map keyframe by keyframe, so that
landmarks of a new keyframe that each older one sees, too, are counted when it comes, which costs
O(keyframes it shares with). What else is to be known of it then is the motion between it and its
parent, S_p_k = S_p⁻¹ S_k, and by what it is less sure than that (`maps/growth`).

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section III-D (covisibility graph and essential graph).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.maps.columns import grown
from odomap.maps.growth import growth_of
from odomap.maps.map import Map
from odomap.maps.states import compose, inverse

__all__ = ["Acquaintance", "Carried", "Covisibility", "acquaint"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Acquaintance(NamedTuple):
    """What is written down of a keyframe when it comes.

    Attributes:
        keyframe_id: of it.
        shared_ids: (n,) keyframes that share landmarks with it.
        num_shared: (n,) how many.
        parent: the keyframe it was placed against, −1 for the first.
        T_parent_keyframe: (4, 4) in the units of the parent.
        scale_parent_keyframe: units of the parent per unit of its own.
        growth: (6, 6) by what it is less sure than its parent, in its own units; NaN where unknown.
    """

    keyframe_id: int
    shared_ids: Index
    num_shared: Index
    parent: int
    T_parent_keyframe: Array
    scale_parent_keyframe: float
    growth: Array


class Carried(NamedTuple):
    """How sure a loop made a keyframe that came while it was solved.

    Attributes:
        parent_before: (6, 6) covariance of its parent before the loop, in units as of after it.
        parent: (6, 6) the same after it.
        own: (6, 6) of the keyframe, which follows from that.
    """

    parent_before: Array
    parent: Array
    own: Array


class Covisibility:
    """Who shares landmarks with whom, as it was when the later one came.

    Args:
        least: landmarks that two keyframes must share to be neighbours.
        strong: landmarks that they must share to hold each other in place.
    """

    def __init__(self, least: int, strong: int) -> None:
        self._least, self._strong = least, strong
        self._shared: dict[int, dict[int, int]] = {}
        self._pairs = np.zeros((0, 2), np.int64)
        self._num_pairs = 0

    def __contains__(self, keyframe_id: int) -> bool:
        return keyframe_id in self._shared

    @property
    def keyframe_ids(self) -> Index:
        """(n,) the keyframes that are known, in the order they came."""
        return np.fromiter(self._shared, np.int64, len(self._shared))

    def add(self, known: Acquaintance) -> None:
        """Write down a keyframe; it and those it shares landmarks with become neighbours."""
        k = known.keyframe_id
        mine = self._shared.setdefault(k, {})
        for other, count in zip(known.shared_ids.tolist(), known.num_shared.tolist()):
            if count < self._least or other not in self._shared:
                continue
            mine[other] = self._shared[other][k] = count
            if count >= self._strong:
                self._pairs = grown(self._pairs, self._num_pairs + 1)
                self._pairs[self._num_pairs] = other, k
                self._num_pairs += 1

    def cull(self, keyframe_id: int) -> None:
        """Forget a keyframe."""
        for other in self._shared.pop(keyframe_id):
            self._shared[other].pop(keyframe_id, None)

    def neighbours(self, keyframe_id: int) -> Index:
        """Return the (n,) keyframes that share landmarks with one, most first, then oldest."""
        shared = self._shared.get(keyframe_id, {})
        return np.array(sorted(shared, key=lambda k: (-shared[k], k)), np.int64)

    def around(self, keyframe_id: int) -> set[int]:
        """Return a keyframe, its neighbours and theirs: what is tied to it already."""
        near = {keyframe_id, *self._shared.get(keyframe_id, ())}
        return near.union(*(self._shared[k] for k in near if k in self._shared))

    def pairs(self) -> Index:
        """Return the (n, 2) pairs of keyframes that hold each other in place, the older first."""
        return self._pairs[: self._num_pairs].copy()


def acquaint(
    map: Map, keyframe_id: int, of_parent: Array | None = None, told: bool = True
) -> Acquaintance:
    """Read what is to be written down of a living keyframe.

    Args:
        map: the map; a growth that it knows is taken.
        keyframe_id: the keyframe.
        of_parent: (6, 6) covariance of its parent when its own was found; default the present one.
        told: whether covariances are those of odometry; what loops say tells nothing of a step.
    """
    with map.lock:
        shared, counts = map.covisible(keyframe_id)
        parent = map.parent(keyframe_id)
        ends = [keyframe_id if parent < 0 else parent, keyframe_id]
        Ts, scales = map.Ts_world_body(ends), [np.asarray(map.scale(k)) for k in ends]
        now, sure = (map.covariance(k) for k in ends)
        growth = map.growth(keyframe_id)
    S_parent, S_own = zip(Ts, scales)
    T, scale = compose(inverse(S_parent), S_own)
    if told and parent >= 0 and not np.isfinite(growth).all():
        growth = growth_of(sure, now if of_parent is None else of_parent, S_own, S_parent)
    return Acquaintance(keyframe_id, shared, counts, parent, T, float(scale), growth)
