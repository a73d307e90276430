"""Frames hang from keyframes, and so does how sure they are."""

import numpy as np
import pytest

from odomap.geometry.lie import se3_adjoint, se3_exp, se3_inverse, se3_log
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.system.path import Path, Placed


def pose(seed, size=1.0):
    return se3_exp(np.random.default_rng(seed).normal(0, size, 6))


def covariance(seed, size=0.01):
    A = np.random.default_rng(seed).normal(0, size, (6, 6))
    return A @ A.T


@pytest.fixture
def map():
    m = Map()
    for k in range(3):
        m.add_keyframe(Keyframe(m.new_keyframe_id(), 100 * k), pose(k), covariance=covariance(k))
    return m


def test_a_frame_is_where_its_keyframe_is(map):
    path = Path(map)
    frame = Placed(150, 1, pose(7), covariance(7))
    T, _ = path.append(frame)
    np.testing.assert_allclose(T, pose(1) @ pose(7), atol=1e-12)
    np.testing.assert_allclose(path.last_pose(), T)
    assert path.last is frame
    assert len(path) == 1


def test_frames_follow_a_keyframe_that_is_corrected_but_live_ones_stay(map):
    path = Path(map)
    before, _ = path.append(Placed(150, 1, pose(7), covariance(7)))
    snapshot = map.snapshot([1], [0])
    Ts = snapshot.Ts_world_body.copy()
    Ts[0] = Ts[0] @ pose(9, 0.1)
    map.apply(snapshot.solved(Ts, snapshot.points_world))
    now = path.trajectory().Ts_world_body[0]
    np.testing.assert_allclose(now, pose(1) @ pose(9, 0.1) @ pose(7), atol=1e-9)
    np.testing.assert_array_equal(path.trajectory_live().Ts_world_body[0], before)
    np.testing.assert_allclose(path.last_pose(), now)


@pytest.mark.parametrize(("moved", "is_leap"), [(0.002, False), (0.2, True)])
def test_a_correction_that_makes_the_last_pose_leap_is_told(map, moved, is_leap):
    """The body has moved a centimetre per frame so far, and is known to a millimetre."""
    path = Path(map)
    for n in range(4):
        T = se3_exp(np.array([0.01 * n, 0, 0, 0, 0, 0]))
        path.append(Placed(150 + n, 1, T, 1e-6 * np.eye(6)))
    assert path.correction() == ""
    snapshot = map.snapshot([1], [0])
    Ts = snapshot.Ts_world_body.copy()
    Ts[0] = Ts[0] @ se3_exp(np.array([0, moved, 0, 0, 0, 0]))
    map.apply(snapshot.solved(Ts, snapshot.points_world))
    said = path.correction()
    assert said == (f"the map was corrected: the last pose moved by {moved:g}" if is_leap else "")


def test_the_covariance_is_that_of_the_keyframe_carried_over_and_the_frames_own(map):
    path = Path(map)
    frame = Placed(150, 2, pose(7), covariance(7))
    _, found = path.append(frame)
    Ad = se3_adjoint(se3_inverse(pose(7)))
    np.testing.assert_allclose(found, Ad @ covariance(2) @ Ad.T + covariance(7), rtol=1e-9)
    np.testing.assert_allclose(path.last_covariance(), found)
    np.testing.assert_allclose(path.trajectory().covariances[0], found)


def test_the_covariance_is_that_of_samples(map):
    """Keyframe and frame are drawn, composed, and compared with what is claimed: to 3 %."""
    rng = np.random.default_rng(0)
    noise = rng.multivariate_normal(np.zeros(6), covariance(2, 0.003), 40000)
    own = rng.multivariate_normal(np.zeros(6), covariance(7, 0.003), 40000)
    truth = pose(2) @ pose(7)
    drawn = pose(2) @ se3_exp(noise) @ pose(7) @ se3_exp(own)
    sampled = np.cov(se3_log(se3_inverse(truth) @ drawn).T)
    map.set_covariance([2], covariance(2, 0.003))
    claimed = Path(map).covariance(Placed(150, 2, pose(7), covariance(7, 0.003)))
    scale = np.sqrt(np.outer(np.diag(claimed), np.diag(claimed)))
    assert np.abs((sampled - claimed) / scale).max() < 0.03


def test_velocity_is_the_twist_per_second(map):
    path = Path(map)
    assert not path.velocity().any()
    np.testing.assert_array_equal(path.last_pose(), np.eye(4))
    assert not path.last_covariance().any()
    path.append(Placed(0, 0, np.eye(4), np.zeros((6, 6))))
    assert not path.velocity().any()
    twist = np.array([0.5, -0.2, 0.1, 0.02, 0.3, -0.1])
    path.append(Placed(50_000_000, 0, se3_exp(0.05 * twist), np.zeros((6, 6))))
    np.testing.assert_allclose(path.velocity(), twist, atol=1e-9)
    # Over a gap nobody knows how it moved.
    path.append(Placed(2_000_000_000, 0, se3_exp(twist), np.zeros((6, 6))))
    assert not path.velocity().any()


def test_an_empty_path_is_a_trajectory_too():
    path = Path(Map())
    assert len(path.trajectory()) == len(path.trajectory_live()) == len(path) == 0
