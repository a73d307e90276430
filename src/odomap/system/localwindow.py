"""The local window: a part of the map as local mapping works on it.

Local mapping fuses duplicates, creates landmarks, adjusts poses and points, all on a copy: arrays
read off the map in one go, while the tracker goes on with the map itself. What is decided is
written back at the end as one change. Rows here are keyframes, landmarks and observations of the
window; ids belong to the map.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section VI.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.camera import Camera
from odomap.maps.keyframes import Keyframe
from odomap.maps.snapshot import Snapshot
from odomap.vision.features import Features

__all__ = ["LocalWindow", "by_id"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class LocalWindow:
    """Keyframes that share landmarks, those landmarks, and who sees which.

    Attributes:
        keyframes: K of them, with features; those that are adjusted come first.
        is_fixed: (K,) bool, those that only hold the others in place.
        Ts_world_camera: (K, 4, 4).
        points_world: (M, 3) landmarks.
        descriptors: (M, 32) uint8, how they look.
        num_observers: (M,) keyframes of the whole map that see each.
        obs_keyframe, obs_landmark, obs_keypoint: (N,) rows of keyframe, of landmark, and of the
            keyframe's features.
        newest: row of the new keyframe.
        camera: the ideal pinhole that all features are in.
        sigma_px: standard deviation of a keypoint's position on the finest level.
        level_scale: size of a pyramid level's pixels relative to those of the finer one.
        inverse_depth_sigma: standard deviation of a measured inverse depth, 1/m.
        inverse_depth_bias: (3,) what all of them are off by, 1/m (see `depthbias`).
    """

    keyframes: tuple[Keyframe, ...]
    is_fixed: NDArray[np.bool_]
    Ts_world_camera: Array
    points_world: Array
    descriptors: NDArray[np.uint8]
    num_observers: Index
    obs_keyframe: Index
    obs_landmark: Index
    obs_keypoint: Index
    newest: int
    camera: Camera
    sigma_px: float
    level_scale: float
    inverse_depth_sigma: float
    inverse_depth_bias: Array = field(default_factory=lambda: np.zeros(3))

    def features(self, k: int) -> Features:
        """Return the features of keyframe row k."""
        features = self.keyframes[k].features
        assert features is not None, "a window is made of keyframes with features"
        return features

    @cached_property
    def first(self) -> Index:
        """(K + 1,) where the keypoints of each keyframe begin when all are put in a row."""
        return np.cumsum([0, *(len(self.features(k)) for k in range(len(self.keyframes)))])

    @cached_property
    def bearings(self) -> Array:
        """(n, 3) of all keypoints, keyframe by keyframe."""
        return np.concatenate([self.features(k).bearings for k in range(len(self.keyframes))])

    @cached_property
    def depths(self) -> Array:
        """(n,) of all keypoints, keyframe by keyframe; NaN where unknown."""
        return np.concatenate([self.features(k).depth for k in range(len(self.keyframes))])

    @cached_property
    def levels(self) -> NDArray[np.uint8]:
        """(n,) of all keypoints, keyframe by keyframe."""
        return np.concatenate([self.features(k).level for k in range(len(self.keyframes))])

    def landmark_at(self, k: int) -> Index:
        """Return the landmark row at each keypoint of keyframe row k, (n,), −1 for none."""
        found = np.full(len(self.features(k)), -1)
        rows = np.flatnonzero(self.obs_keyframe == k)
        found[self.obs_keypoint[rows]] = self.obs_landmark[rows]
        return found

    def center(self, k: int) -> Array:
        """Return where in the world the camera of keyframe row k is, (3,)."""
        return np.asarray(self.Ts_world_camera[k, :3, 3])


def by_id(snapshot: Snapshot) -> Snapshot:
    """Return a snapshot with its landmarks in order of their ids, by which the map fuses them."""
    order = np.argsort(snapshot.landmark_ids)
    row = np.empty(len(order), np.int64)
    row[order] = np.arange(len(order))
    return replace(
        snapshot,
        landmark_ids=snapshot.landmark_ids[order],
        points_world=snapshot.points_world[order],
        anchors=snapshot.anchors[order],
        points_anchor=snapshot.points_anchor[order],
        obs_landmark=row[snapshot.obs_landmark],
    )
