"""Places of a real flight are recognised in a map of it, to the centimetre; a street is not."""

import numpy as np
import pytest

from odomap.geometry.lie import se3_inverse
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sources.open import open as open_source
from odomap.system.recognition import Recognizer
from odomap.vision.features import Features
from odomap.vision.matching import MatchConfig
from odomap.vision.orb import OrbConfig, extract
from odomap.vision.rectifier import Rectifier
from odomap.vision.stereo import StereoConfig, match_sparse

EVERY = 10
"""Frames from one keyframe to the next."""


class Flight:
    """A map of every tenth frame at its true pose; landmarks are measured by the stereo pair."""

    def __init__(self, folder):
        self.source = open_source(folder)
        self.rectifier, self.map = Rectifier(self.source.rig), Map()
        self.recognizer = Recognizer(
            self.map, self.rectifier.camera, self.rectifier.T_body_camera, MatchConfig(), 30
        )
        for index in range(0, len(self.source), EVERY):
            self.remember(self.source.frame(index))

    def extract(self, frame):
        return extract(self.rectifier.rectify(frame.images[0], "left"), OrbConfig())

    def truth(self, frame):
        stamps = self.source.truth.stamps_ns
        row = int(np.argmin(np.abs(stamps - frame.stamp_ns)))
        assert abs(int(stamps[row]) - frame.stamp_ns) < 3_000_000
        return self.source.truth.Ts_world_body[row]

    def remember(self, frame):
        found, camera = self.extract(frame), self.rectifier.camera
        left, right = (
            self.rectifier.rectify(frame.images[i], s) for i, s in enumerate(("left", "right"))
        )
        at = found.keypoints.astype(float)
        disparity = match_sparse(left, right, at, StereoConfig())
        known = np.flatnonzero(disparity > 1)
        rays = camera.unproject(at)
        p = rays[known] / rays[known, 2:] * camera.fx * self.rectifier.baseline
        p = p / disparity[known, None]
        mount = self.rectifier.T_body_camera
        depth = np.full(len(found), np.nan)
        features = Features(found.keypoints, found.descriptors, rays, depth, found.level)
        k = Keyframe(self.map.new_keyframe_id(), frame.stamp_ns, features=features)
        self.map.add_keyframe(k, self.truth(frame))
        seen = p @ mount[:3, :3].T + mount[:3, 3]
        ids = self.map.add_landmarks(k.id, seen, found.descriptors[known])
        self.map.add_observations(k.id, ids, known)

    def find(self, frame):
        found = self.extract(frame)
        return self.recognizer.find(found.descriptors, found.keypoints, found.level, seed=frame.id)


@pytest.fixture(scope="module")
def flight(data_folder):
    return Flight(data_folder / "euroc_mh01")


def test_frames_between_keyframes_are_placed_to_the_centimetre(flight):
    for index in range(EVERY // 2, len(flight.source), EVERY):
        frame = flight.source.frame(index)
        found = flight.find(frame)
        assert not isinstance(found, str), found
        truth = flight.truth(frame) @ flight.rectifier.T_body_camera
        E = se3_inverse(truth) @ found.T_world_camera
        assert np.linalg.norm(E[:3, 3]) < 0.015
        assert np.degrees(np.arccos((np.trace(E[:3, :3]) - 1) / 2)) < 0.15
        # The covariance knows of pixels alone: it is small, and not beyond belief.
        assert 1e-4 < np.sqrt(np.trace(found.covariance[:3, :3])) < 0.01


def test_a_street_is_not_in_the_machine_hall(flight, data_folder):
    street = open_source(data_folder / "kitti_mono")
    for index in (0, len(street) // 2):
        found = extract(street.frame(index).images[0][:, 200:952].copy(), OrbConfig())
        said = flight.recognizer.find(found.descriptors, found.keypoints, found.level, seed=index)
        assert isinstance(said, str)
