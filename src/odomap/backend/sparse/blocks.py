"""Symmetric matrices made of small dense blocks, most of them zero: where the blocks stand.

Normal equations of a graph, A = Σ_e J_eᵀ Ω_e J_e, have a block A_ii of each node's own size (3 for
a pose in the plane, 6 in space, 7 with scale, 2 or 3 for a landmark) and a block A_ij for each pair
of nodes that share an edge; all others are zero. The pattern is fixed by the graph while the
numbers change at every iteration, so they are kept apart:

    values = | A_00 | A_11 | ... | A_NN |  A_ij, A_kl, ... (i < j, sorted)  |

one flat array, each block row-major, of which only the upper half of A is stored (the diagonal
blocks in full). An edge adds its Jacobians' products to four places known beforehand, and nothing
is ever searched, sorted or allocated while a graph is being solved.

Cost: O(P log P) once to sort P pairs; a product A x takes one pass over `values`.

Reference: Kümmerle et al., "g2o: A General Framework for Graph Optimization", ICRA 2011, section
III (block structure of the normal equations).
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import InputError
from odomap.kernels import kernel

if TYPE_CHECKING:
    from scipy.sparse import csc_array

__all__ = ["MAX_BLOCK", "BlockPattern", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MAX_BLOCK = 16  # rows of the largest block


@dataclass(frozen=True, eq=False)
class BlockPattern:
    """Where a symmetric block matrix has blocks: all N on the diagonal, and P pairs above it.

    Attributes:
        sizes: (N,) rows of each block, 1 to 16.
        first, second: (P,) block row and column of each pair, first < second, unique, sorted.
        row_start: (N + 1,) first scalar row of each block.
        size: scalar dimension n.
        diagonal_start: (N,) where in `values` each diagonal block begins, row-major, full.
        pair_start: (P,) where in `values` each block A[first, second] begins, row-major.
        num_values: length of `values`.
        diagonal: (n,) where in `values` each scalar diagonal entry is, for damping.

    Example:
        >>> pattern = BlockPattern.of([2, 1], [1], [0])      # one pair, however it is named
        >>> values = np.array([4.0, 1, 1, 3, 2, 1, 0])       # A_00, A_11, A_01
        >>> pattern.to_scipy(values).toarray().tolist()
        [[4.0, 1.0, 1.0], [1.0, 3.0, 0.0], [1.0, 0.0, 2.0]]
        >>> pattern.multiply(values, np.ones(3)).tolist()
        [6.0, 4.0, 3.0]
    """

    sizes: Index
    first: Index
    second: Index
    row_start: Index = field(init=False, repr=False)
    size: int = field(init=False, repr=False)
    diagonal_start: Index = field(init=False, repr=False)
    pair_start: Index = field(init=False, repr=False)
    num_values: int = field(init=False, repr=False)
    diagonal: Index = field(init=False, repr=False)

    def __post_init__(self) -> None:
        sizes, first, second = (
            np.ascontiguousarray(a, dtype=np.int64) for a in (self.sizes, self.first, self.second)
        )
        _check(sizes, first, second)
        areas = sizes * sizes
        diagonal_start = _starts(areas)
        pair_start = diagonal_start[-1] + _starts(sizes[first] * sizes[second])
        row_start = _starts(sizes)
        within = np.arange(row_start[-1]) - np.repeat(row_start[:-1], sizes)
        diagonal = np.repeat(diagonal_start[:-1], sizes) + within * (np.repeat(sizes, sizes) + 1)
        derived = {
            "sizes": sizes,
            "first": first,
            "second": second,
            "row_start": row_start,
            "size": int(row_start[-1]),
            "diagonal_start": diagonal_start[:-1].copy(),
            "pair_start": pair_start[:-1].copy(),
            "num_values": int(pair_start[-1]),
            "diagonal": diagonal,
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)

    @classmethod
    def of(cls, sizes: ArrayLike, i: ArrayLike, j: ArrayLike) -> "BlockPattern":
        """Return the pattern of the given pairs of blocks.

        Args:
            sizes: (N,) rows of each block.
            i, j: (E,) block indices; a pair may come twice, in either order, or be a block with
                itself (which the diagonal has anyway).

        Raises:
            InputError: a size is not 1 to 16, or a pair names a block that does not exist.
        """
        sizes = np.asarray(sizes, dtype=np.int64)
        low, high = _ordered(i, j)
        n = len(sizes)
        _check_range(n, low, high)
        keys = np.sort((low * n + high)[low != high])
        keys = keys[np.append(True, keys[1:] != keys[:-1])[: len(keys)]]
        return cls(sizes, keys // max(n, 1), keys % max(n, 1))

    def pair_of(self, i: ArrayLike, j: ArrayLike) -> Index:
        """Return which pair each of the given unordered pairs of blocks is.

        Args:
            i, j: (E,) block indices.

        Returns:
            (E,) indices into `first`, −1 where i == j.

        Raises:
            InputError: a pair is not in the pattern.
        """
        low, high = _ordered(i, j)
        n = len(self.sizes)
        _check_range(n, low, high)
        keys, wanted = self.first * n + self.second, low * n + high
        found = np.searchsorted(keys, wanted)
        is_self = low == high
        is_known = np.append(keys, -1)[found] == wanted
        if not (is_known | is_self).all():
            e = int(np.argmin(is_known | is_self))
            raise InputError(f"block pattern: the pair ({low[e]}, {high[e]}) is not in it")
        return np.where(is_self, -1, found).astype(np.int64)

    def multiply(self, values: Array, x: Array) -> Array:
        """Return the product A x.

        Args:
            values: (num_values,).
            x: (n,) or (n, k).

        Raises:
            InputError: a shape does not fit.
        """
        values = self.checked(values)
        x = np.asarray(x, dtype=np.float64)
        if x.ndim not in (1, 2) or len(x) != self.size:
            raise InputError(f"block pattern: x has shape {x.shape} (first axis: {self.size})")
        y = np.zeros(x.shape)
        starts = self.row_start, self.diagonal_start, self.pair_start
        columns = np.ascontiguousarray(x if x.ndim == 2 else x[:, None])
        _multiply(
            self.sizes, self.first, self.second, *starts, values, columns, y.reshape(columns.shape)
        )
        return y

    def to_scipy(self, values: Array) -> "csc_array":
        """Return the whole matrix, both halves, as scipy's (n, n) compressed columns."""
        from scipy.sparse import csc_array

        values = self.checked(values)
        nodes = np.arange(len(self.sizes))
        parts = (nodes, nodes, self.diagonal_start), (self.first, self.second, self.pair_start)
        (r0, c0, v0), (r1, c1, v1) = (self._entries(*part) for part in parts)
        rows, columns = np.concatenate([r0, r1, c1]), np.concatenate([c0, c1, r1])
        data = values[np.concatenate([v0, v1, v1])]
        return csc_array((data, (rows, columns)), shape=(self.size, self.size))

    def checked(self, values: Array) -> Array:
        """Return `values` as contiguous float64, or raise InputError if the length is wrong."""
        values = np.ascontiguousarray(values, dtype=np.float64)
        if values.shape != (self.num_values,):
            raise InputError(
                f"block pattern: values have shape {values.shape}, not ({self.num_values},)"
            )
        return values

    def _entries(self, i: Index, j: Index, start: Index) -> tuple[Index, Index, Index]:
        """Return scalar row, column and place in `values` of all entries of the blocks (i, j)."""
        areas, widths = self.sizes[i] * self.sizes[j], np.maximum(self.sizes[j], 1)
        block = np.repeat(np.arange(len(i)), areas)
        within = np.arange(len(block)) - np.repeat(_starts(areas)[:-1], areas)
        rows = self.row_start[i][block] + within // widths[block]
        columns = self.row_start[j][block] + within % widths[block]
        return rows, columns, start[block] + within


def _starts(lengths: Index) -> Index:
    """Return where pieces of the given lengths begin, and after them where the last one ends."""
    return np.concatenate([np.zeros(1, np.int64), np.cumsum(lengths, dtype=np.int64)])


def _ordered(i: ArrayLike, j: ArrayLike) -> tuple[Index, Index]:
    """Return the lower and the higher index of each pair."""
    i, j = (np.asarray(a, dtype=np.int64).reshape(-1) for a in (i, j))
    if len(i) != len(j):
        raise InputError(f"block pattern: {len(i)} first indices, {len(j)} second ones")
    return np.minimum(i, j), np.maximum(i, j)


def _check_range(n: int, low: Index, high: Index) -> None:
    if len(low) and not (low.min() >= 0 and high.max() < n):
        raise InputError(f"block pattern: a pair names a block that is not one of {n}")


def _check(sizes: Index, first: Index, second: Index) -> None:
    """Raise InputError unless the arrays are what `BlockPattern` says."""
    if sizes.ndim != 1 or first.ndim != 1 or first.shape != second.shape:
        raise InputError("block pattern: sizes, first and second are vectors, the pairs' alike")
    if len(sizes) and not (sizes.min() >= 1 and sizes.max() <= MAX_BLOCK):
        raise InputError(
            f"block pattern: a block has 1 to {MAX_BLOCK} rows, not {sizes.min()} to {sizes.max()}"
        )
    _check_range(len(sizes), first, second)
    keys = first * len(sizes) + second
    if not (first < second).all() or not (np.diff(keys) > 0).all():
        raise InputError("block pattern: pairs must be first < second, sorted, each once")


@kernel
def _multiply(
    sizes: Index,
    first: Index,
    second: Index,
    row_start: Index,
    diagonal_start: Index,
    pair_start: Index,
    values: Array,
    x: Array,
    y: Array,
) -> None:
    """y_i += A_ii x_i, and for each pair y_i += A_ij x_j, y_j += A_ijᵀ x_i; x and y are (n, k)."""
    for i in range(len(sizes)):
        s, row, v = sizes[i], row_start[i], diagonal_start[i]
        for a in range(s):
            for b in range(s):
                for c in range(x.shape[1]):
                    y[row + a, c] += values[v] * x[row + b, c]
                v += 1
    for p in range(len(first)):
        row, column, v = row_start[first[p]], row_start[second[p]], pair_start[p]
        for a in range(sizes[first[p]]):
            for b in range(sizes[second[p]]):
                for c in range(x.shape[1]):
                    y[row + a, c] += values[v] * x[column + b, c]
                    y[column + b, c] += values[v] * x[row + a, c]
                v += 1


def warm_up() -> None:
    """Compile the kernels of this module."""
    pattern = BlockPattern.of([1, 1], [0], [1])
    pattern.multiply(np.ones(pattern.num_values), np.ones(2))
