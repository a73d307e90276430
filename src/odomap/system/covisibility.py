"""Covisibility kept beside the map: who shared how many landmarks with whom, and who came of whom.

Loops are looked for in a thread that must not touch the map, and when one is closed thousands of
keyframes have to be tied together at once. Neither can ask the map keyframe by keyframe, so that
what is needed is written down when a keyframe comes, which costs O(keyframes it shares with):

    shared     landmarks of the new keyframe that each older one sees, too
    parent     the keyframe it was placed against, and the motion between the two
    growth     Q = Σ_k − Ad(T_k_p) Σ_p Ad(T_k_p)ᵀ, by what it is less sure than that

The sum of all Q on the way from the root, each carried along, is the covariance of odometry. It is
kept apart from that of the map, in which closed loops have a part. Where a keyframe is culled, its
children go to its parent, and their motions and growths add up.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section III-D (covisibility graph and essential graph).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_adjoint, se3_inverse
from odomap.maps.columns import grown

__all__ = ["Acquaintance", "Covisibility", "growth_of"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Acquaintance(NamedTuple):
    """What is written down of a keyframe when it comes.

    Attributes:
        keyframe_id: of it.
        shared_ids: (n,) keyframes that share landmarks with it.
        num_shared: (n,) how many.
        parent: the keyframe it was placed against, −1 for the first.
        T_parent_keyframe: (4, 4).
        growth: (6, 6) Q, NaN where unknown.
    """

    keyframe_id: int
    shared_ids: Index
    num_shared: Index
    parent: int
    T_parent_keyframe: Array
    growth: Array


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
        self.parent = np.zeros(0, np.int64)
        self.motion = np.zeros((0, 4, 4))
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
        self.motion, self.growth = grown(self.motion, k + 1), grown(self.growth, k + 1)
        self.parent[k], self.motion[k], self.growth[k] = (
            known.parent,
            known.T_parent_keyframe,
            known.growth,
        )
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
        for child in np.flatnonzero(self.parent == keyframe_id).tolist():
            Ad = se3_adjoint(se3_inverse(self.motion[child]))
            self.growth[child] += Ad @ self.growth[keyframe_id] @ Ad.T
            self.motion[child] = self.motion[keyframe_id] @ self.motion[child]
            self.parent[child] = self.parent[keyframe_id]

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


def growth_of(
    T_parent_keyframe: Array, covariance_parent: Array, covariance_keyframe: Array
) -> Array:
    """Return by what a keyframe is less sure than its parent, (6, 6), in its own tangent.

    It may be indefinite, as covariances that were found one by one need not fit together.
    """
    Ad = se3_adjoint(se3_inverse(T_parent_keyframe))
    return np.asarray(covariance_keyframe - Ad @ covariance_parent @ Ad.T)
