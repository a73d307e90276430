"""A = L Lᵀ of a sparse symmetric positive definite block matrix."""

import numpy as np
from numpy.typing import NDArray

from odomap.backend.blocks import BlockPattern
from odomap.backend.ldl import QdldlFactor

__all__ = ["BlockCholesky"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class BlockCholesky:
    """A = L Lᵀ of a symmetric positive definite block matrix; analysed once, factored often."""

    def __init__(self, pattern: BlockPattern, order: Index | None = None) -> None:
        self.pattern = pattern
        self._factor = QdldlFactor(pattern)
        self.order: Index = np.arange(len(pattern.sizes)) if order is None else order
        self.num_nonzeros = 0
        self.flops = 0.0
        self.failed_block = -1

    def factor(self, values: Array, shift: float = 0.0) -> bool:
        """Factor A + shift·I; False if it is not positive definite."""
        is_definite = self._factor.factor(values, shift)
        self.failed_block = self._factor.failed_block
        self.num_nonzeros, self.flops = self._factor.num_nonzeros, self._factor.flops
        return is_definite

    def solve(self, b: Array) -> Array:
        """Return x with (A + shift·I) x = b, of b's shape (n,) or (n, k)."""
        return self._factor.solve(b)

    def log_determinant(self) -> float:
        """Return log det (A + shift·I)."""
        return self._factor.log_determinant()
