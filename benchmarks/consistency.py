"""Simulated worlds of many seeds: is the path right, and do its covariances say how wrong it is?

    python benchmarks/consistency.py [--seeds 5] [--frames 150] [--kinds room street]
                                     [--world FIELD=VALUE] [--cache DIR] [--jobs N]
                                     [--set NAME=VALUE] [--json FILE]

Per world: RMSE of the absolute trajectory error in percent of the path, frames without a pose, and
the mean over frames of the normalised error squared per degree of freedom, eᵀ P⁻¹ e / 6, which is
1 where covariances P are right, more where they promise too much. The exit code is 1 where a bar
is missed: 0.5 % in every world, no frame lost, between 0.5 and 2 in the mean over all worlds.

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
from odomap.maps.estimate import Status
from odomap.run import chosen_config
from odomap.simulation.export import export_euroc
from odomap.simulation.world import World
from odomap.sources.open import open as open_source
from odomap.sources.simulated import read_spec
from odomap.sources.source import Source
from odomap.system.odometry import make_odometry

KINDS = ("room", "street")
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
        Job(kind, seed, options.frames, tuple(options.world), options.cache, assignments)
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
    missed = below_bars(rows)
    for line in missed:
        print(f"bar missed: {line}")
    if options.json:
        content = {"worlds": [asdict(row) for row in rows], "nees": mean_nees(rows)}
        Path(options.json).write_text(json.dumps(content, indent=1), encoding="utf-8")
    return 1 if missed else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
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
    return parser.parse_args()


def run(job: Job) -> Row:
    """Track one world and judge the path."""
    source = open_world(job)
    config = chosen_config(None, None, job.assignments, source.rig)
    system = make_odometry(source.rig, config)
    lost = 0
    for frame in source:
        estimate = system.track(frame)
        lost += estimate.status == Status.LOST or estimate.keyframe_id < 0
    result = system.finish()
    assert source.truth is not None
    percent, values = float("inf"), [float("nan")] * 3
    try:
        percent = ate(result.trajectory, source.truth).percent
        judged = consistency(result.trajectory, source.truth)
        live = consistency(result.trajectory_live, source.truth)
        values = [judged.per_dof, judged.inside_95, live.per_dof]
    except OdomapError as error:
        print(f"{job.kind} {job.seed}: {error}", file=sys.stderr)
    path_m = source.truth.path_length
    return Row(job.kind, job.seed, len(source), path_m, percent, lost, *values)


def open_world(job: Job) -> Source:
    """Return the source of a world, rendered as it is read or kept from an earlier time."""
    name = f"sim:{job.kind}?" + "&".join((f"seed={job.seed}", f"frames={job.frames}", *job.world))
    if job.cache is None:
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


def below_bars(rows: Sequence[Row]) -> list[str]:
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
    if not NEES_RANGE[0] <= mean <= NEES_RANGE[1]:
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
