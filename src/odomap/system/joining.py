"""Joining: which pairs that look like one thing become one, if some must stay apart.

Pairs make groups: if a is b and b is c, then a is c. A wrong pair would join two groups that stand
apart. So pairs are taken in the order given, best first, and two groups become one only if no
member of the one stands apart from a member of the other (constrained single linkage).

Cost: nearly linear in the pairs, quadratic in the size of a group.

Reference: Tarjan, "Efficiency of a good but not linear set union algorithm", JACM 1975.
"""

from collections.abc import Callable
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

__all__ = ["join"]

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
        is_apart: says of (n,) and (n,) things whether the two of each pair must not be joined.

    Returns:
        (F,) who stands for, and (F,) each other member of a group, ascending.

    Example:
        >>> chain = np.array([[4, 2], [2, 0]])
        >>> join(chain, np.array([1, 0, 3, 0, 1]), lambda a, b: np.zeros(len(a), bool))
        (array([2, 2]), array([0, 4]))
    """
    links = [(a, b) for a, b in pairs.tolist() if a != b]
    whole = _groups(links, frozenset())
    within = [pair for group in whole for pair in combinations(sorted(group), 2)]
    if not within:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    first, second = np.array(within, np.int64).T
    apart = frozenset(within[i] for i in np.flatnonzero(is_apart(first, second)))
    groups = _groups(links, apart) if apart else whole
    heirs = {
        member: max(group, key=lambda m: (int(weight[m]), -m))
        for group in groups
        for member in group
    }
    gone = sorted(member for member, heir in heirs.items() if member != heir)
    return np.array([heirs[m] for m in gone], np.int64), np.array(gone, np.int64)


def _groups(links: list[tuple[int, int]], apart: frozenset[tuple[int, int]]) -> list[list[int]]:
    """Return the groups of linked things that keep (lower, higher) pairs apart."""
    of: dict[int, list[int]] = {}
    for a, b in links:
        one, other = of.setdefault(a, [a]), of.setdefault(b, [b])
        if one is other or any((min(i, j), max(i, j)) in apart for i in one for j in other):
            continue
        small, large = sorted((one, other), key=len)
        large.extend(small)
        of.update((member, large) for member in small)
    distinct = {id(group): group for group in of.values()}
    return list(distinct.values())
