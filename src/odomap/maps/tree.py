"""The spanning tree of keyframes, and the stubs that culled ones leave.

Each keyframe but the root has a parent, the keyframe it was placed against. The tree says two
things the poses alone cannot: whom a keyframe follows that was created while a solver was busy, and
where the frames go that hang from a keyframe which is culled. A culled keyframe c with parent p
leaves the stub (p, S_p_c), so that S_c = S_p S_p_c from then on. Children and stubs of c are handed
to p in the same step, S_p_x = S_p_c S_c_x: a stub therefore always hangs from a living keyframe,
and following one takes a single step. Culling costs O(K) over nine bytes per keyframe.

Reference: R. Mur-Artal, J. Montiel, J. Tardós, ORB-SLAM: a versatile and accurate monocular SLAM
system, 2015 (spanning tree, keyframe culling).
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.maps.columns import grown
from odomap.maps.growth import hand_on
from odomap.maps.states import Placement, States, compose, inverse

__all__ = ["ABSENT", "ALIVE", "STUB", "Tree"]

ABSENT, ALIVE, STUB = 0, 1, 2


class Tree:
    """Who hangs from whom; the row of a keyframe is its id.

    Attributes:
        status: (K,) uint8, ABSENT, ALIVE or STUB.
        parent: (K,) int64, the living parent, -1 for the root.
        created: (K,) int64, version of the map that the keyframe came with.
    """

    def __init__(self) -> None:
        self.status = np.zeros(0, np.uint8)
        self.parent = np.zeros(0, np.int64)
        self.created = np.zeros(0, np.int64)
        self._Ts_parent_self = np.zeros((0, 4, 4))
        self._scales_parent_self = np.zeros(0)

    def add(self, keyframe: int, parent: int, version: int) -> None:
        """Enter a living keyframe below a living parent, or as the root with parent -1."""
        rows = keyframe + 1
        self.status = grown(self.status, rows)
        self.parent = grown(self.parent, rows, fill=-1)
        self.created = grown(self.created, rows)
        self._Ts_parent_self = grown(self._Ts_parent_self, rows)
        self._scales_parent_self = grown(self._scales_parent_self, rows)
        self.status[keyframe] = ALIVE
        self.parent[keyframe] = parent
        self.created[keyframe] = version

    def dump(self, rows: int) -> dict[str, NDArray[Any]]:
        """Return copies of all columns, of so many keyframes."""
        return {
            "status": self.status[:rows].copy(),
            "parent": self.parent[:rows].copy(),
            "created": self.created[:rows].copy(),
            "Ts_parent_self": self._Ts_parent_self[:rows].copy(),
            "scales_parent_self": self._scales_parent_self[:rows].copy(),
        }

    def restore(self, columns: Mapping[str, NDArray[Any]]) -> None:
        """Fill an empty tree with what `dump` returned."""
        self.graft(columns, 0, -1, 0)

    def graft(
        self, columns: Mapping[str, NDArray[Any]], offset: int, holder: int, version: int
    ) -> int:
        """Enter another tree below a living keyframe.

        Args:
            columns: what `dump` returned.
            offset: its keyframe k is called offset + k here.
            holder: its root's parent, −1 if this tree is empty.
            version: of the map; all of it comes after that.

        Returns:
            What its root is called here, −1 if it has none.
        """
        rows = len(columns["status"])
        end, status, parent = offset + rows, columns["status"], columns["parent"]
        self.status = grown(self.status, end)
        self.parent = grown(self.parent, end, fill=-1)
        self.created = grown(self.created, end)
        self._Ts_parent_self = grown(self._Ts_parent_self, end)
        self._scales_parent_self = grown(self._scales_parent_self, end)
        is_there, is_root = status != ABSENT, (status == ALIVE) & (parent < 0)
        below = np.where(is_root, holder, np.where(parent < 0, -1, parent + offset))
        self.status[offset:end], self.parent[offset:end] = status, below
        self.created[offset:end] = np.where(is_there, columns["created"] + version, 0)
        self._Ts_parent_self[offset:end] = columns["Ts_parent_self"]
        self._scales_parent_self[offset:end] = columns["scales_parent_self"]
        return offset + int(np.argmax(is_root)) if is_root.any() else -1

    def twin(self) -> "Tree":
        """Return the same tree, copied."""
        twin = Tree()
        twin.status, twin.parent = self.status.copy(), self.parent.copy()
        twin.created = self.created.copy()
        twin._Ts_parent_self = self._Ts_parent_self.copy()
        twin._scales_parent_self = self._scales_parent_self.copy()
        return twin

    def status_of(self, keyframe: int) -> int:
        """Return ABSENT, ALIVE or STUB; ids never given are absent."""
        return int(self.status[keyframe]) if 0 <= keyframe < len(self.status) else ABSENT

    def alive(self) -> NDArray[np.int64]:
        """Return the ids of living keyframes in order."""
        return np.flatnonzero(self.status == ALIVE)

    def newborn(self, version: int) -> NDArray[np.int64]:
        """Return the living keyframes that came after a version of the map, oldest first."""
        ids = np.flatnonzero((self.created > version) & (self.status == ALIVE))
        return ids[np.argsort(self.created[ids], kind="stable")]

    def placements(self, states: States, keyframes: NDArray[np.int64]) -> Placement:
        """Return (n, 4, 4) poses and (n,) scales of living keyframes and stubs alike."""
        stub = self.status[keyframes] == STUB
        if not stub.any():
            return states.placements(keyframes)
        holders = np.where(stub, self.parent[keyframes], keyframes)
        Ts, scales = states.placements(holders)
        held = keyframes[stub]
        relative = self._Ts_parent_self[held], self._scales_parent_self[held]
        Ts[stub], scales[stub] = compose((Ts[stub], scales[stub]), relative)
        return Ts, scales

    def cull(self, states: States, keyframe: int, holder: int = -1) -> int:
        """Turn a living keyframe into a stub and hand on what hung from it.

        Args:
            states: where the keyframes are.
            keyframe: a living keyframe, not the last one.
            holder: a living keyframe that came before it, which is to hold the stub; by default
                the parent or, for the root, its eldest child, which becomes the root.

        Returns:
            The living keyframe that now holds the stub.

        Raises:
            ValueError: the holder came after it, and might hang from it.
        """
        children = np.flatnonzero((self.parent == keyframe) & (self.status == ALIVE))
        stubs = np.flatnonzero((self.parent == keyframe) & (self.status == STUB))
        if holder >= 0 and self.created[holder] >= self.created[keyframe]:
            raise ValueError(f"keyframe {holder} came after {keyframe}, which it is to hold")
        is_parent = holder in (-1, int(self.parent[keyframe]))
        holder = int(self.parent[keyframe]) if holder < 0 else holder
        if holder < 0:
            holder = int(children[np.argmin(self.created[children])])
        if is_parent:
            hand_on(states, keyframe, holder, children)
        else:  # nobody told how sure it is from there
            states.growths[np.r_[children, keyframe]] = np.nan
        self.parent[children] = np.where(children == holder, self.parent[keyframe], holder)
        moved = np.r_[keyframe, stubs]
        placed = self.placements(states, moved)
        T_world_holder, scale = states.placements(np.array([holder]))
        self.status[keyframe] = STUB
        self.parent[moved] = holder
        self._Ts_parent_self[moved], self._scales_parent_self[moved] = compose(
            inverse((T_world_holder, scale)), placed
        )
        return holder
