"""Copying many columns, a little at a time, while other threads write them.

A copy of a whole map takes tens of milliseconds, and must be of one moment. So it is made in steps
of half a megabyte, each under the map's lock for a fraction of a millisecond; columns pass on to
their copies what is written meanwhile (`Column`). The moment it is of is that of the last step,
which takes what is left and ends all copies in one hold.

Reference: M. H. Overmars, The design of dynamic data structures, 1983 (global rebuilding).
"""

from collections.abc import Iterator, Sequence
from typing import Any

from odomap.maps.column import Column, Copy

__all__ = ["Copying"]

STEP = 1 << 19
"""Bytes that are copied in one hold of the lock."""


class Copying:
    """A copy of columns in the making; hold the lock of their map for every call."""

    def __init__(self) -> None:
        self._jobs: list[tuple[Column[Any], Copy[Any]]] = []

    def begin(self, columns: Sequence[Column[Any]]) -> None:
        """Begin to copy; `close` ends what was begun, whatever happens."""
        for column in columns:
            self._jobs.append((column, column.begin_copy()))

    @property
    def is_nearly_done(self) -> bool:
        """Whether what is left may be copied in the last step, which has other work as well."""
        left = sum(column.left(copy) for column, copy in self._jobs)
        return left <= STEP // 4

    def step(self) -> None:
        """Copy some more."""
        budget = STEP
        for column, copy in self._jobs:
            if budget > 0:
                budget -= column.go_on(copy, budget)

    def finished(self) -> Iterator[Column[Any]]:
        """Return the copies, of this moment, in the order of the columns."""
        for column, copy in self._jobs:
            column.go_on(copy, column.left(copy))
        return iter(self.close())

    def close(self) -> list[Column[Any]]:
        """End the copies as they are; columns have nothing to pass on any more."""
        ended = [column.end_copy(copy) for column, copy in self._jobs]
        self._jobs = []
        return ended
