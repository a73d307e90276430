"""Stereo odometry in a small world: where it is, how sure, the same every time."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.errors import CalibrationError, ConfigError
from odomap.evaluation.metrics import ate
from odomap.geometry.lie import se3_inverse, se3_log
from odomap.maps.estimate import Status
from odomap.system.config import PRESETS, preset
from odomap.system.odometry import StereoVO


def run(source, config=None):
    vo = StereoVO(source.rig, config)
    return [vo.track(frame) for frame in source], vo.finish(), vo


@pytest.fixture(scope="module")
def done(room):
    return run(room)


def test_every_frame_is_tracked_and_the_path_is_right(room, done):
    estimates, result, _ = done
    assert [e.status for e in estimates] == [Status.TRACKING] * len(room)
    assert [e.reason for e in estimates] == [""] * len(room)
    np.testing.assert_array_equal(result.trajectory.stamps_ns, room.stamps_ns)
    length = room.truth.path_length
    assert length > 1.5
    assert ate(result.trajectory, room.truth).rmse < 0.009 * length
    assert ate(result.trajectory, room.truth, align="first").rmse < 0.02 * length
    # Metric: no scale is needed to fit.
    assert ate(result.trajectory, room.truth, align="sim3").scale == pytest.approx(1, abs=0.04)


def test_what_was_emitted_is_the_live_path(done):
    estimates, result, _ = done
    emitted = np.array([e.T_world_body.matrix for e in estimates])
    np.testing.assert_allclose(result.trajectory_live.Ts_world_body, emitted, atol=1e-12)
    final = result.trajectory.Ts_world_body
    assert not np.array_equal(final, emitted)
    assert np.abs(final[:, :3, 3] - emitted[:, :3, 3]).max() < 0.05
    np.testing.assert_allclose(final[0], np.eye(4), atol=1e-12)


def test_estimates_hold_together(room, done):
    estimates, result, vo = done
    assert result.map is vo.map
    for frame, e in zip(room, estimates):
        assert (e.frame_id, e.stamp_ns) == (frame.id, frame.stamp_ns)
        assert e.num_inliers >= 15
        assert {"prepare"} <= set(e.timing)
        assert all(ms >= 0 for ms in e.timing.values())
        assert 0 <= e.keyframe_id < 48
    keyframes = [e for e in estimates if e.is_keyframe]
    assert estimates[0].is_keyframe
    assert 5 <= len(keyframes) <= 30
    # Each hangs from the one before.
    assert [e.keyframe_id for e in keyframes[1:]] == list(range(len(keyframes) - 1))
    np.testing.assert_array_equal(estimates[0].T_keyframe_body.matrix, np.eye(4))
    assert any("map" in e.timing for e in keyframes)


def test_tracks_can_be_drawn(room, done):
    width, height = room.rig.cameras[0].camera.resolution
    for e in done[0][1:]:
        tracks = e.tracks
        n = len(tracks.inlier)
        assert tracks.keypoints.shape == tracks.previous.shape == (n, 2)
        assert tracks.keypoints.dtype == np.float32
        assert tracks.inlier.sum() == e.num_inliers
        assert (tracks.keypoints >= -1).all()
        assert (tracks.keypoints <= [width, height]).all()


def test_covariances_are_those_of_errors(room, done):
    estimates, result, _ = done
    assert not estimates[0].covariance.any()
    for covariances in (
        np.array([e.covariance for e in estimates[1:]]),
        result.trajectory.covariances[1:],
    ):
        assert np.isfinite(covariances).all()
        np.testing.assert_allclose(covariances, np.swapaxes(covariances, 1, 2), atol=1e-12)
        assert (np.linalg.eigvalsh(covariances) > 0).all()
    true = se3_inverse(room.truth.Ts_world_body[0]) @ room.truth.Ts_world_body
    errors = se3_log(se3_inverse(true) @ result.trajectory.Ts_world_body)
    nees = [
        e @ np.linalg.solve(S, e) / 6
        for e, S in zip(errors[10:], result.trajectory.covariances[10:])
    ]
    # One path is one draw: between a tenth and five.
    assert 0.1 < np.mean(nees) < 5


def test_the_same_images_give_the_same_bytes(room, done):
    _, again, _ = run(room)
    for name in ("trajectory", "trajectory_live"):
        first, second = getattr(done[1], name), getattr(again, name)
        np.testing.assert_array_equal(first.Ts_world_body, second.Ts_world_body)
        np.testing.assert_array_equal(first.covariances, second.covariances)
    np.testing.assert_array_equal(done[1].map.landmark_ids, again.map.landmark_ids)


@pytest.mark.parametrize("detector", ["orb", "sift", "fast", "harris"])
def test_descriptors_track_too(room, detector):
    config = preset("stereo")
    config = replace(config, features=replace(config.features, detector=detector, count=300))
    part = room.part(0, 24)
    estimates, result, _ = run(part, config)
    assert {e.status for e in estimates} == {Status.TRACKING}
    assert sum(e.is_keyframe for e in estimates) < 20
    assert ate(result.trajectory, room.truth).rmse < 0.02
    _, again, _ = run(room.part(0, 6), config)
    np.testing.assert_array_equal(
        again.trajectory_live.Ts_world_body, result.trajectory_live.Ts_world_body[:6]
    )


@pytest.mark.parametrize("detector", ["orb", "sift", "harris"])
def test_flow_follows_any_corners(room, detector):
    config = preset("stereo-flow")
    config = replace(config, features=replace(config.features, detector=detector))
    estimates, result, _ = run(room.part(0, 20), config)
    assert {e.status for e in estimates} == {Status.TRACKING}
    assert ate(result.trajectory, room.truth).rmse < 0.02


def test_dense_disparities_do_as_well(room):
    config = preset("stereo-flow")
    config = replace(config, stereo=replace(config.stereo, method="sgbm"))
    estimates, result, _ = run(room.part(0, 30), config)
    assert {e.status for e in estimates} == {Status.TRACKING}
    assert ate(result.trajectory, room.truth).rmse < 0.025


def test_observers_are_told(room):
    vo = StereoVO(room.rig)
    estimates, keyframes, maps = [], [], []
    vo.worker.on_estimate.append(estimates.append)
    vo.worker.on_keyframe.append(keyframes.append)
    vo.worker.on_map.append(maps.append)
    returned = [vo.track(frame) for frame in room.part(0, 12)]
    vo.finish()
    assert [e.frame_id for e in estimates] == list(range(12))
    assert [k.stamp_ns for k in keyframes] == [e.stamp_ns for e in returned if e.is_keyframe]
    assert [k.id for k in keyframes] == list(range(len(keyframes)))
    assert keyframes[0].features is not None
    assert len(keyframes[0].features) > 100
    assert [s.version for s in maps] == sorted({s.version for s in maps})
    assert maps[-1].num_keyframes == len(keyframes)
    assert maps[-1].num_landmarks == vo.map.num_landmarks
    assert vo.worker.failures == []


def test_motion_is_predicted(room):
    """Flow without a pyramid reaches two pixels: only the prediction brings it near enough."""
    config = preset("stereo-flow")
    config = replace(config, flow=replace(config.flow, levels=1))
    estimates, result, _ = run(room, config)
    assert [e.status for e in estimates].count(Status.TRACKING) >= 46
    assert ate(result.trajectory, room.truth).rmse < 0.03


def test_the_path_may_be_read_in_the_middle(room, done):
    vo = StereoVO(room.rig)
    for frame in room.part(0, 20):
        vo.track(frame)
    half = vo.finish()
    assert len(half.trajectory) == 20
    for frame in room.part(20, 48):
        vo.track(frame)
    np.testing.assert_array_equal(
        vo.finish().trajectory.Ts_world_body, done[1].trajectory.Ts_world_body
    )
    assert len(half.trajectory) == 20


def test_the_window_bounds_what_is_kept(done):
    m = done[1].map
    with_payload = [k for k in m.keyframe_ids.tolist() if m.keyframe(k).features is not None]
    assert len(with_payload) <= 11
    assert m.num_landmarks < 11 * 400


def test_another_window_is_another_path_and_as_good(room, done):
    config = preset("stereo-flow")
    config = replace(config, window=replace(config.window, size=3, fixed=1))
    _, result, _ = run(room, config)
    assert ate(result.trajectory, room.truth).rmse < 0.03
    assert not np.array_equal(result.trajectory.Ts_world_body, done[1].trajectory.Ts_world_body)


def test_presets_and_rhythms_that_are_not_there(room):
    assert set(PRESETS) >= {"stereo", "stereo-flow"}
    with pytest.raises(ConfigError, match="did you mean 'stereo-flow'"):
        preset("stereo-flows")
    with pytest.raises(ConfigError, match="rhythm"):
        StereoVO(room.rig, rhythm="inlin")


def test_one_camera_is_no_pair(room):
    with pytest.raises(CalibrationError, match="two cameras"):
        StereoVO(replace(room.rig, cameras=room.rig.cameras[:1]))
