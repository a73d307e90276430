"""The reduced matrix of bundle adjustment, S = A + λ diag A - V Vᵀ, in blocks.

Two views share a block of S where they see a common point. Point m, touching n blocks, takes away
n (n + 1) / 2 products V_i V_jᵀ; they are summed block row by block row, all points of view i before
those of view i + 1, so that what is being written (one row) stays in the nearest cache, and every
sum has one order. Only the upper half is made, in the order of `BlockPattern`.

Cost: 6 d² flops per pair of views and common point, d = 6 or 9.

Reference: B. Triggs et al., "Bundle adjustment - a modern synthesis", 1999, section 6; K. Konolige,
"Sparse sparse bundle adjustment", BMVC 2010.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.backend.adjustment.layout import Blocks, Incidences, Layout
from odomap.backend.adjustment.normal import System
from odomap.backend.sparse.blocks import BlockPattern
from odomap.kernels import kernel

__all__ = ["add_couplings", "damped_diagonal", "num_pairs", "pattern_of", "reduced_matrix"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def pattern_of(layout: Layout, lens: Index) -> BlockPattern:
    """Return where the reduced matrix has blocks.

    Args:
        layout: of the problem.
        lens: (K,) of each view; a pose and the lens it looks through always share a block.
    """
    sizes, partner = layout.blocks.size, _partners(layout, lens)
    count = len(sizes)
    row_start, mark = np.zeros(count + 1, np.int64), np.full(count, -1)
    total = _neighbours(layout.incidences, partner, mark, row_start, np.empty(0, np.int64))
    second = np.empty(total, np.int64)
    mark[:] = -1
    _neighbours(layout.incidences, partner, mark, row_start, second)
    key = np.sort(np.repeat(np.arange(count), np.diff(row_start)) * count + second)
    return BlockPattern(sizes, key // max(count, 1), key % max(count, 1))


def num_pairs(layout: Layout, lens: Index) -> int:
    """Return how many blocks the reduced matrix has above its diagonal, before it is made."""
    count = len(layout.blocks.size)
    row_start, mark = np.zeros(count + 1, np.int64), np.full(count, -1)
    nowhere = np.empty(0, np.int64)
    return _neighbours(layout.incidences, _partners(layout, lens), mark, row_start, nowhere)


def _partners(layout: Layout, lens: Index) -> Index:
    """Return the block of the lens each pose looks through, -1 for none or its own."""
    blocks = layout.blocks
    partner = np.full(len(blocks.size), -1)
    if not layout.is_joined:
        is_block = blocks.pose >= 0
        partner[blocks.pose[is_block]] = blocks.lens[lens[is_block]]
    return partner


@kernel
def _neighbours(
    incidences: Incidences, partner: Index, mark: Index, row_start: Index, second: Index
) -> int:
    """List the blocks j > i that share a point with block i; only count into an empty list.

    row_start[i]: where the list of i begins. Returns how many there are.
    """
    total = 0
    for i in range(len(partner)):
        row_start[i] = total
        if partner[i] >= 0:
            mark[partner[i]] = i
            if len(second):
                second[total] = partner[i]
            total += 1
        for q in range(incidences.block_start[i], incidences.block_start[i + 1]):
            e = incidences.by_block[q]
            for f in range(e + 1, incidences.start[incidences.point[e] + 1]):
                j = incidences.block[f]
                if mark[j] != i:
                    mark[j] = i
                    if len(second):
                        second[total] = j
                    total += 1
    row_start[len(partner)] = total
    return total


@kernel
def damped_diagonal(blocks: Blocks, A: Array, damping: float, out: Array) -> None:
    """Write the diagonal blocks A + λ diag A in full; the identity where held or nothing is seen.

    What kernels fill of A is its lower triangle. What follows the diagonal blocks is zeroed.
    """
    for i in range(len(A), len(out)):
        out[i] = 0.0
    for b in range(len(blocks.size)):
        size, at, row = blocks.size[b], blocks.at[b], blocks.row[b]
        for i in range(size):
            for j in range(i):
                value = A[at + i * size + j]
                out[at + i * size + j] = value
                out[at + j * size + i] = value
            value = A[at + i * size + i]
            is_loose = blocks.is_held[row + i] or not value > 0.0
            out[at + i * size + i] = 1.0 if is_loose else value * (1.0 + damping)


@kernel(reorder=True)
def _subtract_product(V: Array, at: int, size: int, to: int, width: int, S: Array, s: int) -> None:
    """S (size, width) -= Vᵢ Vⱼᵀ of the slabs at `at` and `to`."""
    for i in range(size):
        v0, v1, v2 = V[at + i], V[at + size + i], V[at + 2 * size + i]
        for j in range(width):
            S[s + i * width + j] -= (
                v0 * V[to + j] + v1 * V[to + width + j] + v2 * V[to + 2 * width + j]
            )


@kernel(reorder=True)
def _subtract_6(V: Array, at: int, to: int, S: Array, s: int) -> None:
    """`_subtract_product` of two blocks of 6, unrolled."""
    A, B, C = V[at : at + 18], V[to : to + 18], S[s : s + 36]
    for i in range(6):
        v0, v1, v2 = A[i], A[6 + i], A[12 + i]
        for j in range(6):
            C[6 * i + j] -= v0 * B[j] + v1 * B[6 + j] + v2 * B[12 + j]


@kernel(reorder=True)
def _subtract_9(V: Array, at: int, to: int, S: Array, s: int) -> None:
    """`_subtract_product` of two blocks of 9, unrolled."""
    A, B, C = V[at : at + 27], V[to : to + 27], S[s : s + 81]
    for i in range(9):
        v0, v1, v2 = A[i], A[9 + i], A[18 + i]
        for j in range(9):
            C[9 * i + j] -= v0 * B[j] + v1 * B[9 + j] + v2 * B[18 + j]


@kernel
def reduced_matrix(
    blocks: Blocks,
    incidences: Incidences,
    second: Index,
    row_pair: Index,
    pair_start: Index,
    system: System,
    slot: Index,
    S: Array,
    s: Array,
) -> None:
    """Take V Vᵀ from S, whose diagonal blocks are filled, and write s = a - V y.

    row_pair (B + 1,): pairs of block row i; slot (B,) is room to note where each block is.
    """
    _, _, _, sizes, rows, block_at, _ = blocks
    first, touched, point, slab_at, by_block, block_start = incidences
    _, _, _, a, V, _, y, _, _ = system
    for i in range(len(sizes)):
        size, row = sizes[i], rows[i]
        for p in range(row_pair[i], row_pair[i + 1]):
            slot[second[p]] = pair_start[p]
        slot[i] = block_at[i]
        for k in range(size):
            s[row + k] = a[row + k]
        for q in range(block_start[i], block_start[i + 1]):
            e = by_block[q]
            m, at = point[e], slab_at[e]
            for k in range(size):
                s[row + k] -= (
                    V[at + k] * y[m, 0]
                    + V[at + size + k] * y[m, 1]
                    + V[at + 2 * size + k] * y[m, 2]
                )
            for f in range(e, first[m + 1]):
                j = touched[f]
                to, width = slab_at[f], sizes[j]
                if size == 9 and width == 9:
                    _subtract_9(V, at, to, S, slot[j])
                elif size == 6 and width == 6:
                    _subtract_6(V, at, to, S, slot[j])
                else:
                    _subtract_product(V, at, size, to, width, S, slot[j])


@kernel
def add_couplings(
    blocks: Blocks, lens: Index, coupling: Array, pair: Index, pair_start: Index, S: Array
) -> None:
    """Add the blocks between poses and the lenses they look through; pair (K,) or -1."""
    for i in range(len(pair)):
        if pair[i] >= 0:
            width = blocks.size[blocks.lens[lens[i]]]
            at = pair_start[pair[i]]
            for a in range(6):
                for b in range(width):
                    S[at + a * width + b] += coupling[i, a, b]
