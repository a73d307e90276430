"""Global adjustment: the whole map agrees with all that was seen, after a loop was closed.

A closed loop is spread over the path by a graph of poses, which knows nothing of what cameras saw
between. So all living keyframes and landmarks are adjusted together, the first keyframe held, with
the measurements and weights of local mapping (`localbundle`): pixels, inverse depths less their
bias, Huber's loss. It takes seconds, in which the map goes on. What is written is therefore

    keyframes    S ← S_solved S_read⁻¹ S_now               (`correction`)
    landmarks    p_anchor ← S_anchor,solved⁻¹ p_solved,    unless mapping has moved it since

in parts, the keyframes first: landmarks follow as they hang, and the map is whole after each part.
Observations beyond the gate are dropped. A scale of a single camera stays what it is: the farthest
keyframe keeps its distance from the first. Covariances stay those of the essential graph: features
err together (calibration, the same corner drifting), and a bundle that takes them for independent
would be far too sure. It begins some keyframes after the loop: right then few landmarks are known
from both sides, and all that odometry errs by together can pull the loop open again. When another
loop is closed the job is given up.

Cost: some dozen steps, each O(observations) and a sparse factor; about a microsecond per
observation and step.

Reference: Mur-Artal, Tardós, "ORB-SLAM2", T-RO 2017, section III-D (full bundle adjustment); Triggs
et al., "Bundle Adjustment - A Modern Synthesis", 1999.
"""

import logging
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from odomap.backend.adjustment.adjust import (
    Adjustment,
    AdjustmentConfig,
    AdjustmentSolution,
    adjust,
)
from odomap.backend.bundle import BundleConfig
from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_inverse
from odomap.geometry.robust import Loss
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.maps.snapshot import Snapshot, Update
from odomap.maps.states import act_inverse
from odomap.system.adjusting import AdjustingConfig
from odomap.system.correction import correction
from odomap.system.depthbias import DepthBias, bias_at
from odomap.system.stages import Change, Loop, Stop

__all__ = ["GlobalAdjuster", "GlobalChange", "GlobalJob"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

PART = 4000
"""Landmarks that are written in one go, between two frames."""


class GlobalAdjuster:
    """The adjuster of SLAM with cameras.

    Args:
        map: where keyframes and landmarks are.
        camera: the pinhole.
        T_body_camera: (4, 4) its mount.
        sigma_px: standard deviation of a keypoint's position on the finest level.
        level_scale: size of a pyramid level's pixels relative to those of the finer one.
        sigma: standard deviation of a measured inverse depth, 1/m.
        bias: what all measured depths are off by, as local mapping learns it.
        gate: residual beyond which an observation is dropped, standard deviations.
        bundle: how local mapping solves, for its loss.
        config: how much is done.
        counts: where is added up how many maps were adjusted and observations dropped, by name.
    """

    def __init__(
        self,
        map: Map,
        camera: Camera,
        T_body_camera: Array,
        sigma_px: float,
        level_scale: float,
        sigma: float,
        bias: DepthBias,
        gate: float,
        bundle: BundleConfig,
        config: AdjustingConfig | None = None,
        counts: Counter[str] | None = None,
    ) -> None:
        self._map, self._T_camera_body = map, se3_inverse(T_body_camera)
        self._sigma, self.level_scale = sigma_px / camera.fx, level_scale
        self._depth_sigma, self._bias = sigma, bias
        self.gate, self.loss = gate, Loss("huber", bundle.huber_width)
        self.config = AdjustingConfig() if config is None else config
        self._waits: int | None = None
        self.counts = Counter[str]() if counts is None else counts

    def add(self, keyframe: Keyframe, has_closed: bool) -> "GlobalJob | None":
        """Take notice of a keyframe; begin some keyframes after a loop was closed."""
        if has_closed:
            self._waits = self.config.after
        elif self._waits is not None:
            self._waits -= 1
        return self.end() if self._waits == 0 else None

    def end(self) -> "GlobalJob | None":
        """Begin to adjust the map as it will be when the job reads it, if a loop was closed."""
        if self._waits is None:
            return None
        self._waits = None
        return GlobalJob(self, self._map, np.array(self._bias.value))

    def whole(self) -> "GlobalJob":
        """Begin to adjust a map that others have made, with the bias that is found in it."""
        return GlobalJob(self, self._map, None)

    def problem(self, snapshot: Snapshot, bias: Array | None) -> tuple[Adjustment, Index] | None:
        """Return a map as a bundle, and the rows (N,) of the snapshot that its observations are.

        A landmark that one keyframe sees tells nothing about where keyframes are, and hangs on.
        None where too little was seen to adjust anything. A bias of None is found in the map.
        """
        has_features = np.array([k.features is not None for k in snapshot.keyframes], bool)
        is_sight = has_features[snapshot.obs_keyframe]
        seen = np.bincount(snapshot.obs_landmark, is_sight, minlength=len(snapshot.landmark_ids))
        rows = np.flatnonzero(is_sight & (seen[snapshot.obs_landmark] > 1))
        bearings, depths, levels = _measured(snapshot, rows)
        inverse = 1.0 / depths
        bias = self._bias_in(snapshot, rows, bearings, inverse) if bias is None else bias
        inverse -= bias_at(bias, bearings)
        if not _is_told(snapshot, rows, int(np.isfinite(inverse).sum())):
            return None
        first = np.arange(len(snapshot.keyframes)) == 0
        Ts_camera_world = self._T_camera_body @ se3_inverse(snapshot.Ts_world_body)
        problem = Adjustment(
            Ts_camera_world,
            snapshot.points_world,
            snapshot.obs_keyframe[rows],
            snapshot.obs_landmark[rows],
            bearings[:, :2] / bearings[:, 2:],
            np.array([[1.0, 1.0, 0.0, 0.0]]),
            weights=1.0 / (self._sigma * self.level_scale**levels),
            is_fixed_view=first,
            inverse_depths=inverse if np.isfinite(inverse).any() else None,
            depth_weights=np.full(len(rows), 1.0 / self._depth_sigma),
        )
        return problem, rows

    def _bias_in(self, s: Snapshot, rows: Index, bearings: Array, inverse: Array) -> Array:
        """Return the bias (3,) by which landmarks and measured inverse depths (N,) differ."""
        k, landmark = s.obs_keyframe[rows], s.obs_landmark[rows]
        T = self._T_camera_body @ se3_inverse(s.Ts_world_body)
        z = np.einsum("nj,nj->n", T[k, 2, :3], s.points_world[landmark]) + T[k, 2, 3]
        off = inverse - 1.0 / np.where(z > 0.0, z, np.nan)
        is_known = np.isfinite(off)
        return self._bias.fitted(off[is_known], bearings[is_known], self._depth_sigma)

    def solve(self, problem: Adjustment, stop: Stop | None) -> AdjustmentSolution:
        """Adjust, until there is nothing to gain or all steps are spent."""
        config = AdjustmentConfig(
            gauge="hold", iterations=self.config.iterations, tolerance=self.config.tolerance
        )
        return adjust(problem, config, loss=self.loss, stop=stop)

    def poses(self, solution: AdjustmentSolution) -> Array:
        """Return where a solution has the keyframes, Ts_world_body (K, 4, 4)."""
        return np.asarray(se3_inverse(solution.Ts_camera_world) @ self._T_camera_body)


def _is_told(snapshot: Snapshot, rows: Index, num_depths: int) -> bool:
    """Say whether as many numbers were seen as are unknown of what is seen, one keyframe held."""
    views, points = (np.unique(x[rows]) for x in (snapshot.obs_keyframe, snapshot.obs_landmark))
    unknown = 6 * int(np.count_nonzero(views)) + 3 * len(points)  # the first keyframe is held
    return len(views) > 1 and 2 * len(rows) + num_depths >= unknown


def _measured(snapshot: Snapshot, rows: Index) -> tuple[Array, Array, Array]:
    """Return bearings (N, 3), depths (N,) and levels (N,) of some rows, which are by keyframe."""
    keyframe, keypoint = snapshot.obs_keyframe[rows], snapshot.obs_keypoint[rows]
    begin = np.searchsorted(keyframe, np.arange(len(snapshot.keyframes) + 1)).tolist()
    bearings, depths, levels = np.empty((len(rows), 3)), np.empty(len(rows)), np.empty(len(rows))
    for k, (start, end) in enumerate(pairwise(begin)):
        features = snapshot.keyframes[k].features
        if features is None or start == end:
            continue
        at = keypoint[start:end]
        bearings[start:end] = features.bearings[at]
        depths[start:end], levels[start:end] = features.depth[at], features.level[at]
    return bearings, depths, levels


class GlobalJob:
    """The whole map, to be read and adjusted.

    Args:
        adjuster: whose job it is.
        map: what to read.
        bias: (3,) what all measured depths are off by, 1/m; None where that is to be found.
    """

    def __init__(self, adjuster: GlobalAdjuster, map: Map, bias: Array | None) -> None:
        self._adjuster, self._map, self._bias = adjuster, map, bias
        self._snapshot: Snapshot | None = None

    @property
    def size(self) -> int:
        """Observations, once they are read: what the time it takes grows with."""
        return 0 if self._snapshot is None else len(self._snapshot.obs_keyframe)

    def read(self) -> None:
        """Copy the map, in short steps (`Map.snapshot`)."""
        self._snapshot = self._map.snapshot(self._map.keyframe_ids)

    def solve(self, stop: Stop | None = None) -> "GlobalChange":
        """Adjust; if it is stopped, nothing is to be written."""
        snapshot, adjuster = self._snapshot, self._adjuster
        assert snapshot is not None, "what is to be adjusted has been read"
        made = adjuster.problem(snapshot, self._bias)
        if made is None:
            return GlobalChange(adjuster, None)
        problem, rows = made
        solution = adjuster.solve(problem, stop)
        if (stop is not None and stop.is_set()) or not solution.cost_after < solution.cost_before:
            return GlobalChange(adjuster, None)
        return GlobalChange(adjuster, _solved(snapshot, adjuster, solution, rows))


@dataclass(frozen=True, eq=False)
class _Solved:
    """A map adjusted: what was read, where it is now, and which observations are wrong.

    Attributes:
        snapshot: what was read.
        Ts_world_body: (K, 4, 4) of its keyframes.
        moved: (m,) rows of its landmarks that were adjusted.
        points_anchor: (m, 3) these in their anchors.
        wrong: (w,) rows of its observations, by landmark.
    """

    snapshot: Snapshot
    Ts_world_body: Array
    moved: Index
    points_anchor: Array
    wrong: Index


def _solved(
    snapshot: Snapshot, adjuster: GlobalAdjuster, solution: AdjustmentSolution, rows: Index
) -> _Solved:
    """Return a solution as the map is to have it."""
    Ts = adjuster.poses(solution)
    seen = np.bincount(snapshot.obs_landmark[rows], minlength=len(snapshot.landmark_ids)) > 0
    anchor = np.searchsorted(snapshot.keyframe_ids, snapshot.anchors)
    anchor = np.minimum(anchor, len(Ts) - 1)
    # One that hangs from a keyframe which was made while others were copied stays with that.
    seen &= snapshot.keyframe_ids[anchor] == snapshot.anchors
    moved = np.flatnonzero(seen)
    held = Ts[anchor[moved]], snapshot.scales[anchor[moved]]
    wrong = rows[solution.chi2 > adjuster.gate**2]
    wrong = wrong[np.argsort(snapshot.obs_landmark[wrong], kind="stable")]
    return _Solved(snapshot, Ts, moved, act_inverse(held, solution.points_world[moved]), wrong)


@dataclass(frozen=True, eq=False)
class GlobalChange:
    """What became of a map, to be written.

    Attributes:
        adjuster: whose it is.
        solved: what was found; None where there was nothing to gain, or the job was given up.
        loops: none.
    """

    adjuster: GlobalAdjuster
    solved: _Solved | None
    loops: tuple[Loop, ...] = ()

    def parts(self) -> tuple[Change, ...]:
        """Cut it into changes that are short, to be written in order."""
        if self.solved is None:
            return ()
        count = len(self.solved.moved)
        landmarks = [_Landmarks(self.solved, at, at + PART) for at in range(0, count, PART)]
        return (_Keyframes(self.adjuster, self.solved), *landmarks)

    def write(self, map: Map) -> None:
        """Write it all."""
        for part in self.parts():
            part.write(map)


@dataclass(frozen=True, eq=False)
class _Keyframes:
    """The part that moves the keyframes."""

    adjuster: GlobalAdjuster
    solved: _Solved
    loops: tuple[Loop, ...] = ()

    def write(self, map: Map) -> None:
        """Move the keyframes, and with them all that hangs from them."""
        s = self.solved.snapshot
        read, solved = (s.Ts_world_body, s.scales), (self.solved.Ts_world_body, s.scales)
        root = int(s.keyframe_ids[0])
        map.apply(correction(map, s.keyframe_ids, read, solved, root, s.version))
        wrong = len(self.solved.wrong)
        self.adjuster.counts.update(maps_adjusted=1, observations_dropped=wrong)
        logging.getLogger(__name__).info(
            "map adjusted: %d keyframes, %d landmarks, %d of %d observations were wrong",
            len(s.keyframe_ids),
            len(self.solved.moved),
            wrong,
            len(s.obs_keyframe),
        )


@dataclass(frozen=True, eq=False)
class _Landmarks:
    """The part that moves some landmarks, and drops what is wrong about them."""

    solved: _Solved
    start: int
    end: int
    loops: tuple[Loop, ...] = ()

    def write(self, map: Map) -> None:
        """Move the landmarks within their anchors."""
        s, rows = self.solved.snapshot, self.solved.moved[self.start : self.end]
        after = self.solved.points_anchor[self.start : self.end]
        map.settle(s.landmark_ids[rows], s.anchors[rows], s.points_anchor[rows], after)
        of = s.obs_landmark[self.solved.wrong]
        last = len(s.landmark_ids) if self.end >= len(self.solved.moved) else rows[-1] + 1
        first = 0 if self.start == 0 else rows[0]
        wrong = self.solved.wrong[np.searchsorted(of, first) : np.searchsorted(of, last)]
        if len(wrong):
            map.apply(_dropping(s, wrong))


def _dropping(s: Snapshot, wrong: Index) -> Update:
    """Return the update that drops observations, and nothing else."""
    nothing = np.zeros(0, np.int64)
    return Update(
        anchor_id=s.anchor_id,
        T_world_anchor=s.Ts_world_body[0],
        keyframe_ids=nothing,
        Ts_world_body=np.zeros((0, 4, 4)),
        landmark_ids=nothing,
        points_world=np.zeros((0, 3)),
        version=s.version,
        dropped_keyframes=s.keyframe_ids[s.obs_keyframe[wrong]],
        dropped_landmarks=s.landmark_ids[s.obs_landmark[wrong]],
        dropped_keypoints=s.obs_keypoint[wrong],
    )
