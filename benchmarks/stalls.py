"""What mapping costs the tracker: how long the map's lock is held, how long a frame waits.

    python benchmarks/stalls.py --data DATA [--recordings euroc_mh01 kitti_stereo ...]
                                [--rhythms lockstep live] [--suffix=-flow] [--repeats 3]

Recordings are played at the pace of their sensor. Two figures, each the smallest of the repeats:

    lock   the longest hold of the map's lock, counted on the holder's own processor time, so that
           other programs on the machine do not count; beside it the longest by the clock on the
           wall, and whose the hold was. Bar: 2 ms.
    stall  what mapping takes of a frame's time: waiting for a change that is due, writing it,
           reading the map for the next job; the 99th percentile over frames and the longest. Bar
           on the percentile: 15 ms.

Beside them, without a bar, what lies behind the stalls: reading, solving and writing of a job, of
their own processor time, median and longest ("parts"; a change that is solved in less than is left
of a frame's interval is not waited for); and how much longer placing a frame takes while a job is
being solved in the other thread ("beside"): the difference of the medians. Exit code 1 where a bar
is missed.
"""

import argparse
import json
import os
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from played import SKIPPED

from odomap.kernels import needed_modules, warm_up
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sources.open import open as open_source
from odomap.sources.source import Source
from odomap.system.config import Config, preset
from odomap.system.parallel import ParallelWorker
from odomap.system.slam import Slam

LONGEST_HOLD_MS = 2.0
LONGEST_STALL_MS = 15.0
SENSORS = {"euroc_mh01": "stereo", "kitti_stereo": "stereo", "kitti_mono": "mono"}
"""How a recording is looked at, where it is not "rgbd"."""


class TracedLock:
    """A re-entrant lock that remembers its longest hold, and whose that was.

    Attributes:
        own_ms: the longest hold, of the holder's own processor time.
        wall_ms: the longest hold by the clock on the wall.
        holder: function that took the lock for the longest hold of own time.
        count: how often it was taken.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._depth = 0
        self._own = self._wall = 0.0
        self._who = ""
        self.own_ms = self.wall_ms = 0.0
        self.holder = ""
        self.count = 0

    def __enter__(self) -> None:
        self._lock.acquire()
        self._depth += 1
        if self._depth == 1:
            self._who = sys._getframe(1).f_code.co_qualname
            self._wall, self._own = time.perf_counter(), time.thread_time()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._depth == 1:
            own = 1e3 * (time.thread_time() - self._own)
            self.wall_ms = max(self.wall_ms, 1e3 * (time.perf_counter() - self._wall))
            self.count += 1
            if own > self.own_ms:
                self.own_ms, self.holder = own, self._who
        self._depth -= 1
        self._lock.release()


@dataclass
class Parts:
    """Own milliseconds of what a job is made of, job after job."""

    read: list[float] = field(default_factory=list)
    solve: list[float] = field(default_factory=list)
    write: list[float] = field(default_factory=list)

    def watch(self, mapper: Any) -> None:
        """Have all jobs of a mapper timed."""
        add = mapper.add

        def watched(keyframe: Keyframe) -> "_Job | None":
            job = timed(self.read, add, keyframe)
            return None if job is None else _Job(self, job)

        mapper.add = watched


@dataclass(frozen=True)
class _Job:
    parts: Parts
    job: Any

    def solve(self) -> "_Change":
        return _Change(self.parts, timed(self.parts.solve, self.job.solve))


@dataclass(frozen=True)
class _Change:
    parts: Parts
    change: Any

    @property
    def loops(self) -> Any:
        return self.change.loops

    def write(self, m: Map) -> None:
        timed(self.parts.write, self.change.write, m)


def timed(laps: list[float], call: Callable[..., Any], *args: Any) -> Any:
    """Call something and note the processor time of this thread, in ms."""
    start = time.thread_time()
    result = call(*args)
    laps.append(1e3 * (time.thread_time() - start))
    return result


@dataclass(frozen=True)
class Costs:
    """What one run said.

    Attributes:
        lock_ms: longest hold of the lock, own time.
        lock_wall_ms: longest hold on the wall.
        holder: who held it for lock_ms.
        stall_p99: of what mapping took of the frames' time, ms.
        stall_max: the longest.
        beside_ms: how much longer a frame is placed beside a job, median; NaN where that never was.
        beside: frames placed beside a job.
        frames: all that count.
        parts: of every job, by name.
    """

    lock_ms: float
    lock_wall_ms: float
    holder: str
    stall_p99: float
    stall_max: float
    beside_ms: float
    beside: int
    frames: int
    parts: dict[str, list[float]]


def main() -> int:
    options = _options()
    cv2.setNumThreads(1)
    missed: list[str] = []
    results: dict[str, dict[str, object]] = {}
    for name in options.recordings:
        config = preset(SENSORS.get(name, "rgbd") + options.suffix)
        source = open_source(Path(options.data) / name)
        for rhythm in options.rhythms:
            runs = [run(source, config, rhythm, options.frames) for _ in range(options.repeats)]
            what = f"{name}, {rhythm}"
            print_costs(what, runs)
            missed += below_bars(what, runs)
            results[what] = {"runs": [vars(costs) for costs in runs]}
    for line in missed:
        print(f"bar missed: {line}")
    if options.json:
        Path(options.json).write_text(json.dumps(results, indent=1), encoding="utf-8")
    return 1 if missed else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", default=os.environ.get("ODOMAP_DATA"))
    known = [*SENSORS, "rgbd_desk"]
    parser.add_argument("--recordings", nargs="+", default=known, choices=known)
    parser.add_argument("--rhythms", nargs="+", default=["lockstep", "live"])
    parser.add_argument("--suffix", default="", help="of the preset: -flow")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--frames", type=int, default=0, help="only the first ones")
    parser.add_argument("--json", help="write all numbers here")
    options = parser.parse_args()
    if not options.data:
        parser.exit(2, f"{parser.prog}: --data is needed (or set ODOMAP_DATA)\n")
    return options


def run(source: Source, config: Config, rhythm: str, frames: int = 0, paced: bool = True) -> Costs:
    """Play a recording to SLAM at the pace of its sensor, and note what mapping costs."""
    system = Slam(source.rig, config, rhythm)
    system.map.lock = lock = TracedLock()  # type: ignore[assignment]
    parts = Parts()
    parts.watch(system.worker.stages.mapper)
    for module in needed_modules():
        warm_up(module)
    stalls, placing, is_beside = [], [], []
    start, first = 0.0, 0
    for count, frame in enumerate(source):
        if frames and count == frames:
            break
        if count == 0:
            start, first = time.perf_counter(), frame.stamp_ns
        if paced:
            due = start + 1e-9 * (frame.stamp_ns - first)
            time.sleep(max(0.0, due - time.perf_counter()))
        was_solving = is_solving(system)
        timing = system.track(frame).timing
        # In lockstep a job that is due is collected before the frame is placed.
        is_beside.append(was_solving and rhythm == "live")
        stalls.append(timing["wait"])
        placing.append(timing.get("prepare", 0.0) + timing.get("track", 0.0))
    system.finish()
    return summary(lock, np.array(stalls), np.array(placing), np.array(is_beside), parts)


def is_solving(system: Slam) -> bool:
    """Say whether mapping is at work in its thread."""
    worker = system.worker
    if not isinstance(worker, ParallelWorker):
        return False
    return any(lane.is_out and not lane.is_solved for lane in worker._lanes)


def summary(
    lock: TracedLock,
    stalls: np.ndarray,
    placing: np.ndarray,
    is_beside: np.ndarray,
    parts: Parts,
) -> Costs:
    """Return the figures of a run from those of its frames."""
    stalls, placing, beside = stalls[SKIPPED:], placing[SKIPPED:], is_beside[SKIPPED:].astype(bool)
    alone = placing[~beside]
    slower = np.nan
    if beside.any() and len(alone):
        slower = float(np.median(placing[beside]) - np.median(alone))
    return Costs(
        lock.own_ms,
        lock.wall_ms,
        lock.holder,
        float(np.percentile(stalls, 99)),
        float(stalls.max()),
        slower,
        int(beside.sum()),
        len(stalls),
        vars(parts),
    )


def below_bars(what: str, runs: list[Costs]) -> list[str]:
    """Return a sentence for every bar that even the best run misses."""
    hold = min(runs, key=lambda costs: costs.lock_ms)
    stall = min(costs.stall_p99 for costs in runs)
    missed = []
    if not hold.lock_ms <= LONGEST_HOLD_MS:
        held = f"the lock is held for {hold.lock_ms:.2f} ms by {hold.holder}"
        missed.append(f"{what}: {held}, at most {LONGEST_HOLD_MS:g} ms")
    if not stall <= LONGEST_STALL_MS:
        p99 = f"mapping takes {stall:.1f} ms of a frame's time (p99)"
        missed.append(f"{what}: {p99}, at most {LONGEST_STALL_MS:g} ms")
    return missed


def print_costs(what: str, runs: list[Costs]) -> None:
    """Print the figures of the runs, the best of each."""
    hold = min(runs, key=lambda costs: costs.lock_ms)
    stall = min(runs, key=lambda costs: costs.stall_p99)
    wall = min(costs.lock_wall_ms for costs in runs)
    print(f"{what}: {stall.frames} frames, best of {len(runs)}")
    print(f"  lock   {hold.lock_ms:7.2f} ms own time, {wall:.2f} ms on the wall, {hold.holder}")
    print(f"  stall  {stall.stall_p99:7.2f} ms p99, {stall.stall_max:.2f} ms longest")
    for part in ("read", "solve", "write"):
        middle = min(float(np.median(costs.parts[part] or [0.0])) for costs in runs)
        worst = min(max(costs.parts[part], default=0.0) for costs in runs)
        print(f"  {part:6} {middle:7.2f} ms median, {worst:.2f} ms longest, own time")
    beside = f"{stall.beside_ms:+7.2f} ms" if stall.beside else "      0 ms"
    print(f"  beside {beside}, of {stall.beside} frames", flush=True)


if __name__ == "__main__":
    sys.exit(main())
