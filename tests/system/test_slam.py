"""SLAM with all three kinds of camera and both trackers: where it is, how sure, and the map."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.errors import CalibrationError, ConfigError
from odomap.evaluation.metrics import ate
from odomap.geometry.lie import se3_inverse, se3_log
from odomap.maps.estimate import Status
from odomap.sensors.rig import Rig
from odomap.simulation.world import World
from odomap.system.config import preset
from odomap.system.slam import Slam
from system.conftest import recorded

METRIC = ("stereo", "stereo-flow", "rgbd", "rgbd-flow")
SINGLE = ("mono", "mono-flow")
FEATURES = ("stereo", "rgbd", "mono")


@pytest.fixture(scope="module")
def world():
    """Return four seconds in a room, of a pair of cameras, one of them with depth: 320x240."""
    return recorded(
        World.make(
            kind="room",
            seed=3,
            frames=48,
            rate_hz=12.0,
            resolution=(320, 240),
            sensors=("stereo", "depth"),
        )
    )


def run(source, name, rhythm="inline", **how):
    slam = Slam(source.rig, preset(name), rhythm, **how)
    return [slam.track(frame) for frame in source], slam.finish(), slam


@pytest.fixture(scope="module")
def runs(world):
    """Return what each preset makes of the room, run when first asked for."""
    done = {}

    def of(name):
        if name not in done:
            done[name] = run(world, name)
        return done[name]

    return of


@pytest.mark.parametrize("name", METRIC)
def test_every_frame_is_placed_and_the_path_is_right(world, runs, name):
    estimates, result, _ = runs(name)
    assert [e.status for e in estimates] == [Status.TRACKING] * len(world)
    assert [e.reason for e in estimates] == [""] * len(world)
    np.testing.assert_array_equal(result.trajectory.stamps_ns, world.stamps_ns)
    length = world.truth.path_length
    assert length > 1.5
    assert result.is_metric
    assert ate(result.trajectory, world.truth).rmse < 0.005 * length
    assert ate(result.trajectory_live, world.truth).rmse < 0.005 * length
    assert ate(result.trajectory, world.truth, align="sim3").scale == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize("name", SINGLE)
def test_a_single_camera_starts_soon_and_is_never_lost(world, runs, name):
    estimates, result, _ = runs(name)
    tracking = [e.status is Status.TRACKING for e in estimates]
    first = tracking.index(True)
    assert first <= 15
    assert all(tracking[first:])
    for e in estimates[:first]:
        assert e.status is Status.INITIALIZING
        assert e.reason
    assert not result.is_metric
    # The frames before the start are placed afterwards, those between the two first views.
    assert len(result.trajectory) >= len(world) - 2
    found = ate(result.trajectory, world.truth, align="sim3")
    assert found.rmse < 0.005 * world.truth.path_length


@pytest.mark.parametrize("name", METRIC)
def test_covariances_are_those_of_errors(world, runs, name):
    estimates, result, _ = runs(name)
    live = np.array([e.covariance for e in estimates[1:]])
    for covariances in (live, result.trajectory.covariances[1:]):
        assert np.isfinite(covariances).all()
        np.testing.assert_allclose(covariances, np.swapaxes(covariances, 1, 2), atol=1e-12)
        assert (np.linalg.eigvalsh(covariances) > 0).all()
    true = se3_inverse(world.truth.Ts_world_body[0]) @ world.truth.Ts_world_body
    errors = se3_log(se3_inverse(true) @ result.trajectory.Ts_world_body)
    nees = [
        e @ np.linalg.solve(S, e) / 6
        for e, S in zip(errors[10:], result.trajectory.covariances[10:])
    ]
    # One path is one draw: between a fifth and five.
    assert 0.2 < np.mean(nees) < 5


@pytest.mark.parametrize("name", SINGLE)
def test_covariances_of_a_single_camera_are_of_the_size_of_its_errors(world, runs, name):
    _, result, _ = runs(name)
    covariances = result.trajectory.covariances[1:]
    assert np.isfinite(covariances).all()
    np.testing.assert_allclose(covariances, np.swapaxes(covariances, 1, 2), atol=1e-12)
    assert (np.linalg.eigvalsh(covariances) > -1e-15).all()
    found = ate(result.trajectory, world.truth, align="sim3")
    sigma = np.sqrt(np.trace(covariances[-1][:3, :3])) * found.scale
    assert 0.2 * found.rmse < sigma < 50 * found.rmse


@pytest.mark.parametrize("name", [*METRIC, *SINGLE])
def test_estimates_hold_together(world, runs, name):
    estimates, result, slam = runs(name)
    assert result.map is slam.map
    placed = [e for e in estimates if e.status is Status.TRACKING]
    for frame, e in zip(world, estimates):
        assert (e.frame_id, e.stamp_ns) == (frame.id, frame.stamp_ns)
    live = result.trajectory_live
    emitted = np.array([e.T_world_body.matrix for e in placed])
    np.testing.assert_allclose(live.Ts_world_body, emitted, atol=1e-12)
    for e in placed[1:]:
        tracks = e.tracks
        assert tracks.keypoints.shape == tracks.previous.shape == (len(tracks.inlier), 2)
        assert tracks.inlier.sum() == e.num_inliers >= 15
        assert np.isfinite(tracks.keypoints).all()
        assert np.isfinite(tracks.previous).all()
    # What stands in the map was among the frames.
    stamps = [slam.map.keyframe(k).stamp_ns for k in slam.map.keyframe_ids.tolist()]
    assert np.isin(stamps, world.stamps_ns).all()
    assert np.isin(result.keyframes.stamps_ns, stamps).all()


@pytest.mark.parametrize("name", FEATURES)
def test_frames_hang_from_keyframes_that_were_there(runs, name):
    """A frame may hang from an old keyframe; it may well be culled later, and is placed still."""
    estimates, result, _ = runs(name)
    seen = np.maximum.accumulate([e.keyframe_id for e in estimates])
    begun = np.cumsum([e.is_keyframe for e in estimates])  # mono starts with two at once
    used = [e.keyframe_id for e in estimates if e.status is Status.TRACKING]
    assert min(used) >= 0
    assert (seen <= begun).all()
    assert np.isfinite(result.trajectory.Ts_world_body).all()


@pytest.mark.parametrize("name", [*METRIC, *SINGLE])
def test_the_map_lies_on_the_walls(world, runs, name):
    """Landmarks are where the room is, which the depth image of the first frame tells."""
    _, result, slam = runs(name)
    m = slam.map
    scale = 1.0
    if not result.is_metric:
        scale = ate(result.trajectory, world.truth, align="sim3").scale
    first = int(m.keyframe_ids[0])
    index = int(np.searchsorted(world.stamps_ns, m.keyframe(first).stamp_ns))
    ids, _ = m.observations_of(first)
    # In the frame of that keyframe, whose body is the camera that has the depth.
    T = se3_inverse(m.T_world_body(first))
    points = m.points_world(ids) @ T[:3, :3].T + T[:3, 3]
    camera = world.rig.cameras[0].camera
    pixels = camera.project(points)
    inside = camera.is_inside(pixels, 1.0)
    pixels, points = np.rint(pixels[inside]).astype(int), points[inside]
    measured = world.frame(index).depth[pixels[:, 1], pixels[:, 0]]
    known = np.isfinite(measured) & (measured > 0)
    assert known.sum() > 50
    ratio = scale * points[known, 2] / measured[known]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.03)
    # Corners lie on edges of things, where a pixel decides about the depth.
    assert np.percentile(np.abs(ratio - 1.0), 75) < 0.08


@pytest.mark.parametrize("name", ["stereo", "mono-flow"])
def test_the_same_images_give_the_same_bytes(world, runs, name):
    _, result, _ = runs(name)
    _, again, _ = run(world, name)
    for part in ("trajectory", "trajectory_live", "keyframes"):
        one, two = getattr(result, part), getattr(again, part)
        np.testing.assert_array_equal(one.Ts_world_body, two.Ts_world_body)
        np.testing.assert_array_equal(one.covariances, two.covariances)
    assert result.mapping == again.mapping


def test_the_preset_is_that_of_the_rig(world):
    mono = replace(world.rig, cameras=world.rig.cameras[:1], depth=None)
    for rig, metric in ((world.rig, True), (mono, False)):
        assert Slam(rig).finish().is_metric == metric
    with pytest.raises(CalibrationError, match="no camera"):
        Slam(Rig())
    with pytest.raises(CalibrationError, match="depth"):
        Slam(mono, preset("rgbd"))
    with pytest.raises(CalibrationError):
        Slam(mono, preset("stereo"))
    with pytest.raises(ConfigError, match="rhythm"):
        Slam(world.rig, rhythm="waltz")


def test_a_path_before_the_first_frame_is_empty(world):
    result = Slam(world.rig, preset("stereo")).finish()
    assert len(result.trajectory) == len(result.keyframes) == 0
    assert result.map.num_keyframes == 0


def test_a_map_can_be_gone_on_with_or_only_used(world, runs):
    """The same frames in a map of them: all are placed, and without mapping nothing is written."""
    _, before, slam = runs("stereo")
    tables = slam.map.dump()
    keyframes, landmarks = slam.map.num_keyframes, slam.map.num_landmarks
    localizer = Slam(
        world.rig,
        preset("stereo"),
        map=type(slam.map).restored(tables),
        is_mapping=False,
    )
    estimates = [localizer.track(frame) for frame in world]
    placed = [e for e in estimates if e.status in (Status.TRACKING, Status.RECOVERED)]
    assert len(placed) >= len(world) - 1
    assert not any(e.is_keyframe for e in estimates)
    assert localizer.map.num_keyframes == keyframes
    assert localizer.map.num_landmarks == landmarks
    result = localizer.finish()
    assert ate(result.trajectory, world.truth).rmse < 0.005 * world.truth.path_length
    # In the same world, not in one of its own.
    at = np.searchsorted(before.trajectory.stamps_ns, result.trajectory.stamps_ns)
    apart = result.trajectory.Ts_world_body[:, :3, 3] - before.trajectory.Ts_world_body[at, :3, 3]
    assert np.linalg.norm(apart, axis=1).max() < 0.02
