"""odomap on one bundle adjustment problem, in a process of its own: when was which cost reached?

    python bundle_ours.py PROBLEM.npz OUT.npz [--repeats 2] [--core 1]

The same clock as for the peer: from the arrays of the problem, before anything is analysed, to the
end of each iteration, with every kernel compiled before.
"""

import argparse
import time
from pathlib import Path

from graph_peers import Run, pin, write  # isort: skip; first: sets the threads of what numpy brings

import numpy as np
from bundles import Bundle, load, ring
from meter import peak_memory_mb

from odomap.backend.adjustment.adjust import adjust
from odomap.backend.descent import IterationRecord


def timed(bundle: Bundle) -> Run:
    """Solve as anybody would, and note time and cost after every iteration."""
    problem = bundle.adjustment()
    seconds: list[float] = []
    costs: list[float] = []

    def note(record: IterationRecord) -> None:
        seconds.append(time.process_time() - begin)
        costs.append(record.cost)

    begin = time.process_time()
    found = adjust(problem, progress=note).problem
    result = (found.Ts_camera_world, found.points_world, found.intrinsics)
    return Run(seconds, costs, np.concatenate([array.ravel() for array in result]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("problem")
    parser.add_argument("out")
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--core", type=int, default=-1, help="run on this one alone")
    options = parser.parse_args()
    pin(options.core)
    bundle = load(options.problem)
    timed(ring(60, 400))  # compiles
    built = peak_memory_mb()
    runs = [timed(bundle) for _ in range(options.repeats)]
    memory = {"built_memory_mb": built, "peak_memory_mb": peak_memory_mb()}
    write(Path(options.out), {"odomap": runs}, {}, memory)


if __name__ == "__main__":
    main()
