"""Sightings: the landmarks of a map, and which keyframes see them.

The upper half of a map stands on its skeleton: landmarks hang from keyframes, p_world = S_anchor p,
and observations join the two. Landmarks are named by id here. An id that was fused is good for ever
(it means its survivor), one that is gone is passed over or answered by -1, NaN or 0: another thread
may have removed a landmark since the caller learned of it. Methods cost O(rows touched).

Reference: R. Mur-Artal, J. Montiel, J. Tardós, ORB-SLAM: a versatile and accurate monocular SLAM
system, 2015 (map points, covisibility).
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.maps.columns import distinct
from odomap.maps.landmarks import Landmarks
from odomap.maps.observations import Observations
from odomap.maps.skeleton import Skeleton
from odomap.maps.states import act, act_inverse
from odomap.maps.tree import ALIVE, STUB

__all__ = ["Sightings"]


class Sightings(Skeleton):
    """Landmarks and observations on top of the keyframes."""

    def __init__(self) -> None:
        super().__init__()
        self._landmarks = Landmarks()
        self._observations = Observations()

    @property
    def num_landmarks(self) -> int:
        """How many landmarks there are."""
        return len(self._landmarks)

    @property
    def num_observations(self) -> int:
        """How many observations there are."""
        return len(self._observations)

    def add_landmarks(
        self,
        anchor: ArrayLike,
        p_anchor: NDArray[np.float64],
        descriptors: NDArray[np.uint8] | None = None,
    ) -> NDArray[np.int64]:
        """Add landmarks.

        Args:
            anchor: (M,) keyframe ids or one for all; below a culled one, its parent takes over.
            p_anchor: (M, 3) places in the anchor's body frame and units.
            descriptors: (M, 32) uint8, how they look.

        Returns:
            (M,) their ids.
        """
        with self.lock:
            points = np.asarray(p_anchor, np.float64).reshape(-1, 3)
            if not np.isfinite(points).all():
                raise ValueError("add_landmarks: a place is not finite")
            anchors = np.broadcast_to(self._all_known(anchor), (len(points),)).astype(np.int64)
            stub = self._tree.status[anchors] == STUB
            if stub.any():
                world = act(self._tree.placements(self.states, anchors[stub]), points[stub])
                anchors[stub] = self._tree.parent[anchors[stub]]
                points = points.copy()
                points[stub] = act_inverse(self.states.placements(anchors[stub]), world)
            self.version += 1
            return self._landmarks.add(anchors, points, descriptors)

    def points_world(self, landmark_ids: ArrayLike) -> NDArray[np.float64]:
        """Return the (N, 3) places of (N,) landmarks in the world, NaN for those that are gone."""
        with self.lock:
            slots = self._landmarks.slots(self._ids(landmark_ids))
            gone = slots < 0
            if not gone.any():
                return self._points(slots)
            points = np.full((len(slots), 3), np.nan)
            points[~gone] = self._points(slots[~gone])
            return points

    def anchors(self, landmark_ids: ArrayLike) -> NDArray[np.int64]:
        """Return the keyframes that (N,) living landmarks are stored relative to."""
        with self.lock:
            return self._landmarks.anchor[self._living_slots(landmark_ids)].astype(np.int64)

    def descriptors(self, landmark_ids: ArrayLike) -> NDArray[np.uint8]:
        """Return the (N, 32) descriptors of (N,) living landmarks."""
        with self.lock:
            return self._landmarks.descriptor[self._living_slots(landmark_ids)]

    def set_descriptors(self, landmark_ids: ArrayLike, descriptors: NDArray[np.uint8]) -> None:
        """Write the (N, 32) descriptors of (N,) landmarks; those gone or fused are passed over."""
        with self.lock:
            ids = self._ids(landmark_ids)
            if descriptors.shape != (len(ids), 32) or descriptors.dtype != np.uint8:
                what = f"{descriptors.dtype} {descriptors.shape}"
                raise ValueError(f"{len(ids)} landmarks need uint8 ({len(ids)}, 32), not {what}")
            slots = self._landmarks.slots(ids)
            itself = (slots >= 0) & (self._landmarks.ids[slots] == ids)
            self._landmarks.descriptor[slots[itself]] = descriptors[itself]
            self.version += 1

    def remove_landmarks(self, landmark_ids: ArrayLike) -> None:
        """Remove landmarks and their observations; those already gone are passed over."""
        with self.lock:
            slots = distinct(self._landmarks.slots(self._ids(landmark_ids)))
            slots = slots[slots >= 0]
            self._observations.remove(self._observations.of_landmarks(slots)[1])
            self._landmarks.remove(slots)
            self.version += 1

    def fuse_landmarks(self, survivors: ArrayLike, gone: ArrayLike) -> None:
        """Join pairs of landmarks that are one point: ids and observations go to the survivor.

        Args:
            survivors: (N,) ids that keep their place and descriptor.
            gone: (N,) ids that follow from now on. Pairs are taken in order and may form chains;
                a pair with a dead landmark, or joined already, is passed over. Where a keyframe
                sees several that are joined, the survivor's observation stays, else the oldest's.
        """
        with self.lock:
            winners = self._landmarks.slots(self._ids(survivors))
            losers = self._landmarks.slots(self._ids(gone))
            lost, kept = _heirs(winners, losers)
            order = np.argsort(self._landmarks.ids[lost])
            lost, kept = lost[order], kept[order]
            self._observations.reassign(lost, kept)
            self._landmarks.forward(lost, kept)
            self.version += 1

    def is_alive(self, landmark_ids: ArrayLike) -> NDArray[np.bool_]:
        """Return the (N,) mask of landmarks that exist, a fused one being alive in its survivor."""
        with self.lock:
            return self._landmarks.slots(self._ids(landmark_ids)) >= 0

    def resolve(self, landmark_ids: ArrayLike) -> NDArray[np.int64]:
        """Return the (N,) ids by which landmarks go now: themselves, their survivors, or -1."""
        with self.lock:
            slots = self._landmarks.slots(self._ids(landmark_ids))
            alive = slots >= 0
            slots[alive] = self._landmarks.ids[slots[alive]]
            return slots

    @property
    def landmark_ids(self) -> NDArray[np.int64]:
        """(M,) ids of living landmarks, ascending."""
        with self.lock:
            return self._landmarks.all_ids()

    def count_seen(self, landmark_ids: ArrayLike) -> None:
        """Count one more frame in which landmarks were seen; those gone are passed over."""
        with self.lock:
            slots = self._landmarks.slots(self._ids(landmark_ids))
            self._landmarks.seen.add(slots[slots >= 0], 1)
            self.version += 1

    def seen(self, landmark_ids: ArrayLike) -> NDArray[np.int64]:
        """Return in how many frames (N,) living landmarks were seen."""
        with self.lock:
            return self._landmarks.seen[self._living_slots(landmark_ids)].astype(np.int64)

    def count_expected(self, landmark_ids: ArrayLike) -> None:
        """Count one more frame in which landmarks should have been seen; passes over those gone."""
        with self.lock:
            slots = self._landmarks.slots(self._ids(landmark_ids))
            self._landmarks.expected.add(slots[slots >= 0], 1)
            self.version += 1

    def expected(self, landmark_ids: ArrayLike) -> NDArray[np.int64]:
        """Return in how many frames (N,) living landmarks should have been seen."""
        with self.lock:
            return self._landmarks.expected[self._living_slots(landmark_ids)].astype(np.int64)

    def add_observations(
        self, keyframe_ids: ArrayLike, landmark_ids: ArrayLike, keypoints: ArrayLike
    ) -> int:
        """Say that keyframes see landmarks; a pair already there takes the new keypoint.

        Landmarks that are gone are passed over, fused ones are seen as their survivors. Nothing is
        added to keyframes that were culled.

        Args:
            keyframe_ids: (N,) keyframes, or one for all.
            landmark_ids: (N,) landmarks.
            keypoints: (N,) indices into the keyframes' features, -1 for none.

        Returns:
            How many observations are new.
        """
        with self.lock:
            slots = self._landmarks.slots(self._ids(landmark_ids))
            points = self._ids(keypoints)
            if len(points) != len(slots):
                raise ValueError(f"{len(slots)} landmarks but {len(points)} keypoints")
            keyframes = np.broadcast_to(self._all_known(keyframe_ids), slots.shape)
            good = (slots >= 0) & (self._tree.status[keyframes] == ALIVE)
            if not (self._tree.status[self._ids(keyframe_ids)] == ALIVE).any():
                return 0
            self.version += 1
            return self._observations.add(keyframes[good], slots[good], points[good])

    def remove_observations(self, keyframe_ids: ArrayLike, landmark_ids: ArrayLike) -> None:
        """Remove observations by N pairs of keyframe and landmark; absent ones are passed over."""
        with self.lock:
            slots = self._landmarks.slots(self._ids(landmark_ids))
            keyframes = np.broadcast_to(self._ids(keyframe_ids), slots.shape)
            rows = self._observations.find(keyframes[slots >= 0], slots[slots >= 0])
            self._observations.remove(rows[rows >= 0])
            self.version += 1

    def observations_of(self, keyframe_id: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the (n,) landmark ids that a keyframe sees, and at which of its keypoints."""
        with self.lock:
            _, rows = self._observations.of_keyframes(np.array([self._known(keyframe_id)]))
            _, slots, keypoints = self._observations.read(rows)
            return self._landmarks.ids[slots], keypoints

    def observers_of(
        self, landmark_ids: ArrayLike
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Return who sees landmarks, as a CSR view.

        Args:
            landmark_ids: (N,) living landmarks.

        Returns:
            indptr (N + 1,), keyframe ids and keypoints: those of the n-th landmark are the entries
            indptr[n] up to indptr[n + 1].
        """
        with self.lock:
            indptr, rows = self._observations.of_landmarks(self._living_slots(landmark_ids))
            keyframes, _, keypoints = self._observations.read(rows)
            return indptr, keyframes, keypoints

    def count_observers(self, landmark_ids: ArrayLike) -> NDArray[np.int64]:
        """Return how many keyframes see each of (N,) landmarks, 0 for those that are gone."""
        with self.lock:
            slots = self._landmarks.slots(self._ids(landmark_ids))
            counts = np.zeros(len(slots), np.int64)
            counts[slots >= 0] = self._observations.count(slots[slots >= 0])
            return counts

    def covisible(self, keyframe_id: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the (n,) keyframes that share landmarks with one, and how many; most first."""
        with self.lock:
            return self._observations.covisible(self._known(keyframe_id))

    def _living_slots(self, landmark_ids: ArrayLike) -> NDArray[np.int64]:
        ids = self._ids(landmark_ids)
        slots = self._landmarks.slots(ids)
        if (slots < 0).any():
            raise KeyError(f"landmark {ids[slots < 0][0]} is not in the map")
        return slots

    def _points(self, slots: NDArray[np.int64]) -> NDArray[np.float64]:
        anchors = self._landmarks.anchor.take(slots).astype(np.int64)
        return act(self.states.placements(anchors), self._landmarks.p_anchor.take(slots))


def _heirs(
    winners: NDArray[np.int64], losers: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return (F,) slots that are lost, and where each chain of N pairs (-1: dead) ends, in order.

    Raises:
        ValueError: there are not as many of ones as of the others.
    """
    if len(winners) != len(losers):
        raise ValueError(f"{len(winners)} survivors but {len(losers)} gone")
    good = (winners >= 0) & (losers >= 0)
    winners, losers = winners[good], losers[good]
    is_lost = np.zeros(int(max(winners.max(initial=-1), losers.max(initial=-1))) + 1, np.bool_)
    is_lost[losers] = True
    if np.count_nonzero(is_lost) == len(losers) and not is_lost[winners].any():
        return losers, winners  # no chains
    heir: dict[int, int] = {}
    for winner, loser in zip(winners.tolist(), losers.tolist(), strict=True):
        winner, loser = _root(heir, winner), _root(heir, loser)
        if winner != loser:
            heir[loser] = winner
    lost = np.asarray(list(heir), np.int64)
    return lost, np.asarray([_root(heir, slot) for slot in lost.tolist()], np.int64)


def _root(heir: dict[int, int], slot: int) -> int:
    """Follow a chain of survivors to its end."""
    while slot in heir:
        slot = heir[slot]
    return slot
