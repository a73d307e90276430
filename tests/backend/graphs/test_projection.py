"""The nearest rotations against singular values."""

import numpy as np
import pytest

from odomap.backend.graphs.projection import nearest_rotations
from odomap.geometry.lie import orthonormalize, so3_exp


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("scale", [1e-150, 1.0, 1e150])
def test_they_are_the_nearest_also_of_mirrored_matrices(d, scale):
    M = np.random.default_rng(d).normal(size=(500, d, d))
    assert (np.linalg.det(M) < 0).any()
    R = nearest_rotations(scale * M)
    np.testing.assert_allclose(R, orthonormalize(M), atol=1e-11)
    np.testing.assert_allclose(
        np.swapaxes(R, 1, 2) @ R, np.tile(np.eye(d), (500, 1, 1)), atol=4e-15
    )
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-14)


def test_rotations_stay():
    R = so3_exp(np.random.default_rng(0).normal(scale=2.0, size=(200, 3)))
    R[:3] = np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, -1.0, 1.0]), np.eye(3)
    np.testing.assert_allclose(nearest_rotations(R), R, atol=3e-15)


@pytest.mark.parametrize("d", [2, 3])
def test_what_has_no_nearest_one_gets_some_rotation(d):
    M = np.zeros((3, d, d))
    M[1, 0, 0] = 1.0  # of rank one
    M[2] = -np.eye(d)  # every half turn is as near in space
    R = nearest_rotations(M)
    np.testing.assert_array_equal(R[0], np.eye(d))
    np.testing.assert_allclose(np.swapaxes(R, 1, 2) @ R, np.tile(np.eye(d), (3, 1, 1)), atol=4e-15)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-14)
    assert np.einsum("nij,nij->n", R, M)[1] == pytest.approx(1.0)
