"""Lockstep: mapping and closing beside the tracker, with the same bytes on every run.

A parallel run usually depends on which thread was faster. Here it cannot: the change of keyframe k
is written exactly d frames later, before that frame is looked for in the map, waiting if it is not
solved yet. The map is read and written by one thread at a time, in an order that is counted in
frames, so that the path is a function of the frames and of d alone:

    frame  n   tracked, becomes keyframe k; its job is started
    frame  n+1 … n+d−1    tracked on the map as it was, while the job is solved
    frame  n+d            the change is written, then the frame is tracked

With d = 1 every frame sees the map that it would see inline, and the job has the time in which the
next frame is read and made ready; d = 0 is the same, with nothing beside the tracker. A stage has
one job out at most: a keyframe that comes before d frames are over waits in line, and where that is
full the change before it is written first, so that `add` reads a map which is known. The closer is
given a keyframe when the mapper has written what it found.

What takes a time that grows with the map (`Sideline`) has a delay that grows with the number of its
observations. Given up or not is a question of what was closed meanwhile, never of how far it came.

Observers are called in the caller's thread. Timing per frame includes the waiting.

Reference: none in print; the idea is that of the synchronous languages (Benveniste, Berry, "The
synchronous approach to reactive and real-time systems", 1991): a delay is a number of steps.
"""

from collections import deque

from odomap.maps.keyframes import Keyframe
from odomap.system.background import Sideline, ThreadConfig
from odomap.system.parallel import ParallelWorker
from odomap.system.stages import LongJob, Stages

__all__ = ["LockstepWorker"]


class LockstepWorker(ParallelWorker):
    """Changes are written a fixed number of frames after they were begun.

    Args:
        stages: the agents of the run.
        config: the delays.
    """

    def __init__(self, stages: Stages, config: ThreadConfig | None = None) -> None:
        super().__init__(stages)
        config = ThreadConfig() if config is None else config
        delays = {"map": config.mapping_delay, "close": config.closing_delay}
        longest = {"map": 0, "close": config.closing_line}
        self._delays = [delays[lane.name] for lane in self._lanes]
        self._longest = [longest[lane.name] for lane in self._lanes]
        self._lines: list[deque[Keyframe]] = [deque() for _ in self._lanes]
        self._closing_delay, self._pace = config.closing_delay, config.adjusting_pace
        self._due = [0] * len(self._lanes)
        self._adjusted = 0
        self._count = 0

    def _write_due(self) -> None:
        """Write what is due at the next frame, counted in the one order that there is."""
        self._count += 1
        super()._write_due()
        for index in range(len(self._lanes)):
            self._go_on(index)

    def _write_all(self) -> None:
        """Write what is out, and what those in line find."""
        self._longest = [0] * len(self._lanes)
        for index in range(len(self._lanes)):
            self._go_on(index)
        super()._write_all()

    def close(self) -> None:
        """End the threads; what is out or in line is lost, unless `finish` wrote it."""
        for line in self._lines:
            line.clear()
        super().close()

    def _is_due(self, index: int) -> bool:
        return self._due[index] <= self._count

    def _hand(self, index: int, keyframe: Keyframe) -> None:
        """Give a keyframe to a stage, when the change before it is written."""
        if index == len(self._lanes):
            return
        self._lines[index].append(keyframe)
        self._go_on(index)

    def _go_on(self, index: int) -> None:
        """Let a stage begin with the first in line if it is free, or if the line is full."""
        lane, line = self._lanes[index], self._lines[index]
        while line and (not lane.is_out or len(line) > self._longest[index]):
            if lane.is_out:
                self._collect(index)
            else:
                self._begin(index, line.popleft())

    def _begin(self, index: int, keyframe: Keyframe) -> None:
        self._start(index, keyframe)
        self._due[index] = self._count + self._delays[index]
        if self._lanes[index].is_out and self._delays[index] == 0:
            self._collect(index)

    def _is_adjusted(self) -> bool:
        return self._adjusted <= self._count

    def _adjust(self, adjusting: Sideline, job: LongJob) -> None:
        """Begin to adjust the whole map as it is now."""
        size = adjusting.start(job, reads_beside=False)
        if self._pace:
            delay = max(-(-size // self._pace), self._closing_delay)
            self._adjusted = self._count + delay
        elif adjusting.is_out:
            self._collect_adjusted()
            self._write_parts()
