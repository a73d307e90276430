"""Making keyframes: depth for what is tracked, new landmarks where nothing is.

The points tracked into the image keep their landmarks; corners are detected in the gaps between
them. Where the rig measures depth (`ranging`), points have it at once, and new ones with depth
become landmarks. Those without are followed until their parallax tells it (`candidates`), which is
all there is for a single camera.

Reference: Mur-Artal, Tardós, "ORB-SLAM2", T-RO 2017, section III-A.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_inverse
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.system.association import Association, Candidates, Reference, View
from odomap.system.candidates import Followed, Follower
from odomap.system.config import Config
from odomap.system.depthbias import DepthBias, bias_at
from odomap.system.eye import Eye
from odomap.system.firstsight import FirstSights
from odomap.system.ranging import Ranger
from odomap.vision.features import Features

__all__ = ["Keyframes", "Seen"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Seen:
    """What a view that may become a keyframe shows: rows of its features, in this order.

    Attributes:
        features: of the n tracked points, the c candidates, then what is new.
        landmark_ids: (n,) of the tracked points.
        pixels: (n, 2) where they are.
        is_ranged: (n,) whether their depth was measured once.
        first: (n,) keyframe each was first seen in, −1 for here.
        first_at: (n, 2) where in its image.
        followed: the candidates.
    """

    features: Features
    landmark_ids: Index
    pixels: Array
    is_ranged: NDArray[np.bool_]
    first: Index
    first_at: Array
    followed: Followed


class Keyframes:
    """Turns views into keyframes of a map.

    Args:
        map: where they go.
        eye: the camera.
        ranger: measures depth; None for a single camera.
        bias: what all measured depths are off by, as far as known.
        association: how points are found.
        config: all sections.
    """

    def __init__(
        self,
        map: Map,
        eye: Eye,
        ranger: Ranger | None,
        bias: DepthBias,
        association: Association,
        config: Config,
    ) -> None:
        self._map, self._eye, self.ranger, self._bias = map, eye, ranger, bias
        self._association, self._config = association, config
        keep = config.window.size + config.window.fixed
        self._sights = (
            FirstSights(map, eye.camera, eye.T_body_camera, config.flow, keep)
            if association.follows
            else None
        )
        self._follower = Follower(
            map, eye.camera, eye.T_body_camera, association, self._sights, config.candidates
        )

    def missing(self, frame: Frame) -> str:
        """Say what a frame lacks to become a keyframe; empty if it has all."""
        return "" if self.ranger is None else self.ranger.missing(frame)

    def begin(self, frame: Frame, view: View) -> Seen:
        """Find the points of a view that nothing was tracked into, without touching the map."""
        none = np.empty(0, np.int64)
        features = self._features(frame, view, np.empty((0, 2)), self._nothing(), np.empty(0))
        at, ranged = np.empty((0, 2)), np.empty(0, np.bool_)
        return Seen(features, none, at, ranged, none, at, self._nothing())

    def seen_first(self, view: View, pixels: Array, points_world: Array) -> Seen:
        """Return the corners of a first view whose points are known from a second.

        Args:
            view: the first one.
            pixels: (c, 2) corners of it.
            points_world: (c, 3), NaN where not known yet.
        """
        none, at, ranged = np.empty(0, np.int64), np.empty((0, 2)), np.empty(0, np.bool_)
        never = np.full((len(pixels), self._config.candidates.views), -1)
        descriptors = self._association.descriptors_at(view, pixels)
        followed = Followed(
            pixels, points_world, Candidates(pixels, descriptors, pixels, never, never)
        )
        features = Features(
            pixels.astype(np.float32),
            descriptors,
            self._eye.camera.unproject(pixels),
            np.full(len(pixels), np.nan),
            self._association.levels_at(view, pixels),
        )
        return Seen(features, none, at, ranged, none, at, followed)

    def measure(
        self,
        frame: Frame,
        view: View,
        T_world_body: Array,
        tracked: Reference,
        rows: Index,
        pixels: Array,
    ) -> Seen:
        """Find the points and depths of a view, without touching the map.

        Args:
            frame: as it came.
            view: its image.
            T_world_body: (4, 4).
            tracked: the keyframe it was tracked from.
            rows: (n,) rows of that keyframe found in the view.
            pixels: (n, 2) where.
        """
        ids = tracked.landmark_ids[rows]
        pixels, first, first_at = self._first(view, T_world_body, tracked, rows, pixels)
        follow = self._config.candidates.follow
        followed = self._follower.follow(tracked, view, T_world_body) if follow else self._nothing()
        expected = 1.0 / np.maximum(self._depth(T_world_body, ids), 1e-3)
        features = self._features(frame, view, pixels, followed, expected)
        return Seen(features, ids, pixels, tracked.is_ranged[rows], first, first_at, followed)

    def measure_found(
        self, frame: Frame, view: View, T_world_body: Array, landmark_ids: Index, pixels: Array
    ) -> Seen:
        """Find the depths of a view whose landmarks were found one by one, not followed.

        Args:
            frame: as it came.
            view: its image.
            T_world_body: (4, 4).
            landmark_ids: (n,) landmarks found in it.
            pixels: (n, 2) at which of its features.
        """
        nothing, here = self._nothing(), np.full(len(pixels), -1)
        expected = 1.0 / np.maximum(self._depth(T_world_body, landmark_ids), 1e-3)
        features = self._features(frame, view, pixels, nothing, expected)
        is_ranged = np.isfinite(features.depth[: len(pixels)])
        return Seen(features, landmark_ids, pixels, is_ranged, here, pixels, nothing)

    def add(
        self, view: View, T_world_body: Array, seen: Seen, parent: int, covariance: Array
    ) -> Reference:
        """Add a keyframe with its landmarks and observations to the map.

        Args:
            view: the image.
            T_world_body: (4, 4).
            seen: what was measured in it.
            parent: the keyframe it was tracked from, −1 for the first.
            covariance: (6, 6) of the pose.

        Returns:
            The keyframe as the tracker needs it.
        """
        features, followed = seen.features, seen.followed
        keyframe_id, n, c = self._map.new_keyframe_id(), len(seen.pixels), len(followed.pixels)
        self._map.add_keyframe(
            Keyframe(keyframe_id, view.stamp_ns, features),
            T_world_body,
            parent=parent,
            covariance=covariance,
        )
        if self._sights is not None:
            self._sights.remember(keyframe_id, view)
        # A measured depth comes before a triangulated one.
        bearings, T = features.bearings[n:], self._eye.T_body_camera
        inverse_depth = 1.0 / features.depth[n:] - bias_at(self._bias.value, bearings)
        inverse_depth[inverse_depth <= 0] = np.nan
        local = bearings / (bearings[:, 2:] * inverse_depth[:, None])
        points_body = local @ T[:3, :3].T + T[:3, 3]
        ranged = np.isfinite(inverse_depth)
        T_body_world = se3_inverse(T_world_body)
        triangulated = followed.points_world @ T_body_world[:3, :3].T + T_body_world[:3, 3]
        points_body[:c] = np.where(ranged[:c, None], points_body[:c], triangulated)
        placed = np.flatnonzero(np.isfinite(points_body[:, 0]))
        # A map knows landmarks by 32 bytes; odometry may do with other descriptors, or none.
        binary = features.descriptors.shape[1] == 32
        described = features.descriptors[n + placed] if binary else None
        new = self._map.add_landmarks(keyframe_id, points_body[placed], described)
        ids = np.concatenate([seen.landmark_ids, new])
        rows = np.concatenate([np.arange(n), n + placed])
        self._map.add_observations(keyframe_id, ids, rows)
        history = self._history(keyframe_id, seen, placed)
        self._observed_before(keyframe_id, new, history.at(placed))
        keypoints = features.keypoints.astype(np.float64)
        keypoints[:n] = seen.pixels
        is_rest = np.ones(len(history), np.bool_)
        is_rest[placed] = False
        rest = np.flatnonzero(is_rest)
        return self._reference(
            keyframe_id,
            view,
            ids,
            keypoints[rows],
            features.descriptors[rows],
            np.concatenate([seen.is_ranged, ranged[placed]]),
            np.concatenate(
                [np.where(seen.first < 0, keyframe_id, seen.first), history.keyframes[placed, 0]]
            ),
            np.concatenate([seen.first_at, history.first_at[placed]]),
            history.at(rest) if self._config.candidates.follow else history.at(rest[:0]),
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
            r.is_ranged,
            r.first_keyframe,
            r.first_keypoint,
            r.candidates,
        )

    def _features(
        self, frame: Frame, view: View, pixels: Array, followed: Followed, expected: Array
    ) -> Features:
        """Gather what is tracked, what is followed, and new corners, as features."""
        kept = np.concatenate([pixels, followed.pixels])
        wanted = self._association.count - len(kept)
        fresh, described = self._association.extend(view, kept, max(wanted, 0))
        keypoints = np.concatenate([kept, fresh])
        depth = np.full(len(keypoints), np.nan)
        if self.ranger is not None:
            depth = 1.0 / self.ranger.measure(frame, view, keypoints, expected)
        descriptors = np.concatenate([self._association.descriptors_at(view, kept), described])
        return Features(
            keypoints.astype(np.float32),
            descriptors,
            self._eye.camera.unproject(keypoints),
            depth,
            self._association.levels_at(view, keypoints),
        )

    def _first(
        self, view: View, T_world_body: Array, tracked: Reference, rows: Index, pixels: Array
    ) -> tuple[Array, Index, Array]:
        """Align tracked points to their first sights; −1 for those that start afresh here."""
        if self._sights is None:
            return pixels, np.full(len(pixels), -1), pixels
        points = self._map.points_world(tracked.landmark_ids[rows])
        first = tracked.first_keyframe[rows], tracked.first_keypoint[rows]
        pixels, kept = self._sights.align(view, T_world_body, points, *first, pixels)
        return pixels, np.where(kept, first[0], -1), np.where(kept[:, None], first[1], pixels)

    def _history(self, keyframe_id: int, seen: Seen, placed: Index) -> Candidates:
        """Return all rows beyond the tracked ones as candidates, seen in this keyframe too."""
        n, old = len(seen.pixels), seen.followed.history
        keypoints = seen.features.keypoints[n:].astype(np.float64)
        c, views = len(old), self._config.candidates.views
        keyframes = np.full((len(keypoints), views), -1)
        rows = np.full((len(keypoints), views), -1)
        first_at = np.array(keypoints)
        keyframes[:c], rows[:c] = old.keyframes, old.rows
        known = keyframes[:, 0] >= 0
        first_at[:c][known[:c]] = old.first_at[known[:c]]
        # One that has been followed for long enough starts afresh here, unless it has a place now.
        full = keyframes[:, -1] >= 0
        full[placed] = False
        keyframes[full], rows[full], first_at[full] = -1, -1, keypoints[full]
        # This keyframe goes into the first free column of each that has one.
        unfilled = np.flatnonzero(keyframes[:, -1] < 0)
        column = np.argmax(keyframes[unfilled] < 0, axis=1)
        keyframes[unfilled, column], rows[unfilled, column] = keyframe_id, n + unfilled
        return Candidates(keypoints, seen.features.descriptors[n:], first_at, keyframes, rows)

    def _observed_before(self, keyframe_id: int, landmark_ids: Index, history: Candidates) -> None:
        """Tell the map which earlier keyframes have seen new landmarks."""
        seen_by = np.flatnonzero(np.bincount(history.keyframes[history.keyframes >= 0])).tolist()
        if seen_by == [keyframe_id]:  # which is known to see them
            return
        # Those that were culled, or have left an odometry's window, know nothing any more.
        known = [
            k
            for k in seen_by
            if self._map.is_keyframe_alive(k) and self._map.keyframe(k).features is not None
        ]
        which, view = np.nonzero(np.isin(history.keyframes, known))
        self._map.add_observations(
            history.keyframes[which, view], landmark_ids[which], history.rows[which, view]
        )

    def _reference(
        self,
        keyframe_id: int,
        view: View,
        ids: Index,
        keypoints: Array,
        descriptors: NDArray[np.uint8],
        is_ranged: NDArray[np.bool_],
        first_keyframe: Index,
        first_keypoint: Array,
        candidates: Candidates,
    ) -> Reference:
        """Add what the map knows now, and leave out landmarks that are gone."""
        T_world_body = self._map.T_world_body(keyframe_id)
        depth = self._depth(T_world_body, ids)
        good = np.isfinite(depth) & (depth > 0)
        relative = self._relative(
            T_world_body, ids[good], depth[good], is_ranged[good], first_keyframe[good]
        )
        return Reference(
            keyframe_id,
            view,
            ids[good],
            keypoints[good],
            descriptors[good],
            is_ranged[good],
            relative,
            first_keyframe[good],
            first_keypoint[good],
            candidates,
        )

    def _relative(
        self,
        T_world_body: Array,
        ids: Index,
        depth: Array,
        is_ranged: NDArray[np.bool_],
        first_keyframe: Index,
    ) -> Array:
        """Return (N,) standard deviations of depth as fractions of it."""
        relative = np.empty(len(ids))
        if self.ranger is not None:
            seen = np.maximum(self._map.count_observers(ids), 1)
            relative[:] = self.ranger.sigma * depth / np.sqrt(seen)
        far = np.flatnonzero(~is_ranged)
        if far.size:
            T, points = self._eye.T_body_camera, self._map.points_world(ids[far])
            here = points - (T_world_body @ T)[:3, 3]
            there = points - (self._map.Ts_world_body(first_keyframe[far]) @ T)[:, :3, 3]
            across = np.linalg.norm(np.cross(here, there), axis=1)
            parallax = np.arctan2(across, np.sum(here * there, axis=1))
            sigma = self._config.noise.position_px / self._eye.camera.fx
            relative[far] = sigma / np.maximum(parallax, 1e-6)
        return relative

    def _depth(self, T_world_body: Array, landmark_ids: Index) -> Array:
        T = T_world_body @ self._eye.T_body_camera
        return np.asarray((self._map.points_world(landmark_ids) - T[:3, 3]) @ T[:3, 2])

    def _nothing(self) -> Followed:
        return Followed.none(self._config.candidates.views)
