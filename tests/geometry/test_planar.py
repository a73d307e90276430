"""Motion in the plane: the same as that of poses in space."""

import numpy as np
import pytest

from odomap.geometry.lie import se2_exp, se2_inverse, se2_log
from odomap.geometry.planar import (
    between_planar,
    compose_planar,
    from_plane,
    lift_covariance,
    lift_information,
    moved_covariance,
    planar_matrix,
    to_plane,
    transform_planar,
)


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def test_to_space_and_back(rng):
    x = rng.uniform(-3, 3, (20, 3))
    np.testing.assert_allclose(to_plane(from_plane(x)), x, atol=1e-12)
    T = from_plane(x)
    np.testing.assert_allclose(T[:, 2], np.tile([0, 0, 1, 0], (20, 1)))


def test_one_pose_is_as_one_of_many(rng):
    x = rng.uniform(-3, 3, (20, 3))
    np.testing.assert_allclose([from_plane(each) for each in x], from_plane(x), atol=1e-15)
    np.testing.assert_allclose([to_plane(T) for T in from_plane(x)], x, atol=1e-15)


def test_composing_is_multiplying(rng):
    for _ in range(20):
        a, b = rng.uniform(-3, 3, (2, 3))
        both = compose_planar(a, b)
        np.testing.assert_allclose(from_plane(both), from_plane(a) @ from_plane(b), atol=1e-12)
        np.testing.assert_allclose(between_planar(a, both)[:2], b[:2], atol=1e-12)
        assert between_planar(a, both)[2] == pytest.approx(b[2])
        p = rng.normal(size=(5, 2))
        wanted = (planar_matrix(a) @ np.column_stack([p, np.ones(5)]).T).T[:, :2]
        np.testing.assert_allclose(transform_planar(a, p), wanted, atol=1e-12)


def test_covariance_is_carried_along_a_motion(rng):
    A = rng.normal(size=(3, 3))
    sure, motion = 1e-6 * A @ A.T, np.array([1.0, -2.0, 0.7])
    start, noise = np.array([0.3, 0.1, -0.4]), rng.multivariate_normal(np.zeros(3), sure, 20000)
    there = planar_matrix(start) @ se2_exp(noise) @ planar_matrix(motion)
    meant = planar_matrix(start) @ planar_matrix(motion)
    errors = se2_log(se2_inverse(meant) @ there)
    np.testing.assert_allclose(
        np.cov(errors.T), moved_covariance(sure, motion), rtol=0.1, atol=3e-7
    )


def test_what_is_lifted_is_the_inverse_of_what_is_lifted(rng):
    A = rng.normal(size=(3, 3))
    sure = A @ A.T + np.eye(3)
    lifted = lift_covariance(sure)
    np.testing.assert_allclose(
        np.linalg.inv(lifted), lift_information(np.linalg.inv(sure)), rtol=1e-8
    )
    np.testing.assert_allclose(lifted[np.ix_([0, 1, 5], [0, 1, 5])], sure)
