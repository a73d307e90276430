"""odomap on one pose graph, in a process of its own: when was which cost reached?

    python graph_ours.py PROBLEM.npz OUT.npz [--repeats 3] [--core 1]

The same clock as for peers: from the arrays of the graph, before any initialisation or symbolic
work, to the end of each iteration, with every kernel compiled before. Then the
chordal cost of SE-Sync to its optimum, and the certificate of that optimum.
"""

import argparse
import time
from pathlib import Path
from typing import Any

from graph_peers import Run, pin, write  # isort: skip; first: sets the threads of what numpy brings

from graphs import Problem, load

from odomap.backend.descent import IterationRecord
from odomap.backend.graphs.certificate import certify
from odomap.backend.graphs.solve import solve


def timed(problem: Problem) -> Run:
    """Solve as anybody would, and note time and cost after every iteration."""
    graph = problem.graph()
    seconds: list[float] = []
    costs: list[float] = []

    def note(record: IterationRecord) -> None:
        seconds.append(time.process_time() - begin)
        costs.append(record.cost)

    begin = time.process_time()
    solution = solve(graph, progress=note)
    return Run(seconds, costs, solution.Ts_world_node)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("problem")
    parser.add_argument("out")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--core", type=int, default=-1, help="run on this one alone")
    options = parser.parse_args()
    pin(options.core)
    problem = load(options.problem)
    timed(problem)  # compiles
    runs = [timed(problem) for _ in range(options.repeats)]
    write(Path(options.out), {"odomap": runs}, {}, proven(problem, options.repeats))


def proven(problem: Problem, repeats: int) -> dict[str, Any]:
    """Solve for SE-Sync's cost and prove it; the smallest seconds over the repeats."""
    graph = problem.graph()
    solving, proving = [], []
    certify(solve(graph, cost="chordal").graph)  # compiles
    for _ in range(repeats):
        begin = time.process_time()
        solution = solve(graph, cost="chordal")
        solved = time.process_time()
        certificate = certify(solution.graph)
        proving.append(time.process_time() - solved)
        solving.append(solved - begin)
    return {
        "chordal_poses": solution.Ts_world_node.tolist(),
        "chordal_s": min(solving),
        "certificate_s": min(proving),
        "certified": certificate.certified,
        "why": certificate.reason,
        "smallest_eigenvalue": certificate.smallest_eigenvalue,
    }


if __name__ == "__main__":
    main()
