"""Covisibility kept beside the map: who shared how many landmarks with whom, and who came of whom.

Loops are looked for in a thread that must not touch the map, and when one is closed thousands of
keyframes have to be tied together at once. Neither can ask the map keyframe by keyframe, so that
what is needed is written down when a keyframe comes, which costs O(keyframes it shares with):

    shared     landmarks of the new keyframe that each older one sees, too
    parent     the keyframe it was placed against, and S_p_k = S_p⁻¹ S_k, the motion between the two
    growth     Q = Σ_k − Ad(T_k_p) Σ_p Ad(T_k_p)ᵀ, by what it is less sure than that

The sum of all Q on the way from the root, each carried along, is the covariance of odometry. It is
kept apart from that of the map, in which closed loops have a part, and in the units of each, since
these loops change what a unit is in the world. Where a keyframe is culled, its
children go to its parent, and their motions and growths add up.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section III-D (covisibility graph and essential graph).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_adjoint
from odomap.maps.columns import grown
from odomap.maps.map import Map
from odomap.maps.states import Placement, compose, inverse, stretched

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
        growth: (6, 6) Q, in its own units; NaN where unknown.
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

    Attributes:
        parent: (R,) by keyframe id, −1 for the root.
        motion: (R, 4, 4) T_parent_keyframe by keyframe id, as it was.
        scale: (R,) scale_parent_keyframe by keyframe id, as it was.
        growth: (R, 6, 6) by keyframe id, NaN where unknown.
    """

    def __init__(self, least: int, strong: int) -> None:
        self._least, self._strong = least, strong
        self._shared: dict[int, dict[int, int]] = {}
        self._pairs = np.zeros((0, 2), np.int64)
        self._num_pairs = 0
        self.parent = np.zeros(0, np.int64)
        self.motion, self.scale = np.zeros((0, 4, 4)), np.zeros(0)
        self.growth = np.zeros((0, 6, 6))

    def __contains__(self, keyframe_id: int) -> bool:
        return keyframe_id in self._shared

    @property
    def keyframe_ids(self) -> Index:
        """(n,) the keyframes that are known, in the order they came."""
        return np.fromiter(self._shared, np.int64, len(self._shared))

    def add(self, known: Acquaintance) -> None:
        """Write down a keyframe; it and those it shares landmarks with become neighbours."""
        k = known.keyframe_id
        self.parent = grown(self.parent, k + 1, fill=-1)
        self.motion, self.scale = grown(self.motion, k + 1), grown(self.scale, k + 1)
        self.growth = grown(self.growth, k + 1)
        self.parent[k], self.growth[k] = known.parent, known.growth
        self.motion[k], self.scale[k] = known.T_parent_keyframe, known.scale_parent_keyframe
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
        """Forget a keyframe; its children go to its parent."""
        for other in self._shared.pop(keyframe_id):
            self._shared[other].pop(keyframe_id, None)
        children = np.flatnonzero(self.parent == keyframe_id).tolist()
        holder = int(self.parent[keyframe_id])
        in_holder, added = self._motion(keyframe_id), self.growth[keyframe_id]
        if holder < 0 and children:  # the eldest child is the root from now on
            holder, *children = children
            in_holder = inverse(self._motion(holder))
            added = _carried(self.growth[holder], inverse(in_holder))
            self.parent[holder], self.growth[holder] = -1, np.nan
        for child in children:
            own = self._motion(child)
            self.growth[child] += _carried(added, inverse(own))
            self.motion[child], self.scale[child] = compose(in_holder, own)
            self.parent[child] = holder

    def _motion(self, keyframe_id: int) -> Placement:
        """Return how a keyframe lies in its parent, as a similarity."""
        return self.motion[keyframe_id].copy(), np.asarray(self.scale[keyframe_id])

    def untell_shrunk(self) -> None:
        """Forget growths of what became surer than its parent: closed loops made it so.

        In a map that is opened again covariances hold what loops told; that odometry grew no less
        sure on a step is not one of the things that they tell.
        """
        blocks = np.trace(self.growth.reshape(-1, 2, 3, 2, 3), axis1=2, axis2=4)
        self.growth[(blocks[:, [0, 1], [0, 1]] <= 0.0).any(axis=1)] = np.nan

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


def acquaint(map: Map, keyframe_id: int, of_parent: Array | None = None) -> Acquaintance:
    """Read what is to be written down of a living keyframe.

    Its growth may be indefinite: covariances that were found one by one need not fit together.

    Args:
        map: the map.
        keyframe_id: the keyframe.
        of_parent: (6, 6) covariance of its parent when its own was found; default the present one.
    """
    with map.lock:
        shared, counts = map.covisible(keyframe_id)
        parent = map.parent(keyframe_id)
        ends = [keyframe_id if parent < 0 else parent, keyframe_id]
        Ts, (of, own) = map.Ts_world_body(ends), (map.scale(k) for k in ends)
        now, sure = (map.covariance(k) for k in ends)
        of_parent = now if of_parent is None else of_parent
    S = compose(inverse((Ts[0], np.asarray(of))), (Ts[1], np.asarray(own)))
    growth = np.full((6, 6), np.nan)
    if parent >= 0:
        growth = stretched(sure, 1.0 / own) - _carried(stretched(of_parent, 1.0 / of), inverse(S))
    return Acquaintance(keyframe_id, shared, counts, parent, S[0], float(S[1]), growth)


def _carried(covariance: Array, S_to_from: Placement) -> Array:
    """Return a covariance (6, 6) of a tangent at one pose, of the tangent at another, each in the
    units there.
    """
    T, scale = S_to_from
    Ad = se3_adjoint(T)
    return np.asarray(Ad @ stretched(covariance, scale) @ Ad.T)
