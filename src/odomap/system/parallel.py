"""Parallel workers: what lockstep and live have in common.

Both track a frame while stages solve their jobs (`background`); they differ in when a change is due
and in what becomes of a keyframe whose stage is busy:

             a change is written                      a keyframe whose stage is busy
    lockstep a fixed number of frames later           waits for the change before it
    live     at the first frame that finds it solved  waits in line; the newest replaces it

Reading and writing of the map stay in the tracker's thread: a frame sees one map, from its first
look at it to its last.
"""

import time
from abc import abstractmethod
from dataclasses import replace

from odomap.maps.estimate import Estimate
from odomap.maps.keyframes import Keyframe
from odomap.sensors.frame import Frame
from odomap.system.background import Lane, QuickSwitching
from odomap.system.stages import Stages
from odomap.system.worker import Worker

__all__ = ["ParallelWorker"]


class ParallelWorker(Worker):
    """Tracks in the caller's thread, and has mapper and closer work beside it."""

    def __init__(self, stages: Stages) -> None:
        super().__init__(stages)
        named = ("map", stages.mapper), ("close", stages.closer)
        self._lanes = [Lane(name, stage) for name, stage in named if stage is not None]
        self._laps: dict[str, float] = {}
        self._switching = QuickSwitching()

    @abstractmethod
    def _is_due(self, index: int) -> bool:
        """Say whether the change of a job that is out is to be written before the next frame."""

    @abstractmethod
    def _hand(self, index: int, keyframe: Keyframe) -> None:
        """Give a keyframe to a stage, which may be busy; past the last one, do nothing."""

    def advance(self, frame: Frame) -> Estimate:
        """Write what is due, waiting for it; track the frame; start what its keyframe asks for."""
        self._laps = {}
        for index, lane in enumerate(self._lanes):
            if lane.is_out and self._is_due(index):
                self._collect(index)
        estimate = self.stages.tracker.track(frame)
        self._tell("on_estimate", self.on_estimate, estimate)
        if estimate.is_keyframe:
            keyframe = self.stages.map.keyframe(estimate.keyframe_id)
            self._tell("on_keyframe", self.on_keyframe, keyframe)
            self._hand(0, keyframe)
        self._tell_map()
        return replace(estimate, timing={**estimate.timing, **self._laps})

    def finish(self) -> None:
        """Write all that is out, stage after stage, and end the threads."""
        try:
            for index, lane in enumerate(self._lanes):
                while lane.is_out:
                    self._collect(index)
            self._tell_map()
        finally:
            self.close()

    def close(self) -> None:
        """End the threads; a job that is out is lost, unless `finish` wrote it."""
        for lane in self._lanes:
            lane.close()
        self._switching.release()

    def _start(self, index: int, keyframe: Keyframe) -> None:
        """Let a stage that is free begin with a keyframe; the next one gets what it leaves."""
        lane = self._lanes[index]
        self._switching.hold()
        start = time.perf_counter()
        is_out = lane.start(keyframe)
        self._lap(lane, start)
        if not is_out:
            self._hand(index + 1, keyframe)

    def _collect(self, index: int) -> None:
        """Wait for a job, write its change, and give the keyframe to the next stage."""
        lane = self._lanes[index]
        start = time.perf_counter()
        keyframe, change = lane.collect()
        change.write(self.stages.map)
        self._lap(lane, start)
        for loop in change.loops:
            self._tell("on_loop", self.on_loop, loop)
        self._hand(index + 1, keyframe)

    def _lap(self, lane: Lane, start: float) -> None:
        """Note what a stage has cost this frame, waiting included."""
        ms = 1e3 * (time.perf_counter() - start)
        self._laps[lane.name] = self._laps.get(lane.name, 0.0) + ms
