"""What a run costs, measured in its own process by the same lines for odomap and for its peer.

    ms              wall-clock time of every call of `track`; reading and decoding are not in it
    cpu_s           processor time of all threads, from the first call to the end of the last
    peak_memory_mb  the most the process ever held, what it loads before the first frame included

Needs nothing but Python: the peer's environment has no odomap.
"""

import json
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


class Meter:
    """Times the calls it makes."""

    def __init__(self) -> None:
        self.ms: list[float] = []
        self.cpu_s = 0.0
        self.threads = 0
        self._cpu_start: float | None = None

    def call(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Call a function and note what it took."""
        if self._cpu_start is None:
            self._cpu_start = time.process_time()
        start = time.perf_counter()
        result = function(*args, **kwargs)
        self.ms.append(1e3 * (time.perf_counter() - start))
        self.cpu_s = time.process_time() - self._cpu_start
        self.threads = max(self.threads, thread_count())
        return result

    def write(self, path: str | Path, tracked: int, cv_threads: int, **more: Any) -> None:
        """Write what was measured as JSON, and what else is told."""
        content = {
            "frames": len(self.ms),
            "tracked": tracked,
            "ms": self.ms,
            "cpu_s": self.cpu_s,
            "peak_memory_mb": peak_memory_mb(),
            "threads": self.threads,
            "cv_threads": cv_threads,
            **more,
        }
        Path(path).write_text(json.dumps(content), encoding="utf-8")


def peak_memory_mb() -> float:
    """Return the most memory this process has held, in MB."""
    status = Path("/proc/self/status")
    if status.exists():  # getrusage counts what the parent held before the child was started
        for line in status.read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) / 1024
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024**2 if sys.platform == "darwin" else 1024)


def thread_count() -> int:
    """Return how many threads this process has; 0 where the system does not say."""
    tasks = Path("/proc/self/task")
    return len(list(tasks.iterdir())) if tasks.exists() else 0


def machine() -> str:
    """Return cores and processor in a few words."""
    model = platform.processor() or platform.machine()
    listing = Path("/proc/cpuinfo")
    if listing.exists():
        for line in listing.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                model = line.split(":", 1)[1].strip()
                break
    return f"{os.cpu_count()} cores, {model}"
