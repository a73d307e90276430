"""First sights: landmarks are located against the patch they were first seen in.

Tracking a patch from keyframe to keyframe adds a small error at each step, and the errors add up
to a random walk: the landmark drifts over the surface, and bundle adjustment, which takes
observations to be independent, believes itself more certain than it is. So when a view becomes a
keyframe each point tracked into it is aligned once more, against the image in which its landmark
was first seen. What is left is the noise of the two images alone. A point whose looks have
changed too much for that starts afresh from where it was tracked to.

Cost: one alignment on the finest level per point and keyframe.

Reference: Shi, Tomasi, "Good features to track", CVPR 1994 (dissimilarity to the first frame).
"""

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_inverse
from odomap.maps.map import Map
from odomap.system.association import View
from odomap.vision.flow import FlowConfig, facing_warp
from odomap.vision.patches import align_patches

__all__ = ["FirstSights"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MAX_DRIFT_PX = 1.5
"""A point that lies farther from where it was tracked to has been found somewhere else."""


class FirstSights:
    """Remembers the views of recent keyframes and aligns points to them.

    Args:
        map: where the keyframes are.
        camera: the rectified camera.
        T_body_camera: (4, 4) its mount.
        flow: patch size and checks.
        keep: how many views are remembered.
    """

    def __init__(
        self, map: Map, camera: Camera, T_body_camera: Array, flow: FlowConfig, keep: int
    ) -> None:
        self._map, self._camera, self._T_body_camera = map, camera, T_body_camera
        self._flow, self._keep = flow, keep
        self._views: dict[int, View] = {}

    def remember(self, keyframe_id: int, view: View) -> None:
        """Keep a keyframe's view, and forget the oldest beyond what is kept."""
        self._views[keyframe_id] = view
        for old in list(self._views)[: -self._keep]:
            del self._views[old]

    def align(
        self,
        view: View,
        T_world_body: Array,
        points_world: Array,
        first_keyframe: Index,
        first_keypoint: Array,
        pixels: Array,
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Locate points of a view against their first sights.

        Args:
            view: the image.
            T_world_body: (4, 4) its pose.
            points_world: (n, 3) the points, as far as known.
            first_keyframe: (n,) keyframe each was first seen in.
            first_keypoint: (n, 2) where in its image.
            pixels: (n, 2) where they were tracked to.

        Returns:
            (n, 2) pixels, and (n,) whether each still goes back to its first sight.
        """
        T_world_camera = T_world_body @ self._T_body_camera
        points_camera = (points_world - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        keyframes, which = np.unique(first_keyframe, return_inverse=True)
        Ts_world_first = self._map.Ts_world_body(keyframes) @ self._T_body_camera
        warp = facing_warp(points_camera, (se3_inverse(Ts_world_first) @ T_world_camera)[which])
        aligned, correlation = np.array(pixels), np.zeros(len(pixels))
        for k, keyframe_id in enumerate(keyframes.tolist()):
            first, of = self._views.get(keyframe_id), np.flatnonzero(which == k)
            if first is None:
                continue
            found = align_patches(
                first.image,
                view.image,
                first_keypoint[of],
                pixels[of],
                warp[of],
                self._flow.half_window_px,
                self._flow.iterations,
            )
            aligned[of], correlation[of] = found.points, np.where(found.found, found.correlation, 0)
        near = np.abs(aligned - pixels).max(axis=1, initial=0.0) < MAX_DRIFT_PX
        kept = near & (correlation >= self._flow.min_correlation)
        return np.where(kept[:, None], aligned, pixels), kept
