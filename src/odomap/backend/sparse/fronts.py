"""The dense arithmetic of one front: pivots are eliminated four at a time.

A front is a symmetric matrix of which the upper half is held in two pieces, both row-major: k pivot
rows of width f = k + m in the factor, and the m x m rest on a stack,

    | A11  A12 |     | U11ᵀ      | | U11  U12 |
    |      A22 |  =  | U12ᵀ   I  | |      S   |,      S = A22 − U12ᵀ U12.

Rows of four pivots are finished (each takes off the pivots before it, and is divided by the root of
its diagonal), copied into a small tile, and taken off all rows below. That last step is nearly all
of the work, and its loop is written for the machine: four rows by four pivots give sixteen
multiplications and additions for twelve loads and stores; the tile has a width known to the
compiler and rows are a stride apart, so that it can prove them apart and add 4 or 8 numbers at
once; indices are unsigned, since signed ones may count from the end. Rows are updated from their
diagonal on, in fours: what that writes left of the diagonal and below the last row is never read,
and the arrays have room for it.

Cost: Σ_{p < k} (f − p)² operations, 10 to 18 a nanosecond from a hundred columns on.

Reference: Golub, Van Loan, "Matrix Computations", 4th ed., section 4.2.5 (block outer product).
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["SLACK_ROWS", "TILE", "eliminate", "take_off", "warm_up"]

Array = NDArray[np.float64]

TILE = 256  # columns of the tile: 4 x 256 numbers stay in the first cache
SLACK_ROWS = 4  # rows of the widest front that must follow each piece
ROUNDING = 1e-13  # a pivot that is less than this share of its diagonal has no digit left

U = np.uint64


@kernel(reorder=True)
def eliminate(
    factor: Array, start: int, k: int, f: int, stack: Array, rest: int, diagonal: Array, tile: Array
) -> int:
    """Factor a front in place; return the first pivot that is not positive, or −1.

    Args:
        factor: its pivot rows begin at `start`.
        k, f: pivots and width. stack: its rest begins at `rest`, with rows of f − k.
        diagonal: (k,) of A, before anything was taken off. tile: (4 TILE,).
    """
    m = f - k
    for p in range(0, k, 4):
        end = min(p + 4, k)
        failed = _finish_rows(factor, start, p, end, f, diagonal)
        if failed >= 0:
            return failed
        for c in range((p + 4 - end) * f):  # fewer than four: rows of zeros, where the next front
            factor[start + end * f + c] = 0.0  # is yet to come
        x = start + p * f  # the four rows
        for c in range(end, f, TILE):
            width = min(TILE, f - c)
            for q in range(4):
                for j in range(width):
                    tile[U(q * TILE + j)] = factor[U(x + q * f + c + j)]
            for r in range(end, min(k, c + width), 4):
                skip = max(r - c, 0)
                row = start + r * f + c + skip
                take_off(factor, row, f, tile, skip, factor, x + r, f, width - skip)
            for r in range(k, c + width, 4):
                skip = max(r - c, 0)
                row = rest + (r - k) * m + c + skip - k
                take_off(stack, row, m, tile, skip, factor, x + r, f, width - skip)
    return -1


@kernel(reorder=True)
def _finish_rows(factor: Array, start: int, p: int, end: int, f: int, diagonal: Array) -> int:
    """u_i = (a_i − Σ_{p ≤ q < i} u_qi u_q) / √pivot for rows p ≤ i < end; a failed row or −1."""
    for i in range(p, end):
        row, width = start + i * f + i, f - i
        for q in range(p, i):
            other = start + q * f + i
            u = factor[other]
            for j in range(width):
                factor[U(row + j)] -= u * factor[U(other + j)]
        pivot = factor[row]
        if not pivot > ROUNDING * abs(diagonal[i]) or not np.isfinite(pivot):
            return i
        scale = 1.0 / np.sqrt(pivot)
        for j in range(width):
            factor[U(row + j)] *= scale
    return -1


@kernel(reorder=True)
def take_off(
    F: Array, row: int, g: int, tile: Array, t: int, P: Array, x: int, f: int, width: int
) -> None:
    """F[r, j] −= Σ_{q < 4} P[q, r] tile[q, j] for four rows r; rows of F are g apart, of P f."""
    a0, a1, a2, a3 = P[x], P[x + f], P[x + 2 * f], P[x + 3 * f]
    b0, b1, b2, b3 = P[x + 1], P[x + f + 1], P[x + 2 * f + 1], P[x + 3 * f + 1]
    c0, c1, c2, c3 = P[x + 2], P[x + f + 2], P[x + 2 * f + 2], P[x + 3 * f + 2]
    d0, d1, d2, d3 = P[x + 3], P[x + f + 3], P[x + 2 * f + 3], P[x + 3 * f + 3]
    for j in range(width):
        t0, t1 = tile[U(t + j)], tile[U(t + TILE + j)]
        t2, t3 = tile[U(t + 2 * TILE + j)], tile[U(t + 3 * TILE + j)]
        F[U(row + j)] -= a0 * t0 + a1 * t1 + a2 * t2 + a3 * t3
        F[U(row + g + j)] -= b0 * t0 + b1 * t1 + b2 * t2 + b3 * t3
        F[U(row + 2 * g + j)] -= c0 * t0 + c1 * t1 + c2 * t2 + c3 * t3
        F[U(row + 3 * g + j)] -= d0 * t0 + d1 * t1 + d2 * t2 + d3 * t3


def warm_up() -> None:
    """Compile the kernels of this module."""
    eliminate(np.ones(32), 0, 1, 2, np.ones(32), 0, np.ones(1), np.empty(4 * TILE))
