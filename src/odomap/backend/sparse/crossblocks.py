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
from odomap.backend.sparse.blocks import BlockPattern
from odomap.backend.sparse.multifrontal import GROUP, solve_group
from odomap.backend.sparse.symbolic import Fronts
from odomap.kernels import kernel

__all__ = ["cross_blocks", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bool = NDArray[np.bool_]


def cross_blocks(factor: BlockCholesky, first: Index, second: Index) -> Array:
    """Return blocks of A⁻¹.

    Args:
        factor: of A, factored.
        first, second: (B,) blocks, all of one size s.

    Returns:
        (B, s, s).

    Example:
        >>> cholesky = BlockCholesky(BlockPattern.of([1, 1], [0], [1]))
        >>> cholesky.factor(np.array([2.0, 2.0, 1.0]))
        True
        >>> cross_blocks(cholesky, np.array([1]), np.array([0])).ravel().round(6).tolist()
        [-0.333333]
    """
    factor.require_factor()
    sizes, start, rows = factor.pattern.sizes, factor.pattern.row_start, factor.fronts.rows
    size = int(sizes[first[0]]) if len(first) else 0
    count = np.bincount(np.concatenate([first, second]), minlength=len(sizes))
    is_turned = count[second] > count[first]
    source, target = np.where(is_turned, second, first), np.where(is_turned, first, second)
    order = np.argsort(source, kind="stable")
    position = np.empty_like(rows)
    position[rows] = np.arange(len(rows))
    found = np.empty((len(first), size, size))
    at = [position[start[blocks[order]]] for blocks in (source, target)]
    _columns(factor.fronts, factor.values, at[0], at[1], found)
    found[order] = found.copy()
    found[is_turned] = np.swapaxes(found[is_turned], 1, 2)
    return found


@kernel
def _mark_way(fronts: Fronts, row: int, is_above: Bool) -> None:
    """Mark the front of a pivot row, and all above it."""
    s = np.searchsorted(fronts.pivot, row, side="right") - 1
    while s >= 0 and not is_above[s]:
        is_above[s] = True
        s = fronts.parent[s]


@kernel
def _columns(fronts: Fronts, factor: Array, source: Index, target: Index, found: Array) -> None:
    """found (B, s, s) = blocks of A⁻¹ at rows `source`, ascending by runs, and columns `target`."""
    n, size, pairs = len(fronts.rows), found.shape[1], len(source)
    is_above, visited = np.zeros(len(fronts.parent), np.bool_), np.empty_like(fronts.parent)
    X, local = np.zeros(GROUP * n), np.empty(GROUP * fronts.width.max())
    begin = 0
    while begin < pairs:
        _mark_way(fronts, source[begin], is_above)
        end = begin
        while end < pairs and source[end] == source[begin]:
            _mark_way(fronts, target[end], is_above)
            end += 1
        count = 0
        for s in range(len(is_above)):
            if is_above[s]:
                visited[count], is_above[s] = s, False
                count += 1
        for c in range(0, size, GROUP):
            columns = min(GROUP, size - c)
            for g in range(columns):
                X[g * n + source[begin] + c + g] = 1.0
            solve_group(fronts, factor, visited[:count], X, local)
            for e in range(begin, end):
                for g in range(columns):
                    for b in range(size):
                        found[e, c + g, b] = X[g * n + target[e] + b]
            for s in visited[:count]:
                for g in range(GROUP):
                    for row in range(fronts.pivot[s], fronts.pivot[s + 1]):
                        X[g * n + row] = 0.0
        begin = end


def warm_up() -> None:
    """Compile the kernels of this module."""
    factor = BlockCholesky(BlockPattern.of([1, 1], [0], [1]))
    factor.factor(np.array([2.0, 2.0, 1.0]))
    cross_blocks(factor, np.zeros(1, np.int64), np.ones(1, np.int64))
