"""Lockstep: mapping and closing beside the tracker, with the same bytes on every run.

A parallel run usually depends on which thread was faster. Here it cannot: the change of keyframe k
is written exactly d frames later, before the tracker is given that frame, waiting if it is not
solved yet. All reading and writing of the map is in the tracker's thread, at moments that are
counted in frames, so that the path is a function of the frames and of d alone:

    frame  n   tracked, becomes keyframe k; its job is started
    frame  n+1 … n+d−1    tracked on the map as it was, while the job is solved
    frame  n+d            the change is written, then the frame is tracked

With d = 1 every frame sees the map that it would see inline, and the job has the time in which the
next frame is read; with d = 0 the rhythm is inline. A stage has one job out at most: where a
keyframe comes before d frames are over, the change before it is written first, so that `add` reads
a map which is known. The closer is given a keyframe when the mapper has written what it found.

Observers are called in the caller's thread. Timing per frame includes the waiting.

Reference: none in print; the idea is that of the synchronous languages (Benveniste, Berry, "The
synchronous approach to reactive and real-time systems", 1991): a delay is a number of steps.
"""

import time
from dataclasses import replace

from odomap.maps.estimate import Estimate
from odomap.maps.keyframes import Keyframe
from odomap.sensors.frame import Frame
from odomap.system.background import Lane, QuickSwitching, ThreadConfig
from odomap.system.stages import Stages
from odomap.system.worker import Worker

__all__ = ["LockstepWorker"]


class LockstepWorker(Worker):
    """Changes are written a fixed number of frames after they were begun.

    Args:
        stages: the agents of the run.
        config: the delays.
    """

    def __init__(self, stages: Stages, config: ThreadConfig | None = None) -> None:
        super().__init__(stages)
        config = ThreadConfig() if config is None else config
        self._lanes: list[Lane] = []
        self._delays: list[int] = []
        for name, stage, delay in (
            ("map", stages.mapper, config.mapping_delay),
            ("close", stages.closer, config.closing_delay),
        ):
            if stage is not None:
                self._lanes.append(Lane(name, stage))
                self._delays.append(delay)
        self._due = [0] * len(self._lanes)
        self._count = 0
        self._laps: dict[str, float] = {}
        self._switching = QuickSwitching()

    def advance(self, frame: Frame) -> Estimate:
        """Write what is due, waiting for it; track the frame; start what its keyframe asks for."""
        self._count, self._laps = self._count + 1, {}
        for index, lane in enumerate(self._lanes):
            if lane.is_out and self._due[index] <= self._count:
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
                if lane.is_out:
                    self._collect(index)
            self._tell_map()
        finally:
            self.close()

    def close(self) -> None:
        """End the threads; a job that is out is lost, unless `finish` wrote it."""
        for lane in self._lanes:
            lane.close()
        self._switching.release()

    def _hand(self, index: int, keyframe: Keyframe) -> None:
        """Give a keyframe to a stage, when the change before it is written."""
        if index == len(self._lanes):
            return
        lane = self._lanes[index]
        if lane.is_out:
            self._collect(index)
        self._switching.hold()
        start = time.perf_counter()
        is_out = lane.start(keyframe)
        self._lap(lane, start)
        if not is_out:
            self._hand(index + 1, keyframe)
            return
        self._due[index] = self._count + self._delays[index]
        if self._delays[index] == 0:
            self._collect(index)

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
