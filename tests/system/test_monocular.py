"""A single camera: it waits until motion can be told, and then keeps to one scale."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.errors import CalibrationError, ConfigError
from odomap.evaluation.metrics import ate
from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.geometry.pose import SE3
from odomap.maps.estimate import Status
from odomap.sensors.rig import Rig
from odomap.sources.disturb import blank, drop
from odomap.sources.open import open as open_source
from odomap.system.config import preset, preset_for
from odomap.system.odometry import MonocularVO, make_odometry

from .conftest import Recording


def run(source, config=None):
    vo = MonocularVO(source.rig.cameras[0].camera, config)
    return [vo.track(frame) for frame in source], vo.finish(), vo


@pytest.fixture(scope="module")
def done(depth_room):
    return run(depth_room)


def first_tracked(estimates):
    return next(k for k, e in enumerate(estimates) if e.status is Status.TRACKING)


def share(trajectory, rows):
    """Return some rows of a trajectory."""
    return replace(
        trajectory,
        stamps_ns=trajectory.stamps_ns[rows],
        Ts_world_body=trajectory.Ts_world_body[rows],
        covariances=None,
    )


def test_it_starts_soon_and_then_tracks_every_frame(depth_room, done):
    estimates, result, _ = done
    start = first_tracked(estimates)
    assert 2 <= start <= 10
    assert {e.status for e in estimates[start:]} == {Status.TRACKING}
    assert [e.reason for e in estimates[start:]] == [""] * (48 - start)
    assert not result.is_metric
    # Frames before the start have a pose at the end, and none when they came.
    np.testing.assert_array_equal(result.trajectory.stamps_ns, depth_room.stamps_ns)
    np.testing.assert_array_equal(result.trajectory_live.stamps_ns, depth_room.stamps_ns[start:])
    assert len(result.keyframes) == sum(e.is_keyframe for e in estimates) + 1


def test_the_path_is_right_up_to_scale(depth_room, done):
    _, result, _ = done
    length = depth_room.truth.path_length
    assert length > 1.5
    assert ate(result.trajectory, depth_room.truth, "sim3").rmse < 0.005 * length
    assert ate(result.trajectory_live, depth_room.truth, "sim3").rmse < 0.01 * length
    turned = se3_inverse(depth_room.truth.Ts_world_body[0]) @ depth_room.truth.Ts_world_body
    off = np.swapaxes(turned[:, :3, :3], 1, 2) @ result.trajectory.Ts_world_body[:, :3, :3]
    assert np.degrees(np.arccos((np.trace(off, axis1=1, axis2=2).min() - 1) / 2)) < 0.5


def test_the_scale_is_one_from_start_to_end(depth_room, done):
    _, result, _ = done
    first, second = (
        ate(share(result.trajectory, rows), depth_room.truth, "sim3").scale
        for rows in (slice(0, 24), slice(24, 48))
    )
    assert second == pytest.approx(first, rel=0.02)
    # The unit is the median depth of what is seen at the start.
    frame = depth_room.frame(0)
    depth = np.median(frame.depth[frame.depth > 0])
    assert 0.6 * depth < first < 1.6 * depth


def test_the_first_pose_is_the_identity(done):
    np.testing.assert_array_equal(done[1].trajectory.Ts_world_body[0], np.eye(4))
    assert not done[1].trajectory.covariances[0].any()


def test_frames_before_the_start_say_what_they_wait_for(done):
    estimates = done[0]
    start = first_tracked(estimates)
    for e in estimates[:start]:
        assert e.status is Status.INITIALIZING
        assert e.keyframe_id == -1
        assert not e.is_keyframe
        assert e.num_inliers == 0
        np.testing.assert_array_equal(e.T_world_body.matrix, np.eye(4))
    assert estimates[0].reason == "a first view is taken: move the camera sideways"
    for e in estimates[1:start]:
        assert "parallax" in e.reason or "two motions" in e.reason
    assert estimates[start].is_keyframe


def test_frames_between_the_two_views_fit_in(done):
    """No step to or from the frames placed afterwards is out of line."""
    estimates, result, _ = done
    start = first_tracked(estimates)
    steps = np.linalg.norm(np.diff(result.trajectory.positions, axis=0), axis=1)
    around = np.median(steps[: start + 6])
    assert steps[: start + 2].min() > 0.5 * around
    assert steps[: start + 2].max() < 2.0 * around


def test_covariances_are_those_of_errors(depth_room, done):
    estimates, result, _ = done
    for covariances in (
        result.trajectory.covariances[1:],
        np.array([e.covariance for e in estimates[first_tracked(estimates) :]]),
    ):
        assert np.isfinite(covariances).all()
        np.testing.assert_allclose(covariances, np.swapaxes(covariances, 1, 2), atol=1e-12)
        assert (np.linalg.eigvalsh(covariances) > 0).all()
    # In units of the start, as the truth is in those of the first frames.
    scale = ate(share(result.trajectory, slice(0, 16)), depth_room.truth, "sim3").scale
    true = se3_inverse(depth_room.truth.Ts_world_body[0]) @ depth_room.truth.Ts_world_body
    true[:, :3, 3] /= scale
    errors = se3_log(se3_inverse(true) @ result.trajectory.Ts_world_body)
    nees = [
        e @ np.linalg.solve(S, e) / 6
        for e, S in zip(errors[16:], result.trajectory.covariances[16:])
    ]
    # One path is one draw, and the scale of its start another.
    assert 0.02 < np.mean(nees) < 8


def test_the_same_images_give_the_same_bytes(depth_room, done):
    _, again, _ = run(depth_room)
    for name in ("trajectory", "trajectory_live", "keyframes"):
        first, second = getattr(done[1], name), getattr(again, name)
        np.testing.assert_array_equal(first.Ts_world_body, second.Ts_world_body)
        np.testing.assert_array_equal(first.covariances, second.covariances)


def test_a_covered_lens_is_said_and_the_scale_is_kept(depth_room):
    estimates, result, _ = run(blank(depth_room, range(20, 28)))
    assert {e.status for e in estimates[20:28]} == {Status.LOST}
    assert all("uniform" in e.reason or "too dark" in e.reason for e in estimates[20:28])
    assert estimates[28].status is Status.RECOVERED
    assert {e.status for e in estimates[29:]} == {Status.TRACKING}
    assert len(result.trajectory) == 40
    assert ate(result.trajectory, depth_room.truth, "sim3").rmse < 0.01


def elsewhere(recording, first):
    """Return the recording with all images mirrored from a frame on: a place never seen."""
    frames = [
        replace(f, images=(np.ascontiguousarray(f.images[0][:, ::-1]),)) if f.id >= first else f
        for f in recording
    ]
    return Recording(recording.rig, recording.truth, frames)


def test_it_starts_anew_and_says_that_the_scale_is_new(depth_room):
    estimates, result, _ = run(elsewhere(depth_room, 20))
    anew = [e for e in estimates[20:] if e.is_keyframe and e.status is Status.INITIALIZING]
    assert len(anew) == 1
    assert "the scale is new" in anew[0].reason
    start = anew[0].frame_id
    assert start <= 34
    assert {e.status for e in estimates[20:start]} == {Status.LOST}
    assert all(e.reason for e in estimates[20:start])
    assert {e.status for e in estimates[start + 1 :]} == {Status.TRACKING}
    # It goes on where it was last, with a doubt that admits it.
    stamps = result.trajectory.stamps_ns.tolist()
    row = stamps.index(estimates[start].stamp_ns)
    here, before = result.trajectory.Ts_world_body[row], estimates[19].T_world_body.matrix
    apart = np.linalg.norm(here[:3, 3] - before[:3, 3])
    assert apart < 0.3
    sigma = np.sqrt(result.trajectory.covariances[:, 0, 0])
    assert sigma[row] > 5 * sigma[stamps.index(estimates[19].stamp_ns)]
    # Stamps stay in order with what is placed late, and the new part is a path of its own.
    assert (np.diff(result.trajectory.stamps_ns) > 0).all()
    assert len(result.trajectory) > len(result.trajectory_live)


def depth_seen_by(vo, keyframe_id):
    T = vo.map.T_world_body(keyframe_id)
    points = vo.map.points_world(vo.map.observations_of(keyframe_id)[0])
    return float(np.median((points - T[:3, 3]) @ T[:3, 2]))


def test_a_new_start_takes_the_depth_that_was_usual(depth_room):
    """The same kind of place again: paths before and after are of about one size."""
    recording = elsewhere(depth_room, 30).part(12, 48)
    vo = MonocularVO(recording.rig.cameras[0].camera)
    before, after = [], []
    for frame in recording:
        e = vo.track(frame)
        if e.is_keyframe:
            newest = int(vo.map.keyframe_ids[-1])
            (before if frame.id < 30 else after).append(depth_seen_by(vo, newest))
    assert before
    assert after
    # The first scale is one of median depth 1; by the time of the loss it is another.
    assert abs(before[-1] - 1.0) > 0.02
    assert after[0] == pytest.approx(before[-1], rel=0.02)


def test_dropped_frames_are_bridged(depth_room):
    estimates, result, _ = run(drop(depth_room, [20, 21, 30]))
    assert Status.LOST not in {e.status for e in estimates}
    assert ate(result.trajectory, depth_room.truth, "sim3").rmse < 0.01


def test_a_missing_image_is_said_even_before_the_start(depth_room):
    frames = [replace(f, images=(None,)) if f.id in (1, 20) else f for f in depth_room.part(0, 24)]
    estimates, result, _ = run(Recording(depth_room.rig, depth_room.truth, frames))
    assert estimates[1].reason == "the camera image is missing"
    assert estimates[1].status is Status.INITIALIZING
    assert estimates[20].status is Status.LOST
    assert estimates[20].reason == "the camera image is missing"
    assert first_tracked(estimates) <= 10
    assert ate(result.trajectory, depth_room.truth, "sim3").rmse < 0.01


# ---- a plane, a turn, nothing at all ----


def poses(*rows):
    return np.array([se3_exp(np.array(row, float)) for row in rows])


def walk(steps, across=0.03, along=0.005, turn=0.01):
    """Return a bent path with turns."""
    return poses(
        *(
            [
                across * k,
                0.01 * np.sin(k / 3),
                along * k,
                0.05 * np.sin(k / 5),
                -turn * k,
                0.02 * np.sin(k / 4),
            ]
            for k in range(steps)
        )
    )


SLANT = se3_exp(np.array([0, 0, 0, 0.3, 0.4, 0]))


@pytest.mark.parametrize(
    ("path", "by_frame"),
    [
        pytest.param(walk(24), 10, id="across"),
        pytest.param(SLANT @ walk(24), 10, id="slanted"),
        pytest.param(np.linalg.inv(SLANT) @ walk(24, across=-0.03), 10, id="the other way"),
        pytest.param(walk(24, across=0.02, along=0.02, turn=0.0), 14, id="obliquely ahead"),
        # Along the normal two motions look alike for long: it may wait, and must not be wrong.
        pytest.param(walk(24, across=0.004, along=0.02, turn=0.0), None, id="straight ahead"),
    ],
)
def test_a_plane_gives_the_right_path_or_none(wall, path, by_frame):
    recording = wall.recording(path)
    estimates, result, _ = run(recording)
    placed = [e for e in estimates if e.keyframe_id >= 0]
    for e in estimates[: len(estimates) - len(placed)]:
        assert e.reason
    if placed:
        found = ate(result.trajectory, recording.truth, "sim3")
        assert found.rmse < 0.01 * recording.truth.path_length
    if by_frame is not None:
        assert len(placed) >= 24 - by_frame


def test_a_camera_that_only_turns_waits(wall):
    recording = wall.recording(
        poses(*([0, 0, 0, 0.004 * k, 0.012 * k, 0.01 * np.sin(k / 4)] for k in range(30)))
    )
    estimates, result, _ = run(recording)
    assert {e.status for e in estimates} == {Status.INITIALIZING}
    assert len(result.trajectory) == len(result.trajectory_live) == len(result.keyframes) == 0
    assert all("move the camera sideways" in e.reason for e in estimates)


def test_a_fast_turn_waits_too_though_the_first_view_is_left_behind(wall):
    turning = poses(*([0, 0, 0, 0, 0.05 * k, 0] for k in range(-12, 13)))
    estimates, result, _ = run(wall.recording(turning))
    assert {e.status for e in estimates} == {Status.INITIALIZING}
    assert len(result.trajectory) == 0
    again = [e for e in estimates if "the view changed before the motion was known" in e.reason]
    assert again
    assert all("move the camera sideways" in e.reason for e in again)


def test_a_camera_at_rest_waits_and_starts_when_it_moves(wall):
    path = np.concatenate([np.tile(np.eye(4), (15, 1, 1)), walk(20)])
    recording = wall.recording(path)
    estimates, result, _ = run(recording)
    for e in estimates[1:15]:
        assert e.status is Status.INITIALIZING
        assert e.reason == "parallax of 0.0 px, 1.5 px needed: move the camera sideways"
    assert first_tracked(estimates) < 27
    # All frames are placed in the end, the resting ones where they were.
    assert len(result.trajectory) == 35
    assert np.abs(result.trajectory.positions[:15]).max() < 0.003
    assert ate(result.trajectory, recording.truth, "sim3").rmse < 0.005


def test_a_camera_that_rests_for_longer_than_the_window_keeps_its_scale(wall):
    """All keyframes of the window, those that hold it too, are at one place for a while."""
    there = walk(14)
    onwards = there[-1] @ walk(14)
    recording = wall.recording(np.concatenate([there, np.tile(there[-1:], (26, 1, 1)), onwards]))
    config = preset("mono-flow")
    config = replace(config, tracking=replace(config.tracking, keyframe_interval=2))
    estimates, result, _ = run(recording, config)
    assert Status.LOST not in {e.status for e in estimates}
    resting = [e for e in estimates if 16 <= e.frame_id < 40]
    assert sum(e.is_keyframe for e in resting) > 9
    ours = result.trajectory
    first, second = (
        ate(share(ours, rows), recording.truth, "sim3").scale
        for rows in (slice(0, 14), slice(40, None))
    )
    assert second == pytest.approx(first, rel=0.02)
    assert np.ptp(ours.positions[15:40], axis=0).max() < 0.004
    assert np.isfinite(ours.covariances).all()
    assert (np.linalg.eigvalsh(ours.covariances[1:]) > 0).all()


def test_images_without_texture_wait(depth_room):
    flat = np.full((250, 400), 80, np.uint8)
    frames = [replace(f, images=(flat,)) for f in depth_room.part(0, 5)]
    estimates, result, _ = run(Recording(depth_room.rig, depth_room.truth, frames))
    assert {e.reason for e in estimates} == {
        "0 corners of 120 needed to start: too dark or no texture?"
    }
    assert len(result.trajectory) == 0
    assert result.trajectory.covariances.shape == (0, 6, 6)


# ---- rigs and configurations ----


def test_descriptors_track_a_single_camera_too(depth_room):
    config = preset("mono-flow")
    config = replace(
        config,
        features=replace(config.features, detector="sift", count=600),
        tracking=replace(config.tracking, association="features"),
    )
    estimates, result, _ = run(depth_room.part(0, 26), config)
    assert first_tracked(estimates) <= 16
    assert Status.LOST not in {e.status for e in estimates}
    assert ate(result.trajectory, depth_room.truth, "sim3").rmse < 0.02


def test_a_fisheye_is_as_good():
    source = open_source(
        "sim:room?seed=3&frames=14&rate_hz=8&resolution=320x240&sensors=mono&lens=kannala_brandt"
    )
    assert source.rig.cameras[0].camera.model == "kannala_brandt"
    frames = list(source)
    estimates, result, _ = run(Recording(source.rig, source.truth, frames))
    assert first_tracked(estimates) <= 10
    assert Status.LOST not in {e.status for e in estimates}
    assert ate(result.trajectory, source.truth, "sim3").rmse < 0.02 * source.truth.path_length
    for e in estimates[first_tracked(estimates) + 1 :]:
        # Tracks are drawn in the image as it came.
        assert source.rig.cameras[0].camera.is_inside(e.tracks.keypoints, 0.0).mean() > 0.95


def test_the_mount_of_a_camera_is_told_and_truth_is_that_of_the_camera(depth_room):
    mount = SE3.exp([0.1, -0.05, 0.2, 0.3, -1.2, 0.4])
    rig = Rig(cameras=(replace(depth_room.rig.cameras[0], T_body_camera=mount),))
    assert preset_for(rig) == "mono"
    vo = make_odometry(rig, preset("mono-flow"))
    for frame in depth_room.part(0, 24):
        vo.track(frame)
    result = vo.finish()
    np.testing.assert_allclose(result.T_body_tracked, mount.matrix)
    body = replace(
        depth_room.truth,
        Ts_world_body=depth_room.truth.Ts_world_body @ mount.inverse().matrix,
        covariances=None,
    )
    assert ate(result.trajectory, result.truth(body), "sim3").rmse < 0.01


def test_a_configuration_without_candidates_is_none_for_a_single_camera(depth_room):
    config = preset("mono-flow")
    config = replace(config, candidates=replace(config.candidates, follow=False))
    with pytest.raises(ConfigError, match=r"candidates\.follow"):
        MonocularVO(depth_room.rig.cameras[0].camera, config)


def test_a_rig_without_a_camera():
    with pytest.raises(CalibrationError, match="no camera"):
        make_odometry(Rig(cameras=()), preset("mono-flow"))


def test_the_window_bounds_what_is_kept(done):
    m = done[2].map
    with_payload = [k for k in m.keyframe_ids.tolist() if m.keyframe(k).features is not None]
    assert len(with_payload) <= 11
    assert m.num_landmarks < 11 * 500
