"""The newest frames are placed again once the map has changed, and none else."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.geometry.lie import se3_exp
from odomap.maps.estimate import Status
from odomap.system.association import View
from odomap.system.config import preset
from odomap.system.slam import Slam
from odomap.system.trail import LENGTH, Trail
from odomap.vision.features import Corners
from system.test_localmapping import small_loop, walk
from system.test_maptracking import RIG_SEED, blank, in_order, pose_error, track

WRONG = se3_exp(np.array([0.02, -0.01, 0.02, 0.004, 0.0, -0.004]))


def view(n):
    pyramid = tuple(np.zeros((size, size), np.uint8) for size in (64, 32, 16))
    corners = Corners(np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros(0, np.uint8))
    return View(n, n, pyramid, corners, np.zeros((0, 32), np.uint8))


def test_the_newest_frames_are_kept_without_their_images():
    trail = Trail()
    for n in range(LENGTH + 5):
        trail.add(n, view(n), np.arange(n))
    kept = list(trail.not_at_rest(1))
    assert [f.place for f in kept] == list(range(5, LENGTH + 5))
    assert all(f.view.image.shape == (16, 16) for f in kept)


def test_a_frame_is_given_once_for_each_state_of_the_map():
    trail = Trail()
    trail.add(0, view(0), np.arange(3))
    assert [f.place for f in trail.not_at_rest(5)] == [0]
    trail.add(1, view(1), np.arange(3))
    assert [f.place for f in trail.not_at_rest(5)] == [1]
    assert not list(trail.not_at_rest(5))
    assert [f.place for f in trail.not_at_rest(6)] == [0, 1]
    trail.forget()
    assert len(trail) == 0
    assert not list(trail.not_at_rest(7))


@pytest.fixture(scope="module")
def world():
    """Return a small loop, walked once."""
    return walk(small_loop(24), seed=RIG_SEED)


def misplaced(world, frames):
    """Track frames, say which none came after, and hang all but the first wrongly."""
    slam = Slam(world.rig, preset("stereo"))
    estimates = track(slam, frames)
    path = slam._tracker.path
    last = max(n for n, e in enumerate(estimates) if e.is_keyframe)
    for n in range(1, len(path)):
        if not estimates[n].is_keyframe:
            path.replace(n, replace(path[n], T_keyframe_body=path[n].T_keyframe_body @ WRONG))
    return slam, estimates, last


def change(slam):
    """Write a solution that leaves everything where it is."""
    snapshot = slam.map.snapshot(slam.map.keyframe_ids)
    slam.map.apply(snapshot.solved(snapshot.Ts_world_body, snapshot.points_world))


def test_frames_since_the_last_keyframe_are_placed_again_when_the_map_has_changed(world):
    slam, estimates, last = misplaced(world, list(world))
    assert 0 < last < len(estimates) - 1
    # Let it be as if they had been placed at rest, wrongly, in the map as it is.
    list(slam._tracker._trail.not_at_rest(slam.map.epoch))
    before = slam._tracker.path.trajectory()
    still = slam.finish().trajectory
    np.testing.assert_array_equal(still.Ts_world_body, before.Ts_world_body)
    change(slam)
    after = slam.finish().trajectory
    np.testing.assert_array_equal(after.Ts_world_body[:last], before.Ts_world_body[:last])
    for n in range(last + 1, len(estimates)):
        true, T = world.truth.Ts_world_body, after.Ts_world_body[n]
        off = np.linalg.norm(T[:3, 3] - (np.linalg.inv(true[0]) @ true[n])[:3, 3])
        assert off < max(0.005, 1.5 * pose_error(estimates[n], world.truth, n))
        assert np.linalg.norm(T[:3, 3] - before.Ts_world_body[n][:3, 3]) > 0.02
    assert np.isfinite(after.covariances).all()


def test_what_cannot_be_placed_again_stays_where_it_hangs(world):
    slam, _, last = misplaced(world, list(world))
    trail = slam._tracker._trail
    kept = list(trail.not_at_rest(-1))
    trail.forget()
    nothing = np.zeros(0, np.int64)
    for frame in kept:
        empty = replace(
            frame.view,
            corners=Corners(
                np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros(0, np.uint8)
            ),
            descriptors=np.zeros((0, 32), np.uint8),
        )
        trail.add(frame.place, empty, nothing, -1)
    before = slam._tracker.path.trajectory()
    after = slam.finish().trajectory
    np.testing.assert_array_equal(after.Ts_world_body[last:], before.Ts_world_body[last:])


def test_tracking_goes_on_from_where_the_last_frames_are_now(world):
    frames = list(world)
    slam = Slam(world.rig, preset("stereo"))
    track(slam, frames[:20])
    change(slam)
    slam.finish()
    hidden = in_order([*frames[:20], blank(frames[20]), *frames[21:]])
    then = track(slam, hidden[20:])
    assert [e.status for e in then][1:] == [Status.RECOVERED] + [Status.TRACKING] * (len(then) - 2)
    assert pose_error(then[-1], world.truth, len(frames) - 1) < 0.02
