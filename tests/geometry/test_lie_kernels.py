import numpy as np
import pytest

from odomap.geometry import lie
from odomap.geometry import lie_kernels as kernels

ANGLES = [0.0, 1e-12, 1e-8, 1e-4, 0.2, 0.499, 0.501, 1.5, 3.0, np.pi - 1e-8]


@pytest.mark.parametrize("angle", ANGLES)
def test_kernels_are_their_numpy_twins(angle):
    rng = np.random.default_rng(int(1e6 * angle) % 1000)
    for _ in range(10):
        axis = rng.normal(size=3)
        xi = np.concatenate([rng.normal(size=3), angle * axis / np.linalg.norm(axis)])
        T, R, t, back = lie.se3_exp(xi), np.empty((3, 3)), np.empty(3), np.empty(6)
        kernels.se3_exp_into(xi, R, t)
        np.testing.assert_allclose(R, T[:3, :3], rtol=0, atol=1e-14)
        np.testing.assert_allclose(t, T[:3, 3], rtol=0, atol=1e-14)
        kernels.se3_log_into(R, t, back)
        np.testing.assert_allclose(back, xi, rtol=0, atol=1e-13)
        J, phi = np.empty((3, 3)), xi[3:].copy()
        kernels.so3_exp_into(phi, J)
        np.testing.assert_allclose(J, T[:3, :3], rtol=0, atol=1e-14)
        kernels.so3_right_jacobian_into(phi, J)
        np.testing.assert_allclose(J, lie.so3_right_jacobian(phi), rtol=0, atol=1e-14)
        kernels.so3_left_jacobian_inverse_into(phi, J)
        np.testing.assert_allclose(J, lie.so3_left_jacobian_inverse(phi), rtol=0, atol=1e-13)


def test_log_takes_every_branch():
    rng = np.random.default_rng(1)
    phi, got = rng.normal(size=(300, 3)), np.empty(3)
    phi[:3] = np.pi * np.eye(3)
    for R in lie.so3_exp(phi):
        kernels.so3_log_into(R, got)
        np.testing.assert_allclose(lie.so3_exp(got), R, rtol=0, atol=1e-14)


def test_compose_and_inverse():
    A, B = lie.se3_exp(np.random.default_rng(2).normal(size=(2, 6)))
    R, t = np.empty((3, 3)), np.empty(3)
    a, b = (A[:3, :3].copy(), A[:3, 3].copy()), (B[:3, :3].copy(), B[:3, 3].copy())
    kernels.se3_compose_into(*a, *b, R, t)
    np.testing.assert_allclose(R, (A @ B)[:3, :3], atol=1e-15)
    np.testing.assert_allclose(t, (A @ B)[:3, 3], atol=1e-15)
    kernels.se3_inverse_into(*a, R, t)
    np.testing.assert_allclose(t, lie.se3_inverse(A)[:3, 3], atol=1e-15)
    np.testing.assert_allclose(R, lie.se3_inverse(A)[:3, :3], atol=1e-15)


def test_retract_in_place_does_not_drift():
    rng = np.random.default_rng(3)
    R, t, T = np.eye(3), np.zeros(3), np.eye(4)
    steps = 0.1 * rng.normal(size=(20000, 6))
    for xi, motion in zip(steps, lie.se3_exp(steps), strict=True):
        kernels.se3_retract(R, t, xi, R, t)
        T = T @ motion
    np.testing.assert_allclose(R, T[:3, :3], atol=1e-11)
    np.testing.assert_allclose(t, T[:3, 3], atol=1e-10)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=2e-15)


def test_retract_is_multiplication():
    rng = np.random.default_rng(4)
    for xi in rng.normal(size=(20, 6)):
        T = lie.se3_exp(rng.normal(size=6))
        R, t = np.empty((3, 3)), np.empty(3)
        kernels.se3_retract(T[:3, :3].copy(), T[:3, 3].copy(), xi, R, t)
        expected = T @ lie.se3_exp(xi)
        np.testing.assert_allclose(R, expected[:3, :3], atol=1e-14)
        np.testing.assert_allclose(t, expected[:3, 3], atol=1e-14)


def test_orthonormalize_squares_the_drift():
    R = lie.so3_exp([0.3, -0.2, 0.5]) + 1e-5 * np.random.default_rng(5).normal(size=(3, 3))
    out = np.empty((3, 3))
    kernels.so3_orthonormalize_into(R, out)
    assert np.abs(out.T @ out - np.eye(3)).max() < 1e-9
