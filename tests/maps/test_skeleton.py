"""Keyframes in units of their own: what hangs from them is in the world where it was put."""

from dataclasses import replace

import numpy as np
import pytest

from maps.test_map_properties import random_pose
from mapworlds import Walk
from odomap.geometry.lie import se3_exp
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.maps.states import act_inverse, compose, inverse, stretched


def scaled_map(seed, keyframes=6):
    """Return a map whose keyframes have units of their own; two of them are culled."""
    rng, m = np.random.default_rng(seed), Map()
    for k in range(keyframes):
        m.add_keyframe(Keyframe(k, 10 * k), random_pose(rng), scale=float(np.exp(rng.normal())))
        ids = m.add_landmarks(k, rng.normal(size=(5, 3)))
        m.add_observations(k, ids, np.arange(5))
        m.add_observations(k, rng.integers(0, ids[-1] + 1, 8), np.arange(5, 13))
    m.cull_keyframes([2, 3])
    return m


@pytest.mark.parametrize("keyframe_id", [1, 2, 3, 5])
def test_a_frame_hangs_where_it_is_also_from_a_keyframe_that_was_culled(keyframe_id):
    m, rng = scaled_map(1), np.random.default_rng(2)
    T = random_pose(rng)
    hangs = m.relative(keyframe_id, T)
    np.testing.assert_allclose(m.place(keyframe_id, hangs), T, atol=1e-12)
    away = np.linalg.norm(T[:3, 3] - m.T_world_body(keyframe_id)[:3, 3])
    assert np.linalg.norm(hangs[:3, 3]) * m.scale(keyframe_id) == pytest.approx(away)
    Ts = np.stack([random_pose(rng) for _ in range(4)])
    np.testing.assert_allclose(m.place(keyframe_id, m.relative(keyframe_id, Ts)), Ts, atol=1e-12)
    with pytest.raises(KeyError):
        m.relative(99, T)


def test_a_new_keyframe_has_the_units_of_the_world_whatever_those_of_its_parent():
    m, rng = scaled_map(1), np.random.default_rng(2)
    T = random_pose(rng)
    m.add_keyframe(Keyframe(6, 60), T, parent=5)
    assert m.scale(5) != 1.0
    assert m.scale(6) == 1.0
    points = rng.normal(size=(4, 3))
    ids = m.add_landmarks(6, points)
    np.testing.assert_allclose(m.points_world(ids), points @ T[:3, :3].T + T[:3, 3])


@pytest.mark.parametrize("seed", range(5))
def test_a_solution_that_changes_nothing_changes_nothing_in_whatever_units(seed):
    walk = Walk(seed)
    walk.go(60)
    m = walk.map
    ids, landmarks = m.keyframe_ids, m.landmark_ids
    snapshot = m.snapshot(ids)
    units = np.exp(np.random.default_rng(seed).normal(size=len(ids)))
    m.apply(snapshot.solved(snapshot.Ts_world_body, snapshot.points_world, scales=units))
    before, places = m.Ts_world_body(ids), m.points_world(landmarks)
    frame = random_pose(np.random.default_rng(seed))
    hung = {k: m.place(k, frame) for k in ids.tolist()}
    scales = m.states.scales[ids].copy()
    snapshot = m.snapshot(ids[1:], ids[:1])
    m.apply(snapshot.solved(snapshot.Ts_world_body, snapshot.points_world))
    # The same in another world: turned, moved and stretched as a whole.
    S = random_pose(np.random.default_rng(seed + 9)), np.asarray(1.7)
    snapshot = m.snapshot(ids)
    Ts, units = compose(S, (snapshot.Ts_world_body, snapshot.scales))
    points = 1.7 * snapshot.points_world @ S[0][:3, :3].T + S[0][:3, 3]
    m.apply(snapshot.solved(Ts, points, scales=units))
    np.testing.assert_allclose(m.Ts_world_body(ids), before, atol=1e-9)
    np.testing.assert_allclose(m.points_world(landmarks), places, atol=1e-8)
    np.testing.assert_allclose(m.states.scales[ids], scales, rtol=1e-9)
    for k, T in hung.items():
        np.testing.assert_allclose(m.place(k, frame), T, atol=1e-8)


def test_units_of_keyframes_say_nothing_of_the_world():
    m = scaled_map(3)
    ids = m.keyframe_ids
    snapshot = m.snapshot(ids)
    Ts, points, landmarks = m.Ts_world_body(ids), snapshot.points_world, snapshot.landmark_ids
    m.apply(snapshot.solved(Ts, points, scales=np.linspace(0.5, 2.0, len(ids))))
    # The anchor keeps its own, and all else is relative to it.
    S = compose((Ts[0], m.states.scales[ids[0]]), inverse((Ts[0], np.asarray(0.5))))
    np.testing.assert_allclose(m.Ts_world_body(ids), compose(S, (Ts, np.ones(len(ids))))[0])
    np.testing.assert_allclose(act_inverse(S, m.points_world(landmarks)), points, atol=1e-9)


def test_a_covariance_stretches_with_the_lengths_of_its_tangent():
    rng = np.random.default_rng(0)
    xi = rng.normal(size=(20000, 6)) * [1, 2, 3, 0.1, 0.2, 0.3]
    covariance = np.cov(xi.T)
    xi[:, :3] *= 2.5
    np.testing.assert_allclose(stretched(covariance, 2.5), np.cov(xi.T), rtol=1e-9)
    many = stretched(np.stack([covariance] * 2), np.array([1.0, 2.5]))
    np.testing.assert_array_equal(many[0], covariance)
    np.testing.assert_array_equal(many[1], stretched(covariance, 2.5))


def test_a_correction_of_scale_stretches_a_covariance_and_what_hangs():
    m = Map()
    covariance = np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    m.add_keyframe(Keyframe(0, 0), np.eye(4))
    m.add_keyframe(Keyframe(1, 1), se3_exp(np.full(6, 0.3)), covariance=covariance)
    hangs = m.relative(1, se3_exp(np.full(6, 0.5)))
    snapshot = m.snapshot([1], [0], landmarks=False)
    m.apply(snapshot.solved(snapshot.Ts_world_body, np.zeros((0, 3)), scales=np.array([3.0, 1.0])))
    np.testing.assert_allclose(m.covariance(1), stretched(covariance, 3.0))
    moved = m.relative(1, m.place(1, hangs))
    np.testing.assert_allclose(moved, hangs, atol=1e-12)
    step = m.place(1, hangs)[:3, 3] - m.T_world_body(1)[:3, 3]
    np.testing.assert_allclose(np.linalg.norm(step), 3.0 * np.linalg.norm(hangs[:3, 3]))


def hung(count=8):
    """Return a map of keyframes along a line, each hanging from the one before."""
    m = Map()
    for k in range(count):
        m.add_keyframe(Keyframe(k, 10 * k), se3_exp(np.array([k, 0, 0, 0, 0, 0.1 * k])))
    return m


def test_a_culled_keyframe_hangs_from_the_holder_it_is_given():
    m, T = hung(), se3_exp(np.array([0.3, 0.1, 0, 0, 0, 0.2]))
    frames = [m.place(k, T) for k in (4, 5)]
    m.set_growth(6, np.eye(6))
    m.cull_keyframes([4, 5], [1, 2])
    assert [m.parent(k) for k in (4, 5, 6)] == [1, 2, 2]
    for k, frame in zip((4, 5), frames):
        np.testing.assert_allclose(m.place(k, T), frame, atol=1e-12)
    assert np.isnan(m.growth(6)).all()  # from there nobody measured it
    with pytest.raises(ValueError, match="came after"):
        m.cull_keyframes([3], [6])
    with pytest.raises(ValueError, match="holders"):
        m.cull_keyframes([3, 6], [1])


def test_edges_are_replaced_by_others():
    m = hung()
    for k in range(4):
        m.add_edge(k, k + 1, np.eye(4), (k + 1) * np.eye(6), "submap")
    before = m.edges()
    two = replace(before, **{
        name: getattr(before, name)[:2]
        for name in ("i", "j", "Ts_i_j", "scales_i_j", "information")
    }, kind=("folded",) * 2)  # fmt: skip
    version = m.version
    m.replace_edges([1, 2], two)
    after = m.edges()
    assert after.i.tolist() == [0, 3, 0, 1]
    assert after.kind == ("submap", "submap", "folded", "folded")
    assert after.information[:, 0, 0].tolist() == [1, 4, 1, 2]
    assert m.version > version
    assert m.add_edge(0, 7, np.eye(4), np.eye(6), "loop") == 4
    with pytest.raises(ValueError, match="no edge 9"):
        m.replace_edges([9], two)
