"""Making stereo keyframes: depth for what is tracked, new landmarks where nothing is.

The points tracked into the image keep their landmarks; corners are detected in the gaps between
them. Stereo measures the disparity of both: near the expected one for tracked points, over the
whole range for new ones. New points with a disparity become landmarks.

Reference: Mur-Artal, Tardós, "ORB-SLAM2", T-RO 2017, section III-A.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.system.association import Association, Reference, View
from odomap.system.config import Config
from odomap.system.firstsight import FirstSights
from odomap.vision.features import Features
from odomap.vision.rectifier import Rectifier
from odomap.vision.stereo import match_sparse, sgbm_disparity

__all__ = ["Seen", "StereoKeyframes"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Image = NDArray[np.uint8]

MIN_DISPARITY_PX = 0.05
"""Below this a point is at infinity as far as the pair can tell, and has no depth."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What a view that may become a keyframe shows.

    Attributes:
        features: of the n points tracked into it, then of new ones, which all have depth.
        landmark_ids: (n,) of the tracked points.
        pixels: (n, 2) where they are.
        first: (n,) keyframe each was first seen in, −1 for here.
        first_at: (n, 2) where in its image.
    """

    features: Features
    landmark_ids: Index
    pixels: Array
    first: Index
    first_at: Array


class StereoKeyframes:
    """Turns views into keyframes of a map."""

    def __init__(
        self, map: Map, rectifier: Rectifier, association: Association, config: Config
    ) -> None:
        self._map, self._rectifier = map, rectifier
        self._association, self._config = association, config
        self._sights = FirstSights(
            map,
            rectifier.camera,
            rectifier.T_body_camera,
            config.flow,
            config.window.size + config.window.fixed,
        )

    def measure(
        self,
        view: View,
        right: Image,
        T_world_body: Array,
        tracked: Reference | None,
        rows: Index,
        pixels: Array,
    ) -> Seen:
        """Find the points and depths of a view, without touching the map.

        Args:
            view: the left image.
            right: the raw right image.
            T_world_body: (4, 4).
            tracked: the keyframe it was tracked from, None for the first.
            rows: (n,) rows of that keyframe found in the view.
            pixels: (n, 2) where.
        """
        ids = np.empty(0, np.int64) if tracked is None else tracked.landmark_ids[rows]
        pixels, first, first_at = self._first(view, T_world_body, tracked, rows, pixels)
        expected = self._expected_disparity(T_world_body, ids)
        return Seen(self._features(view, right, pixels, expected), ids, pixels, first, first_at)

    def add(
        self, view: View, T_world_body: Array, seen: Seen, parent: int, covariance: Array
    ) -> Reference:
        """Add a keyframe with its landmarks and observations to the map.

        Args:
            view: the left image.
            T_world_body: (4, 4).
            seen: what was measured in it.
            parent: the keyframe it was tracked from, −1 for the first.
            covariance: (6, 6) of the pose.

        Returns:
            The keyframe as the tracker needs it.
        """
        features, pixels, first = seen.features, seen.pixels, seen.first
        keyframe_id, n = self._map.new_keyframe_id(), len(pixels)
        self._map.add_keyframe(
            Keyframe(keyframe_id, view.stamp_ns, features),
            T_world_body,
            parent=parent,
            covariance=covariance,
        )
        bearings, T = features.bearings[n:], self._rectifier.T_body_camera
        points_camera = bearings / bearings[:, 2:] * features.depth[n:, None]
        new = self._map.add_landmarks(keyframe_id, points_camera @ T[:3, :3].T + T[:3, 3])
        self._sights.remember(keyframe_id, view)
        ids = np.concatenate([seen.landmark_ids, new])
        self._map.add_observations(keyframe_id, ids, np.arange(len(ids)))
        keypoints = np.concatenate([pixels, features.keypoints[n:].astype(np.float64)])
        return self._reference(
            keyframe_id,
            view,
            ids,
            keypoints,
            features.descriptors,
            np.concatenate(
                [np.where(first < 0, keyframe_id, first), np.full(len(new), keyframe_id)]
            ),
            np.concatenate([seen.first_at, keypoints[n:]]),
        )

    def refreshed(self, reference: Reference) -> Reference:
        """Return a keyframe as the tracker needs it, after the mapper has changed the map."""
        r = reference
        return self._reference(
            r.keyframe_id,
            r.view,
            r.landmark_ids,
            r.keypoints,
            r.descriptors,
            r.first_keyframe,
            r.first_keypoint,
        )

    def _features(self, view: View, right: Image, pixels: Array, expected: Array) -> Features:
        """Gather the tracked pixels, then new corners with depth, as features."""
        wanted = self._config.features.count - len(pixels)
        fresh, described = self._association.extend(view, pixels, wanted)
        keypoints = np.concatenate([pixels, fresh])
        disparity = self._disparity(view, right, keypoints, expected)
        fb = self._rectifier.camera.fx * self._rectifier.baseline
        depth = fb / np.where(disparity > MIN_DISPARITY_PX, disparity, np.nan)
        # Keep all that is tracked, and of what is new only what has depth.
        keep = np.isfinite(depth) | (np.arange(len(depth)) < len(pixels))
        descriptors = np.concatenate([self._association.descriptors_at(view, pixels), described])
        return Features(
            keypoints[keep].astype(np.float32),
            descriptors[keep],
            self._rectifier.camera.unproject(keypoints[keep]),
            depth[keep],
            np.zeros(int(keep.sum()), np.uint8),
        )

    def _first(
        self, view: View, T_world_body: Array, tracked: Reference | None, rows: Index, pixels: Array
    ) -> tuple[Array, Index, Array]:
        """Align tracked points to their first sights; −1 for those that start afresh here."""
        if tracked is None or self._config.tracking.association != "flow":
            return pixels, np.full(len(pixels), -1), pixels
        pixels, kept = self._sights.align(view, T_world_body, tracked, rows, pixels)
        keyframes = np.where(kept, tracked.first_keyframe[rows], -1)
        return pixels, keyframes, np.where(kept[:, None], tracked.first_keypoint[rows], pixels)

    def _reference(
        self,
        keyframe_id: int,
        view: View,
        ids: Index,
        keypoints: Array,
        descriptors: NDArray[np.uint8],
        first_keyframe: Index,
        first_keypoint: Array,
    ) -> Reference:
        """Add what the map knows now, and leave out landmarks that are gone."""
        points = self._map.points_world(ids)
        T = self._map.T_world_body(keyframe_id) @ self._rectifier.T_body_camera
        depth = (points - T[:3, 3]) @ T[:3, 2]
        good = np.isfinite(depth) & (depth > 0)
        return Reference(
            keyframe_id,
            view,
            ids[good],
            keypoints[good],
            descriptors[good],
            self._map.count_observers(ids[good]),
            depth[good],
            first_keyframe[good],
            first_keypoint[good],
        )

    def _expected_disparity(self, T_world_body: Array, landmark_ids: Index) -> Array:
        T = T_world_body @ self._rectifier.T_body_camera
        depth = (self._map.points_world(landmark_ids) - T[:3, 3]) @ T[:3, 2]
        return np.asarray(
            self._rectifier.camera.fx * self._rectifier.baseline / np.maximum(depth, 1e-3)
        )

    def _disparity(self, view: View, right: Image, keypoints: Array, expected: Array) -> Array:
        image = self._rectifier.rectify(right, "right")
        config = self._config.stereo
        if config.method == "sgbm":
            dense = sgbm_disparity(view.image, image, config)
            columns, rows = np.round(keypoints).astype(np.int64).T
            rows, columns = rows.clip(0, len(dense) - 1), columns.clip(0, dense.shape[1] - 1)
            return np.asarray(dense[rows, columns], np.float64)
        low = np.full(len(keypoints), -2.0)
        high = np.full(len(keypoints), float(config.max_disparity_px))
        low[: len(expected)], high[: len(expected)] = expected - 4.0, expected + 4.0
        return match_sparse(view.image, image, keypoints, config, low, high)

    def check_order(self, view: View, right: Image) -> None:
        """Raise if the two images match better the other way round.

        Raises:
            CalibrationError: if left and right are swapped.
        """
        image = self._rectifier.rectify(right, "right")
        points, _ = self._association.extend(view, np.empty((0, 2)), 200)
        matched = np.isfinite(match_sparse(view.image, image, points, self._config.stereo)).sum()
        mirrored = match_sparse(
            np.ascontiguousarray(view.image[:, ::-1]),
            np.ascontiguousarray(image[:, ::-1]),
            np.stack([view.image.shape[1] - 1 - points[:, 0], points[:, 1]], axis=1),
            self._config.stereo,
        )
        swapped = int((mirrored > 1.0).sum())
        if swapped >= 30 and swapped > 2 * matched:
            raise CalibrationError(
                f"stereo pair: {swapped} of {len(points)} points have negative disparity, "
                f"{matched} positive: left and right are swapped, exchange the two cameras"
            )
