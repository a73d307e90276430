"""Which piece of a map a keyframe is in, while keyframes of a laser come one after the other.

A body that was carried away unseen begins a piece of which nothing is known relative to the others
(`maps/atlas`); recognised in an older one it goes on there, and the next keyframe belongs to that.
So keyframes change pieces in runs,

    k_0 = 0 < k_1 < ...:    keyframes k_n ≤ k < k_{n+1} are of piece p_n,

and where a loop joins two pieces the newer takes the name of the older. What `Atlas` reads off a
whole map is here kept up as it grows, for a search at every keyframe.

Cost: O(log runs) to ask.
"""

from bisect import bisect_right

from odomap.maps.atlas import Atlas
from odomap.maps.map import Map

__all__ = ["Pieces"]


class Pieces:
    """The pieces of a map by keyframe; each is named by its first one.

    Args:
        map: with its pieces so far.
    """

    def __init__(self, map: Map) -> None:
        found = sorted((k, p.first_id) for p in Atlas(map).pieces for k in p.keyframe_ids.tolist())
        self._starts, self._names = [0], [found[0][1] if found else 0]
        for k, name in found:
            self.enter(k, name)

    @property
    def is_one(self) -> bool:
        """Whether all keyframes are placed relative to each other."""
        return len(set(self._names)) == 1

    def of(self, keyframe_id: int) -> int:
        """Return the piece that a keyframe is in."""
        return self._names[bisect_right(self._starts, keyframe_id) - 1]

    def enter(self, keyframe_id: int, piece: int) -> None:
        """Let a new keyframe, and those after it, be of a piece."""
        if self._names[-1] != piece:
            self._starts.append(keyframe_id)
            self._names.append(piece)

    def join(self, one: int, other: int) -> None:
        """Make two pieces one, named as the older."""
        older, newer = sorted((one, other))
        self._names = [older if name == newer else name for name in self._names]
