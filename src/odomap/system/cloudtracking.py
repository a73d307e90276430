"""Tracking with a 3D LiDAR: every sweep is laid onto what the sweeps before it saw.

The body goes on as before, ξ being its motion per second. From there the front-end finds it on its
map (`lidar/frontend`), the sweep deskewed by ξ; that gives a better ξ, and with it once more:

    x̂ = x exp(ξ Δt),     x = match(x̂, ξ),     ξ = log(x_before⁻¹ x) / Δt

All that is from the middle of one sweep to the middle of the next, where a constant motion errs
least; where the body was at the stamp lies between two such poses, x exp(-ξ τ), τ from stamp to
middle.

The map of the front-end is in a frame of odometry that nothing ever moves; a frame hangs from its
keyframe, and loops move those and never pull the tracker from under its feet. What a match says of
a step is weighed against how a body can move at all,

    P_step = (Q⁻¹ + Λ)⁻¹,        Q = diag(σ_a Δt², σ_ω Δt)²,

so along a tunnel, of whose length walls say nothing, the covariance grows.

A sweep that says nothing is lost; the body is taken to go on, and the next one that fits where it
may be by then is where it goes on. Where nothing fits it is looked for in the whole map
(`cloudrecognition`), and after a while a piece of its own is begun, to be joined when it is
recognised.

Reference: I. Vizzo et al., "KISS-ICP: in defense of point-to-point ICP", RA-L 8(2), 2023.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError
from odomap.geometry.lie import se3_adjoint, se3_exp, se3_inverse, se3_log
from odomap.geometry.pose import SE3
from odomap.geometry.so3 import orthonormalize
from odomap.lidar.frontend import FrontEnd, SweepMatch
from odomap.maps.edges import LOOP, ODOMETRY
from odomap.maps.estimate import Estimate, Status
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.system.cloudconfig import CloudTrackingConfig
from odomap.system.cloudrecognition import CloudFinder, FoundCloud
from odomap.system.cloudsurroundings import Surroundings
from odomap.system.cloudview import CloudView, CloudViewer
from odomap.system.path import Path, Placed

__all__ = ["CloudTracker"]

Array = NDArray[np.float64]

ANEW = "started anew where it was last: how it moved since is not known"
AGAIN = 2
"""How often the first sweep is laid down again, each time with the motion found before."""
LEARNING = 0.1
"""Weight of the last sweep in how unsteady the motion is."""
LONGEST_S = 1.0
"""Time over which a body is taken to go on as before."""


@dataclass(frozen=True, eq=False)
class _Wanted:
    """A sweep that is to be a keyframe."""

    view: CloudView
    twist: Array


class CloudTracker:
    """Places the sweeps of a 3D LiDAR.

    Args:
        map: where keyframes go.
        viewer: makes sweeps ready.
        front_end: lays them onto each other.
        finder: finds them in the map.
        config: how.
        is_mapping: whether sweeps become keyframes.

    Attributes:
        path: the frames placed so far.
    """

    def __init__(
        self,
        map: Map,
        viewer: CloudViewer,
        front_end: FrontEnd[Any],
        finder: CloudFinder,
        config: CloudTrackingConfig,
        is_mapping: bool = True,
    ) -> None:
        self._map, self._viewer, self._front_end, self._config = map, viewer, front_end, config
        self._finder, self._is_mapping = finder, is_mapping
        self._around = Surroundings(map, viewer.T_body_lidar, config)
        self.path = Path(map)
        self._T_odom_middle, self._twist = np.eye(4), np.zeros(6)
        self._middle_ns = 0
        self._T_odom_body = np.eye(4)
        self._keyframe, self._T_odom_keyframe = -1, np.eye(4)
        self._drift = np.zeros((6, 6))
        self._step = np.zeros((6, 6))
        self._unsteady2 = np.zeros(6)
        self._wanted: _Wanted | None = None
        self._made: int | None = None
        self._before: CloudView | None = None
        self._lost = 0
        self._first: CloudView | None = None

    def prepare(self, frame: Frame) -> CloudView:
        """Make a sweep ready, without looking at the map."""
        return self._viewer.view(frame)

    def track(self, view: CloudView) -> Estimate:
        """Place a sweep.

        Raises:
            CalibrationError: the sweeps cannot be what the rig says.
        """
        view.clock.resume()
        self._made, self._wanted = None, None
        if view.wrong:
            raise CalibrationError(view.wrong)
        reason = view.says_nothing(self._config.min_points)
        if not reason and view.is_like(self._before):
            reason = "the sweep is the one before, bit by bit: frozen?"
        self._before = view
        if reason:
            return self._pass_over(view, reason)
        if self._keyframe < 0:
            return self._begin(view)
        seconds = self._seconds_since(view)
        match, twist = self._match(view, seconds)
        is_second = self._first is not None and not self._is_wrong(match, seconds)
        if self._first is not None and is_second:
            match, twist = self._begin_again(self._first, view, seconds, twist)
        view.clock.lap("track")
        if wrong := self._is_wrong(match, seconds):
            return self._lose(view, wrong)
        return self._go_on(view, match, twist, seconds, is_second)

    def make_keyframe(self) -> Keyframe | None:
        """Make the last sweep a keyframe if it is to be one, and return it; else None."""
        wanted, self._wanted = self._wanted, None
        if wanted is not None:
            self._made = self._add_keyframe(wanted)
        made, self._made = self._made, None
        return None if made is None else self._map.keyframe(made)

    # ---- the ways a sweep can go ----

    def _begin(self, view: CloudView) -> Estimate:
        """Begin a map with a sweep, or find it in the one that there is."""
        if self._map.num_keyframes:
            twist = self._motion_seen(view)
            found = self._finder.find(self._viewer.kept(view, twist))
            view.clock.lap("track")
            if isinstance(found, str):
                return self._pass_over(view, f"not recognised: {found}")
            return self._enter(view, found, Status.TRACKING, twist)
        # How the body moved over it nobody knows yet, so nothing of it is kept.
        self._start(view)
        k = self._new_keyframe(view, np.eye(4), np.zeros((6, 6)))
        placed = Placed(view.frame.stamp_ns, k, np.eye(4), np.zeros((6, 6)))
        return self._placed(view, placed, Status.TRACKING, "", len(view))

    def _start(self, view: CloudView) -> None:
        """Begin the front-end's map with a sweep."""
        self._front_end.clear()
        self._T_odom_middle, self._T_odom_body = np.eye(4), np.eye(4)
        self._twist, self._lost, self._first = np.zeros(6), 0, view
        self._front_end.insert(view.prepared, self._T_odom_middle, self._twist)
        self._middle_ns = max(_middle_ns(view), self._middle_ns)

    def _motion_seen(self, view: CloudView) -> Array:
        """Return the motion (6,) since the sweep before, of a body that is not yet in the map."""
        before, seconds, twist = self._first, self._seconds_since(view), np.zeros(6)
        if before is not None and 0.0 < seconds < LONGEST_S:
            match, twist = self._match(view, seconds)
            if self._is_wrong(match, seconds):
                twist = np.zeros(6)
        self._start(view)
        self._front_end.clear()
        self._front_end.insert(view.prepared, self._T_odom_middle, twist)
        self._twist = twist
        return twist

    def _begin_again(
        self, first: CloudView, view: CloudView, seconds: float, twist: Array
    ) -> tuple[SweepMatch, Array]:
        """Begin the map again with the first sweep deskewed, as its motion is known by now."""
        self._first = None
        for _ in range(AGAIN):
            self._front_end.clear()
            self._T_odom_middle, self._twist = se3_exp(first.middle * twist), twist
            self._front_end.insert(first.prepared, self._T_odom_middle, twist)
            match, twist = self._match(view, seconds)
        self._T_odom_keyframe = self._T_odom_middle @ se3_exp(-first.middle * twist)
        return match, twist

    def _match(self, view: CloudView, seconds: float) -> tuple[SweepMatch, Array]:
        """Lay a sweep down where it should be, and again with the motion that this gives."""
        twist, T = self._twist, self._T_odom_middle @ se3_exp(self._twist * seconds)
        for _ in range(self._config.rounds):
            match = self._front_end.match(view.prepared, T, twist)
            T = match.T_map_body
            if seconds > 0.0:
                twist = se3_log(se3_inverse(self._T_odom_middle) @ T) / seconds
        return match, twist

    def _is_wrong(self, match: SweepMatch, seconds: float) -> str:
        """Say why a match cannot be; empty if it can."""
        config = self._config
        if match.share < config.min_share:
            return (
                f"only {match.share:.0%} of {match.num_points} points lie on what is known, "
                f"{config.min_share:.0%} needed"
            )
        moved = se3_log(se3_inverse(self._T_odom_middle) @ match.T_map_body)
        fast = np.linalg.norm(moved[:3]), np.linalg.norm(moved[3:])
        if fast[0] > config.fastest * max(seconds, 0.1):
            return f"it would have moved by {fast[0]:.1f} m in {seconds:.2g} s"
        return ""

    def _go_on(
        self, view: CloudView, match: SweepMatch, twist: Array, seconds: float, is_second: bool
    ) -> Estimate:
        """Take a match as found; the second sweep becomes a keyframe, as the first has no cloud."""
        T_step = se3_inverse(self._T_odom_middle) @ match.T_map_body
        step = self._step_covariance(match, seconds)
        self._unsteady2 += LEARNING * ((twist - self._twist) ** 2 - self._unsteady2)
        Ad = se3_adjoint(se3_inverse(T_step))
        self._drift = Ad @ self._drift @ Ad.T + self._config.renewal * step
        self._step = step
        self._T_odom_middle, self._twist = match.T_map_body, twist
        self._middle_ns = max(_middle_ns(view), self._middle_ns)
        self._T_odom_body = self._T_odom_middle @ se3_exp(-view.middle * twist)
        if self._is_mapping:
            self._front_end.insert(view.prepared, self._T_odom_middle, twist)
        elif self._around.is_left(self._T_odom_body):
            self._hang_anew()
        view.clock.lap("insert")
        T_keyframe_body = se3_inverse(self._T_odom_keyframe) @ self._T_odom_body
        # By how much a motion that is not constant errs, ½ a (Δt/2)², here and at the keyframe.
        shaken = 2.0 * np.diag(self._unsteady2) * (seconds / 8.0) ** 2
        covariance = self._drift + step + shaken
        placed = Placed(view.frame.stamp_ns, self._keyframe, T_keyframe_body, covariance)
        status = Status.RECOVERED if self._lost else Status.TRACKING
        self._lost = 0
        moved = se3_log(T_keyframe_body)
        is_far = np.linalg.norm(moved[:3]) > self._config.keyframe_m
        is_turned = np.linalg.norm(moved[3:]) > self._config.keyframe_rad
        if self._is_mapping and (is_far or is_turned or is_second):
            self._wanted = _Wanted(view, twist)
        return self._placed(view, placed, status, match.reason, match.num_inliers)

    def _pass_over(self, view: CloudView, reason: str) -> Estimate:
        """Say that a sweep says nothing."""
        if self._keyframe < 0:
            identity = SE3.identity()
            return Estimate(
                view.frame.id, view.frame.stamp_ns, Status.INITIALIZING, reason, -1, identity,
                identity, np.zeros((6, 6)), timing=view.clock.laps,
            )  # fmt: skip
        return self._lose(view, reason)

    def _lose(self, view: CloudView, reason: str) -> Estimate:
        """Say that this sweep has no pose; after many of them, begin a piece of the map."""
        self._lost += 1
        is_long = self._lost > self._config.patience
        if is_long and self._is_mapping and not view.says_nothing(self._config.min_points):
            return self._begin_piece(view)
        if self._lost >= self._config.seeks_after and view.prepared is not None:
            seen = self._viewer.kept(view, np.zeros(6))
            found = self._finder.find(seen, self.path.last_pose())
            view.clock.lap("track")
            if not isinstance(found, str):
                return self._enter(view, found, Status.RECOVERED, np.zeros(6))
            reason = f"{reason}; {found}"
        last = self.path.last
        return Estimate(
            view.frame.id, view.frame.stamp_ns, Status.LOST, reason, last.keyframe_id,
            SE3(last.T_keyframe_body), SE3(self.path.last_pose()),
            self.path.gap_covariance(view.frame.stamp_ns), timing=view.clock.laps,
        )  # fmt: skip

    def _enter(self, view: CloudView, found: FoundCloud, status: Status, twist: Array) -> Estimate:
        """Go on in the map, where a sweep was recognised, with a motion (6,)."""
        k, stamp_ns = found.keyframe_id, view.frame.stamp_ns
        T_world_keyframe = self._map.T_world_body(k)
        self._start(view)
        self._first, self._twist = None, twist
        self._T_odom_body = T_world_keyframe @ found.T_keyframe_body
        self._T_odom_middle = self._T_odom_body @ se3_exp(view.middle * twist)
        self._keyframe, self._T_odom_keyframe = k, T_world_keyframe
        self._drift = np.zeros((6, 6))
        self._step = np.asarray(np.linalg.inv(found.information))
        self._front_end.clear()
        self._around.surround(self._front_end, self._T_odom_body)
        placed = Placed(stamp_ns, k, found.T_keyframe_body, self._step)
        if not self._is_mapping:
            return self._placed(view, placed, status, "", found.num_inliers)
        sure = self.path.covariance(placed)
        made = self._new_keyframe(view, self._T_odom_body, sure, self._twist, parent=k)
        self._map.add_edge(k, made, found.T_keyframe_body, found.information, LOOP)
        placed = Placed(stamp_ns, made, np.eye(4), np.zeros((6, 6)))
        return self._placed(view, placed, status, "", found.num_inliers)

    def _begin_piece(self, view: CloudView) -> Estimate:
        """Begin a piece of the map of which nothing is known relative to the others."""
        last, unsure = self.path.last_pose(), self.path.gap_covariance(view.frame.stamp_ns)
        self._start(view)
        k = self._new_keyframe(view, last, unsure)
        self._map.begin_piece(k)
        placed = Placed(view.frame.stamp_ns, k, np.eye(4), np.zeros((6, 6)))
        return self._placed(view, placed, Status.INITIALIZING, ANEW, len(view))

    # ---- parts ----

    def _seconds_since(self, view: CloudView) -> float:
        """Return the time since the last sweep that was placed; stamps that jump back took none."""
        return float(np.clip((_middle_ns(view) - self._middle_ns) * 1e-9, 0.0, LONGEST_S))

    def _hang_anew(self) -> None:
        """Surround a body that is only placed in the map with what is there, and hang it anew."""
        self._front_end.clear()
        k = self._around.surround(self._front_end, self._T_odom_body)
        self._keyframe, self._T_odom_keyframe = k, self._map.T_world_body(k)
        self._drift = np.zeros((6, 6))

    def _step_covariance(self, match: SweepMatch, seconds: float) -> Array:
        """Return (6, 6) of the step: what is matched, and how bodies can move at all."""
        config = self._config
        sigma = config.acceleration * seconds**2 + 1e-3, config.angular * seconds**2 + 1e-3
        if self._lost:
            sigma = sigma[0] + config.unseen * seconds, sigma[1] + config.unseen_rad * seconds
        loose = np.diag(1.0 / np.repeat(sigma, 3) ** 2)
        return np.asarray(np.linalg.inv(loose + match.information))

    def _placed(
        self, view: CloudView, placed: Placed, status: Status, reason: str, count: int
    ) -> Estimate:
        """Turn a place into an estimate."""
        correction = self.path.correction() if len(self.path) else ""
        T_world_body, covariance = self.path.append(placed)
        if correction and status is Status.TRACKING:
            status, reason = Status.RECOVERED, reason or correction
        is_keyframe = self._wanted is not None or self._made is not None
        return Estimate(
            view.frame.id, view.frame.stamp_ns, status, reason, placed.keyframe_id,
            SE3(placed.T_keyframe_body), SE3(T_world_body), covariance, count, is_keyframe,
            view.clock.laps,
        )  # fmt: skip

    def _add_keyframe(self, wanted: _Wanted) -> int:
        """Add the sweep that was placed last to the map, tied to the keyframe before."""
        view, last = wanted.view, self.path.last
        in_world = self.path.covariance(last)
        k = self._new_keyframe(view, self.path.last_pose(), in_world, wanted.twist)
        information = np.asarray(np.linalg.inv(last.covariance))
        self._map.add_edge(last.keyframe_id, k, last.T_keyframe_body, information, ODOMETRY)
        self.path.replace_last(Placed(view.frame.stamp_ns, k, np.eye(4), np.zeros((6, 6))))
        return k

    def _new_keyframe(
        self, view: CloudView, T_world_body: Array, covariance: Array, twist: Array | None = None,
        parent: int = -1,
    ) -> int:  # fmt: skip
        """Add a keyframe with the sweep as of one instant, if the motion over it is known."""
        k = self._map.new_keyframe_id()
        cloud = None if twist is None else self._viewer.kept(view, twist)
        keyframe = Keyframe(k, view.frame.stamp_ns, cloud=cloud)
        T_world_body = T_world_body.copy()  # rounding adds up from keyframe to keyframe
        T_world_body[:3, :3] = orthonormalize(T_world_body[:3, :3])
        self._map.add_keyframe(keyframe, T_world_body, parent=parent, covariance=covariance)
        self._keyframe, self._T_odom_keyframe = k, self._T_odom_body
        self._drift = np.zeros((6, 6))
        self._made = k
        return k


def _middle_ns(view: CloudView) -> int:
    """Return the moment of the middle of a sweep."""
    return view.frame.stamp_ns + round(view.middle * 1e9)
