"""Stereo visual odometry: the metric path of a pair of cameras.

Every frame is placed against the landmarks of the last keyframe (`tracking`). When the view has
changed enough the frame becomes a keyframe: new corners fill the gaps between the tracked ones,
stereo gives all of them depth (`keyframing`), and the window of the last keyframes is adjusted
(`mapping`). What is remembered hangs from keyframes, so an adjusted window moves the frames
before it.

When too few landmarks agree with a pose the frame is lost, and says so. The next frames are tried
with descriptors against the last keyframe (`relocalization`); if that fails for some frames,
odometry starts anew where it was last, with a covariance that admits it.

    vo = StereoVO(source.rig)
    path = [vo.track(frame).T_world_body for frame in source]

Reference: Nistér, Naroditsky, Bergen, "Visual Odometry", CVPR 2004; Mur-Artal, Tardós, "ORB-SLAM2",
T-RO 2017 (stereo keyframes).
"""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_adjoint, se3_inverse
from odomap.geometry.pose import SE3
from odomap.geometry.trajectory import Trajectory
from odomap.maps.estimate import Estimate, Status, Tracks
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig
from odomap.system.association import (
    Association,
    DescriptorAssociation,
    FlowAssociation,
    Reference,
    View,
)
from odomap.system.config import Config
from odomap.system.keyframing import StereoKeyframes
from odomap.system.mapping import WindowMapper
from odomap.system.relocalization import relocalize
from odomap.system.tracking import ConstantVelocity, Located, PoseTracker
from odomap.vision.rectifier import Rectifier

__all__ = ["Result", "StereoVO"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Result:
    """What a run leaves.

    Attributes:
        trajectory: T_world_body of all placed frames as known at the end, with covariances.
        trajectory_live: the same frames as first emitted.
        map: keyframes and landmarks.
    """

    trajectory: Trajectory
    trajectory_live: Trajectory
    map: Map


@dataclass(frozen=True)
class _Placed:
    """A frame as it hangs from its keyframe, and as it was first emitted."""

    stamp_ns: int
    keyframe_id: int
    T_keyframe_body: Array
    T_world_body: Array
    covariance: Array


class _Clock:
    """Milliseconds per stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.laps[stage] = self.laps.get(stage, 0.0) + 1e3 * (now - self._last)
        self._last = now


class StereoVO:
    """Visual odometry of a stereo pair.

    Args:
        rig: with two cameras.
        config: sections for all parts; default the preset "stereo".

    Raises:
        CalibrationError: if the rig has no plausible stereo pair.
    """

    def __init__(self, rig: Rig, config: Config | None = None) -> None:
        self._config = config = Config() if config is None else config
        left, right = rig.stereo_pair()
        self._left, self._right = rig.cameras.index(left), rig.cameras.index(right)
        self._rectifier = Rectifier(rig)
        self.map = Map()
        self._association = _association(config, self._rectifier.mask)
        T, b = self._rectifier.T_body_camera, self._rectifier.baseline
        self._tracker = PoseTracker(self._association, self._rectifier.camera, b, T, config.noise)
        self._mapper = WindowMapper(
            self.map, T, self._rectifier.camera.fx, b, config.window, config.bundle, config.noise
        )
        self._keyframes = StereoKeyframes(self.map, self._rectifier, self._association, config)
        self._motion = ConstantVelocity(config.tracking.max_prediction_s)
        self._reference: Reference | None = None
        self._placed: list[_Placed] = []
        self._since_keyframe = self._lost = self._first_count = 0

    def track(self, frame: Frame) -> Estimate:
        """Place one frame.

        Args:
            frame: the next one in time, with both images.

        Returns:
            Where the body is, how sure that is, and why not if it is lost.

        Raises:
            CalibrationError: if left and right turn out to be swapped.
        """
        clock = _Clock()
        left, right = (
            frame.images[i] if i < len(frame.images) else None for i in (self._left, self._right)
        )
        if left is None:
            return self._lose(frame, "the left image is missing", clock)
        image = self._rectifier.rectify(left, "left")
        view = self._association.view(frame.id, frame.stamp_ns, image)
        clock.lap("prepare")
        if self._reference is None:
            return self._begin(frame, view, right, clock)
        located, status = self._locate(view, self._reference)
        clock.lap("track")
        if located.num_inliers >= self._config.tracking.min_inliers:
            return self._accept(frame, view, right, located, status, clock)
        if self._lost >= self._config.tracking.patience:
            return self._begin(frame, view, right, clock)
        return self._lose(frame, _why_lost(located, self._config.tracking.min_inliers, view), clock)

    def finish(self) -> Result:
        """Return the path as known at the end; tracking may go on afterwards."""
        placed = self._placed
        stamps = np.array([p.stamp_ns for p in placed], np.int64)
        final = [self.map.place(p.keyframe_id, p.T_keyframe_body) for p in placed]
        covariances = np.array([p.covariance for p in placed]).reshape(-1, 6, 6)
        live = np.array([p.T_world_body for p in placed]).reshape(-1, 4, 4)
        return Result(
            Trajectory(stamps, np.array(final).reshape(-1, 4, 4), covariances),
            Trajectory(stamps, live, covariances),
            self.map,
        )

    # ---- the cases of one frame ----

    def _begin(
        self, frame: Frame, view: View, right: NDArray[np.uint8] | None, clock: _Clock
    ) -> Estimate:
        """Start, or start anew after a loss, with a keyframe made from this pair alone."""
        if right is None:
            return self._lose(frame, "the right image is missing: cannot start", clock)
        none = np.empty(0, np.int64)
        covariance = self._gap_covariance(frame.stamp_ns)
        T_world_body = self._last_pose()
        self._mapper.restart()
        reference = self._keyframes.make(
            view, right, T_world_body, None, none, np.empty((0, 2)), covariance
        )
        clock.lap("keyframe")
        count, needed = len(reference.landmark_ids), 2 * self._config.tracking.min_inliers
        if count < needed:
            self._keyframes.check_order(view, right)
            self.map.retire_keyframes([reference.keyframe_id])
            return self._lose(
                frame,
                f"{count} points with depth of {needed} needed to start: too dark or no texture?",
                clock,
            )
        anew = bool(self._placed)
        self._reference, self._since_keyframe, self._lost = reference, 0, 0
        self._first_count = count
        self._mapper.add(reference.keyframe_id)
        self._motion.stop(frame.stamp_ns)
        reason = "started anew where it was last: how it moved since is not known" if anew else ""
        status = Status.INITIALIZING if anew else Status.TRACKING
        self._placed.append(
            _Placed(frame.stamp_ns, reference.keyframe_id, np.eye(4), T_world_body, covariance)
        )
        return Estimate(
            frame.id,
            frame.stamp_ns,
            status,
            reason,
            reference.keyframe_id,
            SE3.identity(),
            SE3(T_world_body),
            covariance,
            count,
            True,
            clock.laps,
            None,
        )

    def _accept(
        self,
        frame: Frame,
        view: View,
        right: NDArray[np.uint8] | None,
        located: Located,
        status: Status,
        clock: _Clock,
    ) -> Estimate:
        """Turn a placed view into an estimate, and into a keyframe if it is time for one."""
        reference, last = self._reference, self._placed[-1]
        assert reference is not None
        self._lost = 0
        self._since_keyframe += 1
        if self._since_keyframe == 1:
            self._first_count = located.num_inliers
        tracks = self._tracks(reference, located)
        wanted = self._wants_keyframe(reference, located)
        reason = "the right image is missing: no keyframe" if wanted and right is None else ""
        if wanted and right is not None:
            keyframe_id, T_keyframe_body = (
                self._add_keyframe(view, right, located, clock),
                np.eye(4),
            )
            covariance = self.map.covariance(keyframe_id)
        else:
            keyframe_id = reference.keyframe_id
            T_keyframe_body = se3_inverse(self.map.T_world_body(keyframe_id)) @ located.T_world_body
            covariance = self._frame_covariance(keyframe_id, T_keyframe_body, located.covariance)
        T_world_body = self.map.place(keyframe_id, T_keyframe_body)
        T_last = self.map.place(last.keyframe_id, last.T_keyframe_body)
        self._motion.update(frame.stamp_ns, se3_inverse(T_last) @ T_world_body)
        self._placed.append(
            _Placed(frame.stamp_ns, keyframe_id, T_keyframe_body, T_world_body, covariance)
        )
        return Estimate(
            frame.id,
            frame.stamp_ns,
            status,
            reason,
            keyframe_id,
            SE3(T_keyframe_body),
            SE3(T_world_body),
            covariance,
            located.num_inliers,
            wanted and right is not None,
            clock.laps,
            tracks,
        )

    def _lose(self, frame: Frame, reason: str, clock: _Clock) -> Estimate:
        """Say that this frame has no pose of its own; it repeats the last one known."""
        self._lost += 1
        last = self._placed[-1] if self._placed else None
        T_world_body = self._last_pose()
        return Estimate(
            frame.id,
            frame.stamp_ns,
            Status.LOST if last else Status.INITIALIZING,
            reason,
            last.keyframe_id if last else -1,
            SE3(last.T_keyframe_body) if last else SE3.identity(),
            SE3(T_world_body),
            self._gap_covariance(frame.stamp_ns),
            0,
            False,
            clock.laps,
            None,
        )

    # ---- parts ----

    def _locate(self, view: View, reference: Reference) -> tuple[Located, Status]:
        """Try the predicted motion, then none, then descriptors."""
        points = self.map.points_world(reference.landmark_ids)
        T_reference = self.map.T_world_body(reference.keyframe_id)
        T_last = self._last_pose()
        tracked = Status.RECOVERED if self._lost else Status.TRACKING
        enough = max(self._config.tracking.min_inliers, 0.3 * self._first_count)
        best: Located | None = None
        for motion in (self._motion.motion(view.stamp_ns), np.eye(4)):
            located = self._tracker.locate(view, reference, points, T_reference, T_last @ motion)
            if located.num_inliers >= enough:
                return located, tracked
            best = located if best is None or located.num_inliers > best.num_inliers else best
        assert best is not None
        T_world_camera = relocalize(
            view,
            reference,
            points,
            self._rectifier.camera,
            self._config.features,
            self._config.matching,
            self._rectifier.mask,
            self._config.tracking.min_inliers,
        )
        if T_world_camera is not None:
            T_guess = T_world_camera @ se3_inverse(self._rectifier.T_body_camera)
            located = self._tracker.locate(view, reference, points, T_reference, T_guess)
            if located.num_inliers > best.num_inliers:
                return located, Status.RECOVERED
        return best, tracked

    def _wants_keyframe(self, reference: Reference, located: Located) -> bool:
        config = self._config.tracking
        moved = located.pixels - reference.keypoints[located.rows]
        motion = np.median(np.linalg.norm(moved[located.inliers], axis=1))
        return bool(
            self._since_keyframe >= config.keyframe_interval
            or located.num_inliers < config.keyframe_ratio * len(reference.landmark_ids)
            or motion > config.keyframe_motion * self._rectifier.camera.width
        )

    def _add_keyframe(
        self, view: View, right: NDArray[np.uint8], located: Located, clock: _Clock
    ) -> int:
        reference = self._reference
        assert reference is not None
        rows = located.rows[located.inliers]
        made = self._keyframes.make(
            view,
            right,
            located.T_world_body,
            reference,
            rows,
            located.pixels[located.inliers],
            np.zeros((6, 6)),
        )
        clock.lap("keyframe")
        self._mapper.add(made.keyframe_id)
        clock.lap("bundle")
        self._reference = self._keyframes.reference(
            made.keyframe_id,
            view,
            made.keypoints,
            made.landmark_ids,
            made.descriptors,
            made.first_keyframe,
            made.first_keypoint,
        )
        self._since_keyframe = 0
        return made.keyframe_id

    def _last_pose(self) -> Array:
        if not self._placed:
            return np.eye(4)
        return self.map.place(self._placed[-1].keyframe_id, self._placed[-1].T_keyframe_body)

    def _frame_covariance(self, keyframe_id: int, T_keyframe_body: Array, relative: Array) -> Array:
        """Carry the keyframe's uncertainty to the frame and add that of tracking."""
        Ad = se3_adjoint(se3_inverse(T_keyframe_body))
        return np.asarray(Ad @ self.map.covariance(keyframe_id) @ Ad.T + relative)

    def _gap_covariance(self, stamp_ns: int) -> Array:
        """Say how unsure the last pose is by now: a metre and half a radian per second unseen."""
        if not self._placed:
            return np.zeros((6, 6))
        gap = (stamp_ns - self._placed[-1].stamp_ns) * 1e-9
        unseen = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5]) * gap + self._motion.speed * gap
        return np.asarray(self._placed[-1].covariance + np.diag(unseen**2))

    def _tracks(self, reference: Reference, located: Located) -> Tracks:
        """Return what was tracked, in raw pixels, for drawing."""
        return Tracks(
            self._rectifier.to_raw(located.pixels).astype(np.float32),
            self._rectifier.to_raw(reference.keypoints[located.rows]).astype(np.float32),
            located.inliers,
        )


def _association(config: Config, mask: NDArray[np.bool_]) -> Association:
    if config.tracking.association == "flow":
        return FlowAssociation(config.features, config.flow, mask)
    return DescriptorAssociation(config.features, config.matching, mask)


def _why_lost(located: Located, needed: int, view: View) -> str:
    """Say in a sentence why too few observations agree."""
    spread = float(view.pyramid[-1].std())
    if spread < 8.0:
        cause = (
            f"the image is nearly uniform (contrast {spread:.0f} of 255): covered lens or no light?"
        )
    elif len(located.rows) < needed:
        again = f"{len(located.rows)} of {located.expected} landmarks found again"
        cause = f"{again}: motion blur or too fast?"
    else:
        cause = "what was found does not fit one motion: moving objects or a wrong calibration?"
    return f"{located.num_inliers} inliers of {needed} needed: {cause}"
