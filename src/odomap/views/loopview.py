"""What a run's loops look like: which there were, and the path before and after.

Before is the path as the tracker told it frame by frame; after is the path as known at the end. In
either a loop is a line between two keyframes: where the camera came back, and where it had been. A
keyframe that is no frame of this run, of a map that was there before, is where the map has it.

Cost: O(frames + loops).
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from odomap.files.loops import LoopLog, LoopRecord
from odomap.geometry.pose import Sim3
from odomap.geometry.trajectory import Trajectory
from odomap.maps.atlas import Atlas
from odomap.maps.edges import GAP, LOOP
from odomap.maps.map import Map

__all__ = ["LoopView", "gap_ends", "loop_ends"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LoopView:
    """The loops of a run, ready to be shown.

    Attributes:
        log: what was decided.
        live: the path as it was told when frames came.
        before: (L, 2, 3) of the loops that were closed, the keyframe that came back and the one it
            came back to, in the path before.
        after: (L, 2, 3) the same in the path at the end.
        scale: what lengths were multiplied with.
    """

    log: LoopLog
    live: Trajectory
    before: Array
    after: Array
    scale: float = 1.0

    @classmethod
    def of(cls, log: LoopLog, live: Trajectory, map: Map, scale: float = 1.0) -> Self:
        """Find where loops were, and where they are.

        Args:
            log: what was decided.
            live: the path as it was told when frames came.
            map: as it is at the end.
            scale: what all lengths are multiplied with, so that they are those of the truth.
        """
        closed = log.closed
        ids = np.array([[r.keyframe_id, r.matched_id] for r in closed], np.int64).reshape(-1, 2)
        after = map.Ts_world_body(ids.ravel())[:, :3, 3].reshape(-1, 2, 3)
        before = np.array([_told(r, live, at) for r, at in zip(closed, after)]).reshape(-1, 2, 3)
        shown = live.transformed(Sim3.from_parts(scale, np.eye(3), np.zeros(3)))
        return cls(log, shown, scale * before, scale * after, scale)

    @property
    def largest(self) -> int:
        """Which of the loops that were closed moved the path most; there must be one."""
        return int(np.argmax([record.moved for record in self.log.closed]))


def _told(record: LoopRecord, live: Trajectory, now: Array) -> Array:
    """Return (2, 3) where the ends of a loop were told to be; where nobody told, they are now."""
    out = now.copy()
    told = (record.frame, record.stamp_ns), (record.matched_frame, record.matched_stamp_ns)
    for k, (frame, stamp) in enumerate(told):
        row = int(np.searchsorted(live.stamps_ns, stamp))
        if frame >= 0 and row < len(live) and live.stamps_ns[row] == stamp:
            out[k] = live.positions[row]
    return out


def loop_ends(map: Map, t_body: Array | None = None) -> Array:
    """Return (L, 2, 3) where the ends of a map's loops are in the world, the newer one first.

    Args:
        map: may change meanwhile; ends that were culled are where their stubs are.
        t_body: (3,) the point on the body that is wanted; default its origin.
    """
    edges = map.edges()
    chosen = np.flatnonzero(np.array(edges.kind, str) == LOOP)
    return _places(map, np.stack([edges.j[chosen], edges.i[chosen]], axis=1), t_body)


def gap_ends(map: Map, t_body: Array | None = None) -> Array:
    """Return (G, 2, 3) where the ends of gaps are that no loop has closed yet.

    Args:
        map: may change meanwhile.
        t_body: (3,) the point on the body that is wanted; default its origin.
    """
    pieces = Atlas(map).pieces if GAP in map.edges().kind else ()
    ids = [(piece.after_id, piece.first_id) for piece in pieces if piece.after_id >= 0]
    return _places(map, np.array(ids, np.int64).reshape(-1, 2), t_body)


def _places(map: Map, ids: NDArray[np.int64], t_body: Array | None) -> Array:
    """Return the places (n, 2, 3) of keyframes (n, 2)."""
    Ts = map.Ts_world_body(ids.ravel())
    places = Ts[:, :3, 3] if t_body is None else Ts[:, :3, :3] @ t_body + Ts[:, :3, 3]
    return np.asarray(places.reshape(-1, 2, 3))
