"""A = L Lᵀ of a sparse symmetric positive definite block matrix: analyse once, factor often.

The solver's door to the room's sparse algebra. The graph decides once in which order blocks are
eliminated (`ordering`), which dense fronts that makes and where every number goes (`symbolic`);
each set of numbers is then factored and solved with (`multifrontal`) in memory that is reused:

    P A Pᵀ = Uᵀ U,      x = Pᵀ U⁻¹ U⁻ᵀ P b,      log det A = 2 Σ log u_ii.

A matrix is refused as not positive definite where a pivot is not positive, or keeps no digit of the
diagonal entry it came from: then the unknowns before it already say all that is known of this one,
as in a graph that nothing ties to the world.

Nothing is shared between two factors, and all of it runs without the interpreter's lock, so that
several threads may each use their own.

Reference: Davis, Rajamanickam, Sid-Lakhdar, "A Survey of Direct Methods for Sparse Linear Systems",
Acta Numerica 25, 2016.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.backend.sparse.blocks import BlockPattern
from odomap.backend.sparse.fronts import SLACK_ROWS, TILE
from odomap.backend.sparse.multifrontal import (
    GROUP,
    factor_fronts,
    solve_fronts,
    solve_group,
    stack_size,
)
from odomap.backend.sparse.ordering import approximate_minimum_degree
from odomap.backend.sparse.symbolic import Fronts, analyse
from odomap.errors import InputError

__all__ = ["BlockCholesky"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class BlockCholesky:
    """A = L Lᵀ of a symmetric positive definite block matrix; analysed once, factored often.

    Attributes:
        pattern: of A.
        order: (N,) the order in which blocks are eliminated: the one given, or an equivalent.
        fronts: what is done, in detail.
        num_nonzeros: entries of L, with its diagonal and the zeros that dense fronts take in.
        flops: multiplications and additions of one factorisation.
        failed_block: block at which the last factorisation failed, or −1.
        is_factored: the last factorisation succeeded.
        values: (fronts.start[-1],) pivot rows of the fronts, the upper triangle U = Lᵀ.

    Example:
        >>> chain = BlockPattern.of([1, 1, 1], [0, 1], [1, 2])
        >>> cholesky = BlockCholesky(chain)
        >>> cholesky.factor(np.array([2.0, 2, 2, -1, -1]))
        True
        >>> cholesky.solve(np.array([1.0, 0, 1])).round(12).tolist()
        [1.0, 1.0, 1.0]
        >>> cholesky.factor(np.array([2.0, 2, 2, -1, -2])), cholesky.failed_block in (0, 1, 2)
        (False, True)
    """

    def __init__(self, pattern: BlockPattern, order: ArrayLike | None = None) -> None:
        self.pattern = pattern
        order = approximate_minimum_degree(pattern) if order is None else _checked(order, pattern)
        self.fronts: Fronts = analyse(pattern, order)
        self.order: Index = self.fronts.order
        k, f = np.diff(self.fronts.pivot), self.fronts.width
        self.num_nonzeros = int((k * (k + 1) // 2 + k * (f - k)).sum())
        self.flops = float((_squares(f) - _squares(f - k)).sum())
        self.failed_block = -1
        self.is_factored = False
        self._widest = int(f.max(initial=0))
        slack = SLACK_ROWS * (self._widest + 1)
        self.values: Array = np.zeros(int(self.fronts.start[-1]) + slack)
        self._stack: Array = np.zeros(stack_size(self.fronts))
        self._scratch: Array = np.zeros(4 * TILE + self._widest)
        within = np.arange(pattern.size) - np.repeat(self.fronts.pivot[:-1], k)
        self._diagonal: Index = np.repeat(self.fronts.start[:-1], k)
        self._diagonal += within * (np.repeat(f, k) + 1)

    def factor(self, values: Array, shift: float = 0.0) -> bool:
        """Factor A + shift·I; False if it is not positive definite, then `failed_block` says where.

        Args:
            values: (num_values,) of the pattern.
            shift: added to the diagonal.

        Raises:
            InputError: `values` has the wrong length.
        """
        values = self.pattern.checked(values)
        failed = factor_fronts(
            self.fronts, values, float(shift), self.values, self._stack, self._scratch
        )
        self.is_factored, self.failed_block = failed < 0, -1
        if failed >= 0:
            row = self.fronts.rows[failed]
            self.failed_block = int(np.searchsorted(self.pattern.row_start, row, side="right")) - 1
        return self.is_factored

    def solve(self, b: Array) -> Array:
        """Return x with (A + shift·I) x = b.

        Args:
            b: (n,) or (n, k).

        Returns:
            Of b's shape.

        Raises:
            InputError: b has another length, or the matrix is not factored.
        """
        b = np.asarray(b, dtype=np.float64)
        if b.ndim not in (1, 2) or len(b) != self.pattern.size:
            raise InputError(f"solve: b has shape {b.shape} (first axis: {self.pattern.size})")
        self.require_factor()
        x = np.empty(b.shape)
        rows = self.fronts.rows
        if b.ndim == 1:
            y = b[rows]
            solve_fronts(self.fronts, self.values, y, np.empty(self._widest))
            x[rows] = y
            return x
        local, visited = np.empty(self._widest * GROUP), np.arange(len(self.fronts.parent))
        for start in range(0, b.shape[1], GROUP):
            count = min(GROUP, b.shape[1] - start)
            group = np.zeros((GROUP, len(b)))
            group[:count] = b[rows, start : start + count].T
            solve_group(self.fronts, self.values, visited, group.reshape(-1), local)
            x[rows, start : start + count] = group[:count].T
        return x

    def log_determinant(self) -> float:
        """Return log det (A + shift·I)."""
        self.require_factor()
        return float(2.0 * np.log(self.values[self._diagonal]).sum())

    def require_factor(self) -> None:
        """Raise InputError unless the last factorisation succeeded."""
        if not self.is_factored:
            raise InputError("block Cholesky: the matrix is not factored, or not positive definite")


def _squares(x: Index) -> Array:
    """Return Σ_{q ≤ x} q²."""
    y = x.astype(np.float64)
    return y * (y + 1.0) * (2.0 * y + 1.0) / 6.0


def _checked(order: ArrayLike, pattern: BlockPattern) -> Index:
    """Return the order as int64, or raise InputError if it is not a permutation of the blocks."""
    order = np.ascontiguousarray(order, dtype=np.int64)
    n = len(pattern.sizes)
    if order.shape != (n,) or not np.array_equal(np.sort(order), np.arange(n)):
        raise InputError(f"block Cholesky: order is not a permutation of {n} blocks")
    return order
