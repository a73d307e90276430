"""Workers: who runs which stage when.

A rhythm is a class; stages, map and observers are the same in all of them (`rhythms` names them).

    inline    each stage in turn: frame, mapping, closing, adjusting; the same bytes on every run
    lockstep  mapping beside tracking, its result due a fixed number of frames later; the same bytes
    live      mapping beside tracking, as fast as it goes; frames that come too fast are dropped

Observers are lists on the worker: `on_estimate`, `on_keyframe`, `on_loop`, `on_map` hold callables,
which are given frozen values. One that raises is detached, its error kept in `failures` and logged;
the run goes on. A first Ctrl-C lets the frame at hand finish, so that nothing is left half written,
and ends the run; a second one interrupts at once. No thread outlives `finish` or `close`.

    worker = InlineWorker(Stages(map, tracker))
    worker.on_estimate.append(print)
    for frame, estimate in worker.run(source): ...
    worker.finish()
"""

import logging
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from types import FrameType
from typing import TypeVar

from odomap.maps.estimate import Estimate
from odomap.maps.keyframes import Keyframe
from odomap.sensors.frame import Frame
from odomap.system.stages import Job, LongJob, Loop, MapState, Stages, has_closed

__all__ = [
    "InlineWorker",
    "ObserverFailure",
    "Worker",
    "deferred_interrupt",
]

V = TypeVar("V")


@dataclass(frozen=True)
class ObserverFailure:
    """An observer that raised, and was detached.

    Attributes:
        event: the list it was on: "on_estimate", "on_keyframe", "on_loop" or "on_map".
        observer: its name.
        error: what it raised.
    """

    event: str
    observer: str
    error: Exception


class Worker(ABC):
    """Runs stages over frames, and tells observers.

    Attributes:
        stages: the agents and their map.
        on_estimate: called with each `Estimate`.
        on_keyframe: called with each new `Keyframe`.
        on_loop: called with each `Loop` decided on.
        on_map: called with a `MapState` when the map has changed.
        failures: observers that were detached because they raised.
        interrupted: whether Ctrl-C ended the last `run`.
        frames_dropped: frames that were never tracked, since tracking was behind (live).
        jobs_skipped: keyframes that a stage never saw, since it was behind (live).
        messages_dropped: what observers were not told, since one was slow (live).
        beside_ms: milliseconds of what was done beside tracking, by name (lockstep, live).
    """

    def __init__(self, stages: Stages) -> None:
        self.stages = stages
        self.on_estimate: list[Callable[[Estimate], object]] = []
        self.on_keyframe: list[Callable[[Keyframe], object]] = []
        self.on_loop: list[Callable[[Loop], object]] = []
        self.on_map: list[Callable[[MapState], object]] = []
        self.failures: list[ObserverFailure] = []
        self.interrupted = False
        self.frames_dropped = self.jobs_skipped = self.messages_dropped = 0
        self.beside_ms: dict[str, list[float]] = {}
        self._told_version = stages.map.version
        self._interrupt = threading.Event()
        self._last: Keyframe | None = None

    @abstractmethod
    def advance(self, frame: Frame) -> Estimate:
        """Take one frame through the stages, as far as the rhythm goes, and return its estimate.

        Like `track`, but leaves Ctrl-C to the caller (see `deferred_interrupt`).
        """

    @abstractmethod
    def finish(self) -> None:
        """Wait until all stages are at rest, and end their threads.

        Nothing is written to the map after this returns; tracking may go on all the same.

        Raises:
            Exception: what a stage raised in its thread and nobody has been told yet.
        """

    def close(self) -> None:
        """End the threads without writing what they still found; `finish` does more."""
        return

    def frames(
        self, source: Iterable[Frame], interrupt: threading.Event
    ) -> Generator[Frame, None, None]:
        """Yield the frames to track: here, all of them as the source gives them.

        Args:
            source: frames in order of time.
            interrupt: set where no more are wanted, though one is being waited for.
        """
        self._interrupt = interrupt
        yield from source

    def track(self, frame: Frame) -> Estimate:
        """Take one frame through the stages, as far as the rhythm goes.

        Args:
            frame: the next one in time.

        Returns:
            Its estimate.

        Raises:
            KeyboardInterrupt: Ctrl-C was pressed meanwhile; the frame is done all the same.
        """
        with deferred_interrupt() as self._interrupt:
            estimate = self.advance(frame)
        if self._interrupt.is_set():
            raise KeyboardInterrupt
        return estimate

    def run(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, Estimate]]:
        """Track frame after frame, until they end or Ctrl-C is pressed (`interrupted`).

        Args:
            frames: in order of time, such as a source.

        Yields:
            Each frame and its estimate.
        """
        self.interrupted = False
        with (
            deferred_interrupt() as interrupt,
            closing(self.frames(frames, interrupt)) as wanted,
        ):
            for frame in wanted:
                if not interrupt.is_set():
                    yield frame, self.advance(frame)
                if interrupt.is_set():
                    break
            self.interrupted = interrupt.is_set()

    def _tell(self, event: str, observers: list[Callable[[V], object]], value: V) -> None:
        for observer in tuple(observers):
            try:
                observer(value)
            except Exception as error:
                if observer in observers:
                    observers.remove(observer)
                name = getattr(observer, "__qualname__", type(observer).__qualname__)
                self.failures.append(ObserverFailure(event, name, error))
                logging.getLogger(__name__).error(
                    "%s: observer %s raised and is detached", event, name, exc_info=error
                )

    def _tell_map(self) -> None:
        """Tell about the map if it has changed since last told."""
        m = self.stages.map
        if m.version == self._told_version:
            return
        with m.lock:
            state = MapState(m.version, m.epoch, m.num_keyframes, m.num_landmarks)
        self._told_version = state.version
        self._tell("on_map", self.on_map, state)


class InlineWorker(Worker):
    """Each stage in turn, in the caller's thread; observers too."""

    def advance(self, frame: Frame) -> Estimate:
        """Track a frame; if it became a keyframe, map and close before returning."""
        tracker = self.stages.tracker
        estimate = tracker.track(tracker.prepare(frame))
        self._tell("on_estimate", self.on_estimate, estimate)
        start = time.perf_counter()
        keyframe = tracker.make_keyframe()
        if keyframe is not None:
            self._last = keyframe
            timing = dict(estimate.timing)
            timing["keyframe"] = timing.get("keyframe", 0.0) + 1e3 * (time.perf_counter() - start)
            self._tell("on_keyframe", self.on_keyframe, keyframe)
            mapper, closer = self.stages.mapper, self.stages.closer
            self._work("map", partial(mapper.add, keyframe) if mapper else None, timing)
            closed = self._work("close", partial(closer.add, keyframe) if closer else None, timing)
            if self.stages.adjuster is not None:
                start = time.perf_counter()
                if self._adjust(self.stages.adjuster.add(keyframe, closed)):
                    timing["adjust"] = 1e3 * (time.perf_counter() - start)
            estimate = replace(estimate, timing=timing)
        self._tell_map()
        return estimate

    def _work(
        self, name: str, read: Callable[[], Job | None] | None, timing: dict[str, float]
    ) -> bool:
        """Have a stage do what it reads that there is to do; say whether a loop was closed."""
        start = time.perf_counter()
        job = None if read is None else read()
        if job is None:
            return False
        change = job.solve()
        change.write(self.stages.map)
        for loop in change.loops:
            self._tell("on_loop", self.on_loop, loop)
        timing[name] = 1e3 * (time.perf_counter() - start)
        return has_closed(change)

    def _adjust(self, job: LongJob | None) -> bool:
        """Adjust the whole map if there is a reason, unless Ctrl-C is pressed; say whether so."""
        if job is None:
            return False
        job.read()
        job.solve(self._interrupt).write(self.stages.map)
        return True

    def finish(self) -> None:
        """Decide on what the last keyframe points at, and adjust the map if that is due."""
        last, closer, adjuster = self._last, self.stages.closer, self.stages.adjuster
        closed = last is not None and self._work("close", closer.last if closer else None, {})
        if adjuster is not None and last is not None:
            if closed:
                self._adjust(adjuster.add(last, closed))
            self._adjust(adjuster.end())
        self._tell_map()


@contextmanager
def deferred_interrupt() -> Iterator[threading.Event]:
    """Turn the first Ctrl-C into an event, so that no frame is torn; a second one interrupts.

    Outside the main thread, which alone receives Ctrl-C, the event is never set.

    Yields:
        The event; look at it between frames.
    """
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    before = signal.getsignal(signal.SIGINT)

    def on_interrupt(number: int, frame: FrameType | None) -> None:
        event.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, before)
