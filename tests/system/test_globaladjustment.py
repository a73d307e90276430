"""The whole map adjusted: nearer to the truth, whole after each part, given up where told."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from adjustworlds import CAMERA, DEPTH, PIXELS, SCALE, adjust_world
from mapworlds import same_map
from odomap.backend.bundle import BundleConfig
from odomap.geometry.lie import se3_exp, se3_inverse
from odomap.maps.keyframes import Keyframe
from odomap.simulation.world import World
from odomap.system.adjusting import AdjustingConfig
from odomap.system.config import preset
from odomap.system.depthbias import DepthBias
from odomap.system.globaladjustment import GlobalAdjuster
from odomap.system.slam import Slam


def adjuster_of(w, bias=0.0, **how):
    known = DepthBias(np.full(3, 1.0))
    known.value = np.array([bias, 0.0, 0.0])
    parts = w.map, CAMERA, w.T_body_camera, PIXELS, SCALE, DEPTH, known, 3.5, BundleConfig()
    return GlobalAdjuster(*parts, AdjustingConfig(**how))


def job_of(w, **how):
    job = adjuster_of(w, after=0, **how).add(w.map.keyframe(0), has_closed=True)
    job.read()
    return job


def adjust(w, **how):
    job_of(w, **how).solve().write(w.map)


@pytest.mark.parametrize("deep", [True, False])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_map_comes_nearer_to_the_truth(deep, seed):
    w = adjust_world(deep=deep, seed=seed)
    before, landmarks = w.ate(), np.median(w.landmark_errors())
    adjust(w)
    # Of one camera the size stays what it was: the farthest keyframe keeps its distance.
    places, true = w.map.Ts_world_body(np.arange(len(w.true)))[:, :3, 3], w.true[:, :3, 3]
    far = np.argmax(np.linalg.norm(places - places[0], axis=1))
    size = (
        1.0 if deep else np.divide(*np.linalg.norm([x[far] - x[0] for x in (true, places)], axis=1))
    )
    errors = np.linalg.norm(size * (places - places[0]) + true[0] - true, axis=1)
    assert np.sqrt(np.mean(errors**2)) < 0.2 * before
    if deep:
        assert np.median(w.landmark_errors()) < 0.2 * landmarks
    np.testing.assert_allclose(w.map.T_world_body(0), w.true[0], atol=1e-12)


def test_what_all_depths_are_off_by_is_taken_away():
    errors = []
    for bias in (0.0, 0.02):
        w = adjust_world(seed=3, bias=0.02)
        adjust(w, bias=bias)
        errors.append(w.ate())
    assert errors[1] < 0.3 * errors[0]
    assert errors[1] < 0.03


@pytest.mark.parametrize("bias", [0.0, 0.02])
def test_a_map_that_others_made_tells_its_bias(bias):
    """Made as mapping makes it: landmarks lie where depths say, less the bias."""
    w = adjust_world(seed=3, bias=bias)
    adjuster = adjuster_of(w)
    adjust(w, bias=bias)
    job = adjuster.whole()
    job.read()
    before = w.ate()
    change = job.solve()
    found, _ = adjuster.problem(w.map.snapshot(w.map.keyframe_ids), None)
    zero, _ = adjuster.problem(w.map.snapshot(w.map.keyframe_ids), np.zeros(3))
    np.testing.assert_allclose(
        np.nanmedian(zero.inverse_depths - found.inverse_depths), bias, atol=1e-3
    )
    change.write(w.map)
    assert w.ate() < 1.2 * before + 1e-3


def test_scales_of_one_camera_stay_and_points_are_in_them():
    worlds = [adjust_world(deep=False, scales=scales, seed=4) for scales in (0.0, 0.3)]
    scales = worlds[1].map.states.scales.copy()
    assert np.ptp(scales) > 0.5
    for w in worlds:
        adjust(w)
    np.testing.assert_array_equal(worlds[1].map.states.scales, scales)
    np.testing.assert_allclose(worlds[0].errors(), worlds[1].errors(), atol=1e-6)
    np.testing.assert_allclose(*(w.landmark_errors() for w in worlds), atol=1e-5)


def test_wrong_observations_are_dropped_and_hardly_any_other():
    w = adjust_world(wrong=0.03, seed=5)
    seen = w.map.num_observations
    adjust(w)
    left = [m for k, m in w.wrong.tolist() if m in w.map.observations_of(k)[0]]
    assert len(left) < 0.03 * len(w.wrong)
    assert seen - w.map.num_observations < 1.3 * len(w.wrong)
    clean = adjust_world(seed=5)
    adjust(clean)
    assert w.ate() < 2.0 * clean.ate()


def test_a_stopped_job_writes_nothing():
    w = adjust_world(seed=1)
    job, stop = job_of(w), threading.Event()
    stop.set()
    change = job.solve(stop)
    version = w.map.version
    change.write(w.map)
    assert change.parts() == ()
    assert w.map.version == version


def test_the_same_map_gives_the_same_bytes():
    maps = []
    for _ in range(2):
        w = adjust_world(seed=6, wrong=0.02)
        adjust(w)
        maps.append(w.map)
    same_map(*maps)


def test_the_map_is_whole_after_each_part(monkeypatch):
    monkeypatch.setattr("odomap.system.globaladjustment.PART", 200)
    w = adjust_world(seed=2)
    parts = job_of(w).solve().parts()
    assert len(parts) > 4
    errors = [np.median(w.landmark_errors())]
    for part in parts:
        part.write(w.map)
        errors.append(np.median(w.landmark_errors()))
        w.map.snapshot(w.map.keyframe_ids)
    assert max(errors[1:]) <= errors[0]
    assert errors[-1] < 0.5 * errors[0]
    other = adjust_world(seed=2)
    adjust(other)
    np.testing.assert_array_equal(w.map.states.Ts_world_body, other.map.states.Ts_world_body)
    np.testing.assert_array_equal(w.landmark_errors(), other.landmark_errors())


def test_what_was_mapped_meanwhile_is_kept():
    w = adjust_world(seed=1)
    m, last = w.map, len(w.true) - 1
    change = job_of(w).solve()
    step = se3_exp(np.array([0.3, 0.0, 0.1, 0.0, 0.02, 0.0]))
    new = m.new_keyframe_id()
    m.add_keyframe(Keyframe(new, 10**12, m.keyframe(last).features), m.place(last, step))
    nudge = se3_exp(np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.01]))
    snapshot = m.snapshot([30], [31])
    Ts = snapshot.Ts_world_body.copy()
    Ts[0] = Ts[0] @ nudge
    moved = snapshot.landmark_ids[:5]
    places = snapshot.points_world.copy()
    places[:5] += 0.5
    read = m.T_world_body(30)
    m.apply(snapshot.solved(Ts, places))
    within = m.snapshot([30], [31])
    m.cull_keyframes([50])
    gone = int(m.observations_of(40)[0][0])
    m.remove_landmarks([gone])
    change.write(m)
    # A keyframe that came since follows, one that was moved keeps that, landmarks too.
    np.testing.assert_allclose(
        se3_inverse(m.T_world_body(last)) @ m.T_world_body(new), step, atol=1e-9
    )
    solved = adjust_world(seed=1)
    adjust(solved)
    expected = solved.map.T_world_body(30) @ se3_inverse(read) @ Ts[0]
    np.testing.assert_allclose(m.T_world_body(30), expected, atol=1e-9)
    again = m.snapshot([30], [31])
    rows = [int(np.flatnonzero(again.landmark_ids == k)[0]) for k in moved]
    were = [int(np.flatnonzero(within.landmark_ids == k)[0]) for k in moved]
    np.testing.assert_array_equal(again.points_anchor[rows], within.points_anchor[were])
    assert not m.is_alive([gone])[0]
    others = np.setdiff1d(np.arange(last), [30, 50])
    np.testing.assert_allclose(m.Ts_world_body(others), solved.map.Ts_world_body(others), atol=1e-9)


def test_covariances_stay_those_of_the_graph():
    w = adjust_world(seed=1)
    w.map.set_covariance([5], 1e-4 * np.eye(6))
    adjust(w)
    np.testing.assert_array_equal(w.map.covariance(5), 1e-4 * np.eye(6))


def test_a_map_without_anything_seen_twice_is_left_alone():
    w = adjust_world(keyframes=3, landmarks=300, spacing=40.0, seed=1)
    change = job_of(w).solve()
    assert change.parts() == ()


@pytest.mark.parametrize("deep", [True, False])
def test_of_the_smallest_maps_it_adjusts_what_can_be(deep):
    adjusted = []
    for left in range(9):
        for keyframes in (1, 2, 3):
            w = adjust_world(keyframes, landmarks=200, deep=deep, spacing=0.3, laps=0.05, seed=1)
            kept = w.seen[:left]
            w.map.remove_landmarks(np.setdiff1d(np.arange(200), kept))
            places = w.map.Ts_world_body(w.map.keyframe_ids)
            parts = job_of(w).solve().parts()
            for part in parts:
                part.write(w.map)
            assert np.isfinite(w.map.Ts_world_body(w.map.keyframe_ids)).all()
            if parts:
                adjusted.append((keyframes, left))
            else:
                after = w.map.Ts_world_body(w.map.keyframe_ids)
                np.testing.assert_array_equal(places, after)
    assert (2, 8) in adjusted
    assert not [k for k, n in adjusted if k == 1 or n < 3]


def test_landmarks_that_only_keyframes_without_features_share_are_left_alone():
    w = adjust_world(keyframes=3, landmarks=200, deep=False, spacing=0.3, laps=0.05, seed=1)
    for k in (1, 2):
        w.map._keyframes[k] = w.map.keyframe(k).without_payload()
    assert job_of(w).solve().parts() == ()


@pytest.mark.parametrize(("closing", "adjusting"), [(True, True), (True, False), (False, True)])
def test_slam_adjusts_where_it_closes_loops(closing, adjusting):
    config = preset("stereo")
    config = replace(
        config,
        closing=replace(config.closing, enabled=closing),
        adjusting=replace(config.adjusting, enabled=adjusting),
    )
    rig = World.make(kind="room", frames=1, sensors=("stereo",)).rig
    stages = Slam(rig, config).worker.stages
    assert (stages.closer is not None) == closing
    assert (stages.adjuster is not None) == (closing and adjusting)


def test_it_begins_some_keyframes_after_a_loop_or_at_the_end():
    w = adjust_world(keyframes=4, landmarks=100)
    keyframe = w.map.keyframe(0)

    def begins(adjuster, *closed):
        return [adjuster.add(keyframe, c) is not None for c in closed]

    assert begins(adjuster_of(w, after=2), 0, 0, 1, 0, 0, 0, 0) == [0, 0, 0, 0, 1, 0, 0]
    assert begins(adjuster_of(w, after=2), 1, 0, 1, 0, 0, 0) == [0, 0, 0, 0, 1, 0]
    ended = adjuster_of(w, after=2)
    assert ended.end() is None
    begins(ended, 1, 0)
    assert ended.end() is not None
    assert ended.end() is None
