"""Tracking with a 3D LiDAR: every sweep is laid onto what the sweeps before it saw.

The body goes on as before, ξ being its motion per second. From there the front-end finds it on its
map (`lidar/frontend`), the sweep deskewed by ξ; that gives a better ξ, and with it once more:

    x̂ = x exp(ξ Δt),     x = match(x̂, ξ),     ξ = log(x_before⁻¹ x) / Δt

All that is from the middle of one sweep to the middle of the next, where a constant motion errs
least; where the body was at the stamp lies between two such poses, x exp(-ξ τ), τ from stamp to
middle.

The map of the front-end is in a frame of odometry that nothing ever moves; a frame hangs from its
keyframe, and loops move those and never pull the tracker from under its feet. What a match says of
a step is weighed against how a body can move at all (`cloudmotion`), so along a tunnel, of whose
length walls say nothing, it goes on as before and the covariance grows.

A sweep that says nothing is lost; the body is taken to go on, and the next one that fits where it
may be by then is where it goes on. Where nothing fits, or nothing was seen for long, it is looked
for in the whole map (`cloudrecognition`), and after a while a piece of its own is begun, to be
joined when it is recognised. In a loaded map the first sweeps may not be recognised, bent as they
are by a motion of which nothing is known; they are placed when a later one is.

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
from odomap.lidar.frontend import FrontEnd
from odomap.maps.edges import LOOP, ODOMETRY
from odomap.maps.estimate import Estimate, Status
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.system.cloudconfig import CloudTrackingConfig
from odomap.system.cloudlaying import CloudLayer, Laid
from odomap.system.cloudmotion import CloudMotion
from odomap.system.cloudrecognition import CloudFinder, FoundCloud
from odomap.system.cloudsurroundings import Surroundings
from odomap.system.cloudview import CloudView, CloudViewer
from odomap.system.path import Path, Placed

__all__ = ["CloudTracker"]

Array = NDArray[np.float64]

ANEW = "started anew where it was last: how it moved since is not known"
ASTRAY = "it may be anywhere: it was carried off, or not seen for long"
UNKNOWN = np.zeros(6), np.zeros((6, 6))
"""A motion of which nothing is known, and its information."""
WAITING = 9
"""Sweeps before the first that is recognised in a map which are placed by how the body moved."""
GLIMPSE_S = 0.5
"""Longest time between two sweeps that show how a body moves of which nothing else is known."""
AGAIN, AS_BEFORE = 15, np.array([1e-2] * 3 + [1e-3] * 3)
"""How often at most the first sweep is laid down again, each time with the motion found before; and
by how much that is another motion, metres and radians per second."""


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
        self._motion = CloudMotion(config)
        self._layer = CloudLayer(front_end, self._motion, config)
        self._T_odom_body = np.eye(4)
        self._keyframe, self._T_odom_keyframe = -1, np.eye(4)
        self._tie = ODOMETRY
        self._wanted: _Wanted | None = None
        self._made: int | None = None
        self._before: CloudView | None = None
        self._lost = self._unplaced = 0
        self._is_astray = False
        self._first: CloudView | None = None
        self._glimpsed: CloudView | None = None
        self._waiting: list[tuple[CloudView, tuple[Array, Array]]] = []

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
        seconds = self._motion.seconds_to(_middle_ns(view))
        self._is_astray = self._is_astray or self._motion.is_anywhere(seconds)
        if self._is_astray:
            return self._lose(view, ASTRAY)
        laid, is_second = self._layer.lay(view, seconds), False
        if self._first is not None and not laid.wrong:
            laid, is_second = self._begin_again(self._first, view, seconds, laid), True
        view.clock.lap("track")
        if laid.wrong:
            return self._lose(view, laid.wrong)
        return self._go_on(view, laid, seconds, is_second)

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
            before, known = self._glimpsed, self._glimpse(view)
            self._waiting = (
                [*self._waiting[1 - WAITING :], (before, known)]
                if before is not None and known is not UNKNOWN
                else []
            )
            found = self._finder.find(self._viewer.kept(view, known[0]))
            view.clock.lap("track")
            if isinstance(found, str):
                return self._pass_over(view, f"not recognised: {found}")
            self._place_late(view, found)
            return self._enter(view, found, Status.TRACKING, known)
        # How the body moved over it nobody knows yet, so nothing of it is kept.
        self._start(view)
        k = self._new_keyframe(view, np.eye(4), np.zeros((6, 6)))
        placed = Placed(view.frame.stamp_ns, k, np.eye(4), np.zeros((6, 6)))
        return self._placed(view, placed, Status.TRACKING, "", len(view))

    def _glimpse(self, view: CloudView) -> tuple[Array, Array]:
        """Return how a body moves of which no place is known, as the sweep before shows."""
        before, self._glimpsed = self._glimpsed, view
        seconds = 0.0 if before is None else (_middle_ns(view) - _middle_ns(before)) * 1e-9
        if before is None or not 0.0 < seconds < GLIMPSE_S:
            return UNKNOWN
        self._start(before)
        laid = self._layer.lay(view, seconds)
        if laid.wrong:
            return UNKNOWN
        laid = self._begin_again(before, view, seconds, laid)
        self._motion.know(laid.twist, laid.match.information * seconds**2)
        return self._motion.known

    def _place_late(self, view: CloudView, found: FoundCloud) -> None:
        """Place sweeps that nobody recognised, by how the body moved to one that is."""
        k, T, late = found.keyframe_id, found.T_keyframe_body, []
        covariance = np.asarray(np.linalg.inv(found.information))
        stamp_ns = view.frame.stamp_ns
        for before, (twist, information) in reversed(self._waiting):
            seconds = (stamp_ns - before.frame.stamp_ns) * 1e-9
            moved, stamp_ns = se3_exp(twist * seconds), before.frame.stamp_ns
            T, Ad = T @ se3_inverse(moved), se3_adjoint(moved)
            covariance = Ad @ covariance @ Ad.T + np.linalg.inv(information) * seconds**2
            late.append(Placed(stamp_ns, k, T, covariance))
        for placed in reversed(late):
            self.path.append_late(placed)
        self._waiting = []

    def _start(self, view: CloudView) -> None:
        """Begin the front-end's map with a sweep."""
        self._front_end.clear()
        self._layer.clear()
        self._T_odom_body, self._first, self._tie = np.eye(4), view, ODOMETRY
        self._motion.begin(np.eye(4), _middle_ns(view))
        self._front_end.insert(view.prepared, np.eye(4), np.zeros(6))

    def _found(self, view: CloudView) -> None:
        """Begin with a sweep after none was placed for a while."""
        self._start(view)
        self._lost, self._unplaced, self._is_astray, self._glimpsed = 0, 0, False, None

    def _begin_again(self, first: CloudView, view: CloudView, seconds: float, laid: Laid) -> Laid:
        """Begin the map again with the first sweep deskewed, as its motion is known by now."""
        self._first = None
        for _ in range(AGAIN):
            self._front_end.clear()
            motion, twist = self._motion, laid.twist
            motion.T_odom_middle, motion.twist = se3_exp(first.middle * twist), twist
            self._front_end.insert(first.prepared, motion.T_odom_middle, twist)
            laid = self._layer.lay(view, seconds)
            if (np.abs(laid.twist - twist) < AS_BEFORE).all():
                break
        self._T_odom_keyframe = self._motion.T_odom_middle @ se3_exp(-first.middle * laid.twist)
        return laid

    def _go_on(self, view: CloudView, laid: Laid, seconds: float, is_second: bool) -> Estimate:
        """Take a match as found; the second sweep becomes a keyframe, as the first has no cloud."""
        match, twist = laid.match, laid.twist
        told = self._lost > 0, not self._is_mapping
        covariance = self._motion.go(match, twist, seconds, _middle_ns(view), *told)
        self._layer.note(view)
        T_odom_middle = self._motion.T_odom_middle
        self._T_odom_body = T_odom_middle @ se3_exp(-view.middle * twist)
        if self._is_mapping:
            self._front_end.insert(view.prepared, T_odom_middle, twist)
        elif self._around.is_left(self._T_odom_body):
            self._hang_anew()
        view.clock.lap("insert")
        T_keyframe_body = se3_inverse(self._T_odom_keyframe) @ self._T_odom_body
        placed = Placed(view.frame.stamp_ns, self._keyframe, T_keyframe_body, covariance)
        status = Status.RECOVERED if self._lost else Status.TRACKING
        self._lost = self._unplaced = 0
        moved = se3_log(T_keyframe_body)
        is_far = np.linalg.norm(moved[:3]) > self._config.keyframe_m
        is_turned = np.linalg.norm(moved[3:]) > self._config.keyframe_rad
        is_new = is_second or self._tie == LOOP
        if self._is_mapping and (is_far or is_turned or is_new):
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
        return self._lose(view, reason, shows=False)

    def _lose(self, view: CloudView, reason: str, shows: bool = True) -> Estimate:
        """Say that this sweep has no pose; after many of them, begin a piece of the map."""
        self._lost += 1
        if shows:
            self._unplaced += 1
            self._is_astray = self._is_astray or self._unplaced >= self._config.seeks_after
            known = self._motion.twist, UNKNOWN[1]
            if self._is_astray:
                known = self._glimpse(view)
            self._glimpsed = view
            if self._lost >= self._config.seeks_after:
                seen = self._viewer.kept(view, known[0])
                found = self._finder.find(seen, self.path.last_pose())
                view.clock.lap("track")
                if not isinstance(found, str):
                    return self._enter(view, found, Status.RECOVERED, known)
                reason = f"{reason}; {found}"
            if self._unplaced > self._config.patience and self._is_mapping:
                return self._begin_piece(view)
        last = self.path.last
        return Estimate(
            view.frame.id, view.frame.stamp_ns, Status.LOST, reason, last.keyframe_id,
            SE3(last.T_keyframe_body), SE3(self.path.last_pose()),
            self.path.gap_covariance(view.frame.stamp_ns), timing=view.clock.laps,
        )  # fmt: skip

    def _enter(
        self, view: CloudView, found: FoundCloud, status: Status, known: tuple[Array, Array]
    ) -> Estimate:
        """Go on in the map, where a sweep was recognised, with a motion and its information."""
        k, stamp_ns = found.keyframe_id, view.frame.stamp_ns
        T_world_keyframe = self._map.T_world_body(k)
        self._found(view)
        self._first = None
        self._T_odom_body = T_world_keyframe @ found.T_keyframe_body
        sure, middle = np.asarray(np.linalg.inv(found.information)), _middle_ns(view)
        T_odom_middle = self._T_odom_body @ se3_exp(view.middle * known[0])
        self._motion.begin(T_odom_middle, middle, sure)
        self._motion.know(*known)
        self._keyframe, self._T_odom_keyframe, self._tie = k, T_world_keyframe, LOOP
        self._front_end.clear()
        self._around.surround(self._front_end, self._T_odom_body)
        # If nobody knows how it moves, it was found where it is in the middle of the sweep.
        covariance = sure + self._motion.over(view.middle)
        placed = Placed(stamp_ns, k, found.T_keyframe_body, covariance)
        return self._placed(view, placed, status, "", found.num_inliers)

    def _begin_piece(self, view: CloudView) -> Estimate:
        """Begin a piece of the map of which nothing is known relative to the others."""
        last, unsure = self.path.last_pose(), self.path.gap_covariance(view.frame.stamp_ns)
        self._found(view)
        k = self._new_keyframe(view, last, unsure)
        self._map.begin_piece(k)
        placed = Placed(view.frame.stamp_ns, k, np.eye(4), np.zeros((6, 6)))
        return self._placed(view, placed, Status.INITIALIZING, ANEW, len(view))

    # ---- parts ----

    def _hang_anew(self) -> None:
        """Surround a body that is only placed in the map with what is there, and hang it anew."""
        self._front_end.clear()
        k = self._around.surround(self._front_end, self._T_odom_body)
        self._keyframe, self._T_odom_keyframe = k, self._map.T_world_body(k)

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
        since, own = self._motion.since, self._motion.own
        hung = Placed(last.stamp_ns, last.keyframe_id, last.T_keyframe_body, since)
        in_world = self.path.covariance(hung)
        k = self._new_keyframe(view, self.path.last_pose(), in_world, wanted.twist)
        information = np.asarray(np.linalg.inv(since))
        self._map.add_edge(last.keyframe_id, k, last.T_keyframe_body, information, self._tie)
        self._tie = ODOMETRY
        self.path.replace_last(Placed(view.frame.stamp_ns, k, np.eye(4), own))
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
        self._motion.hang()
        self._made = k
        return k


def _middle_ns(view: CloudView) -> int:
    """Return the moment of the middle of a sweep."""
    return view.frame.stamp_ns + round(view.middle * 1e9)
