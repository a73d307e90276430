"""Observations: which keyframe saw which landmark, at which of its keypoints.

One table of rows (keyframe, landmark, keypoint), read both ways through CSR views:

    rows of keyframe k: the landmarks it sees       rows of landmark l: the keyframes that see it

A row keeps its number while it lives, and the pair (keyframe, landmark) is unique, so either names
it. Both views are kept up to date as rows come and go (`Ragged`): an operation costs O(rows
touched), however large the map. Covisibility is counted off the table, it is not stored:

    covisibility(k, j) = #{l : (k, l) and (j, l) are rows}

Landmarks are named by slot here (`Landmarks.slots`); `Map` speaks in ids.

Reference: H. Strasdat et al., Double window optimisation for constant time visual SLAM, 2011.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.maps.column import Column
from odomap.maps.columns import distinct
from odomap.maps.ragged import Ragged

__all__ = ["Observations"]


class Observations:
    """The table (keyframe, landmark, keypoint)."""

    def __init__(self) -> None:
        self._keyframe = Column[np.int32].empty(np.int32)
        self._landmark = Column[np.int32].empty(np.int32)
        self._keypoint = Column[np.int32].empty(np.int32)
        self._alive = Column[np.bool_].empty(np.bool_)
        self._by_keyframe = Ragged()
        self._by_landmark = Ragged()
        self._free: list[int] = []
        self._end = 0

    def __len__(self) -> int:
        return self._end - len(self._free)

    def columns(self) -> tuple[Column[Any], ...]:
        """Return the columns that `twin` needs copies of."""
        own = self._keyframe, self._landmark, self._keypoint
        return (*own, *self._by_keyframe.columns(), *self._by_landmark.columns())

    def twin(self, copies: Iterator[Column[Any]]) -> "Observations":
        """Return the same table, to be read only, made of copies of `columns`."""
        twin = Observations()
        twin._keyframe, twin._landmark, twin._keypoint = next(copies), next(copies), next(copies)
        twin._by_keyframe = self._by_keyframe.twin(copies)
        twin._by_landmark = self._by_landmark.twin(copies)
        twin._end = self._end
        return twin

    def dump(self, keyframes: int) -> dict[str, NDArray[Any]]:
        """Return copies of all rows, in the order in which each keyframe has its own.

        Args:
            keyframes: how many keyframe ids there are.

        Returns:
            By name: keyframe (ascending), landmark (slots) and keypoint of the (R,) rows, and
            by_landmark, the rows in the order in which each landmark has its own, by slot.
        """
        _, rows = self._by_keyframe.gather(np.arange(keyframes))
        landmarks = self._landmark[rows]
        _, others = self._by_landmark.gather(np.arange(int(landmarks.max(initial=-1)) + 1))
        place = np.zeros(self._end, np.int32)
        place[rows] = np.arange(len(rows), dtype=np.int32)
        return {
            "keyframe": self._keyframe[rows],
            "landmark": landmarks,
            "keypoint": self._keypoint[rows],
            "by_landmark": place[others],
        }

    def restore(self, columns: Mapping[str, NDArray[Any]]) -> None:
        """Fill an empty table with what `dump` returned."""
        self.graft(columns, 0, columns["landmark"].astype(np.int64))

    def graft(
        self, columns: Mapping[str, NDArray[Any]], offset: int, slots: NDArray[np.int64]
    ) -> None:
        """Take in another table; all lists keep the order they had.

        Args:
            columns: what `dump` returned.
            offset: its keyframe k is called offset + k here.
            slots: (R,) the landmarks of its rows, as they are here.
        """
        rows, others = self._new_rows(len(columns["keypoint"])), columns["by_landmark"]
        keyframes = offset + columns["keyframe"].astype(np.int64)
        self._keyframe[rows], self._landmark[rows] = keyframes, slots
        self._keypoint[rows], self._alive[rows] = columns["keypoint"], True
        self._by_keyframe.append(keyframes, rows.astype(np.int32))
        self._by_landmark.append(slots[others], rows[others].astype(np.int32))

    def read(
        self, rows: NDArray[np.int64] | NDArray[np.int32]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Return the (N,) keyframes, landmark slots and keypoints of (N,) rows."""
        return (
            self._keyframe[rows].astype(np.int64),
            self._landmark[rows].astype(np.int64),
            self._keypoint[rows].astype(np.int64),
        )

    def observers(
        self, rows: NDArray[np.int64] | NDArray[np.int32]
    ) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return the (N,) keyframes and keypoints of (N,) rows."""
        return self._keyframe.take(rows), self._keypoint.take(rows)

    def sights(
        self, rows: NDArray[np.int64] | NDArray[np.int32]
    ) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return the (N,) landmark slots and keypoints of (N,) rows."""
        return self._landmark.take(rows), self._keypoint.take(rows)

    def of_keyframes(
        self, keyframes: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """Return the CSR view (indptr, rows) of (N,) keyframes."""
        return self._by_keyframe.gather(keyframes)

    def of_landmarks(
        self, landmarks: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """Return the CSR view (indptr, rows) of (N,) landmark slots."""
        return self._by_landmark.gather(landmarks)

    def count(self, landmarks: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return how many keyframes see each of (N,) landmark slots."""
        return self._by_landmark.counts(landmarks)

    def count_of(self, keyframes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return how many landmarks each of (N,) keyframes sees."""
        return self._by_keyframe.counts(keyframes)

    def first_keyframe(self, landmarks: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the lowest keyframe that sees each of (N,) landmark slots, -1 where none does."""
        indptr, rows = self.of_landmarks(landmarks)
        first = np.full(len(landmarks), -1, np.int64)
        seen = np.flatnonzero(np.diff(indptr) > 0)
        if len(seen):
            first[seen] = np.minimum.reduceat(self._keyframe[rows], indptr[seen])
        return first

    def find(self, keyframes: NDArray[np.int64], landmarks: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the (N,) rows of N pairs, -1 where there is none."""
        indptr, rows = self.of_landmarks(landmarks)
        pair = np.repeat(np.arange(len(landmarks)), np.diff(indptr))
        hit = self._keyframe[rows] == keyframes[pair]
        found = np.full(len(landmarks), -1, np.int64)
        found[pair[hit]] = rows[hit]
        return found

    def covisible(self, keyframe: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Count what a keyframe sees together with others.

        Returns:
            ids and counts (n,) of the keyframes that share a landmark, most first, then oldest.
        """
        _, rows = self.of_keyframes(np.array([keyframe]))
        _, others = self.of_landmarks(self._landmark[rows].astype(np.int64))
        counts = np.bincount(self._keyframe[others]) if len(others) else np.zeros(0, np.int64)
        counts[keyframe : keyframe + 1] = 0
        ids = np.flatnonzero(counts)
        order = np.argsort(-counts[ids], kind="stable")
        return ids[order], counts[ids[order]]

    def add(
        self,
        keyframes: NDArray[np.int64],
        landmarks: NDArray[np.int64],
        keypoints: NDArray[np.int64],
    ) -> int:
        """Add observations; a pair already there takes the new keypoint.

        Args:
            keyframes: (N,) ids.
            landmarks: (N,) slots; of a pair that comes twice the last keypoint counts.
            keypoints: (N,) indices into the keyframes' features, -1 where there is none.

        Returns:
            How many rows were added.
        """
        pair = keyframes << 32 | landmarks
        last = np.zeros(len(pair), np.bool_)
        last[len(pair) - 1 - np.unique(pair[::-1], return_index=True)[1]] = True
        keyframes, landmarks, keypoints = keyframes[last], landmarks[last], keypoints[last]
        if self.count_of(distinct(keyframes)).any():  # new keyframes have none to be looked for
            known = self.find(keyframes, landmarks)
            old = known >= 0
            self._keypoint[known[old]] = keypoints[old]
            keyframes, landmarks, keypoints = keyframes[~old], landmarks[~old], keypoints[~old]
        rows = self._new_rows(len(landmarks))
        self._keyframe[rows] = keyframes
        self._landmark[rows] = landmarks
        self._keypoint[rows] = keypoints
        self._alive[rows] = True
        self._by_keyframe.append(keyframes, rows.astype(np.int32))
        self._by_landmark.append(landmarks, rows.astype(np.int32))
        return len(rows)

    def remove(self, rows: NDArray[np.int64] | NDArray[np.int32]) -> None:
        """Remove (N,) living rows."""
        gone = distinct(rows.astype(np.int64))
        self._alive[gone] = False
        self._by_keyframe.keep(distinct(self._keyframe[gone]).astype(np.int64), self._alive.values)
        self._by_landmark.keep(distinct(self._landmark[gone]).astype(np.int64), self._alive.values)
        self._free.extend(gone.tolist())

    def reassign(self, gone: NDArray[np.int64], survivors: NDArray[np.int64]) -> None:
        """Hand the rows of N distinct landmarks to N survivors (none of them among the gone).

        Where a keyframe sees both, the row the survivor had stays.
        """
        indptr, rows = self.of_landmarks(gone)
        heirs = np.repeat(survivors, np.diff(indptr))
        keyframes = self._keyframe[rows].astype(np.int64)
        key = keyframes << 32 | heirs
        moves = np.zeros(len(rows), np.bool_)
        moves[np.unique(key, return_index=True)[1]] = True
        moves &= self.find(keyframes, heirs) < 0
        self.remove(rows[~moves])
        rows, heirs = rows[moves], heirs[moves]
        self._by_landmark.clear(gone)
        self._landmark[rows] = heirs
        self._by_landmark.append(heirs, rows)

    def _new_rows(self, number: int) -> NDArray[np.int64]:
        cut = max(len(self._free) - number, 0)
        reused = self._free[cut:]
        del self._free[cut:]
        fresh = self._end + np.arange(number - len(reused), dtype=np.int64)
        self._end += len(fresh)
        self._keyframe.reserve(self._end)
        self._landmark.reserve(self._end)
        self._keypoint.reserve(self._end)
        self._alive.reserve(self._end)
        return np.concatenate([np.asarray(reused, np.int64), fresh])
