"""Pose graphs that grow: every graph replayed node by node, and what each addition costs.

    python benchmarks/incremental.py [NAME ...] [--every 100] [--figure FILE.png]
                                     [--peer-python PYTHON] [--most N]

Nodes come in the order of their ids, each with its edges to older ones, and the graph is updated
after each. A step is `add_node`, its `add_edge`s and `update`, in processor time; reading files is
not in it, kernels are compiled before. After every hundred nodes the cost is compared with that of
`solve` on the same graph, from scratch and from the present poses, whichever is lower; that is not
in the times either. With the Python of an environment that has gtsam, its iSAM2 does the same.

The exit code is 1 where the cost is more than 1 % above the batch solution's.
"""

import argparse
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from graphs import Problem, read
from meter import machine

from odomap.backend.graphs.incremental import IncrementalPoseGraph
from odomap.backend.graphs.solve import solve

PEER = Path(__file__).parent / "incremental_peer.py"
LARGEST_RATIO = 1.01
NAMES = ("manhattan", "sphere2500", "city10000")


@dataclass
class Replay:
    """What a replay took.

    Attributes:
        name: of the graph.
        ms: of each step.
        is_loop: whether the step brought more than the edge that places its node.
        scope: what its update did.
        ratio: nodes, and cost over the batch solution's, now and then.
        batch_s: all batch solutions together.
        cost: in the end.
        peer: what the peer says of itself, if there is one.
    """

    name: str
    ms: list[float] = field(default_factory=list)
    is_loop: list[bool] = field(default_factory=list)
    scope: list[str] = field(default_factory=list)
    ratio: list[tuple[int, float]] = field(default_factory=list)
    batch_s: float = 0.0
    cost: float = 0.0
    peer: dict[str, Any] = field(default_factory=dict)


def replay(problem: Problem, every: int, most: int | None = None) -> Replay:
    """Add the nodes of a graph one by one; `every` 0 leaves the batch solutions out."""
    graph = IncrementalPoseGraph("SE2" if problem.is_planar else "SE3")
    second = np.maximum(problem.first, problem.second)
    order = np.argsort(second, kind="stable")
    ends = np.searchsorted(second[order], np.arange(len(problem.poses)), side="right")
    out, begin = Replay(problem.name), 0
    for node, end in enumerate(ends[:most].tolist()):
        edges = order[begin:end].tolist()
        begin = end
        start = time.process_time()
        graph.add_node()
        for e in edges:
            i, j = int(problem.first[e]), int(problem.second[e])
            graph.add_edge(i, j, problem.measured[e], problem.information[e])
        record = graph.update()
        out.ms.append(1e3 * (time.process_time() - start))
        out.is_loop.append(len(edges) > 1)
        out.scope.append(record.scope)
        if every and node % every == 0 and node:
            out.ratio.append((node, _ratio(graph, out)))
    out.cost = graph.cost
    return out


def _ratio(graph: IncrementalPoseGraph, out: Replay) -> float:
    now = graph.graph()
    start = time.process_time()
    least = solve(now).cost_after
    out.batch_s += time.process_time() - start
    least = min(least, solve(now, initial="given").cost_after)
    return graph.cost / least if least > 1e-6 else 1.0


def table(runs: list[Replay]) -> str:
    """Return milliseconds per step by the number of nodes, and the cost beside the batch's."""
    lines = [
        "| graph | nodes | no loop: median ms | p95 | loop: median ms | p95 | largest "
        "| windows | wholes | worst cost ratio |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for run in runs:
        ms, is_loop, scope = np.array(run.ms), np.array(run.is_loop), np.array(run.scope)
        edges = [0, *[n for n in (100, 300, 1000, 3000, 10000) if n < len(ms)], len(ms)]
        for low, high in itertools.pairwise(edges):
            part, loop, what = ms[low:high], is_loop[low:high], scope[low:high]
            ratios = [ratio for node, ratio in run.ratio if low <= node < high]
            worst = f"{max(ratios):.5f}" if ratios else "-"
            lines.append(
                f"| {run.name} | {low} to {high} | {_quantiles(part[~loop], 50, 95)} | "
                f"{_quantiles(part[loop], 50, 95, 100)} | {(what == 'window').sum()} | "
                f"{(what == 'whole').sum()} | {worst} |"
            )
    lines.append("")
    lines += [_summary(run) for run in runs]
    return "\n".join(lines)


def _summary(run: Replay) -> str:
    ours = (
        f"{sum(run.ms) / 1e3:.1f} s in all, {np.mean(run.ms):.2f} ms per node, cost {run.cost:.2f}"
    )
    text = f"{run.name}: {ours}; batch now and then: {run.batch_s:.1f} s"
    if not run.peer:
        return text
    end = run.peer["failed"] or f"cost {run.peer['cost']:.2f}"
    return f"{text}; iSAM2: {sum(run.peer['ms']) / 1e3:.1f} s for {len(run.peer['ms'])}, {end}"


def peer(problem: Problem, python: str, most: int | None) -> dict[str, Any]:
    """Return what iSAM2 makes of the same nodes, by QR where Cholesky fails."""
    with tempfile.TemporaryDirectory() as scratch:
        given, out = Path(scratch) / f"{problem.name}.npz", Path(scratch) / "out.json"
        problem.save(given)
        result: dict[str, Any] = {"failed": "not run"}
        for factorization in ("CHOLESKY", "QR"):
            if result["failed"]:
                command = [python, str(PEER), str(given), str(out)]
                command += ["--factorization", factorization]
                subprocess.run(command + (["--most", str(most)] if most else []), check=True)
                result = json.loads(out.read_text(encoding="utf-8"))
        return result


def _quantiles(ms: np.ndarray, *percent: float) -> str:
    return " | ".join(f"{np.percentile(ms, p):.2f}" if len(ms) else "-" for p in percent)


def figure(runs: list[Replay], path: Path) -> None:
    """Draw milliseconds per step against the number of nodes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    drawn, axes = plt.subplots(1, len(runs), figsize=(5 * len(runs), 4), squeeze=False, sharey=True)
    for ax, run in zip(axes[0], runs, strict=True):
        for scope in ("placed", "window", "whole"):
            at = [n for n, what in enumerate(run.scope) if what == scope]
            ax.plot(at, np.array(run.ms)[at], ".", markersize=2, label=scope)
        ax.set(title=run.name, xlabel="nodes", yscale="log")
        ax.legend()
    axes[0][0].set_ylabel("ms per node")
    drawn.tight_layout()
    drawn.savefig(path, dpi=120)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("names", nargs="*", default=NAMES)
    parser.add_argument("--every", type=int, default=100, help="0: no batch solutions")
    parser.add_argument("--most", type=int, help="nodes at most")
    parser.add_argument("--peer-python", default=os.environ.get("ODOMAP_PEER_PYTHON"))
    parser.add_argument("--figure", type=Path)
    options = parser.parse_args()
    folder = Path(os.environ.get("ODOMAP_DATA", "../shared/data")) / "graphs"
    runs = []
    for name in options.names:
        problem = read(folder / f"{name}.g2o.gz")
        replay(problem, 100, most=150)  # compiles
        runs.append(replay(problem, options.every, options.most))
        if options.peer_python:
            runs[-1].peer = peer(problem, options.peer_python, options.most)
    print(machine())
    print(table(runs))
    if options.figure:
        figure(runs, options.figure)
    return int(any(ratio > LARGEST_RATIO for run in runs for _, ratio in run.ratio))


if __name__ == "__main__":
    sys.exit(main())
