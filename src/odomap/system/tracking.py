"""Tracking: the stage that places every frame and makes the keyframes, whatever the camera.

A frame is placed against the landmarks of the last keyframe (`locating`). When the view has changed
enough it becomes a keyframe itself (`keyframing`). How the first keyframes come about is all that
differs between a camera with depth and one without (`starting`).

When too few landmarks agree with a pose the frame is lost, and says so. It is tried from where it
is expected, from how the image turned, from where it was, and by descriptors (`relocalization`);
if that fails for some frames, tracking starts anew where it was last, with a covariance that
admits it.

Reference: Nistér, Naroditsky, Bergen, "Visual Odometry", CVPR 2004; Mur-Artal, Tardós, "ORB-SLAM2",
T-RO 2017 (stereo keyframes).
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_exp, se3_inverse
from odomap.geometry.pose import SE3
from odomap.maps.estimate import Estimate, Status, Tracks
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.system.association import Association, Reference, View
from odomap.system.config import Config
from odomap.system.eye import Eye
from odomap.system.keyframing import Keyframes
from odomap.system.locating import Located, Locator
from odomap.system.path import Path, Placed
from odomap.system.relocalization import relocalize
from odomap.system.starting import Start, Waiting
from odomap.vision.turning import Thumbnail, turn_between

__all__ = ["Tracker"]

Array = NDArray[np.float64]


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
class _Look:
    """A frame being tracked: its ideal view, and the clock."""

    frame: Frame
    view: View
    clock: _Clock


class Tracker:
    """Places the frames of a camera in a map.

    Args:
        map: where keyframes go.
        eye: the camera.
        association: finds landmarks in images.
        keyframes: makes keyframes.
        start: makes the first ones.
        config: all sections.
    """

    def __init__(
        self,
        map: Map,
        eye: Eye,
        association: Association,
        keyframes: Keyframes,
        start: Start,
        config: Config,
    ) -> None:
        self._map, self._eye, self._association = map, eye, association
        self._keyframes, self._start, self._config = keyframes, start, config
        self._locator = Locator(association, eye.camera, eye.T_body_camera, config.noise)
        self._reference: Reference | None = None
        self._last: View | None = None
        self._newest_ns = -1
        self._epoch = map.epoch
        self.path = Path(map)
        self._since_keyframe = self._lost = self._first_count = 0

    def track(self, frame: Frame) -> Estimate:
        """Place one frame; its keyframe, if it became one, is in the map when this returns."""
        clock = _Clock()
        if frame.stamp_ns <= self._newest_ns:
            return self._lose(frame, "its time is not after that of the frame before", clock)
        self._newest_ns = frame.stamp_ns
        image = self._eye.image(frame)
        if image is None:
            return self._lose(frame, f"the {self._eye.name} image is missing", clock)
        look = _Look(frame, self._association.view(frame.id, frame.stamp_ns, image), clock)
        clock.lap("prepare")
        reference = self._current_reference()
        if reference is None:
            return self._begin(look)
        located, status = self._locate(look.view, reference)
        clock.lap("track")
        if located.num_inliers >= self._config.tracking.min_inliers:
            return self._accept(look, reference, located, status)
        if self._lost >= self._config.tracking.patience:
            return self._begin(look)
        reason = _why_lost(located, self._config.tracking.min_inliers, look.view)
        return self._lose(frame, reason, clock)

    # ---- the three ways a frame can go ----

    def _begin(self, look: _Look) -> Estimate:
        """Start, or start anew after a loss."""
        frame, anew = look.frame, len(self.path) > 0
        T_world_body, covariance = self.path.last_pose(), self._gap_covariance(frame.stamp_ns)
        started = self._start.begin(frame, look.view, T_world_body, covariance)
        look.clock.lap("keyframe")
        if isinstance(started, Waiting):
            return self._lose(frame, started.reason, look.clock)
        self._reference, self._since_keyframe, self._lost = started.reference, 0, 0
        self._first_count, self._epoch = started.count, self._map.epoch
        self._last = look.view
        for placed in started.placed[:-1]:
            self.path.append_late(placed)
        return self._estimate(
            look,
            Status.INITIALIZING if anew else Status.TRACKING,
            self._start.anew if anew else "",
            started.placed[-1],
            started.count,
            True,
            None,
        )

    def _accept(
        self, look: _Look, reference: Reference, located: Located, status: Status
    ) -> Estimate:
        """Turn a placed view into an estimate, and into a keyframe if it is time for one."""
        if self._lost:
            self._start.forget()
        self._lost, self._last = 0, look.view
        self._since_keyframe += 1
        if self._since_keyframe == 1:
            self._first_count = located.num_inliers
        T_world_reference = self._map.T_world_body(reference.keyframe_id)
        placed = Placed(
            look.frame.stamp_ns,
            reference.keyframe_id,
            se3_inverse(T_world_reference) @ located.T_world_body,
            located.covariance,
        )
        tracks = Tracks(
            self._eye.to_raw(located.pixels).astype(np.float32),
            self._eye.to_raw(reference.keypoints[located.rows]).astype(np.float32),
            located.inliers,
        )
        reason, is_keyframe = "", self._wants_keyframe(reference, located)
        if is_keyframe and (missing := self._keyframes.missing(look.frame)):
            reason, is_keyframe = f"{missing}: no keyframe", False
        if is_keyframe:
            placed = self._add_keyframe(look, reference, located, placed)
        return self._estimate(
            look, status, reason, placed, located.num_inliers, is_keyframe, tracks
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
        look: _Look,
        status: Status,
        reason: str,
        placed: Placed,
        num_inliers: int,
        is_keyframe: bool,
        tracks: Tracks | None,
    ) -> Estimate:
        T_world_body, covariance = self.path.append(placed)
        return Estimate(
            look.frame.id,
            look.frame.stamp_ns,
            status,
            reason,
            placed.keyframe_id,
            SE3(placed.T_keyframe_body),
            SE3(T_world_body),
            covariance,
            num_inliers,
            is_keyframe,
            look.clock.laps,
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
        """Try the motions that are likely, then descriptors."""
        config = self._config.tracking
        points = self._map.points_world(reference.landmark_ids)
        T_reference = self._map.T_world_body(reference.keyframe_id)
        T_last = self.path.last_pose()
        tracked = Status.RECOVERED if self._lost else Status.TRACKING
        enough = max(config.min_inliers, 0.3 * self._first_count)
        dt = min((view.stamp_ns - self.path.last.stamp_ns) * 1e-9, config.max_prediction_s)
        best: Located | None = None
        for motion in self._motions(view, dt):
            located = self._locator.locate(view, reference, points, T_reference, T_last @ motion)
            if located.num_inliers >= enough:
                return located, tracked
            best = located if best is None or located.num_inliers > best.num_inliers else best
        assert best is not None
        T_world_camera = relocalize(
            view,
            reference,
            points,
            self._eye.camera,
            self._config.features,
            self._config.matching,
            self._eye.mask,
            config.min_inliers,
        )
        if T_world_camera is not None:
            T_guess = T_world_camera @ se3_inverse(self._eye.T_body_camera)
            located = self._locator.locate(view, reference, points, T_reference, T_guess)
            if located.num_inliers > best.num_inliers:
                return located, Status.RECOVERED
        return best, tracked

    def _motions(self, view: View, dt: float) -> Iterator[Array]:
        """Yield how the body may have moved: steadily, as the images turned, not at all."""
        steady = se3_exp(self.path.velocity() * dt)
        yield steady
        R = self._turn(view)
        if R is not None:
            mount = self._eye.T_body_camera
            turned = np.eye(4)
            turned[:3, :3] = mount[:3, :3] @ R @ mount[:3, :3].T
            turned[:3, 3] = steady[:3, 3]
            yield turned
        yield np.eye(4)

    def _turn(self, view: View) -> Array | None:
        """Return R_before_now (3, 3) of the camera since the last frame placed."""
        if self._last is None:
            return None
        now = Thumbnail.of(view.pyramid[-1], self._eye.camera)
        return turn_between(Thumbnail.of(self._last.pyramid[-1], self._eye.camera), now)

    def _wants_keyframe(self, reference: Reference, located: Located) -> bool:
        config = self._config.tracking
        moved = located.pixels - reference.keypoints[located.rows]
        motion = np.median(np.linalg.norm(moved[located.inliers], axis=1))
        return bool(
            self._since_keyframe >= config.keyframe_interval
            or located.num_inliers < config.keyframe_ratio * self._first_count
            or motion > config.keyframe_motion * self._eye.camera.width
        )

    def _add_keyframe(
        self, look: _Look, reference: Reference, located: Located, placed: Placed
    ) -> Placed:
        """Make the frame a keyframe; the mapper will know its pose better."""
        T_world_body, inliers = located.T_world_body, located.inliers
        rows, pixels = located.rows[inliers], located.pixels[inliers]
        seen = self._keyframes.measure(look.frame, look.view, T_world_body, reference, rows, pixels)
        self._reference = self._keyframes.add(
            look.view, T_world_body, seen, reference.keyframe_id, self.path.covariance(placed)
        )
        self._since_keyframe = 0
        look.clock.lap("keyframe")
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
    elif not located.expected:
        cause = "none of the landmarks is where the camera is expected to look"
    elif len(located.rows) < needed:
        again = f"{len(located.rows)} of {located.expected} landmarks found again"
        cause = f"{again}: motion blur or too fast?"
    else:
        cause = "what was found does not fit one motion: moving objects or a wrong calibration?"
    return f"{located.num_inliers} inliers of {needed} needed: {cause}"
