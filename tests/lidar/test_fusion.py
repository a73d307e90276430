"""What is known of a pose twice."""

import numpy as np
import pytest

from odomap.lidar.fusion import fused


def drawn(seed, rank=3, size=1.0):
    A = np.random.default_rng(seed).normal(0, size, (3, rank))
    return A @ A.T


@pytest.mark.parametrize("seed", range(20))
def test_information_adds_up(seed):
    P, information = drawn(seed, size=0.1), drawn(seed + 100, size=30.0)
    both = fused(P, information)
    np.testing.assert_allclose(both, np.linalg.inv(np.linalg.inv(P) + information), rtol=1e-8)
    np.testing.assert_array_equal(both, both.T)


def test_what_says_nothing_changes_nothing_and_what_is_sure_stays_sure():
    P = drawn(1)
    np.testing.assert_allclose(fused(P, np.zeros((3, 3))), P, rtol=1e-12)
    np.testing.assert_array_equal(fused(np.zeros((3, 3)), drawn(2)), np.zeros((3, 3)))


@pytest.mark.parametrize("seed", range(5))
def test_along_a_corridor_only_the_prediction_counts(seed):
    """A scan that says nothing along x leaves that as it was, however sure it is of the rest."""
    information = np.diag([0.0, 1e6, 1e8])
    P = np.diag([0.04, 0.01, 0.001])
    both = fused(P, information)
    assert both[0, 0] == pytest.approx(0.04)
    assert both[1, 1] == pytest.approx(1e-6, rel=1e-3)
    mixed = fused(P + 1e-4 * drawn(seed), information)
    assert mixed[0, 0] <= 0.04 + 1e-4 * drawn(seed)[0, 0] + 1e-12


def test_pivots_may_vanish():
    """(I + P Λ) has a zero in its corner here, though it is regular."""
    P = np.array([[2.0, -1.5, 0.0], [-1.5, 2.0, 0.0], [0.0, 0.0, 1.0]])
    information = np.array([[1.0, 2.0, 0.0], [2.0, 5.0, 0.0], [0.0, 0.0, 1.0]])
    assert (np.eye(3) + P @ information)[0, 0] == 0.0
    want = np.linalg.solve(np.eye(3) + P @ information, P)
    np.testing.assert_allclose(fused(P, information), want, atol=1e-12)
