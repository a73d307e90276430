"""Starting: the first keyframes, from nothing.

Where depth is measured, one view is enough. A single camera needs two, far enough apart: corners
of a first view are followed until a second one allows to triangulate them (`vision.bootstrap`).
Both views are then adjusted together and become keyframes. The scale is free, and set once: the
median depth is 1 at the start, and what it was when tracking starts anew. From then on it lives in
the landmarks. The views between the two are placed when there are landmarks to place them with.

A start after a long loss begins a piece of the map (`maps/atlas`): its first keyframe hangs from
the one it was lost at by a gap, until a place seen before says where it is.

Reference: Klein, Murray, "Parallel Tracking and Mapping for Small AR Workspaces", ISMAR 2007.
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from odomap.backend.bundle import Bundle, BundleConfig, solve_bundle
from odomap.backend.motion import MotionSolution, Sightings, solve_motion
from odomap.geometry.lie import se3_adjoint, se3_exp, se3_inverse, se3_log
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.system.association import Association, Reference, View
from odomap.system.config import Config
from odomap.system.eye import Eye
from odomap.system.following import FollowedCorners
from odomap.system.keyframing import Keyframes
from odomap.system.path import Placed
from odomap.system.ranging import UNIT_BASELINE
from odomap.vision.bootstrap import BetweenView, TwoViewMotion, two_view_motion

__all__ = ["OneViewStart", "Start", "Started", "TwoViewsStart", "Waiting", "make_start"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MATCH_PATIENCE = 5
"""Views in a row in which a corner known by its descriptor may be missed."""
LEAST_FOLLOWED, LEAST_MATCHED = 0.4, 0.1
"""Part of the corners that must be found again: followed, or known by their descriptors, of which
many are not repeated."""
MOST_BETWEEN = 300
"""Frames between the two views that are remembered, and placed afterwards."""
MORE_PARALLAX = 1.2
"""By how much the parallax must grow before two views are tried again."""
LEAST_PARALLAX = 3.0
"""Standard deviations of a point's position; with less parallax it has no depth yet."""


@dataclass(frozen=True, eq=False)
class Started:
    """A start that was made.

    Attributes:
        reference: the newest keyframe.
        placed: frames that have a pose now, in order of time; the last is the one at hand.
        count: landmarks in the newest keyframe.
    """

    reference: Reference
    placed: tuple[Placed, ...]
    count: int


@dataclass(frozen=True)
class Waiting:
    """No start yet, and why."""

    reason: str


class Start(Protocol):
    """Makes the first keyframes."""

    anew: str
    """What to say of a start after a loss."""

    def begin(
        self, frame: Frame, view: View, T_world_body: Array, covariance: Array
    ) -> Started | Waiting:
        """Take the next frame.

        Args:
            frame: as it came.
            view: its image.
            T_world_body: (4, 4) where to begin.
            covariance: (6, 6) how sure that is.
        """
        ...

    def forget(self) -> None:
        """Drop what was begun: tracking goes on without."""
        ...


class OneViewStart:
    """Starts from one view whose depth is measured."""

    anew = "started anew where it was last: how it moved since is not known"

    def __init__(
        self, map: Map, keyframes: Keyframes, association: Association, config: Config
    ) -> None:
        self._map, self._keyframes = map, keyframes
        self._association, self._config = association, config
        self._is_checked = False

    def begin(
        self, frame: Frame, view: View, T_world_body: Array, covariance: Array
    ) -> Started | Waiting:
        """Start with a keyframe made from this view alone."""
        missing = self._keyframes.missing(frame)
        if missing:
            return Waiting(f"{missing}: cannot start")
        assert self._keyframes.ranger is not None, "one view needs measured depth"
        if not self._is_checked:  # a rig that was right once is not to blame for a strange view
            points, _ = self._association.extend(view, np.empty((0, 2)), 200)
            self._keyframes.ranger.check(frame, view, points)
        seen = self._keyframes.begin(frame, view)
        count = int(np.isfinite(seen.features.depth).sum())
        needed = 2 * self._config.tracking.min_inliers
        if count < needed:
            corners, _ = self._association.extend(view, np.empty((0, 2)), needed)
            why = "too dark or no texture?"
            if len(corners) >= needed:
                why = "there are corners, but their depth is unknown: too near, too far?"
            return Waiting(f"{count} points with depth of {needed} needed to start: {why}")
        self._is_checked = True
        made = self._keyframes.add(view, T_world_body, seen, -1, covariance)
        self._map.begin_piece(made.keyframe_id)
        placed = Placed(frame.stamp_ns, made.keyframe_id, np.eye(4), np.zeros((6, 6)))
        return Started(made, (placed,), count)

    def forget(self) -> None:
        """Do nothing: nothing is begun that is not done."""


@dataclass(frozen=True, eq=False)
class _Between:
    """A frame after the first view: which corners were found in it, and where."""

    stamp_ns: int
    rows: Index
    pixels: Array


class TwoViewsStart:
    """Starts from two views of a single camera.

    Args:
        map: where the landmarks go.
        eye: the camera.
        keyframes: makes keyframes.
        association: finds corners again.
        config: all sections.
    """

    anew = "started anew where it was last: the scale is new, how it moved since is not known"

    def __init__(
        self, map: Map, eye: Eye, keyframes: Keyframes, association: Association, config: Config
    ) -> None:
        self._map, self._eye, self._keyframes = map, eye, keyframes
        self._association, self._config = association, config
        self._corners: FollowedCorners | None = None
        self._between: list[_Between] = []
        self._needed_px = config.bootstrap.min_parallax_px
        follows = association.follows
        self._share = LEAST_FOLLOWED if follows else LEAST_MATCHED
        self._patience = 0 if follows else MATCH_PATIENCE

    def forget(self) -> None:
        """Drop the first view."""
        self._corners, self._between = None, []

    def begin(
        self, frame: Frame, view: View, T_world_body: Array, covariance: Array
    ) -> Started | Waiting:
        """Follow the corners of the first view; start when they tell the motion."""
        if self._corners is None:
            return self._look(view)
        corners = self._corners
        corners.follow(view)
        if len(corners.found) < max(self._config.bootstrap.min_points, self._share * len(corners)):
            again = self._look(view)
            return Waiting(f"the view changed before the motion was known; {again.reason}")
        found = two_view_motion(
            corners.corners[corners.found],
            corners.pixels,
            self._eye.camera,
            replace(self._config.bootstrap, min_parallax_px=self._needed_px),
            frame.id,
            self._views(corners),
        )
        started: Started | Waiting = Waiting(found.reason)
        if found.T_second_first is not None:
            adjusted = self._adjusted(corners, found)
            started = self._start(frame, view, T_world_body, covariance, corners, *adjusted)
        if isinstance(started, Waiting):
            self._between.append(_Between(frame.stamp_ns, corners.found, corners.pixels))
            self._between = self._between[-MOST_BETWEEN:]
            if found.parallax_px >= self._needed_px:  # tried in vain: views farther apart say more
                self._needed_px = MORE_PARALLAX * found.parallax_px
        return started

    def _look(self, view: View) -> Waiting:
        """Take a view as the first."""
        wanted, needed = self._association.count, 2 * self._config.bootstrap.min_points
        corners, descriptors = self._association.extend(view, np.empty((0, 2)), wanted)
        self.forget()
        self._needed_px = self._config.bootstrap.min_parallax_px
        if len(corners) < needed:
            why = f"{len(corners)} corners of {needed} needed to start"
            return Waiting(f"{why}: too dark or no texture?")
        self._corners = FollowedCorners(
            view, corners, descriptors, self._eye.camera, self._association, self._patience
        )
        return Waiting("a first view is taken: move the camera sideways")

    def _views(self, corners: FollowedCorners) -> list[BetweenView]:
        """Return the views between as rows of the corners found now."""
        at = np.full(len(corners), -1)
        at[corners.found] = np.arange(len(corners.found))
        views = [(at[b.rows], b.pixels) for b in self._between]
        return [BetweenView(rows[rows >= 0], pixels[rows >= 0]) for rows, pixels in views]

    def _adjusted(self, corners: FollowedCorners, found: TwoViewMotion) -> tuple[Array, Array]:
        """Adjust two views and their points; return T_first_second and the points, NaN if wrong.

        The distance of the two is 1.
        """
        assert found.T_second_first is not None
        good = np.flatnonzero(np.isfinite(found.points_first[:, 0]))
        Ts = np.stack([np.eye(4), found.T_second_first.inverse().matrix])
        n, camera = len(good), self._eye.camera
        pixels = np.concatenate([corners.corners[corners.found[good]], corners.pixels[good]])
        sigma = self._config.noise.position_px / camera.fx
        bundle = Bundle(
            Ts,
            np.array([True, False]),
            found.points_first[good],
            np.eye(4)[None],
            np.array([UNIT_BASELINE]),
            np.repeat([0, 1], n),
            np.tile(np.arange(n), 2),
            np.zeros(2 * n, np.int64),
            camera.undistort(pixels),
            np.full(2 * n, np.nan),
            np.full((2 * n, 2), 1.0 / sigma),
            is_scale_free=True,
        )
        solution = solve_bundle(bundle, BundleConfig(iterations=20, tolerance=1e-4))
        wrong = solution.chi2.reshape(2, n).max(axis=0) > self._config.window.gate**2
        # Nearly parallel rays give no depth yet; their points stay candidates.
        enough = found.parallax[good] >= LEAST_PARALLAX * sigma
        points = np.full((len(found.points_first), 3), np.nan)
        points[good] = np.where((wrong | ~enough)[:, None], np.nan, solution.points_world)
        return solution.Ts_world_body[1], points

    def _start(
        self,
        frame: Frame,
        view: View,
        T_world_body: Array,
        covariance: Array,
        corners: FollowedCorners,
        T_first_second: Array,
        points: Array,
    ) -> Started | Waiting:
        """Make keyframes of the two views, in a scale that fits what came before."""
        in_second = (points - T_first_second[:3, 3]) @ T_first_second[:3, :3]
        good = np.isfinite(points[:, 0]) & (points[:, 2] > 0) & (in_second[:, 2] > 0)
        if good.sum() < self._config.bootstrap.min_points:
            return Waiting(f"{good.sum()} points of {self._config.bootstrap.min_points} agree")
        scale = self._usual_depth() / float(np.median(in_second[good, 2]))
        T_body_camera, T_camera_body = self._eye.T_body_camera, se3_inverse(self._eye.T_body_camera)
        T_first_second = np.array(T_first_second)
        T_first_second[:3, 3] *= scale
        T_first_second = T_body_camera @ T_first_second @ T_camera_body
        points = scale * points @ T_body_camera[:3, :3].T + T_body_camera[:3, 3]
        points = np.where(good[:, None], points, np.nan)
        first = self._first_keyframe(T_world_body, covariance, corners, points)
        placed = [Placed(corners.first.stamp_ns, first.keyframe_id, np.eye(4), np.zeros((6, 6)))]
        placed += self._placed_between(first.keyframe_id, corners, points, T_first_second)
        rows = np.flatnonzero(good)
        pixels = corners.pixels[rows]
        here = self._motion(points[rows], pixels, T_first_second)
        Ad = se3_adjoint(se3_inverse(T_first_second))
        sure = Ad @ covariance @ Ad.T + self._config.noise.overlap * here.covariance
        T_world_second = T_world_body @ T_first_second
        index = np.arange(len(rows))
        seen = self._keyframes.measure(frame, view, T_world_second, first, index, pixels)
        second = self._keyframes.add(view, T_world_second, seen, first.keyframe_id, sure)
        placed.append(Placed(frame.stamp_ns, second.keyframe_id, np.eye(4), np.zeros((6, 6))))
        self.forget()
        return Started(second, tuple(placed), len(second.landmark_ids))

    def _usual_depth(self) -> float:
        """Return the median depth of the last keyframe with landmarks; 1 before there is one."""
        for keyframe_id in self._map.keyframe_ids[::-1].tolist():
            T = self._map.T_world_body(keyframe_id) @ self._eye.T_body_camera
            points = self._map.points_world(self._map.observations_of(keyframe_id)[0])
            depth = (points - T[:3, 3]) @ T[:3, 2]
            if (depth > 0).any():
                return float(np.median(depth[depth > 0]))
        return 1.0

    def _first_keyframe(
        self, T_world_body: Array, covariance: Array, corners: FollowedCorners, points: Array
    ) -> Reference:
        """Make the first view a keyframe, with what is triangulated as landmarks."""
        points_world = points @ T_world_body[:3, :3].T + T_world_body[:3, 3]
        pixels = corners.corners[corners.found]
        seen = self._keyframes.seen_first(corners.first, pixels, points_world)
        made = self._keyframes.add(corners.first, T_world_body, seen, -1, covariance)
        self._map.begin_piece(made.keyframe_id)
        return made

    def _placed_between(
        self, keyframe_id: int, corners: FollowedCorners, points: Array, T_first_second: Array
    ) -> list[Placed]:
        """Place the frames between the two views, from the landmarks they saw."""
        of_corner = np.full((len(corners), 3), np.nan)
        of_corner[corners.found] = points
        twist, placed = se3_log(T_first_second), []
        for k, between in enumerate(self._between):
            known = np.isfinite(of_corner[between.rows, 0])
            guess = se3_exp((k + 1) / (len(self._between) + 1) * twist)
            found = self._motion(of_corner[between.rows[known]], between.pixels[known], guess)
            if found.converged and found.inliers.sum() >= self._config.tracking.min_inliers:
                covariance = self._config.noise.overlap * found.covariance
                placed.append(Placed(between.stamp_ns, keyframe_id, found.T_world_body, covariance))
        return placed

    def _motion(self, points: Array, pixels: Array, guess: Array) -> MotionSolution:
        """Find a body's pose (4, 4) in the first keyframe from points (n, 3) of it."""
        camera = self._eye.camera
        sightings = Sightings(
            points,
            camera.undistort(pixels),
            np.full(len(points), np.nan),
            np.full((len(points), 2), camera.fx / self._config.noise.position_px),
        )
        T_camera_body = se3_inverse(self._eye.T_body_camera)
        return solve_motion(guess, T_camera_body, UNIT_BASELINE, sightings)


def make_start(
    map: Map, eye: Eye, keyframes: Keyframes, association: Association, config: Config
) -> Start:
    """Return the start for what an eye sees: one view where depth is measured, else two."""
    if keyframes.ranger is not None:
        return OneViewStart(map, keyframes, association, config)
    return TwoViewsStart(map, eye, keyframes, association, config)
