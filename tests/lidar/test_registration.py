"""Registration finds known motions, whatever the method, and says what it does not know."""

import numpy as np
import pytest

import odomap
from lidarworlds import CORRIDOR, CORRIDOR_2D, PLANE, ROOM, ROOM_2D, Sphere
from odomap.errors import ConfigError, InputError
from odomap.geometry.lie import se2_exp, se2_log, se3_exp, se3_inverse, se3_log
from odomap.lidar.methods import METHODS, RegistrationConfig
from odomap.lidar.target import Target

TRUTH = se3_exp(np.array([0.2, -0.1, 0.05, 0.03, -0.02, 0.08]))


def moved(points, T):
    """Return points (N, d) as a sensor at T sees them."""
    d = points.shape[1]
    return (points - T[:d, d]) @ T[:d, :d]


@pytest.fixture(scope="module")
def pair():
    rng = np.random.default_rng(0)
    return moved(ROOM.seen(rng), TRUTH), ROOM.seen(rng)


def off(found, truth=TRUTH):
    xi = se3_log(se3_inverse(truth) @ found.T_target_source)
    return np.linalg.norm(xi[:3]), np.degrees(np.linalg.norm(xi[3:]))


@pytest.mark.parametrize("method", METHODS)
def test_a_known_motion_is_found(pair, method):
    # Points of coarse voxels catch on each other, where they may not slide along a surface.
    found = odomap.register(*pair, method, voxel=0.1 if method == "icp" else None)
    metres, degrees = off(found)
    assert found.converged
    assert not found.reason
    assert metres < (0.003 if method in ("plane", "gicp") else 0.01)
    assert degrees < (0.05 if method in ("plane", "gicp") else 0.1)
    assert found.num_inliers > 0.95 * found.num_points
    assert found.information.shape == (6, 6)
    assert 0.005 < found.error < 0.02


@pytest.mark.parametrize("method", METHODS)
def test_a_known_motion_in_the_plane_is_found(method):
    rng = np.random.default_rng(1)
    truth = se2_exp(np.array([0.1, 0.05, 0.05]))
    source, target = moved(ROOM_2D.seen(rng), truth), ROOM_2D.seen(rng)
    found = odomap.register(source, target, method, voxel=0.1, max_distance=0.6)
    xi = se2_log(np.linalg.inv(truth) @ found.se2)
    assert found.converged
    assert np.linalg.norm(xi[:2]) < (0.002 if method in ("plane", "gicp") else 0.03)
    assert abs(xi[2]) < 0.005
    assert found.information.shape == (3, 3)
    np.testing.assert_array_equal(found.T_target_source[2], [0, 0, 1, 0])
    again = odomap.register(source, target, method, initial=odomap.SE2(truth))
    assert again.converged


def test_moving_both_clouds_moves_the_answer(pair):
    source, target = pair
    A, B = (se3_exp(np.array(v)) for v in ([3, -2, 9, 0, 0, 0.0], [-40, 7, 1, 0, 0, 0.0]))
    plain = odomap.register(source, target)
    found = odomap.register(
        source + A[:3, 3], target + B[:3, 3], initial=B @ np.eye(4) @ se3_inverse(A)
    )
    expected = B @ plain.T_target_source @ se3_inverse(A)
    np.testing.assert_allclose(found.T_target_source, expected, atol=1e-6)
    # The covariance is of the source's frame: it moves by the adjoint of A.
    from odomap.geometry.lie import se3_adjoint

    Ad = se3_adjoint(se3_inverse(A))
    np.testing.assert_allclose(found.information, Ad.T @ plain.information @ Ad, rtol=1e-3)


def test_units_do_not_matter(pair):
    source, target = pair
    plain, feet = odomap.register(source, target), odomap.register(3.28 * source, 3.28 * target)
    np.testing.assert_allclose(
        feet.T_target_source[:3, 3] / 3.28, plain.T_target_source[:3, 3], atol=1e-6
    )
    np.testing.assert_allclose(
        feet.T_target_source[:3, :3], plain.T_target_source[:3, :3], atol=1e-6
    )


def test_the_order_of_points_hardly_matters(pair):
    source, target = pair
    rng = np.random.default_rng(2)
    shuffled = odomap.register(rng.permutation(source), rng.permutation(target))
    assert np.abs(shuffled.T_target_source - odomap.register(*pair).T_target_source).max() < 1e-3


def test_the_same_input_gives_the_same_bytes_with_one_thread_or_two(pair):
    one, again = odomap.register(*pair), odomap.register(*pair)
    two = odomap.register(*pair, threads=2)
    robust = [odomap.register(*pair, loss="cauchy", threads=n) for n in (1, 2)]
    assert one.T_target_source.tobytes() == again.T_target_source.tobytes()
    assert one.T_target_source.tobytes() == two.T_target_source.tobytes()
    assert one.information.tobytes() == two.information.tobytes()
    assert robust[0].T_target_source.tobytes() == robust[1].T_target_source.tobytes()


def test_coordinates_of_a_map_projection(pair):
    source, target = pair
    shift = np.array([4.5e5, 5.4e6, 120.0])
    plain = odomap.register(source, target)
    initial = np.eye(4)
    initial[:3, 3] = 0.0
    found = odomap.register(source + shift, target + shift, initial=initial)
    A = np.eye(4)
    A[:3, 3] = shift
    local = se3_inverse(A) @ found.T_target_source @ A
    assert np.abs(local - plain.T_target_source).max() < 1e-5


@pytest.mark.parametrize("loss", ["huber", "cauchy", "geman_mcclure"])
@pytest.mark.parametrize("method", ["plane", "gicp"])
def test_a_robust_loss_forgives_what_is_not_there(method, loss):
    rng = np.random.default_rng(5)
    source, target = ROOM.seen(rng), ROOM.seen(rng)
    box = rng.uniform([3.5, -2, -1], [3.7, 2, 1], (4000, 3))  # stands before a wall, once
    source = np.vstack([source, box])
    plain = odomap.register(source, target, method, max_distance=1.0)
    robust = odomap.register(source, target, method, loss=loss, max_distance=1.0)
    assert off(robust, np.eye(4))[0] < 0.01
    assert off(robust, np.eye(4))[0] < 0.5 * off(plain, np.eye(4))[0]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("world", "weak", "which"),
    [
        (CORRIDOR, 1, "translation along (1.00"),
        (PLANE, 3, "rotation about"),
        (Sphere(), 3, "rotation about"),
        (CORRIDOR_2D, 1, "translation along (1.00"),
        (ROOM, 0, ""),
        (ROOM_2D, 0, ""),
    ],
)
def test_what_clouds_do_not_fix_is_said(world, weak, which, method):
    rng = np.random.default_rng(6)
    found = odomap.register(world.seen(rng), world.seen(rng), method)
    assert len(found.weak_directions) == weak
    assert found.is_degenerate == (weak > 0)
    assert which in found.reason
    values = np.linalg.eigvalsh(found.information)
    assert (np.abs(values[:weak]) < 1e-9 * values[-1]).all()
    assert (values[weak:] > 1e-6 * values[-1]).all()
    if world is CORRIDOR:
        assert np.abs(found.weak_directions[0] @ [1, 0, 0, 0, 0, 0]) > 0.99
        along, across = found.information[0, 0], found.information[1, 1]
        assert along < 0.003 * across


def test_a_target_made_once_serves_many(pair):
    source, target = pair
    ready = Target.of(target, 0.2)
    a, b = odomap.register(source, ready), odomap.register(source, target, voxel=0.2)
    assert a.T_target_source.tobytes() == b.T_target_source.tobytes()
    assert odomap.register(source[::3], ready).converged


def test_points_as_they_are(pair):
    source, target = pair
    found = odomap.register(source[::8], target[::8], voxel=0.0, max_distance=0.8)
    assert off(found)[0] < 0.01
    assert found.num_points == len(source[::8])


def test_too_far_apart_is_said():
    rng = np.random.default_rng(7)
    found = odomap.register(ROOM.seen(rng) + 500.0, ROOM.seen(rng))
    assert not found.converged
    assert "better first guess" in found.reason
    assert found.num_inliers == 0
    assert not found.information.any()


@pytest.mark.parametrize(
    ("source", "says"),
    [
        (np.empty((0, 3)), "source: has 0 points"),
        (np.full((9, 3), np.nan), "9 of NaN"),
        (np.zeros((1, 3)), "has 1 points"),
        (np.tile([1.0, 2.0, 3.0], (50, 1)), "in one place"),
        (np.zeros((50, 4)), "shape"),
        (np.zeros((50, 2)), "of the plane"),
        (None, "shape"),
        ([["a", "b", "c"]], "numbers"),
    ],
)
def test_what_is_no_cloud_is_said(pair, source, says):
    with pytest.raises(InputError, match=says):
        odomap.register(source, pair[1])


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"method": "icpp"}, "did you mean 'icp'"),
        ({"voxel": -1.0}, "voxel"),
        ({"max_distance": 0.0}, "max_distance"),
        ({"loss": "hubert"}, "did you mean 'huber'"),
        ({"threads": 0}, "threads"),
    ],
)
def test_a_setting_that_cannot_be_is_said(pair, settings, says):
    with pytest.raises(ConfigError, match=says):
        odomap.register(*pair, **settings)


def test_a_first_guess_that_cannot_be_is_said(pair):
    with pytest.raises(InputError, match="SE3"):
        odomap.register(*pair, initial=np.eye(3))
    with pytest.raises(InputError, match="leaves the plane"):
        odomap.register(np.eye(9, 2), np.eye(9, 2), initial=TRUTH, voxel=0.0)
    with pytest.raises(InputError, match="in space"):
        _ = odomap.register(*pair).se2


def test_settings_are_checked_where_they_are_made():
    assert RegistrationConfig(voxel=0.0).voxel == 0.0
    with pytest.raises(ConfigError, match="iterations"):
        RegistrationConfig(iterations=0)
