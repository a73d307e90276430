"""Local mapping: the map around each new keyframe is completed, adjusted and thinned.

A new keyframe is joined to the keyframes that share landmarks with it (its covisible ones) and to
those that merely look at the same place from nearby. On a copy of that part of the map

    1. landmarks of the neighbours are looked for in it, and its own in them; two that turn out to
       be one point are fused (`fusing`), which is how a place seen before is recognised while the
       drift is still small;
    2. keypoints without landmark are matched along epipolar lines and triangulated (`creating`);
    3. poses and points are adjusted, held in place by the keyframes around (`localbundle`);
    4. landmarks that were hardly found again, and keyframes that show nothing others do not show,
       are chosen to go (`culling`), so that the map grows with the space seen, not with time.

All is written back as one change. A keyframe that goes leaves a stub: what hung from it stays.

Cost: grows with the window, not with the map.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section VI.
"""

from collections import Counter, deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odomap.backend.bundle import BundleConfig
from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_inverse
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.maps.snapshot import Snapshot, Update
from odomap.system.creating import CreateConfig, Created, create_landmarks
from odomap.system.culling import CullConfig, poor_landmarks, redundant_keyframes
from odomap.system.depthbias import DepthBias
from odomap.system.fusing import FuseConfig, Fusions, find_fusions, fused
from odomap.system.localbundle import Adjusted, adjust_window
from odomap.system.localmap import LocalMapConfig, median_distance
from odomap.system.localpart import MappingConfig, choose_part
from odomap.system.localwindow import LocalWindow
from odomap.system.stages import Loop
from odomap.system.uncertainty import Calibration, Drift, NoiseConfig
from odomap.vision.matching import MatchConfig

__all__ = ["LocalChange", "LocalJob", "LocalMapper", "MappingConfig", "MappingSections"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

KEPT = 3
"""Newest keyframes that are never culled: frames still hang from them."""


@dataclass(frozen=True)
class MappingSections:
    """The sections of a configuration that local mapping reads.

    Attributes:
        sigma_px: standard deviation of a keypoint's position on the finest level.
        level_scale: size of a pyramid level relative to the one above.
    """

    mapping: MappingConfig
    local: LocalMapConfig
    creating: CreateConfig
    fusing: FuseConfig
    culling: CullConfig
    matching: MatchConfig
    bundle: BundleConfig
    noise: NoiseConfig
    sigma_px: float
    level_scale: float


class LocalMapper:
    """The mapper of SLAM: works on the window around each new keyframe.

    Args:
        map: where keyframes and landmarks are.
        camera: the pinhole.
        T_body_camera: (4, 4) its mount.
        sections: of the configuration.
        bias: what all measured depths are off by, learnt here.
        sigma: standard deviation of a measured inverse depth, 1/m.
        calibration: how far all of them may be off together, 1/m.
        has_depth: whether depth is measured at all.
        min_baseline: distance of two keyframes from which on they tell depth; None: by the scene.

    Attributes:
        T_body_camera: (4, 4) the mount.
        counts: landmarks and keyframes created, fused and culled so far, by name.
    """

    def __init__(
        self,
        map: Map,
        camera: Camera,
        T_body_camera: Array,
        sections: MappingSections,
        bias: DepthBias,
        sigma: float = 1.0,
        calibration: float = 0.0,
        has_depth: bool = False,
        min_baseline: float | None = None,
    ) -> None:
        self._map, self._camera, self.T_body_camera = map, camera, T_body_camera
        self._sections, self._bias, self._sigma = sections, bias, sigma
        self._calibration = Calibration.of(sections.noise, camera, T_body_camera, calibration)
        self._has_depth, self.min_baseline = has_depth, min_baseline
        self._drifts: dict[int, Drift] = {}
        self._probation: deque[Index] = deque(maxlen=int(sections.culling.max_age) + 1)
        self.counts: Counter[str] = Counter()

    def add(self, keyframe: Keyframe) -> "LocalJob | None":
        """Take in a keyframe that is in the map, and read the window around it."""
        s = self._sections
        part = choose_part(self._map, keyframe.id, self._camera, s.mapping, s.local)
        if part is None:
            return None
        window = self._window(part.snapshot, keyframe.id)
        drift = self._drift(part.anchor_id)
        return LocalJob(self, s, window, part.snapshot, part.anchor_id, drift)

    def write(self, change: "LocalChange", map: Map) -> None:
        """Write what was found into the map, and decide what has to go."""
        ids, keyframes = change.snapshot.landmark_ids, change.snapshot.keyframe_ids
        fusions, adjusted = change.fusions, change.adjusted
        map.fuse_landmarks(ids[fusions.survivors], ids[fusions.gone])
        map.add_observations(keyframes[fusions.keyframe], ids[fusions.landmark], fusions.keypoint)
        map.apply(change.update)
        new = self._write_created(change, map)
        self._bias.learn(adjusted.solution, 1.0 / max(int((~change.window.is_fixed).sum()), 1))
        self._write_covariance(change, map)
        map.cull_keyframes(keyframes[change.redundant])
        poor = self._poor(change, map, new)
        map.remove_landmarks(poor)
        self.counts.update(
            landmarks_created=len(new),
            landmarks_fused=len(fusions.gone),
            landmarks_culled=len(poor),
            observations_found=len(fusions.keyframe),
            observations_dropped=int(adjusted.is_wrong.sum() + adjusted.is_created_wrong.sum()),
            keyframes_culled=len(change.redundant),
        )

    def forget_drifts(self) -> None:
        """Take the map's covariances for the keyframes' from now on: a loop has changed them."""
        self._drifts.clear()

    # ---- reading ----

    def _window(self, snapshot: Snapshot, keyframe_id: int) -> LocalWindow:
        # Copies: a kernel would be compiled again for arrays that must not be written to.
        ids = snapshot.landmark_ids
        return LocalWindow(
            snapshot.keyframes,
            np.array(snapshot.is_fixed),
            snapshot.Ts_world_body @ self.T_body_camera,
            np.array(snapshot.points_world),
            self._map.descriptors(ids),
            self._map.count_observers(ids),
            np.array(snapshot.obs_keyframe),
            np.array(snapshot.obs_landmark),
            np.array(snapshot.obs_keypoint),
            int(np.flatnonzero(snapshot.keyframe_ids == keyframe_id)[0]),
            self._camera,
            self._sections.sigma_px,
            self._sections.level_scale,
            self._sigma,
            self._bias.value,
        )

    def _drift(self, keyframe_id: int) -> Drift:
        """Return a keyframe's drift; where tracking began, what the tracker said of it."""
        begun = Drift.begun(self._map.covariance(keyframe_id))
        return self._drifts.get(keyframe_id, begun)

    # ---- writing ----

    def _write_created(self, change: "LocalChange", map: Map) -> Index:
        """Add the landmarks that were created; return their ids."""
        created, adjusted, newest = change.created, change.adjusted, change.window.newest
        seen = np.bincount(created.obs_point[~adjusted.is_created_wrong], minlength=len(created))
        kept = np.flatnonzero(seen >= 2)
        T_body_world = se3_inverse(adjusted.Ts_world_body[newest])
        points_body = adjusted.created_world[kept] @ T_body_world[:3, :3].T + T_body_world[:3, 3]
        points_body /= change.snapshot.scales[newest]
        keyframes = change.snapshot.keyframe_ids
        descriptors = _descriptors(change.window, created)[kept]
        new = map.add_landmarks(int(keyframes[newest]), points_body, descriptors)
        ids = np.full(len(created), -1)
        ids[kept] = new
        good = ~adjusted.is_created_wrong & (ids[created.obs_point] >= 0)
        map.add_observations(
            keyframes[created.obs_keyframe[good]],
            ids[created.obs_point[good]],
            created.obs_keypoint[good],
        )
        return new

    def _poor(self, change: "LocalChange", map: Map, new: Index) -> Index:
        """Return landmarks hardly seen: of those on probation, and those of no keyframe."""
        newest = int(change.snapshot.keyframe_ids[change.window.newest])
        seen, _ = map.observations_of(newest)
        young = seen[map.anchors(seen) == newest]
        self._probation.append(np.unique(np.concatenate([young, new])))
        ids = np.concatenate(self._probation)
        age = np.repeat(np.arange(len(self._probation))[::-1], [len(p) for p in self._probation])
        alive = map.is_alive(ids)
        ids, age = ids[alive], age[alive]
        rows = poor_landmarks(
            age,
            map.count_observers(ids),
            map.seen(ids),
            map.expected(ids),
            np.full(len(ids), self._has_depth),
            self._sections.culling,
        )
        window = change.snapshot.landmark_ids
        unseen = window[map.count_observers(window) == 0]
        return np.unique(np.concatenate([ids[rows], unseen]))

    def _write_covariance(self, change: "LocalChange", map: Map) -> None:
        """Say how sure the new keyframe's pose is; where unknown, the tracker's word stands."""
        if not change.adjusted.solution.joint_covariance.any():
            return
        row, snapshot = change.window.newest, change.snapshot
        newest = int(snapshot.keyframe_ids[row])
        # A loop closed meanwhile has changed what a unit of the window is in the world.
        drift = change.drift.stretched(map.scale(newest) / float(snapshot.scales[row]))
        self._drifts[newest] = drift
        map.set_covariance([newest], self._calibration.total(drift, map.T_world_body(newest)))


def _descriptors(window: LocalWindow, created: Created) -> NDArray[np.uint8]:
    """Return how new landmarks (C,) look: as in the newest keyframe."""
    _, first = np.unique(created.obs_point, return_index=True)
    features = window.features(window.newest)
    return features.descriptors[created.obs_keypoint[first]]


@dataclass(frozen=True, eq=False)
class LocalJob:
    """A window read from the map, ready to be worked on.

    Attributes:
        mapper: whose window it is.
        sections: of the configuration.
        window: the window.
        snapshot: what it was made of, which knows the ids.
        anchor_id: the fixed keyframe that the new one's uncertainty is counted from.
        anchor_drift: how unsure that is.
    """

    mapper: LocalMapper
    sections: MappingSections
    window: LocalWindow
    snapshot: Snapshot
    anchor_id: int
    anchor_drift: Drift

    def solve(self) -> "LocalChange":
        """Fuse, create, adjust, and choose what goes."""
        s, T_body_camera = self.sections, self.mapper.T_body_camera
        fusions = find_fusions(self.window, s.fusing, s.matching)
        window = fused(self.window, fusions)
        created = create_landmarks(window, s.creating, s.matching, self.mapper.min_baseline)
        adjusted = adjust_window(window, created, T_body_camera, s.bundle, s.mapping.gate)
        wrong = np.flatnonzero(adjusted.is_wrong)
        ids, keyframe_ids = self.snapshot.landmark_ids, self.snapshot.keyframe_ids
        update = replace(
            self.snapshot.solved(adjusted.Ts_world_body, adjusted.points_world),
            dropped_keyframes=keyframe_ids[window.obs_keyframe[wrong]],
            dropped_landmarks=ids[window.obs_landmark[wrong]],
            dropped_keypoints=window.obs_keypoint[wrong],
        )
        redundant = redundant_keyframes(window, s.culling, self._protected())
        return LocalChange(
            self.mapper,
            window,
            self.snapshot,
            fusions,
            created,
            adjusted,
            update,
            self._onwards(adjusted),
            redundant,
        )

    def _protected(self) -> NDArray[np.bool_]:
        """Say which keyframes must stay: the newest ones, which frames still hang from."""
        ids = self.snapshot.keyframe_ids
        newest = np.sort(ids)[-KEPT:]
        return np.asarray(np.isin(ids, newest) | (ids == 0))

    def _onwards(self, adjusted: Adjusted) -> Drift:
        """Return how unsure the new keyframe is, from how unsure its anchor is."""
        newest, Ts = self.window.newest, adjusted.Ts_world_body
        anchor = int(np.flatnonzero(self.snapshot.keyframe_ids == self.anchor_id)[0])
        T_newest_anchor = se3_inverse(Ts[newest]) @ Ts[anchor]
        measured = adjusted.is_scale_free or adjusted.has_depth
        depth = None if measured else median_distance(adjusted.points_world, Ts[newest, :3, 3])
        overlap = self.sections.noise.overlap
        return self.anchor_drift.onwards(T_newest_anchor, adjusted.solution, newest, overlap, depth)


@dataclass(frozen=True, eq=False)
class LocalChange:
    """What was found about a window, to be written into the map.

    Attributes:
        mapper: whose window it is.
        window: the window, with what was fused.
        snapshot: what it was made of, which knows the ids.
        fusions: landmarks found again, and those that are one.
        created: new landmarks.
        adjusted: poses and points.
        update: the same as the map takes it.
        drift: how unsure the new keyframe's pose in the world is.
        redundant: rows of keyframes that are to go.
    """

    mapper: LocalMapper
    window: LocalWindow
    snapshot: Snapshot
    fusions: Fusions
    created: Created
    adjusted: Adjusted
    update: Update
    drift: Drift
    redundant: Index
    loops: tuple[Loop, ...] = ()

    def write(self, map: Map) -> None:
        """Complete, move and thin the window."""
        self.mapper.write(self, map)
