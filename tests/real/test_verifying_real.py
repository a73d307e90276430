"""Places of real recordings are verified there and back: none is false, few are missed."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.files.vocabulary import Vocabulary
from odomap.geometry.lie import se3_inverse, so3_log
from odomap.sources.open import open as open_source
from odomap.system.config import preset
from odomap.system.eye import Eye
from odomap.system.loopsides import read_side
from odomap.system.slam import Slam
from odomap.system.verifying import VerifyConfig, verify
from odomap.vision.rectifier import Rectifier

FRAMES = 50
"""Of each recording, from its beginning."""
EVERY = 3
"""Keyframes of the way back from one that is compared with all of the way there to the next."""


class Way:
    """The keyframes of a map of a recording, played forwards or backwards, and where they were."""

    def __init__(self, source, name, vocabulary, backwards=False):
        self.config = preset(name)
        slam = Slam(source.rig, self.config)
        stamps, n = source.truth.stamps_ns, FRAMES
        first, last = (source.frame(i).stamp_ns for i in (0, n - 1))
        for i in range(n)[:: -1 if backwards else 1]:
            frame = source.frame(i)
            turned = replace(frame, stamp_ns=first + last - frame.stamp_ns)
            slam.track(turned if backwards else frame)
        slam.finish()
        if name == "stereo":
            eye = Eye.of_pair(source.rig, Rectifier(source.rig))
        else:
            eye = Eye.of_camera(source.rig.cameras[0].camera)
        self.mount, self.sides, poses = eye.T_body_camera, [], []
        for k in slam.map.keyframe_ids.tolist():
            side = read_side(slam.map, k, eye.camera, self.mount)
            self.sides.append(side.with_nodes(vocabulary.transform(side.descriptors).nodes))
            stamp = slam.map.keyframe(k).stamp_ns
            stamp = first + last - stamp if backwards else stamp
            poses.append(source.truth.Ts_world_body[np.abs(stamps - stamp).argmin()])
        self.poses = np.array(poses)


def compare(there, back, with_scale):
    """Return for each pair: its true pose, what was found, and how far that is off (m, degrees)."""
    config = there.config
    for i, newer in list(enumerate(back.sides))[::EVERY]:
        for j, matched in enumerate(there.sides):
            found = verify(
                *(newer, matched, there.mount, config.noise.feature_px, config.orb.scale),
                *(with_scale, VerifyConfig(), config.matching, 1000 * i + j),
            )
            truth = se3_inverse(there.poses[j]) @ back.poses[i]
            E = se3_inverse(truth) @ found.T_matched_keyframe
            yield (
                truth,
                found,
                np.linalg.norm(E[:3, 3]),
                np.degrees(np.linalg.norm(so3_log(E[:3, :3]))),
            )


@pytest.fixture(scope="module")
def vocabulary():
    return Vocabulary.load()


def test_a_flight_there_and_back(data_folder, vocabulary):
    source = open_source(data_folder / "euroc_mh01")
    there, back = (Way(source, "stereo", vocabulary, backwards=b) for b in (False, True))
    near, sigmas = [], []
    for truth, found, metres, degrees in compare(there, back, False):
        if found.is_accepted:
            assert metres < 0.03
            assert degrees < 0.4
            sigmas.append(np.sqrt(np.trace(np.linalg.inv(found.information)[:3, :3])))
        else:
            assert "needed" in found.reason
        if np.linalg.norm(truth[:3, 3]) < 1.0:
            near.append(found.is_accepted)
    assert np.mean(near) > 0.9
    assert 0.0003 < np.median(sigmas) < 0.005


def test_a_single_camera_on_a_road(data_folder, vocabulary):
    """Two maps of a single camera have each a scale of their own; the pairs agree about it."""
    source = open_source(data_folder / "kitti_mono")
    there, back = (Way(source, "mono", vocabulary, backwards=b) for b in (False, True))
    near, scales = [], []
    for truth, found, _, degrees in compare(there, back, True):
        if found.is_accepted:
            assert degrees < 1.5
            scales.append(found.scale)
        if np.linalg.norm(truth[:3, 3]) < 5.0:
            near.append(found.is_accepted)
    assert np.mean(near) > 0.9
    assert np.std(np.log(scales)) < 0.1
