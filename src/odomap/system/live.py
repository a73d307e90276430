"""Live: what comes from a sensor is tracked as it comes, and what comes too fast is dropped.

The source is read by a thread of its own (`feed`), so that no image waits in a driver while another
is tracked; if tracking is behind, the oldest frame is dropped, and counted. A change is written at
the first frame that finds it solved. If a keyframe comes while its stage is busy it waits, and a
newer one replaces it: a stage that is behind works on what is newest, and what it skipped is
counted. Mappers take skipped keyframes into the window of the next, since the map has them.

Observers are called in a thread of their own, one after the other: a slow one loses messages, the
oldest first, counted in `messages_dropped`, and never costs a frame. Which frames are dropped
depends on the machine, so no two runs are the same: for recordings there is `lockstep`.

Reference: G. Klein, D. Murray, Parallel tracking and mapping for small AR workspaces, 2007.
"""

import logging
import threading
from collections.abc import Callable, Generator, Iterable
from typing import Any, TypeVar

from odomap.maps.keyframes import Keyframe
from odomap.sensors.frame import Frame
from odomap.system.background import Sideline, ThreadConfig
from odomap.system.feed import LOOK_UP_S, Feed, Mailbox
from odomap.system.parallel import ParallelWorker
from odomap.system.stages import LongJob, Stages

__all__ = ["LiveWorker"]

V = TypeVar("V")
Message = tuple[str, list[Callable[[Any], object]], Any]

FAREWELL_S = 1.0
"""How long slow observers are given for what is left to tell them at the end."""


class LiveWorker(ParallelWorker):
    """Keeps up with a sensor, dropping what it must.

    Args:
        stages: the agents of the run.
        config: the queues.
    """

    def __init__(self, stages: Stages, config: ThreadConfig | None = None) -> None:
        super().__init__(stages)
        self._config = ThreadConfig() if config is None else config
        self._waiting: list[Keyframe | None] = [None] * len(self._lanes)
        self._feed: Feed | None = None
        self._messages: Mailbox[Message] = Mailbox(self._config.messages)
        self._teller: threading.Thread | None = None

    def frames(
        self, source: Iterable[Frame], interrupt: threading.Event
    ) -> Generator[Frame, None, None]:
        """Yield the newest frames of a source that is read by a thread of its own.

        Args:
            source: frames in order of time; a recording comes at the pace of its stamps.
            interrupt: set where no more are wanted, though one is being waited for.
        """
        self._interrupt = interrupt
        self._switching.hold()
        self._feed = Feed(source, self._config.queue, self._drop)
        try:
            yield from self._feed.frames(interrupt)
        finally:
            self._feed.close()

    def close(self) -> None:
        """End all threads: of the source, the stages and the observers."""
        if self._feed is not None:
            self._feed.close()
            self._feed = None
        super().close()
        self._waiting = [None] * len(self._lanes)
        if self._teller is not None:
            self._messages.end()
            self._teller.join(FAREWELL_S)
            self.messages_dropped += self._messages.clear()
            self._teller.join()
            self._teller, self._messages = None, Mailbox(self._config.messages)

    # ---- stages ----

    def _is_due(self, index: int) -> bool:
        return self._lanes[index].is_solved

    def _is_adjusted(self) -> bool:
        return self._adjusting is not None and self._adjusting.is_solved

    def _adjust(self, adjusting: Sideline, job: LongJob) -> None:
        """Begin to adjust the whole map; it is copied beside the frames, in steps."""
        adjusting.start(job, reads_beside=True)

    def _hand(self, index: int, keyframe: Keyframe) -> None:
        """Give a keyframe to a stage; if it is busy it waits, in place of an older one."""
        if index == len(self._lanes):
            return
        lane = self._lanes[index]
        if lane.is_solved:
            self._collect(index)
        if not lane.is_out:
            self._start(index, keyframe)
            return
        if self._waiting[index] is not None:
            self.jobs_skipped += 1
        self._waiting[index] = keyframe

    def _collect(self, index: int) -> None:
        """Write the change of a job, and go on with the keyframe that waits."""
        waiting, self._waiting[index] = self._waiting[index], None
        super()._collect(index)
        if waiting is not None:
            self._start(index, waiting)

    # ---- frames and observers ----

    def _drop(self, frame: Frame) -> None:
        self.frames_dropped += 1
        if self.frames_dropped == 1:
            logging.getLogger(__name__).warning(
                "frame %d is dropped: tracking is slower than the source, and %d frames wait; "
                "further ones are counted",
                frame.id,
                self._config.queue,
            )

    def _tell(self, event: str, observers: list[Callable[[V], object]], value: V) -> None:
        """Leave a message for the thread of the observers."""
        if not observers:
            return
        if self._teller is None:
            self._teller = threading.Thread(target=self._tell_on, name="odomap observers")
            self._teller.daemon = True
            self._teller.start()
        if self._messages.put((event, observers, value)) is not None:
            self.messages_dropped += 1

    def _tell_on(self) -> None:
        """Call observers with one message after the other, until there will be none."""
        messages = self._messages
        while not messages.is_over:
            message = messages.take(LOOK_UP_S)
            if message is not None:
                super()._tell(*message)
