"""The essential graph: a circuit whose drift, also of scale, one loop takes away; false loops."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.geometry.lie import (
    se3_adjoint,
    se3_exp,
    se3_inverse,
    se3_log,
    sim3_exp,
    sim3_inverse,
)
from odomap.system.essentialgraph import Essentials, LoopEdges, correct

STEP = np.array([0.02, 0.01, 0.01, 2e-3, 2e-3, 2e-3])
"""Standard deviations of a step of odometry."""
SURE = np.array([1e-3, 1e-3, 1e-3, 1e-4, 1e-4, 1e-4])
"""Those of a loop."""


def circle(count, radius=10.0):
    """Return true poses that go once round a circle, looking ahead, and are back at the end."""
    turn = 2 * np.pi * np.arange(count) / (count - 1)
    Ts = se3_exp(np.stack([0 * turn, 0 * turn, 0 * turn, 0 * turn, 0 * turn, turn], axis=1))
    Ts[:, :2, 3] = radius * np.stack([np.sin(turn), 1 - np.cos(turn)], axis=1)
    return Ts


def drifted(true, rng, scale=0.0):
    """Return poses as odometry finds them, steps noisy and longer and longer."""
    n = len(true)
    steps = se3_inverse(true[:-1]) @ true[1:]
    steps[:, :3, 3] *= (1.0 + scale * np.arange(n - 1) / n)[:, None]
    noise = se3_exp(rng.normal(size=(n - 1, 6)) * STEP) if rng is not None else np.eye(4)[None]
    Ts = [true[0]]
    for step in steps @ noise:
        Ts.append(Ts[-1] @ step)
    return np.array(Ts)


def essentials(Ts, loops=None, pairs=None):
    """Return a chain of keyframes that share landmarks with the two before."""
    n = len(Ts)
    growth = np.tile(np.diag(STEP**2), (n, 1, 1))
    growth[0] = np.nan
    covariances = [1e-12 * np.eye(6)]
    for step, Q in zip(se3_inverse(Ts[:-1]) @ Ts[1:], growth[1:]):
        Ad = se3_adjoint(se3_inverse(step))
        covariances.append(Ad @ covariances[-1] @ Ad.T + Q)
    near = np.stack([np.arange(n - 2), np.arange(2, n)], axis=1) if pairs is None else pairs
    return Essentials(
        np.arange(n) * 2,
        Ts,
        np.ones(n),
        np.array(covariances),
        np.arange(n) - 1,
        growth,
        near,
        loop(np.zeros((0, 4, 4)), []) if loops is None else loops,
        7,
    )


def loop(T, ends, scale=1.0):
    T = np.asarray(T).reshape(-1, 4, 4)
    i, j = np.array(ends, np.int64).reshape(-1, 2).T
    information = np.tile(np.diag(SURE**-2), (len(T), 1, 1))
    return LoopEdges(i, j, T, np.full(len(T), scale), information, 2 * np.stack([j, i], axis=1))


def errors(Ts, true):
    return np.linalg.norm(Ts[:, :3, 3] - true[:, :3, 3], axis=1)


def test_one_loop_takes_the_drift_of_a_circuit_away():
    true = circle(80)
    Ts = drifted(true, np.random.default_rng(0))
    found = correct(essentials(Ts), loop(se3_inverse(true[0]) @ true[-1], (0, 79)), False)
    assert found.is_accepted
    assert found.reason == ""
    assert errors(Ts, true)[-1] > 0.2
    assert errors(found.Ts_world_body, true)[-1] < 0.02
    assert errors(found.Ts_world_body, true).mean() < 0.5 * errors(Ts, true).mean()
    np.testing.assert_array_equal(found.Ts_world_body[0], Ts[0])
    np.testing.assert_array_equal(found.scales, 1.0)


def test_without_a_loop_covariances_are_those_of_odometry_and_with_one_they_fit_the_errors():
    true, nees = circle(60), []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        Ts = drifted(true, rng)
        noise = se3_exp(rng.normal(size=6) * SURE)
        parts = essentials(Ts)
        found = correct(parts, loop(se3_inverse(true[0]) @ true[-1] @ noise, (0, 59)), False)
        e = se3_log(se3_inverse(true) @ found.Ts_world_body)[1:]
        S = found.covariances[1:]
        nees.append(np.einsum("na,na->n", e, np.linalg.solve(S, e[:, :, None])[:, :, 0]) / 6)
        assert np.trace(S[-1]) < 0.01 * np.trace(parts.covariances[-1])
        # Near the beginning a loop at the end says little that is new.
        np.testing.assert_allclose(S[0], parts.covariances[1], rtol=0.3, atol=1e-6)
    assert 0.7 < np.mean(nees) < 1.4


def test_steps_that_add_up_to_more_than_the_map_says_are_made_surer():
    true = circle(60)
    parts = essentials(drifted(true, np.random.default_rng(1)))
    closed = loop(se3_inverse(true[0]) @ true[-1], (0, 59))
    right = correct(parts, closed, False).covariances
    found = correct(replace(parts, growth=4.0 * parts.growth), closed, False).covariances
    np.testing.assert_allclose(np.trace(found[30]), np.trace(right[30]), rtol=0.15)
    # What is less than the map says stays as it is.
    found = correct(replace(parts, covariances=4.0 * parts.covariances), closed, False).covariances
    np.testing.assert_allclose(np.trace(found[30]), np.trace(right[30]), rtol=0.05)


def test_a_similarity_takes_the_drift_of_scale_away():
    true = circle(100)
    Ts = drifted(true, None, scale=0.03)
    T = se3_inverse(true[0]) @ true[-1]
    # In the units of the last keyframe the world is 3 % larger.
    found = correct(essentials(Ts), loop(T, (0, 99), scale=1 / 1.03), True)
    assert found.is_accepted
    wanted = 1 / (1.0 + 0.03 * np.arange(100) / 100)
    np.testing.assert_allclose(found.scales, wanted, atol=0.003)
    assert errors(found.Ts_world_body, true).max() < 0.1 * errors(Ts, true).max()
    rigid = correct(essentials(Ts), loop(T, (0, 99)), False)
    assert errors(rigid.Ts_world_body, true).max() > 2 * errors(found.Ts_world_body, true).max()


def test_a_false_loop_is_not_believed_and_says_how_far_off_it_is():
    true = circle(80)
    Ts = drifted(true, np.random.default_rng(1))
    found = correct(essentials(Ts), loop(se3_exp(np.array([0, 0, 0, 0, 0, 1.5])), (0, 40)), False)
    assert not found.is_accepted
    assert found.covariances is None
    assert found.Ts_world_body is Ts
    assert "20 away" in found.reason
    assert "turned" in found.reason
    similar = correct(essentials(Ts), loop(true[0], (0, 40)), True)
    assert not similar.is_accepted
    assert "in scale" in similar.reason


def test_true_loops_outvote_an_older_false_one():
    true = circle(100)
    Ts = drifted(true, np.random.default_rng(2))
    ends = [(0, 99), (2, 98), (50, 52)]
    Zs = [se3_inverse(true[i]) @ true[j] for i, j in ends]
    Zs[2] = se3_exp(np.array([4.0, 3.0, 0.0, 0.0, 0.0, 1.0]))
    older = loop(np.array([Zs[2], Zs[0]]), [ends[2], ends[0]])
    found = correct(essentials(Ts, older), loop(Zs[1], ends[1]), False)
    assert found.is_accepted
    assert found.doubted.tolist() == [[104, 100]]
    assert errors(found.Ts_world_body, true)[-1] < 0.05


def test_covisible_keyframes_of_other_branches_stay_together():
    # There and back: what lies side by side is tied by landmarks, not by the tree.
    out = np.tile(np.eye(4), (30, 1, 1))
    out[:, 0, 3] = np.arange(30)
    true = np.concatenate([out, out[::-1]])
    Ts = drifted(true, np.random.default_rng(3))
    Ts[45:] = Ts[14::-1]  # where landmarks have tied it to the way out
    i = np.arange(15)
    pairs = np.stack([i, 59 - i], axis=1)
    parts = essentials(Ts, pairs=pairs)
    Z = se3_inverse(true[0]) @ true[29]
    found = correct(parts, loop(Z, (0, 29)), False)
    apart = errors(found.Ts_world_body[pairs[:, 0]], found.Ts_world_body[pairs[:, 1]])
    assert found.is_accepted
    assert apart.max() < 0.2 * errors(found.Ts_world_body, Ts).max()


def test_an_unknown_covariance_does_for_a_default():
    true = circle(50)
    Ts = drifted(true, np.random.default_rng(4))
    parts = essentials(Ts)
    parts.growth[:] = np.nan
    found = correct(parts, loop(se3_inverse(true[0]) @ true[-1], (0, 49)), False)
    assert found.is_accepted
    assert found.covariances is None
    assert errors(found.Ts_world_body, true)[-1] < 0.02


@pytest.mark.parametrize("with_scale", [False, True])
def test_the_same_bytes_come_out_every_time(with_scale):
    true = circle(60)
    Ts = drifted(true, np.random.default_rng(5))
    new = loop(se3_inverse(true[0]) @ true[-1], (0, 59))
    first, again = (correct(essentials(Ts), new, with_scale) for _ in range(2))
    assert first.Ts_world_body.tobytes() == again.Ts_world_body.tobytes()
    assert first.covariances.tobytes() == again.covariances.tobytes()


def test_units_of_a_loop_are_those_of_its_keyframes():
    true = sim3_exp(np.random.default_rng(6).normal(size=(40, 7)) * [9, 9, 9, 1, 1, 1, 0.2])
    scales = np.cbrt(np.linalg.det(true[:, :3, :3]))
    Ts = true.copy()
    Ts[:, :3, :3] /= scales[:, None, None]
    Z = sim3_inverse(true[3]) @ true[37]
    scale = np.cbrt(np.linalg.det(Z[:3, :3]))
    Z[:3, :3] /= scale
    parts = essentials(Ts)
    parts.scales[:] = scales
    found = correct(parts, loop(Z, (3, 37), scale), True)
    assert found.is_accepted
    np.testing.assert_allclose(found.Ts_world_body, Ts, atol=1e-8)
    np.testing.assert_allclose(found.scales, scales, atol=1e-8)


def in_pieces(true, begins, rng=None, scale=1.0):
    """Return a chain that was lost where a piece begins, and went on somewhere, in other units."""
    Ts = drifted(true, rng)
    parts = essentials(Ts)
    parts.parent[begins] = -1
    away = sim3_exp(np.array([30.0, -20.0, 5.0, 0.3, -1.0, 2.0, np.log(scale)]))
    moved = away @ Ts[begins:]
    moved[:, :3, :3] /= scale
    Ts[begins:] = moved
    is_far = (parts.pairs < begins).any(axis=1) & (parts.pairs >= begins).any(axis=1)
    return replace(parts, pairs=parts.pairs[~is_far])


@pytest.mark.parametrize("off", [0.0, 1.0])
def test_where_nobody_told_a_piece_is_as_unsure_as_its_own_steps_are_long(off):
    """One camera's pieces differ in scale; what the other is like changes nothing."""
    small = circle(40, 0.2)
    Ts = drifted(small, None, scale=0.1)
    Z = se3_inverse(small[0]) @ small[-1]
    Z[0, 3] += off
    found = []
    for count in (0, 60):
        parts = essentials(np.concatenate([circle(60)[:count], Ts]), pairs=np.zeros((0, 2), int))
        parts.parent[count] = -1
        parts.growth[:] = parts.covariances[:] = np.nan
        found.append(correct(parts, loop(Z, (count, count + 39)), True))
    assert [one.is_accepted for one in found] == [off == 0.0] * 2
    np.testing.assert_allclose(*(one.Ts_world_body[-40:] for one in found), atol=1e-6)


@pytest.mark.parametrize(("with_scale", "scale"), [(False, 1.0), (True, 1.0), (True, 0.4)])
def test_a_loop_between_two_pieces_moves_all_of_the_newer_one(with_scale, scale):
    true = circle(80)
    parts = in_pieces(true, 50, scale=scale)
    Z = se3_inverse(true[4]) @ true[76]
    found = correct(parts, loop(Z, (4, 76), 1.0 / scale), with_scale)
    assert found.is_accepted
    assert found.is_merging.all()
    assert errors(found.Ts_world_body, true).max() < 1e-6
    np.testing.assert_allclose(found.Ts_world_body[:50], parts.Ts_world_body[:50], atol=1e-9)
    np.testing.assert_allclose(found.scales[50:], 1.0 / scale, atol=1e-9)
    np.testing.assert_allclose(found.scales[:50], 1.0, atol=1e-9)
    # How sure the newer piece is comes from the loop alone: unsurer the farther away from it.
    spread = np.trace(found.covariances[:, :3, :3], axis1=1, axis2=2)
    assert spread[76] < spread[70] < spread[50]


def test_a_piece_that_no_loop_ties_stays_where_it_is():
    true = circle(80)
    parts = in_pieces(true, 40, np.random.default_rng(7))
    inside = loop(se3_inverse(true[42]) @ true[78], (42, 78))
    found = correct(parts, inside, False)
    assert found.is_accepted
    assert not found.is_merging.any()
    np.testing.assert_allclose(found.Ts_world_body[:41], parts.Ts_world_body[:41], atol=1e-9)
    assert np.linalg.norm(found.Ts_world_body[78] - parts.Ts_world_body[78]) > 1e-3
    np.testing.assert_allclose(found.covariances[40], parts.covariances[40], rtol=1e-6, atol=1e-9)


def test_of_several_loops_between_two_pieces_the_false_one_is_not_believed():
    true = circle(80)
    parts = in_pieces(true, 40, np.random.default_rng(8))
    ends = [(4, 76), (30, 50), (2, 78), (35, 45)]
    Zs = np.array([se3_inverse(true[i]) @ true[j] for i, j in ends])
    Zs[1] = Zs[1] @ se3_exp(np.array([3.0, -2.0, 1.0, 0.0, 0.5, 0.0]))
    found = correct(parts, loop(Zs, ends), False)
    assert found.is_accepted
    assert found.is_believed.tolist() == [True, False, True, True]
    assert found.is_merging.all()
    assert errors(found.Ts_world_body, true)[[0, 45, 76]].max() < 0.2
    again = replace(parts, loops=loop(Zs[[0, 2]], [ends[0], ends[2]]))
    contradicted = correct(again, loop(Zs[1], ends[1]), False)
    assert not contradicted.is_accepted
    assert not contradicted.is_merging.any()
