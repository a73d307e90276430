"""Parallel workers: what lockstep and live have in common.

Both track a frame while stages solve their jobs (`background`); they differ in when a change is due
and in what becomes of a keyframe whose stage is busy:

             a change is written                      a keyframe whose stage is busy
    lockstep a fixed number of frames later           waits for the change before it
    live     at the first frame that finds it solved  waits in line; the newest replaces it

The map belongs to one thread at a time. While a frame is tracked it is the tracker's: a frame sees
one map, from its first look at it to its last. Between frames it is lent to a thread that writes
what is due, makes the keyframe that was asked for and lets stages read; the caller has its estimate
by then, and the next image is made ready meanwhile:

    caller's thread   … track → estimate     wait for image, prepare      track → estimate …
    between frames              └ make keyframe, add;  write what is due ┘
    stage's thread                                └──── solve ────────────────────────▶

Where a loop was closed the whole map is adjusted, aside of the others (`Sideline`). That is written
part by part, one before each frame; another loop closed meanwhile begins it anew.

Observers are told in the order of events, when the map is the tracker's again.
"""

import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace

from odomap.maps.estimate import Estimate
from odomap.maps.keyframes import Keyframe
from odomap.sensors.frame import Frame
from odomap.system.background import Lane, QuickSwitching, Sideline
from odomap.system.stages import Change, LongJob, Loop, Stages, has_closed
from odomap.system.worker import Worker, deferred_interrupt

__all__ = ["ParallelWorker"]

LOOK_UP_S = 0.1
"""How often `finish` looks up from what takes long, whether Ctrl-C was pressed."""


class ParallelWorker(Worker):
    """Tracks in the caller's thread, and has mapper, closer and adjuster work beside it."""

    def __init__(self, stages: Stages) -> None:
        super().__init__(stages)
        named = ("map", stages.mapper), ("close", stages.closer)
        self._lanes = [Lane(name, stage) for name, stage in named if stage is not None]
        adjuster = stages.adjuster
        self._adjusting = None if adjuster is None else Sideline("adjust", adjuster)
        self._parts: deque[Change] = deque()
        self._switching = QuickSwitching()
        self._between: ThreadPoolExecutor | None = None
        self._lent: list[Future[None]] = []
        self._news: list[Keyframe | Loop] = []

    @abstractmethod
    def _is_due(self, index: int) -> bool:
        """Say whether the change of a job that is out is to be written before the next frame."""

    @abstractmethod
    def _is_adjusted(self) -> bool:
        """Say whether the map adjusted is to be written from the next frame on."""

    @abstractmethod
    def _adjust(self, adjusting: Sideline, job: LongJob) -> None:
        """Begin to adjust the whole map, in place of what is being adjusted."""

    @abstractmethod
    def _hand(self, index: int, keyframe: Keyframe) -> None:
        """Give a keyframe to a stage, which may be busy; past the last one, do nothing."""

    def advance(self, frame: Frame) -> Estimate:
        """Track the frame on a map in which what is due is written; lend the map until the next."""
        tracker = self.stages.tracker
        self._lend(self._write_due)
        prepared = tracker.prepare(frame)
        start = time.perf_counter()
        self._take_back()
        waited = 1e3 * (time.perf_counter() - start)
        estimate = tracker.track(prepared)
        self._tell("on_estimate", self.on_estimate, estimate)
        if estimate.is_keyframe:
            self._lend(self._begin_keyframe)
        return replace(estimate, timing={**estimate.timing, "wait": waited})

    def finish(self) -> None:
        """Write all that is out, stage after stage, and end the threads.

        After Ctrl-C, also if it is pressed while this waits, the map is not adjusted any further.
        """
        try:
            self._lend(self._write_all)
            self._take_back()
            if self._adjusting is not None:
                self._finish_adjusting(self._adjusting)
        finally:
            self.close()

    def _finish_adjusting(self, adjusting: Sideline) -> None:
        """Complete what is being adjusted, or is due to be, unless Ctrl-C is pressed."""
        with deferred_interrupt() as interrupt:
            if not adjusting.is_out and not self._interrupt.is_set():
                self._lend(self._write_parts)
                self._lend(self._begin_last)
                self._take_back()
            while adjusting.is_out:
                if interrupt.is_set() or self._interrupt.is_set():
                    self._interrupt.set()  # whoever waits for the run to end is told
                    adjusting.drop()
                elif adjusting.is_solved:
                    self._lend(self._collect_adjusted)
                    self._take_back()
                else:
                    adjusting.wait(LOOK_UP_S)
        self._lend(self._write_parts)
        self._take_back()

    def close(self) -> None:
        """End the threads; a job that is out is lost, unless `finish` wrote it."""
        if self._adjusting is not None:
            self._adjusting.drop()  # somebody may be waiting for it
        if self._between is not None:
            self._between.shutdown(wait=True, cancel_futures=True)
            self._between = None
        self._lent.clear()
        self._parts.clear()
        if self._adjusting is not None:
            self._adjusting.close()
        for lane in self._lanes:
            lane.close()
        self._switching.release()

    # ---- the map, lent and taken back ----

    def _lend(self, work: Callable[[], None]) -> None:
        """Have something done with the map between two frames, after what was asked before."""
        if self._between is None:
            self._between = ThreadPoolExecutor(1, thread_name_prefix="odomap between frames")
        self._lent.append(self._between.submit(work))

    def _take_back(self) -> None:
        """Wait until nobody else has the map; tell observers what became of it."""
        try:
            while self._lent:
                self._lent[0].result()
                del self._lent[0]
        except Exception:
            del self._lent[0]
            raise
        finally:
            self._tell_news()

    def _tell_news(self) -> None:
        news, self._news = self._news, []
        for item in news:
            if isinstance(item, Loop):
                self._tell("on_loop", self.on_loop, item)
            else:
                self._tell("on_keyframe", self.on_keyframe, item)
        self._tell_map()

    # ---- between frames ----

    def _write_due(self) -> None:
        for index, lane in enumerate(self._lanes):
            if lane.is_out and self._is_due(index):
                self._collect(index)
        if self._adjusting is not None and self._adjusting.is_out and self._is_adjusted():
            self._collect_adjusted()
        if self._parts:
            self._write_part()

    def _write_all(self) -> None:
        for index, lane in enumerate(self._lanes):
            while lane.is_out:
                self._collect(index)
        job = self.stages.closer.last() if self.stages.closer else None
        if job is not None and self._last is not None:
            self._lanes[-1].begin(self._last, job)
            self._collect(len(self._lanes) - 1)

    def _begin_keyframe(self) -> None:
        """Make the keyframe that the tracker asked for, and start what it asks for."""
        with self._beside("keyframe"):
            keyframe = self.stages.tracker.make_keyframe()
        if keyframe is not None:
            self._last = keyframe
            self._news.append(keyframe)
            self._hand(0, keyframe)

    def _start(self, index: int, keyframe: Keyframe) -> None:
        """Let a stage that is free begin with a keyframe; the next one gets what it leaves."""
        lane = self._lanes[index]
        self._switching.hold()
        with self._beside(f"{lane.name} reads"):
            is_out = lane.start(keyframe)
        if not is_out:
            self._hand(index + 1, keyframe)

    def _collect(self, index: int) -> None:
        """Wait for a job, write its change, and give the keyframe to the next stage."""
        lane = self._lanes[index]
        keyframe, change = lane.collect()
        self._note(f"{lane.name} solves", lane.solved_ms)
        with self._beside(f"{lane.name} writes"):
            change.write(self.stages.map)
        self._news.extend(change.loops)
        if index == len(self._lanes) - 1 and self._adjusting is not None:
            self._notice(self._adjusting, keyframe, has_closed(change))
        self._hand(index + 1, keyframe)

    # ---- the whole map ----

    def _notice(self, adjusting: Sideline, keyframe: Keyframe, closed: bool) -> None:
        """Let the adjuster take notice of a keyframe that all others are done with."""
        if closed:
            self._parts.clear()  # what was adjusted was another path
        job = adjusting.add(keyframe, closed)
        if job is not None:
            self._parts.clear()
            with self._beside("adjust reads"):
                self._adjust(adjusting, job)

    def _begin_last(self) -> None:
        """Begin to adjust the map if that is due at the end of a run."""
        assert self._adjusting is not None
        job = self._adjusting.end()
        if job is not None:
            self._adjusting.start(job, reads_beside=False)

    def _collect_adjusted(self) -> None:
        """Wait until the map is adjusted, and lay ready what is to be written."""
        assert self._adjusting is not None
        self._parts.extend(self._adjusting.collect().parts())
        self._note("adjust solves", self._adjusting.solved_ms)

    def _write_part(self) -> None:
        with self._beside("adjust writes"):
            self._parts.popleft().write(self.stages.map)

    def _write_parts(self) -> None:
        while self._parts:
            self._write_part()

    @contextmanager
    def _beside(self, name: str) -> Iterator[None]:
        """Note how long something takes beside tracking."""
        start = time.perf_counter()
        yield
        self._note(name, 1e3 * (time.perf_counter() - start))

    def _note(self, name: str, ms: float) -> None:
        self.beside_ms.setdefault(name, []).append(ms)
