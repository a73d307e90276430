"""Ragged lists: one growing list of row numbers per owner, kept up to date as rows come and go.

The observation table is read both ways: all rows of a keyframe, all rows of a landmark. Sorting the
table anew after every change would cost O(n log n) with n the whole map, under the map's lock. Here
each owner has a segment of one shared array with room for a power of two of values; a segment that
runs full moves to one of twice the size, and the old one is handed to the next owner that needs
that size (segregated free lists: Knuth, The Art of Computer Programming, vol. 1, sec. 2.5).
Appending n values and reading the lists of some owners (`gather`, a CSR view) cost O(values
touched), whatever the size of the map; memory is at most twice the values, and is used again.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.maps.column import Column
from odomap.maps.columns import distinct, offsets, spans

__all__ = ["Ragged"]

_SMALLEST = 4


class Ragged:
    """Lists of int32 values by owner 0, 1, 2, ...; an owner never seen has an empty list."""

    def __init__(self) -> None:
        self._start = Column[np.int64].empty(np.int64)
        self._count = Column[np.int64].empty(np.int64)
        self._capacity = Column[np.int64].empty(np.int64)
        self._values = Column[np.int32].empty(np.int32)
        self._end = 0
        self._free: dict[int, list[int]] = {}

    def columns(self) -> tuple[Column[Any], ...]:
        """Return the columns that `twin` needs copies of."""
        return self._start, self._count, self._values

    def twin(self, copies: Iterator[Column[Any]]) -> "Ragged":
        """Return the same lists, to be read only, made of copies of `columns`."""
        twin = Ragged()
        twin._start, twin._count, twin._values = next(copies), next(copies), next(copies)
        return twin

    def counts(self, owners: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the (N,) lengths of the lists of (N,) owners."""
        self._cover(owners)
        return self._count[owners]

    def gather(self, owners: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """Read the lists of some owners.

        Args:
            owners: (N,) owners, in the order wanted.

        Returns:
            indptr (N + 1,) and values: the list of owners[n] is values[indptr[n]:indptr[n + 1]].
        """
        self._cover(owners)
        counts = self._count.take(owners)
        return offsets(counts), self._values.take(spans(self._start.take(owners), counts))

    def append(self, owners: NDArray[np.int64], values: NDArray[np.int32]) -> None:
        """Append values[n] to the list of owners[n]; (N,) each, owners may repeat."""
        if len(owners) == 0:
            return
        self._cover(owners)
        order = np.argsort(owners, kind="stable")
        ordered = owners[order]
        begins = np.ones(len(owners), np.bool_)
        begins[1:] = ordered[1:] != ordered[:-1]
        first = np.flatnonzero(begins)
        heads = ordered[first]
        added = np.diff(first, append=len(owners))
        self._reserve(heads, added)
        at = self._start[heads] + self._count[heads]
        self._values[spans(at, added)] = values[order]
        self._count[heads] += added

    def keep(self, owners: NDArray[np.int64], wanted: NDArray[np.bool_]) -> None:
        """Drop every value v with wanted[v] false from the lists of (N,) distinct owners."""
        indptr, values = self.gather(owners)
        stays = wanted[values]
        group = np.repeat(np.arange(len(owners)), np.diff(indptr))
        counts = np.bincount(group[stays], minlength=len(owners))
        self._values[spans(self._start[owners], counts)] = values[stays]
        self._count[owners] = counts
        self._release(owners[counts == 0])

    def clear(self, owners: NDArray[np.int64]) -> None:
        """Empty the lists of (N,) distinct owners."""
        self._cover(owners)
        self._count[owners] = 0
        self._release(owners)

    def _cover(self, owners: NDArray[np.int64]) -> None:
        rows = int(owners.max()) + 1 if len(owners) else 0
        if rows > len(self._start):
            self._start.reserve(rows)
            self._count.reserve(rows)
            self._capacity.reserve(rows)

    def _reserve(self, owners: NDArray[np.int64], added: NDArray[np.int64]) -> None:
        """Make room for so many more values; distinct owners."""
        need = self._count[owners] + added
        tight = need > self._capacity[owners]
        if not tight.any():
            return
        owners, need = owners[tight], need[tight]
        capacity = np.maximum(np.exp2(np.ceil(np.log2(need))).astype(np.int64), _SMALLEST)
        start = np.zeros_like(capacity)
        for size in distinct(capacity).tolist():
            chosen = capacity == size
            start[chosen] = self._allocate(size, int(chosen.sum()))
        counts = self._count[owners]
        self._values[spans(start, counts)] = self._values[spans(self._start[owners], counts)]
        self._release(owners)
        self._start[owners] = start
        self._capacity[owners] = capacity

    def _allocate(self, size: int, number: int) -> NDArray[np.int64]:
        """Return where so many segments of one size begin: freed ones first, then new ones."""
        free = self._free.get(size, [])
        cut = max(len(free) - number, 0)
        reused = free[cut:]
        del free[cut:]
        fresh = self._end + size * np.arange(number - len(reused), dtype=np.int64)
        self._end += size * len(fresh)
        self._values.reserve(self._end)
        return np.concatenate([np.asarray(reused, np.int64), fresh])

    def _release(self, owners: NDArray[np.int64]) -> None:
        """Hand the segments of distinct owners back."""
        capacity = self._capacity[owners]
        for size in distinct(capacity[capacity > 0]).tolist():
            self._free.setdefault(size, []).extend(self._start[owners[capacity == size]].tolist())
        self._capacity[owners] = 0
