"""Tracking with a stereo pair: the stage that places every frame and makes the keyframes.

A frame is placed against the landmarks of the last keyframe (`locating`). When the view has changed
enough it becomes a keyframe itself: new corners fill the gaps between the tracked ones, and stereo
gives all of them depth (`keyframing`).

When too few landmarks agree with a pose the frame is lost, and says so. It is tried from where it
is expected, from where it was, and by descriptors (`relocalization`); if that fails for some
frames, tracking starts anew where it was last, with a covariance that admits it.

Reference: Nistér, Naroditsky, Bergen, "Visual Odometry", CVPR 2004; Mur-Artal, Tardós, "ORB-SLAM2",
T-RO 2017 (stereo keyframes).
"""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_exp, se3_inverse
from odomap.geometry.pose import SE3
from odomap.maps.estimate import Estimate, Status, Tracks
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig
from odomap.system.association import Association, Reference, View
from odomap.system.config import Config, make_association
from odomap.system.keyframing import StereoKeyframes
from odomap.system.locating import Located, Locator
from odomap.system.path import Path, Placed
from odomap.system.relocalization import relocalize
from odomap.vision.rectifier import Rectifier

__all__ = ["StereoTracker"]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


class _Clock:
    """Milliseconds per stage; for people, nothing decides by it."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.laps[stage] = self.laps.get(stage, 0.0) + 1e3 * (now - self._last)
        self._last = now


@dataclass(frozen=True, eq=False)
class _Pair:
    """A frame being tracked: its left view, its raw right image, and the clock."""

    frame: Frame
    view: View
    right: Image | None
    clock: _Clock


class StereoTracker:
    """Places the frames of a stereo pair in a map.

    Args:
        rig: with two cameras.
        config: all sections.
        map: where keyframes go.
        rectifier: of the rig's pair.
    """

    def __init__(self, rig: Rig, config: Config, map: Map, rectifier: Rectifier) -> None:
        left, right = rig.stereo_pair()
        self._left, self._right = rig.cameras.index(left), rig.cameras.index(right)
        self._config, self._map, self._rectifier = config, map, rectifier
        self._association: Association = make_association(config, rectifier.mask)
        self._locator = Locator(
            self._association,
            rectifier.camera,
            rectifier.baseline,
            rectifier.T_body_camera,
            config.noise,
        )
        self._keyframes = StereoKeyframes(map, rectifier, self._association, config)
        self._reference: Reference | None = None
        self._epoch = map.epoch
        self.path = Path(map)
        self._since_keyframe = self._lost = self._first_count = 0

    def track(self, frame: Frame) -> Estimate:
        """Place one frame; its keyframe, if it became one, is in the map when this returns."""
        clock = _Clock()
        left, right = (
            frame.images[i] if i < len(frame.images) else None for i in (self._left, self._right)
        )
        if left is None:
            return self._lose(frame, "the left image is missing", clock)
        image = self._rectifier.rectify(left, "left")
        pair = _Pair(frame, self._association.view(frame.id, frame.stamp_ns, image), right, clock)
        clock.lap("prepare")
        reference = self._current_reference()
        if reference is None:
            return self._begin(pair)
        located, status = self._locate(pair.view, reference)
        clock.lap("track")
        if located.num_inliers >= self._config.tracking.min_inliers:
            return self._accept(pair, reference, located, status)
        if self._lost >= self._config.tracking.patience:
            return self._begin(pair)
        reason = _why_lost(located, self._config.tracking.min_inliers, pair.view)
        return self._lose(frame, reason, clock)

    # ---- the three ways a frame can go ----

    def _begin(self, pair: _Pair) -> Estimate:
        """Start, or start anew after a loss, with a keyframe made from this pair alone."""
        frame = pair.frame
        if pair.right is None:
            return self._lose(frame, "the right image is missing: cannot start", pair.clock)
        T_world_body, covariance = self.path.last_pose(), self._gap_covariance(frame.stamp_ns)
        none = np.empty(0, np.int64)
        self._keyframes.check_order(pair.view, pair.right)
        seen = self._keyframes.measure(
            pair.view, pair.right, T_world_body, None, none, np.empty((0, 2))
        )
        count, needed = len(seen.features), 2 * self._config.tracking.min_inliers
        pair.clock.lap("keyframe")
        if count < needed:
            why = f"{count} points with depth of {needed} needed to start"
            return self._lose(frame, f"{why}: too dark or no texture?", pair.clock)
        made = self._keyframes.add(pair.view, T_world_body, seen, -1, covariance)
        anew = len(self.path) > 0
        self._reference, self._since_keyframe, self._lost = made, 0, 0
        self._first_count, self._epoch = count, self._map.epoch
        reason = "started anew where it was last: how it moved since is not known" if anew else ""
        placed = Placed(frame.stamp_ns, made.keyframe_id, np.eye(4), np.zeros((6, 6)))
        status = Status.INITIALIZING if anew else Status.TRACKING
        return self._estimate(pair, status, reason, placed, count, True, None)

    def _accept(
        self, pair: _Pair, reference: Reference, located: Located, status: Status
    ) -> Estimate:
        """Turn a placed view into an estimate, and into a keyframe if it is time for one."""
        self._lost = 0
        self._since_keyframe += 1
        if self._since_keyframe == 1:
            self._first_count = located.num_inliers
        T_world_reference = self._map.T_world_body(reference.keyframe_id)
        placed = Placed(
            pair.frame.stamp_ns,
            reference.keyframe_id,
            se3_inverse(T_world_reference) @ located.T_world_body,
            located.covariance,
        )
        tracks = Tracks(
            self._rectifier.to_raw(located.pixels).astype(np.float32),
            self._rectifier.to_raw(reference.keypoints[located.rows]).astype(np.float32),
            located.inliers,
        )
        wanted = self._wants_keyframe(reference, located)
        reason = "the right image is missing: no keyframe" if wanted and pair.right is None else ""
        if wanted and pair.right is not None:
            placed = self._add_keyframe(pair, pair.right, reference, located, placed)
        return self._estimate(
            pair, status, reason, placed, located.num_inliers, wanted and not reason, tracks
        )

    def _lose(self, frame: Frame, reason: str, clock: _Clock) -> Estimate:
        """Say that this frame has no pose of its own; it repeats the last one known."""
        self._lost += 1
        known = len(self.path) > 0
        last = self.path.last if known else None
        return Estimate(
            frame.id,
            frame.stamp_ns,
            Status.LOST if known else Status.INITIALIZING,
            reason,
            last.keyframe_id if last else -1,
            SE3(last.T_keyframe_body) if last else SE3.identity(),
            SE3(self.path.last_pose()),
            self._gap_covariance(frame.stamp_ns),
            timing=clock.laps,
        )

    def _estimate(
        self,
        pair: _Pair,
        status: Status,
        reason: str,
        placed: Placed,
        num_inliers: int,
        is_keyframe: bool,
        tracks: Tracks | None,
    ) -> Estimate:
        T_world_body, covariance = self.path.append(placed)
        return Estimate(
            pair.frame.id,
            pair.frame.stamp_ns,
            status,
            reason,
            placed.keyframe_id,
            SE3(placed.T_keyframe_body),
            SE3(T_world_body),
            covariance,
            num_inliers,
            is_keyframe,
            pair.clock.laps,
            tracks,
        )

    # ---- parts ----

    def _current_reference(self) -> Reference | None:
        """Return the last keyframe, with what the mapper has changed since it was made."""
        if self._reference is not None and self._epoch != self._map.epoch:
            self._epoch = self._map.epoch
            self._reference = self._keyframes.refreshed(self._reference)
        return self._reference

    def _locate(self, view: View, reference: Reference) -> tuple[Located, Status]:
        """Try the predicted motion, then none, then descriptors."""
        config = self._config.tracking
        points = self._map.points_world(reference.landmark_ids)
        T_reference = self._map.T_world_body(reference.keyframe_id)
        T_last = self.path.last_pose()
        tracked = Status.RECOVERED if self._lost else Status.TRACKING
        enough = max(config.min_inliers, 0.3 * self._first_count)
        dt = min((view.stamp_ns - self.path.last.stamp_ns) * 1e-9, config.max_prediction_s)
        best: Located | None = None
        for motion in (se3_exp(self.path.velocity() * dt), np.eye(4)):
            located = self._locator.locate(view, reference, points, T_reference, T_last @ motion)
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
            config.min_inliers,
        )
        if T_world_camera is not None:
            T_guess = T_world_camera @ se3_inverse(self._rectifier.T_body_camera)
            located = self._locator.locate(view, reference, points, T_reference, T_guess)
            if located.num_inliers > best.num_inliers:
                return located, Status.RECOVERED
        return best, tracked

    def _wants_keyframe(self, reference: Reference, located: Located) -> bool:
        config = self._config.tracking
        moved = located.pixels - reference.keypoints[located.rows]
        motion = np.median(np.linalg.norm(moved[located.inliers], axis=1))
        return bool(
            self._since_keyframe >= config.keyframe_interval
            or located.num_inliers < config.keyframe_ratio * self._first_count
            or motion > config.keyframe_motion * self._rectifier.camera.width
        )

    def _add_keyframe(
        self, pair: _Pair, right: Image, reference: Reference, located: Located, placed: Placed
    ) -> Placed:
        """Make the frame a keyframe; the mapper will know its pose better."""
        T_world_body, inliers = located.T_world_body, located.inliers
        seen = self._keyframes.measure(
            pair.view,
            right,
            T_world_body,
            reference,
            located.rows[inliers],
            located.pixels[inliers],
        )
        self._reference = self._keyframes.add(
            pair.view, T_world_body, seen, reference.keyframe_id, self.path.covariance(placed)
        )
        self._since_keyframe = 0
        pair.clock.lap("keyframe")
        return Placed(placed.stamp_ns, self._reference.keyframe_id, np.eye(4), np.zeros((6, 6)))

    def _gap_covariance(self, stamp_ns: int) -> Array:
        """Say how unsure the last pose is by now: a metre and half a radian per second unseen."""
        if not len(self.path):
            return np.zeros((6, 6))
        gap = (stamp_ns - self.path.last.stamp_ns) * 1e-9
        unseen = (np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5]) + np.abs(self.path.velocity())) * gap
        return np.asarray(self.path.last_covariance() + np.diag(unseen**2))


def _why_lost(located: Located, needed: int, view: View) -> str:
    """Say in a sentence why too few observations agree."""
    contrast = float(view.pyramid[-1].std())
    if contrast < 8.0:
        cause = (
            f"the image is nearly uniform (contrast {contrast:.0f} of 255): covered lens, no light?"
        )
    elif len(located.rows) < needed:
        again = f"{len(located.rows)} of {located.expected} landmarks found again"
        cause = f"{again}: motion blur or too fast?"
    else:
        cause = "what was found does not fit one motion: moving objects or a wrong calibration?"
    return f"{located.num_inliers} inliers of {needed} needed: {cause}"
