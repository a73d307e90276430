"""Sparse Cholesky as a sequence of dense fronts, and the two substitutions that follow.

Fronts are visited in postorder. Each gathers the blocks of A in its pivot rows and the update
matrices S of its children, which lie on top of a stack (extend-add: a child's border is part of the
parent's front), eliminates its pivots, and leaves its own S on the stack in place of theirs:

    front(s) = A[pivots(s), :] + Σ_{children c} S_c,      S_s = A22 − U12ᵀ U12.

All sparse indexing is done here, once for each entry of a border; the arithmetic is dense (see
`fronts`). Waiting updates are packed: row r holds its m − r entries from the diagonal on.

With A = Uᵀ U, U y = x is solved from the last front to the first and Uᵀ y = b from the first to the
last, each reading U once. Several right-hand sides go through in groups of four.

Cost: Σ over fronts of Σ_{p < k} (f − p)² for the factor, 4 operations an entry of U for a solution.

Reference: Duff, Reid, "The Multifrontal Solution of Indefinite Sparse Symmetric Linear Equations",
ACM TOMS 9(3), 1983; Liu, "The Multifrontal Method for Sparse Matrix Solution", SIAM Review 34(1),
1992.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.backend.sparse.blocks import BlockPattern
from odomap.backend.sparse.fronts import SLACK_ROWS, TILE, eliminate
from odomap.backend.sparse.symbolic import Fronts, analyse
from odomap.kernels import kernel

__all__ = ["GROUP", "factor_fronts", "solve_fronts", "solve_group", "stack_size", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

GROUP = 4  # right-hand sides solved together, in `solve_group`

U = np.uint64


@kernel
def stack_size(fronts: Fronts) -> int:
    """Return the most numbers ever on the stack, with what rows in fours write past the end."""
    waiting, top, most = np.empty(len(fronts.parent) + 1, np.int64), 0, 0
    size = 0
    for s in range(len(fronts.parent)):
        m = fronts.border[s + 1] - fronts.border[s]
        most = max(most, size + m * (m + SLACK_ROWS))
        for _ in range(fronts.children[s]):
            top -= 1
            size -= waiting[top]
        waiting[top] = (m * (m + 1)) // 2
        size += waiting[top]
        top += 1
    return most + SLACK_ROWS


@kernel(reorder=True)
def factor_fronts(
    fronts: Fronts, values: Array, shift: float, factor: Array, stack: Array, scratch: Array
) -> int:
    """Write U of A + shift I = Uᵀ U; return the position of the first bad pivot, or −1.

    `stack` is (stack_size,), `scratch` (4 TILE + widest front,).
    """
    pivot, width, begin, border = fronts.pivot, fronts.width, fronts.start, fronts.border
    entry, entries, run, runs = fronts.entry, fronts.entries, fronts.run, fronts.runs
    tile, diagonal = scratch[: 4 * TILE], scratch[4 * TILE :]
    owner, top, end = np.empty(len(width) + 1, np.int64), 0, begin[0]
    for s in range(len(width)):
        k, f, start = pivot[s + 1] - pivot[s], width[s], begin[s]
        m, rest = f - k, end
        for i in range(k * f):
            factor[U(start + i)] = 0.0
        for r in range(m):
            for c in range(m - r):
                stack[U(rest + r * (m + 1) + c)] = 0.0
        for e in range(entry[s], entry[s + 1]):
            _add_block(entries, e, values, factor, f)
        for p in range(k):
            factor[start + p * (f + 1)] += shift
            diagonal[p] = factor[start + p * (f + 1)]
        for _ in range(fronts.children[s]):
            top -= 1
            c = owner[top]
            size = border[c + 1] - border[c]
            end -= (size * (size + 1)) // 2
            _extend_add(runs, run[c], run[c + 1], stack, end, factor, start, k, f, rest)
        failed = eliminate(factor, start, k, f, stack, rest, diagonal, tile)
        if failed >= 0:
            return int(pivot[s] + failed)
        for r in range(m):  # down to where the children's were, and packed
            for c in range(m - r):
                stack[U(end + c)] = stack[U(rest + r * (m + 1) + c)]
            end += m - r
        owner[top] = s
        top += 1
    return -1


@kernel
def _add_block(entries: Index, e: int, values: Array, factor: Array, f: int) -> None:
    """Copy one block of A into its front, transposed if its rows are eliminated later."""
    source, place = entries[e, 0], entries[e, 3]
    down, right = (1, f) if entries[e, 4] == 1 else (f, 1)
    for a in range(entries[e, 1]):
        for b in range(entries[e, 2]):
            factor[place + a * down + b * right] = values[source]
            source += 1


@kernel(reorder=True)
def _extend_add(
    runs: Index,
    first: int,
    last: int,
    stack: Array,
    source: int,
    factor: Array,
    start: int,
    k: int,
    f: int,
    rest: int,
) -> None:
    """Add a child's packed update, at `source`, to its parent's front, run by run."""
    for a in range(first, last):
        for x in range(runs[a, 0]):
            row = runs[a, 1] + x
            for b in range(a, last):
                skip = x if b == a else 0
                column, count = runs[b, 1] + skip, runs[b, 0] - skip
                if row < k:
                    to = start + row * f + column
                    for j in range(count):
                        factor[U(to + j)] += stack[U(source + j)]
                else:
                    to = rest + (row - k) * (f - k) + column - k
                    for j in range(count):
                        stack[U(to + j)] += stack[U(source + j)]
                source += count


@kernel(reorder=True)
def solve_fronts(fronts: Fronts, factor: Array, x: Array, local: Array) -> None:
    """Overwrite x (n,), in the order of elimination, with the solution of Uᵀ U y = x."""
    pivot, width, start, rows = fronts.pivot, fronts.width, fronts.start, fronts.border_rows
    count = len(width)
    for s in range(count):
        k, f, first = pivot[s + 1] - pivot[s], width[s], pivot[s]
        border = fronts.border[s] - k
        for j in range(f):
            local[j] = 0.0
        for p in range(k):
            row = start[s] + p * f
            y = (x[first + p] - local[p]) / factor[row + p]
            x[first + p] = y
            for j in range(f - p - 1):
                local[U(p + 1 + j)] += y * factor[U(row + p + 1 + j)]
        for j in range(k, f):
            x[rows[border + j]] -= local[j]
    for s in range(count - 1, -1, -1):
        k, f, first = pivot[s + 1] - pivot[s], width[s], pivot[s]
        border = fronts.border[s] - k
        for j in range(k, f):
            local[j] = x[rows[border + j]]
        for p in range(k - 1, -1, -1):
            row = start[s] + p * f
            total = x[first + p]
            for j in range(f - p - 1):
                total -= local[U(p + 1 + j)] * factor[U(row + p + 1 + j)]
            local[p] = total / factor[row + p]
            x[first + p] = local[p]


@kernel(reorder=True)
def solve_group(fronts: Fronts, factor: Array, visited: Index, x: Array, local: Array) -> None:
    """Do as `solve_fronts` with four right-hand sides, x (4 n,), one after the other.

    `visited` names the fronts that take part, ascending, and with each its parent. From right-hand
    sides that are zero in all others follow solutions that are right in these.
    """
    pivot, width, start, rows = fronts.pivot, fronts.width, fronts.start, fronts.border_rows
    n = len(fronts.rows)
    for s in visited:
        k, f, first = pivot[s + 1] - pivot[s], width[s], pivot[s]
        border = fronts.border[s] - k
        for j in range(4 * f):
            local[j] = 0.0
        for p in range(k):
            u, at, to = start[s] + p * f + p, first + p, p
            scale = 1.0 / factor[u]
            y0, y1 = (x[at] - local[to]) * scale, (x[at + n] - local[to + f]) * scale
            y2 = (x[at + 2 * n] - local[to + 2 * f]) * scale
            y3 = (x[at + 3 * n] - local[to + 3 * f]) * scale
            x[at], x[at + n], x[at + 2 * n], x[at + 3 * n] = y0, y1, y2, y3
            for j in range(1, f - p):
                local[U(to + j)] += y0 * factor[U(u + j)]
                local[U(to + f + j)] += y1 * factor[U(u + j)]
                local[U(to + 2 * f + j)] += y2 * factor[U(u + j)]
                local[U(to + 3 * f + j)] += y3 * factor[U(u + j)]
        for g in range(4):
            for j in range(k, f):
                x[g * n + rows[border + j]] -= local[g * f + j]
    for s in visited[::-1]:
        k, f, first = pivot[s + 1] - pivot[s], width[s], pivot[s]
        border = fronts.border[s] - k
        for g in range(4):
            for j in range(k, f):
                local[g * f + j] = x[g * n + rows[border + j]]
        for p in range(k - 1, -1, -1):
            u, at, to = start[s] + p * f + p, first + p, p
            scale = 1.0 / factor[u]
            y0, y1, y2, y3 = x[at], x[at + n], x[at + 2 * n], x[at + 3 * n]
            for j in range(1, f - p):
                y0 -= factor[U(u + j)] * local[U(to + j)]
                y1 -= factor[U(u + j)] * local[U(to + f + j)]
                y2 -= factor[U(u + j)] * local[U(to + 2 * f + j)]
                y3 -= factor[U(u + j)] * local[U(to + 3 * f + j)]
            y0, y1, y2, y3 = y0 * scale, y1 * scale, y2 * scale, y3 * scale
            x[at], x[at + n], x[at + 2 * n], x[at + 3 * n] = y0, y1, y2, y3
            local[to], local[to + f], local[to + 2 * f], local[to + 3 * f] = y0, y1, y2, y3


def warm_up() -> None:
    """Compile the kernels of this module."""
    pattern = BlockPattern.of([1, 1], [0], [1])
    fronts = analyse(pattern, np.arange(2))
    factor, x = np.zeros(64), np.ones(2 * GROUP)
    factor_fronts(
        fronts, np.array([2.0, 2.0, 1.0]), 0.0, factor, np.zeros(64), np.zeros(4 * TILE + 8)
    )
    solve_fronts(fronts, factor, x[:2], np.zeros(2))
    solve_group(fronts, factor, np.arange(len(fronts.parent)), x, np.zeros(2 * GROUP))
    stack_size(fronts)
