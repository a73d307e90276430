"""Growth: what odometry said of a step, through culling, other units, merging and a file."""

import numpy as np
import pytest

from odomap.files.mapfile import load_map, save_map
from odomap.geometry.lie import se3_adjoint, se3_exp, se3_inverse
from odomap.maps.growth import growth_of
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.maps.states import stretched

UNITS = [np.full(5, 1.0), np.array([1.0, 0.9, 1.3, 2.0, 0.5])]


def odometry(units, parents=(-1, 0, 1, 2, 3), seed=0):
    """Return a map whose keyframes have units of their own, and the noise of each step."""
    rng, m, added = np.random.default_rng(seed), Map(), {}
    for k, p in enumerate(parents):
        if p < 0:
            m.add_keyframe(Keyframe(k, k), np.eye(4), covariance=np.eye(6), scale=units[k])
            continue
        step, A = se3_exp(rng.normal(size=6)), rng.normal(size=(6, 6))
        added[k] = A @ A.T
        Ad = se3_adjoint(se3_inverse(step))
        sure = Ad @ m.covariance(p) @ Ad.T + stretched(added[k], units[k])
        T = m.T_world_body(p) @ step
        m.add_keyframe(Keyframe(k, k), T, covariance=sure, scale=units[k], parent=p)
        m.set_growth(k, told(m, k))
    return m, added


def told(m, k):
    """Return what covariances say of a keyframe and its parent."""
    p = m.parent(k)
    S = [(m.T_world_body(n), np.asarray(m.scale(n))) for n in (k, p)]
    return growth_of(m.covariance(k), m.covariance(p), *S)


@pytest.mark.parametrize("units", UNITS)
def test_it_is_what_a_step_added_in_the_units_of_the_keyframe(units):
    m, added = odometry(units)
    assert np.isnan(m.growth(0)).all()
    for k in range(1, 5):
        np.testing.assert_allclose(m.growth(k), added[k], atol=1e-8)


@pytest.mark.parametrize("gone", [1, 3])
@pytest.mark.parametrize("units", UNITS)
def test_what_hung_from_one_that_goes_is_less_sure_by_both_steps(gone, units):
    m, added = odometry(units)
    m.cull_keyframes([gone])
    assert np.isnan(m.growth(gone)).all()
    for k in m.keyframe_ids.tolist()[1:]:
        np.testing.assert_allclose(m.growth(k), told(m, k), atol=1e-8)
        assert k == gone + 1 or np.allclose(m.growth(k), added[k])


def test_of_a_root_that_goes_the_eldest_child_is_the_root_and_the_others_hang_from_that():
    m, added = odometry(np.array([1.0, 2.0, 0.5]), (-1, 0, 0))
    T = se3_inverse(m.T_world_body(2)) @ m.T_world_body(1)
    m.cull_keyframes([0])
    assert (m.parent(1), m.parent(2)) == (-1, 1)
    assert np.isnan(m.growth(1)).all()
    Ad = se3_adjoint(T)
    both = stretched(added[2], 0.5) + Ad @ stretched(added[1], 2.0) @ Ad.T
    np.testing.assert_allclose(stretched(m.growth(2), 0.5), both, atol=1e-8)


def test_other_units_and_other_covariances_of_the_world_change_nothing():
    m, added = odometry(np.ones(5))
    snapshot = m.snapshot([1, 2, 3, 4], [0], landmarks=False)
    Ts = snapshot.Ts_world_body.copy()
    Ts[:, :3, 3] *= 3.0
    m.apply(snapshot.solved(Ts, np.zeros((0, 3)), scales=np.full(5, 3.0)))
    m.set_covariance([1, 2, 3, 4], 1e-6 * np.eye(6))
    for k in range(1, 5):
        np.testing.assert_allclose(m.growth(k), added[k], atol=1e-8)


def test_another_map_brings_its_own():
    first, second = odometry(np.ones(5))[0], odometry(np.ones(5), seed=1)[0]
    second.cull_keyframes([2])
    whole = Map.restored(first.dump())
    absorbed = whole.absorb(second)
    for k in range(5):
        np.testing.assert_array_equal(whole.growth(k), first.growth(k))
        np.testing.assert_array_equal(whole.growth(absorbed.offset + k), second.growth(k))


def test_a_file_keeps_it(tmp_path):
    m, _ = odometry(UNITS[1])
    m.cull_keyframes([2])
    save_map(tmp_path / "a.odomap", m)
    loaded = load_map(tmp_path / "a.odomap")
    for k in range(5):
        np.testing.assert_array_equal(loaded.growth(k), m.growth(k))
