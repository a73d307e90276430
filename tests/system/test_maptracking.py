"""Tracking against the map: what was seen before is used, when to add, lost and found again."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from odomap.evaluation.metrics import ate
from odomap.geometry.lie import se3_inverse
from odomap.maps.estimate import Status
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.system.config import preset
from odomap.system.slam import Slam
from system.test_localmapping import small_loop, walk

PER_ROUND = 24
RIG_SEED = 3


def track(slam, frames):
    return [slam.track(frame) for frame in frames]


def in_order(frames):
    """Return frames numbered and stamped anew, as they are given."""
    first, step = frames[0].stamp_ns, round(1e9 / 12)
    return [replace(f, id=n, stamp_ns=first + n * step) for n, f in enumerate(frames)]


def blank(frame):
    """Return a frame that shows nothing."""
    noise = np.random.default_rng(frame.id).integers(98, 102, frame.images[0].shape, np.uint8)
    return replace(frame, images=(noise,) * len(frame.images))


@pytest.fixture(scope="module")
def loop():
    """Return a small loop, walked twice."""
    return walk(small_loop(PER_ROUND), rounds=2, seed=RIG_SEED)


def pose_error(estimate, truth, index):
    """Return how far (m) an estimate is from the truth, whose first pose is the origin."""
    true = se3_inverse(truth.Ts_world_body[0]) @ truth.Ts_world_body[index]
    return float(np.linalg.norm(estimate.T_world_body.matrix[:3, 3] - true[:3, 3]))


def test_a_second_round_hangs_from_the_first(loop):
    """What was mapped is found again: most frames of the second round need no new keyframe."""
    slam = Slam(loop.rig, preset("stereo"))
    estimates = track(slam, loop)
    assert {e.status for e in estimates} <= {Status.TRACKING, Status.RECOVERED}
    made = [e.stamp_ns for e in estimates[:PER_ROUND] if e.is_keyframe]
    again = estimates[PER_ROUND:]
    old = [e.keyframe_id < len(made) for e in again]
    assert np.mean(old) > 0.5
    assert sum(e.is_keyframe for e in again) < 0.5 * len(made)
    # So the drift does not go on: the second round is as good as the first.
    off = [pose_error(e, loop.truth, n) for n, e in enumerate(estimates)]
    assert np.median(off[PER_ROUND:]) < 1.5 * np.median(off[1:PER_ROUND]) + 0.005


def test_frames_hang_from_keyframes_that_came_before(loop):
    slam = Slam(loop.rig, preset("stereo"))
    estimates = track(slam, loop.part(0, PER_ROUND))
    m = slam.map
    for n, e in enumerate(estimates):
        hung = int(np.searchsorted(loop.stamps_ns, m.keyframe(e.keyframe_id).stamp_ns))
        assert hung < max(n, 1)
    stamps = {m.keyframe(k).stamp_ns for k in m.keyframe_ids.tolist()}
    assert stamps <= {e.stamp_ns for e in estimates if e.is_keyframe}


def test_keyframes_are_made_where_something_new_is_seen(loop):
    slam = Slam(loop.rig, preset("stereo"))
    estimates = track(slam, loop.part(0, PER_ROUND))
    inliers = np.array([e.num_inliers for e in estimates])
    chosen = [n for n, e in enumerate(estimates) if e.is_keyframe]
    assert chosen[0] == 0
    assert 3 <= len(chosen) <= PER_ROUND // 2
    config = preset("stereo").tracking
    for before, n in pairwise(chosen):
        fell = inliers[n] < config.keyframe_ratio * inliers[before + 1]
        assert fell or n - before >= config.keyframe_interval
    # Between them there was no reason.
    for before, n in pairwise(chosen):
        assert (inliers[before + 1 : n] >= config.keyframe_ratio * inliers[before + 1]).all()


def test_the_map_is_told_what_was_found(loop):
    slam = Slam(loop.rig, preset("stereo"))
    track(slam, loop.part(0, PER_ROUND))
    m = slam.map
    ids = m.landmark_ids
    assert m.seen(ids).sum() > 1000
    # What many keyframes see is found in many frames.
    often = m.count_observers(ids) >= 4
    assert m.seen(ids[often]).mean() > 2 * m.seen(ids[~often]).mean()


def test_a_camera_that_jumps_back_is_found_again(loop):
    """Carried, covered, to where it was long ago: the map says where that is."""
    frames = list(loop)
    there, back = frames[:14], frames[PER_ROUND + 2 : PER_ROUND + 6]
    covered = [blank(f) for f in frames[14:17]]
    slam = Slam(loop.rig, preset("stereo"))
    estimates = track(slam, in_order([*there, *covered, *back]))
    statuses = [e.status for e in estimates]
    assert statuses[:14] == [Status.TRACKING] * 14
    assert statuses[14:17] == [Status.LOST] * 3
    assert "uniform" in estimates[14].reason
    assert statuses[17] is Status.RECOVERED
    assert statuses[18:] == [Status.TRACKING] * 3
    for n, e in enumerate(estimates[17:]):
        assert pose_error(e, loop.truth, PER_ROUND + 2 + n) < 0.02
        assert np.isfinite(e.covariance).all()


def test_one_that_is_lost_for_long_starts_anew_where_nothing_is_known(loop):
    """Turned round in the dark: nothing there is in the map."""
    turned = np.eye(4)
    turned[0, 0] = turned[2, 2] = -1.0
    elsewhere = list(walk(np.stack([turned] * 12), seed=RIG_SEED))
    frames = list(loop)[:8]
    slam = Slam(loop.rig, preset("stereo"))
    estimates = track(slam, in_order([*frames, *elsewhere]))
    statuses = [e.status for e in estimates]
    patience = preset("stereo").tracking.patience
    assert statuses[:8] == [Status.TRACKING] * 8
    assert set(statuses[8 : 8 + patience]) == {Status.LOST}
    begun = statuses.index(Status.INITIALIZING)
    assert begun == 8 + patience
    assert "anew" in estimates[begun].reason
    assert set(statuses[begun + 1 :]) == {Status.TRACKING}
    # It admits that it does not know how it got there.
    assert np.trace(estimates[begun].covariance[:3, :3]) > 0.01


@pytest.fixture(scope="module")
def mapped(loop):
    """Return a map of the loop's first round."""
    slam = Slam(loop.rig, preset("stereo"))
    track(slam, loop.part(0, PER_ROUND))
    return slam.map


def localizer(loop, tables):
    return Slam(loop.rig, preset("stereo"), map=Map.restored(tables), is_mapping=False)


def test_a_map_is_not_changed_by_being_used(loop, mapped):
    slam = localizer(loop, mapped.dump())
    before = slam.map.dump()
    estimates = track(slam, loop.part(PER_ROUND, 2 * PER_ROUND))
    assert not any(e.is_keyframe for e in estimates)
    after = slam.map.dump()
    for name, column in before.columns.items():
        if "seen" not in name and "expected" not in name:
            np.testing.assert_array_equal(column, after.columns[name], err_msg=name)
    placed = [e.status in (Status.TRACKING, Status.RECOVERED) for e in estimates]
    assert np.mean(placed) > 0.9
    result = slam.finish()
    assert ate(result.trajectory, loop.truth).rmse < 0.01
    errors = [pose_error(e, loop.truth, PER_ROUND + n) for n, e in enumerate(estimates)]
    assert max(e for e, known in zip(errors, placed) if known) < 0.03


def test_one_that_only_looks_never_starts_anew(loop, mapped):
    slam = localizer(loop, mapped.dump())
    frames = list(loop)[:16]
    hidden = [blank(f) for f in frames[4:14]]
    estimates = track(slam, in_order([*frames[:4], *hidden, *frames[14:]]))
    statuses = [e.status for e in estimates]
    assert Status.LOST in statuses[4:14]
    assert not {Status.TRACKING, Status.RECOVERED} & set(statuses[4:14])
    assert statuses[14] is Status.RECOVERED
    assert statuses[15] is Status.TRACKING
    assert slam.map.num_keyframes == mapped.num_keyframes
    assert pose_error(estimates[15], loop.truth, 15) < 0.02


def test_what_is_in_no_map_is_not_placed(loop, mapped):
    """Another room: no pose is better than a wrong one."""
    other = walk(small_loop(6), seed=11)
    slam = Slam(other.rig, preset("stereo"), map=Map.restored(mapped.dump()), is_mapping=False)
    estimates = track(slam, other)
    assert not {Status.TRACKING, Status.RECOVERED} & {e.status for e in estimates}
    assert all(e.reason for e in estimates)


def test_a_frame_without_its_image_or_out_of_order_is_lost_and_forgotten(loop):
    frames = list(loop)[:8]
    slam = Slam(loop.rig, preset("stereo"))
    track(slam, frames[:5])
    missing = slam.track(Frame(5, frames[5].stamp_ns, (None, None)))
    late = slam.track(replace(frames[3], id=6))
    then = slam.track(replace(frames[6], id=7))
    assert missing.status is late.status is Status.LOST
    assert "missing" in missing.reason
    assert "time" in late.reason
    assert then.status in (Status.TRACKING, Status.RECOVERED)
    assert pose_error(then, loop.truth, 6) < 0.02
