"""Local mapping as a whole: what it makes of windows of known truth, and of small walks."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from mapworlds import same_map
from odomap.evaluation.metrics import ate
from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.geometry.trajectory import Trajectory
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.simulation.exposure import ImageNoise, expose, measure_depth
from odomap.simulation.render import render
from odomap.simulation.world import START_NS, World
from odomap.system.background import ThreadConfig
from odomap.system.config import Config, preset
from odomap.system.depthbias import DepthBias
from odomap.system.localmapping import KEPT, LocalMapper
from odomap.system.slam import Slam
from odomap.system.visualslam import _sections
from system.conftest import Recording
from windowworlds import CAMERA, row, with_duplicates, with_features, world

RATE_HZ = 12.0


def is_sound(m):
    """Check that all that a map says of who sees what is there."""
    count = 0
    for k in m.keyframe_ids.tolist():
        ids, rows = m.observations_of(k)
        features = m.keyframe(k).features
        assert features is not None
        assert m.is_alive(ids).all()
        assert len(np.unique(ids)) == len(ids)
        if len(rows):
            assert rows.min() >= 0
            assert rows.max() < len(features)
        count += len(ids)
    assert count == m.num_observations
    assert np.isfinite(m.points_world(m.landmark_ids)).all()
    assert np.isfinite(m.Ts_world_body(m.keyframe_ids)).all()


# ---- windows of known truth ----


def as_map(window, off=0.0, seed=0):
    """Return a map of all that a window knows, and its ids; poses after the first two are off."""
    rng, m = np.random.default_rng(seed), Map()
    ids = np.full(len(window.points_world), -1)
    for k, keyframe in enumerate(window.keyframes):
        T = window.Ts_world_camera[k]
        if k > 1:
            T = T @ se3_exp(off * rng.normal(size=6) * [1, 1, 1, 0.2, 0.2, 0.2])
        new = m.new_keyframe_id()
        made = Keyframe(new, keyframe.stamp_ns, keyframe.features)
        m.add_keyframe(made, T, parent=new - 1, covariance=np.zeros((6, 6)))
        rows = np.flatnonzero(window.obs_keyframe == k)
        seen = window.obs_landmark[rows]
        fresh = seen[ids[seen] < 0]
        points = window.points_world[fresh]
        R, t = window.Ts_world_camera[k, :3, :3], window.Ts_world_camera[k, :3, 3]
        ids[fresh] = m.add_landmarks(new, (points - t) @ R, window.descriptors[fresh])
        m.add_observations(new, ids[seen], window.obs_keypoint[rows])
    return m, ids


def mapper_of(m, config=None, has_depth=False, **how):
    config = Config() if config is None else config
    sections = replace(_sections(config), sigma_px=0.5, level_scale=1.2)
    return LocalMapper(
        m,
        CAMERA,
        np.eye(4),
        sections,
        DepthBias(np.zeros(3)),
        has_depth=has_depth,
        **how,
    )


def mapped(m, mapper=None):
    """Work on the newest keyframe's window; return the mapper."""
    mapper = mapper_of(m) if mapper is None else mapper
    job = mapper.add(m.keyframe(int(m.keyframe_ids[-1])))
    version = m.version
    change = job.solve()
    assert m.version == version, "solving touches nothing"
    change.write(m)
    is_sound(m)
    return mapper


def pose_errors(m, Ts):
    return se3_log(se3_inverse(Ts) @ m.Ts_world_body(np.arange(len(Ts))))


def test_poses_come_back_to_the_truth():
    made = world(known=1.0)
    m, _ = as_map(made.window, off=0.01)
    before = np.abs(pose_errors(m, made.window.Ts_world_camera)).max()
    mapped(m)
    assert np.abs(pose_errors(m, made.window.Ts_world_camera)).max() < 0.6 * before


def test_what_was_not_a_landmark_becomes_one():
    made = world(known=0.4)
    m, ids = as_map(made.window)
    mapper = mapped(m)
    assert mapper.counts["landmarks_created"] > 30
    new = np.setdiff1d(m.landmark_ids, ids)
    assert len(new) <= mapper.counts["landmarks_created"]
    points = m.points_world(new)
    nearest = np.linalg.norm(points[:, None] - made.points[None], axis=2).min(axis=1)
    assert np.median(nearest) < 0.15
    newest = int(m.keyframe_ids[-1])
    seen, _ = m.observations_of(newest)
    assert np.isin(new, seen).all()
    assert (m.count_observers(new) >= 2).all()


def test_two_landmarks_of_one_point_become_one():
    made = world(known=0.8, flips=0.02)
    rows = np.arange(0, len(made.window.points_world), 4)
    window = with_duplicates(made.window, rows, from_keyframe=4)
    m, ids = as_map(window)
    twins = np.arange(len(made.window.points_world), len(window.points_world))
    both = (ids[rows] >= 0) & (ids[twins] >= 0)
    assert both.sum() > 20
    mapper = mapped(m)
    assert mapper.counts["landmarks_fused"] > 0.7 * both.sum()
    one, two = m.resolve(ids[rows[both]]), m.resolve(ids[twins[both]])
    assert (one == two).mean() > 0.7


def test_observations_that_disagree_are_dropped():
    made = world(known=1.0)
    window, newest = made.window, made.window.newest
    keypoints = window.features(newest).keypoints.copy()
    of = np.flatnonzero(window.obs_keyframe == newest)[::20]
    wrong = window.obs_keypoint[of]
    keypoints[wrong] += [0.0, 60.0]
    window = with_features(
        window, newest, keypoints=keypoints, bearings=CAMERA.unproject(keypoints)
    )
    m, ids = as_map(window)
    mapper = mapped(m)
    seen, rows = m.observations_of(int(m.keyframe_ids[-1]))
    still = set(zip(seen.tolist(), rows.tolist()))
    left = [(int(ids[window.obs_landmark[o]]), int(window.obs_keypoint[o])) in still for o in of]
    assert np.mean(left) < 0.1
    assert mapper.counts["observations_dropped"] >= 0.9 * len(of)
    assert mapper.counts["observations_dropped"] < 0.05 * len(window.obs_keyframe) + len(of)


def test_a_keyframe_that_shows_nothing_of_its_own_goes():
    """Ten keyframes at nearly one place: the map keeps some of them."""
    made = world(row(10, step=0.03), known=1.0, sigma_px=0.3)
    m, _ = as_map(made.window)
    mapper = mapped(m)
    gone = [k for k in range(10) if not m.is_keyframe_alive(k)]
    assert 1 <= len(gone) <= Config().culling.keyframes
    assert mapper.counts["keyframes_culled"] == len(gone)
    # Never the first one, nor those that frames still hang from.
    assert 0 not in gone
    assert max(gone) < 10 - KEPT


def test_one_keyframe_alone_is_no_window():
    made = world(row(1), known=1.0)
    m, _ = as_map(made.window)
    assert mapper_of(m).add(m.keyframe(0)) is None


def test_the_newest_keyframe_says_how_sure_it_is():
    made = world(known=1.0)
    m, _ = as_map(made.window)
    newest = int(m.keyframe_ids[-1])
    assert not m.covariance(newest).any()
    mapped(m)
    covariance = m.covariance(newest)
    assert (np.linalg.eigvalsh(covariance) > 0).all()
    assert 1e-4 < np.sqrt(np.trace(covariance[:3, :3])) < 0.1


def test_the_same_window_gives_the_same_map():
    made = world(known=0.5)
    maps = [as_map(made.window, off=0.01)[0] for _ in range(2)]
    for m in maps:
        mapped(m)
    same_map(*maps)


# ---- walks ----


def walk(Ts_body, rounds=1, seed=3):
    """Return a recording of a pair, one of them with depth, at poses (N, 4, 4), again and again.

    Poses are relative to one in the room. Each round has noise of its own.
    """
    made = World.make(
        kind="room",
        seed=seed,
        frames=1,
        rate_hz=RATE_HZ,
        resolution=(320, 240),
        sensors=("stereo", "depth"),
    )
    rig, noise = made.rig, ImageNoise()
    Ts = made.truth.Ts_world_body[0] @ Ts_body
    now = np.zeros(2)
    pictures = [
        [
            render(made.scene, mount.camera, np.stack([T @ mount.T_body_camera.matrix] * 2), now)
            for mount in rig.cameras
        ]
        for T in Ts
    ]
    frames = []
    for n in range(rounds * len(Ts)):
        pair = pictures[n % len(Ts)]
        images = tuple(
            expose(picture, noise, mount.camera.intrinsics, (seed, n, side), 1.0)
            for side, (picture, mount) in enumerate(zip(pair, rig.cameras))
        )
        stamp = START_NS + round(n * 1e9 / RATE_HZ)
        frames.append(Frame(n, stamp, images, measure_depth(pair[0].depth, 1.0, (seed, n))))
    stamps = np.array([frame.stamp_ns for frame in frames])
    return Recording(rig, Trajectory(stamps, np.tile(Ts, (rounds, 1, 1))), frames)


def small_loop(count):
    """Return poses (count, 4, 4) of a camera carried once round a small loop, looking ahead."""
    a = 2 * np.pi * np.arange(count) / count
    xi = np.zeros((count, 6))
    xi[:, 0], xi[:, 1], xi[:, 2] = 0.4 * np.sin(a), 0.1 * np.sin(2 * a), 0.3 * (1 - np.cos(a))
    xi[:, 4] = 0.25 * (np.sin(a + 0.5) - np.sin(0.5))
    return se3_exp(xi)


PER_ROUND = 24


@pytest.fixture(scope="module")
def rounds():
    """Return a small loop walked four times."""
    return walk(small_loop(PER_ROUND), rounds=4)


def tracker(sensors, how):
    """Return the preset for sensors with features or flow."""
    return preset(sensors if how == "features" else f"{sensors}-flow")


def run(source, config, rhythm="inline", after=lambda slam, estimate: None):
    slam = Slam(source.rig, config, rhythm)
    for frame in source:
        after(slam, slam.track(frame))
    return slam, slam.finish()


@pytest.fixture(scope="module")
def walked(rounds):
    """What comes of all four rounds, run once: a system, its result, and the sizes of its map.

    Sizes (N, 2) are numbers of keyframes and landmarks after each frame.
    """

    @cache
    def results(sensors, how):
        sizes = []

        def after(slam, estimate):
            sizes.append((slam.map.num_keyframes, slam.map.num_landmarks))
            if estimate.is_keyframe:
                is_sound(slam.map)

        slam, result = run(rounds, tracker(sensors, how), after=after)
        return slam, result, np.array(sizes)

    return results


@pytest.mark.parametrize("how", ["features", "flow"])
@pytest.mark.parametrize("sensors", ["stereo", "mono", "rgbd"])
def test_a_map_is_sound_at_any_time(walked, sensors, how):
    slam, result, _ = walked(sensors, how)
    is_sound(slam.map)
    assert slam.worker.failures == []
    assert set(result.mapping) == {
        "landmarks_created",
        "landmarks_fused",
        "landmarks_culled",
        "observations_found",
        "observations_dropped",
        "keyframes_culled",
    }
    assert min(result.mapping.values()) >= 0
    assert result.mapping["observations_found"] > 0


@pytest.mark.parametrize("how", ["features", "flow"])
def test_lockstep_makes_the_map_of_inline(rounds, how):
    """To the last bit, and so does every other run."""
    part = rounds.part(0, PER_ROUND)
    config = replace(tracker("stereo", how), threads=ThreadConfig(mapping_delay=1))
    first, one = run(part, config)
    for rhythm in ("inline", "lockstep"):
        again, two = run(part, config, rhythm)
        same_map(first.map, again.map)
        for name in ("trajectory", "trajectory_live", "keyframes"):
            a, b = getattr(one, name), getattr(two, name)
            np.testing.assert_array_equal(a.Ts_world_body, b.Ts_world_body)
            np.testing.assert_array_equal(a.covariances, b.covariances)
        assert one.mapping == two.mapping


def test_a_longer_delay_makes_the_same_map_on_every_run(rounds):
    part = rounds.part(0, PER_ROUND)
    config = replace(tracker("stereo", "features"), threads=ThreadConfig(mapping_delay=3))
    (first, one), (again, two) = (run(part, config, "lockstep") for _ in range(2))
    same_map(first.map, again.map)
    np.testing.assert_array_equal(one.trajectory.Ts_world_body, two.trajectory.Ts_world_body)
    assert not np.array_equal(
        one.trajectory.Ts_world_body, run(part, config)[1].trajectory.Ts_world_body
    )


def test_frames_of_a_keyframe_that_went_stay_where_they_were(rounds):
    """Flow makes many keyframes, most of which go; what hung from them is placed all the same."""
    hangs = {}

    def after(slam, estimate):
        hangs[estimate.stamp_ns] = estimate.keyframe_id

    slam, result = run(rounds.part(0, 2 * PER_ROUND), tracker("stereo", "flow"), after=after)
    m = slam.map
    culled = [not m.is_keyframe_alive(hangs[s]) for s in result.trajectory.stamps_ns.tolist()]
    culled = np.array(culled)
    assert result.mapping["keyframes_culled"] >= 5
    assert culled.sum() >= 5
    for k in {hangs[s] for s in result.trajectory.stamps_ns[culled].tolist()}:
        assert m.parent(k) >= 0
    truth = se3_inverse(rounds.truth.Ts_world_body[0]) @ rounds.truth.Ts_world_body
    off = se3_log(se3_inverse(truth[: len(culled)]) @ result.trajectory.Ts_world_body)
    away = np.linalg.norm(off[:, :3], axis=1)
    assert away[culled].max() < 0.03
    assert np.median(away[culled]) < 2 * np.median(away[~culled]) + 0.002
    assert ate(result.trajectory, rounds.truth).rmse < 0.01


@pytest.fixture(scope="module")
def still():
    """Return ten seconds of a camera that stands still."""
    return walk(np.eye(4)[None], rounds=120)


def sizes_of(source, config):
    """Return how many keyframes and landmarks (N, 2) there are after each frame, and the result."""
    sizes = []

    def after(slam, estimate):
        sizes.append((slam.map.num_keyframes, slam.map.num_landmarks))

    _, result = run(source, config, after=after)
    return np.array(sizes), result


@pytest.mark.parametrize("sensors", ["stereo", "rgbd"])
def test_a_camera_that_stands_still_adds_nothing(still, sensors):
    sizes, result = sizes_of(still.part(0, 70), tracker(sensors, "features"))
    assert (sizes[:, 0] == 1).all()
    assert (sizes[:, 1] == sizes[0, 1]).all()
    assert len(result.trajectory) == 70
    assert np.abs(result.trajectory.Ts_world_body - np.eye(4)).max() < 0.01


@pytest.mark.parametrize("sensors", ["stereo", "rgbd"])
def test_what_flow_adds_of_a_camera_that_stands_still_goes_again(still, sensors):
    """Flow needs a keyframe now and then to go on from; the old ones are not kept."""
    sizes, _ = sizes_of(still, tracker(sensors, "flow"))
    assert sizes[-1, 0] <= 1 + KEPT
    assert sizes[-1, 1] < 1.2 * sizes[0, 1]


def num_doubled(m):
    """Count the keypoints that are two landmarks at once."""
    rows = [m.observations_of(k)[1] for k in m.keyframe_ids.tolist()]
    return sum(len(r) - len(np.unique(r)) for r in rows)


def num_unseen(m):
    """Count the landmarks that no keyframe sees."""
    return int(np.sum(m.count_observers(m.landmark_ids) == 0))


@pytest.mark.parametrize("how", ["features", "flow"])
@pytest.mark.parametrize("sensors", ["stereo", "mono", "rgbd"])
def test_a_place_walked_round_again_and_again_does_not_grow_the_map(walked, rounds, sensors, how):
    _, result, sizes = walked(sensors, how)
    two, four = sizes[2 * PER_ROUND - 1], sizes[-1]
    assert (four <= 1.3 * two).all(), f"keyframes, landmarks: {two} after 2 rounds, {four} after 4"
    align = "se3" if result.is_metric else "sim3"
    assert ate(result.trajectory, rounds.truth, align).rmse < 0.02


@pytest.mark.parametrize("how", ["features", "flow"])
@pytest.mark.parametrize("sensors", ["stereo", "mono", "rgbd"])
def test_every_landmark_is_seen_and_no_keypoint_is_two(walked, sensors, how):
    slam, _, _ = walked(sensors, how)
    assert num_unseen(slam.map) == 0
    assert num_doubled(slam.map) == 0
