"""Tracking from the last keyframe: its landmarks are followed into every frame by optical flow.

That costs little, and finds nearly all of them to a twentieth of a pixel, as long as the view
changes slowly. When it has changed enough the frame becomes the next keyframe. What was seen before
the last keyframe is not looked for here; that is left to the mapper, between keyframes.

Reference: Nistér, Naroditsky, Bergen, "Visual Odometry", CVPR 2004; Mur-Artal, Tardós, "ORB-SLAM2",
T-RO 2017 (stereo keyframes).
"""

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_inverse
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.system.association import Association, Reference, View
from odomap.system.config import Config
from odomap.system.dispute import SETTLED
from odomap.system.eye import Eye
from odomap.system.keyframing import Keyframes
from odomap.system.locating import Located, Locator
from odomap.system.looking import Look
from odomap.system.path import Placed
from odomap.system.relocalization import relocalize
from odomap.system.starting import Start, Started
from odomap.system.tracking import Tracker

__all__ = ["KeyframeTracker"]

Array = NDArray[np.float64]


class KeyframeTracker(Tracker[Reference]):
    """Places frames against the last keyframe.

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
        super().__init__(map, eye, association, start, config.tracking)
        self._keyframes, self._config = keyframes, config
        self._locator = Locator(association, eye.camera, eye.T_body_camera, config.noise)
        self._reference: Reference | None = None
        self._epoch = map.epoch

    def _begun(self, started: Started) -> None:
        self._reference, self._epoch = started.reference, self._map.epoch

    def _known(self) -> Reference | None:
        """Return the last keyframe, with what the mapper has changed since it was made."""
        if self._reference is not None and self._epoch != self._map.epoch:
            self._epoch = self._map.epoch
            self._reference = self._keyframes.refreshed(self._reference)
        return self._reference

    def _try(self, view: View, known: Reference, T_world_body: Array, needed: int) -> Located:
        points = self._map.points_world(known.landmark_ids)
        is_settled = self._map.count_observers(known.landmark_ids) >= SETTLED
        T_reference = self._map.T_world_body(known.keyframe_id)
        return self._locator.locate(view, known, points, is_settled, T_reference, T_world_body)

    def _without_guess(self, view: View, known: Reference) -> tuple[Reference, Located] | None:
        """Compare descriptors with those of the last keyframe."""
        T_world_camera = relocalize(
            view,
            known,
            self._map.points_world(known.landmark_ids),
            self._eye.camera,
            self._config.features,
            self._config.matching,
            self._eye.mask,
            self._config.tracking.min_inliers,
        )
        if T_world_camera is None:
            return None
        T_guess = T_world_camera @ se3_inverse(self._eye.T_body_camera)
        return known, self._try(view, known, T_guess, 0)

    def _wants_keyframe(self, known: Reference, located: Located) -> bool:
        config = self._config.tracking
        return bool(
            self._since_keyframe >= config.keyframe_interval
            or located.num_inliers < config.keyframe_ratio * self._first_count
            or self._motion_px(known, located) > config.keyframe_motion * self._eye.camera.width
        )

    def _missing(self, frame: Frame) -> str:
        return self._keyframes.missing(frame)

    def _make_keyframe(self, look: Look, known: Reference, located: Located, placed: Placed) -> int:
        """Make the frame a keyframe; the mapper will know its pose better."""
        T_world_body, inliers = located.T_world_body, located.inliers
        rows, pixels = located.rows[inliers], located.pixels[inliers]
        seen = self._keyframes.measure(look.frame, look.view, T_world_body, known, rows, pixels)
        covariance = self.path.covariance(placed)
        self._reference = self._keyframes.add(
            look.view, T_world_body, seen, known.keyframe_id, covariance
        )
        return self._reference.keyframe_id
