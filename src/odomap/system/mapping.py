"""Local mapping of an odometry: bundle adjustment over the last keyframes.

The newest keyframes and the landmarks they see are adjusted together, held in place by the
keyframes just before them. Observations that disagree with the solution have little weight in it
(Huber) and are dropped for the next; keyframes that leave the window are retired, so that memory
stays flat.

How sure the newest keyframe's pose is in the world then follows from the solution (`uncertainty`).

Reference: Mouragnon et al., "Real Time Localization and 3D Reconstruction", CVPR 2006.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.backend.bundle import Bundle, BundleConfig, BundleSolution, solve_bundle
from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_inverse
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.maps.snapshot import Snapshot, Update
from odomap.system.depthbias import DepthBias, bias_at
from odomap.system.localbundle import at_one_place
from odomap.system.localmap import median_distance
from odomap.system.ranging import UNIT_BASELINE
from odomap.system.stages import Loop
from odomap.system.uncertainty import Calibration, Drift, NoiseConfig
from odomap.system.visualconfig import WindowConfig

__all__ = ["WindowChange", "WindowConfig", "WindowJob", "WindowMapper"]

Array = NDArray[np.float64]


class WindowMapper:
    """The mapper of an odometry: adjusts the window that ends at each new keyframe.

    Args:
        map: where keyframes and landmarks are.
        T_body_camera: (4, 4) mount of the pinhole.
        camera: the pinhole.
        window, bundle, noise: sections of the configuration.
        bias: what all measured depths are off by, learnt here.
        sigma: standard deviation of a measured inverse depth, 1/m.
        calibration: how far all of them may be off together, 1/m.
    """

    def __init__(
        self,
        map: Map,
        T_body_camera: Array,
        camera: Camera,
        window: WindowConfig,
        bundle: BundleConfig,
        noise: NoiseConfig,
        bias: DepthBias,
        sigma: float = 1.0,
        calibration: float = 0.0,
    ) -> None:
        self._map, self._window, self._bundle, self._noise = map, window, bundle, noise
        self._T_camera_body = se3_inverse(T_body_camera)
        self._weights = np.array([camera.fx / noise.position_px, 1.0 / sigma])
        self._calibration = Calibration.of(noise, camera, T_body_camera, calibration)
        self._bias = bias
        self._recent: list[int] = []
        self._drifts: dict[int, Drift] = {}

    def add(self, keyframe: Keyframe) -> "WindowJob | None":
        """Take in a keyframe that is in the map, and read the window that it ends."""
        size, fixed = self._window.size, self._window.fixed
        tied = np.sort(self._map.covisible(keyframe.id)[0]).tolist()
        # Odometry that starts anew shares no landmark with the window: all of that leaves.
        starts_anew = set(tied).isdisjoint(self._recent)
        leaving = self._recent if starts_anew else self._recent[: -(size + fixed - 1)]
        kept = self._recent[len(leaving) :]
        # A single camera starts with two keyframes at once, and only the second comes by here.
        partner = [k for k in tied if not self._recent or k > self._recent[-1]]
        self._recent = [*kept, *partner, keyframe.id]
        if len(self._recent) < 2:
            self._retire(leaving)
            return None
        held = max(1, len(self._recent) - size)
        snapshot = self._map.snapshot(self._recent[held:], self._recent[:held])
        return WindowJob(
            self,
            snapshot,
            self._make_bundle(snapshot),
            self._bundle,
            self._window.gate,
            self._drift(self._recent[held - 1]),
            self._noise.overlap,
            tuple(leaving),
        )

    def write(self, change: "WindowChange", map: Map) -> None:
        """Write a solved window into the map: poses, landmarks, and how sure the newest pose is."""
        newest = change.newest_id
        with map.lock:
            map.apply(change.update)
            self._bias.learn(change.solution, 1.0 / self._window.size)
            if change.solution.joint_covariance.any():  # else the tracker's word stands
                self._drifts[newest] = change.drift
                covariance = self._calibration.total(change.drift, map.T_world_body(newest))
                map.set_covariance([newest], covariance)
            self._retire(change.leaving)

    def _retire(self, leaving: Sequence[int]) -> None:
        """Forget what keyframes saw, and their drift: no later one hangs from them."""
        self._map.retire_keyframes(leaving)
        for keyframe_id in leaving:
            self._drifts.pop(keyframe_id, None)

    def _drift(self, keyframe_id: int) -> Drift:
        """Return a keyframe's drift; where odometry began, what the tracker said of it."""
        begun = Drift.begun(self._map.covariance(keyframe_id))
        return self._drifts.get(keyframe_id, begun)

    def _make_bundle(self, snapshot: Snapshot) -> Bundle:
        """Gather what the keyframes measured, in the order of the snapshot's observations."""
        xy = np.empty((len(snapshot.obs_keyframe), 2))
        inverse_depth = np.full(len(xy), np.nan)
        for k, keyframe in enumerate(snapshot.keyframes):
            rows = np.flatnonzero(snapshot.obs_keyframe == k)
            if not rows.size or keyframe.features is None:
                continue
            seen = snapshot.obs_keypoint[rows]
            bearings = keyframe.features.bearings[seen]
            xy[rows] = bearings[:, :2] / bearings[:, 2:]
            bias = bias_at(self._bias.value, bearings)
            inverse_depth[rows] = 1.0 / keyframe.features.depth[seen] - bias
        zeros = np.zeros(len(xy), np.int64)
        return Bundle(
            snapshot.Ts_world_body,
            snapshot.is_fixed,
            snapshot.points_world,
            self._T_camera_body[None],
            np.array([UNIT_BASELINE]),
            snapshot.obs_keyframe,
            snapshot.obs_landmark,
            zeros,
            xy,
            inverse_depth,
            np.tile(self._weights, (len(xy), 1)),
            is_scale_free=not np.isfinite(inverse_depth).any()
            and at_one_place(
                snapshot.Ts_world_body[snapshot.is_fixed],
                snapshot.points_world,
                1.0 / float(self._weights[0]),
            ),
        )


@dataclass(frozen=True, eq=False)
class WindowJob:
    """A window read from the map, ready to be solved.

    Attributes:
        mapper: whose window it is.
        snapshot: the window.
        bundle: its observations.
        config: of the solver.
        gate: residual beyond which an observation is dropped, standard deviations.
        anchor_drift: of the newest keyframe that is held fixed.
        overlap: factor on variances for errors that observations share.
        leaving: keyframes that have left the window.
    """

    mapper: WindowMapper
    snapshot: Snapshot
    bundle: Bundle
    config: BundleConfig
    gate: float
    anchor_drift: Drift
    overlap: float
    leaving: tuple[int, ...]

    def solve(self) -> "WindowChange":
        """Adjust the window."""
        solution = solve_bundle(self.bundle, self.config)
        wrong = np.flatnonzero(solution.chi2 > self.gate**2)
        update = self.snapshot.solved(solution.Ts_world_body, solution.points_world, dropped=wrong)
        newest = int(np.flatnonzero(~self.snapshot.is_fixed)[-1])
        anchor = int(np.flatnonzero(self.snapshot.is_fixed)[-1])
        Ts = solution.Ts_world_body
        T_newest_anchor = se3_inverse(Ts[newest]) @ Ts[anchor]
        measured = self.bundle.is_scale_free or np.isfinite(self.bundle.disparity).any()
        depth = None if measured else median_distance(solution.points_world, Ts[newest, :3, 3])
        drift = self.anchor_drift.onwards(T_newest_anchor, solution, newest, self.overlap, depth)
        newest_id = int(self.snapshot.keyframe_ids[newest])
        return WindowChange(self.mapper, update, newest_id, drift, self.leaving, solution)


@dataclass(frozen=True, eq=False)
class WindowChange:
    """A solved window, to be written into the map.

    Attributes:
        mapper: whose window it is.
        update: poses and landmarks.
        newest_id: the keyframe that ended the window.
        drift: how unsure its pose in the world is.
        leaving: keyframes that have left the window.
        solution: what the solver said.
    """

    mapper: WindowMapper
    update: Update
    newest_id: int
    drift: Drift
    leaving: tuple[int, ...]
    solution: BundleSolution
    loops: tuple[Loop, ...] = ()

    def write(self, map: Map) -> None:
        """Move the window, and retire what has left it."""
        self.mapper.write(self, map)
