"""Joining: which pairs that look like one thing become one, if some must stay apart.

Pairs make groups: if a is b and b is c, then a is c. A wrong pair would join two groups that stand
apart. So pairs are taken in the order given, best first, and two groups become one only if no
member of the one stands apart from a member of the other (constrained single linkage). Groups are
lists of members that a member points along, each knowing the number of its group; the smaller one
of two is renumbered.

Cost: O(pairs log things), and what the groups' members stand apart from.

Reference: Tarjan, "Efficiency of a good but not linear set union algorithm", JACM 1975.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["join", "warm_up"]

Index = NDArray[np.int64]


def join(
    pairs: Index,
    weight: Index,
    is_apart: Callable[[Index, Index], NDArray[np.bool_]],
) -> tuple[Index, Index]:
    """Join pairs to groups in which nothing stands apart.

    Args:
        pairs: (P, 2) things that look like one, best first.
        weight: (M,) of each thing; the heaviest of a group, the lowest among equals, stands for it.
        is_apart: says of (n,) and (n,) things, the lower first, whether the two of each pair must
            not be joined.

    Returns:
        (F,) who stands for, and (F,) each other member of a group, ascending.

    Example:
        >>> chain = np.array([[4, 2], [2, 0]])
        >>> join(chain, np.array([1, 0, 3, 0, 1]), lambda a, b: np.zeros(len(a), bool))
        (array([2, 2]), array([0, 4]))
    """
    pairs = np.ascontiguousarray(pairs, np.int64)
    none, never = np.empty(0, np.int64), np.zeros(len(weight) + 1, np.int64)
    group = _grouped(pairs, never, none)
    within = _within(group)
    if not len(within):
        return none, none
    apart = within[is_apart(within[:, 0], within[:, 1])]
    if len(apart):
        one, other = np.concatenate([apart, apart[:, ::-1]]).T
        np.cumsum(np.bincount(one, minlength=len(weight)), out=never[1:])
        group = _grouped(pairs, never, other[np.argsort(one, kind="stable")])
    heir = np.empty(len(weight), np.int64)
    _heirs(group, np.ascontiguousarray(weight, np.int64), heir)
    gone = np.flatnonzero(heir != np.arange(len(heir)))
    return heir[gone], gone


def _grouped(pairs: Index, start: Index, apart: Index) -> Index:
    """Return (M,) the group of each thing, named by one of its members.

    Args:
        pairs: (P, 2), best first.
        start, apart: (M + 1,) and (A,): thing m must stay apart from apart[start[m]:start[m + 1]].
    """
    M = len(start) - 1
    group, following, last, size = np.arange(M), np.full(M, -1), np.arange(M), np.ones(M, np.int64)
    _link(pairs, start, apart, group, following, last, size)
    return group


def _within(group: Index) -> Index:
    """Return (n, 2) all pairs of members of one group, the lower first."""
    size = np.bincount(group, minlength=len(group))
    members = np.flatnonzero(size[group] > 1)
    members = members[np.argsort(group[members], kind="stable")]
    pairs = np.empty((int(np.sum(size * (size - 1) // 2)), 2), np.int64)
    _pair_up(members, group, pairs)
    return pairs


@kernel
def _link(
    pairs: Index,
    start: Index,
    apart: Index,
    group: Index,
    following: Index,
    last: Index,
    size: Index,
) -> None:
    """Join the groups of each pair, unless a member of one stands apart from one of the other.

    A group g is g, following[g], ... up to last[g], and has size[g] members.
    """
    for p in range(len(pairs)):
        small, large = group[pairs[p, 0]], group[pairs[p, 1]]
        if small == large:
            continue
        if size[small] > size[large]:
            small, large = large, small
        m, free = small, True
        while m >= 0 and free:
            for a in range(start[m], start[m + 1]):
                free = free and group[apart[a]] != large
            m = following[m]
        if not free:
            continue
        m = small
        while m >= 0:
            group[m] = large
            m = following[m]
        following[last[large]], last[large] = small, last[small]
        size[large] += size[small]


@kernel
def _pair_up(members: Index, group: Index, pairs: Index) -> None:
    """Write all pairs of members of one group; members are sorted by it."""
    count = 0
    for i in range(len(members)):
        j = i + 1
        while j < len(members) and group[members[j]] == group[members[i]]:
            pairs[count, 0], pairs[count, 1] = members[i], members[j]
            count += 1
            j += 1


@kernel
def _heirs(group: Index, weight: Index, heir: Index) -> None:
    """heir[m] = the member of m's group of the largest weight, the lowest of equals."""
    for m in range(len(group)):
        heir[m] = -1
    for m in range(len(group)):
        best = heir[group[m]]
        if best < 0 or weight[m] > weight[best]:
            heir[group[m]] = m
    # A group is named by a member: it holds the answer until all others have read it.
    for m in range(len(group)):
        if group[m] != m:
            heir[m] = heir[group[m]]


def warm_up() -> None:
    """Compile the kernels of this module."""
    pairs = np.array([[0, 1], [1, 2]])
    join(pairs, np.ones(3, np.int64), lambda a, b: np.asarray(b > 1))
