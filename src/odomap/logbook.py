"""The logbook of a run: what is kept of each frame, and the numbers made from it.

A run must not grow with its length by more than a few hundred bytes per frame, so images and tracks
are dropped at once, but for a few frames sampled evenly for the report. How large the map is is
noted with every frame, how much memory is held with every tenth. The clock is read here and in the
stages for their timing, and never decides anything.
"""

import dataclasses
import os
import platform
import sys
import time
from array import array
from collections import Counter
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from odomap.maps.estimate import Estimate, Status
from odomap.sensors.frame import Frame
from odomap.sources.source import Skipped, Source
from odomap.version import __version__

if TYPE_CHECKING:
    from odomap.loopbook import LoopBook
    from odomap.maps.map import Map
    from odomap.views.record import Growth

__all__ = ["Logbook", "memory_mb", "peak_memory_mb", "versions"]

SAMPLES = 6
"""Frames kept with their image and tracks for the report."""

SKIPPED_LISTED = 50
"""Skipped measurements that metrics.json lists; all are counted."""

MEMORY_EVERY = 10
"""Frames after which the memory held is looked at again."""

GAP_S = 1.0
"""A gap between two frames that is worth a warning, seconds."""


class Logbook:
    """Collect the light part of every estimate.

    Args:
        total: how many frames are expected; spreads the samples.

    Attributes:
        estimates: one per frame, without tracks.
        samples: a few (frame, estimate with tracks) spread over the run.
        map: whose size is noted with every frame; None notes none.
        loops: what was decided on loops; None where nobody looked for any.
    """

    def __init__(self, total: int) -> None:
        self.estimates: list[Estimate] = []
        self.samples: list[tuple[Frame, Estimate]] = []
        self.map: Map | None = None
        self.loops: LoopBook | None = None
        self._track_ms: list[float] = []
        self._keyframes, self._landmarks = array("q"), array("q")
        self._memory_mb = array("d")
        self._wanted = {round(k) for k in np.linspace(0, max(total - 1, 0), SAMPLES)}
        self._cpu_start = time.process_time()

    def add(self, frame: Frame, estimate: Estimate, seconds: float) -> None:
        """Note one tracked frame and how long it took."""
        if len(self.estimates) in self._wanted:
            self.samples.append((frame, estimate))
        if len(self.estimates) % MEMORY_EVERY == 0:
            self._memory_mb.append(memory_mb())
        if self.map is not None:
            self._keyframes.append(self.map.num_keyframes)
            self._landmarks.append(self.map.num_landmarks)
        if estimate.tracks is not None:
            estimate = dataclasses.replace(estimate, tracks=None)
        self.estimates.append(estimate)
        self._track_ms.append(1000.0 * seconds)

    @property
    def frames_per_second(self) -> float:
        """Rate of tracking over the last frames."""
        recent = self._track_ms[-20:]
        return 1000.0 * len(recent) / max(sum(recent), 1e-9) if recent else 0.0

    @property
    def track_ms(self) -> list[float]:
        """Milliseconds per frame, in order."""
        return list(self._track_ms)

    def count(self, status: Status) -> int:
        """Count the frames of a status."""
        return sum(estimate.status == status for estimate in self.estimates)

    def growth(self) -> "Growth":
        """Return how large the map and the memory were, frame by frame."""
        from odomap.views.record import Growth

        return Growth(
            keyframes=np.array(self._keyframes, np.int64),
            landmarks=np.array(self._landmarks, np.int64),
            memory_frames=MEMORY_EVERY * np.arange(len(self._memory_mb)),
            memory_mb=np.array(self._memory_mb, np.float64),
        )

    @property
    def placed(self) -> int:
        """How many frames have a pose."""
        return sum(e.status != Status.LOST and e.keyframe_id >= 0 for e in self.estimates)

    def duration_s(self) -> float:
        """Return the time from the first to the last frame, seconds."""
        if not self.estimates:
            return 0.0
        return (self.estimates[-1].stamp_ns - self.estimates[0].stamp_ns) * 1e-9

    def gaps(self) -> list[tuple[int, float]]:
        """Return (frame id before, seconds) of every gap worth a warning."""
        stamps = np.array([estimate.stamp_ns for estimate in self.estimates], np.int64)
        if len(stamps) < 3:
            return []
        steps = np.diff(stamps) * 1e-9
        wide = np.nonzero(steps > max(GAP_S, 3.0 * float(np.median(steps))))[0]
        return [(self.estimates[k].frame_id, float(steps[k])) for k in wide]

    def failure(self, placed: int | None = None) -> str:
        """Return why the run has no usable path; empty when it has one.

        Args:
            placed: how many frames have a pose in the end; default those that had one at once.
        """
        total = len(self.estimates)
        placed = self.placed if placed is None else placed
        if total == 0:
            return "no frame could be read"
        if placed >= max(2, total / 2):
            return ""
        if placed == total:
            return "one frame is no path"
        lost = self.count(Status.LOST) > 0
        waited = Status.LOST if lost else Status.INITIALIZING
        reasons = Counter(e.reason for e in self.estimates if e.status == waited and e.reason)
        why = f": {reasons.most_common(1)[0][0]}" if reasons else ""
        what = "was lost" if lost else "started late" if placed else "never started"
        return f"tracking {what}, {placed} of {total} frames have a pose{why}"

    def numbers(self) -> dict[str, Any]:
        """Return the part of metrics.json that the frames tell."""
        by_status = {status.value: self.count(status) for status in Status}
        stages: dict[str, list[float]] = {}
        for estimate in self.estimates:
            for stage, ms in estimate.timing.items():
                stages.setdefault(stage, []).append(ms)
        tracking_s = sum(self._track_ms) / 1000.0
        return {
            "frames": len(self.estimates),
            "tracked": self.placed,
            "lost": self.count(Status.LOST),
            "statuses": by_status,
            "keyframes": sum(estimate.is_keyframe for estimate in self.estimates),
            "ms_per_frame": spread(self._track_ms),
            "ms_per_stage": {stage: spread(values) for stage, values in stages.items()},
            "real_time_factor": self.duration_s() / tracking_s if tracking_s > 0 else 0.0,
            "duration_s": self.duration_s(),
            "cpu_s": time.process_time() - self._cpu_start,
            "peak_memory_mb": peak_memory_mb(),
            "memory_mb": self._memory(),
        }

    def _memory(self) -> dict[str, float]:
        """Return the memory held at the first frame and now, and the most that was noted."""
        noted = [*self._memory_mb, memory_mb()]
        return {"start": noted[0], "end": noted[-1], "peak": max(noted)}


def spread(values: list[float]) -> dict[str, float]:
    """Return median, 95th percentile, mean and maximum; zeros of nothing."""
    a = np.array(values or [0.0])
    return {
        "median": float(np.median(a)),
        "p95": float(np.percentile(a, 95)),
        "mean": float(a.mean()),
        "max": float(a.max()),
    }


def skipped_numbers(source: Source) -> dict[str, Any]:
    """Return how many measurements a source left out, why, and which (the first ones)."""
    skipped: list[Skipped] = list(source.skipped)
    return {
        "skipped": len(skipped),
        "skipped_measurements": [dataclasses.asdict(item) for item in skipped[:SKIPPED_LISTED]],
    }


def memory_mb() -> float:
    """Return the memory this process holds now, megabytes; where nobody says, the most it held."""
    try:
        with open("/proc/self/statm", "rb") as statm:
            pages = int(statm.read().split()[1])
    except OSError:
        return peak_memory_mb()
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def peak_memory_mb() -> float:
    """Return the most memory this process has held, megabytes; 0 where the system does not say."""
    # Not getrusage first: on Linux its maximum survives exec and may be that of the parent.
    status = Path("/proc/self/status")
    for line in status.read_text().splitlines() if status.is_file() else ():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024.0
    try:
        import resource
    except ImportError:
        return 0.0
    scale = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / scale


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    found = {"odomap": __version__, "python": platform.python_version()}
    for name in ("numpy", "scipy", "numba", "opencv-python-headless", "qdldl"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found | {"platform": platform.platform()}
