"""Inverse index: for each word, the images that it occurs in.

The postings (image, weight) of a word are a range of one pool, with room to grow; a range that is
full moves to the pool's end with twice the room, so that adding costs O(words of the image) in the
long run, and a query walks through memory in order. Weights are whole numbers of 2⁻³⁰: sums of

    score_r = Σ over words w of the query of min(a_w, b_rw)

are exact, the same in whatever order images came and went, and one addition counts common words,
too. An index has room for some images only, so that no addition has much to move; `places` has
several of them.

Cost: a query 2 ns for each posting of its words, adding 0.1 ms.

Reference: Zobel, Moffat, "Inverted files for text search engines", ACM Computing Surveys 38(2),
2006; Gálvez-López, Tardós, "Bags of binary words", T-RO 28(5), 2012, section IV-B.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["COUNT", "ONE", "InverseIndex", "warm_up"]

Whole = NDArray[np.int32]
Index = NDArray[np.int64]

ONE = 1 << 30
"""The weight 1."""
COUNT = 1 << 40
"""In a sum of weights, one common word; weights of an image are together near ONE."""
LEAST_ROOM = 2
"""Postings that a word's first range has room for."""


class InverseIndex:
    """An inverse index of at most so many images, which are called rows.

    Args:
        num_words: of the vocabulary.
        capacity: rows.
    """

    def __init__(self, num_words: int, capacity: int) -> None:
        self.capacity = capacity
        # of each word: where its postings begin in the pool, how many there are, and may be
        self._ranges = np.zeros((num_words, 3), np.int32)
        self._pool = np.empty((0, 2), np.int32)
        self._end = 0

    @property
    def nbytes(self) -> int:
        """Memory of the arrays."""
        return self._ranges.nbytes + self._pool.nbytes

    def add(self, row: int, words: Whole, weights: Whole) -> None:
        """Add an image.

        Args:
            row: 0 to capacity - 1, not in use.
            words: (W,) its words, each once.
            weights: (W,) of them, in 2⁻³⁰.
        """
        needed = _room_for(words, self._ranges)
        if self._end + needed > len(self._pool):
            # Ranges that moved left holes behind: they are given up on the way.
            size = (int(self._ranges[:, 2].sum()) + needed) * 3 // 2
            pool = np.empty((size, 2), np.int32)
            self._end = _pack(self._ranges, self._pool, pool)
            self._pool = pool
        self._end = _add(row, words, weights, self._ranges, self._pool, self._end)

    def remove(self, row: int, words: Whole) -> None:
        """Remove an image.

        Args:
            row: the image.
            words: (W,) its words.
        """
        _remove(row, words, self._ranges, self._pool)

    def sums(self, words: Whole, weights: Whole) -> Index:
        """Compare an image with all rows.

        Args:
            words: (W,) its words, each once.
            weights: (W,) of them, in 2⁻³⁰.

        Returns:
            (capacity,) score in 2⁻³⁰, and COUNT for each common word.
        """
        sums = np.zeros(self.capacity, np.int64)
        _sum(words, weights, self._ranges, self._pool, sums)
        return sums


@kernel
def _room_for(words: Whole, ranges: Whole) -> int:
    """How much of the pool adding an image with these words takes at its end."""
    needed = 0
    for i in range(len(words)):
        if ranges[words[i], 1] == ranges[words[i], 2]:
            needed += max(2 * ranges[words[i], 2], LEAST_ROOM)
    return needed


@kernel
def _add(row: int, words: Whole, weights: Whole, ranges: Whole, pool: Whole, end: int) -> int:
    """Append (row, weight) to the range of each word; return the new end of the pool."""
    for i in range(len(words)):
        start, used, room = ranges[words[i], 0], ranges[words[i], 1], ranges[words[i], 2]
        if used == room:
            for k in range(used):
                pool[end + k, 0], pool[end + k, 1] = pool[start + k, 0], pool[start + k, 1]
            start, room = end, max(2 * room, LEAST_ROOM)
            ranges[words[i], 0], ranges[words[i], 2] = start, room
            end += room
        pool[start + used, 0], pool[start + used, 1] = row, weights[i]
        ranges[words[i], 1] = used + 1
    return end


@kernel
def _remove(row: int, words: Whole, ranges: Whole, pool: Whole) -> None:
    """Take a row out of the ranges of its words: the last posting takes its place."""
    for i in range(len(words)):
        last = ranges[words[i], 0] + ranges[words[i], 1] - 1
        for k in range(ranges[words[i], 0], last + 1):
            if pool[k, 0] == row:
                pool[k, 0], pool[k, 1] = pool[last, 0], pool[last, 1]
                ranges[words[i], 1] -= 1
                break


@kernel
def _pack(ranges: Whole, pool: Whole, target: Whole) -> int:
    """Write all ranges, word after word and with their rooms, into another pool; return its end."""
    end = 0
    for w in range(len(ranges)):
        start = ranges[w, 0]
        for k in range(ranges[w, 1]):
            target[end + k, 0], target[end + k, 1] = pool[start + k, 0], pool[start + k, 1]
        ranges[w, 0] = end
        end += ranges[w, 2]
    return end


@kernel
def _sum(words: Whole, weights: Whole, ranges: Whole, pool: Whole, sums: Index) -> None:
    """sums_r += min(a_w, b_rw) + COUNT over the postings of the query's words."""
    for i in range(len(words)):
        start, a = ranges[words[i], 0], weights[i]
        for k in range(start, start + ranges[words[i], 1]):
            sums[pool[k, 0]] += np.int64(min(a, pool[k, 1])) + COUNT


def warm_up() -> None:
    """Compile the kernels of this module."""
    index, one = InverseIndex(1, 1), np.zeros(1, np.int32)
    index.add(0, one, one)
    index.sums(one, one)
    index.remove(0, one)
