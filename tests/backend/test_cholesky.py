"""The compiled factorisation against LAPACK's."""

import numpy as np
import pytest

from odomap.backend.cholesky import factor, invert, solve


def definite(n, seed, condition=1e6):
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    return Q * np.geomspace(1.0, condition, n) @ Q.T


@pytest.mark.parametrize("n", [1, 2, 6, 30, 61])
def test_factor_solve_and_invert(n):
    A = definite(n, n)
    L = A.copy()
    L[np.triu_indices(n, 1)] = np.nan  # only the lower triangle may be read
    assert factor(L)
    np.testing.assert_allclose(np.tril(L), np.linalg.cholesky(A), rtol=1e-9, atol=1e-9)
    b = np.random.default_rng(n + 1).normal(size=n)
    x = b.copy()
    solve(L, x)
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-7, atol=1e-9)
    inverse = np.full((n, n), np.nan)
    invert(L, inverse)
    np.testing.assert_allclose(inverse, np.linalg.inv(A), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize(
    "A",
    [
        -np.eye(3),
        np.zeros((4, 4)),
        np.diag([1.0, 0.0, 1.0]),
        np.ones((3, 3)),
        np.diag([1.0, 2.0, -1e-3]),
        np.diag([1.0, np.nan, 1.0]),
        np.diag([np.inf, 1.0]),
        np.array([[1.0, 2.0], [2.0, 1.0]]),
    ],
)
def test_what_is_not_positive_definite_is_refused(A):
    assert not factor(A.copy())


def test_a_gauge_that_is_free_up_to_rounding_is_refused():
    """J^T J of 40 rows that cannot see one direction: singular, though rounding may hide it."""
    rng = np.random.default_rng(3)
    refused = 0
    for _ in range(50):
        J = rng.normal(size=(40, 12)) * np.geomspace(1, 1e3, 12)
        blind = rng.normal(size=12)
        J -= np.outer(J @ blind, blind) / (blind @ blind)
        refused += not factor(J.T @ J)
    assert refused == 50


def test_nothing_is_positive_definite():
    assert factor(np.empty((0, 0)))
