"""The local map: the landmarks that a camera may see from where it is.

They are those of the keyframes that share landmarks with the last frame, and of those that look at
the same place from nearby, though nothing is shared yet: so what was seen long ago is looked for
again when the camera comes back. How many there are depends on the place, not on the map.

Which of them a frame should show follows from a predicted pose: a landmark is expected if it lies
in the image, is not seen from another side than before, and at a distance at which it would be
found again; the level of the pyramid is predicted from that distance.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section V-D.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.camera import Camera
from odomap.maps.map import Map
from odomap.maps.views import LandmarkViews
from odomap.system.dispute import SETTLED
from odomap.system.maplocating_kernels import foresee
from odomap.system.visualconfig import LocalMapConfig

__all__ = [
    "Expected",
    "LocalMap",
    "LocalMapConfig",
    "expect",
    "local_map",
    "median_distance",
    "nearby",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

SIDE = 0.5
"""Cosine of the angle between the directions of view beyond which a landmark looks different."""
MARGIN_PX = 2.0
"""Nearer to the rim of the image nothing is found."""


@dataclass(frozen=True, eq=False)
class LocalMap:
    """Landmarks around a keyframe, ready to be searched for.

    Attributes:
        keyframe_id: the keyframe that frames hang from here.
        views: the N landmarks, and how they were seen.
        keypoints: (N, 2) where in that keyframe; NaN where it does not see them.
        relative: (N,) standard deviation of a landmark's distance as a fraction of it.
        is_settled: (N,) whether several keyframes agree on it.
    """

    keyframe_id: int
    views: LandmarkViews
    keypoints: Array
    relative: Array
    is_settled: NDArray[np.bool_]

    @property
    def landmark_ids(self) -> Index:
        """(N,) ids, ascending."""
        return self.views.ids

    @property
    def seen_ids(self) -> Index:
        """Ids of the landmarks that the keyframe sees."""
        return self.views.ids[np.isfinite(self.keypoints[:, 0])]

    @property
    def num_seen(self) -> int:
        """How many landmarks the keyframe sees."""
        return int(np.count_nonzero(np.isfinite(self.keypoints[:, 0])))

    def __len__(self) -> int:
        return len(self.views.ids)

    def rows_of(self, landmark_ids: Index) -> Index:
        """Return the rows of those of some landmarks (n,) that are here, ascending."""
        if not len(self):
            return np.empty(0, np.int64)
        at = np.searchsorted(self.views.ids, landmark_ids).clip(0, len(self) - 1)
        is_here = np.zeros(len(self), np.bool_)
        is_here[at[self.views.ids[at] == landmark_ids]] = True
        return np.flatnonzero(is_here)


def nearby(map: Map, T_world_body: Array, distance: float, config: LocalMapConfig) -> Index:
    """Return keyframes that look at the same place as a body does, nearest first.

    Args:
        map: what is remembered.
        T_world_body: (4, 4) where the body is.
        distance: of what it sees, world units.
        config: how near they must be.
    """
    radius = config.near_distance * distance
    return map.near(T_world_body, radius, np.radians(config.near_angle_deg))


def median_distance(points_world: Array, from_world: Array) -> float:
    """Return how far points (N, 3) typically are from another; 1 if there are none."""
    away = np.linalg.norm(points_world - from_world, axis=1)
    return float(np.median(away)) if len(away) else 1.0


def local_map(
    map: Map,
    keyframe_id: int,
    T_world_body: Array,
    T_body_camera: Array,
    sigma: float | None,
    config: LocalMapConfig,
) -> LocalMap:
    """Gather the landmarks around a keyframe.

    Args:
        map: what is remembered.
        keyframe_id: the keyframe.
        T_world_body: (4, 4) where the body is.
        T_body_camera: (4, 4) mount of the pinhole.
        sigma: standard deviation of a measured inverse depth, 1/m; None for a single camera.
        config: how much is gathered.
    """
    seen, rows = map.observations_of(keyframe_id)
    sharing = map.observing(seen)[0][: config.keyframes]
    points = map.points_world(seen)
    near = nearby(map, T_world_body, median_distance(points, T_world_body[:3, 3]), config)
    near = near[~np.isin(near, sharing)][: config.near]
    ids = map.landmarks_of(np.concatenate([sharing, near, [keyframe_id]]))
    views = map.views_of(ids, T_body_camera)
    keypoints = np.full((len(views), 2), np.nan)
    features = map.keyframe(keyframe_id).features
    if features is not None and len(seen):
        at = np.searchsorted(views.ids, seen)
        keypoints[at] = features.keypoints[rows]
    observers = map.count_observers(views.ids)
    relative = np.zeros(len(views))
    if sigma is not None:
        relative = sigma * views.distance / np.sqrt(np.maximum(observers, 1))
    return LocalMap(keyframe_id, views, keypoints, relative, observers >= SETTLED)


@dataclass(frozen=True, eq=False)
class Expected:
    """Landmarks of a local map that a frame should show.

    Attributes:
        rows: (n,) of the local map.
        points_camera: (n, 3).
        pixels: (n, 2) where.
        level: (n,) on which level of the pyramid.
    """

    rows: Index
    points_camera: Array
    pixels: Array
    level: Index


def expect(
    local: LocalMap,
    rows: Index,
    T_camera_world: Array,
    camera: Camera,
    level_scale: float,
    levels: int,
) -> Expected:
    """Tell which landmarks a frame should show.

    Args:
        local: the local map.
        rows: (m,) which of it are asked about.
        T_camera_world: (4, 4) the predicted pose.
        camera: the pinhole.
        level_scale, levels: of the pyramid.
    """
    views, n = local.views, len(rows)
    shown, points = np.empty(n, np.int64), np.empty((n, 3))
    pixels, level = np.empty((n, 2)), np.empty(n, np.int64)
    found = foresee(
        views.points_world,
        views.normals,
        views.distance,
        views.level,
        np.ascontiguousarray(rows, np.int64),
        np.ascontiguousarray(T_camera_world),
        np.array([*camera.intrinsics, *camera.resolution], np.float64),
        np.array([MARGIN_PX, SIDE, np.log(level_scale)]),
        levels,
        shown,
        points,
        pixels,
        level,
    )
    return Expected(shown[:found], points[:found], pixels[:found], level[:found])
