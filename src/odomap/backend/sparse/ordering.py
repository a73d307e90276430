"""In which order to eliminate: approximate minimum degree on the graph of blocks.

Eliminating a node of a sparse symmetric matrix joins all its neighbours with each other; the order
decides how much fill that makes. Choosing the node of least degree at every step is simple and
good, but degrees of the filled graph are costly to keep. The quotient graph never stores fill: an
eliminated node e becomes an *element*, a clique given by the list L_e of its members, and each
variable i keeps a list of elements E_i and of original neighbours A_i,

    neighbours of i  =  A_i ∪ ⋃_{e ∈ E_i} L_e \\ i.

The new element L_p swallows those of its pivot p (absorption), so storage never grows. Degrees are
bounded from above, all |L_e \\ L_p| in one scan of the lists,

    d_i = min(rows left,  d_i + |L_p \\ i|,  |A_i| + |L_p \\ i| + Σ_{e ∈ E_i} |L_e \\ L_p|),

elements with L_e ⊆ L_p vanish (aggressive absorption), variables that see nothing but L_p are
eliminated with p (mass elimination), and variables with equal lists, found by hashing, become one.
A block of s rows starts as s such equal variables: sizes are the weights of all counts. Nodes with
very many neighbours would be scanned at every step; they are set aside and come last.

Cost: in practice O(P log P) or so; 10,000 poses with 20,000 edges take a few milliseconds.

Reference: Amestoy, Davis, Duff, "An Approximate Minimum Degree Ordering Algorithm", SIAM J. Matrix
Analysis and Applications 17(4), 1996.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.backend.sparse.blocks import BlockPattern
from odomap.kernels import kernel

__all__ = ["approximate_minimum_degree", "warm_up"]

Index = NDArray[np.int64]


def approximate_minimum_degree(pattern: BlockPattern) -> Index:
    """Return an elimination order of the blocks that keeps the Cholesky factor sparse.

    Args:
        pattern: of the matrix.

    Returns:
        (N,) block indices, first to be eliminated first.

    Example:
        >>> star = BlockPattern.of([3] * 5, [0, 0, 0, 0], [1, 2, 3, 4])
        >>> int(approximate_minimum_degree(star)[-1]) in (0, 1, 2, 3, 4)
        True
    """
    n = len(pattern.sizes)
    degree = np.bincount(np.concatenate([pattern.first, pattern.second]), minlength=n)
    weight = np.where(degree > max(16.0, 10.0 * np.sqrt(n)), 0, pattern.sizes)
    absorbed, rank = np.full(n, -1), np.full(n, n)
    rank[weight == 0] += degree[weight == 0]  # the densest last of all
    _order(pattern.first, pattern.second, weight, absorbed, rank)
    pivot = _roots(absorbed)
    return np.argsort(rank[pivot], kind="stable")


@kernel
def _roots(parent: Index) -> Index:
    """Follow each absorbed variable to what absorbed it, and on to the pivot."""
    root = np.empty(len(parent), np.int64)
    for i in range(len(parent)):
        r = i
        while parent[r] >= 0:
            r = parent[r]
        root[i] = r
        j = i
        while parent[j] >= 0:  # shorten the way for those who come after
            parent[j], j = r, parent[j]
    return root


@kernel
def _neighbours(
    first: Index, second: Index, weight: Index, begin: Index, length: Index, degree: Index
) -> Index:
    """Write the lists A_i into one workspace, with half as much room again for elements."""
    n, total = len(weight), 0
    for p in range(len(first)):
        i, j = first[p], second[p]
        if weight[i] > 0 and weight[j] > 0:
            length[i] += 1
            length[j] += 1
            total += 2
    work = np.empty(total + total // 2 + 2 * n, np.int64)
    total = 0
    for i in range(n):
        begin[i] = total
        total += length[i]
        length[i] = 0
    for p in range(len(first)):
        i, j = first[p], second[p]
        if weight[i] > 0 and weight[j] > 0:
            work[begin[i] + length[i]] = j
            work[begin[j] + length[j]] = i
            length[i] += 1
            length[j] += 1
            degree[i] += weight[j]
            degree[j] += weight[i]
    return work


@kernel
def _compact(begin: Index, length: Index, work: Index, spare: Index) -> int:
    """Copy all lists that are still alive to `spare`, one after another; return where they end."""
    free = 0
    for i in range(len(begin)):
        old = begin[i]
        begin[i] = free
        for p in range(old, old + length[i]):
            spare[free] = work[p]
            free += 1
    return free


@kernel
def _order(first: Index, second: Index, weight: Index, absorbed: Index, rank: Index) -> None:
    """Write rank[p] of each pivot p, and into which variable or pivot each other is absorbed.

    In the loop weight[i] > 0 says that i is a variable of its own, < 0 that it is in the new L_p,
    and 0 that it is gone; mark[e] = 0 that the element e is gone. Variables of one degree are
    linked in both directions from head[degree].
    """
    n, total = len(weight), weight.sum()
    begin, length, elements = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n, np.int64)
    degree, mark = np.zeros(n, np.int64), np.zeros(n, np.int64)
    work = _neighbours(first, second, weight, begin, length, degree)
    spare, free = np.empty(len(work), np.int64), length.sum()
    head, after, before = np.full(total + 1, -1), np.full(n, -1), np.full(n, -1)
    bucket, twin, code = np.full(n, -1), np.full(n, -1), np.zeros(n, np.int64)
    for i in range(n):
        if weight[i] > 0:
            after[i] = head[degree[i]]
            if after[i] >= 0:
                before[after[i]] = i
            head[degree[i]] = i
    stamp, least, left, step = total + 1, 0, total, 0
    while left > 0:
        while head[least] < 0:
            least += 1
        pivot = head[least]
        head[least] = after[pivot]
        if after[pivot] >= 0:
            before[after[pivot]] = -1
        rank[pivot] = step
        step += 1
        room = length[pivot]
        for p in range(begin[pivot], begin[pivot] + elements[pivot]):
            room += length[work[p]]
        if free + min(room, n) > len(work):
            free = _compact(begin, length, work, spare)
            work, spare = spare, work
        left -= weight[pivot]
        weight[pivot] = 0
        size = _form_element(
            pivot, free, begin, length, elements, weight, degree, mark, work, head, after, before
        )
        end = free + length[pivot]
        # What each neighbouring element has outside the new one: mark − stamp = |L_e \ L_p|.
        for p in range(free, end):
            i = work[p]
            for q in range(begin[i], begin[i] + elements[i]):
                e = work[q]
                if mark[e] >= stamp:
                    mark[e] += weight[i]
                elif mark[e] > 0:
                    mark[e] = degree[e] + stamp + weight[i]
        mark[pivot] = stamp  # alive; not in any list yet
        gone = _renew_lists(
            pivot, free, end, stamp, begin, length, elements, weight, degree, mark, work, absorbed
        )
        size -= gone
        left -= gone
        stamp = _merge_twins(
            free,
            end,
            stamp + total + 1,
            begin,
            length,
            elements,
            weight,
            mark,
            work,
            bucket,
            twin,
            code,
            absorbed,
        )
        filled = free
        for p in range(free, end):
            i = work[p]
            if weight[i] < 0:
                weight[i] = -weight[i]
                d = min(degree[i] + size, left) - weight[i]
                after[i], before[i], degree[i] = head[d], -1, d
                if head[d] >= 0:
                    before[head[d]] = i
                head[d] = i
                least = min(least, d)
                work[filled] = i
                filled += 1
        begin[pivot], length[pivot], elements[pivot], degree[pivot] = free, filled - free, 0, size
        if filled == free:
            mark[pivot] = 0
        free = filled


@kernel
def _form_element(
    pivot: int,
    free: int,
    begin: Index,
    length: Index,
    elements: Index,
    weight: Index,
    degree: Index,
    mark: Index,
    work: Index,
    head: Index,
    after: Index,
    before: Index,
) -> int:
    """Write L_p = (A_p ∪ ⋃ L_e) \\ p at `free`, absorb the elements e; return its weight."""
    size, end, first, count = 0, free, begin[pivot], elements[pivot]
    for q in range(count + 1):
        # The elements one after the other, and then the pivot's own variables.
        if q < count:
            e = work[first + q]
            start, stop = begin[e], begin[e] + length[e]
            mark[e] = length[e] = 0
        else:
            start, stop = first + count, first + length[pivot]
        for p in range(start, stop):
            i = work[p]
            if weight[i] <= 0:
                continue
            size += weight[i]
            weight[i] = -weight[i]
            work[end] = i
            end += 1
            if after[i] >= 0:  # its degree will be another
                before[after[i]] = before[i]
            if before[i] >= 0:
                after[before[i]] = after[i]
            else:
                head[degree[i]] = after[i]
    length[pivot] = end - free
    return size


@kernel
def _renew_lists(
    pivot: int,
    free: int,
    end: int,
    stamp: int,
    begin: Index,
    length: Index,
    elements: Index,
    weight: Index,
    degree: Index,
    mark: Index,
    work: Index,
    absorbed: Index,
) -> int:
    """Drop from E_i and A_i of all i in L_p what L_p covers, put p first, bound the degrees.

    Writes |A_i| + Σ |L_e \\ L_p| if that is less than the degree before. There is room for p: it
    replaces itself among the variables, or an element it absorbed. Returns the weight of variables
    that see nothing but L_p, which are eliminated with p.
    """
    gone = 0
    for s in range(free, end):
        i = work[s]
        first, outside = begin[i], 0
        to = first
        for q in range(first, first + elements[i]):
            e = work[q]
            if mark[e] > stamp:
                outside += mark[e] - stamp
                work[to] = e
                to += 1
            else:  # inside L_p, or absorbed before
                mark[e] = 0
        kept = to - first
        for q in range(first + elements[i], first + length[i]):
            j = work[q]
            if weight[j] > 0:
                outside += weight[j]
                work[to] = j
                to += 1
        if outside == 0:
            absorbed[i] = pivot
            gone -= weight[i]
            weight[i] = length[i] = elements[i] = 0
            continue
        # p becomes the first element, that one the last, the first variable goes to the end.
        if to > first + kept:
            work[to] = work[first + kept]
        if kept > 0:
            work[first + kept] = work[first]
        work[first] = pivot
        elements[i], length[i], degree[i] = kept + 1, to + 1 - first, min(degree[i], outside)
    return gone


@kernel
def _merge_twins(
    free: int,
    end: int,
    stamp: int,
    begin: Index,
    length: Index,
    elements: Index,
    weight: Index,
    mark: Index,
    work: Index,
    bucket: Index,
    twin: Index,
    code: Index,
    absorbed: Index,
) -> int:
    """Make one variable of all variables of L_p that have equal lists; return the next stamp."""
    for p in range(free, end):
        i = work[p]
        if weight[i] < 0:
            total = 0
            for q in range(begin[i], begin[i] + length[i]):
                total += work[q]
            code[i] = total % len(bucket)
            twin[i] = bucket[code[i]]
            bucket[code[i]] = i
    for p in range(free, end):
        i = work[p]
        if weight[i] == 0:
            continue
        i = bucket[code[i]]
        bucket[code[work[p]]] = -1  # each bucket is emptied once
        while i >= 0:
            for q in range(begin[i], begin[i] + length[i]):
                mark[work[q]] = stamp
            previous, j = i, twin[i]
            while j >= 0:
                is_equal = length[j] == length[i] and elements[j] == elements[i]
                q = begin[j]
                while is_equal and q < begin[j] + length[j]:
                    is_equal = mark[work[q]] == stamp
                    q += 1
                if is_equal:
                    absorbed[j] = i
                    weight[i] += weight[j]
                    weight[j] = length[j] = elements[j] = 0
                    twin[previous] = twin[j]
                else:
                    previous = j
                j = twin[j]
            stamp += 1
            i = twin[i]
    return stamp


def warm_up() -> None:
    """Compile the kernels of this module."""
    approximate_minimum_degree(BlockPattern.of([1, 1], [0], [1]))
