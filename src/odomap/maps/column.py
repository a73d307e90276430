"""A column of the map's tables: it grows, and is copied, in small steps while it is written.

An array that doubles when it is full takes n appended rows in O(n) in all, but one append in a
while copies everything, and so does a copy for a file: milliseconds under the map's lock, however
little the caller wanted. Here both are made bit by bit. A column three quarters full gets an heir
of twice its length; each append moves eight rows per new one into it, so that the heir is complete
before room runs out. All that is written goes to the column, its heir and its copies alike. Hence
at any moment

    rows [0, moved) of a copy = those of the column,

and a copy is complete, as of now, once moved has reached the last row: no second pass, no retry.
An append costs O(rows appended), a step of a copy as much as it is told to.

Reference: M. H. Overmars, The design of dynamic data structures, 1983 (global rebuilding: a
structure is made anew beside the old one, some of it at each operation).
"""

from math import prod
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from odomap.maps.columns import grown

__all__ = ["Column", "Copy"]

S = TypeVar("S", bound=np.generic)

PACE = 8
"""Rows moved to the heir per new row; at three quarters full, four would be enough."""
LEAST = 1024
"""Rows moved at each append at least."""

Rows = NDArray[np.integer[Any]] | slice | int


class Copy(Generic[S]):
    """Another array that follows a column, complete up to a row.

    Attributes:
        array: (K, ...) at least as long as the column has rows.
        moved: rows that are there.
    """

    def __init__(self, array: NDArray[S]) -> None:
        self.array = array
        self.moved = 0

    def take_over(self, source: NDArray[S], end: int, rows: int) -> None:
        """Copy so many more rows of the first `end` ones."""
        stop = min(self.moved + rows, end)
        self.array[self.moved : stop] = source[self.moved : stop]
        self.moved = stop


class Column(Generic[S]):
    """A growing array of rows; write through the column, read `values` or the column.

    Attributes:
        values: (K, ...) rows in use and spare ones; another array after `reserve`.
    """

    def __init__(self, values: NDArray[S]) -> None:
        """Make a column whose rows are those of an array, which is taken over."""
        self.values = values
        self._rows = len(values)
        self._heir: Copy[S] | None = None
        self._copies: tuple[Copy[S], ...] = ()

    @classmethod
    def empty(cls, dtype: DTypeLike, *tail: int) -> "Column[S]":
        """Return a column without rows."""
        return cls(np.zeros((0, *tail), dtype))

    def __len__(self) -> int:
        return self._rows

    @property
    def is_followed(self) -> bool:
        """Whether a copy is being made."""
        return bool(self._copies)

    def __getitem__(self, rows: Rows) -> NDArray[S]:
        return self.values[rows]

    def __setitem__(self, rows: Rows, values: ArrayLike | np.generic) -> None:
        self.values[rows] = values
        for follower in self._followers():
            follower.array[rows] = values

    def take(self, rows: NDArray[np.integer[Any]]) -> NDArray[S]:
        """Return (N,) rows, copied."""
        return self.values.take(rows, axis=0)

    def add(self, rows: NDArray[np.int64], values: ArrayLike) -> None:
        """Add numbers to (N,) rows, which may repeat."""
        np.add.at(self.values, rows, values)
        for follower in self._followers():
            follower.array[rows] = self.values[rows]

    def reserve(self, rows: int) -> None:
        """Make sure that there are at least so many rows; new ones hold 0 until they are set."""
        fresh = rows - self._rows
        if fresh <= 0:
            return
        if self._heir is None and 4 * rows > 3 * len(self.values):
            self._heir = self._follower(max(2 * len(self.values), 2 * rows, 64))
        if self._heir is not None:
            is_full = rows > len(self.values)
            pace = self._rows if is_full else PACE * fresh + LEAST
            self._heir.take_over(self.values, self._rows, pace)
            if self._heir.moved == self._rows:
                self.values, self._heir = grown(self._heir.array, rows), None
        for copy in self._copies:
            copy.array = grown(copy.array, rows)
        self[self._rows : rows] = 0
        self._rows = rows

    def begin_copy(self) -> Copy[S]:
        """Return a copy without rows, which from now on gets what is written."""
        copy = self._follower(2 * self._rows + LEAST)  # so that it hardly ever has to grow
        self._copies = (*self._copies, copy)
        return copy

    def go_on(self, copy: Copy[S], size: int) -> int:
        """Copy some more rows.

        Args:
            copy: from `begin_copy`.
            size: bytes to copy, about.

        Returns:
            How many bytes there were.
        """
        row, before = self._row_bytes, copy.moved
        copy.take_over(self.values, self._rows, max(size // row, 1))
        return row * (copy.moved - before)

    def left(self, copy: Copy[S]) -> int:
        """Return how many bytes a copy still lacks."""
        return self._row_bytes * (self._rows - copy.moved)

    def end_copy(self, copy: Copy[S]) -> "Column[S]":
        """Return a column of a copy's rows, which stays as it is now."""
        self._copies = tuple(other for other in self._copies if other is not copy)
        return Column(copy.array[: self._rows])

    def _follower(self, rows: int) -> Copy[S]:
        """Return a copy without rows; memory that is never touched is never given out."""
        return Copy(np.empty((rows, *self.values.shape[1:]), self.values.dtype))

    @property
    def _row_bytes(self) -> int:
        return self.values.itemsize * prod(self.values.shape[1:])

    def _followers(self) -> tuple[Copy[S], ...]:
        return self._copies if self._heir is None else (*self._copies, self._heir)
