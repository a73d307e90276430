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
from odomap.system.association import Reference, View
from odomap.vision.flow import FlowConfig, align_patches, facing_warp

__all__ = ["FirstSights"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


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
        self, view: View, T_world_body: Array, reference: Reference, rows: Index, pixels: Array
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Locate points of a view against their first sights.

        Args:
            view: the image.
            T_world_body: (4, 4) its pose.
            reference: the keyframe they were tracked from.
            rows: (n,) rows of the reference.
            pixels: (n, 2) where they were tracked to.

        Returns:
            (n, 2) pixels, and (n,) whether each still goes back to its first sight.
        """
        aligned, kept = np.array(pixels), np.zeros(len(rows), np.bool_)
        points = self._map.points_world(reference.landmark_ids[rows])
        T_camera_world = se3_inverse(T_world_body @ self._T_body_camera)
        points_camera = points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        for keyframe_id in np.unique(reference.first_keyframe[rows]).tolist():
            first = self._views.get(keyframe_id)
            if first is None:
                continue
            of = np.flatnonzero(reference.first_keyframe[rows] == keyframe_id)
            T_first_world = se3_inverse(self._map.T_world_body(keyframe_id) @ self._T_body_camera)
            warp = facing_warp(points_camera[of], T_first_world @ se3_inverse(T_camera_world))
            found = align_patches(
                first.image,
                view.image,
                reference.first_keypoint[rows[of]],
                pixels[of],
                warp,
                self._flow.half_window_px,
                self._flow.iterations,
            )
            moved = np.linalg.norm(found.points - pixels[of], axis=1)
            good = found.found & (found.correlation >= self._flow.min_correlation) & (moved < 1.5)
            aligned[of[good]] = found.points[good]
            kept[of[good]] = True
        return aligned, kept
