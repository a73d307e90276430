"""Frames hang from keyframes, and so does how sure they are."""

import numpy as np
import pytest

from odomap.geometry.lie import se3_adjoint, se3_exp, se3_inverse, se3_log
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.maps.states import stretched
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


def stretch(map, units):
    """Have keyframe 1 count in other units, as a loop that corrects the scale does."""
    snapshot = map.snapshot([1], [0], landmarks=False)
    scales = np.where(snapshot.keyframe_ids == 1, units, snapshot.scales)
    map.apply(snapshot.solved(snapshot.Ts_world_body, np.zeros((0, 3)), scales=scales))


@pytest.mark.parametrize("units", [1.0, 0.4, 3.0])
def test_a_frame_is_hung_where_it_is_and_as_sure_as_it_is_in_whatever_units(map, units):
    path, straight = Path(map), Path(map)
    T, own = pose(7), covariance(7)
    _, expected = straight.append(straight.hang(150, 1, T, own))
    sure = map.covariance(1)
    stretch(map, units)
    map.set_covariance([1], sure)
    frame = path.hang(150, 1, T, own)
    found, covariances = path.append(frame)
    np.testing.assert_allclose(found, T, atol=1e-12)
    np.testing.assert_allclose(covariances, expected, rtol=1e-9, atol=1e-15)
    away = np.linalg.norm(T[:3, 3] - map.T_world_body(1)[:3, 3])
    assert units * np.linalg.norm(frame.T_keyframe_body[:3, 3]) == pytest.approx(away)


def test_a_frame_is_stretched_with_its_keyframe_and_so_is_how_unsure_it_is(map):
    path = Path(map)
    T, before = path.append(path.hang(150, 1, pose(7), covariance(7)))
    stretch(map, 2.0)
    step = path.last_pose()[:3, 3] - map.T_world_body(1)[:3, 3]
    np.testing.assert_allclose(step, 2.0 * (T[:3, 3] - map.T_world_body(1)[:3, 3]))
    np.testing.assert_allclose(path.last_covariance(), stretched(before, 2.0), rtol=1e-9)


def test_how_fast_a_body_has_moved_is_told_in_the_units_of_now(map):
    path = Path(map)
    for n in range(4):
        T = map.T_world_body(1) @ se3_exp(np.array([0.01 * n, 0, 0, 0, 0, 0]))
        path.append(path.hang(150 + n, 1, T, 1e-10 * np.eye(6)))
    further = path.last_pose() @ se3_exp(np.array([0.05, 0, 0, 0, 0, 0]))
    assert path.is_leap(path.last_pose(), further, 1e-10 * np.eye(6))
    stretch(map, 2.0)
    further = path.last_pose() @ se3_exp(np.array([0.05, 0, 0, 0, 0, 0]))
    assert not path.is_leap(path.last_pose(), further, 1e-10 * np.eye(6))
    # A keyframe that is new has the units of the world, and the body is no faster for that.
    m = map
    m.add_keyframe(Keyframe(m.new_keyframe_id(), 153), path.last_pose(), parent=1)
    path.replace_last(Placed(153, 3, np.eye(4), np.zeros((6, 6))))
    assert not path.is_leap(path.last_pose(), further, 1e-10 * np.eye(6))
    further = path.last_pose() @ se3_exp(np.array([0.07, 0, 0, 0, 0, 0]))
    assert path.is_leap(path.last_pose(), further, 1e-10 * np.eye(6))


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


def test_the_path_of_all_frames_is_that_of_each(map):
    """Also of frames that hang from a keyframe with units of its own, or one that was culled."""
    map.add_keyframe(Keyframe(3, 300), pose(3), covariance=covariance(3), scale=1.7)
    path = Path(map)
    for n in range(12):
        path.append(Placed(1000 + n, n % 4, pose(20 + n), covariance(20 + n)))
    map.cull_keyframes([1])
    found = path.trajectory()
    for n in range(12):
        frame = path[n]
        placed = map.place(frame.keyframe_id, frame.T_keyframe_body)
        np.testing.assert_allclose(found.Ts_world_body[n], placed, atol=1e-12)
        np.testing.assert_allclose(found.covariances[n], path.covariance(frame), rtol=1e-9)


def test_the_last_pose_is_as_known_now_whatever_became_of_it(map):
    path = Path(map)
    np.testing.assert_array_equal(path.last_pose(), np.eye(4))
    path.append(Placed(150, 1, pose(7), covariance(7)))
    path.last_pose()[:] = 0.0  # the caller's own
    np.testing.assert_allclose(path.last_pose(), pose(1) @ pose(7), atol=1e-12)
    path.replace_last(Placed(150, 2, pose(8), covariance(8)))
    np.testing.assert_allclose(path.last_pose(), pose(2) @ pose(8), atol=1e-12)
    path.append_late(Placed(160, 0, pose(9), covariance(9)))
    np.testing.assert_allclose(path.last_pose(), pose(0) @ pose(9), atol=1e-12)
