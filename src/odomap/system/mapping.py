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
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.maps.snapshot import Snapshot, Update
from odomap.system.stages import Loop
from odomap.vision.stereo import StereoNoise

__all__ = ["WindowChange", "WindowConfig", "WindowJob", "WindowMapper"]

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


class WindowMapper:
    """The mapper of an odometry: adjusts the window that ends at each new keyframe.

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

    def add(self, keyframe: Keyframe) -> "WindowJob | None":
        """Take in a keyframe that is in the map, and read the window that it ends."""
        size, fixed = self._window.size, self._window.fixed
        leaving = self._recent[: -(size + fixed - 1)]
        if not len(self._map.covisible(keyframe.id)[0]):
            leaving = self._recent  # odometry has started anew: nothing ties the window to it
        self._recent = [*self._recent[len(leaving) :], keyframe.id]
        if len(self._recent) < 2:
            self._map.retire_keyframes(leaving)
            return None
        held = max(1, len(self._recent) - size)
        snapshot = self._map.snapshot(self._recent[held:], self._recent[:held])
        anchor = int(snapshot.keyframe_ids[np.flatnonzero(snapshot.is_fixed)[-1]])
        return WindowJob(
            snapshot,
            self._make_bundle(snapshot),
            self._bundle,
            self._window.gate,
            self._map.covariance(anchor),
            tuple(leaving),
        )

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


@dataclass(frozen=True, eq=False)
class WindowJob:
    """A window read from the map, ready to be solved.

    Attributes:
        snapshot: the window.
        bundle: its observations.
        config: of the solver.
        gate: residual beyond which an observation is dropped, standard deviations.
        anchor_covariance: (6, 6) of the newest keyframe that is held fixed.
        leaving: keyframes that have left the window.
    """

    snapshot: Snapshot
    bundle: Bundle
    config: BundleConfig
    gate: float
    anchor_covariance: Array
    leaving: tuple[int, ...]

    def solve(self) -> "WindowChange":
        """Adjust the window."""
        solution = solve_bundle(self.bundle, self.config)
        wrong = np.flatnonzero(solution.chi2 > self.gate**2)
        update = self.snapshot.solved(solution.Ts_world_body, solution.points_world, dropped=wrong)
        newest = int(np.flatnonzero(~self.snapshot.is_fixed)[-1])
        return WindowChange(
            update,
            int(self.snapshot.keyframe_ids[newest]),
            self._world_covariance(solution, newest),
            self.leaving,
            solution,
        )

    def _world_covariance(self, solution: BundleSolution, newest: int) -> Array:
        """Chain the covariance of the newest keyframe to that of the anchor."""
        anchor = int(np.flatnonzero(self.snapshot.is_fixed)[-1])
        Ts = solution.Ts_world_body
        Ad = se3_adjoint(se3_inverse(Ts[newest]) @ Ts[anchor])
        factor = max(1.0, solution.variance_factor)
        relative = factor * solution.covariances[newest]
        return np.asarray(Ad @ self.anchor_covariance @ Ad.T + relative)


@dataclass(frozen=True, eq=False)
class WindowChange:
    """A solved window, to be written into the map.

    Attributes:
        update: poses and landmarks.
        newest_id: the keyframe that ended the window.
        covariance: (6, 6) of its pose in the world.
        leaving: keyframes that have left the window.
        solution: what the solver said.
    """

    update: Update
    newest_id: int
    covariance: Array
    leaving: tuple[int, ...]
    solution: BundleSolution
    loops: tuple[Loop, ...] = ()

    def write(self, map: Map) -> None:
        """Move the window, and retire what has left it."""
        with map.lock:
            map.apply(self.update)
            map.set_covariance([self.newest_id], self.covariance)
            map.retire_keyframes(self.leaving)
