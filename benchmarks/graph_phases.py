"""Where the time of solving a pose graph goes, phase by phase.

The functions that make up a solution are wrapped in clocks for the length of a run; a phase's
time is without the phases inside it, so that all of them and the rest add up to the whole.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from graphs import Problem

import odomap.backend.graphs.solve as solving
from odomap.backend.graphs.graphproblem import GraphProblem
from odomap.backend.sparse.blockcholesky import BlockCholesky

PHASES: tuple[tuple[object, str, str], ...] = (
    (solving, "node_factor", "ordering"),
    (solving, "find_components", "layout"),
    (GraphProblem, "__init__", "layout"),
    (BlockCholesky, "__init__", "symbolic"),
    (solving, "choose_start", "initialisation"),
    (GraphProblem, "linearise", "linearise"),
    (BlockCholesky, "factor", "numeric factor"),
    (BlockCholesky, "solve", "triangular solves"),
    (GraphProblem, "retract", "retract"),
)
"""Owner, its attribute, and the phase it belongs to."""

ORDER = (*dict.fromkeys(phase for _, _, phase in PHASES), "rest")


class Phases:
    """Seconds of each phase; what runs inside initialisation is counted there."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(ORDER, 0.0)
        self._inside: list[str] = []
        self._since = 0.0

    def wrap(self, function: Callable[..., Any], phase: str) -> Callable[..., Any]:
        """Return the function with its time counted as a phase."""

        def timed(*args: Any, **kwargs: Any) -> Any:
            with self.phase(phase):
                return function(*args, **kwargs)

        return timed

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Count the time until the end of the block as a phase."""
        self._settle()
        is_starting = "initialisation" in self._inside
        self._inside.append("initialisation" if is_starting else name)
        try:
            yield
        finally:
            self._settle()
            self._inside.pop()

    def _settle(self) -> None:
        now = time.perf_counter()
        if self._inside:
            self.seconds[self._inside[-1]] += now - self._since
        self._since = now


@contextmanager
def watched(phases: Phases) -> Iterator[None]:
    """Have the functions of `PHASES` timed for the length of the block."""
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in PHASES]
    for owner, name, phase in PHASES:
        setattr(owner, name, phases.wrap(getattr(owner, name), phase))
    try:
        yield
    finally:
        for owner, name, function in before:
            setattr(owner, name, function)


def measure(problem: Problem) -> tuple[dict[str, float], int]:
    """Return the seconds of each phase of one solution, and its iterations."""
    graph = problem.graph()
    phases = Phases()
    with watched(phases), phases.phase("rest"):
        solution = solving.solve(graph)
    return phases.seconds, solution.iterations


def show(problems: Sequence[Problem], repeats: int) -> int:
    """Print the phases of each problem, milliseconds, of the fastest of the runs."""
    columns = []
    for problem in problems:
        measure(problem)  # compiles
        runs = [measure(problem) for _ in range(repeats)]
        columns.append(min(runs, key=lambda run: sum(run[0].values())))
    print(f"{'milliseconds':24}" + "".join(f"{problem.name:>16}" for problem in problems))
    for phase in ORDER:
        print(f"{phase:24}" + "".join(f"{1e3 * seconds[phase]:16.1f}" for seconds, _ in columns))
    print(f"{'all':24}" + "".join(f"{1e3 * sum(s.values()):16.1f}" for s, _ in columns))
    print(f"{'iterations':24}" + "".join(f"{iterations:16}" for _, iterations in columns))
    return 0
