"""Largest eigenvalues against dense ones."""

import numpy as np
import pytest

from odomap.backend.sparse.lanczos import largest_eigenvalue


@pytest.mark.parametrize("n", [1, 2, 5, 40, 200])
def test_it_is_the_largest(n):
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n, n))
    A = A + A.T
    value = largest_eigenvalue(lambda x: A @ x, n, tolerance=1e-9, max_steps=300)
    assert value == pytest.approx(np.linalg.eigvalsh(A)[-1], rel=1e-8)


def test_multiple_and_negative_eigenvalues():
    values = np.concatenate([np.full(3, -1.0), np.linspace(-9.0, -2.0, 50)])
    found = largest_eigenvalue(lambda x: values * x, len(values))
    assert found == pytest.approx(-1.0, rel=1e-8)


def test_zeros_and_few_steps_are_no_failure():
    assert largest_eigenvalue(lambda x: 0.0 * x, 7) == 0.0
    values = np.linspace(0.0, 1.0, 1000)
    few = largest_eigenvalue(lambda x: values * x, 1000, max_steps=3)
    assert 0.5 < few < 1.0


def test_the_same_twice():
    values = np.random.default_rng(0).normal(size=300)
    one, two = (largest_eigenvalue(lambda x: values * x, 300) for _ in range(2))
    assert one == two


def test_what_multiplies_may_return_what_it_was_given():
    assert largest_eigenvalue(lambda x: x, 6) == pytest.approx(1.0, rel=1e-14)
