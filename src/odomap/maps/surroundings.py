"""Surroundings: the part of a map that matters at one place, as a tracker asks for it.

A tracker knows a few landmarks it sees, or roughly where it is, and wants what lies around:

    landmarks seen → observing keyframes → all their landmarks → views    (the local map)
    pose → keyframes near by that look the same way                       (where to look when lost)

Each is read off the observation table or the states, O(rows touched) or O(K) over a few numbers per
keyframe; the cost of a frame does not grow with the map.

Reference: R. Mur-Artal, J. Montiel, J. Tardós, ORB-SLAM: a versatile and accurate monocular SLAM
system, 2015 (local map tracking).
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.maps.columns import distinct, members
from odomap.maps.sightings import Sightings
from odomap.maps.views import LandmarkViews, ViewRows, views_from

__all__ = ["Surroundings"]


class Surroundings(Sightings):
    """What lies around some landmarks, some keyframes or a pose."""

    def observing(self, landmark_ids: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Count who sees some landmarks.

        Args:
            landmark_ids: landmarks; each counts once, those gone are passed over.

        Returns:
            ids and counts (n,) of the keyframes that see any of them, most first, then oldest.
        """
        with self.lock:
            slots = distinct(self._landmarks.slots(self._ids(landmark_ids)))
            _, rows = self._observations.of_landmarks(slots[slots >= 0])
            keyframes = self._observations.observers(rows)[0]
        counts = np.bincount(keyframes)
        ids = np.flatnonzero(counts)
        order = np.argsort(-counts[ids], kind="stable")
        return ids[order], counts[ids[order]]

    def landmarks_of(self, keyframe_ids: ArrayLike) -> NDArray[np.int64]:
        """Return the (n,) distinct landmarks that keyframes see, ascending; stubs see none."""
        with self.lock:
            _, rows = self._observations.of_keyframes(self._all_known(keyframe_ids))
            seen = self._landmarks.ids[members(self._observations.sights(rows)[0])]
        return np.sort(seen)

    def near(
        self, T_world_body: NDArray[np.float64], radius: float, angle: float
    ) -> NDArray[np.int64]:
        """Return the (n,) living keyframes around a pose, nearest first, then oldest.

        Args:
            T_world_body: (4, 4) the pose.
            radius: how far away their bodies may be, world units.
            angle: how far their bodies may be turned against it, radians.
        """
        with self.lock:
            ids = self._tree.alive()
            Ts, _ = self.states.placements(ids)
        apart = np.linalg.norm(Ts[:, :3, 3] - T_world_body[:3, 3], axis=1)
        # tr(Rᵀ R_k) = 1 + 2 cos of the angle between the two
        trace = np.einsum("kij,ij->k", Ts[:, :3, :3], T_world_body[:3, :3])
        turn = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))
        inside = np.flatnonzero((apart <= radius) & (turn <= angle))
        return ids[inside[np.argsort(apart[inside], kind="stable")]]

    def views_of(
        self, landmark_ids: ArrayLike, T_body_camera: NDArray[np.float64]
    ) -> LandmarkViews:
        """Return where landmarks are and how they look from the keyframes that see them.

        The reference observation is that of the anchor if it still sees the landmark, else that of
        the oldest keyframe that does; where none does, the anchor stands in for the observers.

        Args:
            landmark_ids: landmarks; those gone are passed over, fused ones are their survivors.
            T_body_camera: (4, 4) mount of the camera whose features the keyframes hold.

        Returns:
            Each living landmark once, by ascending id.
        """
        asked = self._ids(landmark_ids)
        with self.lock:
            rows = self._view_rows(asked)
        return views_from(rows, np.asarray(T_body_camera, np.float64))

    def _view_rows(self, landmark_ids: NDArray[np.int64]) -> ViewRows:
        slots = self._landmarks.slots(landmark_ids)
        slots = members(slots[slots >= 0])
        slots = slots[np.argsort(self._landmarks.ids[slots])]
        indptr, rows = self._observations.of_landmarks(slots)
        observers, keypoints = self._observations.observers(rows)
        anchors = self._landmarks.anchor.take(slots)
        keyframes = members(np.concatenate([anchors, observers]))
        index = np.zeros(int(keyframes.max(initial=-1)) + 1, np.int64)
        index[keyframes] = np.arange(len(keyframes))
        return ViewRows(
            ids=self._landmarks.ids.take(slots),
            anchor=index.take(anchors),
            p_anchor=self._landmarks.p_anchor.take(slots),
            descriptors=self._landmarks.descriptor.take(slots),
            indptr=indptr,
            observer=index.take(observers),
            keypoint=keypoints,
            keyframes=[self._keyframes[k] for k in keyframes.tolist()],
            placements=self.states.placements(keyframes),
        )
