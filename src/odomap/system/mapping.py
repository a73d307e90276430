"""Local mapping of an odometry: bundle adjustment over the last keyframes.

The newest keyframes and the landmarks they see are adjusted together, held in place by the
keyframes just before them. Observations that disagree with the solution have little weight in it
(Huber) and are dropped for the next; keyframes that leave the window are retired, so that memory
stays flat.

Covariance. The window gives each keyframe's covariance S given the fixed ones. Its uncertainty in
the world adds that of the keyframe a that ties the window, as it was when a was the newest:

    Σ_k = Ad(T_k_a) Σ_a Ad(T_k_a)ᵀ + S_k.

Spans of one window each are chained this way, not neighbouring keyframes: consecutive steps share
their landmarks and with it their errors, which a sum over every step would count again and again.

Reference: Mouragnon et al., "Real Time Localization and 3D Reconstruction", CVPR 2006; Barfoot,
Furgale, "Associating Uncertainty With Three-Dimensional Poses", T-RO 2014.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.backend.bundle import Bundle, BundleConfig, BundleSolution, solve_bundle
from odomap.geometry.lie import se3_adjoint, se3_inverse
from odomap.maps.map import Map
from odomap.maps.snapshot import Snapshot

__all__ = ["StereoNoise", "WindowConfig", "WindowMapper"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class WindowConfig:
    """The window of keyframes adjusted together."""

    size: int = 8
    """Keyframes adjusted."""
    fixed: int = 2
    """Older keyframes that hold them in place."""
    gate: float = 3.5
    """Residual, in standard deviations, beyond which an observation is dropped."""


@dataclass(frozen=True)
class StereoNoise:
    """Standard deviations of what is measured in the images."""

    position_px: float = 0.4
    """Of a tracked point's position."""
    disparity_px: float = 0.8
    """Of a stereo match's disparity."""


class WindowMapper:
    """Adjusts the window that ends at each new keyframe.

    Args:
        map: where keyframes and landmarks are.
        T_body_camera: (4, 4) mount of the rectified left camera.
        focal: of the rectified camera, pixels.
        baseline: metres.
    """

    def __init__(
        self,
        map: Map,
        T_body_camera: Array,
        focal: float,
        baseline: float,
        window: WindowConfig,
        bundle: BundleConfig,
        noise: StereoNoise,
    ) -> None:
        self._map, self._window, self._bundle, self._noise = map, window, bundle, noise
        self._T_camera_body = se3_inverse(T_body_camera)
        self._focal, self._baseline = focal, baseline
        self._recent: list[int] = []
        self.last: BundleSolution | None = None

    def restart(self) -> None:
        """Begin a new window: the keyframes so far share no landmarks with those to come."""
        self._map.retire_keyframes(self._recent)
        self._recent = []

    def add(self, keyframe_id: int) -> None:
        """Take in a keyframe that is in the map already, and adjust the window it ends."""
        self._recent.append(keyframe_id)
        if len(self._recent) < 2:
            return
        free, fixed = self._recent[-self._window.size :], self._recent[: -self._window.size]
        if not fixed:
            free, fixed = free[1:], free[:1]
        snapshot = self._map.snapshot(free, fixed)
        if not len(snapshot.obs_keyframe):
            return
        bundle = self._make_bundle(snapshot)
        solution = solve_bundle(bundle, self._bundle)
        wrong = solution.chi2 > self._window.gate**2
        covariances = self._world_covariances(snapshot, solution)
        self._map.apply(
            snapshot.solved(
                solution.Ts_world_body,
                solution.points_world,
                dropped=np.flatnonzero(wrong),
                covariances=covariances,
            )
        )
        self.last = solution
        leaving = self._recent[: -(self._window.size + self._window.fixed - 1)]
        self._map.retire_keyframes(leaving)
        self._recent = self._recent[len(leaving) :]

    def _make_bundle(self, snapshot: Snapshot) -> Bundle:
        """Gather what the keyframes measured, in the order of the snapshot's observations."""
        xy = np.empty((len(snapshot.obs_keyframe), 2))
        disparity = np.full(len(xy), np.nan)
        for k, keyframe in enumerate(snapshot.keyframes):
            rows = np.flatnonzero(snapshot.obs_keyframe == k)
            if not rows.size or keyframe.features is None:
                continue
            seen = snapshot.obs_keypoint[rows]
            bearings = keyframe.features.bearings[seen]
            xy[rows] = bearings[:, :2] / bearings[:, 2:]
            disparity[rows] = self._baseline / keyframe.features.depth[seen]
        sigma = np.array([self._noise.position_px, self._noise.disparity_px])
        zeros = np.zeros(len(xy), np.int64)
        return Bundle(
            snapshot.Ts_world_body,
            snapshot.is_fixed,
            snapshot.points_world,
            self._T_camera_body[None],
            np.array([self._baseline]),
            snapshot.obs_keyframe,
            snapshot.obs_landmark,
            zeros,
            xy,
            disparity,
            np.tile(self._focal / sigma, (len(xy), 1)),
        )

    def _world_covariances(self, snapshot: Snapshot, solution: BundleSolution) -> Array:
        """Chain the covariances of the newest keyframe; older ones keep what they had."""
        covariances = np.stack([self._map.covariance(int(k)) for k in snapshot.keyframe_ids])
        fixed, free = np.flatnonzero(snapshot.is_fixed), np.flatnonzero(~snapshot.is_fixed)
        anchor, newest = fixed[-1], free[-1]
        Ts = solution.Ts_world_body
        Ad = se3_adjoint(se3_inverse(Ts[newest]) @ Ts[anchor])
        factor = max(1.0, solution.variance_factor)
        covariances[newest] = (
            Ad @ covariances[anchor] @ Ad.T + factor * solution.covariances[newest]
        )
        return covariances
