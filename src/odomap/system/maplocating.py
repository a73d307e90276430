"""Locating in a map: where the body is at a new frame, by guided search for landmarks.

First the landmarks that the frame before has shown are looked for around where the predicted
motion puts them; they give a pose. With that all others of the local map are projected, and looked
for nearby; all together give the pose again. Descriptors say which feature is which landmark, the
level of the pyramid how sure its position is: σ s^l.

Cost: grows with the local map, not with the map.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, sections V-B and V-D.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.backend.motion import MotionSolution, Sightings, solve_motion
from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_inverse
from odomap.system.association import View
from odomap.system.dispute import settle
from odomap.system.localmap import LocalMap, LocalMapConfig, expect
from odomap.system.locating import Located, variance_factor
from odomap.system.maplocating_kernels import weigh
from odomap.system.ranging import UNIT_BASELINE
from odomap.system.uncertainty import NoiseConfig
from odomap.vision.matching import KeypointGrid, MatchConfig, match_projected
from odomap.vision.orb import OrbConfig

__all__ = ["MapLocator"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class MapLocator:
    """Finds the pose of views in a local map.

    Args:
        camera: the pinhole.
        T_body_camera: (4, 4) its mount.
        orb, matching, search, noise: sections of the configuration.
    """

    def __init__(
        self,
        camera: Camera,
        T_body_camera: Array,
        orb: OrbConfig,
        matching: MatchConfig,
        search: LocalMapConfig,
        noise: NoiseConfig,
    ) -> None:
        self._camera, self._T_camera_body = camera, se3_inverse(T_body_camera)
        self._pinhole = np.array([*camera.intrinsics, *camera.resolution], np.float64)
        self._orb, self._matching, self._search, self._noise = orb, matching, search, noise

    def locate(
        self, view: View, local: LocalMap, likely: Index, T_world_body: Array, needed: int
    ) -> Located:
        """Place a view.

        Args:
            view: its features.
            local: the landmarks around.
            likely: (n,) rows of those that should be there, since the last frame has shown them.
            T_world_body: (4, 4) predicted pose.
            needed: inliers without which a look around is of no use.

        Returns:
            The pose, to be believed if enough inliers agree.
        """
        width, height = self._camera.resolution
        grid = KeypointGrid.of(view.corners.keypoints, (height, width))
        rows, found, expected = self._search_for(
            view, grid, local, likely, T_world_body, self._search.first_radius_px
        )
        solution = self._settled(view, local, rows, found, T_world_body)
        if int(solution.inliers.sum()) < needed or not solution.converged:
            return self._located(view, rows, found, solution, expected)
        rows, found = rows[solution.inliers], found[solution.inliers]
        is_other = np.ones(len(local), np.bool_)
        is_other[rows] = False
        others = np.flatnonzero(is_other)
        more, at, around = self._search_for(
            view, grid, local, others, solution.T_world_body, self._search.radius_px, found
        )
        rows, found = np.concatenate([rows, more]), np.concatenate([found, at])
        solution = self._settled(view, local, rows, found, solution.T_world_body)
        expected = np.concatenate([rows[: len(rows) - len(more)], around])
        return self._located(view, rows, found, solution, expected)

    def _search_for(
        self,
        view: View,
        grid: KeypointGrid,
        local: LocalMap,
        rows: Index,
        T_world_body: Array,
        radius_px: float,
        claimed: Index | None = None,
    ) -> tuple[Index, Index, Index]:
        """Match landmarks to features; return rows, features, and the rows that were expected."""
        T_camera_world = self._T_camera_body @ se3_inverse(T_world_body)
        scale, levels = self._orb.scale, self._orb.levels
        there = expect(local, rows, T_camera_world, self._camera, scale, levels)
        index = match_projected(
            local.views.descriptors[there.rows],
            there.pixels,
            (radius_px * scale ** np.arange(levels, dtype=np.float64))[there.level],
            there.level - 1,
            there.level + 1,
            view.descriptors,
            view.corners.keypoints,
            view.corners.level,
            grid,
            self._matching,
        )
        matched = index >= 0
        if claimed is not None:
            is_free = np.ones(len(view.descriptors), np.bool_)
            is_free[claimed] = False
            matched &= is_free[index]
        return there.rows[matched], index[matched], there.rows

    def _settled(
        self, view: View, local: LocalMap, rows: Index, found: Index, T_world_body: Array
    ) -> MotionSolution:
        """Find the pose that agrees with matches; in a dispute, with those of settled landmarks."""

        def solve(which: NDArray[np.bool_], T: Array, iterations: int) -> MotionSolution:
            return self._solve(view, local, rows[which], found[which], T, iterations)

        return settle(solve, local.is_settled[rows], T_world_body)

    def _solve(
        self,
        view: View,
        local: LocalMap,
        rows: Index,
        found: Index,
        T_world_body: Array,
        iterations: int,
    ) -> MotionSolution:
        """Find the pose that agrees with matches of landmarks and features."""
        T_camera_world = self._T_camera_body @ se3_inverse(T_world_body)
        levels = np.arange(self._orb.levels, dtype=np.float64)
        n = len(rows)
        points, xy, weights = np.empty((n, 3)), np.empty((n, 2)), np.empty((n, 2))
        weigh(
            local.views.points_world,
            local.views.normals,
            local.views.distance,
            local.relative,
            rows,
            T_camera_world,
            self._pinhole,
            view.corners.keypoints,
            view.corners.level,
            found,
            self._noise.feature_px * self._orb.scale**levels,
            points,
            xy,
            weights,
        )
        sightings = Sightings(points, xy, np.full(n, np.nan), weights)
        return solve_motion(
            T_world_body,
            self._T_camera_body,
            UNIT_BASELINE,
            sightings,
            iterations=iterations,
        )

    def _located(
        self, view: View, rows: Index, found: Index, solution: MotionSolution, expected: Index
    ) -> Located:
        return Located(
            solution.T_world_body,
            self._noise.overlap * variance_factor(solution) * solution.covariance,
            rows,
            view.corners.keypoints[found].astype(np.float64),
            solution.inliers & solution.converged,
            expected,
        )
