"""Cholesky factorisation of small dense matrices, inside compiled loops.

A symmetric positive definite A = L Lᵀ is factored column by column and solved by two triangular
substitutions: n³/3 operations. LAPACK would be as fast from a hundred rows on, but calling it
holds the interpreter's lock or a second compiled library; the windows of odometry have 30 to 150
unknowns.

Reference: Golub, Van Loan, "Matrix Computations", 4th ed., section 4.2.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["factor", "invert", "solve", "warm_up"]

Array = NDArray[np.float64]


@kernel(reorder=True)
def factor(A: Array) -> bool:
    """Overwrite the lower triangle of A (n, n) with L; False if A is not positive definite.

    A pivot that is 1e-10 of its diagonal is what rounding makes of zero.
    """
    n = len(A)
    for j in range(n):
        row_j = A[j]
        pivot = row_j[j]
        for k in range(j):
            pivot -= row_j[k] * row_j[k]
        if not pivot > 1e-10 * abs(A[j, j]) or not np.isfinite(pivot):
            return False
        diagonal = np.sqrt(pivot)
        A[j, j] = diagonal
        inverse = 1.0 / diagonal
        for i in range(j + 1, n):
            row_i = A[i]
            total = row_i[j]
            for k in range(j):
                total -= row_i[k] * row_j[k]
            row_i[j] = total * inverse
    return True


@kernel(reorder=True)
def solve(L: Array, b: Array) -> None:
    """Overwrite b (n,) with the solution of L Lᵀ x = b."""
    n = len(L)
    for i in range(n):
        total = b[i]
        for k in range(i):
            total -= L[i, k] * b[k]
        b[i] = total / L[i, i]
    for i in range(n - 1, -1, -1):
        b[i] /= L[i, i]
        for k in range(i):
            b[k] -= L[i, k] * b[i]


@kernel(reorder=True)
def invert(L: Array, inverse: Array) -> None:
    """Write (L Lᵀ)⁻¹ (n, n)."""
    n = len(L)
    inverse[:, :] = 0.0
    for j in range(n):
        inverse[j, j] = 1.0
        solve(L, inverse[j])


def warm_up() -> None:
    """Compile the kernels of this module."""
    A = np.eye(2)
    factor(A)
    solve(A, np.ones(2))
    invert(A, np.empty((2, 2)))
