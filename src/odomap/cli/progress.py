"""Progress for people: a bar on a terminal, a plain line every few seconds in a pipe.

Everything goes to stderr, so that what a command prints on stdout can be piped on.
"""

import sys
import time
from types import TracebackType
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from odomap.run import Progress

__all__ = ["Steps", "TrackingProgress"]

LINE_EVERY_S = 5.0
"""Seconds between two plain lines."""


class Steps:
    """Progress through named steps, such as modules being compiled."""

    def __init__(self, title: str, quiet: bool = False) -> None:
        self._display = _display(title, quiet)

    def __enter__(self) -> Self:
        self._display.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        self._display.stop()

    def show(self, done: int, total: int, text: str) -> None:
        """Show that `done` of `total` steps are behind, and what is being done now."""
        self._display.show(done, total, text)


class TrackingProgress:
    """Progress of a run: stage, frames, frame rate, status and inliers."""

    def __init__(self, quiet: bool = False) -> None:
        self._quiet = quiet
        self._stage = ""
        self._display: _Lines | _Bar = _Lines("", quiet=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        self._display.stop()

    def show(self, progress: "Progress") -> None:
        """Show where a run stands; hand this to `odomap.run` as `progress`."""
        if progress.stage != self._stage:
            self._display.stop()
            self._stage = progress.stage
            self._display = _display(progress.stage, self._quiet)
            self._display.start()
        text = ""
        if progress.estimate is not None:
            estimate = progress.estimate
            text = f"{progress.frames_per_second:5.1f} fps  {estimate.status.value}"
            text += f"  {estimate.num_inliers} inliers" if estimate.num_inliers else ""
            text += f"  {estimate.reason}" if estimate.reason else ""
        self._display.show(progress.done, progress.total, text or progress.text)


def _display(title: str, quiet: bool) -> "_Lines | _Bar":
    return _Bar(title) if sys.stderr.isatty() and not quiet else _Lines(title, quiet)


class _Lines:
    """Plain lines, never more often than every few seconds."""

    def __init__(self, title: str, quiet: bool = False) -> None:
        self._title = title
        self._quiet = quiet
        self._last = 0.0

    def start(self) -> None:
        self._last = time.monotonic()

    def show(self, done: int, total: int, text: str) -> None:
        now = time.monotonic()
        if self._quiet or now - self._last < LINE_EVERY_S:
            return
        self._last = now
        count = f" {done}/{total}" if total else ""
        print(f"{self._title}{count}  {text}".rstrip(), file=sys.stderr, flush=True)

    def stop(self) -> None:
        pass


class _Bar:
    """A bar that stays on one line of the terminal and goes away when done."""

    def __init__(self, title: str) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

        self._rich = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            TextColumn("{task.fields[text]}", markup=False),
            console=Console(stderr=True),
            transient=True,
        )
        self._task = self._rich.add_task(title, total=None, text="")

    def start(self) -> None:
        self._rich.start()

    def show(self, done: int, total: int, text: str) -> None:
        self._rich.update(self._task, completed=done, total=total or None, text=text)

    def stop(self) -> None:
        self._rich.stop()
