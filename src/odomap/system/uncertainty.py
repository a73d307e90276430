"""Uncertainty of an odometry's keyframes: what noise and what the calibration do to the path.

Noise. A window gives its newest keyframe's covariance S given the keyframe a that ties the window.
In the world it adds to that of a, as it was when a was the newest,

    Σ_k = Ad(T_k_a) Σ_a Ad(T_k_a)ᵀ + f S_k.

Spans of one window each are chained: neighbouring keyframes share their landmarks and so their
errors. f is the variance factor of the residuals times one for errors that observations share.

Scale. A single camera passes the scale on in the landmarks; where a step is too long, all that
follows is. So Ad and Σ are those of Sim(3), and a window without measured depth adds the relative
error of its length, uᵀ S_t u / |t|² with u = t / |t|, as a scale that later poses inherit. One
too short for new landmarks adds less: those there are keep the scale of a camera that stands.

Calibration. No data averages out what the rig says wrongly. An error δ of all inverse depths, an
offset or a slope across the image, moves the newest keyframe by k_k (the solver's response) given
a, along the path by g_k = Ad(T_k_a) g_a + k_k; a camera turned by θ against its mount moves a pose
T by (Ad(T⁻¹) − I) θ. Both are carried as responses and squared when asked for ("consider"):

    Σ = Σ_k + Σ_δ σ_δ² g_k g_kᵀ + σ_θ² M Mᵀ.

Reference: Schmidt, "Application of state-space methods to navigation problems", 1966; Barfoot,
Furgale, "Associating Uncertainty With Three-Dimensional Poses", T-RO 2014.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.backend.bundle import BundleSolution
from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_adjoint, se3_inverse, sim3_adjoint
from odomap.system.visualconfig import NoiseConfig

__all__ = ["Calibration", "Drift", "NoiseConfig"]

Array = NDArray[np.float64]

LEAST_PARALLAX = 0.02
"""Radians; a camera that moves by less of the depth makes no landmarks that carry the scale on."""


@dataclass(frozen=True, eq=False)
class Drift:
    """How unsure a keyframe's pose in the world is, apart from what is not random.

    Attributes:
        covariance: (7, 7) due to noise, right tangent of Sim(3): translation, rotation, log scale.
        responses: (3, 6) motion of the pose per 1/m of error in all measured inverse depths: an
            offset, a slope in x, a slope in y of the normalised image.
    """

    covariance: Array
    responses: Array

    @staticmethod
    def begun(covariance: Array) -> "Drift":
        """Return that of a first keyframe, (6, 6); the scale begins here."""
        return Drift(np.pad(covariance, (0, 1)), np.zeros((3, 6)))

    def stretched(self, by: float) -> "Drift":
        """Return the same drift with lengths in other units, so many for each of these."""
        units = np.array([by] * 3 + [1.0] * 4)
        return Drift(self.covariance * np.outer(units, units), self.responses * units[:6])

    def onwards(
        self,
        T_newest_anchor: Array,
        solution: BundleSolution,
        newest: int,
        overlap: float,
        depth: float | None,
    ) -> "Drift":
        """Return the drift of a window's newest keyframe, this being that of its anchor.

        Args:
            T_newest_anchor: (4, 4).
            solution: of the window.
            newest: its row in the solution.
            overlap: factor for errors that observations share.
            depth: of the landmarks, where nothing in the window measures its size; else None.
        """
        Ad = sim3_adjoint(T_newest_anchor)
        to_tangent = np.eye(7, 6)
        t = T_newest_anchor[:3, 3]  # the anchor as the newest keyframe sees it
        if depth is not None:
            to_tangent[6, :3] = -t / max(float(t @ t), (LEAST_PARALLAX * depth) ** 2)
        S = overlap * solution.variance_factor * solution.covariances[newest]
        return Drift(
            Ad @ self.covariance @ Ad.T + to_tangent @ S @ to_tangent.T,
            self.responses @ Ad[:6, :6].T + solution.disparity_responses[newest],
        )


@dataclass(frozen=True, eq=False)
class Calibration:
    """How far the calibration may be off, as standard deviations.

    Attributes:
        inverse_depth: (3,) of measured inverse depths, 1/m: offset, slopes in x and y.
        direction: of the camera's direction about each axis, radians.
        Ad_body_camera: (6, 6) adjoint of the camera's mount.
    """

    inverse_depth: Array
    direction: float
    Ad_body_camera: Array

    @staticmethod
    def of(
        noise: NoiseConfig, camera: Camera, T_body_camera: Array, inverse_depth: float
    ) -> "Calibration":
        """Gather the deviations; slopes reach theirs at the image's rim.

        Args:
            noise: of the images.
            camera: the pinhole.
            T_body_camera: (4, 4) its mount.
            inverse_depth: how far all measured inverse depths may be off together, 1/m.
        """
        rim = 0.5 * camera.width / camera.fx
        return Calibration(
            inverse_depth / np.array([1.0, rim, rim]),
            noise.calibration_px / camera.fx,
            se3_adjoint(T_body_camera),
        )

    def total(self, drift: Drift, T_world_body: Array) -> Array:
        """Return the (6, 6) covariance of a pose, calibration included."""
        mount = (se3_adjoint(se3_inverse(T_world_body)) - np.eye(6)) @ self.Ad_body_camera[:, 3:]
        errors = self.inverse_depth[:, None] * drift.responses
        return np.asarray(
            drift.covariance[:6, :6] + errors.T @ errors + self.direction**2 * mount @ mount.T
        )
