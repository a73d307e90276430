"""Odometry of 3D LiDARs, ours and KISS-ICP's, on the same sweeps in the same run (`lidar3d.py`)."""

import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
from numpy.typing import NDArray

from odomap.evaluation.metrics import ate, kitti_segments, rpe
from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.geometry.trajectory import Trajectory
from odomap.kernels import needed_modules, warm_up
from odomap.lidar.sweeps import points_of
from odomap.maps.estimate import Status
from odomap.run import chosen_config
from odomap.sensors.frame import Frame
from odomap.sensors.rig import LidarMount, Rig
from odomap.sources.source import Source
from odomap.system.config import Config
from odomap.system.slam import Slam
from odomap.system.stages import Loop
from odomap.system.system import Result

PROGRAM = Path(__file__).parent / "lidar3d_peer.py"
WITHOUT_LOOPS = (("cloud_closing.enabled", "false"),)
SEGMENT_M, SHORT_M = 100.0, 10.0
SKIPPED = 2
"""Sweeps before there is anything to lay one onto are not timed."""

Array = NDArray[np.float64]
Settings = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Way:
    """One way to do odometry.

    Attributes:
        who: a front-end of ours, or "KISS-ICP".
        is_compensated: whether the motion over a sweep is taken out.
    """

    who: str
    is_compensated: bool

    @property
    def is_ours(self) -> bool:
        """Whether it is odomap's."""
        return self.who != "KISS-ICP"

    def __str__(self) -> str:
        return f"{self.who}, {'motion-compensated' if self.is_compensated else 'raw sweeps'}"


@dataclass(frozen=True)
class Found:
    """How well and how fast a drive was followed.

    Attributes:
        ate_m: RMSE after a rigid alignment.
        per10_m: mean error over 10 m, NaN where the drive is shorter.
        per10_deg: likewise.
        percent: mean drift over segments of 100 m, NaN where the drive is shorter.
        deg_per_m: of rotation.
        ms: of a sweep, median.
        ms_p95: 95 of 100 are below.
        cpu_ms: median of the processor's time, of all threads: what waits for nobody else.
        lost: sweeps.
    """

    ate_m: float
    per10_m: float
    per10_deg: float
    percent: float
    deg_per_m: float
    ms: float
    ms_p95: float
    cpu_ms: float
    lost: int


class Ours:
    """Our system, told sweep after sweep, on one thread."""

    def __init__(self, rig: Rig, way: Way) -> None:
        self.way = way
        self._system = Slam(rig, config_of(way.who, False))
        self._ms, self._lost = list[tuple[float, float]](), 0
        for module in needed_modules():
            warm_up(module)

    def tell(self, frame: Frame) -> None:
        """Track a sweep."""
        frame = frame if self.way.is_compensated else without_times(frame)
        start = perf_counter(), process_time()
        estimate = self._system.track(frame)
        self._ms.append((1e3 * (perf_counter() - start[0]), 1e3 * (process_time() - start[1])))
        self._lost += estimate.status is Status.LOST

    def end(self, truth: Trajectory, ends: Array) -> Found:
        """Return what came of it."""
        path = self._system.finish().trajectory
        return found(path, truth, ends, self.way, np.array(self._ms), self._lost)


class Kiss:
    """KISS-ICP, told sweep after sweep, in a process of its own with threads of its own."""

    def __init__(self, python: str, mount: LidarMount, way: Way, stack: ExitStack) -> None:
        self.way, self._mount = way, mount
        self._out = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="odomap-kiss-")))
        self._said = (self._out / "said.txt").open("w+", encoding="utf-8")
        stack.enter_context(self._said)
        command = [python, str(PROGRAM), str(self._out / "out.npz")]
        command += ["--deskew"] if way.is_compensated else []
        self._stamps: list[int] = []
        self._process = stack.enter_context(
            subprocess.Popen(command, stdin=subprocess.PIPE, stdout=self._said, stderr=self._said)
        )
        stack.callback(self._process.kill)

    def tell(self, frame: Frame) -> None:
        """Hand a sweep over."""
        assert frame.cloud is not None, "a drive of sweeps"
        seen = points_of(frame.cloud, self._mount)
        pipe = self._process.stdin
        assert pipe is not None, "made with a pipe"
        try:
            pipe.write(np.int64(len(seen)).tobytes())
            pipe.write(np.column_stack([seen.points, seen.times]).tobytes())
        except BrokenPipeError:
            self._fail()
        self._stamps.append(frame.stamp_ns)

    def end(self, truth: Trajectory, ends: Array) -> Found:
        """Return what came of it."""
        self._process.communicate()
        if self._process.returncode != 0:
            self._fail()
        with np.load(self._out / "out.npz") as arrays:
            path = Trajectory(np.array(self._stamps, np.int64), np.array(arrays["Ts"]))
            return found(path, truth, ends, self.way, arrays["ms"], 0)

    def _fail(self) -> None:
        self._process.communicate()
        self._said.seek(0)
        lines = self._said.read().strip().splitlines() or [f"code {self._process.returncode}"]
        sys.exit(f"KISS-ICP failed: {lines[-1]}")


def without_times(frame: Frame) -> Frame:
    """Return a frame of whose points nobody knows when they were measured."""
    return replace(frame, cloud=None if frame.cloud is None else replace(frame.cloud, times=None))


def config_of(front_end: str, closes: bool = True, also: Settings = ()) -> Config:
    """Return the preset with a front-end, with or without loops, and with what else is set."""
    chosen = (("cloud_tracking.front_end", front_end), *also)
    return chosen_config("lidar", overrides=chosen if closes else chosen + WITHOUT_LOOPS)


def followed(
    source: Source, ways: Sequence[Way], python: str, is_recorded: bool = False
) -> dict[Way, Found]:
    """Follow a drive in several ways.

    Args:
        source: of sweeps, with truth.
        ways: to do so.
        python: has KISS-ICP.
        is_recorded: whether one after the other follows it, so that they can be timed, and the
            truth is known at stamps alone; else all do at once, so that each sweep is made once.
    """
    assert source.truth is not None, f"{source.name}: has no truth"
    told: dict[Way, Found] = {}
    frames: Iterable[Frame] = list(source) if is_recorded else source
    for group in [[way] for way in ways] if is_recorded else [ways]:
        with ExitStack() as stack:
            mount = source.rig.lidars[0]
            runs = [
                Ours(source.rig, w) if w.is_ours else Kiss(python, mount, w, stack) for w in group
            ]
            ends, stamps = [], []
            for frame in frames:
                for run in runs:
                    run.tell(frame)
                times = None if frame.cloud is None else frame.cloud.times
                ends.append((0.0, 0.0) if times is None else (times.min(), times.max()))
                stamps.append(frame.stamp_ns)
            truth = source.truth
            spans = np.zeros((len(truth), 2))
            at = np.searchsorted(truth.stamps_ns, stamps)
            spans[at] = 0.0 if is_recorded else ends
            told |= {run.way: run.end(truth, spans) for run in runs}
    return told


def found(
    path: Trajectory, truth: Trajectory, ends: Array, way: Way, ms: Array, lost: int
) -> Found:
    """Hold a path against the truth, and sum up its milliseconds (N, 2): passed, of processors.

    A pose of ours is that at the stamp. One of raw sweeps is that of no moment in particular, and
    KISS-ICP's is that at the end of a sweep: both are held against the truth at the stamp, at the
    beginning, the middle and the end of the sweep, if it is known there, and judged by what suits
    each figure best.
    """
    moments = [np.zeros(len(truth))]
    if ends.any() and not (way.is_ours and way.is_compensated):
        moments += [ends[:, 0], ends.mean(axis=1), ends[:, 1]]
    figures = np.array([_figures(path, moved(truth, moment)) for moment in moments])
    timed = ms[SKIPPED:]
    wall, cpu = np.median(timed, axis=0).tolist()
    slow = float(np.percentile(timed[:, 0], 95))
    return Found(*np.min(figures, axis=0).tolist(), wall, slow, cpu, lost)


def _figures(path: Trajectory, truth: Trajectory) -> list[float]:
    """Return the errors in the order of `Found`."""
    short, long = [float("nan")] * 2, [float("nan")] * 2
    if truth.path_length > SHORT_M:
        errors = rpe(path, truth, SHORT_M, "m")
        short = [float(errors.trans_errors.mean()), float(errors.rot_errors_deg.mean())]
    if truth.path_length > SEGMENT_M:
        segments = kitti_segments(path, truth)
        of_length = segments.lengths_m == SEGMENT_M
        long = [100.0 * segments.trans_errors[of_length].mean()]
        long += [segments.rot_errors_deg_per_m[of_length].mean()]
    return [ate(path, truth).rmse, *short, *long]


def moved(truth: Trajectory, seconds: Array) -> Trajectory:
    """Return where a body was so many seconds after each stamp, its motion constant in between."""
    Ts, stamps = truth.Ts_world_body, truth.stamps_ns * 1e-9
    ahead = se3_log(se3_inverse(Ts[:-1]) @ Ts[1:]) / np.diff(stamps)[:, None]
    behind = np.vstack([ahead[:1], ahead])
    ahead = np.vstack([ahead, ahead[-1:]])
    twists = np.where(seconds[:, None] < 0, behind, ahead)
    return Trajectory(truth.stamps_ns, Ts @ se3_exp(twists * seconds[:, None]))


@dataclass(frozen=True, eq=False)
class Played:
    """A run of our system.

    Attributes:
        result: at the end.
        loops: looked at.
        statuses: of all frames.
        reasons: of the frames that were lost, by their ids.
        ms: of each frame.
    """

    result: Result
    loops: list[Loop]
    statuses: list[Status]
    reasons: dict[int, str]
    ms: list[float]

    @property
    def closed(self) -> int:
        """How many loops were."""
        return sum(loop.is_accepted for loop in self.loops)


def played(source: Source, system: Slam) -> Played:
    """Play a source to a system."""
    loops, statuses, reasons, ms = list[Loop](), list[Status](), dict[int, str](), list[float]()
    system.worker.on_loop.append(loops.append)
    for frame in source:
        start = perf_counter()
        estimate = system.track(frame)
        ms.append(1e3 * (perf_counter() - start))
        statuses.append(estimate.status)
        if estimate.status is Status.LOST:
            reasons[frame.id] = estimate.reason
    return Played(system.finish(), loops, statuses, reasons, ms)
