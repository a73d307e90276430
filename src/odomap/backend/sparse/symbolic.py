"""What a Cholesky factorisation will do, found from the pattern alone: tree, supernodes, maps.

Column j of L is needed first by column parent(j) = min { i > j : L_ij ≠ 0 }. These links are the
elimination tree; column j of L has a block in row i exactly if j lies on the way from some k with
A_ik ≠ 0 up to i, so walking those ways (each stops where an earlier one went) writes the structure
of L without ever forming it. Children are numbered before their parents (postorder), which changes
neither fill nor work.

Neighbouring columns of equal structure form a *supernode* and are factored as one dense front: k
pivot rows and m rows of border. Small fronts cost more in moving numbers than in arithmetic, so a
child is merged into its parent, zeros and all, where a model of the time says that this pays:

    time(k, m)  =  a + b (k + m)² + c Σ_{p < k} (k + m − p)².

Cost: O(blocks of L). All arrays are int64; positions are those after reordering.

Reference: Liu, "The Role of Elimination Trees in Sparse Factorization", SIAM J. Matrix Analysis
and Applications 11(1), 1990; Ashcraft, Grimes, "The Influence of Relaxed Supernode Partitions on
the Multifrontal Method", ACM TOMS 15(4), 1989.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.backend.sparse.blocks import BlockPattern
from odomap.kernels import kernel

__all__ = ["Fronts", "analyse", "warm_up"]

Index = NDArray[np.int64]

# The model of a front's time in nanoseconds: per front, per entry, per pivot and entry.
FRONT_NS, ENTRY_NS, UPDATE_NS = 300.0, 0.35, 0.08


class Fronts(NamedTuple):
    """The plan of a multifrontal factorisation: S fronts in postorder, over n scalar rows.

    A front of k pivots and m border rows keeps its pivot rows, k x (k + m) row-major, in the
    factor; its update matrix, m x m, waits on a stack until the parent takes it.

    Attributes:
        order: (N,) block eliminated at each position.
        rows: (n,) scalar row of A at each position.
        parent: (S,) front that takes the update, −1 for a root.
        children: (S,) how many updates it takes itself: the last ones on the stack.
        pivot: (S + 1,) first pivot's position.
        width: (S,) k + m.
        start: (S + 1,) where in the factor its rows begin.
        border: (S + 1,) where in `border_rows` its border begins.
        border_rows: (B,) positions of the border's scalar rows, ascending.
        run: (S + 1,) where in `runs` its runs begin.
        runs: (R, 2) runs of the border that stay together in the parent's front: their length, and
            their first row there.
        entry: (S + 1,) where in `entries` its blocks of A begin.
        entries: (N + P, 5): place in `values`, rows and columns there, place in the factor, and
            whether it is written transposed.
    """

    order: Index
    rows: Index
    parent: Index
    children: Index
    pivot: Index
    width: Index
    start: Index
    border: Index
    border_rows: Index
    run: Index
    runs: Index
    entry: Index
    entries: Index


def analyse(pattern: BlockPattern, order: Index) -> Fronts:
    """Return the plan for eliminating the blocks of a pattern in (nearly) the given order.

    Args:
        pattern: of the matrix.
        order: (N,) permutation of the blocks; the plan's own is an equivalent one.
    """
    order = np.ascontiguousarray(order, dtype=np.int64)
    first, second, sizes = pattern.first, pattern.second, pattern.sizes
    start, lower = _lower_neighbours(_inverse(order), first, second)
    parent = _elimination_tree(start, lower)
    post = _postorder(parent)
    order, parent = order[post], _renumbered(parent, post)
    start, lower = _lower_neighbours(_inverse(order), first, second)
    below = _rows_below(start, lower, parent, sizes[order])
    front, front_parent = _supernodes(parent, sizes[order], below)
    post = _postorder(front_parent)
    front, front_parent = _inverse(post)[front], _renumbered(front_parent, post)
    within = np.argsort(front, kind="stable")
    order, front = order[within], front[within]
    return _plan(pattern, order, front, front_parent)


def _plan(pattern: BlockPattern, order: Index, front: Index, parent: Index) -> Fronts:
    """Return the plan, given the final order of blocks and the front of each position."""
    position, sizes, count = _inverse(order), pattern.sizes[order], len(parent)
    scalar = _starts(sizes)
    rows = np.repeat(pattern.row_start[order] - scalar[:-1], sizes) + np.arange(pattern.size)
    pivot = scalar[np.searchsorted(front, np.arange(count + 1))]
    start, lower = _lower_neighbours(position, pattern.first, pattern.second)
    border, border_rows = _borders(start, lower, front, parent, scalar)
    width = np.diff(pivot) + np.diff(border)
    factor_start = _starts(np.diff(pivot) * width)
    run, runs = _runs(parent, pivot, border, border_rows)
    entry, entries = _entries(
        (pattern.sizes, pattern.first, pattern.second),
        (pattern.diagonal_start, pattern.pair_start, np.zeros(count + 1, np.int64)),
        position,
        front,
        scalar,
        pivot,
        width,
        factor_start,
        border,
        border_rows,
    )
    children = np.bincount(parent[parent >= 0], minlength=count)
    return Fronts(
        order,
        rows,
        parent,
        children,
        pivot,
        width,
        factor_start,
        border,
        border_rows,
        run,
        runs,
        entry,
        entries,
    )


def _inverse(permutation: Index) -> Index:
    inverse = np.empty_like(permutation)
    inverse[permutation] = np.arange(len(permutation))
    return inverse


def _renumbered(parent: Index, post: Index) -> Index:
    """Return the parents of a forest whose nodes are numbered anew."""
    return np.append(_inverse(post), -1)[parent[post]]


def _starts(lengths: Index) -> Index:
    """Return where pieces of the given lengths begin, and after them where the last one ends."""
    return np.append(0, np.cumsum(lengths))


@kernel
def _lower_neighbours(position: Index, first: Index, second: Index) -> tuple[Index, Index]:
    """List for each position those of its neighbours that are eliminated before it."""
    start, lower = np.zeros(len(position) + 1, np.int64), np.empty(len(first), np.int64)
    for p in range(len(first)):
        start[max(position[first[p]], position[second[p]])] += 1
    end = 0
    for j in range(len(start)):
        end += start[j]
        start[j] = end
    for p in range(len(first)):  # from the end of each list to its beginning
        i, j = position[first[p]], position[second[p]]
        start[max(i, j)] -= 1
        lower[start[max(i, j)]] = min(i, j)
    return start, lower


@kernel
def _elimination_tree(start: Index, lower: Index) -> Index:
    """Write parent(j) of each column: each way up is shortened to its end so far (Liu)."""
    n = len(start) - 1
    parent, ancestor = np.full(n, -1), np.full(n, -1)
    for j in range(n):
        for p in range(start[j], start[j + 1]):
            i = lower[p]
            while ancestor[i] >= 0 and ancestor[i] != j:
                ancestor[i], i = j, ancestor[i]
            if ancestor[i] < 0:
                ancestor[i] = parent[i] = j
    return parent


@kernel
def _postorder(parent: Index) -> Index:
    """List the nodes of a forest, children before parents, each subtree together."""
    n = len(parent)
    child, sibling = np.full(n + 1, -1), np.full(n, -1)
    for i in range(n - 1, -1, -1):
        root = parent[i] if parent[i] >= 0 else n
        sibling[i], child[root] = child[root], i
    post, node, filled = np.empty(n, np.int64), n, 0
    while filled < n:
        while child[node] >= 0:  # down; each way is taken once
            below = child[node]
            child[node] = -1
            node = below
        post[filled] = node
        filled += 1
        node = sibling[node] if sibling[node] >= 0 else (parent[node] if parent[node] >= 0 else n)
    return post


@kernel
def _time(k: int, m: int) -> float:
    """Return a + b (k + m)² + c Σ_{m < q ≤ k + m} q², nanoseconds for a front."""
    f = float(k + m)
    total = f * (f + 1.0) * (2.0 * f + 1.0) - m * (m + 1.0) * (2.0 * m + 1.0)
    return FRONT_NS + ENTRY_NS * f * f + UPDATE_NS / 6.0 * total


@kernel
def _rows_below(start: Index, lower: Index, parent: Index, sizes: Index) -> Index:
    """Count the scalar rows that each column of L has below its diagonal block."""
    n = len(parent)
    below, mark = np.zeros(n, np.int64), np.full(n, -1)
    for i in range(n):
        mark[i] = i
        for p in range(start[i], start[i + 1]):
            j = lower[p]
            while mark[j] != i:
                mark[j] = i
                below[j] += sizes[i]
                j = parent[j]
    return below


@kernel
def _supernodes(parent: Index, sizes: Index, below: Index) -> tuple[Index, Index]:
    """Return the front of each column of a postordered matrix, and the parent of each front."""
    n, count = len(parent), 0
    front, k, m = np.empty(n, np.int64), np.zeros(n, np.int64), np.zeros(n, np.int64)
    for j in range(n):
        if j == 0 or parent[j - 1] != j or below[j - 1] != below[j] + sizes[j]:
            count += 1
        front[j] = count - 1
        k[count - 1] += sizes[j]
        m[count - 1] = below[j]
    above = np.full(count, -1)
    for j in range(n):
        if parent[j] >= 0 and front[parent[j]] != front[j]:
            above[front[j]] = front[parent[j]]
    merged = _merge(above, k, m)
    # Number what is left, in order; a merged front has the number of the one that took it.
    number, kept = np.empty(count, np.int64), 0
    for s in range(count):
        if merged[s] < 0:
            number[s] = kept
            kept += 1
    up = np.full(kept, -1)
    for s in range(count - 1, -1, -1):
        if merged[s] >= 0:
            number[s] = number[merged[s]]
        elif above[s] >= 0:
            up[number[s]] = number[above[s]]
    for j in range(n):
        front[j] = number[front[j]]
    return front, up


@kernel
def _merge(above: Index, k: Index, m: Index) -> Index:
    """Merge children into their parents where that saves time; return who took each, or −1."""
    count = len(above)
    child, sibling, merged = np.full(count, -1), np.full(count, -1), np.full(count, -1)
    for s in range(count):
        c = child[s]
        while c >= 0:
            if _time(k[c] + k[s], m[s]) < _time(k[c], m[c]) + _time(k[s], m[s]):
                k[s] += k[c]
                merged[c] = s
            c = sibling[c]
        if above[s] >= 0:
            sibling[s], child[above[s]] = child[above[s]], s
    return merged


@kernel
def _borders(
    start: Index, lower: Index, front: Index, parent: Index, scalar: Index
) -> tuple[Index, Index]:
    """List the scalar rows below each front: row i is below all fronts on the ways up to its own.

    Rows are visited in ascending order, so the lists are sorted.
    """
    count, mark = len(parent), np.empty(len(parent), np.int64)
    border, rows = np.zeros(count + 1, np.int64), np.empty(0, np.int64)
    for is_filling in range(2):
        mark[:] = -1
        for i in range(len(front)):
            mark[front[i]] = i
            for p in range(start[i], start[i + 1]):
                s = front[lower[p]]
                while mark[s] != i:
                    mark[s] = i
                    for row in range(scalar[i], scalar[i + 1]):
                        if is_filling:
                            rows[border[s]] = row
                        border[s] += 1
                    s = parent[s]
        if is_filling == 0:
            end = 0
            for s in range(count + 1):
                border[s], end = end, end + border[s]
            rows = np.empty(end, np.int64)
    for s in range(count, 0, -1):  # filling has moved each beginning to the next
        border[s] = border[s - 1]
    border[0] = 0
    return border, rows


@kernel
def _entries(
    where: tuple[Index, Index, Index],
    starts: tuple[Index, Index, Index],
    position: Index,
    front: Index,
    scalar: Index,
    pivot: Index,
    width: Index,
    factor_start: Index,
    border: Index,
    border_rows: Index,
) -> tuple[Index, Index]:
    """List where each block of A goes in the factor, those of one front together.

    `where` has sizes, first and second of the pattern, `starts` where a diagonal block and a pair
    begin in `values`, and an array of the fronts' size plus one, all zeros, to be filled.
    """
    sizes, first, second = where
    diagonal_start, pair_start, entry = starts
    n, P = len(sizes), len(first)
    entries = np.empty((n + P, 5), np.int64)
    for e in range(-n, P):  # the diagonal blocks are the negative ones
        i, j = (first[e], second[e]) if e >= 0 else (n + e, n + e)
        entry[front[min(position[i], position[j])]] += 1
    end = 0
    for s in range(len(entry)):
        end += entry[s]
        entry[s] = end
    for e in range(P - 1, -n - 1, -1):
        i, j = (first[e], second[e]) if e >= 0 else (n + e, n + e)
        low, high = min(position[i], position[j]), max(position[i], position[j])
        s, row = front[low], scalar[high]
        column = row - pivot[s]
        if row >= pivot[s + 1]:  # by bisection in the border
            b, beyond = border[s], border[s + 1]
            while b < beyond:
                middle = (b + beyond) // 2
                if border_rows[middle] < row:
                    b = middle + 1
                else:
                    beyond = middle
            column = pivot[s + 1] - pivot[s] + b - border[s]
        entry[s] -= 1
        to = entry[s]
        entries[to, 0] = pair_start[e] if e >= 0 else diagonal_start[n + e]
        entries[to, 1], entries[to, 2] = sizes[i], sizes[j]
        entries[to, 3] = factor_start[s] + (scalar[low] - pivot[s]) * width[s] + column
        entries[to, 4] = position[i] > position[j]
    return entry, entries


@kernel
def _runs(parent: Index, pivot: Index, border: Index, border_rows: Index) -> tuple[Index, Index]:
    """Find the runs of each front's border that are neighbours in its parent's front as well."""
    run, runs, count = (
        np.zeros(len(parent) + 1, np.int64),
        np.empty((len(border_rows), 2), np.int64),
        0,
    )
    for s in range(len(parent)):
        above = parent[s]
        q, previous = border[above], -2
        for p in range(border[s], border[s + 1]):
            row = border_rows[p]
            if row < pivot[above + 1]:
                place = row - pivot[above]
            else:
                while border_rows[q] != row:
                    q += 1
                place = pivot[above + 1] - pivot[above] + q - border[above]
            if place != previous + 1:
                runs[count, 0], runs[count, 1] = 0, place
                count += 1
            runs[count - 1, 0] += 1
            previous = place
        run[s + 1] = count
    return run, runs[:count].copy()


def warm_up() -> None:
    """Compile the kernels of this module."""
    analyse(BlockPattern.of([1, 1], [0], [1]), np.arange(2))
