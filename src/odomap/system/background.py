"""Beside the tracker: a stage whose jobs are solved in a thread of its own, one at a time.

What a stage reads from the map and what it writes to it runs between two frames (`parallel`), so
that no frame sees the map change under its feet and every order of events is that of the code. Only
what lies between, `Job.solve` on arrays that are its own, runs beside the frames:

    between frames     start (add reads) ──────── frames ────────▶ collect, change.write
    stage's thread              └──── solve: compiled, without the GIL ────┘

When to collect is all that the rhythms differ in. One stage stands aside (`Sideline`): its jobs
take long, and are given up where another one is begun. Python hands its lock from thread to thread
every 5 ms at best; while threads run, that is shortened, or a tracker made of many short steps
would wait for it at each (`quick_switching`).

Reference: G. Klein, D. Murray, Parallel tracking and mapping for small AR workspaces, 2007.
"""

import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Annotated, ClassVar, Generic, TypeVar

from odomap.limits import Count, Limits, check_limits
from odomap.maps.keyframes import Keyframe
from odomap.system.stages import Adjuster, Change, Closer, Job, LongChange, LongJob, Mapper

__all__ = ["Lane", "QuickSwitching", "Sideline", "ThreadConfig"]

Frames = Annotated[int, Limits(least=0)]
C = TypeVar("C")


@dataclass(frozen=True)
class ThreadConfig:
    """When stages beside the tracker hand in what they found (lockstep, live)."""

    mapping_delay: Frames = 1
    """Lockstep: frames from a keyframe to the one that sees the map adjusted around it. With 1, the
    next frame does, and the mapper works while it is read; 0 works inline."""
    closing_delay: Frames = 20
    """Lockstep: frames from the search for a loop to the one that sees the path corrected."""
    closing_line: Frames = 0
    """Lockstep: keyframes that may wait for the closer; with one more, tracking waits for it."""
    adjusting_pace: Frames = 2000
    """Lockstep: observations adjusted in the time of a frame, so that a large map is seen adjusted
    later than a small one, and none before `closing_delay`; 0 works inline."""
    queue: Count = 2
    """Live: frames that may wait for the tracker; beyond them the oldest is dropped."""
    messages: Count = 256
    """Live: what may wait for a slow observer; beyond it the oldest is dropped."""

    def __post_init__(self) -> None:
        check_limits(self)


class QuickSwitching:
    """Shortens the interval at which Python's threads take turns, while anybody wants that.

    The interval belongs to the process, and so does the count of those who want it short: the last
    one to release it puts back what was there before the first.
    """

    INTERVAL_S: ClassVar[float] = 0.0005
    _lock: ClassVar[threading.Lock] = threading.Lock()
    _holders: ClassVar[int] = 0
    _before: ClassVar[float] = 0.0

    def __init__(self) -> None:
        self._holds = False

    def hold(self) -> None:
        """Shorten the interval; a second call does nothing."""
        cls = QuickSwitching
        with cls._lock:
            if self._holds:
                return
            if cls._holders == 0:
                cls._before = sys.getswitchinterval()
                sys.setswitchinterval(min(cls._before, cls.INTERVAL_S))
            self._holds = True
            cls._holders += 1

    def release(self) -> None:
        """Put back what was there, unless another one still holds it."""
        cls = QuickSwitching
        with cls._lock:
            if not self._holds:
                return
            self._holds = False
            cls._holders -= 1
            if cls._holders == 0:
                sys.setswitchinterval(cls._before)


class _Line(Generic[C]):
    """A thread of its own in which one job at a time is solved.

    Args:
        name: for timing and for the thread.

    Attributes:
        name: of the line.
        solved_ms: milliseconds that the last job was solved in.
    """

    def __init__(self, name: str) -> None:
        self.name, self.solved_ms = name, 0.0
        self._future: Future[C] | None = None
        self._thread: ThreadPoolExecutor | None = None

    @property
    def is_out(self) -> bool:
        """Whether a job is out."""
        return self._future is not None

    @property
    def is_solved(self) -> bool:
        """Whether a job is out whose change, or whose error, is there."""
        return self._future is not None and self._future.done()

    def _begin(self, solve: Callable[[], C]) -> None:
        """Solve a job in the thread."""
        if self._thread is None:
            self._thread = ThreadPoolExecutor(1, thread_name_prefix=f"odomap {self.name}")
        self._future = self._thread.submit(self._timed, solve)

    def _timed(self, solve: Callable[[], C]) -> C:
        start = time.perf_counter()
        change = solve()
        self.solved_ms = 1e3 * (time.perf_counter() - start)
        return change

    def _collect(self) -> C:
        """Wait for the job that is out, and return its change, or raise what the stage raised."""
        assert self._future is not None, f"{self.name}: no job is out"
        future = self._future
        try:
            return future.result()
        finally:
            if future.done():  # else Ctrl-C was pressed while waiting: it is still out
                self._forget()

    def _forget(self) -> None:
        """Forget the job that is out."""
        self._future = None

    def close(self) -> None:
        """End the thread and forget the job that is out; a later start makes a new one."""
        self._forget()
        if self._thread is not None:
            self._thread.shutdown(wait=True)
            self._thread = None


class Lane(_Line[Change]):
    """A stage beside the tracker, with at most one job out.

    Args:
        name: for timing and for the thread.
        stage: mapper or closer.

    Attributes:
        keyframe: the one whose job is out, or None.
    """

    def __init__(self, name: str, stage: Mapper | Closer) -> None:
        super().__init__(name)
        self._stage = stage
        self.keyframe: Keyframe | None = None

    def start(self, keyframe: Keyframe) -> bool:
        """Let the stage read the map, and solve what it found to do in its thread.

        Args:
            keyframe: a new one; the job of the last must have been collected.

        Returns:
            Whether there is something to do.
        """
        assert not self.is_out, f"{self.name}: a job is out"
        job = self._stage.add(keyframe)
        if job is not None:
            self.begin(keyframe, job)
        return job is not None

    def begin(self, keyframe: Keyframe, job: Job) -> None:
        """Solve a job in the stage's thread; the one before it must have been collected."""
        self.keyframe = keyframe
        self._begin(job.solve)

    def collect(self) -> tuple[Keyframe, Change]:
        """Wait for the job that is out.

        Returns:
            Its keyframe, and the change to write.

        Raises:
            Exception: what the stage raised; the job is not out any more.
        """
        keyframe = self.keyframe
        assert keyframe is not None, f"{self.name}: no job is out"
        return keyframe, self._collect()

    def _forget(self) -> None:
        super()._forget()
        self.keyframe = None


class Sideline(_Line[LongChange]):
    """A stage aside of all others, whose job is given up where another one is begun.

    Args:
        name: for timing and for the thread.
        stage: the adjuster.
    """

    def __init__(self, name: str, stage: Adjuster) -> None:
        super().__init__(name)
        self._stage = stage
        self._stop = threading.Event()

    def add(self, keyframe: Keyframe, has_closed: bool) -> LongJob | None:
        """Let the stage take notice of a keyframe; give up the job that is out if it closed a loop.

        Returns:
            What is to be started, if anything is.
        """
        if has_closed:
            self.drop()
        return self._stage.add(keyframe, has_closed)

    def end(self) -> LongJob | None:
        """Return what is to be started at the end of a run, if anything is."""
        return self._stage.end()

    def start(self, job: LongJob, reads_beside: bool) -> int:
        """Begin a job, in place of the one that is out.

        Args:
            job: from `add` or `end`.
            reads_beside: whether the map is copied in the stage's thread too, while it goes on.

        Returns:
            The size of the job; 0 where it is not known yet.
        """
        self.drop()
        if not reads_beside:
            job.read()
        stop = self._stop = threading.Event()

        def solve() -> LongChange:
            if reads_beside:
                job.read()
            return job.solve(stop)

        self._begin(solve)
        return job.size if not reads_beside else 0

    def wait(self, seconds: float) -> None:
        """Wait for the job that is out, but no longer than that."""
        if self._future is not None:
            wait([self._future], seconds)

    def collect(self) -> LongChange:
        """Wait for the job that is out, and return its change.

        Raises:
            Exception: what the stage raised; the job is not out any more.
        """
        return self._collect()

    def drop(self) -> None:
        """Give up the job that is out: nobody will learn what it found, and it ends soon."""
        self._stop.set()
        self._forget()

    def close(self) -> None:
        """End the thread, and give up the job that is out; a later start makes a new one."""
        self._stop.set()
        super().close()
