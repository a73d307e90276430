"""Matching by words: two views without a guess, compared only where the direct index agrees.

Features of two images that are one point of the world mostly pass the same node of the vocabulary
tree. So a feature is compared only with those of the other image in its own node,

    j(i) = argmin over j with node(j) = node(i) of d(a_i, b_j),

and kept if it is clearly the nearest there, and the nearest both ways. At level l of a tree of k
branches that is some k^l times less work than comparing all pairs, and more pairs are torn apart:
of the matches among all pairs 78 % are found at level 1, 55 % at level 2. Of equal ones the first
counts.

Cost: O(N M / k^l); for 1,000 features a side 1 ms at level 1, 0.4 ms at level 2.

Reference: Gálvez-López, Tardós, "Bags of binary words for fast place recognition in image
sequences", T-RO 28(5), 2012, section IV-C (direct index).
"""

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.kernels import kernel
from odomap.vision.hamming import NO_DISTANCE, as_words, hamming
from odomap.vision.matching import MatchConfig

__all__ = ["match_words", "warm_up"]

Words = NDArray[np.uint64]
Index = NDArray[np.int64]


def match_words(
    first: NDArray[np.uint8],
    first_nodes: Index,
    second: NDArray[np.uint8],
    second_nodes: Index,
    config: MatchConfig,
) -> Index:
    """Match descriptors of two images that share a node; face and checks of `match_all`.

    Args:
        first: (N, 32) uint8.
        first_nodes: (N,) of the direct index, `BagOfWords.nodes`.
        second: (M, 32) uint8.
        second_nodes: (M,), of the same vocabulary and level.
        config: `max_hamming`, and `ratio` against the second best of the node.

    Returns:
        (N,) index into `second`, -1 without a match; no index twice.

    Raises:
        InputError: there is not one node for each descriptor.
    """
    if len(first) != len(first_nodes) or len(second) != len(second_nodes):
        raise InputError(
            f"matching: {len(first)} and {len(second)} descriptors, but {len(first_nodes)} and "
            f"{len(second_nodes)} nodes"
        )
    order = np.argsort(second_nodes, kind="stable")
    ordered = second_nodes[order]
    start = np.searchsorted(ordered, first_nodes, "left")
    end = np.searchsorted(ordered, first_nodes, "right")
    matches = np.full(len(first), -1, np.int64)
    _match_kernel(
        as_words(first),
        as_words(second),
        order,
        start,
        end,
        config.ratio,
        config.max_hamming,
        matches,
    )
    return matches


@kernel
def _match_kernel(
    first: Words,
    second: Words,
    order: Index,
    start: Index,
    end: Index,
    ratio: float,
    limit: int,
    matches: Index,
) -> None:
    """For each i the nearest of order[start_i:end_i], if clearly the nearest; both ways best."""
    owner = np.full(len(second), -1, np.int64)
    distances = np.full(len(second), NO_DISTANCE, np.int64)
    for i in range(len(first)):
        best, other, index = NO_DISTANCE, NO_DISTANCE, -1
        for k in range(start[i], end[i]):
            j = order[k]
            d = hamming(first, i, second, j)
            if d < distances[j]:
                distances[j], owner[j] = d, i
            if d < best:
                best, other, index = d, best, j
            elif d < other:
                other = d
        if index >= 0 and best <= limit and best < ratio * other:
            matches[i] = index
    for i in range(len(first)):
        if matches[i] >= 0 and owner[matches[i]] != i:
            matches[i] = -1


def warm_up() -> None:
    """Compile the kernel of this module."""
    two, nodes = np.zeros((2, 32), np.uint8), np.zeros(2, np.int64)
    match_words(two, nodes, two, nodes, MatchConfig())
