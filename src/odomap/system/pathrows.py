"""The rows of a path: what is kept of every frame for as long as a run lasts.

A path is the one thing that grows with time whatever a robot sees, so a frame is not an object with
two matrices of its own, 1.5 kB, but a row of numbers. Of a pose the last row is (0, 0, 0, 1), and
of a covariance Σ = Σᵀ the entries on and above the diagonal say all:

    8 stamp | 8 keyframe | 12 · 8 pose | 21 · 8 covariance = 280 bytes.

Rows stand in blocks of some hundred kilobytes. A full one is never moved, so that a row is written
once, and nothing is held beside the rows but what is left of the last block.

Reference: Cormen et al., Introduction to Algorithms, ch. 17 (tables that grow).
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["PathRows"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

BLOCK = 512
"""Rows of a block."""
UPPER = np.ravel_multi_index(np.triu_indices(6), (6, 6))
"""(21,) where the entries of a covariance that are kept stand in its 36."""
WHOLE = np.zeros((6, 6), np.int64)
WHOLE[np.triu_indices(6)] = np.arange(21)
WHOLE = np.maximum(WHOLE, WHOLE.T)
WHOLE.setflags(write=False)
"""(6, 6) where in those 21 each of a covariance's entries is."""
ROW = np.dtype(
    [("stamp_ns", "i8"), ("keyframe_id", "i8"), ("pose", "f8", 12), ("covariance", "f8", 21)]
)


class PathRows:
    """Frames by their place: a stamp, a keyframe, a pose and its covariance each."""

    def __init__(self) -> None:
        self._blocks: list[NDArray[np.void]] = []
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, stamp_ns: int, keyframe_id: int, T: Array, covariance: Array) -> None:
        """Add a frame.

        Args:
            stamp_ns: its time.
            keyframe_id: the keyframe that it hangs from; -1 for a pose in the world.
            T: (4, 4) pose.
            covariance: (6, 6) of it, symmetric.
        """
        if self._count == BLOCK * len(self._blocks):
            self._blocks.append(np.zeros(BLOCK, ROW))
        self._count += 1
        self.replace(self._count - 1, stamp_ns, keyframe_id, T, covariance)

    def replace(
        self, place: int, stamp_ns: int, keyframe_id: int, T: Array, covariance: Array
    ) -> None:
        """Write one of the frames anew."""
        row = stamp_ns, keyframe_id, T.ravel()[:12], covariance.ravel()[UPPER]
        block, within = divmod(self._within(place), BLOCK)
        self._blocks[block][within] = row

    def stamp_ns(self, place: int) -> int:
        """Return the time of a frame; places count from the end if negative."""
        block, within = divmod(self._within(place), BLOCK)
        return int(self._blocks[block]["stamp_ns"][within])

    def __getitem__(self, place: int) -> tuple[int, int, Array, Array]:
        """Return stamp, keyframe, pose (4, 4) and covariance (6, 6) of a frame."""
        block, within = divmod(self._within(place), BLOCK)
        row = self._blocks[block][within]
        poses, covariances = _matrices(row["pose"], row["covariance"])
        return int(row["stamp_ns"]), int(row["keyframe_id"]), poses, covariances

    @property
    def stamps_ns(self) -> Index:
        """(N,) the times of all."""
        return self._column("stamp_ns")

    @property
    def keyframe_ids(self) -> Index:
        """(N,) the keyframes that they hang from."""
        return self._column("keyframe_id")

    def matrices(self, rows: ArrayLike | None = None) -> tuple[Array, Array]:
        """Return poses (n, 4, 4) and covariances (n, 6, 6).

        Args:
            rows: (n,) of which frames, or (N,) whether; default of all.
        """
        chosen = slice(None) if rows is None else np.asarray(rows)
        return _matrices(self._column("pose")[chosen], self._column("covariance")[chosen])

    def _column(self, name: str) -> NDArray[Any]:
        if not self._blocks:
            return np.zeros(0, ROW)[name]
        return np.concatenate([block[name] for block in self._blocks])[: self._count]

    def _within(self, place: int) -> int:
        """Return a place counted from the first.

        Raises:
            IndexError: there is no such frame.
        """
        if not -self._count <= place < self._count:
            raise IndexError(f"frame {place} of {self._count}")
        return place % self._count


def _matrices(poses: Array, covariances: Array) -> tuple[Array, Array]:
    """Return (..., 4, 4) and (..., 6, 6) of the numbers (..., 12) and (..., 21) that are kept."""
    Ts = np.empty((*poses.shape[:-1], 4, 4))
    Ts[..., :3, :] = poses.reshape(*poses.shape[:-1], 3, 4)
    Ts[..., 3, :] = 0.0, 0.0, 0.0, 1.0
    return Ts, covariances[..., WHOLE]
