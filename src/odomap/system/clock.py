"""How long the stages of a frame take, for people: no decision reads a clock."""

import time

__all__ = ["Clock"]


class Clock:
    """Milliseconds per stage; for people, nothing decides by it."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def resume(self) -> None:
        """Let the time since the last lap belong to no stage."""
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Give the time since the last lap to a stage."""
        now = time.perf_counter()
        self.laps[stage] = self.laps.get(stage, 0.0) + 1e3 * (now - self._last)
        self._last = now
