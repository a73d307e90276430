"""Entries of the inverse in the pattern of the factor, from the root of the tree down.

From A = Uᵀ U, Z = A⁻¹ obeys U Z = U⁻ᵀ, whose right side is lower triangular: each row of U, read
from the right, gives a row of Z from rows below it. For the pivot rows of one front, with Z22 the
part of Z that belongs to the front's border,

    W = U11⁻¹ U12,    Z12 = −W Z22,    Z11 = (U11ᵀ U11)⁻¹ − W Z12ᵀ.

The border lies within the parent's front, so going from the roots down, Z22 is always at hand; it
is copied along the runs by which the child's update went up. A wide front is taken in panels of 32
pivots, of which each has those behind it for its border: nearly all of the work is then W Z22, and
runs through the same tile as the factorisation (see `fronts`). Waiting fronts lie one behind the
other, from a root to where the walk is.

Cost: about two factorisations.

Reference: Erisman, Tinney, "On Computing Certain Elements of the Inverse of a Sparse Matrix",
Communications of the ACM 18(3), 1975 (after Takahashi, Fagan, Chin, 1973).
"""

import numpy as np
from numpy.typing import NDArray

from odomap.backend.sparse.blocks import BlockPattern
from odomap.backend.sparse.fronts import SLACK_ROWS, TILE, take_off
from odomap.backend.sparse.symbolic import Fronts, analyse
from odomap.kernels import kernel

__all__ = ["selected_inverse", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

PANEL = 32  # pivots whose rows of the inverse are found together

U = np.uint64


def selected_inverse(fronts: Fronts, factor: Array) -> Array:
    """Return Z = A⁻¹ in the pivot rows of all fronts.

    Args:
        fronts: the plan. factor: (F,) the pivot rows of U, row-major, front by front.

    Returns:
        (start[-1],) laid out as the factor; Z11 is full.
    """
    place, size = _places(fronts)
    widest = int(fronts.width.max(initial=0))
    inverse = np.empty(int(fronts.start[-1]))
    _invert_fronts(
        fronts,
        factor,
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
    edge = k - k  # a literal zero would compile `take_off` once more
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


def warm_up() -> None:
    """Compile the kernels of this module."""
    fronts = analyse(BlockPattern.of([1, 1], [0], [1]), np.arange(2))
    selected_inverse(fronts, np.array([1.0, 0.0, 0.0, 1.0]))
