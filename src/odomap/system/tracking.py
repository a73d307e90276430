"""Tracking: the stage that places every frame and makes the keyframes, whatever the camera.

A frame is placed against landmarks that are known. When the view has changed enough it becomes a
keyframe itself (`keyframing`). How the first keyframes come about is all that differs between a
camera with depth and one without (`starting`). Two trackers have this face: one follows the
landmarks of the last keyframe by optical flow (`keyframetracking`), the other searches for those of
the local map by their descriptors (`maptracking`).

Images are made ready, frames placed and keyframes made in three separate steps: only the last two
need the map, and who waits for a pose need not wait for the keyframe (`stages`).

When too few landmarks agree with a pose the frame is lost, and says so. It is tried from where it
is expected, from how the image turned, from where it was, and without any guess; if that fails for
some frames, tracking starts anew where it was last, with a covariance that admits it.

Reference: Nistér, Naroditsky, Bergen, "Visual Odometry", CVPR 2004; Mur-Artal, Tardós, "ORB-SLAM2",
T-RO 2017 (stereo keyframes).
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_exp
from odomap.geometry.pose import SE3
from odomap.maps.estimate import Estimate, Status, Tracks
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.system.association import Association, TrackingConfig, View
from odomap.system.clock import Clock
from odomap.system.dispute import FEWEST, SETTLED
from odomap.system.eye import Eye
from odomap.system.keyframing import Keyframes
from odomap.system.locating import Located
from odomap.system.looking import Look, Looker, Unseen, doubt
from odomap.system.path import ASTRAY, Path, Placed
from odomap.system.starting import Start, Started, Waiting
from odomap.system.veil import VEILED, Veil
from odomap.vision.coverage import coverage
from odomap.vision.turning import Thumbnail, turn_between

__all__ = ["Known", "Tracker"]

Array = NDArray[np.float64]


class Known(Protocol):
    """Landmarks that a frame is placed against.

    Attributes:
        keyframe_id: the keyframe that the frame will hang from.
        landmark_ids: (N,) the landmarks.
        keypoints: (N, 2) where they are in that keyframe, NaN where it does not see them.
    """

    @property
    def keyframe_id(self) -> int: ...  # noqa: D102 (see the class)

    @property
    def landmark_ids(self) -> NDArray[np.int64]: ...  # noqa: D102

    @property
    def keypoints(self) -> Array: ...  # noqa: D102


K = TypeVar("K", bound=Known)

WELL = 2
"""How many times the inliers needed must be settled for that to be believed."""
SHOWS = 0.15
"""Part of the landmarks expected there that must show, further off than one such deviation."""
CLEARLY = 1.5
"""How many times the settled landmarks of the tracked pose must agree with another to win."""


@dataclass(frozen=True, eq=False)
class Wanted(Generic[K]):
    """A placed frame that is to become a keyframe."""

    look: Look
    known: K
    located: Located
    placed: Placed


class Tracker(ABC, Generic[K]):
    """Places the frames of a camera in a map.

    Args:
        map: where keyframes go.
        eye: the camera.
        association: makes images ready.
        start: makes the first keyframes.
        config: how frames are placed and when one becomes a keyframe.

    Attributes:
        path: the frames placed so far.
    """

    _keyframes: Keyframes
    """What makes keyframes: each tracker has its own."""

    def __init__(
        self, map: Map, eye: Eye, association: Association, start: Start, config: TrackingConfig
    ) -> None:
        self._map, self._eye, self._looker = map, eye, Looker(eye, association)
        self._start, self._tracking = start, config
        self._veil = Veil(map, eye)
        self._last: View | None = None
        self.path = Path(map)
        self._since_keyframe = self._lost = self._first_count = self._piece = 0
        self._coverage = config.min_coverage
        self._wanted: Wanted[K] | None = None
        self._made: int | None = None

    # ---- what trackers differ in ----

    @abstractmethod
    def _known(self) -> K | None:
        """Return what the next frame is placed against, as the map is now; None before a start."""

    @abstractmethod
    def _begun(self, started: Started) -> None:
        """Take in the first keyframes."""

    @abstractmethod
    def _try(self, view: View, known: K, T_world_body: Array, needed: int) -> Located:
        """Place a view from a predicted pose."""

    @abstractmethod
    def _without_guess(self, view: View, known: K) -> tuple[K, Located] | None:
        """Place a view without a predicted pose; None if that is not possible."""

    @abstractmethod
    def _wants_keyframe(self, known: K, located: Located) -> bool:
        """Say whether it is time for a keyframe."""

    @abstractmethod
    def _missing(self, frame: Frame) -> str:
        """Say what a frame lacks to become a keyframe; empty if it has all."""

    @abstractmethod
    def _make_keyframe(self, look: Look, known: K, located: Located, placed: Placed) -> int:
        """Make the frame a keyframe; return its id."""

    # ---- tracking ----

    def prepare(self, frame: Frame) -> Look | Unseen:
        """Find the features of a frame, without looking at the map."""
        return self._looker.look(frame, is_begun=len(self.path) > 0)

    def track(self, look: Look | Unseen) -> Estimate:
        """Place a frame; if it is to become a keyframe, `make_keyframe` makes it one."""
        look.clock.resume()
        self._made = None
        if isinstance(look, Unseen):
            return self._lose(look.frame, look.reason, look.clock)
        known = self._known()
        if known is None:
            return self._begin(look)
        known, located, status = self._locate(self._veil.lifted(look.view), known)
        located = self._of_one_piece(known, located)
        look.clock.lap("track")
        needed = self._tracking.min_inliers, self._coverage
        reason = doubt(located, *needed, look.view, self._eye.camera)
        if not reason:
            return self._accept(look, known, located, status)
        is_patient = self._lost < self._tracking.patience or self._veil.is_shown
        if not is_patient and self._may_start_anew():
            return self._begin(look)
        return self._lose(look.frame, reason, look.clock)

    def make_keyframe(self) -> Keyframe | None:
        """Make the last frame a keyframe, if it is to be one; return it once it is in the map."""
        wanted, self._wanted = self._wanted, None
        if wanted is not None:
            self._made = self._make_keyframe(
                wanted.look, wanted.known, wanted.located, wanted.placed
            )
            hangs = Placed(wanted.placed.stamp_ns, self._made, np.eye(4), np.zeros((6, 6)))
            self.path.replace_last(hangs)
            self._since_keyframe = 0
        made, self._made = self._made, None
        return None if made is None else self._map.keyframe(made)

    def _may_start_anew(self) -> bool:
        """Say whether one that is lost for long may begin again."""
        return True

    # ---- the three ways a frame can go ----

    def _begin(self, look: Look) -> Estimate:
        """Start, or start anew after a loss."""
        frame, anew = look.frame, len(self.path) > 0
        T_world_body, covariance = self.path.last_pose(), self.path.gap_covariance(frame.stamp_ns)
        started = self._start.begin(frame, look.view, T_world_body, covariance)
        look.clock.lap("keyframe")
        if isinstance(started, Waiting):
            return self._lose(frame, started.reason, look.clock)
        self._since_keyframe, self._lost = 0, 0
        self._first_count = started.count
        self._begun(started)
        self._piece = int(started.reference.landmark_ids.min()) if anew else 0
        self._made = started.placed[-1].keyframe_id
        # Where all there is to see is a strip, no more can be asked for.
        begun = coverage(started.reference.keypoints, self._eye.camera)
        self._coverage = min(self._tracking.min_coverage, 0.5 * begun)
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

    def _accept(self, look: Look, known: K, located: Located, status: Status) -> Estimate:
        """Turn a placed view into an estimate, and into a keyframe if it is time for one."""
        if self._lost:
            self._start.forget()
        self._lost, self._last = 0, look.view
        self._since_keyframe += 1
        if self._since_keyframe == 1:
            self._first_count = located.num_inliers
        placed = self.path.hang(
            look.frame.stamp_ns, known.keyframe_id, located.T_world_body, located.covariance
        )
        before = known.keypoints[located.rows]
        before = np.where(np.isfinite(before), before, located.pixels)
        tracks = Tracks(
            self._eye.to_raw(located.pixels).astype(np.float32),
            self._eye.to_raw(before).astype(np.float32),
            located.inliers,
        )
        reason, is_keyframe = "", self._wants_keyframe(known, located)
        if status is Status.TRACKING and (moved := self.path.correction()):
            status, reason = Status.RECOVERED, moved
        if is_keyframe and (missing := self._missing(look.frame)):
            reason, is_keyframe = f"{missing}: no keyframe", False
        if is_keyframe and self._veil.hides(
            look.frame, look.view, known.landmark_ids, located, self._keyframes.ranger
        ):
            reason, is_keyframe = f"{VEILED}: no keyframe", False
        self._wanted = Wanted(look, known, located, placed) if is_keyframe else None
        return self._estimate(
            look, status, reason, placed, located.num_inliers, is_keyframe, tracks
        )

    def _lose(self, frame: Frame, reason: str, clock: Clock) -> Estimate:
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
            self.path.gap_covariance(frame.stamp_ns),
            timing=clock.laps,
        )

    def _estimate(
        self,
        look: Look,
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

    def _locate(self, view: View, known: K) -> tuple[K, Located, Status]:
        """Try the motions that are likely, then without a guess."""
        T_last = self.path.last_pose()
        tracked = Status.RECOVERED if self._lost else Status.TRACKING
        enough = int(max(self._tracking.min_inliers, 0.3 * self._first_count))
        best: Located | None = None
        for motion in self._motions(view):
            located = self._try(view, known, T_last @ motion, enough)
            if located.num_inliers >= enough:
                return known, located, tracked
            best = located if best is None or located.num_inliers > best.num_inliers else best
        assert best is not None
        again = self._without_guess(view, known)
        is_likely = again is not None and self._is_likely(*again, view.stamp_ns)
        if again is not None and is_likely and self._convinces(again, (known, best)):
            return *again, Status.RECOVERED
        if best.num_inliers >= self._tracking.min_inliers:
            best = self._try(view, known, best.T_world_body, 0)
        # Few agree: if that is somewhere else than expected, it is not as if all was well.
        steady = T_last @ next(self._motions(view))
        leaps = self.path.is_leap(steady, best.T_world_body, best.covariance)
        return known, best, Status.RECOVERED if leaps else tracked

    def _convinces(self, again: tuple[K, Located], tracked: tuple[K, Located]) -> bool:
        """Say whether a pose found without a guess is to be believed rather than the tracked one.

        What many new landmarks say is worth nothing where settled ones speak against it: they may
        be on a thing that moves. A pose that goes on as before needs clearly better reasons to be
        given up.
        """
        if tracked[1].num_inliers < self._tracking.min_inliers:
            return again[1].num_inliers > tracked[1].num_inliers
        votes, against = self._count_settled(*again), self._count_settled(*tracked)
        if against < FEWEST:
            return again[1].num_inliers > tracked[1].num_inliers
        return votes > CLEARLY * against

    def _of_one_piece(self, known: K, located: Located) -> Located:
        """Leave out what is older than a new start, until enough of it agrees.

        Where the body is in the older piece of the map is not known, so a few of its landmarks
        are found by chance; as observations they would tie the pieces together wrongly.
        """
        is_older = located.inliers & (known.landmark_ids[located.rows] < self._piece)
        if int(is_older.sum()) < self._tracking.min_inliers:
            return replace(located, inliers=located.inliers & ~is_older)
        self._piece = 0
        return located

    def _is_likely(self, known: K, located: Located, stamp_ns: int) -> bool:
        """Say whether the body may be there: near enough for the time unseen, or well attested."""
        moved = np.linalg.norm(located.T_world_body[:3, 3] - self.path.last_pose()[:3, 3])
        sigma = np.sqrt(np.trace(self.path.gap_covariance(stamp_ns)[:3, :3]))
        settled, least = self._count_settled(known, located), self._tracking.min_inliers
        if self._veil.is_shown and settled < least:  # the others may be on what hides the known
            return False
        if moved <= sigma:
            return True
        # One of many identical doors looks right, but not what must show around it.
        shows = located.num_inliers >= SHOWS * located.expected
        return shows and (bool(moved <= ASTRAY * sigma) or settled >= WELL * least)

    def _count_settled(self, known: K, located: Located) -> int:
        """Count the settled landmarks that agree with a pose."""
        ids = known.landmark_ids[located.rows[located.inliers]]
        return int(np.count_nonzero(self._map.count_observers(ids) >= SETTLED))

    def _motions(self, view: View) -> Iterator[Array]:
        """Yield how the body may have moved: steadily, as the images turned, not at all."""
        seconds = (view.stamp_ns - self.path.last.stamp_ns) * 1e-9
        steady = se3_exp(self.path.velocity() * min(seconds, self._tracking.max_prediction_s))
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

    def _motion_px(self, known: K, located: Located) -> float:
        """Return by how much landmarks have moved in the image since the keyframe, the median."""
        moved = located.pixels - known.keypoints[located.rows]
        by = np.linalg.norm(moved[located.inliers], axis=1)
        by = by[np.isfinite(by)]
        return float(np.median(by)) if len(by) else np.inf
