"""Arrays that grow by a row at a time, at the same cost however long they are.

Room is doubled when it is spent: n additions copy fewer than 2 n rows in all. What is in use is a
view of the room, contiguous, so that kernels take it as it is. A view has the rows that were there
when it was asked for, and may be of the room before the last doubling: ask again after adding.

Cost: O(1) per row, amortised.

Reference: T. H. Cormen, C. E. Leiserson, R. L. Rivest, C. Stein, "Introduction to Algorithms",
3rd ed., section 17.4 (dynamic tables), MIT Press, 2009.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

__all__ = ["GrowingArray"]

_FIRST_ROOM = 16


class GrowingArray:
    """Rows of one shape and type, of which more come.

    Args:
        tail: shape of a row.
        dtype: of its entries.

    Example:
        >>> points = GrowingArray((2,), float)
        >>> points.append([1.0, 2.0])
        >>> points.rows.tolist(), len(points)
        ([[1.0, 2.0]], 1)
    """

    def __init__(self, tail: tuple[int, ...], dtype: DTypeLike) -> None:
        self._room: NDArray[Any] = np.zeros((_FIRST_ROOM, *tail), dtype)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> NDArray[Any]:
        """(n, ...) the rows there are; writing into them changes the array."""
        return self._room[: self._count]

    def append(self, row: ArrayLike) -> None:
        """Add a row."""
        if self._count == len(self._room):
            self._room = np.concatenate([self._room, np.zeros_like(self._room)])
        self._room[self._count] = row
        self._count += 1
