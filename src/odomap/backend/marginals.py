"""Covariances from a factored information matrix: some blocks of A⁻¹, without forming A⁻¹.

The covariance of a graph's solution is A⁻¹, which is dense. But its blocks in the pattern of the
factor follow from each other: from A = Uᵀ U, Z = A⁻¹ obeys U Z = U⁻ᵀ, and with the rows of one
front U = | U11 U12 | and Z22 the part of Z that belongs to the front's border,

    W = U11⁻¹ U12,    Z12 = −W Z22,    Z11 = (U11ᵀ U11)⁻¹ − W Z12ᵀ.

The border of a front lies within its parent's front, so going from the roots down, Z22 is always at
hand: one pass yields the covariance of every node and of every pair of neighbours.

Blocks far from each other are columns of A⁻¹, A X = E. A column that is wanted in few places needs
only the fronts on the ways from those places to the root, in both substitutions.

Cost: two or three factorisations for all of them; for the joint covariance of a few blocks, 4
operations for each entry of those fronts and each column.

Reference: Erisman, Tinney, "On Computing Certain Elements of the Inverse of a Sparse Matrix",
Communications of the ACM 18(3), 1975 (after Takahashi, Fagan, Chin, 1973).
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.backend.blockcholesky import BlockCholesky
from odomap.backend.blocks import BlockPattern
from odomap.backend.fronts import SLACK_ROWS, TILE, take_off
from odomap.backend.multifrontal import GROUP, solve_group
from odomap.backend.symbolic import Fronts
from odomap.errors import InputError
from odomap.kernels import kernel

__all__ = ["Marginals", "joint_covariance", "marginal_blocks", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

PANEL = 32  # pivots whose rows of the inverse are found together

U = np.uint64


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
        self._inverse = _selected_inverse(factor)
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
    entries = _entries_up(factor.fronts)[_fronts_of(factor, chosen)]
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
    visited = _ways_up(fronts, np.unique(_fronts_of(factor, chosen)))
    local = np.empty(GROUP * int(fronts.width.max(initial=0)))
    joint = np.empty((len(at), len(at)))
    for c in range(0, len(at), GROUP):
        count = min(GROUP, len(at) - c)
        X = np.zeros((factor.pattern.size, GROUP))
        X[at[c : c + count], np.arange(count)] = 1.0
        solve_group(fronts, factor.values, visited, X.reshape(-1), local)
        joint[:, c : c + count] = X[at, :count]
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


def _fronts_of(factor: BlockCholesky, blocks: Index) -> Index:
    """Return the front in which each block is eliminated."""
    position = np.empty_like(factor.order)
    position[factor.order] = np.arange(len(position))
    row = np.append(0, np.cumsum(factor.pattern.sizes[factor.order]))[position[blocks]]
    return np.searchsorted(factor.fronts.pivot, row, side="right") - 1


def _ways_up(fronts: Fronts, first: Index) -> Index:
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


def _selected_inverse(factor: BlockCholesky) -> Array:
    """Return the pivot rows of all fronts of Z = A⁻¹, laid out as the factor; Z11 is full."""
    fronts = factor.fronts
    place, size = _places(fronts)
    widest = int(fronts.width.max(initial=0))
    inverse = np.empty(int(fronts.start[-1]))
    _invert_fronts(
        fronts,
        factor.values,
        place,
        np.empty(size),
        np.empty((3, (PANEL + SLACK_ROWS) * (widest + SLACK_ROWS))),
        np.empty(PANEL * PANEL),
        np.empty(4 * TILE),
        inverse,
    )
    return inverse


@kernel
def _places(fronts: Fronts) -> tuple[Index, int]:
    """Return where each f x f front of Z waits for its children: behind its parent's."""
    place, size = np.zeros(len(fronts.parent), np.int64), 0
    for s in range(len(fronts.parent) - 1, -1, -1):
        above = fronts.parent[s]
        if above >= 0:
            place[s] = place[above] + fronts.width[above] ** 2
        size = max(size, place[s] + fronts.width[s] ** 2)
    return place, size


@kernel(reorder=True)
def _invert_fronts(
    fronts: Fronts,
    factor: Array,
    place: Index,
    stack: Array,
    rows: Array,
    corner: Array,
    tile: Array,
    inverse: Array,
) -> None:
    """Write Z of all fronts, from the roots down."""
    pivot, width, parent, begin = fronts.pivot, fronts.width, fronts.parent, fronts.start
    run, runs, W, W_T, Z = fronts.run, fronts.runs, rows[0], rows[1], rows[2]
    for s in range(len(width) - 1, -1, -1):
        k, f, start, at, above = pivot[s + 1] - pivot[s], width[s], begin[s], place[s], parent[s]
        if above >= 0:
            to = at + k * (f + 1)
            _take_border(runs, run[s], run[s + 1], stack, place[above], width[above], to, f)
        for end in range(k, 0, -PANEL):  # what is behind the panel is its border
            first = max(end - PANEL, 0)
            skip, p, m = first * (f + 1), end - first, f - end
            _border_rows(factor, start + skip, p, m, f, stack, at + skip, W, W_T, Z, tile)
            _pivot_block(factor, start + skip, p, m, f, stack, at + skip, W, Z, corner)
        for i in range(k * f):
            inverse[U(start + i)] = stack[U(at + i)]


@kernel
def _take_border(
    runs: Index, first: int, last: int, stack: Array, source: int, g: int, to: int, f: int
) -> None:
    """Copy Z22 of a front from its parent's Z: rows of g there, of f here."""
    for a in range(first, last):
        for x in range(runs[a, 0]):
            done = to
            for b in range(first, last):
                row = source + (runs[a, 1] + x) * g + runs[b, 1]
                for j in range(runs[b, 0]):
                    stack[U(done + j)] = stack[U(row + j)]
                done += runs[b, 0]
            to += f


@kernel(reorder=True)
def _border_rows(
    factor: Array,
    start: int,
    k: int,
    m: int,
    f: int,
    stack: Array,
    place: int,
    W: Array,
    W_T: Array,
    Z: Array,
    tile: Array,
) -> None:
    """W = U11⁻¹ U12 and Z12 = −W Z22, k x m each, in fronts whose rows are f apart."""
    edge = np.int64(0)
    for p in range(k - 1, -1, -1):
        row = start + p * f
        for j in range(m):
            W[U(p * m + j)] = factor[U(row + k + j)]
        for q in range(p + 1, k):
            u = factor[row + q]
            for j in range(m):
                W[U(p * m + j)] -= u * W[U(q * m + j)]
        scale = 1.0 / factor[row + p]
        for j in range(m):
            W[U(p * m + j)] *= scale
            W_T[j * k + p] = W[U(p * m + j)]
    for i in range(m * k, (m + SLACK_ROWS) * k + SLACK_ROWS):
        W_T[i] = 0.0
    for i in range((k + SLACK_ROWS) * m):
        Z[i] = 0.0
    for a in range(0, m, 4):
        for c in range(0, m, TILE):
            width = min(TILE, m - c)
            for q in range(4):
                row = place + (k + a + q) * f + k + c
                for j in range(width):
                    tile[U(q * TILE + j)] = stack[U(row + j)] if a + q < m else 0.0
            for r in range(0, k, 4):
                take_off(Z, r * m + c, m, tile, edge, W_T, a * k + r, k, width)
    for p in range(k):
        for j in range(m):
            stack[place + p * f + k + j] = stack[place + (k + j) * f + p] = Z[p * m + j]


@kernel(reorder=True)
def _pivot_block(
    factor: Array,
    start: int,
    k: int,
    m: int,
    f: int,
    stack: Array,
    place: int,
    W: Array,
    Z: Array,
    V: Array,
) -> None:
    """Z11 = V Vᵀ − W Z12ᵀ with V = U11⁻¹, k x k."""
    for p in range(k - 1, -1, -1):
        row = start + p * f
        for j in range(k - p):
            V[U(p * k + p + j)] = 0.0
        V[p * k + p] = 1.0
        for q in range(p + 1, k):
            u = factor[row + q]
            for j in range(k - q):
                V[U(p * k + q + j)] -= u * V[U(q * k + q + j)]
        scale = 1.0 / factor[row + p]
        for j in range(k - p):
            V[U(p * k + p + j)] *= scale
    for p in range(k):
        for r in range(p, k):
            total = 0.0
            for j in range(k - r):
                total += V[U(p * k + r + j)] * V[U(r * k + r + j)]
            for j in range(m):
                total -= W[U(p * m + j)] * Z[U(r * m + j)]
            stack[place + p * f + r] = stack[place + r * f + p] = total


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
    _entries_up(factor.fronts)
