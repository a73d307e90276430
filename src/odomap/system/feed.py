"""Queues between threads that never make the writer wait: when one is full, the oldest is dropped.

A sensor does not wait, and a frame of a second ago is worth less than one of now: so a queue of
frames holds a few, and drops the oldest under pressure. A `Feed` reads a source into such a queue
in a thread of its own, at the pace of the source. A recording has no pace, so its stamps are its
pace: a frame is handed out no earlier than it was taken, counted from the first.

Reference: Lakshman, Neidhardt, Ott, The drop from front strategy in TCP and in TCP over ATM,
INFOCOM 1996 (of a full queue, the oldest is the one to drop).
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sized
from typing import Generic, TypeVar

from odomap.sensors.frame import Frame

__all__ = ["Feed", "Mailbox"]

V = TypeVar("V")

LOOK_UP_S = 0.1
"""How long a thread that waits may take to notice that it should not."""
LONGEST_PAUSE_S = 2.0
"""A recording that makes a longer pause is not waited for: its clock has jumped."""
PATIENCE_S = 5.0
"""How long a source may take to give the frame it is at, when it is no longer wanted."""


class Mailbox(Generic[V]):
    """A queue of limited size that drops its oldest item rather than let a writer wait.

    Args:
        size: items it holds.
    """

    def __init__(self, size: int) -> None:
        self._items: deque[V] = deque()
        self._size = size
        self._changed = threading.Condition()
        self._has_ended = False

    def put(self, item: V) -> V | None:
        """Add an item; return the oldest one if that had to go for it."""
        with self._changed:
            dropped = self._items.popleft() if len(self._items) == self._size else None
            self._items.append(item)
            self._changed.notify_all()
            return dropped

    def take(self, wait_s: float) -> V | None:
        """Return the oldest item; None if none comes in time or no more will come."""
        with self._changed:
            if not self._items and not self._has_ended:
                self._changed.wait(wait_s)
            return self._items.popleft() if self._items else None

    def end(self) -> None:
        """Say that no more items come; those that wait can still be taken."""
        with self._changed:
            self._has_ended = True
            self._changed.notify_all()

    def clear(self) -> int:
        """Drop all items; return how many."""
        with self._changed:
            count = len(self._items)
            self._items.clear()
            return count

    @property
    def is_over(self) -> bool:
        """Whether there is nothing to take and there will not be."""
        with self._changed:
            return self._has_ended and not self._items


class Feed:
    """A source read by a thread of its own, at its own pace.

    Args:
        source: frames in order of time; one that knows its length is a recording, and paced by its
            stamps.
        size: frames that may wait.
        drop: called with each frame that is dropped, in the thread of the source.
    """

    def __init__(self, source: Iterable[Frame], size: int, drop: Callable[[Frame], object]) -> None:
        self._source, self._drop = source, drop
        self._is_recording = isinstance(source, Sized) and len(source) > 0
        self._mailbox: Mailbox[Frame] = Mailbox(size)
        self._stop = threading.Event()
        self._error: BaseException | None = None
        # A source that never answers must not keep the program from ending.
        self._thread = threading.Thread(target=self._read, name="odomap source", daemon=True)
        self._thread.start()

    def frames(self, interrupt: threading.Event) -> Generator[Frame, None, None]:
        """Yield the frames, oldest first, until they end or the event is set.

        Raises:
            BaseException: what the source raised, when the frames before it are tracked.
        """
        while not interrupt.is_set():
            frame = self._mailbox.take(LOOK_UP_S)
            if frame is not None and not interrupt.is_set():
                yield frame
            elif self._mailbox.is_over:
                if self._error is not None:
                    raise self._error
                return

    def close(self) -> None:
        """Stop reading, and wait for the thread."""
        self._stop.set()
        self._thread.join(PATIENCE_S)
        if self._thread.is_alive():
            logging.getLogger(__name__).warning(
                "the source has not answered for %g s; its thread is left to itself", PATIENCE_S
            )

    def _read(self) -> None:
        try:
            frames = iter(self._source)
            try:
                start, first = time.perf_counter(), -1
                for frame in frames:
                    if self._is_recording:
                        start, first = self._wait(frame.stamp_ns, start, first)
                    if self._stop.is_set():
                        break
                    dropped = self._mailbox.put(frame)
                    if dropped is not None:
                        self._drop(dropped)
            finally:
                if isinstance(frames, Generator):
                    frames.close()  # a camera is let go, by the thread that read it
        except BaseException as error:
            self._error = error
        finally:
            self._mailbox.end()

    def _wait(self, stamp_ns: int, start: float, first: int) -> tuple[float, int]:
        """Wait until a frame is due; return when the clock of the recording was at which stamp."""
        now = time.perf_counter()
        due = start + 1e-9 * (stamp_ns - first)
        if first < 0 or due - now > LONGEST_PAUSE_S:
            return now, stamp_ns
        self._stop.wait(max(0.0, due - now))
        return start, first
