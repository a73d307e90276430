"""Bundle adjustment: odomap beside Ceres from the same start in one run, each on one core.

    python benchmarks/bundle.py [PROBLEM.txt ...] [--views 1000] [--points 200000] [--gate]

Without files: Ladybug-49 of the BAL data sets in DATA/bundle, and two generated laps of a ring with
1,000 views and 200,000 points. Seconds are those of the processor until the cost stays within 1e-4
of the final one, building the problem excluded; the smallest over the repeats, of Ceres' fastest
configuration (see `bundle_peers`). Ours begin with the arrays, before any analysis. Ceres' begin
after its preprocessor: pyceres cannot be told an elimination order, and the search for one, which
C++ callers are spared, can take as long as all else; it is printed below. Costs are
½ Σ |residual|², by one function for both. Peak memory is of the whole process, Python's objects
included.

The exit code is 1 where a bar is missed: Ladybug-49 at 13,344.4 within 1e-4 in at most Ceres' time;
the ring within 1 % of Ceres' cost, in at most twice its time, under 4 GB.
"""

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import gate
import numpy as np
import peer
from bundles import Bundle, cost, read, ring
from graph_peers import Run, reached
from meter import machine
from runs import HERE, Outcome, last_core, outcome

LADYBUG = "problem-49-7776"
LADYBUG_COST = 13_344.4
LARGEST_EXCESS = {LADYBUG: 1e-4}
LARGEST_TIME_RATIO = {LADYBUG: 1.0}
ANY_EXCESS, ANY_TIME_RATIO, LARGEST_MEMORY_MB = 0.01, 2.0, 4096.0


@dataclass(frozen=True)
class Best:
    """A solver's fastest configuration, and the lowest cost of any.

    Attributes:
        seconds: until the cost stays within 1e-4 of the final one.
        which: the configuration.
        cost: lowest final cost.
        memory_mb: peak of the process.
        also: seconds of every configuration and what else was measured.
    """

    seconds: float
    which: str
    cost: float
    memory_mb: float
    also: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Row:
    """One problem, solved by both."""

    name: str
    views: int
    points: int
    observations: int
    ours: Best
    ceres: Best

    @property
    def ratio(self) -> float:
        """Our seconds over Ceres'."""
        return self.ours.seconds / self.ceres.seconds

    @property
    def excess(self) -> float:
        """How far our cost is above the reference: what is known of Ladybug, otherwise Ceres'."""
        reference = LADYBUG_COST if self.name == LADYBUG else self.ceres.cost
        return self.ours.cost / reference - 1.0


def main() -> int:
    options = _options()
    rows = []
    print(f"{machine()}; smallest of the runs, one core\n{_HEAD}")
    with tempfile.TemporaryDirectory(prefix="odomap-bundle-") as folder:
        for bundle in _problems(options):
            rows.append(compare(options, bundle, Path(folder)))
            print(cells(rows[-1]), flush=True)
    for row in rows:
        print(configurations(row))
    if options.json:
        content = {"machine": machine(), "problems": [asdict(row) for row in rows]}
        Path(options.json).write_text(json.dumps(content, indent=1), encoding="utf-8")
    return gate.verdict(options, "bundle", ratios(rows), below_bars(rows))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    env = os.environ.get
    parser.add_argument("problems", nargs="*", type=Path, help="BAL files")
    parser.add_argument("--data", default=env("ODOMAP_DATA"), help="folder with bundle/")
    parser.add_argument("--peer-python", default=env("ODOMAP_PEER_PYTHON", sys.executable))
    parser.add_argument("--views", type=int, default=1000, help="of the ring; 0 for none")
    parser.add_argument("--points", type=int, default=200_000, help="of the ring")
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--cap", type=float, default=300.0, help="seconds of one run of Ceres")
    parser.add_argument("--core", type=int, default=last_core(), help="which one; -1 for any")
    gate.add_options(parser)
    options = parser.parse_args()
    if not options.problems:
        peer.require(parser, options, ("data",))
    return options


def _problems(options: argparse.Namespace) -> list[Bundle]:
    files = options.problems or sorted((Path(options.data) / "bundle").glob("*.txt*"))
    if not files:
        sys.exit(f"no problem in {options.data}/bundle")
    found = [read(file) for file in files]
    if options.views and not options.problems:
        found.append(ring(options.views, options.points))
    return found


def compare(options: argparse.Namespace, bundle: Bundle, scratch: Path) -> Row:
    """Have a problem solved by both, one after the other."""
    given = scratch / f"{bundle.name}.npz"
    bundle.save(given)
    common = ["--repeats", str(options.repeats), "--core", str(options.core)]
    ours = outcome([sys.executable, str(HERE / "bundle_ours.py"), str(given)], common, scratch)
    command = [options.peer_python, str(HERE / "bundle_peers.py"), str(given)]
    ceres = outcome(command, [*common, "--cap", str(options.cap)], scratch)
    return Row(
        bundle.name,
        len(bundle.poses),
        len(bundle.points),
        len(bundle.view),
        best(bundle, ours),
        best(bundle, ceres),
    )


def best(bundle: Bundle, found: Outcome) -> Best:
    """Return the fastest configuration of those that reach the lowest cost of any."""
    about, results = found
    runs = {
        name: [Run(r["seconds"], r["costs"], result) for r in several]
        for (name, several), result in zip(about["runs"].items(), results, strict=True)
    }
    if not runs:
        sys.exit(f"{bundle.name}: nothing solved it: {about['failed']}")
    final = min(run.costs[-1] for several in runs.values() for run in several)
    times = {name: min(reached(run, final) for run in several) for name, several in runs.items()}
    which = min(times, key=lambda name: times[name])
    lowest = min(cost(bundle, *unpacked(bundle, several[0].poses)) for several in runs.values())
    return Best(
        times[which],
        which,
        lowest,
        about["also"]["peak_memory_mb"],
        about["also"] | {"times": times, "failed": about["failed"]},
    )


def unpacked(bundle: Bundle, row: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return poses (K, 4, 4), points (M, 3) and intrinsics (K, 3) from the row they travel in."""
    first, last = bundle.poses.size, bundle.intrinsics.size
    return (
        row[:first].reshape(-1, 4, 4),
        row[first : len(row) - last].reshape(-1, 3),
        row[len(row) - last :].reshape(-1, 3),
    )


_HEAD = (
    f"{'':18}{'views':>6}{'points':>8}{'sights':>9}{'ours s':>8}{'Ceres s':>9}{'ratio':>6}"
    f"{'our cost':>13}{'Ceres cost':>13}{'excess':>9}{'ours MB':>9}{'Ceres MB':>9}"
)


def cells(row: Row) -> str:
    """Return one problem as a line of the table."""
    return (
        f"{row.name:18}{row.views:6}{row.points:8}{row.observations:9}{row.ours.seconds:8.2f}"
        f"{row.ceres.seconds:9.2f}{row.ratio:6.2f}{row.ours.cost:13.2f}{row.ceres.cost:13.2f}"
        f"{row.excess:+9.1e}{row.ours.memory_mb:9.0f}{row.ceres.memory_mb:9.0f}"
    )


def configurations(row: Row) -> str:
    """Return the seconds of every configuration, and what of Ceres' are spent on analysis."""
    lines = [f"\n{row.name}: seconds of Ceres' configurations"]
    times = sorted(row.ceres.also["times"].items(), key=lambda item: item[1])
    lines += [f"  {seconds:9.3f}  {which}" for which, seconds in times]
    lines += [f"  failed: {which}: {why}" for which, why in row.ceres.also["failed"].items()]
    lines.append(f"  {row.ceres.also['preprocessor_s']:9.3f}  its preprocessor, not in these")
    return "\n".join(lines)


def below_bars(rows: Sequence[Row]) -> list[str]:
    """Return a sentence for every bar that is missed."""
    missed = []
    for row in rows:
        excess = LARGEST_EXCESS.get(row.name, ANY_EXCESS)
        slower = LARGEST_TIME_RATIO.get(row.name, ANY_TIME_RATIO)
        if not row.excess <= excess:
            missed.append(f"{row.name}: the cost is {row.excess:.1e} too high, at most {excess:g}")
        if not row.ratio <= slower:
            missed.append(f"{row.name}: {row.ratio:.2f} of Ceres' time, at most {slower:g}")
        if not row.ours.memory_mb <= LARGEST_MEMORY_MB:
            missed.append(f"{row.name}: {row.ours.memory_mb:.0f} MB, at most {LARGEST_MEMORY_MB:g}")
    return missed


def ratios(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Return the ratios for the gate."""
    return {
        f"bundle/{row.name}": {
            "seconds": row.ratio,
            "peak_memory_mb": row.ours.memory_mb / row.ceres.memory_mb,
        }
        for row in rows
    }


if __name__ == "__main__":
    sys.exit(main())
