"""Kidnapped in a simulated room: a camera that is somewhere else at once is found there."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.evaluation.match import rotation_angle
from odomap.files.vocabulary import Vocabulary
from odomap.geometry.lie import se3_inverse
from odomap.maps.estimate import Status
from odomap.sources.disturb import blank
from odomap.system.slam import Slam

from .conftest import Recording

PLACED = (Status.TRACKING, Status.RECOVERED)


@pytest.fixture(params=["words", "looks"])
def vocabulary(request):
    """Return what keyframes are found by: words, or None."""
    return Vocabulary.load() if request.param == "words" else None


def in_order(recording, order):
    """Return frames in another order at an even pace, and which each of them is."""
    step = int(np.diff(recording.stamps_ns).min())
    frames = [
        replace(recording.frame(k), id=i, stamp_ns=int(recording.stamps_ns[0]) + i * step)
        for i, k in enumerate(order)
    ]
    return Recording(recording.rig, None, frames)


def apart(estimates, recording, order):
    """Return metres and degrees (n,) between estimates and truth, both from the first frame on."""
    Ts = np.array([e.T_world_body.matrix for e in estimates])
    truth = recording.truth
    rows = np.searchsorted(truth.stamps_ns, [recording.frame(k).stamp_ns for k in order])
    true = se3_inverse(truth.Ts_world_body[rows[0]]) @ truth.Ts_world_body[rows]
    error = np.array([se3_inverse(a) @ b for a, b in zip(true, Ts, strict=True)])
    return np.linalg.norm(error[:, :3, 3], axis=1), np.degrees(rotation_angle(error[:, :3, :3]))


def check(estimates, recording, order, back):
    """Check that frames are placed where they were taken from one of them on."""
    assert estimates[back].status is Status.RECOVERED
    assert all(e.status in PLACED for e in estimates[back:])
    metres, degrees = apart(estimates, recording, order)
    assert metres[back:].max() < 0.03
    assert degrees[back:].max() < 1.0


def test_a_jump_is_noticed_and_undone(room, vocabulary):
    """The even frames, then odd ones from the first on: no motion leads there."""
    order = [*range(0, 48, 2), *range(1, 21, 2)]
    slam = Slam(room.rig, vocabulary=vocabulary)
    estimates = [slam.track(frame) for frame in in_order(room, order)]
    check(estimates, room, order, 24)


def test_a_camera_carried_in_the_dark_is_found_elsewhere(room, vocabulary):
    """Two seconds of black images, at the end of which the camera is somewhere else."""
    order = [*range(0, 48, 2), *[46] * 24, *range(11, 25, 2)]
    dark = range(24, 48)
    slam = Slam(room.rig, vocabulary=vocabulary)
    estimates = [slam.track(frame) for frame in blank(in_order(room, order), dark)]
    assert all(estimates[k].status is Status.LOST for k in dark)
    check(estimates, room, order, 48)


def test_in_a_map_that_is_not_to_change_it_is_found_again_and_again(room, vocabulary):
    made = Slam(room.rig)
    first, *_ = [made.track(frame) for frame in in_order(room, range(0, 48, 2))]
    made.finish()
    keyframes = made.map.keyframe_ids.tolist()
    order = [1, 3, 31, 33, 9, 11, 45, 47, 3]
    slam = Slam(room.rig, map=made.map, is_mapping=False, vocabulary=vocabulary)
    estimates = [slam.track(frame) for frame in in_order(room, order)]
    assert all(e.status in PLACED for e in estimates)
    metres, degrees = apart([first, *estimates], room, [0, *order])
    assert metres.max() < 0.03
    assert degrees.max() < 1.0
    assert made.map.keyframe_ids.tolist() == keyframes
