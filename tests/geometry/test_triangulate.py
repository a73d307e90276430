import numpy as np
import pytest
from scipy.optimize import least_squares

from odomap.errors import InputError
from odomap.geometry.lie import se3_exp, se3_inverse
from odomap.geometry.triangulate import parallax, triangulate

POSES = se3_exp(
    [[0, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0.1, 0], [0, 1, 0, 0.1, 0, 0.3], [-1, 0, 0.5, 0, 0, 0]]
)


def seen(points, poses=POSES):
    local = np.einsum("vij,nj->vni", se3_inverse(poses)[:, :3], np.c_[points, np.ones(len(points))])
    return local[..., :2] / local[..., 2:]


def cloud(n=200, seed=1):
    return np.random.default_rng(seed).uniform([-3, -2, 4], [3, 2, 40], (n, 3))


@pytest.mark.parametrize("views", [2, 3, 4])
def test_exact_observations_give_exact_points(views):
    points = cloud()
    found = triangulate(POSES[:views], seen(points)[:views])
    np.testing.assert_allclose(found.points_world, points, rtol=0, atol=1e-9)
    assert found.ahead.all()
    assert found.errors.max() < 1e-12


def test_noisy_points_minimise_the_reprojection_error():
    points = cloud(15)
    x = seen(points) + np.random.default_rng(2).normal(size=(4, 15, 2)) / 450.0
    found = triangulate(POSES, x, iterations=15)
    for i in range(15):
        best = least_squares(
            lambda p, i=i: (seen(p[None]) - x[:, i : i + 1]).ravel(), points[i], xtol=1e-14
        )
        rms = np.sqrt(2 * best.cost / 4)
        assert found.errors[i] == pytest.approx(rms, rel=1e-5)


def test_views_that_did_not_see_a_point_do_not_count():
    points = cloud(30)
    x = seen(points)
    x[1, :10] = np.nan
    x[1:, 20:] = np.nan
    found = triangulate(POSES, x)
    np.testing.assert_allclose(found.points_world[:20], points[:20], atol=1e-8)
    assert np.isnan(found.points_world[20:]).all()
    assert not found.ahead[20:].any()
    assert np.all(found.parallax[20:] == 0)
    np.testing.assert_allclose(found.parallax[:10], parallax(POSES[[0, 2, 3], :3, 3], points[:10]))


def test_parallax_is_the_widest_angle():
    centres = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    angles = parallax(centres, [[0.5, 0.0, 0.5], [0.5, 0.0, 5e5], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(angles, [np.pi / 2, 2e-6, np.pi / 4], rtol=1e-9)
    assert parallax([*centres, [2.0, 0.0, 0.0]], [[1.0, 0.0, 1.0]])[0] == pytest.approx(np.pi / 2)


def test_points_behind_or_without_parallax_are_said():
    x = np.array([[[0.0, 0.0], [0.1, 0.1]], [[0.5, 0.0], [0.1, 0.1]]])
    poses = se3_exp([[0, 0, 0, 0, 0, 0], [1.0, 0, 0, 0, 0, 0]])
    found = triangulate(poses, x)
    assert not found.ahead[0]
    np.testing.assert_allclose(found.points_world[0], [0, 0, -2], atol=1e-9)
    assert np.isinf(found.errors[0])
    np.testing.assert_allclose(found.parallax, [np.arctan(0.5), 0.0], atol=1e-12)
    assert np.isnan(found.points_world[1]).all()
    assert not found.ahead[1]
    same_place = triangulate(np.stack([poses[0], poses[0]]), x)
    assert not same_place.ahead[1]


@pytest.mark.parametrize(
    ("poses", "x"),
    [
        (POSES[:1], np.zeros((1, 5, 2))),
        (POSES, np.zeros((3, 5, 2))),
        (POSES, np.zeros((4, 5, 3))),
        (np.eye(4), np.zeros((4, 5, 2))),
    ],
)
def test_wrong_input_is_named(poses, x):
    with pytest.raises(InputError, match="normalised"):
        triangulate(poses, x)
