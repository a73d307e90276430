"""Pose graphs: odomap beside GTSAM and g2o from the same start in one run, each on one core.

    python benchmarks/posegraph.py [GRAPH.g2o ...] [--repeats 3] [--gate | --update-baseline]
    python benchmarks/posegraph.py --profile | --stall | --growth [--figure FILE.png]

Without files: every graph in DATA/graphs. Seconds are those of the processor until the cost stays
within 1e-4 of the final one, initialisation, ordering and symbolic work included, reading files
excluded, kernels compiled before; the smallest over the repeats, of a peer's fastest configuration
(see `graph_peers`). A peer's clock stops by the cost it minimises itself (g2o measures residuals
in its own way); the final costs compared are all odomap's geodesic cost, by one function. The
chordal cost stands beside SE-Sync's optima.

The exit code is 1 where a bar is missed: the time at most the fastest peer's for 1,000 poses and
more, the cost no worse than the best peer's by 1e-6, the chordal cost within 1e-3 of the certified
one, the certificates of sphere2500 and torus3D in 0.5 s.
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
import graph_growth
import graph_phases
import graph_stall
import numpy as np
import peer
from graph_peers import PEERS, Run, reached
from graphs import CERTIFIED, Problem, chordal_cost, geodesic_cost, read
from meter import machine
from runs import HERE, Outcome, last_core, merged, outcome

LEAST_TIMED = 1000
"""Poses from which times count: below, calls of Python are what is timed."""
LARGEST_TIME_RATIO = 1.0
LARGEST_EXCESS = 1e-6
LARGEST_CHORDAL_EXCESS = 1e-3
LARGEST_CERTIFICATE_S = {"sphere2500": 0.5, "torus3D": 0.5}


@dataclass(frozen=True)
class Best:
    """The fastest of a solver's configurations, and the lowest cost of any.

    Attributes:
        seconds: until the cost stays within 1e-4 of the final one; inf if it never does.
        which: the configuration.
        geodesic: lowest geodesic cost where any of its configurations ended.
        failed: configurations that ended with an error, and why.
        also: what else was measured.
    """

    seconds: float
    which: str
    geodesic: float
    failed: dict[str, str] = field(default_factory=dict)
    also: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Row:
    """One graph, solved by all."""

    name: str
    poses: int
    edges: int
    ours: Best
    peers: dict[str, Best]

    @property
    def fastest(self) -> str:
        """Name of the fastest peer."""
        return min(self.peers, key=lambda name: self.peers[name].seconds)

    @property
    def ratio(self) -> float:
        """Our seconds over those of the fastest peer."""
        return self.ours.seconds / self.peers[self.fastest].seconds

    @property
    def excess(self) -> float:
        """How far our geodesic cost is above the best peer's, relative; negative if below."""
        best = min(found.geodesic for found in self.peers.values())
        return self.ours.geodesic / best - 1.0

    @property
    def chordal_excess(self) -> float:
        """How far our chordal cost is above the certified optimum, relative; NaN if unknown."""
        return self.ours.also.get("chordal_cost", np.nan) / CERTIFIED.get(self.name, np.nan) - 1.0


def main() -> int:
    options = _options()
    if options.profile:
        return graph_phases.show(_problems(options, ("city10000", "torus3D")), options.repeats)
    if options.stall:
        return graph_stall.show(_problems(options, ("sphere2500",)), options.repeats)
    with tempfile.TemporaryDirectory(prefix="odomap-posegraph-") as folder:
        scratch = Path(folder)
        if options.growth:
            problems = [graph_growth.manhattan(n) for n in options.sizes]
        else:
            problems = _problems(options)
        rows = []
        print(f"{machine()}; smallest of {options.repeats} runs, one core\n{_HEAD}")
        for problem in problems:
            rows.append(compare(options, problem, scratch))
            print(cells(rows[-1]), flush=True)
    if options.verbose:
        print(configurations(rows))
    if options.growth:
        graph_growth.show({who: _times(rows, who) for who in _solvers(rows)}, options.figure)
        missed = []
    else:
        missed = below_bars(rows)
    if options.json:
        content = {"machine": machine(), "graphs": [asdict(row) for row in rows]}
        Path(options.json).write_text(json.dumps(content, indent=1), encoding="utf-8")
    return gate.verdict(options, "posegraph", ratios(rows), missed)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    env = os.environ.get
    parser.add_argument("graphs", nargs="*", type=Path, help="g2o files; default DATA/graphs")
    parser.add_argument("--data", default=env("ODOMAP_DATA"), help="folder with graphs/")
    parser.add_argument("--peer-python", default=env("ODOMAP_PEER_PYTHON", sys.executable))
    parser.add_argument("--peers", nargs="+", choices=PEERS, default=list(PEERS))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--cap", type=float, default=20.0, help="seconds of one run of a peer")
    parser.add_argument("--only", default="", help="configurations of peers that begin so, as GN")
    parser.add_argument("--core", type=int, default=last_core(), help="which one; -1 for any")
    parser.add_argument("--verbose", action="store_true", help="print all configurations")
    parser.add_argument("--profile", action="store_true", help="where our time goes")
    parser.add_argument("--stall", action="store_true", help="how long other threads wait")
    parser.add_argument("--growth", action="store_true", help="time over the number of poses")
    parser.add_argument("--sizes", nargs="+", type=int, default=graph_growth.SIZES)
    parser.add_argument("--figure", type=Path, help="of --growth, a PNG")
    gate.add_options(parser)
    options = parser.parse_args()
    if not (options.graphs or options.growth):
        peer.require(parser, options, ("data",))
    return options


def _problems(options: argparse.Namespace, names: Sequence[str] = ()) -> list[Problem]:
    """Read the files given, or all of the data; without files, those of some names."""
    files = options.graphs or sorted((Path(options.data) / "graphs").glob("*.g2o*"))
    if names and not options.graphs:
        files = [file for file in files if file.name.split(".")[0] in names]
    if not files:
        sys.exit(f"no graph in {options.data}/graphs")
    return [read(file) for file in files]


def compare(options: argparse.Namespace, problem: Problem, scratch: Path) -> Row:
    """Have a graph solved by all, one after the other, ours before and after the peers."""
    given = scratch / f"{problem.name}.npz"
    problem.save(given)
    common = ["--repeats", str(options.repeats), "--core", str(options.core)]
    ours = [sys.executable, str(HERE / "graph_ours.py"), str(given)]
    runs = {"odomap": [outcome(ours, common, scratch)]}
    for name in options.peers:
        command = [options.peer_python, str(HERE / "graph_peers.py"), name, str(given)]
        limits = ["--cap", str(options.cap), "--only", options.only]
        runs[name] = [outcome(command, [*common, *limits], scratch)]
    runs["odomap"].append(outcome(ours, common, scratch))
    found = {name: best(problem, several) for name, several in runs.items()}
    mine = found.pop("odomap")
    return Row(problem.name, len(problem.poses), len(problem.first), mine, found)


def best(problem: Problem, outcomes: Sequence[Outcome]) -> Best:
    """Return the fastest configuration: all must reach the lowest cost that any has reached."""
    runs: dict[str, list[Run]] = {}
    for about, poses in outcomes:
        for (name, several), ended in zip(about["runs"].items(), poses, strict=True):
            runs.setdefault(name, []).extend(Run(r["seconds"], r["costs"], ended) for r in several)
    also = merged([about["also"] for about, _ in outcomes])
    if "chordal_poses" in also:
        also["chordal_cost"] = chordal_cost(problem, np.array(also.pop("chordal_poses")))
    failed = {key: value for about, _ in outcomes for key, value in about["failed"].items()}
    if not runs:
        return Best(np.inf, "none", np.inf, failed, also)
    final = min(run.costs[-1] for several in runs.values() for run in several)
    times = {name: min(reached(run, final) for run in several) for name, several in runs.items()}
    which = min(times, key=lambda name: times[name])
    lowest = min(geodesic_cost(problem, several[0].poses) for several in runs.values())
    return Best(times[which], which, lowest, failed, also | {"times": times})


_HEAD = (
    f"{'':16}{'poses':>7}{'edges':>7}{'ours s':>8}{'peer s':>8} {'fastest peer':28}{'ratio':>6}"
    f"{'geodesic cost':>15}{'over peer':>10}{'chordal':>11}{'over opt.':>10}{'proof s':>8}"
)


def cells(row: Row) -> str:
    """Return one graph as a line of the table."""
    fastest = row.peers[row.fastest]
    proof = row.ours.also.get("certificate_s")
    return (
        f"{row.name:16}{row.poses:7}{row.edges:7}{row.ours.seconds:8.3f}{fastest.seconds:8.3f}"
        f" {row.fastest + ' ' + _short(fastest.which):28}{row.ratio:6.2f}{row.ours.geodesic:15.4f}"
        f"{row.excess:+10.1e}{row.ours.also.get('chordal_cost', np.nan):11.4f}"
        f"{row.chordal_excess:+10.1e}{f'{proof:8.3f}' if proof is not None else ''}"
        f"{' proven' if row.ours.also.get('certified') else ''}"
    )


def _short(which: str) -> str:
    return which.replace("MULTIFRONTAL_", "").replace(" from", ",")


def configurations(rows: Sequence[Row]) -> str:
    """Return the seconds of every configuration of every solver, and what failed."""
    lines = []
    for row in rows:
        lines.append(f"\n{row.name}")
        for who, found in {"odomap": row.ours, **row.peers}.items():
            lines.append(f"  {who:8} lowest geodesic cost {found.geodesic:.8g}")
            times = sorted(found.also.get("times", {}).items(), key=lambda item: item[1])
            lines += [f"    {seconds:9.4f} s  {which}" for which, seconds in times]
            lines += [f"    failed: {which}: {why}" for which, why in found.failed.items()]
    return "\n".join(lines)


def below_bars(rows: Sequence[Row]) -> list[str]:
    """Return a sentence for every bar that is missed."""
    missed = []
    for row in rows:
        if row.poses >= LEAST_TIMED and not row.ratio <= LARGEST_TIME_RATIO:
            missed.append(f"{row.name}: {row.ratio:.2f} of the time of {row.fastest}, at most 1")
        if not row.excess <= LARGEST_EXCESS:
            missed.append(f"{row.name}: the cost is {row.excess:.1e} above the best peer's")
        if row.name in CERTIFIED and not row.chordal_excess <= LARGEST_CHORDAL_EXCESS:
            missed.append(f"{row.name}: {row.chordal_excess:.1e} above the certified optimum")
        proof = row.ours.also.get("certificate_s", np.inf)
        if not proof <= LARGEST_CERTIFICATE_S.get(row.name, np.inf):
            missed.append(f"{row.name}: certificate in {proof:.2f} s, at most 0.5")
    return missed


def ratios(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Return the ratios for the gate: graphs that are large enough to be timed."""
    return {
        f"posegraph/{row.name}": {"seconds": row.ratio} for row in rows if row.poses >= LEAST_TIMED
    }


def _solvers(rows: Sequence[Row]) -> list[str]:
    return ["odomap", *rows[0].peers]


def _times(rows: Sequence[Row], who: str) -> dict[int, float]:
    return {row.poses: (row.ours if who == "odomap" else row.peers[who]).seconds for row in rows}


if __name__ == "__main__":
    sys.exit(main())
