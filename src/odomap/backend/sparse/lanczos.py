"""The largest eigenvalue of a symmetric matrix that is only ever multiplied with.

From a start vector q_1 Lanczos' method builds an orthonormal basis of the Krylov space q_1, A q_1,
A² q_1, … in which A is tridiagonal,

    A q_k = β_{k−1} q_{k−1} + α_k q_k + β_k q_{k+1},

and the outer eigenvalues of that small matrix T go to those of A fast, the better they stand apart.
An eigenpair (θ, s) of T is one of A up to |A Q s − θ Q s| = β_k |s_k|, which says when to stop. All
basis vectors are kept and every new one is made orthogonal to them twice, since rounding otherwise
lets copies of eigenvalues found earlier come back.

For the eigenvalue of a matrix nearest to a number σ apply it to (A − σI)⁻¹, where that eigenvalue
is the largest and stands apart. Cost: k products and O(k² n).

Reference: B. N. Parlett, "The Symmetric Eigenvalue Problem", SIAM, 1998, chapter 13.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["largest_eigenvalue", "largest_ritz_value", "warm_up"]

Array = NDArray[np.float64]


def largest_eigenvalue(
    multiply: Callable[[Array], Array],
    size: int,
    tolerance: float = 1e-8,
    max_steps: int = 100,
    seed: int = 0,
) -> float:
    """Return the (algebraically) largest eigenvalue of a symmetric matrix.

    Args:
        multiply: x (n,) to A x (n,).
        size: n, at least 1.
        tolerance: relative error at which to stop.
        max_steps: products to spend at most; what is known then is returned, from below.
        seed: of the start vector.

    Example:
        >>> round(largest_eigenvalue(lambda x: np.array([1.0, 2.0, 7.0]) * x, 3), 9)
        7.0
    """
    return largest_ritz_value(multiply, size, tolerance, max_steps, seed)[0]


def largest_ritz_value(
    multiply: Callable[[Array], Array],
    size: int,
    tolerance: float = 1e-8,
    max_steps: int = 100,
    seed: int = 0,
) -> tuple[float, float]:
    """Return what `largest_eigenvalue` does, and how far at most an eigenvalue is from it.

    The second is above tolerance times the first only if `max_steps` were not enough.
    """
    steps = min(max_steps, size)
    basis = np.zeros((steps, size))
    alpha, beta = np.zeros(steps), np.zeros(steps)
    y = np.random.default_rng(seed).standard_normal(size)
    length = float(np.sqrt(np.sum(y * y)))
    value = error = 0.0
    for k in range(steps):
        _append(basis, k, y, length)
        y = np.array(multiply(basis[k]))  # a copy: it is written to
        alpha[k] = _orthogonalize(basis, k + 1, y)
        beta[k] = length = float(np.sqrt(np.sum(y * y)))
        values, vectors = np.linalg.eigh(
            np.diag(alpha[: k + 1]) + np.diag(beta[:k], 1) + np.diag(beta[:k], -1)
        )
        value = float(values[-1])
        error = length * abs(float(vectors[-1, -1]))
        if error <= tolerance * abs(value):
            break
    return value, error


@kernel
def _append(basis: Array, row: int, y: Array, length: float) -> None:
    """basis_row = y / length."""
    for i in range(len(y)):
        basis[row, i] = y[i] / length


@kernel(reorder=True)
def _orthogonalize(basis: Array, count: int, y: Array) -> float:
    """y −= Σ_k q_k (q_kᵀ y), newest first, twice; returns the first q_kᵀ y, Lanczos' α."""
    alpha = 0.0
    for sweep in range(2):
        for k in range(count - 1, -1, -1):
            dot = 0.0
            for i in range(len(y)):
                dot += basis[k, i] * y[i]
            for i in range(len(y)):
                y[i] -= dot * basis[k, i]
            if sweep == 0 and k == count - 1:
                alpha = dot
    return alpha


def warm_up() -> None:
    """Compile the kernels of this module."""
    largest_eigenvalue(lambda x: x, 2)
