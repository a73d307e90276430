"""The loopbook of a run: every candidate for a loop that was decided on, when it was.

An observer of the worker. A keyframe may be culled before anybody asks for its time, or even before
the decision is told; so stamps are noted as keyframes come, two numbers each, and those of a map
that was there before when the run begins. Frames are found by their stamps in the end.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Self

from odomap.files.loops import LoopRecord
from odomap.maps.estimate import Estimate

if TYPE_CHECKING:
    from odomap.maps.keyframes import Keyframe
    from odomap.maps.map import Map
    from odomap.system.stages import Loop
    from odomap.system.worker import Worker

__all__ = ["LoopBook"]


class LoopBook:
    """Collect what a closer decides.

    Args:
        map: that is worked on.
    """

    def __init__(self, map: "Map") -> None:
        self._map = map
        self._loops: list[Loop] = []
        self._stamps = {k: map.keyframe(k).stamp_ns for k in map.keyframe_ids.tolist()}
        self._before = frozenset(self._stamps)

    @classmethod
    def of(cls, worker: "Worker") -> Self | None:
        """Return a book that a worker fills from now on; None where nobody looks for loops."""
        if worker.stages.closer is None:
            return None
        book = cls(worker.stages.map)
        worker.on_keyframe.append(book.note)
        worker.on_loop.append(book.add)
        return book

    def note(self, keyframe: "Keyframe") -> None:
        """Note when a keyframe was."""
        self._stamps[keyframe.id] = keyframe.stamp_ns

    def add(self, loop: "Loop") -> None:
        """Note what was decided."""
        if loop.stamps_ns is not None:
            self._stamps.update(zip((loop.keyframe_id, loop.matched_id), loop.stamps_ns))
        for k in (loop.keyframe_id, loop.matched_id):
            if k not in self._stamps:  # made with another one, of which alone was told
                with self._map.lock:
                    if self._map.is_keyframe_alive(k):
                        self.note(self._map.keyframe(k))
        self._loops.append(loop)

    @property
    def num_closed(self) -> int:
        """How many candidates were believed."""
        return sum(loop.is_accepted for loop in self._loops)

    @property
    def num_rejected(self) -> int:
        """How many were not."""
        return len(self._loops) - self.num_closed

    def records(self, estimates: Sequence[Estimate]) -> tuple[LoopRecord, ...]:
        """Return what was decided, with the frames of the keyframes.

        Args:
            estimates: of the run's frames.
        """
        frames = {e.stamp_ns: e.frame_id for e in estimates}
        return tuple(self._record(loop, frames) for loop in self._loops)

    def _record(self, loop: "Loop", frames: dict[int, int]) -> LoopRecord:
        stamp, matched_stamp = (self._stamps.get(k, 0) for k in (loop.keyframe_id, loop.matched_id))
        is_new = loop.matched_id not in self._before
        return LoopRecord(
            keyframe_id=loop.keyframe_id,
            matched_id=loop.matched_id,
            frame=frames.get(stamp, -1),
            matched_frame=frames.get(matched_stamp, -1) if is_new else -1,
            stamp_ns=stamp,
            matched_stamp_ns=matched_stamp,
            num_inliers=loop.num_inliers,
            is_accepted=loop.is_accepted,
            reason=loop.reason,
            merges=loop.merges,
            moved=loop.moved,
            turned=loop.turned,
            rescaled=loop.rescaled,
            T_matched_keyframe=loop.T_matched_keyframe,
            doubts=loop.doubts,
            is_tied=loop.is_tied,
        )
