"""What closing loops in a large map takes of a frame's time, live (`loops.py`, part "live").

A circuit of 3,000 keyframes without images (as in the tests) comes back to its beginning. Between
two frames the closer reads the map (`add`) or corrects it (`write`): then a frame waits. Beside the
frames it solves: there what counts is how long Python's lock is held, which is the longest time
that another thread stands still.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from graph_stall import longest_gap

from odomap.files.vocabulary import Vocabulary
from odomap.kernels import needed_modules, warm_up
from odomap.system.background import QuickSwitching
from odomap.system.closing import LoopCloser, SideVerifier
from odomap.system.loopsearch import ClosingConfig, LoopSearch
from odomap.vision.matching import MatchConfig
from system.circuits import CAMERA, PIXELS, SCALE, Circuit, Walls, around

LONGEST_STALL_MS = 15.0
KEYFRAMES, STEP_M, OVERLAP = 3000, 0.8, 80
POINTS_PER_M = 30


@dataclass
class Stalls:
    """Milliseconds, keyframe after keyframe.

    Attributes:
        keyframes: in the map.
        read: of a keyframe without candidates.
        read_sides: of one with candidates.
        write: of a closure.
        gap: longest stand of another thread while a closure is solved.
        idle: the same while nothing is.
        solve: a closure from job to change, beside the frames.
    """

    keyframes: int = 0
    read: list[float] = field(default_factory=list)
    read_sides: list[float] = field(default_factory=list)
    write: list[float] = field(default_factory=list)
    gap: list[float] = field(default_factory=list)
    idle: list[float] = field(default_factory=list)
    solve: list[float] = field(default_factory=list)


def timed(call: Callable[[], object]) -> tuple[float, object]:
    """Return the milliseconds a call takes of this thread's processor time, and its result."""
    start = time.thread_time()
    result = call()
    return 1e3 * (time.thread_time() - start), result


def circuit_of(keyframes: int, overlap: int) -> Circuit:
    """Return a circuit that is back at its beginning `overlap` keyframes before its end."""
    radius = STEP_M * keyframes / (2 * np.pi)
    count = keyframes + overlap
    walls = Walls.make(count=int(POINTS_PER_M * STEP_M * keyframes), radius=radius)
    return Circuit(around(count, count / keyframes, radius), walls, noise=0.2)


def measured(closures: int, keyframes: int = KEYFRAMES) -> Stalls:
    """Close some loops at the end of a long circuit."""
    circuit, stalls = circuit_of(keyframes, OVERLAP), Stalls(keyframes)
    for _ in range(keyframes - 3):
        circuit.add()
    config = ClosingConfig(enabled=True)
    check = SideVerifier(CAMERA, np.eye(4), PIXELS, SCALE, False, MatchConfig())
    search = LoopSearch(Vocabulary.load(), config)
    closer = LoopCloser(circuit.map, search, check, False, config)
    for module in needed_modules():
        warm_up(module)
    switching = QuickSwitching()
    switching.hold()
    try:
        while len(stalls.write) < closures and circuit.count < len(circuit.true):
            _one(circuit, closer, stalls)
    finally:
        switching.release()
    return stalls


def _one(circuit: Circuit, closer: LoopCloser, stalls: Stalls) -> None:
    """Add a keyframe, and time what the closer makes of it."""
    keyframe = circuit.add()
    ms, job = timed(lambda: closer.add(keyframe))
    (stalls.read_sides if job.candidates else stalls.read).append(ms)
    solved, laps = [], []

    def solve() -> None:
        start = time.perf_counter()
        solved.append(job.solve())
        laps.append(1e3 * (time.perf_counter() - start))

    gap = 1e3 * longest_gap(solve)
    (change,) = solved
    ms, _ = timed(lambda: change.write(circuit.map))
    if change.closure is None:
        return
    stalls.write.append(ms)
    stalls.gap.append(gap)
    stalls.solve += laps
    stalls.idle.append(1e3 * longest_gap(lambda: time.sleep(1e-3 * laps[0])))


def show(stalls: Stalls) -> None:
    """Print what was measured, the median and the worst, and the best of what may be disturbed."""
    print(f"{stalls.keyframes} keyframes, {len(stalls.write)} closures, ms")
    for name in ("read", "read_sides", "write", "gap", "idle", "solve"):
        laps = getattr(stalls, name) or [float("nan")]
        low, middle, high = min(laps), float(np.median(laps)), max(laps)
        print(f"  {name:12}{low:9.2f} least{middle:9.2f} median{high:9.2f} most", flush=True)


def below_bars(stalls: Stalls) -> list[str]:
    """Return a sentence for every bar that even the best closure misses."""
    if not stalls.write:
        return ["no loop was closed"]
    # Where a loop is written the next keyframe is read, too; its candidates were read long before.
    waits = max(min(stalls.read_sides), min(stalls.write) + min(stalls.read))
    missed = []
    if not waits <= LONGEST_STALL_MS:
        missed.append(f"a frame waits {waits:.1f} ms for a closure, at most {LONGEST_STALL_MS:g}")
    # What a thread stands still for beside one that sleeps is the machine's, not the solver's.
    gap, idle = min(stalls.gap), min(stalls.idle)
    if not gap <= LONGEST_STALL_MS + idle:
        missed.append(
            f"solving stops others for {gap:.1f} ms, {idle:.1f} ms where nothing is solved"
        )
    return missed
