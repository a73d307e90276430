"""Tracking with a laser: every scan is laid onto the submap that has seen most of what it shows.

Where the body went since the last scan is predicted, by the wheels' odometry or else by going on as
before, with a covariance. The scan is matched to the older active submap from there, and both are
fused; so along a corridor, of whose length walls say nothing, the prediction is what counts, and
the covariance grows:

    x̂, P̂ = x ⊕ motion, Ad P Adᵀ + Q
    x, P = argmin |1 - m(T_x p)|²/σ² + |x - x̂|²_P̂, (P̂⁻¹ + Λ)⁻¹

When the body has moved far enough the scan becomes a keyframe, and part of the submaps. A scan that
says nothing, or does not fit, is passed over: with odometry the path goes on by that alone, without
it the body is lost, and searched for in a wide window until a scan fits.

Reference: W. Hess, D. Kohler, H. Rapp, D. Andor, "Real-time loop closure in 2D LIDAR SLAM", ICRA
2016; S. Thrun, W. Burgard, D. Fox, "Probabilistic robotics", MIT Press 2005, chapter 5 (odometry).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.planar import (
    between_planar,
    from_plane,
    lift_covariance,
    lift_information,
    moved_covariance,
    to_plane,
)
from odomap.geometry.pose import SE3
from odomap.lidar.branchbound import GridPyramid
from odomap.lidar.correlative import search_near
from odomap.lidar.fusion import fused
from odomap.lidar.gridmatching import GridMatch, lay_on_grid
from odomap.lidar.scans import Beams, ScanPoints
from odomap.maps.edges import LOOP
from odomap.maps.estimate import Estimate, Status
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.system.looking import Clock
from odomap.system.path import Path, Placed
from odomap.system.scanconfig import ScanTrackingConfig
from odomap.system.scanrecognition import recognise_scan
from odomap.system.submaps import Submap, Submaps

__all__ = ["ScanTracker"]

Array = NDArray[np.float64]

SURPRISE = 9.0
"""Squared standard deviations off odometry from which on it is asked whether that is true."""
MORE_ON_WALLS = 0.05
"""Share of the beams that must meet walls elsewhere, and not where odometry leads."""


@dataclass(frozen=True, eq=False)
class ScanView:
    """A scan being tracked: its points, and the clock."""

    frame: Frame
    scan: ScanPoints | None
    clock: Clock


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
        self._odometry: Array | None = None
        self._step, self._step_s = np.zeros(3), 0.0
        self._since = np.zeros((3, 3))
        self._unknown = 1.0
        self._keyframe = -1
        self._wanted: ScanView | None = None
        self._made: int | None = None
        self._stamp_ns = 0
        self._is_lost = False

    def prepare(self, frame: Frame) -> ScanView:
        """Make points of a scan, without looking at the map."""
        clock = Clock()
        scan = None if frame.scan is None else self._beams.points(frame.scan)
        clock.lap("points")
        return ScanView(frame, scan, clock)

    def track(self, view: ScanView) -> Estimate:
        """Place a scan."""
        view.clock.resume()
        self._made = None
        reason = self._says_nothing(view)
        if self._keyframe < 0:
            return self._begin(view, reason)
        motion, noise, is_known = self._motion(view.frame)
        self._submaps.move(motion, noise)
        self._since = moved_covariance(self._since, motion) + noise
        match = None
        if not reason and view.scan is not None:
            match = self._match(view.scan, is_known)
            if match.on_walls < self._config.min_on_walls:
                shown = f"{match.on_walls:.0%} of {len(view.scan)} beams"
                reason = f"only {shown} meet walls that are known"
                match = None
        view.clock.lap("track")
        if match is not None:
            self._accept(match)
        elif not is_known:
            return self._lose(view, reason)
        else:
            reason = f"{reason}: followed by odometry alone"
        return self._estimate(view, match, reason)

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
        frame, scan, config = view.frame, view.scan, self._config
        found = None
        if not reason and scan is not None and self._submaps.finished:
            score, in_free = config.known_score, config.known_in_free
            found = recognise_scan(self._submaps.finished, scan, score, in_free)
            reason = f"not recognised: {found}" if isinstance(found, str) else ""
        view.clock.lap("track")
        if reason or scan is None or isinstance(found, str):
            identity = SE3.identity()
            return Estimate(
                frame.id, frame.stamp_ns, Status.INITIALIZING, reason, -1, identity, identity,
                np.zeros((6, 6)), timing=view.clock.laps,
            )  # fmt: skip
        self._stamp_ns, self._odometry = frame.stamp_ns, self._read_odometry(frame)
        if found is not None:
            placed = self._enter(view, scan, *found)
        else:
            self._made = self._add_keyframe(view, scan, np.eye(4), np.zeros((6, 6)))
            placed = Placed(frame.stamp_ns, self._made, np.eye(4), np.zeros((6, 6)))
        T_world_body, covariance = self.path.append(placed)
        return Estimate(
            frame.id, frame.stamp_ns, Status.TRACKING, "", placed.keyframe_id,
            SE3(placed.T_keyframe_body), SE3(T_world_body), covariance, len(scan),
            self._is_mapping, view.clock.laps,
        )  # fmt: skip

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
        self._is_lost, self._step = True, np.zeros(3)
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
        self._step = between_planar(to_plane(T_before), to_plane(T_world_body))
        self._step_s = (placed.stamp_ns - before.stamp_ns) * 1e-9
        status = Status.RECOVERED if self._is_lost or correction else Status.TRACKING
        reason, self._is_lost = reason or correction, False
        moved = np.hypot(*x_keyframe_body[:2]) > self._config.keyframe_m
        turned = abs(x_keyframe_body[2]) > self._config.keyframe_rad
        is_keyframe = bool(self._is_mapping and match is not None and (moved or turned))
        self._wanted = view if is_keyframe else None
        count = 0 if match is None or view.scan is None else round(match.on_walls * len(view.scan))
        return Estimate(
            frame.id, frame.stamp_ns, status, reason, self._keyframe, SE3(placed.T_keyframe_body),
            SE3(T_world_body), in_world, count, is_keyframe, view.clock.laps,
        )  # fmt: skip

    # ---- parts ----

    def _says_nothing(self, view: ScanView) -> str:
        """Say why a scan says nothing; empty if it does."""
        if view.scan is None:
            return "no scan"
        if len(view.scan) >= self._config.min_hits:
            return ""
        scan = view.scan
        return (
            f"{len(scan)} of {scan.num_beams} beams came back within reach, "
            f"{self._config.min_hits} needed"
        )

    def _match(self, scan: ScanPoints, is_known: bool) -> GridMatch:
        """Lay a scan onto the older active submap."""
        submap, config = self._submaps.active[0], self._config
        grid, x = submap.grid, submap.x_anchor_body
        if self._is_lost and not is_known:
            found = GridPyramid(grid).search(scan.hits, x, config.lost_reach, np.pi, 0.4)
            return lay_on_grid(scan, grid, x if found is None else found.x_grid_body)
        prior = np.asarray(np.linalg.inv(submap.covariance))
        if not is_known:
            x = search_near(grid, scan.hits, x, config.search, config.search_rad)
        match = lay_on_grid(scan, grid, x, prior, submap.x_anchor_body)
        off = between_planar(submap.x_anchor_body, match.x_grid_body)
        if is_known and (match.on_walls < config.few_on_walls or off @ prior @ off > SURPRISE):
            return self._match_anew(scan, match)
        return match

    def _match_anew(self, scan: ScanPoints, match: GridMatch) -> GridMatch:
        """Look for a scan as if there was no odometry, as wheels slip, and some logs have it of
        another instant; stay with a match unless clearly more of the scan meets walls elsewhere."""
        submap, config = self._submaps.active[0], self._config
        grid, expected = submap.grid, submap.x_anchor_body
        x = search_near(grid, scan.hits, expected, config.slip_m, config.slip_rad)
        wide = np.diag([config.slip_m, config.slip_m, config.slip_rad]) ** 2
        prior = np.asarray(np.linalg.inv(submap.covariance + wide))
        again = lay_on_grid(scan, grid, x, prior, expected)
        if max(again.on_walls, match.on_walls) < config.few_on_walls:
            window = expected, 2.0 * config.slip_m, 3.0 * config.slip_rad
            found = GridPyramid(grid).search(scan.hits, *window, config.min_on_walls)
            if found is not None:
                x = found.x_grid_body
                farther = lay_on_grid(scan, grid, x, prior, expected)
                again = max(again, farther, key=lambda each: each.on_walls)
        if again.on_walls < match.on_walls + MORE_ON_WALLS:
            return match
        self._submaps.move(np.zeros(3), wide)
        self._since = self._since + wide
        return again

    def _motion(self, frame: Frame) -> tuple[Array, Array, bool]:
        """Return the motion (3,) since the last frame, its noise (3, 3), and if it is measured."""
        config, before = self._config, self._odometry
        seconds = max((frame.stamp_ns - self._stamp_ns) * 1e-9, 0.0)
        self._stamp_ns = max(frame.stamp_ns, self._stamp_ns)
        self._odometry = self._read_odometry(frame)
        is_known = before is not None and self._odometry is not None
        if before is not None and self._odometry is not None:
            motion, share = between_planar(before, self._odometry), config.slip
            least = config.jitter, config.jitter_rad
        else:
            least = config.shake, config.shake_rad
            usual = self._step_s if self._step_s > 0.0 else seconds
            motion = self._step * (min(seconds / usual, 3.0) if usual > 0.0 else 1.0)
            share = config.unsteady
        way, turn = float(np.hypot(*motion[:2])), abs(float(motion[2]))
        sigma = least[0] + share * way + 0.2 * config.slip * turn
        sigma_rad = least[1] + share * turn + config.veer * way
        return motion, np.diag([sigma, sigma, sigma_rad]) ** 2, is_known

    def _read_odometry(self, frame: Frame) -> Array | None:
        if frame.odometry is None or not self._config.use_odometry:
            return None
        return to_plane(frame.odometry)

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
        keyframe = Keyframe(k, view.frame.stamp_ns, scan=view.frame.scan)
        # In the plane exactly: what corrections round, one on top of the other, would add up.
        T_world_body = from_plane(to_plane(T_world_body))
        self._map.add_keyframe(keyframe, T_world_body, parent=parent, covariance=covariance)
        self._submaps.add(k, scan, self._unknown * self._since)
        self._keyframe, self._since = k, np.zeros((3, 3))
        return k
