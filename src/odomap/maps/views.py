"""How landmarks look: from where they were seen, how far away, and on which level of the pyramid.

Before a landmark is searched in an image one asks whether it can be found there: is it seen from
about the side it was seen from before, and at what size? With the centres c_k of the cameras that
observe it, a reference observation at distance d_ref and pyramid level l_ref, and a scale factor f
per level, a landmark at p is expected from a camera at c within

    n = Σ_k (p - c_k) / |p - c_k|  normalised,    viewing angle  cos α = n · (p - c) / |p - c|,
    level  l = l_ref + log_f (d_ref / |p - c|):   nearer, it is larger and found on a higher level.

The rows are copied under the map's lock (`ViewRows`), all else is computed without it, O(rows).

Reference: R. Mur-Artal, J. Montiel, J. Tardós, ORB-SLAM: a versatile and accurate monocular SLAM
system, 2015 (map points; local map tracking).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.maps.columns import offsets
from odomap.maps.keyframes import Keyframe
from odomap.maps.states import Placement, act

__all__ = ["LandmarkViews", "ViewRows", "views_from"]


@dataclass(frozen=True, eq=False)
class LandmarkViews:
    """What guided search needs of landmarks; arrays are copies.

    Attributes:
        ids: (N,) int64, ascending, distinct.
        points_world: (N, 3) places.
        normals: (N, 3) unit vectors: the mean direction from the observing cameras to the point.
        descriptors: (N, 32) uint8.
        distance: (N,) from the camera of the reference observation, world units.
        level: (N,) uint8 pyramid level of the reference observation, 0 where it has no features.
    """

    ids: NDArray[np.int64]
    points_world: NDArray[np.float64]
    normals: NDArray[np.float64]
    descriptors: NDArray[np.uint8]
    distance: NDArray[np.float64]
    level: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, eq=False)
class ViewRows:
    """The rows of a map that views are computed from, as they were at one moment.

    Attributes:
        ids: (N,) landmarks, ascending.
        anchor: (N,) index of their anchor among the keyframes.
        p_anchor: (N, 3) places in the anchors' frames.
        descriptors: (N, 32).
        indptr: (N + 1,) observations of each landmark.
        observer: (R,) index of the observing keyframe.
        keypoint: (R,) which of its features, -1 for none.
        keyframes: the K keyframes, by ascending id.
        placements: (K, 4, 4) poses and (K,) scales of them.
    """

    ids: NDArray[np.int64]
    anchor: NDArray[np.int64]
    p_anchor: NDArray[np.float64]
    descriptors: NDArray[np.uint8]
    indptr: NDArray[np.int64]
    observer: NDArray[np.int64]
    keypoint: NDArray[np.int32]
    keyframes: Sequence[Keyframe]
    placements: Placement


def views_from(rows: ViewRows, T_body_camera: NDArray[np.float64]) -> LandmarkViews:
    """Compute how landmarks look from the cameras that see them.

    Args:
        rows: of the map.
        T_body_camera: (4, 4) mount of the camera.
    """
    # Maps are read and written in places where nobody looks for landmarks: no kernels there.
    from odomap.maps.views_kernels import look_from

    Ts, scales = rows.placements
    centers = act(rows.placements, np.broadcast_to(T_body_camera[:3, 3], (len(Ts), 3)))
    none = np.zeros(0, np.uint8)
    levels = [none if k.features is None else k.features.level for k in rows.keyframes]
    number = len(rows.ids)
    views = LandmarkViews(
        ids=rows.ids,
        points_world=np.empty((number, 3)),
        normals=np.empty((number, 3)),
        descriptors=rows.descriptors,
        distance=np.empty(number),
        level=np.empty(number, np.uint8),
    )
    look_from(
        rows.anchor,
        rows.p_anchor,
        rows.indptr,
        rows.observer,
        rows.keypoint,
        np.ascontiguousarray(Ts),
        np.ascontiguousarray(scales),
        np.ascontiguousarray(centers),
        offsets(np.array([len(column) for column in levels], np.int64)),
        np.concatenate([none, *levels]),
        views.points_world,
        views.normals,
        views.distance,
        views.level,
    )
    return views
