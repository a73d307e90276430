"""How long another Python thread stands still while a pose graph is solved.

One thread solves, another asks for the time in a loop; the longest gap between two answers is how
long it stood still: for the interpreter's lock, or because the machine gave its core away. To tell
the two apart the same is measured beside a thread that sleeps.
"""

import sys
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial

from graphs import Problem

from odomap.backend.graphs.solve import solve

LARGEST_STALL_S = 0.020


def longest_gap(work: Callable[[], object]) -> float:
    """Return the longest time, seconds, that this thread stood still while another did work."""
    done = threading.Event()
    failed: list[BaseException] = []

    def background() -> None:
        try:
            work()
        except BaseException as error:
            failed.append(error)
        done.set()

    thread = threading.Thread(target=background)
    longest, last = 0.0, time.perf_counter()
    thread.start()
    while not done.is_set():
        now = time.perf_counter()
        longest, last = max(longest, now - last), now
    thread.join()
    longest = max(longest, time.perf_counter() - last)
    if failed:
        raise failed[0]
    return longest


def show(problems: Sequence[Problem], repeats: int) -> int:
    """Print the gaps; return 1 where even the shortest longest one is over the bar.

    The smallest over the repeats: what another program takes of the machine differs from run to
    run, what our own solver takes does not.
    """
    sys.setswitchinterval(0.005)  # Python's default, said so that it is known
    missed = False
    print(f"longest stall of another thread, ms, of {repeats} runs")
    for problem in problems:
        graph = problem.graph()
        solve(graph)  # compiles
        begin = time.perf_counter()
        solve(graph)
        alone = time.perf_counter() - begin
        gaps = sorted(longest_gap(partial(solve, graph)) for _ in range(repeats))
        asleep = sorted(longest_gap(partial(time.sleep, alone)) for _ in range(repeats))
        for name, several in (("solving", gaps), ("sleeping", asleep)):
            listed = ", ".join(f"{1e3 * gap:.1f}" for gap in several)
            print(f"{problem.name:16}{name:10}{listed}")
        if gaps[0] > LARGEST_STALL_S:
            missed = True
            print(f"bar missed: {problem.name}: {1e3 * gaps[0]:.1f} ms, at most 20")
    return int(missed)
