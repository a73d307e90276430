"""Simulated worlds of many seeds: is the path right, and do its covariances say how wrong it is?

    python benchmarks/consistency.py [--sensors stereo] [--seeds 5] [--frames 150]
                                     [--kinds room street] [--world FIELD=VALUE] [--cache DIR]
                                     [--jobs N] [--set NAME=VALUE] [--json FILE]

Per world: RMSE of the absolute trajectory error in percent of the path, frames without a pose since
the first that has one, and the mean over frames of the normalised error squared per degree of
freedom, eᵀ P⁻¹ e / 6, which is 1 where covariances P are right, more where they promise too much.
The path of a single camera (--sensors mono) is judged with its scale fitted, its covariances in the
scale of the first window of keyframes, which is what they are relative to. The exit code is 1 where
a bar is missed: 0.5 % in every world, no frame lost, and where the scale is known between 0.5 and 2
in the mean over all worlds.

Rendering takes most of the time: with --cache the worlds are kept as recordings and rendered anew
only when the simulation has changed.
"""

import argparse
import hashlib
import json
import os
import shutil
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

import odomap.simulation
from odomap.errors import OdomapError
from odomap.evaluation.consistency import consistency
from odomap.evaluation.metrics import ate
from odomap.geometry.pose import Sim3
from odomap.geometry.trajectory import Trajectory
from odomap.run import chosen_config
from odomap.simulation.export import export_euroc
from odomap.simulation.world import World
from odomap.sources.open import open as open_source
from odomap.sources.simulated import read_spec
from odomap.sources.source import Source
from odomap.system.mapping import WindowConfig
from odomap.system.odometry import Result, make_odometry

KINDS = ("room", "street")
SENSORS = {"stereo": "stereo,imu", "mono": "mono", "rgbd": "mono,depth"}
"""What a world carries for each odometry."""
LARGEST_PERCENT = 0.5
NEES_RANGE = (0.5, 2.0)


@dataclass(frozen=True)
class Job:
    """One world, and how to run on it."""

    kind: str
    seed: int
    frames: int
    world: tuple[str, ...]
    cache: str | None
    assignments: tuple[tuple[str, str], ...]
    sensors: str = "stereo"


@dataclass(frozen=True)
class Row:
    """What came of one world.

    Attributes:
        percent: error in percent of the path; infinite where there is no path to judge.
        lost: frames without a pose.
        nees: normalised error squared per degree of freedom, mean over the frames.
        inside_95: share of the frames in the 95 % interval of what right covariances give.
        nees_live: as `nees`, of the path as first emitted.
    """

    kind: str
    seed: int
    frames: int
    path_m: float
    percent: float
    lost: int
    nees: float
    inside_95: float
    nees_live: float


def main() -> int:
    options = _options()
    assignments = tuple(
        (name, value) for name, _, value in (text.partition("=") for text in options.set)
    )
    jobs = [
        Job(
            *(kind, seed, options.frames, tuple(options.world), options.cache, assignments),
            sensors=options.sensors,
        )
        for kind in options.kinds
        for seed in range(options.first_seed, options.first_seed + options.seeds)
    ]
    print(f"{'world':12}{'frames':>7}{'path, m':>9}{'ATE, %':>8}{'lost':>6}", end="")
    print(f"{'NEES/dof':>10}{'in 95 %':>9}{'as first emitted':>18}")
    rows: list[Row] = []
    workers = max(1, min(options.jobs, len(jobs)))
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for row in pool.map(run, jobs):
            rows.append(row)
            print(_cells(f"{row.kind} {row.seed}", [row]), flush=True)
    for kind in options.kinds:
        print(_cells(f"{kind}s", [row for row in rows if row.kind == kind]))
    print(_cells("all", rows))
    missed = below_bars(rows, has_scale=options.sensors != "mono")
    for line in missed:
        print(f"bar missed: {line}")
    if options.json:
        content = {"worlds": [asdict(row) for row in rows], "nees": mean_nees(rows)}
        Path(options.json).write_text(json.dumps(content, indent=1), encoding="utf-8")
    return 1 if missed else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sensors", choices=SENSORS, default="stereo")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, help="default both; rgbd: rooms")
    parser.add_argument("--seeds", type=int, default=5, help="worlds of each kind")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument(
        "--world", action="append", default=[], metavar="FIELD=VALUE", help="e.g. moving_objects=3"
    )
    parser.add_argument("--cache", metavar="DIR", help="keep rendered worlds here")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--json", help="write all numbers here")
    options = parser.parse_args()
    if options.kinds is None:  # a depth camera sees nothing of a street
        options.kinds = ["room"] if options.sensors == "rgbd" else list(KINDS)
    return options


def run(job: Job) -> Row:
    """Track one world and judge the path."""
    source = open_world(job)
    config = chosen_config(None, None, job.assignments, source.rig)
    system = make_odometry(source.rig, config)
    for frame in source:
        system.track(frame)
    result = system.finish()
    assert source.truth is not None
    truth, found = result.truth(source.truth), result.trajectory
    since = int(np.searchsorted(truth.stamps_ns, found.stamps_ns[0])) if len(found) else 0
    lost = len(source) - since - len(found)
    percent, values = float("inf"), [float("nan")] * 3
    try:
        percent = ate(found, truth, "se3" if result.is_metric else "sim3").percent
        size = Sim3.from_parts(first_scale(result, truth), np.eye(3), np.zeros(3))
        judged = consistency(found.transformed(size), truth)
        live = consistency(result.trajectory_live.transformed(size), truth)
        values = [judged.per_dof, judged.inside_95, live.per_dof]
    except OdomapError as error:
        print(f"{job.kind} {job.seed}: {error}", file=sys.stderr)
    path_m = truth.path_length
    return Row(job.kind, job.seed, len(source), path_m, percent, lost, *values)


def first_scale(result: Result, truth: Trajectory) -> float:
    """Return metres per unit of a path, from the size of its first window; 1 if it is metric."""
    if result.is_metric:
        return 1.0
    stamps = result.keyframes.stamps_ns[: WindowConfig().size]
    ours, true = result.trajectory.between(stamps[0], stamps[-1]).associate(truth)
    a, b = result.trajectory.positions[ours], truth.positions[true]
    return float(np.linalg.norm(b - b[0]) / np.linalg.norm(a - a[0]))


def open_world(job: Job) -> Source:
    """Return the source of a world, rendered as it is read or kept from an earlier time."""
    given = (f"seed={job.seed}", f"frames={job.frames}", *job.world)
    name = f"sim:{job.kind}?" + "&".join((*given, f"sensors={SENSORS[job.sensors]}"))
    if job.cache is None or job.sensors != "stereo":  # what is kept is kept as a stereo recording
        return open_source(name)
    label = name.removeprefix("sim:").replace("?", "&").replace("&", "-")
    folder = Path(job.cache) / f"{label}-{simulation_hash()}"
    if not folder.exists():
        # Under another name until it is whole: an interrupted run must not leave half a world.
        part = folder.with_name(f"{folder.name}.part")
        shutil.rmtree(part, ignore_errors=True)
        export_euroc(World(read_spec(name)), part).rename(folder)
    return open_source(folder)


def simulation_hash() -> str:
    """Return a few characters that change with the code of the simulation."""
    digest = hashlib.sha256()
    for file in sorted(Path(odomap.simulation.__file__).parent.glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:10]


def mean_nees(rows: Sequence[Row]) -> float:
    """Return the mean over worlds; NaN where one has none."""
    return float(np.mean([row.nees for row in rows]))


def below_bars(rows: Sequence[Row], has_scale: bool = True) -> list[str]:
    """Return a sentence for every bar that is missed."""
    missed = []
    for row in rows:
        if not row.percent <= LARGEST_PERCENT:
            missed.append(
                f"{row.kind} {row.seed}: ATE {row.percent:.3f} %, at most {LARGEST_PERCENT} %"
            )
        if row.lost:
            missed.append(f"{row.kind} {row.seed}: {row.lost} frames lost")
    mean = mean_nees(rows)
    if has_scale and not NEES_RANGE[0] <= mean <= NEES_RANGE[1]:
        missed.append("NEES per degree of freedom {:.2f}, from {} to {}".format(mean, *NEES_RANGE))
    return missed


def _cells(label: str, rows: Sequence[Row]) -> str:
    """Return a line of the table: worst error, sum of the lost, means of the rest."""
    return (
        f"{label:12}{sum(r.frames for r in rows):7d}{sum(r.path_m for r in rows):9.2f}"
        f"{max(r.percent for r in rows):8.3f}{sum(r.lost for r in rows):6d}"
        f"{mean_nees(rows):10.2f}{np.mean([r.inside_95 for r in rows]):9.2f}"
        f"{np.mean([r.nees_live for r in rows]):18.2f}"
    )


if __name__ == "__main__":
    sys.exit(main())
