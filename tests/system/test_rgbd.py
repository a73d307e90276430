"""A camera with depth: metric from the first frame, whatever holes and noise depth has."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.errors import CalibrationError, InputError
from odomap.evaluation.metrics import ate
from odomap.geometry.lie import se3_inverse, se3_log
from odomap.geometry.pose import SE3
from odomap.maps.estimate import Status
from odomap.sensors.rig import CameraMount, DepthMount, Rig
from odomap.sources.disturb import blank, pierce_depth, roughen_depth
from odomap.system.config import preset, preset_for
from odomap.system.odometry import RgbdVO, make_odometry

from .conftest import Recording


def run(source, config=None):
    vo = RgbdVO(source.rig, config)
    return [vo.track(frame) for frame in source], vo.finish(), vo


@pytest.fixture(scope="module")
def done(depth_room):
    return run(depth_room)


def edited(recording, depth, first=0, last=48):
    """Return the recording with each frame's depth put through depth(frame)."""
    frames = [replace(f, depth=depth(f)) for f in recording.part(first, last)]
    return Recording(recording.rig, recording.truth, frames)


def test_every_frame_is_tracked_and_the_path_is_metric(depth_room, done):
    estimates, result, _ = done
    assert preset_for(depth_room.rig) == "rgbd"
    assert [e.status for e in estimates] == [Status.TRACKING] * 48
    assert [e.reason for e in estimates] == [""] * 48
    assert result.is_metric
    np.testing.assert_array_equal(result.trajectory.stamps_ns, depth_room.stamps_ns)
    np.testing.assert_array_equal(result.trajectory_live.stamps_ns, depth_room.stamps_ns)
    length = depth_room.truth.path_length
    assert ate(result.trajectory, depth_room.truth).rmse < 0.005 * length
    assert ate(result.trajectory, depth_room.truth, align="first").rmse < 0.01 * length
    scale = ate(result.trajectory, depth_room.truth, align="sim3").scale
    assert scale == pytest.approx(1, abs=0.02)
    np.testing.assert_array_equal(result.trajectory.Ts_world_body[0], np.eye(4))
    np.testing.assert_array_equal(result.T_body_tracked, np.eye(4))


def test_keyframes_are_those_that_were_announced(done):
    estimates, result, _ = done
    announced = [e.stamp_ns for e in estimates if e.is_keyframe]
    np.testing.assert_array_equal(result.keyframes.stamps_ns, announced)


def test_covariances_are_those_of_errors(depth_room, done):
    estimates, result, _ = done
    assert not estimates[0].covariance.any()
    for covariances in (
        np.array([e.covariance for e in estimates[1:]]),
        result.trajectory.covariances[1:],
    ):
        assert np.isfinite(covariances).all()
        np.testing.assert_allclose(covariances, np.swapaxes(covariances, 1, 2), atol=1e-12)
        assert (np.linalg.eigvalsh(covariances) > 0).all()
    true = se3_inverse(depth_room.truth.Ts_world_body[0]) @ depth_room.truth.Ts_world_body
    errors = se3_log(se3_inverse(true) @ result.trajectory.Ts_world_body)
    nees = [
        e @ np.linalg.solve(S, e) / 6
        for e, S in zip(errors[10:], result.trajectory.covariances[10:])
    ]
    assert 0.01 < np.mean(nees) < 5


def test_the_same_images_give_the_same_bytes(depth_room, done):
    _, again, _ = run(depth_room)
    for name in ("trajectory", "trajectory_live", "keyframes"):
        first, second = getattr(done[1], name), getattr(again, name)
        np.testing.assert_array_equal(first.Ts_world_body, second.Ts_world_body)
        np.testing.assert_array_equal(first.covariances, second.covariances)


def test_half_an_image_of_holes(depth_room):
    left = np.arange(400) < 200
    estimates, result, _ = run(edited(depth_room, lambda f: np.where(left, 0, f.depth)))
    assert {e.status for e in estimates} == {Status.TRACKING}
    assert ate(result.trajectory, depth_room.truth).rmse < 0.005 * depth_room.truth.path_length


def test_patches_of_holes(depth_room):
    estimates, result, _ = run(pierce_depth(depth_room, share=0.5, seed=2))
    assert {e.status for e in estimates} == {Status.TRACKING}
    assert ate(result.trajectory, depth_room.truth).rmse < 0.005 * depth_room.truth.path_length


def test_corners_without_depth_are_triangulated(depth_room):
    """Where depth ends at 2.5 m the rest of the room is of use all the same."""
    near = edited(depth_room, lambda f: np.where(f.depth > 2.5, 0, f.depth).astype(np.float32))
    _, followed, vo = run(near)
    config = preset("rgbd-flow")
    config = replace(config, candidates=replace(config.candidates, follow=False))
    _, without, vo_without = run(near, config)
    assert vo.map.num_landmarks > 1.1 * vo_without.map.num_landmarks
    length = depth_room.truth.path_length
    assert ate(followed.trajectory, depth_room.truth).rmse < 0.01 * length
    assert ate(without.trajectory, depth_room.truth).rmse < 0.03 * length


def test_rough_depth(depth_room, done):
    """Three times the noise of a good sensor, on top of its own."""
    estimates, result, _ = run(roughen_depth(depth_room, sigma_m=0.006))
    assert {e.status for e in estimates} == {Status.TRACKING}
    assert ate(result.trajectory, depth_room.truth).rmse < 0.01 * depth_room.truth.path_length
    assert ate(result.trajectory, depth_room.truth, align="sim3").scale == pytest.approx(
        1, abs=0.02
    )


def test_a_frame_without_depth_is_placed_but_makes_no_keyframe(depth_room):
    estimates, result, _ = run(edited(depth_room, lambda f: None if f.id % 3 else f.depth))
    assert {e.status for e in estimates} == {Status.TRACKING}
    without = [e for e in estimates if e.frame_id % 3]
    assert not any(e.is_keyframe for e in without)
    reasons = {e.reason for e in without}
    assert reasons == {"", "the depth image is missing: no keyframe"}
    assert {e.reason for e in estimates if not e.frame_id % 3} == {""}
    assert ate(result.trajectory, depth_room.truth).rmse < 0.01 * depth_room.truth.path_length


def test_without_depth_at_first_it_waits(depth_room):
    estimates, result, _ = run(edited(depth_room, lambda f: None if f.id < 3 else f.depth, 0, 12))
    for e in estimates[:3]:
        assert e.status is Status.INITIALIZING
        assert e.reason == "the depth image is missing: cannot start"
        assert e.keyframe_id == -1
    assert {e.status for e in estimates[3:]} == {Status.TRACKING}
    assert len(result.trajectory) == 9


def test_depth_full_of_holes_waits(depth_room):
    def holes(frame):
        return np.zeros_like(frame.depth) if frame.id < 2 else frame.depth

    estimates, _, _ = run(edited(depth_room, holes, 0, 6))
    for e in estimates[:2]:
        assert e.status is Status.INITIALIZING
        assert e.reason.startswith("0 points with depth of 30 needed to start: ")
    assert estimates[2].status is Status.TRACKING


def test_a_covered_lens_is_said_and_tracking_comes_back(depth_room):
    estimates, result, _ = run(blank(depth_room, range(20, 28)))
    assert {e.status for e in estimates[20:28]} == {Status.LOST}
    assert estimates[28].status is Status.RECOVERED
    assert ate(result.trajectory, depth_room.truth).rmse < 0.01


def test_another_place_starts_anew_in_metres(depth_room):
    frames = [
        replace(
            f,
            images=(np.ascontiguousarray(f.images[0][:, ::-1]),),
            depth=np.ascontiguousarray(f.depth[:, ::-1]),
        )
        if f.id >= 20
        else f
        for f in depth_room
    ]
    estimates, result, _ = run(Recording(depth_room.rig, depth_room.truth, frames))
    anew = [e for e in estimates if e.is_keyframe and e.status is Status.INITIALIZING]
    assert [e.frame_id for e in anew] == [25]
    assert anew[0].reason == "started anew where it was last: how it moved since is not known"
    assert {e.status for e in estimates[26:]} == {Status.TRACKING}
    steps = np.linalg.norm(np.diff(result.trajectory.positions[-20:], axis=0), axis=1)
    true = np.linalg.norm(np.diff(depth_room.truth.positions[-20:], axis=0), axis=1)
    # A mirrored room is walked through at the same speed.
    assert steps.sum() == pytest.approx(true.sum(), rel=0.1)


def test_a_wrong_factor_is_told(depth_room):
    """Files of 5000 per metre read with 1000."""
    with pytest.raises(CalibrationError, match=r"% of the values lie outside.*depth factor") as e:
        run(edited(depth_room, lambda f: 5 * f.depth))
    assert "median 16" in str(e.value)


def test_depth_of_another_size(depth_room):
    with pytest.raises(InputError, match=r"frame 0: the depth image is 200x125.*400x250") as e:
        run(edited(depth_room, lambda f: f.depth[::2, ::2]))
    assert "registered" in str(e.value)
    # Later in a recording as well, when a keyframe is made.
    with pytest.raises(InputError, match="200x125"):
        run(edited(depth_room, lambda f: f.depth[::2, ::2] if f.id > 3 else f.depth))


def test_a_rig_without_depth(depth_room):
    with pytest.raises(CalibrationError, match="'depth' in the rig"):
        RgbdVO(replace(depth_room.rig, depth=None))


def test_the_body_need_not_be_the_camera(depth_room, done):
    """The mount carries the path over to the body; the depth camera may be the second one."""
    mount = SE3.exp([0.1, -0.05, 0.2, 0.3, -1.2, 0.4])
    camera = replace(depth_room.rig.cameras[0], name="colour", T_body_camera=mount)
    other = CameraMount("other", depth_room.rig.cameras[0].camera)
    rig = Rig(cameras=(other, camera), depth=DepthMount("colour"))
    vo = make_odometry(rig, preset("rgbd-flow"))
    for frame in depth_room.part(0, 24):
        vo.track(replace(frame, images=(None, *frame.images)))
    result = vo.finish()
    np.testing.assert_allclose(result.T_body_tracked, np.eye(4))
    inverse = mount.inverse().matrix
    as_camera = inverse @ result.trajectory.Ts_world_body @ mount.matrix
    off = se3_log(se3_inverse(done[1].trajectory.Ts_world_body[:24]) @ as_camera)
    assert np.abs(off).max() < 0.01


def test_far_depth_is_less_sure(depth_room):
    """The same room twice as large, seen with a sensor as good: the path is less sure."""
    part = depth_room.part(0, 24)
    _, here, _ = run(part)
    _, there, _ = run(edited(part, lambda f: np.minimum(1.5 * f.depth, 7.9), 0, 24))
    sigma = [np.sqrt(np.trace(r.trajectory.covariances[-1][:3, :3])) for r in (here, there)]
    assert sigma[1] > 1.3 * sigma[0]
