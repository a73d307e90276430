"""Blocks of an inverse anywhere: how two unknowns far from each other vary together.

Of A⁻¹ the factor's pattern has only blocks of neighbours (`selected`). Those of any other pairs are
in the columns of their first blocks,

    A X = E_i,    (A⁻¹)_ij = (X_j)ᵀ,

so that one substitution serves all pairs of the same first block. As in `marginals` only the fronts
on the ways from a pair's blocks to the root take part. Whichever block of a pair is in more of the
pairs is its first: all pairs of n blocks take n substitutions.

Cost: for each first block 4 operations for each entry of those fronts and each column.

Reference: M. Kaess, F. Dellaert, "Covariance recovery from a square root information matrix for
data association", Robotics and Autonomous Systems 57(12), 2009.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.backend.sparse.blockcholesky import BlockCholesky
from odomap.backend.sparse.marginals import fronts_of, ways_up
from odomap.backend.sparse.multifrontal import GROUP, solve_group

__all__ = ["cross_blocks"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def cross_blocks(factor: BlockCholesky, first: Index, second: Index) -> Array:
    """Return blocks of A⁻¹.

    Args:
        factor: of A, factored.
        first, second: (B,) blocks, all of one size s.

    Returns:
        (B, s, s).

    Example:
        >>> from odomap.backend.sparse.blocks import BlockPattern
        >>> cholesky = BlockCholesky(BlockPattern.of([1, 1], [0], [1]))
        >>> cholesky.factor(np.array([2.0, 2.0, 1.0]))
        True
        >>> cross_blocks(cholesky, np.array([1]), np.array([0])).ravel().round(6).tolist()
        [-0.333333]
    """
    factor.require_factor()
    sizes, start, fronts = factor.pattern.sizes, factor.pattern.row_start, factor.fronts
    size = int(sizes[first[0]]) if len(first) else 0
    count = np.bincount(np.concatenate([first, second]), minlength=len(sizes))
    is_turned = count[second] > count[first]
    source, target = np.where(is_turned, second, first), np.where(is_turned, first, second)
    position = np.empty_like(fronts.rows)
    position[fronts.rows] = np.arange(len(fronts.rows))
    rows, columns = position[start[source]], position[start[target]]
    ends = np.stack([fronts_of(factor, source), fronts_of(factor, target)])
    X, local = np.zeros((GROUP, len(position))), np.empty(GROUP * int(fronts.width.max(initial=0)))
    found = np.empty((len(first), size, size))
    order = np.argsort(source, kind="stable")
    runs = np.split(order, np.flatnonzero(np.diff(source[order])) + 1)
    for run in runs if len(order) else []:
        visited = ways_up(fronts, np.unique(ends[:, run]))
        entries = columns[run][:, None] + np.arange(size)
        for c in range(0, size, GROUP):
            width = min(GROUP, size - c)
            X[np.arange(width), rows[run[0]] + c + np.arange(width)] = 1.0
            solve_group(fronts, factor.values, visited, X.reshape(-1), local)
            found[run, c : c + width] = np.swapaxes(X[:width, entries], 0, 1)
            X[:] = 0.0
    found[is_turned] = np.swapaxes(found[is_turned], 1, 2)
    return found
