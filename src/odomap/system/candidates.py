"""Candidates: corners on their way to becoming landmarks, followed until their depth is known.

A corner without a measured depth is a ray. It is followed from keyframe to keyframe, expected at
the depth of the landmarks around it, and located against its first sight, as landmarks are. Seen
from far enough aside, by the parallax α between its rays, it is triangulated, and its depth is
known to

    σ_z / z = σ_x / (f α).

Below the least parallax it stays a candidate; where its rays do not meet it is dropped.

Cost: one alignment per candidate and keyframe.

Reference: Klein, Murray, "Parallel Tracking and Mapping for Small AR Workspaces", ISMAR 2007.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_inverse
from odomap.geometry.triangulate import triangulate
from odomap.maps.map import Map
from odomap.system.association import Association, Candidates, Reference, View
from odomap.system.firstsight import FirstSights
from odomap.system.visualconfig import CandidateConfig
from odomap.vision.flow import facing_warp

__all__ = ["CandidateConfig", "Followed", "Follower"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

NEIGHBOURS = 5
"""Landmarks around a candidate whose depth it is expected at."""


@dataclass(frozen=True, eq=False)
class Followed:
    """Candidates found again in a new view.

    Attributes:
        pixels: (C, 2) where.
        points_world: (C, 3), NaN while the parallax is too small.
        history: the candidates as they were; one that starts afresh has none.
    """

    pixels: Array
    points_world: Array
    history: Candidates

    @staticmethod
    def none(views: int) -> "Followed":
        """Return no candidates."""
        empty = np.empty((0, 2))
        return Followed(empty, np.empty((0, 3)), no_candidates(views))


def no_candidates(views: int) -> Candidates:
    """Return none, with room for that many views."""
    rows = np.empty((0, views), np.int64)
    return Candidates(np.empty((0, 2)), np.empty((0, 0), np.uint8), np.empty((0, 2)), rows, rows)


class Follower:
    """Follows candidates and triangulates them.

    Args:
        map: where keyframes are.
        camera: the pinhole.
        T_body_camera: (4, 4) its mount.
        association: how points are found again.
        sights: first sights of points; None where association does without.
        config: thresholds.
    """

    def __init__(
        self,
        map: Map,
        camera: Camera,
        T_body_camera: Array,
        association: Association,
        sights: FirstSights | None,
        config: CandidateConfig,
    ) -> None:
        self._map, self._camera, self._T_body_camera = map, camera, T_body_camera
        self._association, self._sights, self._config = association, sights, config

    def follow(self, reference: Reference, view: View, T_world_body: Array) -> Followed:
        """Find a keyframe's candidates in a new view.

        Args:
            reference: the keyframe.
            view: the image.
            T_world_body: (4, 4) its pose.
        """
        candidates = reference.candidates
        expected = self._expected(reference)
        if not len(candidates) or not len(expected):
            return Followed.none(self._config.views)
        T_world_camera = T_world_body @ self._T_body_camera
        points_camera = (expected - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        ahead = np.flatnonzero(points_camera[:, 2] > 0)
        guess = self._camera.project(points_camera[ahead])
        inside = self._camera.is_inside(guess, 2.0)
        rows, guess = ahead[inside], guess[inside]
        T_world_reference = self._map.T_world_body(reference.keyframe_id) @ self._T_body_camera
        warp = facing_warp(points_camera[rows], se3_inverse(T_world_reference) @ T_world_camera)
        known = candidates.keypoints[rows], candidates.descriptors[rows]
        pixels, found = self._association.find(reference.view, *known, view, guess, warp)
        history, pixels = candidates.at(rows[found]), pixels[found]
        return self._located(view, T_world_body, history, pixels, expected[rows[found]])

    def _located(
        self, view: View, T_world_body: Array, history: Candidates, pixels: Array, expected: Array
    ) -> Followed:
        """Align candidates to their first sights, and triangulate them."""
        if self._sights is not None and len(pixels):
            pixels, kept = self._sights.align(
                view, T_world_body, expected, history.keyframes[:, 0], history.first_at, pixels
            )
            history = history.afresh(~kept)
        points, parallax, errors, ahead = self._triangulated(T_world_body, history, pixels)
        enough = parallax >= np.radians(self._config.min_parallax_deg)
        meet = errors * self._camera.fx <= self._config.max_error_px
        # Rays that nearly run parallel may meet anywhere, even behind, and mean nothing yet.
        sound = ~enough | (ahead & meet)
        points = np.where((enough & ahead & meet)[:, None], points, np.nan)
        keep = np.flatnonzero(sound)
        return Followed(pixels[keep], points[keep], history.at(keep))

    def _triangulated(
        self, T_world_body: Array, history: Candidates, pixels: Array
    ) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """Return points, parallax, errors on the plane z = 1, and whether they lie ahead."""
        ids = np.unique(history.keyframes[history.keyframes >= 0])
        Ts = np.concatenate([self._map.Ts_world_body(ids), T_world_body[None]])
        seen_at = np.full((len(Ts), len(pixels), 2), np.nan)
        for k, keyframe_id in enumerate(ids.tolist()):
            if not self._map.is_keyframe_alive(keyframe_id):
                continue  # it was culled
            features = self._map.keyframe(keyframe_id).features
            if features is None:
                continue  # it has left the window, and what it saw is forgotten
            which, view = np.nonzero(history.keyframes == keyframe_id)
            bearings = features.bearings[history.rows[which, view]]
            seen_at[k, which] = bearings[:, :2] / bearings[:, 2:]
        seen_at[-1] = self._camera.undistort(pixels)
        if len(Ts) < 2:
            nothing = np.zeros(len(pixels))
            return np.full((len(pixels), 3), np.nan), nothing, nothing, nothing > 0
        # One step: the bundle adjustment takes more.
        found = triangulate(Ts @ self._T_body_camera, seen_at, iterations=1)
        return found.points_world, found.parallax, found.errors, found.ahead

    def _expected(self, reference: Reference) -> Array:
        """Return (C, 3) where candidates would be at the depth of the landmarks around them."""
        points = self._map.points_world(reference.landmark_ids)
        T = self._map.T_world_body(reference.keyframe_id) @ self._T_body_camera
        depth = (points - T[:3, 3]) @ T[:3, 2]
        good = np.flatnonzero(depth > 0)
        if not good.size:
            return np.empty((0, 3))
        at = reference.candidates.keypoints
        count = min(NEIGHBOURS, good.size)
        _, near = cKDTree(reference.keypoints[good]).query(at, np.arange(1, count + 1))
        inverse = np.median(1.0 / depth[good][near], axis=1)
        rays = self._camera.unproject(at)
        return np.asarray(rays / (rays[:, 2] * inverse)[:, None] @ T[:3, :3].T + T[:3, 3])
