"""Tracking with a laser: every scan is laid onto the submap that has seen most of what it shows.

Where the body went since the last scan is predicted, by the wheels' odometry or else by going on as
before, with a covariance. The scan is matched to the older active submap from there, and both are
fused; so along a corridor, of whose length walls say nothing, the prediction is what counts, and
the covariance grows:

    x̂, P̂ = x ⊕ motion, Ad P Adᵀ + Q
    x, P = argmin |1 - m(T_x p)|²/σ² + |x - x̂|²_P̂, (P̂⁻¹ + Λ)⁻¹

When the body has moved far enough the scan becomes a keyframe, and part of the submaps. A scan that
says nothing is passed over: with odometry the path goes on by that alone. One that shows something
else than it should (`scanjudging`) is searched for around, and

    on new ground, with odometry      is mapped where that says
    where it contradicts the map      is searched for everywhere (`scanrecognition`)
    found nowhere for long            begins a piece of its own, to be joined when it is recognised

Reference: W. Hess, D. Kohler, H. Rapp, D. Andor, "Real-time loop closure in 2D LIDAR SLAM", ICRA
2016.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError
from odomap.geometry.planar import (
    between_planar,
    from_plane,
    lift_covariance,
    lift_information,
    moved_covariance,
    to_plane,
)
from odomap.geometry.pose import SE3
from odomap.lidar.fusion import fused
from odomap.lidar.gridmatching import GridMatch
from odomap.lidar.scans import Beams, ScanPoints
from odomap.maps.edges import LOOP, ODOMETRY
from odomap.maps.estimate import Estimate, Status
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.system.mountcheck import MountCheck
from odomap.system.path import Path, Placed
from odomap.system.scanconfig import ScanTrackingConfig
from odomap.system.scanjudging import Judgement, ScanJudge
from odomap.system.scanmotion import Loss, ScanMotion
from odomap.system.scanrecognition import ScanFinder
from odomap.system.scantrial import ScanTrial
from odomap.system.scanview import ScanView, view_scan
from odomap.system.submaps import Submap, Submaps

__all__ = ["ScanTracker"]

Array = NDArray[np.float64]

ANEW = "started anew where it was last: how it moved since is not known"
FOUND = "found again in the map"


class ScanTracker:
    """Places the scans of a 2D laser.

    Args:
        map: where keyframes go.
        beams: of the laser.
        submaps: of the map.
        config: how scans are placed.
        is_mapping: whether scans become keyframes; if not, they are only placed in the map.

    Attributes:
        path: the frames placed so far.
    """

    def __init__(
        self,
        map: Map,
        beams: Beams,
        submaps: Submaps,
        config: ScanTrackingConfig,
        is_mapping: bool = True,
    ) -> None:
        self._map, self._beams, self._submaps, self._config = map, beams, submaps, config
        self._is_mapping = is_mapping
        self.path = Path(map)
        self._since = np.zeros((3, 3))
        self._unknown = 1.0
        self._keyframe = -1
        self._wanted: ScanView | None = None
        self._before: ScanView | None = None
        self._made: int | None = None
        self._is_lost = False
        self._blind = 0
        self._motion, self._loss = ScanMotion(config), Loss()
        self._finder = ScanFinder(map, submaps.pieces, config)
        self._judge = ScanJudge(config, self._finder)
        self._trial = ScanTrial(submaps, self._judge, config)
        self._mount_check = MountCheck(beams.mount, config)

    def prepare(self, frame: Frame) -> ScanView:
        """Make points of a scan, without looking at the map."""
        return view_scan(frame, self._beams)

    def track(self, view: ScanView) -> Estimate:
        """Place a scan.

        Raises:
            CalibrationError: what the laser sees cannot be what the rig says.
        """
        view.clock.resume()
        self._made = None
        reason = view.says_nothing(self._config.min_hits)
        scan = None if reason else view.scan
        if self._keyframe < 0:
            return self._begin(view, reason)
        motion = self._motion.until(view.frame)
        self._mount_check.check(view.scan, self._motion.x_odom_body)
        self._submaps.move(motion.x, motion.noise)
        self._since = moved_covariance(self._since, motion.x) + motion.noise
        if scan is not None and motion.has_moved and view.is_like(self._before):
            scan, reason = None, "the scan is the one before, bit by bit: frozen?"
        self._before = view
        if scan is None:
            view.clock.lap("track")
            return self._go_blind(view, reason, motion.is_measured)
        said = Judgement(None, "what is seen is not known here")
        if self._trial.submap is not None:
            return self._watch(view, scan, motion.is_measured)
        if not self._is_lost:
            said = self._judge.match(self._submaps.active[0], scan, motion.is_measured)
        view.clock.lap("track")
        if said.match is None or (said.is_doubtful and self._loss.scans):
            self._loss.add(motion, self._judge.was_clean)
            return self._seek(view, scan, said.reason, motion.is_measured)
        elsewhere = self._judge.elsewhere(self._places(), self._submaps.active[0], scan, said)
        if elsewhere is not None:
            return self._return(view, *elsewhere)
        if said.doubted is not None:  # odometry was wrong, by that much
            self._submaps.move(np.zeros(3), said.doubted)
            self._since = self._since + said.doubted
        self._accept(said.match)
        return self._estimate(view, said.match, "")

    def make_keyframe(self) -> Keyframe | None:
        """Make the last scan a keyframe if it is to be one, and return it; else None."""
        wanted, self._wanted = self._wanted, None
        if wanted is not None and wanted.scan is not None:
            submap = self._submaps.active[0]
            sure, T = lift_covariance(submap.whole_covariance), from_plane(submap.x_anchor_body)
            in_submap = Placed(wanted.frame.stamp_ns, submap.anchor_id, T, sure)
            in_world = self.path.covariance(in_submap)
            last = self.path.last_pose()
            self._made = self._add_keyframe(wanted, wanted.scan, last, in_world)
            place = Placed(wanted.frame.stamp_ns, self._made, np.eye(4), np.zeros((6, 6)))
            self.path.replace_last(place)
        made, self._made = self._made, None
        return None if made is None else self._map.keyframe(made)

    # ---- the ways a scan can go ----

    def _begin(self, view: ScanView, reason: str) -> Estimate:
        """Begin a map with a scan that shows something, or find it in the map that there is."""
        frame, scan, finished = view.frame, view.scan, self._submaps.finished
        if view.wrong and frame.scan is not None and frame.scan.size:
            raise CalibrationError(f"{view.wrong}: mend its angles in a rig.yaml")
        self._blind += 1
        is_told = self._is_mapping and not finished and self._motion.read(frame) is not None
        if reason and is_told and self._blind > self._config.patience:
            scan, reason = self._beams.nothing(), ""  # the wheels say where the body goes
        if reason or scan is None:
            return self._wait(view, reason)
        found = None
        if finished:
            most = self._config.lost_submaps if self._blind > 1 else None
            found = self._finder.anywhere(finished, scan, most)
            view.clock.lap("track")
            if isinstance(found, str):
                return self._wait(view, f"not recognised: {found}")
        self._motion.begin(frame)
        if found is not None:
            return self._placed(view, self._enter(view, scan, *found), Status.TRACKING, "")
        self._made = self._add_keyframe(view, scan, np.eye(4), np.zeros((6, 6)))
        placed = Placed(frame.stamp_ns, self._made, np.eye(4), np.zeros((6, 6)))
        return self._placed(view, placed, Status.TRACKING, "")

    def _wait(self, view: ScanView, reason: str) -> Estimate:
        """Say that there is no place yet to say anything of."""
        frame, identity = view.frame, SE3.identity()
        return Estimate(
            frame.id, frame.stamp_ns, Status.INITIALIZING, reason, -1, identity, identity,
            np.zeros((6, 6)), timing=view.clock.laps,
        )  # fmt: skip

    def _placed(self, view: ScanView, placed: Placed, status: Status, reason: str) -> Estimate:
        """Turn a place that does not come from the scan before into an estimate."""
        self._wanted, self._judge.doubts = None, 0
        self._motion.stop()
        self._find_again()
        T_world_body, covariance = self.path.append(placed)
        count = 0 if view.scan is None else len(view.scan)
        return Estimate(
            view.frame.id, view.frame.stamp_ns, status, reason, placed.keyframe_id,
            SE3(placed.T_keyframe_body), SE3(T_world_body), covariance, count,
            self._made is not None, view.clock.laps,
        )  # fmt: skip

    def _go_blind(self, view: ScanView, reason: str, is_known: bool) -> Estimate:
        """Go on without a scan: by odometry, where there is any and the body is not lost."""
        if not is_known or self._is_lost:
            return self._lose(view, reason)
        return self._estimate(view, None, f"{reason}: followed by odometry alone")

    def _seek(self, view: ScanView, scan: ScanPoints, reason: str, is_known: bool) -> Estimate:
        """Find a scan that is not where it should be, or say what else is to become of it."""
        config, loss, finder = self._config, self._loss, self._finder
        active = self._submaps.active[0]
        near = self._judge.around(active, scan, is_known)
        if near is not None:
            self._accept(near)
            return self._estimate(view, near, "")
        is_patient = loss.scans < config.patience
        is_strange = loss.is_sudden and self._judge.contradicts(active, scan)
        is_strange = is_strange or not is_known
        if not is_strange and not self._is_lost:
            if is_patient or not self._is_mapping:
                return self._go_blind(view, reason, is_known)
            return self._map_by_odometry(view, scan, reason)
        found = finder.anywhere(self._places(), scan, config.lost_submaps)
        view.clock.lap("track")
        if not isinstance(found, str):
            return self._return(view, *found)
        is_long = loss.scans >= config.lost_scans and finder.rounds > 0
        if self._is_mapping and is_long and (not is_known or loss.way >= config.lost_m):
            return self._begin_piece(view, scan)
        if is_patient:
            return self._go_blind(view, reason, is_known)
        return self._lose(view, f"{reason}; {found}")

    def _places(self) -> list[Submap]:
        """Return the submaps in which the body may be."""
        return [*self._submaps.finished, *(self._submaps.active[:1] if self._is_mapping else ())]

    def _map_by_odometry(self, view: ScanView, scan: ScanPoints, reason: str) -> Estimate:
        """Begin submaps where only odometry says that the body is: nothing is known there."""
        submap = self._submaps.active[0]
        T_anchor_body = from_plane(submap.x_anchor_body)
        place = Placed(
            view.frame.stamp_ns,
            submap.anchor_id,
            T_anchor_body,
            lift_covariance(submap.whole_covariance),
        )
        T_world_body = self._map.place(submap.anchor_id, T_anchor_body)
        in_world = self.path.covariance(place)
        self._submaps.leave()
        self._made = self._add_keyframe(view, scan, T_world_body, in_world)
        information = lift_information(np.asarray(np.linalg.inv(submap.whole_covariance)))
        self._map.add_edge(submap.anchor_id, self._made, T_anchor_body, information, ODOMETRY)
        placed = Placed(view.frame.stamp_ns, self._made, np.eye(4), np.zeros((6, 6)))
        said = f"{reason}: mapped where odometry says"
        return self._placed(view, placed, Status.TRACKING, said)

    def _return(self, view: ScanView, submap: Submap, match: GridMatch) -> Estimate:
        """Go on where a scan was recognised, on trial."""
        self._trial.begin(submap, match, self._is_lost)
        return self._lose(view, "recognised, and watched whether it stays so")

    def _watch(self, view: ScanView, scan: ScanPoints, is_known: bool) -> Estimate:
        """Go on where a scan was recognised, and believe it when scans have fitted for a while."""
        trial = self._trial
        match = trial.watch(scan, is_known)
        if match is None:
            self._loss.scans += trial.scans
            estimate = self._lose(view, "what was recognised is not what is seen now")
            self._is_lost = trial.was_lost
            return estimate
        if trial.left > 0:
            return self._lose(view, f"recognised, and watched for {trial.left} more scans")
        submap = trial.end()
        assert submap is not None
        if submap in self._submaps.active:
            self._accept(match)
            return self._estimate(view, match, FOUND)
        if self._is_mapping:
            self._submaps.leave()
        placed = self._enter(view, scan, submap, match)
        return self._placed(view, placed, Status.RECOVERED, FOUND)

    def _begin_piece(self, view: ScanView, scan: ScanPoints) -> Estimate:
        """Begin a piece of the map of which nothing is known relative to the others."""
        last, unsure = self.path.last_pose(), self.path.gap_covariance(view.frame.stamp_ns)
        self._submaps.leave()
        k = self._made = self._add_keyframe(view, scan, last, unsure)
        self._map.begin_piece(k)
        self._submaps.pieces.enter(k, k)
        placed = Placed(view.frame.stamp_ns, k, np.eye(4), np.zeros((6, 6)))
        return self._placed(view, placed, Status.INITIALIZING, ANEW)

    def _find_again(self) -> None:
        """Take the body to be where it is believed to be."""
        self._is_lost = False
        self._loss.forget()
        if not self._judge.doubts:
            self._finder.forget()

    def _enter(self, view: ScanView, scan: ScanPoints, submap: Submap, match: GridMatch) -> Placed:
        """Go on in a submap of a map that was there, where a scan was recognised."""
        anchor, stamp_ns = submap.anchor_id, view.frame.stamp_ns
        T_anchor_body = from_plane(match.x_grid_body)
        sure = fused(np.eye(3), match.information)
        place = Placed(stamp_ns, anchor, T_anchor_body, lift_covariance(sure))
        if not self._is_mapping:
            self._submaps.stay(submap, match.x_grid_body, sure)
            self._keyframe, self._since = anchor, sure
            return place
        T_world_body = self._map.place(anchor, T_anchor_body)
        in_world = self.path.covariance(place)
        self._made = self._add_keyframe(view, scan, T_world_body, in_world, anchor)
        self._submaps.pieces.enter(self._made, self._submaps.piece_of(submap))
        information = lift_information(match.information)
        self._map.add_edge(anchor, self._made, T_anchor_body, information, LOOP)
        return Placed(stamp_ns, self._made, np.eye(4), np.zeros((6, 6)))

    def _accept(self, match: GridMatch) -> None:
        """Take a pose as found."""
        self._submaps.place(match.x_grid_body, match.information)
        self._since = fused(self._since, match.information)
        self._unknown = 1.0 - match.on_walls
        if not self._is_mapping and self._submaps.change():
            self._keyframe = self._submaps.active[0].anchor_id

    def _lose(self, view: ScanView, reason: str) -> Estimate:
        """Say that this scan has no pose of its own; it repeats the last one known."""
        self._is_lost = True
        self._motion.stop()
        last = self.path.last
        return Estimate(
            view.frame.id, view.frame.stamp_ns, Status.LOST, reason, last.keyframe_id,
            SE3(last.T_keyframe_body), SE3(self.path.last_pose()),
            self.path.gap_covariance(view.frame.stamp_ns), timing=view.clock.laps,
        )  # fmt: skip

    def _estimate(self, view: ScanView, match: GridMatch | None, reason: str) -> Estimate:
        """Turn a pose in the submap into an estimate, and into a keyframe if it is time for one."""
        submap, frame = self._submaps.active[0], view.frame
        x_keyframe_body = between_planar(submap.x_anchor_keyframe, submap.x_anchor_body)
        covariance = lift_covariance(self._since)
        placed = Placed(frame.stamp_ns, self._keyframe, from_plane(x_keyframe_body), covariance)
        before, T_before = self.path.last, self.path.last_pose()
        correction = self.path.correction()
        T_world_body, in_world = self.path.append(placed)
        step = between_planar(to_plane(T_before), to_plane(T_world_body))
        self._motion.note(step, (placed.stamp_ns - before.stamp_ns) * 1e-9)
        status = Status.RECOVERED if self._is_lost or correction else Status.TRACKING
        reason = reason or correction
        if match is not None:
            self._find_again()
        moved = np.hypot(*x_keyframe_body[:2]) > self._config.keyframe_m
        turned = abs(x_keyframe_body[2]) > self._config.keyframe_rad
        is_sure = self._is_mapping and match is not None and self._judge.is_settled
        is_keyframe = bool(is_sure and (moved or turned))
        self._wanted = view if is_keyframe else None
        count = 0 if match is None or view.scan is None else round(match.on_walls * len(view.scan))
        return Estimate(
            frame.id, frame.stamp_ns, status, reason, self._keyframe, SE3(placed.T_keyframe_body),
            SE3(T_world_body), in_world, count, is_keyframe, view.clock.laps,
        )  # fmt: skip

    # ---- parts ----

    def _add_keyframe(
        self,
        view: ScanView,
        scan: ScanPoints,
        T_world_body: Array,
        covariance: Array,
        parent: int = -1,
    ) -> int:
        """Add a keyframe to the map, and its scan to the submaps."""
        k = self._map.new_keyframe_id()
        shown = None if view.scan is None else view.frame.scan
        keyframe = Keyframe(k, view.frame.stamp_ns, scan=shown)
        # In the plane exactly: what corrections round, one on top of the other, would add up.
        T_world_body = from_plane(to_plane(T_world_body))
        self._map.add_keyframe(keyframe, T_world_body, parent=parent, covariance=covariance)
        self._submaps.add(k, scan, self._unknown * self._since)
        self._keyframe, self._since = k, np.zeros((3, 3))
        return k
