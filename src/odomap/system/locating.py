"""Locating: where the body is at a new frame, from the landmarks of a reference keyframe.

A constant velocity predicts the pose; the landmarks are projected with it, found in the image
(see `association`), and the pose that agrees with them is solved for. A landmark's depth is only
known to σ_z / z = σ_d / d; by how much that blurs its projection in the new view is added to the
noise of the observation, so that a near point just created does not pull harder than it knows.

Reference: Klein, Murray, "Parallel Tracking and Mapping for Small AR Workspaces", ISMAR 2007.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.backend.motion import MotionSolution, Sightings, solve_motion
from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_inverse
from odomap.system.association import Association, Reference, View
from odomap.system.dispute import settle
from odomap.system.ranging import UNIT_BASELINE
from odomap.system.uncertainty import NoiseConfig
from odomap.vision.flow import facing_warp

__all__ = ["Located", "Locator", "variance_factor"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Located:
    """A frame placed against a reference.

    Attributes:
        T_world_body: (4, 4).
        covariance: (6, 6) given the reference keyframe, right tangent.
        rows: (n,) rows of the reference that were found in the image.
        pixels: (n, 2) where.
        inliers: (n,) bool, those that agree with the pose.
        expected_rows: (m,) rows of the reference that were expected in the image.
    """

    T_world_body: Array
    covariance: Array
    rows: NDArray[np.int64]
    pixels: Array
    inliers: NDArray[np.bool_]
    expected_rows: NDArray[np.int64]

    @property
    def expected(self) -> int:
        """How many landmarks were expected in the image."""
        return len(self.expected_rows)

    @property
    def num_inliers(self) -> int:
        """Observations that agree with the pose."""
        return int(self.inliers.sum())


class Locator:
    """Finds the pose of views against a reference keyframe."""

    def __init__(
        self,
        association: Association,
        camera: Camera,
        T_body_camera: Array,
        noise: NoiseConfig,
    ) -> None:
        self._association, self._camera, self._noise = association, camera, noise
        self._T_body_camera, self._T_camera_body = T_body_camera, se3_inverse(T_body_camera)

    def locate(
        self,
        view: View,
        reference: Reference,
        points_world: Array,
        is_settled: NDArray[np.bool_],
        T_world_reference: Array,
        T_world_body: Array,
    ) -> Located:
        """Place a view.

        Args:
            view: the image.
            reference: the keyframe whose landmarks are looked for.
            points_world: (N, 3) those landmarks now; NaN where gone.
            is_settled: (N,) whether several keyframes agree on each.
            T_world_reference: (4, 4) the keyframe's pose now.
            T_world_body: (4, 4) predicted pose of the view.

        Returns:
            The pose, to be believed if enough inliers agree.
        """
        T_camera_world = self._T_camera_body @ se3_inverse(T_world_body)
        T_reference_camera = se3_inverse(T_world_reference @ self._T_body_camera) @ se3_inverse(
            T_camera_world
        )
        points_camera = points_world @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        guess = self._project(points_camera)
        rows = np.flatnonzero(
            (points_camera[:, 2] > 0.05)
            & self._camera.is_inside(np.nan_to_num(guess, nan=-1.0), 2.0)
        )
        warp = facing_warp(points_camera[rows], T_reference_camera)
        pixels, found = self._association.find(
            reference.view,
            reference.keypoints[rows],
            reference.descriptors[rows],
            view,
            guess[rows],
            warp,
        )
        expected, rows, pixels = rows, rows[found], pixels[found]
        weights = self._weights(points_camera[rows], T_reference_camera, reference, rows)
        sightings = Sightings(
            points_world[rows], self._normalised(pixels), np.full(len(rows), np.nan), weights
        )

        def solve(which: NDArray[np.bool_], T: Array, iterations: int) -> MotionSolution:
            return self._solve(T, sightings.at(which), iterations)

        solution = settle(solve, is_settled[rows], T_world_body)
        factor = self._noise.overlap * variance_factor(solution)
        return Located(
            solution.T_world_body,
            factor * solution.covariance,
            rows,
            pixels,
            solution.inliers & solution.converged,
            expected,
        )

    def _solve(self, T_world_body: Array, sightings: Sightings, iterations: int) -> MotionSolution:
        return solve_motion(
            T_world_body,
            self._T_camera_body,
            UNIT_BASELINE,
            sightings,
            iterations=iterations,
        )

    def _project(self, points_camera: Array) -> Array:
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = points_camera[:, :2] / points_camera[:, 2:]
        c = self._camera
        return np.asarray(xy * (c.fx, c.fy) + (c.cx, c.cy))

    def _normalised(self, pixels: Array) -> Array:
        c = self._camera
        return np.asarray((pixels - (c.cx, c.cy)) / (c.fx, c.fy))

    def _weights(
        self,
        points_camera: Array,
        T_reference_camera: Array,
        reference: Reference,
        rows: NDArray[np.int64],
    ) -> Array:
        """Return (n, 2) inverse standard deviations in normalised image coordinates."""
        f = self._camera.fx
        # Moving a point along its ray from the reference moves its projection here by `slide`.
        origin = se3_inverse(T_reference_camera)[:3, 3]
        ray = points_camera - origin
        depth = points_camera[:, 2:]
        slide = (
            f
            * np.linalg.norm(ray[:, :2] - points_camera[:, :2] / depth * ray[:, 2:], axis=1)
            / depth[:, 0]
        )
        sigma = np.hypot(self._noise.position_px, slide * np.minimum(reference.relative[rows], 1.0))
        return np.stack([f / sigma, np.ones(len(sigma))], axis=1)


def variance_factor(solution: MotionSolution) -> float:
    """Return χ² per degree of freedom of the inliers: 1 where the weights say the truth."""
    freedom = 2 * int(solution.inliers.sum()) - 6
    return float(solution.chi2[solution.inliers].sum() / freedom) if freedom > 0 else 1.0
