"""A start in a map that is there already: the first frame is recognised, and hangs from it.

Features on all levels of the image are compared with those of the map's keyframes; the landmarks
found tell where the frame was taken. It becomes a keyframe that sees them, and from then on
tracking is as if the map had never been away.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section V-C.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_adjoint, se3_inverse
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.system.association import View
from odomap.system.eye import Eye
from odomap.system.keyframing import Keyframes
from odomap.system.path import Placed
from odomap.system.recognition import Recognizer
from odomap.system.starting import Started, Waiting
from odomap.vision.orb import OrbConfig, extract

__all__ = ["RecognisedStart"]

Array = NDArray[np.float64]


class RecognisedStart:
    """Starts where a view is recognised.

    Args:
        map: with keyframes and landmarks.
        eye: the camera.
        keyframes: makes keyframes.
        recognizer: knows the places of the map.
        orb: how features are found.
    """

    anew = "found again in the map"

    def __init__(
        self, map: Map, eye: Eye, keyframes: Keyframes, recognizer: Recognizer, orb: OrbConfig
    ) -> None:
        self._map, self._eye, self._keyframes = map, eye, keyframes
        self._recognizer, self._orb = recognizer, orb

    def begin(
        self, frame: Frame, view: View, T_world_body: Array, covariance: Array
    ) -> Started | Waiting:
        """Start with a keyframe that sees what was recognised."""
        missing = self._keyframes.missing(frame)
        if missing:
            return Waiting(f"{missing}: cannot start")
        seen = extract(view.image, self._orb, self._eye.mask)
        found = self._recognizer.find(seen.descriptors, seen.keypoints, seen.level, view.frame_id)
        if isinstance(found, str):
            return Waiting(f"not recognised: {found}")
        T_camera_body = se3_inverse(self._eye.T_body_camera)
        T_world_body = found.T_world_camera @ T_camera_body
        T_body_known = se3_inverse(T_world_body) @ self._map.T_world_body(found.keyframe_id)
        Ad, Ad_known = (se3_adjoint(T) for T in (self._eye.T_body_camera, T_body_known))
        known = self._map.covariance(found.keyframe_id)
        sure = Ad_known @ known @ Ad_known.T + Ad @ found.covariance @ Ad.T
        pixels = seen.keypoints[found.rows].astype(np.float64)
        shown = self._keyframes.measure_found(frame, view, T_world_body, found.landmark_ids, pixels)
        made = self._keyframes.add(view, T_world_body, shown, found.keyframe_id, sure)
        placed = Placed(frame.stamp_ns, made.keyframe_id, np.eye(4), np.zeros((6, 6)))
        return Started(made, (placed,), len(found.rows))

    def forget(self) -> None:
        """Do nothing: nothing is begun that is not done."""
