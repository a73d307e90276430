"""Landmarks: points of the world, each stored relative to a keyframe that saw it.

A landmark is a row of arrays, never an object. Its place is p_anchor in the frame and units of its
anchor keyframe; in the world it is at T_world_anchor (s_anchor p_anchor), so that it moves with its
anchor when a loop closes. Rows (slots) are used again after a landmark is gone, ids never: a table
id → slot is kept, in which the id of a fused landmark points at the id of its survivor, as in a
union-find forest (R. Tarjan, Efficiency of a good but not linear set union algorithm, 1975).
Looking up N ids is O(N). The table is compacted when it would grow: paths are shortened, dead ids
at its beginning are cut off, so that odometry, which forgets what it passed, needs constant memory.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.maps.columns import distinct, grown
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
        self.ids = np.zeros(0, np.int64)
        self.anchor = np.zeros(0, np.int32)
        self.p_anchor = np.zeros((0, 3))
        self.descriptor = np.zeros((0, 32), np.uint8)
        self.seen = np.zeros(0, np.int32)
        self.expected = np.zeros(0, np.int32)
        self._by_anchor = Ragged()
        self._free: list[int] = []
        self._end = 0
        # entry of id first + n: a slot, or _DEAD, or -2 - id of the survivor
        self._entry = np.zeros(0, np.int64)
        self._first = 0
        self._next = 0

    def __len__(self) -> int:
        return self._end - len(self._free)

    @property
    def next_id(self) -> int:
        """The id that the next landmark will have."""
        return self._next

    def dump(self) -> dict[str, NDArray[Any]]:
        """Return copies of all that decides how the table goes on.

        Returns:
            By name: slot, id, anchor, p_anchor, descriptor, seen, expected of the (M,) landmarks
            in order of their slots; free, the (S,) slots to be used again, the last first; fused
            and survivor, the (F,) ids that mean another landmark, and its id.
        """
        slots = self.all_slots()
        fused = self._first + np.flatnonzero(self._entry[: self._next - self._first] <= -2)
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
        self.ids = grown(self.ids, self._end, fill=_DEAD)
        self.anchor = grown(self.anchor, self._end)
        self.p_anchor = grown(self.p_anchor, self._end)
        self.descriptor = grown(self.descriptor, self._end)
        self.seen = grown(self.seen, self._end)
        self.expected = grown(self.expected, self._end)
        self.ids[slots], self.anchor[slots] = ids, columns["anchor"]
        self.p_anchor[slots], self.seen[slots] = columns["p_anchor"], columns["seen"]
        self.expected[slots] = columns["expected"]
        self.descriptor[slots] = columns["descriptor"]
        self._by_anchor.append(columns["anchor"].astype(np.int64), slots.astype(np.int32))
        oldest = (int(known.min(initial=next_id)) for known in (ids, columns["fused"]))
        self._first, self._next = min(oldest), next_id
        self._entry = np.full(next_id - self._first, _DEAD, np.int64)
        self._entry[ids - self._first] = slots
        self._entry[columns["fused"] - self._first] = -2 - columns["survivor"]

    def slots(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the (N,) slots of (N,) ids; a fused id gives its survivor's, a dead one -1."""
        entry = self._lookup(ids)
        while (forward := entry <= -2).any():
            entry[forward] = self._lookup(-2 - entry[forward])
        return entry

    def all_slots(self) -> NDArray[np.int64]:
        """Return the slots in use, in order."""
        return np.flatnonzero(self.ids[: self._end] >= 0)

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
        if self._next + number - self._first > len(self._entry):
            self._compact()
            self._entry = grown(self._entry, self._next + number - self._first, fill=_DEAD)
        self._next += number
        self._entry[ids - self._first] = slots
        self.ids[slots] = ids
        self.anchor[slots] = anchors
        self.p_anchor[slots] = p_anchor
        self.descriptor[slots] = 0 if descriptors is None else descriptors
        self.seen[slots] = 0
        self.expected[slots] = 0
        self._by_anchor.append(anchors, slots.astype(np.int32))
        return ids

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
        np.add.at(self.seen, survivors, self.seen[gone])
        np.add.at(self.expected, survivors, self.expected[gone])
        self._entry[self.ids[gone] - self._first] = -2 - self.ids[survivors]
        self._vacate(gone)

    def _lookup(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        known = (ids >= self._first) & (ids < self._next)
        if known.all():
            return self._entry[ids - self._first]
        entry = np.full(len(ids), _DEAD, np.int64)
        entry[known] = self._entry[ids[known] - self._first]
        return entry

    def _compact(self) -> None:
        """Let every fused id point at its last survivor, and cut dead ids off the beginning."""
        known = self._next - self._first
        ids = self._first + np.arange(known, dtype=np.int64)
        fused = np.flatnonzero(self._entry[:known] <= -2)
        slots = self.slots(ids[fused])
        self._entry[fused] = np.where(slots >= 0, -2 - self.ids[slots], _DEAD)
        living = np.flatnonzero(self._entry[:known] != _DEAD)
        cut = int(living[0]) if len(living) else known
        if 2 * cut >= known:
            self._entry = self._entry[cut:].copy()
            self._first += cut

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
        self.ids = grown(self.ids, self._end, fill=-1)
        self.anchor = grown(self.anchor, self._end)
        self.p_anchor = grown(self.p_anchor, self._end)
        self.descriptor = grown(self.descriptor, self._end)
        self.seen = grown(self.seen, self._end)
        self.expected = grown(self.expected, self._end)
        return np.concatenate([np.asarray(reused, np.int64), fresh])
