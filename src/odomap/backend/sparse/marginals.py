"""Covariances from a factored information matrix: some blocks of A⁻¹, without forming A⁻¹.

The covariance of a graph's solution is A⁻¹, which is dense. But its blocks in the pattern of the
factor follow from each other, from the root of the elimination tree down (`selected`): one pass
yields the covariance of every node and of every pair of neighbours.

Blocks far from each other are found as columns of A⁻¹, by solving

    A X = E,    E the columns of the identity that belong to the chosen blocks.

Such a column is wanted in few places, and needs only the fronts on the ways from there to the root,
in both substitutions: forwards nothing else is reached from E, backwards nothing else is asked for.

Cost: two or three factorisations for all of them; for the joint covariance of a few blocks, 4
operations for each entry of those fronts and each column.

Reference: Kaess, Dellaert, "Covariance Recovery from a Square Root Information Matrix for Data
Association", Robotics and Autonomous Systems 57(12), 2009.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.backend.sparse.blockcholesky import BlockCholesky
from odomap.backend.sparse.blocks import BlockPattern
from odomap.backend.sparse.multifrontal import GROUP, solve_group
from odomap.backend.sparse.selected import selected_inverse
from odomap.backend.sparse.symbolic import Fronts
from odomap.errors import InputError
from odomap.kernels import kernel

__all__ = [
    "Marginals",
    "fronts_of",
    "joint_covariance",
    "marginal_blocks",
    "warm_up",
    "ways_up",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Marginals:
    """The blocks of A⁻¹ on the diagonal and in the pattern of the factor, all found at once.

    Args:
        factor: of A, factored. It may be used for other numbers afterwards.

    Raises:
        InputError: the matrix is not factored.

    Example:
        >>> cholesky = BlockCholesky(BlockPattern.of([1, 1], [0], [1]))
        >>> cholesky.factor(np.array([2.0, 2.0, 1.0]))
        True
        >>> marginals = Marginals(cholesky)
        >>> marginals.blocks([0, 1]).ravel().round(6).tolist()
        [0.666667, 0.666667]
        >>> marginals.pairs([0], [1]).ravel().round(6).tolist()
        [-0.333333]
    """

    def __init__(self, factor: BlockCholesky) -> None:
        factor.require_factor()
        self.pattern, self._fronts = factor.pattern, factor.fronts
        self._inverse = selected_inverse(factor.fronts, factor.values)
        self._position = np.empty_like(self._fronts.rows)
        self._position[self._fronts.rows] = np.arange(len(self._position))

    def blocks(self, blocks: ArrayLike) -> Array:
        """Return covariances of single blocks.

        Args:
            blocks: (B,) indices, of blocks of one size s.

        Returns:
            (B, s, s).
        """
        return self.pairs(blocks, blocks)

    def pairs(self, first: ArrayLike, second: ArrayLike) -> Array:
        """Return cross covariances of pairs of blocks that are neighbours in the factor.

        All pairs of the pattern are; others may be.

        Args:
            first, second: (B,) indices, the first all of one size s, the second of one size t.

        Returns:
            (B, s, t).

        Raises:
            InputError: the sizes differ, or a pair is not in the factor.
        """
        i, s = _of_one_size(self.pattern, first)
        j, t = _of_one_size(self.pattern, second)
        if len(i) != len(j):
            raise InputError(f"marginals: {len(i)} first blocks, {len(j)} second ones")
        start = self.pattern.row_start
        rows, columns = self._position[start[i]], self._position[start[j]]
        found = np.empty((len(i), s, t))
        missing = _look_up(self._fronts, self._inverse, rows, columns, found)
        if missing >= 0:
            raise InputError(
                f"marginals: the blocks {i[missing]} and {j[missing]} are no neighbours in the "
                "factor (take joint_covariance)"
            )
        return found


def marginal_blocks(factor: BlockCholesky, blocks: ArrayLike) -> Array:
    """Return the covariances of single blocks, by whichever way is shorter.

    Args:
        factor: of A, factored.
        blocks: (B,) indices, of blocks of one size s.

    Returns:
        (B, s, s) diagonal blocks of A⁻¹.

    Raises:
        InputError: a block does not exist, sizes differ, or the matrix is not factored.
    """
    factor.require_factor()
    chosen, size = _of_one_size(factor.pattern, blocks)
    entries = _entries_up(factor.fronts)[fronts_of(factor, chosen)]
    columns = -(-size // GROUP) * GROUP
    if 4.0 * columns * entries.sum() > 3.0 * factor.flops:
        return Marginals(factor).blocks(chosen)
    return np.array([joint_covariance(factor, [b]) for b in chosen]).reshape(
        len(chosen), size, size
    )


def joint_covariance(factor: BlockCholesky, blocks: ArrayLike) -> Array:
    """Return the joint covariance of some blocks, wherever they are.

    Args:
        factor: of A, factored.
        blocks: (B,) indices, each at most once; sizes may differ.

    Returns:
        (Σ s, Σ s), rows and columns in the order of `blocks`.

    Raises:
        InputError: a block does not exist or comes twice, or the matrix is not factored.
    """
    factor.require_factor()
    chosen = _checked(factor.pattern, blocks)
    if len(np.unique(chosen)) != len(chosen):
        raise InputError("joint covariance: a block comes twice")
    fronts, start = factor.fronts, factor.pattern.row_start
    rows = [np.arange(start[b], start[b + 1]) for b in chosen]
    wanted = np.concatenate([np.zeros(0, np.int64), *rows])
    position = np.empty_like(fronts.rows)
    position[fronts.rows] = np.arange(len(position))
    at = position[wanted]
    visited = ways_up(fronts, np.unique(fronts_of(factor, chosen)))
    local = np.empty(GROUP * int(fronts.width.max(initial=0)))
    joint = np.empty((len(at), len(at)))
    for c in range(0, len(at), GROUP):
        count = min(GROUP, len(at) - c)
        X = np.zeros((GROUP, factor.pattern.size))
        X[np.arange(count), at[c : c + count]] = 1.0
        solve_group(fronts, factor.values, visited, X.reshape(-1), local)
        joint[:, c : c + count] = X[:count, at].T
    return 0.5 * (joint + joint.T)


def _checked(pattern: BlockPattern, blocks: ArrayLike) -> Index:
    """Return block indices as int64, or raise InputError if one does not exist."""
    chosen = np.asarray(blocks, dtype=np.int64).reshape(-1)
    n = len(pattern.sizes)
    if len(chosen) and not (chosen.min() >= 0 and chosen.max() < n):
        raise InputError(f"covariance: there is no such block among {n}")
    return chosen


def _of_one_size(pattern: BlockPattern, blocks: ArrayLike) -> tuple[Index, int]:
    """Return block indices and their common size, or raise InputError if there is none."""
    chosen = _checked(pattern, blocks)
    sizes = pattern.sizes[chosen]
    if len(chosen) and (sizes != sizes[0]).any():
        raise InputError(
            "covariance: blocks of several sizes (ask for those of one size at a time)"
        )
    return chosen, int(sizes[0]) if len(chosen) else 0


def fronts_of(factor: BlockCholesky, blocks: Index) -> Index:
    """Return the front in which each block is eliminated."""
    position = np.empty_like(factor.order)
    position[factor.order] = np.arange(len(position))
    row = np.append(0, np.cumsum(factor.pattern.sizes[factor.order]))[position[blocks]]
    return np.searchsorted(factor.fronts.pivot, row, side="right") - 1


def ways_up(fronts: Fronts, first: Index) -> Index:
    """Return the given fronts and all above them, ascending."""
    is_above = np.zeros(len(fronts.parent), np.bool_)
    for s in first:
        while s >= 0 and not is_above[s]:
            is_above[s] = True
            s = fronts.parent[s]
    return np.flatnonzero(is_above)


@kernel
def _entries_up(fronts: Fronts) -> Array:
    """Return how many entries the factor has in each front and all above it."""
    entries = np.zeros(len(fronts.parent))
    for s in range(len(entries) - 1, -1, -1):
        entries[s] = (fronts.pivot[s + 1] - fronts.pivot[s]) * fronts.width[s]
        if fronts.parent[s] >= 0:
            entries[s] += entries[fronts.parent[s]]
    return entries


@kernel
def _look_up(fronts: Fronts, inverse: Array, rows: Index, columns: Index, found: Array) -> int:
    """Copy blocks of Z that begin at the given positions; return the first that is not there."""
    pivot, border, border_rows = fronts.pivot, fronts.border, fronts.border_rows
    for e in range(len(rows)):
        low, high = min(rows[e], columns[e]), max(rows[e], columns[e])
        s = np.searchsorted(pivot, low, side="right") - 1
        k, begin, end = (
            pivot[s + 1] - pivot[s],
            border[s],
            border[s + 1],
        )
        column = high - pivot[s]
        if column >= k:
            b = begin
            while b < end and border_rows[b] != high:
                b += 1
            if b == end:
                return e
            column = k + b - begin
        place = fronts.start[s] + (low - pivot[s]) * fronts.width[s] + column
        for a in range(found.shape[1]):
            for b in range(found.shape[2]):
                down, right = (a, b) if rows[e] <= columns[e] else (b, a)
                found[e, a, b] = inverse[place + down * fronts.width[s] + right]
    return -1


def warm_up() -> None:
    """Compile the kernels of this module."""
    factor = BlockCholesky(BlockPattern.of([1, 1], [0], [1]))
    factor.factor(np.array([2.0, 2.0, 1.0]))
    Marginals(factor).blocks([0])
    joint_covariance(factor, [0])
    _entries_up(factor.fronts)
