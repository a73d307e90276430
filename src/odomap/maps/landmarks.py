"""Landmarks: points of the world, each stored relative to a keyframe that saw it.

A landmark is a row of arrays, never an object. Its place is p_anchor in the frame and units of its
anchor keyframe; in the world it is at T_world_anchor (s_anchor p_anchor), so that it moves with its
anchor when a loop closes. Rows (slots) are used again after a landmark is gone, ids never: a table
id → slot is kept, in which the id of a fused landmark points at the id of its survivor, as in a
union-find forest (R. Tarjan, Efficiency of a good but not linear set union algorithm, 1975).
Looking up N ids is O(N); paths are shortened on the way. Where the beginning of the table is dead,
which is followed as landmarks are added, it is cut off when the table would grow, so that odometry,
which forgets what it passed, needs constant memory.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.maps.column import Column
from odomap.maps.columns import distinct
from odomap.maps.ragged import Ragged

__all__ = ["Landmarks"]

_DEAD = -1


class Landmarks:
    """Struct of arrays by slot.

    Attributes:
        ids: (M,) id of the landmark in each slot, -1 in free slots.
        anchor: (M,) id of the keyframe it is stored relative to.
        p_anchor: (M, 3) place in the anchor's body frame and units.
        descriptor: (M, 32) uint8, how it looks.
        seen: (M,) frames it was seen in, as counted by the tracker.
        expected: (M,) frames it should have been seen in.
    """

    def __init__(self) -> None:
        self.ids = Column[np.int64].empty(np.int64)
        self.anchor = Column[np.int32].empty(np.int32)
        self.p_anchor = Column[np.float64].empty(np.float64, 3)
        self.descriptor = Column[np.uint8].empty(np.uint8, 32)
        self.seen = Column[np.int32].empty(np.int32)
        self.expected = Column[np.int32].empty(np.int32)
        self._by_anchor = Ragged()
        self._free: list[int] = []
        self._end = 0
        # entry of id first + n: a slot, or _DEAD, or -2 - id of the survivor
        self._entry = Column[np.int64].empty(np.int64)
        self._first = 0
        self._next = 0
        self._oldest = 0  # no id below it is of use

    def __len__(self) -> int:
        return self._end - len(self._free)

    @property
    def next_id(self) -> int:
        """The id that the next landmark will have."""
        return self._next

    def columns(self) -> tuple[Column[Any], ...]:
        """Return the columns that `twin` needs copies of."""
        return (*self._by_slot(), self._entry)

    def twin(self, copies: Iterator[Column[Any]]) -> "Landmarks":
        """Return the same table, to be read only, made of copies of `columns`."""
        twin = Landmarks()
        twin.ids, twin.anchor, twin.p_anchor = next(copies), next(copies), next(copies)
        twin.descriptor, twin.seen, twin.expected = next(copies), next(copies), next(copies)
        twin._entry = next(copies)
        twin._free, twin._end = self._free.copy(), self._end
        twin._first, twin._next = self._first, self._next
        return twin

    def dump(self) -> dict[str, NDArray[Any]]:
        """Return copies of all that decides how the table goes on.

        Returns:
            By name: slot, id, anchor, p_anchor, descriptor, seen, expected of the (M,) landmarks
            in order of their slots; free, the (S,) slots to be used again, the last first; fused
            and survivor, the (F,) ids that mean another landmark, and its id.
        """
        slots = self.all_slots()
        known = self._entry.values[: self._next - self._first]
        fused = self._first + np.flatnonzero(known <= -2)
        heirs = self.slots(fused)
        return {
            "slot": slots,
            "id": self.ids[slots],
            "anchor": self.anchor[slots],
            "p_anchor": self.p_anchor[slots],
            "descriptor": self.descriptor[slots],
            "seen": self.seen[slots],
            "expected": self.expected[slots],
            "free": np.asarray(self._free, np.int64),
            "fused": fused[heirs >= 0],
            "survivor": self.ids[heirs[heirs >= 0]],
        }

    def restore(self, columns: Mapping[str, NDArray[Any]], next_id: int) -> None:
        """Fill an empty table with what `dump` returned; O(ids since the oldest one alive)."""
        slots, ids = columns["slot"], columns["id"]
        self._free = columns["free"].tolist()
        self._end = len(slots) + len(self._free)
        for column in self._by_slot():
            column.reserve(self._end)
        self.ids[columns["free"]] = _DEAD
        self.ids[slots], self.anchor[slots] = ids, columns["anchor"]
        self.p_anchor[slots], self.seen[slots] = columns["p_anchor"], columns["seen"]
        self.descriptor[slots], self.expected[slots] = columns["descriptor"], columns["expected"]
        self._by_anchor.append(columns["anchor"].astype(np.int64), slots.astype(np.int32))
        oldest = (int(known.min(initial=next_id)) for known in (ids, columns["fused"]))
        self._first = self._oldest = min(oldest)
        self._next = next_id
        self._entry.reserve(next_id - self._first)
        self._entry[: next_id - self._first] = _DEAD
        self._entry[ids - self._first] = slots
        self._entry[columns["fused"] - self._first] = -2 - columns["survivor"]

    def slots(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the (N,) slots of (N,) ids; a fused id gives its survivor's, a dead one -1."""
        entry = self._lookup(ids)
        fused = np.flatnonzero(entry <= -2)
        if not len(fused):
            return entry
        heirs = -2 - entry[fused]
        found = self._lookup(heirs)
        while (forward := found <= -2).any():
            heirs[forward] = -2 - found[forward]
            found = self._lookup(heirs)
        self._entry[ids[fused] - self._first] = np.where(found >= 0, -2 - heirs, _DEAD)
        entry[fused] = found
        return entry

    def all_slots(self) -> NDArray[np.int64]:
        """Return the slots in use, in order."""
        return np.flatnonzero(self.ids.values[: self._end] >= 0)

    def all_ids(self) -> NDArray[np.int64]:
        """Return the ids of living landmarks, ascending."""
        known = self._entry.values[: self._next - self._first]
        return self._first + np.flatnonzero(known >= 0)

    def anchored(self, keyframes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the slots of all landmarks stored relative to some keyframes."""
        return self._by_anchor.gather(keyframes)[1].astype(np.int64)

    def add(
        self,
        anchors: NDArray[np.int64],
        p_anchor: NDArray[np.float64],
        descriptors: NDArray[np.uint8] | None,
    ) -> NDArray[np.int64]:
        """Add landmarks.

        Args:
            anchors: (N,) keyframe ids.
            p_anchor: (N, 3) places in the anchors' frames and units.
            descriptors: (N, 32), or None for zeros.

        Returns:
            (N,) their ids, ascending.
        """
        number = len(p_anchor)
        slots = self._new_slots(number)
        ids = self._next + np.arange(number, dtype=np.int64)
        self._follow_the_oldest(number)
        self._next += number
        self._entry.reserve(self._next - self._first)
        self._entry[ids - self._first] = slots
        self.ids[slots] = ids
        self.anchor[slots] = anchors
        self.p_anchor[slots] = p_anchor
        self.descriptor[slots] = 0 if descriptors is None else descriptors
        self.seen[slots] = self.expected[slots] = 0
        self._by_anchor.append(anchors, slots.astype(np.int32))
        return ids

    def graft(self, columns: Mapping[str, NDArray[Any]], offset: int) -> NDArray[np.int64]:
        """Take in the landmarks of another table, with new ids in the order of those they had.

        Args:
            columns: what `dump` returned.
            offset: its keyframe k is called offset + k here.

        Returns:
            (M,) their slots here, in the order of `columns`.
        """
        order = np.argsort(columns["id"], kind="stable")
        anchors = offset + columns["anchor"].astype(np.int64)
        look, places = columns["descriptor"], columns["p_anchor"]
        slots = np.empty(len(order), np.int64)
        slots[order] = self.slots(self.add(anchors[order], places[order], look[order]))
        self.seen[slots], self.expected[slots] = columns["seen"], columns["expected"]
        return slots

    def reanchor(
        self,
        slots: NDArray[np.int64],
        anchors: NDArray[np.int64],
        p_anchor: NDArray[np.float64],
    ) -> None:
        """Store (N,) distinct landmarks relative to other keyframes, at (N, 3) places."""
        self._leave_anchors(slots)
        self.anchor[slots] = anchors
        self.p_anchor[slots] = p_anchor
        self._by_anchor.append(anchors, slots.astype(np.int32))

    def remove(self, slots: NDArray[np.int64]) -> None:
        """Remove (N,) distinct landmarks; their ids are dead from now on."""
        self._entry[self.ids[slots] - self._first] = _DEAD
        self._vacate(slots)

    def forward(self, gone: NDArray[np.int64], survivors: NDArray[np.int64]) -> None:
        """Remove the landmarks in N distinct slots; their ids follow those in N other slots."""
        self.seen.add(survivors, self.seen[gone])
        self.expected.add(survivors, self.expected[gone])
        self._entry[self.ids[gone] - self._first] = -2 - self.ids[survivors]
        self._vacate(gone)

    def _lookup(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        known = (ids >= self._first) & (ids < self._next)
        if known.all():
            return self._entry[ids - self._first]
        entry = np.full(len(ids), _DEAD, np.int64)
        entry[known] = self._entry[ids[known] - self._first]
        return entry

    def _follow_the_oldest(self, number: int) -> None:
        """Pass over dead ids at the beginning of the table; cut them off when most are dead."""
        start = self._oldest - self._first
        stop = min(start + 8 * number + 1024, self._next - self._first)
        ids = self._first + np.arange(start, stop, dtype=np.int64)
        alive = np.flatnonzero(self.slots(ids) >= 0)
        self._oldest += int(alive[0]) if len(alive) else len(ids)
        cut, known = self._oldest - self._first, self._next - self._first
        if 2 * cut > known + 1024 and not self._entry.is_followed:
            living = self._entry.values[cut:known]
            self._entry = Column[np.int64].empty(np.int64)
            self._entry.reserve(len(living))
            self._entry[: len(living)] = living
            self._first = self._oldest

    def _by_slot(self) -> tuple[Column[Any], ...]:
        return self.ids, self.anchor, self.p_anchor, self.descriptor, self.seen, self.expected

    def _leave_anchors(self, slots: NDArray[np.int64]) -> None:
        stays = np.ones(self._end, np.bool_)
        stays[slots] = False
        self._by_anchor.keep(distinct(self.anchor[slots]).astype(np.int64), stays)

    def _vacate(self, slots: NDArray[np.int64]) -> None:
        self._leave_anchors(slots)
        self.ids[slots] = -1
        self._free.extend(slots.tolist())

    def _new_slots(self, number: int) -> NDArray[np.int64]:
        cut = max(len(self._free) - number, 0)
        reused = self._free[cut:]
        del self._free[cut:]
        fresh = self._end + np.arange(number - len(reused), dtype=np.int64)
        self._end += len(fresh)
        for column in self._by_slot():
            column.reserve(self._end)
        return np.concatenate([np.asarray(reused, np.int64), fresh])
