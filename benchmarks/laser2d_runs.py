"""What runs over recordings and worlds of 2D lasers give (`laser2d.py`)."""

import json
import multiprocessing
import subprocess
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
from doublewalls import doubled, in_the_open
from meter import peak_memory_mb
from rounds import private_mb

from odomap.evaluation.consistency import nees
from odomap.evaluation.match import match
from odomap.evaluation.metrics import ate, read_relations, relations
from odomap.evaluation.walls import compare_walls
from odomap.files.mapfile import save_map
from odomap.geometry.lie import se3_inverse, se3_log
from odomap.geometry.planar import IN_PLANE
from odomap.geometry.trajectory import Trajectory
from odomap.kernels import needed_modules, warm_up
from odomap.lidar.scans import Beams
from odomap.maps.estimate import Status
from odomap.maps.occupancy import grid_of_map
from odomap.run import RunResult, chosen_config, run
from odomap.sources.open import open as open_source
from odomap.sources.simulated import SimulatedSource
from odomap.system.config import Config
from odomap.system.slam import Slam
from odomap.system.system import System

WITHOUT_LOOPS = (("scan_closing.enabled", "false"),)
Judge = Callable[[Trajectory, Trajectory], float]
EVERY = 5
"""Of the frames of a world, those whose beams say which walls can be seen."""


@dataclass(frozen=True)
class Related:
    """How well relations checked by hand are kept.

    Attributes:
        relations: how many.
        trans_m: mean error of translation.
        rot_deg: of rotation.
        odometry_m: the same of the wheels alone.
        odometry_deg: likewise.
        without_loops_m: of the path whose loops were not closed.
        without_loops_deg: likewise.
        loops: closed.
        refused: candidates that were not.
        lost: frames.
    """

    relations: int
    trans_m: float
    rot_deg: float
    odometry_m: float
    odometry_deg: float
    without_loops_m: float
    without_loops_deg: float
    loops: int
    refused: int
    lost: int


@dataclass(frozen=True)
class Drawn:
    """How single the walls of a grid are, and of the grid whose loops were not closed.

    Attributes:
        loops: closed.
        refused: candidates that were not.
        lost: frames.
        doubled: share of the cells of long walls with a parallel one close by.
        open: share of beams that end where the grid is free.
        moved_m: most that closing loops moved a keyframe by, in one go.
        doubled_without: without loops.
        open_without: likewise.
    """

    loops: int
    refused: int
    lost: int
    doubled: float
    open: float
    moved_m: float
    doubled_without: float
    open_without: float


@dataclass(frozen=True)
class Built:
    """A simulated building.

    Attributes:
        percent: ATE relative to the path.
        nees: mean normalised error squared in the plane per degree of freedom.
        true: share of the wall cells within one cell of a true wall, path and grid aligned.
        true_as_is: the same where the grid is laid on the first pose alone.
        found: share of the walls that can be seen with a wall cell within one cell.
        keyframes: at the end.
        loops: closed.
        lost: frames.
    """

    percent: float
    nees: float
    true: float
    true_as_is: float
    found: float
    keyframes: int
    loops: int
    lost: int


@dataclass(frozen=True)
class Held:
    """What is held after a round.

    Attributes:
        keyframes: alive.
        submaps: likewise; none but of a 2D laser.
        edges: of the map.
        file_mb: size of its file.
        memory_mb: of the process, over what it held before the first frame.
        peak_mb: the most it ever held, all in all.
        lost: frames of this round.
        ate_m: of the path so far.
        nees: mean normalised error squared per degree of freedom.
        ms: of a frame in this round, mean.
    """

    keyframes: int
    submaps: int
    edges: int
    file_mb: float
    memory_mb: float
    peak_mb: float
    lost: int
    ate_m: float
    nees: float
    ms: float


def played(data: str | Path, out: Path | None = None, loops: bool = True) -> RunResult:
    """Run a recording in lockstep."""
    config = chosen_config("lidar2d", overrides=() if loops else WITHOUT_LOOPS)
    return run(str(data), out, config=config)


def related(file: Path, truth: Path, out: Path | None) -> Related:
    """Hold a run against relations."""
    checked = read_relations(truth)
    results = [played(file, _beneath(out, file, loops), loops) for loops in (True, False)]
    found, without = (relations(result.trajectory, checked) for result in results)
    wheels = relations(wheel_path(file), checked)
    metrics = results[0].metrics
    return Related(
        found.relations,
        found.trans_mean,
        found.rot_mean_deg,
        wheels.trans_mean,
        wheels.rot_mean_deg,
        without.trans_mean,
        without.rot_mean_deg,
        metrics["loops_closed"],
        metrics["loops_rejected"],
        metrics["lost"],
    )


def wheel_path(file: Path) -> Trajectory:
    """Return the path that the wheels tell."""
    told = [(f.stamp_ns, f.odometry) for f in open_source(file) if f.odometry is not None]
    stamps, Ts = zip(*told)
    order = np.argsort(stamps, kind="stable")  # clocks of old logs jump back
    return Trajectory(np.array(stamps, np.int64)[order], np.array(Ts)[order])


def drawn(file: Path, out: Path | None) -> Drawn:
    """Look at the walls of a run's grid."""
    beams = Beams(open_source(file).rig.lidars[0])
    rig = open_source(file).rig
    numbers, results = [], []
    for loops in (True, False):
        result = played(file, _beneath(out, file, loops), loops)
        grid = grid_of_map(result.map, rig).grid
        numbers.append((doubled(grid), in_the_open(result.map, beams, grid)))
        results.append(result)
    first, (live, end) = results[0], (results[0].trajectory_live, results[0].trajectory)
    rows = np.isin(end.stamps_ns, live.stamps_ns)
    moved = np.linalg.norm(end.positions[rows] - live.positions, axis=1).max()
    metrics = first.metrics
    return Drawn(
        metrics["loops_closed"],
        metrics["loops_rejected"],
        metrics["lost"],
        *numbers[0],
        float(moved),
        *numbers[1],
    )


def _beneath(out: Path | None, file: Path, loops: bool) -> Path | None:
    name = file.name.split(".")[0]
    return None if out is None else out / (name if loops else f"{name}-without-loops")


def built(name: str, out: Path | None = None) -> Built:
    """Hold a run in a simulated building against its plan."""
    source = open_source(name)
    result = run(source, out)
    grid = grid_of_map(result.map, source.rig).grid
    world, path = source.world, result.trajectory
    error = ate(path, source.truth)
    seen = np.concatenate([world.hits(k) for k in range(0, len(source), EVERY)])
    cells = grid.centres(np.argwhere(grid.log_odds > 0.0))
    walls = []
    for T in (error.T_reference_estimate.matrix, source.truth.Ts_world_body[0]):
        centres = cells @ T[:2, :2].T + T[:2, 3]
        walls.append(compare_walls(centres, world.plan.distances(centres), seen, grid.resolution))
    metrics = result.metrics
    return Built(
        error.percent,
        planar_nees(path, source.truth),
        walls[0].true,
        walls[1].true,
        walls[0].found,
        metrics["keyframes"],
        metrics["loops_closed"],
        metrics["lost"],
    )


def planar_nees(path: Trajectory, truth: Trajectory) -> float:
    """Return the mean normalised error squared in the plane, per degree of freedom."""
    pairs = match(path, truth)
    A = pairs.Ts_reference[0] @ se3_inverse(pairs.Ts_estimate[0])
    errors = se3_log(se3_inverse(pairs.Ts_reference) @ (A @ pairs.Ts_estimate))
    values = nees(errors[:, IN_PLANE], pairs.covariances[:, IN_PLANE[:, None], IN_PLANE])
    return float(np.nanmean(values)) / 3.0


def factor_of_real_time(file: Path) -> float:
    """Run a recording in a new process, all outputs written; return its time over the process's."""
    with tempfile.TemporaryDirectory(prefix="odomap-laser2d-") as folder:
        command = [sys.executable, "-m", "odomap", "run", str(file), "--out", folder, "--quiet"]
        start = perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        seconds = perf_counter() - start
        if done.returncode != 0:
            sys.exit(f"{file.name}: odomap run failed: {done.stderr.strip()[-2000:]}")
        metrics = json.loads((Path(folder) / "metrics.json").read_text(encoding="utf-8"))
    return float(metrics["duration_s"]) / seconds


def rounds_of(name: str, rounds: int, config: Config, judge: Judge = planar_nees) -> list[Held]:
    """Go round a world in a process of its own; return what is held after each round.

    Args:
        name: of the world.
        rounds: how often.
        config: of the system.
        judge: says how large normalised errors are.
    """
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn) as pool:
        world = f"{name}&rounds={rounds}"
        return pool.submit(_gone_round, world, rounds, config, judge).result()


def _gone_round(name: str, rounds: int, config: Config, judge: Judge) -> list[Held]:
    source = open_source(name)
    system = Slam(source.rig, config)
    for module in needed_modules():
        warm_up(module)
    held: list[Held] = []
    ends = np.round(np.arange(1, rounds + 1) * (len(source) - 1) / rounds).astype(int).tolist()
    before, lost, start = private_mb(), 0, perf_counter()
    for frame in source:
        lost += system.track(frame).status is Status.LOST
        if frame.id in ends:
            seconds = perf_counter() - start
            each = ends[0] if not held else ends[1] - ends[0]
            held.append(_held(system, source, before, lost, 1e3 * seconds / each, judge))
            lost, start = 0, perf_counter()
    return held


def _held(
    system: System, source: SimulatedSource, before: float, lost: int, ms: float, judge: Judge
) -> Held:
    """Look at a system between two frames."""
    memory = private_mb() - before
    with tempfile.TemporaryDirectory(prefix="odomap-laser2d-") as folder:
        file = Path(folder) / "map.odomap"
        save_map(file, system.map, source.rig)
        size = file.stat().st_size / 2**20
    path = system.finish()
    return Held(
        path.map.num_keyframes,
        path.mapping.get("submaps", 0),
        len(path.map.edges().kind),
        size,
        memory,
        peak_memory_mb(),
        lost,
        ate(path.trajectory, source.truth).rmse,
        judge(path.trajectory, source.truth),
        ms,
    )
