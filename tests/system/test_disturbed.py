"""What odometry does when sensors fail: it says so, and goes on where it can."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.errors import CalibrationError
from odomap.evaluation.metrics import ate
from odomap.geometry.lie import se3_inverse, se3_log
from odomap.maps.estimate import Status
from odomap.sources.disturb import blank, blur, drop, freeze
from odomap.system.config import preset
from odomap.system.odometry import StereoVO

from .conftest import Recording


def run(source, config=None):
    vo = StereoVO(source.rig, config)
    return [vo.track(frame) for frame in source], vo.finish()


def edited(room, edit):
    """Return the recording with each frame's images put through edit(frame)."""
    frames = [replace(f, images=edit(f)) for f in room]
    return Recording(room.rig, room.truth, frames)


def lost(estimates):
    return [e.frame_id for e in estimates if e.status is Status.LOST]


def still(estimate, last):
    """Check that a pose repeats the last one, up to what mapping has mended since."""
    np.testing.assert_allclose(estimate.T_world_body.matrix, last.T_world_body.matrix, atol=0.005)


def honest(room, estimates):
    """Check that each pose given is within five sigma of truth, as far as it claims to know."""
    true = se3_inverse(room.truth.Ts_world_body[0]) @ room.truth.Ts_world_body
    for e in estimates[1:]:
        error = se3_log(se3_inverse(true[e.frame_id]) @ e.T_world_body.matrix)
        nees = error @ np.linalg.solve(e.covariance, error) / 6
        assert nees < 25, f"frame {e.frame_id} ({e.status}): {nees:.1f}"


def test_a_covered_lens_is_said_and_tracking_comes_back(room):
    estimates, result = run(blank(room, range(20, 23)))
    assert lost(estimates) == [20, 21, 22]
    for e in estimates[20:23]:
        assert "nearly uniform" in e.reason
        assert e.num_inliers == 0
        assert not e.is_keyframe
        assert e.keyframe_id == estimates[22].keyframe_id
        still(e, estimates[19])
    assert estimates[23].status is Status.RECOVERED
    assert {e.status for e in estimates[24:]} == {Status.TRACKING}
    # Lost frames have no row, and what is unseen grows unsure.
    assert len(result.trajectory) == len(room) - 3
    assert not set(room.stamps_ns[20:23].tolist()) & set(result.trajectory.stamps_ns.tolist())
    sigma = [np.sqrt(e.covariance[0, 0]) for e in estimates[19:23]]
    assert (np.diff(sigma) > 0.01).all()
    assert ate(result.trajectory, room.truth).rmse < 0.025
    honest(room, estimates)


def test_a_lens_covered_beyond_patience_is_no_reason_to_start_anew(room):
    """Nothing can be started from black images, and the last keyframe is still known."""
    estimates, result = run(blank(room, range(12, 22)))
    assert lost(estimates) == list(range(12, 22))
    assert all(e.reason for e in estimates[12:22])
    assert estimates[22].status is Status.RECOVERED
    assert ate(result.trajectory, room.truth).rmse < 0.03
    honest(room, estimates)


def test_a_lens_covered_to_the_end(room):
    estimates, result = run(blank(room.part(0, 20), range(9, 20)))
    assert lost(estimates) == list(range(9, 20))
    assert len(result.trajectory) == 9


@pytest.mark.parametrize("frames", [range(20, 22), range(20, 24), range(10, 40, 2)])
def test_lost_frames_are_bridged(room, frames):
    source = drop(room, frames)
    estimates, result = run(source)
    assert lost(estimates) == []
    assert len(result.trajectory) == len(room) - len(frames)
    assert ate(result.trajectory, room.truth).rmse < 0.03
    honest(room, estimates)


def test_a_camera_that_hangs_is_said_and_is_caught_up_with(room):
    estimates, _ = run(freeze(room, range(20, 23)))
    assert lost(estimates) == [20, 21, 22]
    assert all("frozen" in e.reason for e in estimates[20:23])
    assert estimates[23].status is Status.RECOVERED
    true = se3_inverse(room.truth.Ts_world_body[0]) @ room.truth.Ts_world_body
    off = [np.linalg.norm(e.T_world_body.t - true[e.frame_id, :3, 3]) for e in estimates]
    assert max(off[:20] + off[24:]) < 0.06


def test_blur_is_tracked_or_said(room):
    estimates, result = run(blur(room, range(20, 24), length_px=12.0, angle_deg=20.0))
    assert set(lost(estimates)) <= set(range(20, 24))
    assert {e.status for e in estimates[25:]} == {Status.TRACKING}
    assert ate(result.trajectory, room.truth).rmse < 0.04
    honest(room, estimates)


def test_a_gap_of_two_seconds_is_crossed_or_said(room):
    """Half a room further on: found again by descriptors, or begun anew with a doubt to match."""
    estimates, result = run(drop(room, range(14, 38)))
    after = estimates[14:]
    assert after[0].frame_id == 38
    assert after[0].status in (Status.LOST, Status.RECOVERED, Status.TRACKING)
    assert all(e.reason for e in after if e.status in (Status.LOST, Status.INITIALIZING))
    assert after[-1].status is Status.TRACKING
    honest(room, estimates)
    assert np.isfinite(result.trajectory.covariances).all()


def test_another_place_after_patience_is_a_new_start_that_admits_it(room):
    """Upside down nothing is found again: after six frames odometry begins anew."""

    def turn(frame):
        if frame.id < 20:
            return frame.images
        return tuple(np.ascontiguousarray(image[::-1]) for image in frame.images)

    estimates, result = run(edited(room.part(0, 40), turn))
    assert lost(estimates) == list(range(20, 25))
    anew = estimates[25]
    assert anew.status is Status.INITIALIZING
    assert "anew" in anew.reason
    assert anew.is_keyframe
    still(anew, estimates[19])
    # Half a second unseen: tens of centimetres of doubt, kept by all that follows.
    for e in estimates[25:]:
        assert np.sqrt(np.trace(e.covariance[:3, :3])) > 0.3
    assert {e.status for e in estimates[26:]} == {Status.TRACKING}
    assert len(result.trajectory) == 35


def test_a_start_in_the_dark_waits_for_light(room):
    estimates, result = run(blank(room.part(0, 12), range(4)))
    for e in estimates[:4]:
        assert e.status is Status.INITIALIZING
        assert "points with depth" in e.reason
        assert e.keyframe_id == -1
        assert not e.is_keyframe
    assert {e.status for e in estimates[4:]} == {Status.TRACKING}
    assert len(result.trajectory) == 8
    np.testing.assert_allclose(result.trajectory.Ts_world_body[0], np.eye(4), atol=1e-12)
    assert not result.trajectory.covariances[0].any()
    assert result.map.num_keyframes == sum(e.is_keyframe for e in estimates)


def test_darkness_leaves_nothing_behind(room):
    frames = [replace(f, id=10 * k + f.id) for k in range(3) for f in room.part(0, 10)]
    dark = Recording(room.rig, room.truth, frames)
    estimates, result = run(blank(dark, range(100)))
    assert {e.status for e in estimates} == {Status.INITIALIZING}
    assert len(result.trajectory) == 0
    assert result.map.num_landmarks == 0
    assert result.map.num_keyframes <= 1


def test_without_a_right_image_frames_are_tracked_but_no_keyframes_made(room):
    estimates, result = run(
        edited(room, lambda f: (f.images[0], None if 10 <= f.id < 16 else f.images[1]))
    )
    assert lost(estimates) == []
    assert not any(e.is_keyframe for e in estimates[10:16])
    wanting = [e for e in estimates[10:16] if e.reason]
    assert wanting
    assert all(e.reason == "the right image is missing: no keyframe" for e in wanting)
    assert any(e.is_keyframe for e in estimates[16:19])
    assert ate(result.trajectory, room.truth).rmse < 0.03
    honest(room, estimates)


@pytest.mark.parametrize("images", [lambda f: (f.images[0], None), lambda f: f.images[:1]])
def test_one_image_alone_cannot_start(room, images):
    estimates, result = run(edited(room.part(0, 4), images))
    assert {e.status for e in estimates} == {Status.INITIALIZING}
    assert all("right image is missing" in e.reason for e in estimates)
    assert len(result.trajectory) == 0


def test_without_a_left_image_a_frame_is_lost(room):
    estimates, _ = run(
        edited(room.part(0, 14), lambda f: (None if f.id in (0, 8) else f.images[0], f.images[1]))
    )
    assert estimates[0].status is Status.INITIALIZING
    assert estimates[8].status is Status.LOST
    assert "left image is missing" in estimates[8].reason
    assert estimates[9].status is Status.RECOVERED


@pytest.mark.parametrize("name", ["stereo", "stereo-flow", "sgbm"])
def test_swapped_images_are_said(room, name):
    config = preset("stereo-flow" if name == "sgbm" else name)
    if name == "sgbm":
        config = replace(config, stereo=replace(config.stereo, method="sgbm"))
    source = edited(room.part(0, 8), lambda f: f.images[::-1])
    with pytest.raises(CalibrationError, match="swapped"):
        run(source, config)


def test_noise_alone_is_not_tracked(room):
    rng = np.random.default_rng(0)
    shape = room.frame(0).images[0].shape

    def noise(frame):
        if frame.id < 10:
            return frame.images
        return tuple(rng.integers(0, 256, shape).astype(np.uint8) for _ in range(2))

    estimates, _ = run(edited(room.part(0, 24), noise))
    assert {e.status for e in estimates[:10]} == {Status.TRACKING}
    assert lost(estimates) == list(range(10, 24))
    assert all(e.reason for e in estimates[10:])
