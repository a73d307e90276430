"""Sides of a loop: what a keyframe and those around it show, read off the map in one go.

Whether two keyframes show the same place is decided without the map: that takes long, and tracking
goes on. Two sides are all there is to decide on. A side is a keyframe with its features, the
landmarks it sees, and those that its covisible group sees,

    keyframe → covisible keyframes, most shared first → all their landmarks → how they look

in the camera of the keyframe and in its units: p_camera = Rᵀ (p_world - t) / s. There the drift of
the path is the same for all of them, and drops out: what two sides say of each other is measured.

Cost: O(observations of the group), one hold of the map's lock.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section VII; Mur-Artal, Tardós, "ORB-SLAM2", T-RO 2017, section III-C.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import InputError
from odomap.geometry.camera import Camera
from odomap.maps.map import Map

__all__ = ["GROUP", "LoopSide", "read_side"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

GROUP = 10
"""Covisible keyframes of a side, those that share most landmarks with it."""


@dataclass(frozen=True, eq=False)
class LoopSide:
    """What a keyframe and its covisible group show; copies, good for as long as one likes.

    Attributes:
        keyframe_id: the keyframe.
        T_world_camera: (4, 4) where its camera is.
        scale: world units per unit of the keyframe.
        camera: the ideal pinhole that its features are in.
        keypoints: (N, 2) float64 pixels of its features.
        levels: (N,) uint8 pyramid levels.
        descriptors: (N, 32) uint8.
        nodes: (N,) of the vocabulary's direct index; None where nobody looked them up.
        landmark_of: (N,) row of the landmark at each feature, -1 for none.
        landmark_ids: (M,) those of the keyframe itself first, then those of its group.
        points_world: (M, 3) where they are.
        landmark_descriptors: (M, 32) uint8, how they look.
        is_own: (M,) bool, seen by the keyframe itself.
        normals: (M, 3) mean direction, world axes, from the cameras that see them.
        distances: (M,) from the camera of a reference observation, world units.
        landmark_levels: (M,) uint8 pyramid level of that observation.
    """

    keyframe_id: int
    T_world_camera: Array
    scale: float
    camera: Camera
    keypoints: Array
    levels: NDArray[np.uint8]
    descriptors: NDArray[np.uint8]
    nodes: Index | None
    landmark_of: Index
    landmark_ids: Index
    points_world: Array
    landmark_descriptors: NDArray[np.uint8]
    is_own: NDArray[np.bool_]
    normals: Array
    distances: Array
    landmark_levels: NDArray[np.uint8]

    @cached_property
    def points_camera(self) -> Array:
        """(M, 3) landmarks in the camera of the keyframe, in its units."""
        T = self.T_world_camera
        return np.ascontiguousarray((self.points_world - T[:3, 3]) @ T[:3, :3] / self.scale)

    @cached_property
    def plane(self) -> Array:
        """(N, 2) where the features are on the plane z = 1."""
        return self.camera.undistort(self.keypoints)

    @cached_property
    def feature_of(self) -> Index:
        """(M,) the feature that shows each landmark, -1 for those of the group."""
        found = np.full(len(self.landmark_ids), -1)
        rows = np.flatnonzero(self.landmark_of >= 0)
        found[self.landmark_of[rows]] = rows
        return found

    def with_nodes(self, nodes: ArrayLike) -> "LoopSide":
        """Return the same side with the nodes of its features, `BagOfWords.nodes`.

        Raises:
            InputError: there is not one node for each feature.
        """
        nodes = np.asarray(nodes, np.int64)
        if nodes.shape != (len(self.descriptors),):
            raise InputError(
                f"keyframe {self.keyframe_id}: {len(self.descriptors)} features, but nodes of "
                f"shape {nodes.shape}: give one for each"
            )
        return replace(self, nodes=nodes)

    def without(self, landmark_ids: ArrayLike) -> "LoopSide":
        """Return the same side without some landmarks.

        What both sides of a loop know already ties them as the path does, drift included, and would
        speak for it: leave it out before the two are compared.

        Args:
            landmark_ids: (n,) of the same map.
        """
        kept = np.flatnonzero(~np.isin(self.landmark_ids, np.asarray(landmark_ids, np.int64)))
        row = np.full(len(self.landmark_ids) + 1, -1)
        row[kept] = np.arange(len(kept))
        return replace(
            self,
            landmark_of=row[self.landmark_of],
            landmark_ids=self.landmark_ids[kept],
            points_world=self.points_world[kept],
            landmark_descriptors=self.landmark_descriptors[kept],
            is_own=self.is_own[kept],
            normals=self.normals[kept],
            distances=self.distances[kept],
            landmark_levels=self.landmark_levels[kept],
        )


def read_side(
    map: Map,
    keyframe_id: int,
    camera: Camera,
    T_body_camera: Array,
    group: int = GROUP,
    part: Collection[int] | None = None,
) -> LoopSide:
    """Copy what a keyframe and its covisible group show.

    Args:
        map: where they are.
        keyframe_id: a living keyframe with binary features.
        camera: the ideal pinhole that the features are in.
        T_body_camera: (4, 4) its mount.
        group: covisible keyframes whose landmarks are read too, at most.
        part: keyframes that may be of the group, and those whose landmarks count: what others made
            is left out. Default: all.

    Raises:
        InputError: the keyframe has no features, or none with descriptors of 32 bytes.
        KeyError: it is not in the map.
    """
    with map.lock:
        features = map.keyframe(keyframe_id).features
        if features is None or features.descriptors.shape[1:] != (32,):
            raise InputError(f"keyframe {keyframe_id}: has no features with binary descriptors")
        own_ids, rows = map.observations_of(keyframe_id)
        around, ids = map.covisible(keyframe_id)[0], own_ids
        if part is not None:
            around = around[_are_in(around, part)]
        ids = np.union1d(own_ids, map.landmarks_of(around[:group]))
        if part is not None:
            ids = ids[_are_in(map.anchors(ids), part)]
            kept = np.isin(own_ids, ids)
            own_ids, rows = own_ids[kept], rows[kept]
        T_world_body, scale = map.T_world_body(keyframe_id), map.scale(keyframe_id)
        views = map.views_of(ids, T_body_camera)
    is_own = np.isin(views.ids, own_ids)
    order = np.argsort(~is_own, kind="stable")
    ids = views.ids[order]
    landmark_of = np.full(len(features), -1)
    shown = np.flatnonzero(rows >= 0)
    row = np.searchsorted(views.ids, own_ids[shown])
    place = np.empty(len(ids), np.int64)
    place[order] = np.arange(len(ids))
    landmark_of[rows[shown]] = place[row]
    T_world_camera = T_world_body @ T_body_camera
    T_world_camera[:3, 3] = T_world_body[:3, 3] + scale * (
        T_world_body[:3, :3] @ T_body_camera[:3, 3]
    )
    return LoopSide(
        keyframe_id=keyframe_id,
        T_world_camera=T_world_camera,
        scale=scale,
        camera=camera,
        keypoints=features.keypoints.astype(np.float64),
        levels=features.level,
        descriptors=features.descriptors,
        nodes=None,
        landmark_of=landmark_of,
        landmark_ids=ids,
        points_world=views.points_world[order],
        landmark_descriptors=views.descriptors[order],
        is_own=is_own[order],
        normals=views.normals[order],
        distances=views.distance[order],
        landmark_levels=views.level[order],
    )


def _are_in(ids: Index, part: Collection[int]) -> NDArray[np.bool_]:
    return np.isin(ids, np.fromiter(part, np.int64, len(part)))
