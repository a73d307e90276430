"""Tracking against the map: every frame is placed by all landmarks around that it shows.

The features of a frame are matched to the local map (`localmap`, `maplocating`). Frames hang from
the keyframe that shares most landmarks with them, which need not be the last one: a camera that
comes back to a place is tracked against what was mapped there. A frame becomes a keyframe when it
shows clearly less of the map than its keyframe, that is, something new; not where the map knows
the place already (`passed`).

When a frame cannot be placed from where it is expected, it is looked up in the whole map by what it
shows (`recognition`). Where the map is not to be changed, no keyframe is made.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section V.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_inverse
from odomap.maps.estimate import Estimate, Status
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.system.association import Association, View
from odomap.system.config import Config
from odomap.system.eye import Eye
from odomap.system.keyframing import Keyframes
from odomap.system.localmap import LocalMap, local_map
from odomap.system.locating import Located
from odomap.system.looking import Look, doubt
from odomap.system.maplocating import MapLocator
from odomap.system.passed import Passed
from odomap.system.path import Placed
from odomap.system.recognition import Recognizer
from odomap.system.starting import Start, Started
from odomap.system.tracking import Tracker
from odomap.system.trail import Trail

__all__ = ["MapTracker"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

SHARE = 0.3
"""Part of the likely landmarks that must agree before others are looked for."""
RECOGNISED = 2
"""How many times the inliers of a tracked frame one that was recognised must have."""
AGREE = 0.5
"""Part of the landmarks found there that must agree; by chance it is a third at most."""
FULLY = 0.9
"""A frame that shows this part of what its keyframe showed adds nothing, however late it comes."""
STILL = 0.005
"""A camera whose landmarks moved by less than this part of the image has seen nothing new."""


class MapTracker(Tracker[LocalMap]):
    """Places frames against the local map.

    Args:
        map: where keyframes go.
        eye: the camera.
        association: finds and describes features.
        keyframes: makes keyframes.
        start: makes the first ones.
        config: all sections.
        recognizer: finds views in the whole map.
        is_mapping: whether keyframes are made.
    """

    def __init__(
        self,
        map: Map,
        eye: Eye,
        association: Association,
        keyframes: Keyframes,
        start: Start,
        config: Config,
        recognizer: Recognizer,
        is_mapping: bool = True,
    ) -> None:
        super().__init__(map, eye, association, start, config.tracking)
        self._keyframes, self._config, self._is_mapping = keyframes, config, is_mapping
        self._locator = MapLocator(
            eye.camera, eye.T_body_camera, config.orb, config.matching, config.local, config.noise
        )
        self._recognizer = recognizer
        self._is_given = map.num_keyframes > 0
        self._local: LocalMap | None = None
        self._epoch = map.epoch
        self._due: tuple[int, Array] | None = None
        self._shown = np.empty(0, np.int64)
        self._most_shown = 0
        self._is_single = config.tracking.sensors == "mono"
        self._expected_often: list[Index] = []
        self._seen_often: list[Index] = []
        self._passed = Passed(int(map.keyframe_ids.max(initial=-1)))
        self._trail = Trail()

    # ---- the local map ----

    def _begun(self, started: Started) -> None:
        keyframe_id = started.reference.keyframe_id
        self._turn_later(keyframe_id, self._map.T_world_body(keyframe_id))
        self._shown = started.reference.landmark_ids
        self._most_shown = started.count
        self._trail.forget()

    def _known(self) -> LocalMap | None:
        """Return the local map, read again where the mapper has changed the map."""
        due, is_changed = self._due, self._epoch != self._map.epoch
        if due is None and self._local is not None and is_changed:
            due = self._local.keyframe_id, self.path.last_pose()
        if due is not None:
            self._turn_to(due[0], self.path.last_pose() if is_changed else due[1])
            if is_changed:
                self._shown = self._map.resolve(self._shown)
                if self._is_single and self._local is not None:
                    # What the mapper has made since no frame has shown, but the keyframe sees it.
                    self._shown = np.union1d(self._shown, self._local.seen_ids)
        return self._local

    def _turn_later(self, keyframe_id: int, T_world_body: Array) -> None:
        """Take the surroundings of a keyframe as the local map when it is asked for.

        A new keyframe is no sooner there than the mapper changes what is around it.
        """
        self._count()
        self._passed.add(keyframe_id)
        self._due, self._epoch = (keyframe_id, T_world_body), self._map.epoch

    def _turn_to(self, keyframe_id: int, T_world_body: Array) -> None:
        """Take the surroundings of a keyframe as the local map."""
        self._count()
        self._due, self._epoch = None, self._map.epoch
        self._local = self._around(keyframe_id, T_world_body)

    def _around(self, keyframe_id: int, T_world_body: Array) -> LocalMap:
        """Return the local map around a keyframe, or around the one that holds its stub."""
        alive = keyframe_id
        if not self._map.is_keyframe_alive(keyframe_id):
            alive = self._map.parent(keyframe_id)
        ranger = self._keyframes.ranger
        return local_map(
            self._map,
            alive,
            T_world_body,
            self._eye.T_body_camera,
            None if ranger is None else ranger.sigma,
            self._config.local,
        )

    def _count(self) -> None:
        """Tell the map how often landmarks were expected, and found."""
        for counted, tell in (
            (self._expected_often, self._map.count_expected),
            (self._seen_often, self._map.count_seen),
        ):
            if counted and self._is_mapping:
                tell(np.concatenate(counted))
            counted.clear()

    # ---- placing ----

    def _try(self, view: View, known: LocalMap, T_world_body: Array, needed: int) -> Located:
        likely = known.rows_of(self._shown)
        # Of those that are likely as large a part is asked for as of all.
        share = max(self._tracking.min_inliers, int(SHARE * len(likely)))
        needed = min(needed, share)
        return self._locator.locate(view, known, likely, T_world_body, needed)

    def _begin(self, look: Look) -> Estimate:
        """Start; in a map that was there before, where the view is recognised.

        Lost in it for long, the tracker begins a new piece if it may, as in a map of its own.
        """
        if not self._is_given or (self._is_mapping and len(self.path)):
            return super()._begin(look)
        found = self._recognised(look.view)
        look.clock.lap("recognise")
        if isinstance(found, str):
            return self._lose(look.frame, f"not recognised: {found}", look.clock)
        known, located = found
        self._since_keyframe = 0
        return self._accept(look, known, located, Status.RECOVERED)

    def _without_guess(self, view: View, known: LocalMap) -> tuple[LocalMap, Located] | None:
        """Look the view up in the whole map."""
        found = self._recognised(view)
        return None if isinstance(found, str) else found

    def _recognised(self, view: View) -> tuple[LocalMap, Located] | str:
        """Place a view by what it shows alone; or say why that cannot be."""
        near = self.path.last_pose() @ self._eye.T_body_camera if len(self.path) else None
        found = self._recognizer.find(
            view.descriptors,
            view.corners.keypoints,
            view.corners.level,
            view.frame_id,
            guess=near,
        )
        if isinstance(found, str):
            return found
        T_world_body = found.T_world_camera @ se3_inverse(self._eye.T_body_camera)
        known = self._around(found.keyframe_id, T_world_body)
        likely = known.rows_of(found.landmark_ids)
        located = self._locator.locate(view, known, likely, T_world_body, 0)
        count, matched = located.num_inliers, len(located.rows)
        # Near any pose some of the many landmarks there find a feature that looks like them.
        needed = max(RECOGNISED * self._tracking.min_inliers, int(AGREE * matched))
        if count < needed:
            return f"{count} inliers of {needed} needed, of {matched} landmarks that were found"
        return known, located

    def _accept(self, look: Look, known: LocalMap, located: Located, status: Status) -> Estimate:
        """Accept a frame, and turn to the keyframe that shares most landmarks with it."""
        if known is not self._local:  # it was recognised there
            self._local, self._due, self._epoch = known, None, self._map.epoch
        shown = known.landmark_ids[located.rows[located.inliers]]
        estimate = super()._accept(look, known, located, status)
        if not estimate.is_keyframe:
            self._shown = shown
            self._expected_often.append(known.landmark_ids[located.expected_rows])
            self._seen_often.append(shown)
            if not self._veil.is_shown:
                self._trail.add(len(self.path) - 1, look.view, shown)
            sharing, _ = self._map.observing(shown)
            if len(sharing) and sharing[0] != known.keyframe_id:
                self._turn_later(int(sharing[0]), located.T_world_body)
        return estimate

    def place_again(self) -> None:
        """Place the frames since the last keyframe again, in the map as it has become since.

        One that cannot be found where it hangs stays there.
        """
        for frame in self._trail.not_at_rest(self._map.epoch):
            before, view = self.path[frame.place], frame.view
            T_world_body = self._map.place(before.keyframe_id, before.T_keyframe_body)
            known = self._around(before.keyframe_id, T_world_body)
            likely = known.rows_of(self._map.resolve(frame.landmark_ids))
            located = self._locator.locate(view, known, likely, T_world_body, 0)
            located = self._of_one_piece(known, located)
            if not doubt(
                located, self._tracking.min_inliers, self._coverage, view, self._eye.camera
            ):
                pose = located.T_world_body, located.covariance
                after = self.path.hang(before.stamp_ns, known.keyframe_id, *pose)
                self.path.replace(frame.place, after)

    # ---- keyframes ----

    def _wants_keyframe(self, known: LocalMap, located: Located) -> bool:
        config = self._config.tracking
        if not self._is_mapping:
            return False
        # A single camera's landmarks come from the mapper, some frames late: what the keyframe
        # itself has shown counts until then, and the most that was shown since.
        self._most_shown = max(self._most_shown, located.num_inliers)
        base = self._most_shown if self._is_single else self._first_count
        # Of a place seen before as much is wanted as was seen there, not as at the last keyframe.
        shown = located.num_inliers / max(min(base, known.num_seen), 1)
        if shown < config.keyframe_ratio:
            return not self._is_seen_before(known, located)
        motion = self._motion_px(known, located) / self._eye.camera.width
        is_due = self._since_keyframe >= config.keyframe_interval
        is_due = is_due and motion > STILL and shown < FULLY
        return is_due and not self._is_seen_before(known, located)

    def _is_seen_before(self, known: LocalMap, located: Located) -> bool:
        """Say whether the last view shows a place that the map knows already."""
        assert self._last is not None
        anchors = self._map.anchors(known.landmark_ids[located.rows[located.inliers]])
        found, features = located.pixels[located.inliers], self._last.corners.keypoints
        return self._passed.is_known(anchors, found, features, self._eye.camera.width)

    def _missing(self, frame: Frame) -> str:
        return self._keyframes.missing(frame)

    def _make_keyframe(self, look: Look, known: LocalMap, located: Located, placed: Placed) -> int:
        """Make the frame a keyframe with all that it shows of the map."""
        T_world_body, inliers = located.T_world_body, located.inliers
        rows, pixels = located.rows[inliers], located.pixels[inliers]
        ids = known.landmark_ids[rows]
        seen = self._keyframes.measure_found(look.frame, look.view, T_world_body, ids, pixels)
        covariance = self.path.covariance(placed)
        made = self._keyframes.add(look.view, T_world_body, seen, known.keyframe_id, covariance)
        self._turn_later(made.keyframe_id, T_world_body)
        self._shown = made.landmark_ids
        self._most_shown = located.num_inliers
        self._recognizer.keep_up()
        self._trail.forget()
        return made.keyframe_id

    def _may_start_anew(self) -> bool:
        return self._is_mapping
