"""What is written down of keyframes: who came of whom, and how much less sure, in its own units."""

import numpy as np
import pytest

from odomap.geometry.lie import se3_adjoint, se3_exp, se3_inverse
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.maps.states import stretched
from odomap.system.closure import carry_covariance
from odomap.system.covisibility import acquaint


def odometry(count=5, seed=0):
    """Return a map of a path whose covariance grows by noise of each step, and that noise."""
    rng, m, added = np.random.default_rng(seed), Map(), []
    for k in range(count):
        if k == 0:
            m.add_keyframe(Keyframe(0, 0), se3_exp(rng.normal(size=6)), covariance=np.eye(6))
            continue
        step, A = se3_exp(rng.normal(size=6)), rng.normal(size=(6, 6))
        added.append(A @ A.T)
        Ad = se3_adjoint(se3_inverse(step))
        sure = Ad @ m.covariance(k - 1) @ Ad.T + added[-1]
        m.add_keyframe(Keyframe(k, k), m.T_world_body(k - 1) @ step, covariance=sure)
    return m, added


def rescaled(m, units):
    """Give keyframes other units as a loop does: lengths between them change with them."""
    ids = m.keyframe_ids
    snapshot = m.snapshot(ids[1:], ids[:1], landmarks=False)
    order = np.argsort(snapshot.keyframe_ids)
    Ts = snapshot.Ts_world_body.copy()
    for k in range(1, len(ids)):
        step = se3_inverse(snapshot.Ts_world_body[order[k - 1]]) @ snapshot.Ts_world_body[order[k]]
        step[:3, 3] *= units[k - 1]
        Ts[order[k]] = Ts[order[k - 1]] @ step
    scales = np.empty(len(ids))
    scales[order] = units
    m.apply(snapshot.solved(Ts, np.zeros((0, 3)), scales=scales))


def test_growth_is_what_a_step_added():
    m, added = odometry()
    for k in range(1, 5):
        np.testing.assert_allclose(acquaint(m, k).growth, added[k - 1], atol=1e-9)
    assert np.isnan(acquaint(m, 0).growth).all()


@pytest.mark.parametrize("units", [np.full(5, 1.0), np.array([1.0, 0.9, 1.3, 2.0, 0.5])])
def test_growth_and_motion_are_the_same_when_a_loop_has_changed_the_units(units):
    m, added = odometry()
    before = [acquaint(m, k) for k in range(5)]
    rescaled(m, units)
    for k in range(1, 5):
        known = acquaint(m, k)
        np.testing.assert_allclose(known.T_parent_keyframe, before[k].T_parent_keyframe, atol=1e-9)
        assert known.scale_parent_keyframe == pytest.approx(units[k] / units[k - 1])
        m.set_covariance([k], np.zeros((6, 6)))
        carry_covariance(m, before[k])
        sure = stretched(m.covariance(k), 1 / units[k])
        parent = stretched(m.covariance(k - 1), 1 / units[k])
        T = before[k].T_parent_keyframe.copy()
        T[:3, 3] *= units[k - 1] / units[k]
        Ad = se3_adjoint(se3_inverse(T))
        np.testing.assert_allclose(sure, Ad @ parent @ Ad.T + added[k - 1], atol=1e-8)
        np.testing.assert_allclose(acquaint(m, k).growth, added[k - 1], atol=1e-8)


def test_growth_that_the_map_knows_is_taken_and_what_loops_told_is_not():
    m, added = odometry()
    m.set_growth(2, np.eye(6))
    np.testing.assert_array_equal(acquaint(m, 2).growth, np.eye(6))
    assert np.isnan(acquaint(m, 3, told=False).growth).all()
    np.testing.assert_allclose(acquaint(m, 3).growth, added[2], atol=1e-9)
