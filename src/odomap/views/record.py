"""The record of one run, as a report needs it: plain values, and the words that sum them up.

A `Report` is filled by whoever ran the system; the views only read it. Numbers travel under names
that end in their unit (`rmse_m`, `ms_per_frame`, `rot_deg_per_m`), so that one rule formats all.
"""

import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.trajectory import Trajectory
from odomap.maps.estimate import Estimate, Status

if TYPE_CHECKING:
    from odomap.views.covisibility import MapView
    from odomap.views.loopview import LoopView

__all__ = [
    "Growth",
    "LostRun",
    "Report",
    "Sample",
    "Verdict",
    "environment",
    "lost_runs",
    "verdict",
]

Level = Literal["good", "warn", "bad"]
Scale = Literal["metric", "fitted", "free"]
PLACED = (Status.TRACKING, Status.RECOVERED)
PACKAGES = ("numpy", "scipy", "numba", "opencv-python-headless", "matplotlib")


@dataclass(frozen=True, eq=False)
class Sample:
    """A frame kept for the report: its picture, and the estimate with the tracks to draw on it.

    Attributes:
        image: (H, W) or (H, W, 3) uint8, as the reference camera saw it.
        estimate: what the tracker said about it.
    """

    image: NDArray[np.uint8]
    estimate: Estimate


@dataclass(frozen=True, eq=False)
class Growth:
    """How large a run was, frame by frame.

    Attributes:
        keyframes: (N,) keyframes in the map after each frame; empty where nobody counted.
        landmarks: (N,) landmarks in the map after each frame; empty likewise.
        memory_frames: (S,) indices of the frames at which memory was looked at.
        memory_mb: (S,) memory held then, megabytes.
    """

    keyframes: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    memory_frames: NDArray[np.int64]
    memory_mb: NDArray[np.float64]

    def before(self, estimates: Sequence[Estimate]) -> int:
        """Return how many keyframes the map had before the first frame, as one loaded has."""
        return int(self.keyframes[0]) - bool(estimates[0].is_keyframe)

    def made(self, estimates: Sequence[Estimate]) -> NDArray[np.int64]:
        """Return how many keyframes were made up to each frame (N,).

        One may make several, as the start of a single camera does. The map may hold one only when
        the next frame is there.
        """
        marked = np.array([e.is_keyframe for e in estimates], np.int64)
        came = np.diff(self.keyframes, prepend=self.keyframes[:1] - marked[:1])
        made = np.cumsum(marked)
        besides = np.maximum(np.cumsum(np.maximum(came, 0)) - made, 0)
        return np.asarray(made + np.maximum.accumulate(besides))


def environment() -> dict[str, str]:
    """Describe what a run ran on: versions of what decides its numbers, system, cores."""
    found = {"Python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    found["system"] = f"{platform.system()} {platform.machine()}"
    found["cores"] = str(os.cpu_count() or "unknown")
    return found


@dataclass(frozen=True, eq=False)
class Report:
    """Everything a report shows about one run.

    Attributes:
        title: headline, such as the name of the recording.
        source: what was read, in words or as a path.
        version: odomap's version.
        command: how to repeat the run.
        config: the whole configuration as YAML text.
        rig: what is mounted where, as short text.
        estimates: one per frame, in order; their tracks may be left out.
        trajectory: the final path with its covariances; None or empty when nothing was tracked.
        truth: ground truth of the same body, or None.
        scores: results by group and name, such as `{"ATE": {"rmse_m": 0.003, "path_m": 1.5}}`.
        metrics: numbers of the run by name, one level of nesting, as in metrics.json.
        samples: a few frames with their pictures.
        skipped: (stamp_ns, file, reason) of every measurement that could not be used.
        warnings: what a person should know, one sentence each.
        scale: what lengths of path and landmarks are: metres, units of a single camera brought to
            metres by the truth, or such units as they are.
        points: (M, 3) landmarks in the world, metres, or None.
        environment: versions and machine.
        map: what the map holds at the end, to be drawn; None for none.
        grid_png: a picture of the map as a grid, with the path; empty for none.
        cloud_png: a picture of the map as a cloud from above; empty for none.
        growth: how the map and the memory grew, or None.
        mapping: what local mapping made and dropped, by name.
        beside_ms: what ran beside the frames: count, median, p95 and max by name.
        loops: what was decided on loops; None where none were looked for.
    """

    title: str
    source: str = ""
    version: str = ""
    command: str = ""
    config: str = ""
    rig: str = ""
    estimates: Sequence[Estimate] = ()
    trajectory: Trajectory | None = None
    truth: Trajectory | None = None
    scores: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    metrics: Mapping[str, object] = field(default_factory=dict)
    samples: Sequence[Sample] = ()
    skipped: Sequence[tuple[int, str, str]] = ()
    warnings: Sequence[str] = ()
    scale: Scale = "metric"
    points: NDArray[np.float64] | None = None
    environment: Mapping[str, str] = field(default_factory=environment)
    map: "MapView | None" = None
    grid_png: bytes = b""
    cloud_png: bytes = b""
    growth: Growth | None = None
    beside_ms: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    mapping: Mapping[str, int] = field(default_factory=dict)
    loops: "LoopView | None" = None

    @property
    def has_path(self) -> bool:
        """Whether there is at least one pose to draw."""
        return self.trajectory is not None and len(self.trajectory) > 0

    @property
    def unit(self) -> str:
        """What lengths of the path are in: metres, or units of its own."""
        return "units" if self.scale == "free" else "m"


@dataclass(frozen=True)
class LostRun:
    """Frames lost in a row.

    Attributes:
        first: index of the first of them among the estimates.
        count: how many.
        start_ns: stamp of the first, nanoseconds.
        end_ns: stamp of the last, nanoseconds.
        reason: what the first of them said.
    """

    first: int
    count: int
    start_ns: int
    end_ns: int
    reason: str


def lost_runs(estimates: Sequence[Estimate]) -> list[LostRun]:
    """Gather lost frames into runs."""
    runs: list[LostRun] = []
    for k, e in enumerate(estimates):
        if e.status is not Status.LOST:
            continue
        if runs and runs[-1].first + runs[-1].count == k:
            last = runs[-1]
            reason = last.reason or e.reason
            runs[-1] = LostRun(last.first, last.count + 1, last.start_ns, e.stamp_ns, reason)
        else:
            runs.append(LostRun(k, 1, e.stamp_ns, e.stamp_ns, e.reason))
    return runs


@dataclass(frozen=True)
class Verdict:
    """The run in one sentence, and how much of a worry it is."""

    text: str
    level: Level


def verdict(report: Report) -> Verdict:
    """Sum up a run in plain words.

    Example:
        >>> verdict(Report("empty", environment={})).text
        'No frames were read'
    """
    total = len(report.estimates)
    placed = sum(e.status in PLACED for e in report.estimates)
    starting = sum(e.status is Status.INITIALIZING for e in report.estimates)
    if placed and report.trajectory is not None:  # a start's first views are placed afterwards
        known = set(report.trajectory.stamps_ns.tolist())
        late = sum(
            e.status is Status.INITIALIZING and e.stamp_ns in known for e in report.estimates
        )
        placed, starting = placed + late, starting - late
    parts = [_tracked(total, placed, starting)]
    runs = lost_runs(report.estimates)
    if runs and placed:
        lost = sum(run.count for run in runs)
        times = "once" if len(runs) == 1 else f"{len(runs)} times"
        parts.append(f"lost {times}, for {lost} {'frame' if lost == 1 else 'frames'} in all")
    parts += [text for text in (_accuracy(report), _pace(report)) if text]
    if report.skipped:
        n = len(report.skipped)
        parts.append(f"{n} {'image was' if n == 1 else 'images were'} unreadable")
    lost = sum(run.count for run in runs)
    if placed == 0 or lost > 0.1 * total:
        return Verdict("; ".join(parts), "bad")
    return Verdict("; ".join(parts), "warn" if runs or report.skipped else "good")


def _tracked(total: int, placed: int, starting: int) -> str:
    if total == 0:
        return "No frames were read"
    if placed == 0:
        return f"None of {total} frames could be tracked"
    text = f"Tracked {placed} of {total} frames"
    return f"{text} ({starting} for start-up)" if starting else text


def _accuracy(report: Report) -> str:
    ate = next((of for group, of in report.scores.items() if group.upper().startswith("ATE")), {})
    rmse = ate.get("rmse_m", math.nan)
    # The reference may go on long before and after the run: what was travelled is what counts.
    path = report.trajectory.path_length if report.trajectory is not None else math.nan
    fitted = ", scale fitted" if report.scale == "fitted" else ""
    if math.isfinite(rmse) and path > 0:
        return f"ATE {length(rmse)} over {length(path)} ({100 * rmse / path:.2g} %){fitted}"
    if math.isfinite(rmse):
        return f"ATE {length(rmse)}{fitted}"
    return "" if report.truth is not None or not report.has_path else "no ground truth to judge it"


def _pace(report: Report) -> str:
    given = report.metrics.get("ms_per_frame")
    median = given.get("median") if isinstance(given, Mapping) else given
    if not isinstance(median, (int, float)) or not math.isfinite(median):
        totals = frame_totals_ms(report.estimates)
        median = float(np.median(totals)) if len(totals) else math.nan
    return f"{significant(median, 2)} ms per frame" if math.isfinite(median) else ""


def frame_totals_ms(estimates: Sequence[Estimate]) -> NDArray[np.float64]:
    """Return the finite whole times per frame, milliseconds: "total" where given, else the sum."""
    totals = [
        e.timing["total"] if "total" in e.timing else sum(e.timing.values())
        for e in estimates
        if e.timing
    ]
    array = np.array(totals, dtype=np.float64)
    return array[np.isfinite(array)]


def length(metres: float) -> str:
    """Write a length with the unit that keeps it readable.

    Example:
        >>> length(0.00342), length(1.5), length(3724.2)
        ('3.4 mm', '1.5 m', '3.7 km')
    """
    if not math.isfinite(metres):
        return "unknown"
    for factor, unit in ((1e-3, "km"), (1.0, "m"), (1e2, "cm"), (1e3, "mm")):
        least = {"km": 1000.0, "m": 0.5, "cm": 0.02, "mm": 0.0}[unit]
        if abs(metres) >= least:
            return f"{significant(metres * factor, 2)} {unit}"
    return "0 mm"


def significant(value: float, digits: int) -> str:
    """Write a number with so many significant digits, never in powers of ten below a million."""
    if not math.isfinite(value):
        return "–"
    if value == 0 or abs(value) >= 1e6 or abs(value) < 1e-5:
        return f"{value:.{digits}g}"
    places = digits - 1 - math.floor(math.log10(abs(value)))
    return f"{value:,.{max(places, 0)}f}" if abs(value) >= 1e4 else f"{value:.{max(places, 0)}f}"
