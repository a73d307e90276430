"""GTSAM or g2o on one pose graph, in a Python that has it: when was which cost reached?

    python graph_peers.py gtsam|g2opy PROBLEM.npz OUT.npz [--repeats 3] [--cap 20] [--core 1]

A peer is as fast as its fastest configuration. So each is tried once, from the start given and
from the peer's own initialisation, and the fastest are run again. Clocks count processor time of
all threads, since on one core that is what the wall clock says once nothing else runs there; they
start before the initialisation, orderings and symbolic work included, building the peer's graph and
reading its result excluded. Costs are what the peer minimises (½ Σ rᵀ Ω r with its own r), noted
after every iteration. Needs numpy and the peer; odomap is not imported.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "TBB_NUM_THREADS")
for _name in THREADS:  # before numpy reads them
    os.environ[_name] = "1"

import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

Array = NDArray[np.float64]
CLOSE = 1e-4
"""How near to the final cost counts as there."""
CONVERGED = 1e-10
MOST_ITERATIONS = 60
FINALISTS = 3


@dataclass(frozen=True)
class Run:
    """Processor seconds and cost after every iteration, first those of the start; the poses."""

    seconds: list[float]
    costs: list[float]
    poses: Array


def pin(core: int) -> None:
    """Keep this process on one core, where the system lets it."""
    if core >= 0 and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})


def reached(run: Run, final: float) -> float:
    """Return the seconds after which the cost stays within 1e-4 of a final one; inf if never."""
    there = np.asarray(run.costs) <= final * (1 + CLOSE)
    if not there[-1]:
        return float("inf")
    away = np.flatnonzero(~there)
    return run.seconds[away[-1] + 1 if len(away) else 0]


def race(
    runners: Mapping[str, Callable[[], Run]], repeats: int, finalists: int = FINALISTS
) -> tuple[dict[str, list[Run]], dict[str, str]]:
    """Run each once and the fastest again; return runs of each, and why others failed."""
    runs: dict[str, list[Run]] = {}
    failed: dict[str, str] = {}
    for name, runner in runners.items():
        try:
            run = runner()
        except RuntimeError as error:  # what both peers raise on a singular system
            failed[name] = (str(error).strip() or type(error).__name__).splitlines()[0]
            continue
        if np.isfinite(run.costs[-1]):
            runs[name] = [run]
        else:
            failed[name] = "diverged"
    if not runs:
        return runs, failed
    final = min(min(run[0].costs) for run in runs.values())
    fastest = sorted(runs, key=lambda name: reached(runs[name][0], final))[:finalists]
    for _ in range(repeats - 1):
        for name in fastest:
            runs[name].append(runners[name]())
    return runs, failed


def gtsam_runners(problem: Mapping[str, Array], cap: float) -> dict[str, Callable[[], Run]]:
    """Return GTSAM's configurations: method, ordering, elimination, and where they start."""
    import gtsam

    planar = problem["poses"].shape[1] == 3
    graph, diagonal = _gtsam_graph(gtsam, problem)
    given = gtsam.Values()
    for i, T in enumerate(problem["poses"]):
        given.insert(i, _gtsam_pose(gtsam, T))
    starts: dict[str, Callable[[], object]] = {"given": lambda: given}
    if planar:
        starts["lago"] = lambda: gtsam.lago.initialize(diagonal, False)
    else:
        starts["chordal"] = lambda: gtsam.InitializePose3.initialize(graph)
    methods = {
        "LM": (gtsam.LevenbergMarquardtOptimizer, gtsam.LevenbergMarquardtParams),
        "GN": (gtsam.GaussNewtonOptimizer, gtsam.GaussNewtonParams),
        "dogleg": (gtsam.DoglegOptimizer, gtsam.DoglegParams),
    }

    def run(start: str, method: str, ordering: str, solver: str) -> Run:
        optimizer, parameters = methods[method]
        options = parameters()
        options.setOrderingType(ordering)
        options.setLinearSolverType(solver)
        begin = time.process_time()
        solving = optimizer(graph, starts[start](), options)
        seconds, costs = [time.process_time() - begin], [solving.error()]
        while len(costs) <= MOST_ITERATIONS and seconds[-1] < cap:
            solving.iterate()
            seconds.append(time.process_time() - begin)
            costs.append(solving.error())
            if not abs(costs[-2] - costs[-1]) > CONVERGED * costs[-1]:
                break
        return Run(seconds, costs, _gtsam_poses(gtsam, solving.values(), planar))

    eliminations = [(m, o, "MULTIFRONTAL_CHOLESKY") for m in methods for o in ("COLAMD", "METIS")]
    eliminations += [(method, "METIS", "MULTIFRONTAL_SOLVER") for method in ("LM", "GN")]
    return {
        " ".join((*elimination, "from", start)): partial(run, start, *elimination)
        for start in starts
        for elimination in eliminations
    }


def _gtsam_pose(gtsam, T):  # type: ignore[no-untyped-def]
    if len(T) == 4:
        return gtsam.Pose3(T)
    return gtsam.Pose2(T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0]))


def _gtsam_graph(gtsam, problem):  # type: ignore[no-untyped-def]
    """Return the graph with its first pose tied down, and one whose noise is diagonal for LAGO."""
    planar = problem["poses"].shape[1] == 3
    between = gtsam.BetweenFactorPose2 if planar else gtsam.BetweenFactorPose3
    prior = gtsam.PriorFactorPose2 if planar else gtsam.PriorFactorPose3
    order = [0, 1, 2] if planar else [3, 4, 5, 0, 1, 2]  # GTSAM's tangent of Pose3: rotation first
    graph, diagonal = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
    for i, j, T, information in zip(
        problem["first"].tolist(),
        problem["second"].tolist(),
        problem["measured"],
        problem["information"],
        strict=True,
    ):
        pose = _gtsam_pose(gtsam, T)
        full = np.ascontiguousarray(information[np.ix_(order, order)])
        graph.add(between(i, j, pose, gtsam.noiseModel.Gaussian.Information(full)))
        if planar:
            noise = gtsam.noiseModel.Diagonal.Precisions(np.diag(full).copy())
            diagonal.add(between(i, j, pose, noise))
    tie = gtsam.noiseModel.Isotropic.Sigma(len(order), 1e-3)
    for each in (graph, diagonal):
        each.add(prior(0, _gtsam_pose(gtsam, problem["poses"][0]), tie))
    return graph, diagonal


def _gtsam_poses(gtsam, values, planar: bool) -> Array:  # type: ignore[no-untyped-def]
    if planar:
        return _planar_poses(gtsam.utilities.extractPose2(values))
    flat = gtsam.utilities.extractPose3(values)
    poses = np.tile(np.eye(4), (len(flat), 1, 1))
    poses[:, :3, :3] = flat[:, :9].reshape(-1, 3, 3)
    poses[:, :3, 3] = flat[:, 9:]
    return poses


def _planar_poses(xyt: Array) -> Array:
    poses = np.tile(np.eye(3), (len(xyt), 1, 1))
    c, s = np.cos(xyt[:, 2]), np.sin(xyt[:, 2])
    poses[:, 0, 0] = poses[:, 1, 1] = c
    poses[:, 1, 0], poses[:, 0, 1] = s, -s
    poses[:, :2, 2] = xyt[:, :2]
    return poses


def g2o_runners(problem: Mapping[str, Array], cap: float) -> dict[str, Callable[[], Run]]:
    """Return g2o's configurations: method, and whether it makes its own start (along a tree).

    The wheel has one sparse solver, Eigen's. Times of iterations are those g2o takes itself, of the
    wall clock, times the share of it that this process had.
    """
    import g2opy

    planar = problem["poses"].shape[1] == 3
    with tempfile.NamedTemporaryFile("w", suffix=".g2o", delete=False) as file:
        file.writelines(_g2o_lines(problem))
    kind = "SE2" if planar else "SE3"

    def attempt(method: str, own_start: bool, iterations: int) -> Run:
        solver = getattr(g2opy, f"LinearSolverEigen{kind}")()
        algorithm = getattr(g2opy, f"OptimizationAlgorithm{method}")
        optimizer = g2opy.SparseOptimizer()
        optimizer.set_algorithm(algorithm(getattr(g2opy, f"BlockSolver{kind}")(solver)))
        if not optimizer.load(file.name):
            raise RuntimeError("g2o cannot read the problem")
        optimizer.vertex(0).set_fixed(True)
        optimizer.set_compute_batch_statistics(True)
        begin = time.process_time()
        optimizer.initialize_optimization()
        if own_start:
            optimizer.compute_initial_guess()
        before = time.process_time() - begin
        optimizer.compute_active_errors()
        start = optimizer.active_chi2()
        wall, processor = time.perf_counter(), time.process_time()
        made = optimizer.optimize(iterations)
        share = (time.process_time() - processor) / (time.perf_counter() - wall)
        laps = optimizer.batch_statistics()[:made]
        seconds = before + share * np.cumsum([0.0] + [lap.time_iteration for lap in laps])
        costs = [0.5 * start, *(0.5 * lap.chi2 for lap in laps)]
        return Run(seconds.tolist(), costs, _g2o_poses(optimizer, len(problem["poses"]), planar))

    def run(method: str, own_start: bool) -> Run:
        """Run as many iterations as the cap allows: g2o cannot be asked between two of them."""
        each = attempt(method, own_start, 1).seconds[-1]
        for most in (10, MOST_ITERATIONS):
            iterations = int(np.clip(cap / each, 1, most))
            made = attempt(method, own_start, iterations)
            if iterations < most or abs(made.costs[-2] - made.costs[-1]) <= 1e-7 * made.costs[-1]:
                break
        return made

    return {
        f"{short} Eigen from {'tree' if own_start else 'given'}": partial(run, method, own_start)
        for own_start in (False, True)
        for short, method in (("GN", "GaussNewton"), ("LM", "Levenberg"), ("dogleg", "Dogleg"))
    }


def _g2o_lines(problem: Mapping[str, Array]):  # type: ignore[no-untyped-def]
    """Yield the problem as g2o text.

    g2o's error of a rotation is the vector of its quaternion, half of the angle: information of
    rotations is given as four times as much, so that small errors weigh what they weigh here.
    """
    planar = problem["poses"].shape[1] == 3
    tag, scale = ("SE2", np.ones(3)) if planar else ("SE3:QUAT", np.repeat([1.0, 2.0], 3))
    upper = np.triu_indices(len(scale))

    def text(values: Array) -> str:
        return " ".join(repr(float(v)) for v in values)

    for i, T in enumerate(problem["poses"]):
        yield f"VERTEX_{tag} {i} {text(_g2o_numbers(T))}\n"
    for i, j, T, information in zip(
        problem["first"],
        problem["second"],
        problem["measured"],
        problem["information"],
        strict=True,
    ):
        weights = (information * np.outer(scale, scale))[upper]
        yield f"EDGE_{tag} {i} {j} {text(_g2o_numbers(T))} {text(weights)}\n"


def _g2o_numbers(T: Array) -> Array:
    """Return x y θ, or x y z and the quaternion, vector first."""
    if len(T) == 3:
        return np.array([T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0])])
    R = T[:3, :3]
    skew = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    K = np.empty((4, 4))
    K[:3, :3] = R + R.T - np.trace(R) * np.eye(3)
    K[3, :3] = K[:3, 3] = skew
    K[3, 3] = np.trace(R)
    q = np.linalg.eigh(K)[1][:, -1]
    return np.concatenate([T[:3, 3], q])


def _g2o_poses(optimizer, count: int, planar: bool) -> Array:  # type: ignore[no-untyped-def]
    estimates = [optimizer.vertex(i).estimate() for i in range(count)]
    if planar:
        return _planar_poses(np.array([e.to_vector() for e in estimates]))
    return np.array([e.matrix() for e in estimates])


PEERS = {"gtsam": gtsam_runners, "g2opy": g2o_runners}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("peer", choices=PEERS)
    parser.add_argument("problem")
    parser.add_argument("out")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--cap", type=float, default=20.0, help="seconds of one run")
    parser.add_argument("--core", type=int, default=-1, help="run on this one alone")
    parser.add_argument("--only", default="", help="configurations whose names begin so")
    options = parser.parse_args()
    pin(options.core)
    with np.load(options.problem) as arrays:
        problem = dict(arrays)
    try:
        runners = PEERS[options.peer](problem, options.cap)
    except ImportError as error:
        sys.exit(f"{sys.executable} has no {options.peer}: {error}")
    chosen = {name: run for name, run in runners.items() if name.startswith(options.only)}
    runs, failed = race(chosen, options.repeats)
    write(Path(options.out), runs, failed)


def write(
    path: Path,
    runs: Mapping[str, list[Run]],
    failed: Mapping[str, str],
    also: Mapping[str, float] | None = None,
) -> None:
    """Write all runs: their clocks and costs as JSON text, the poses of each first run."""
    clocks = {
        name: [{"seconds": run.seconds, "costs": run.costs} for run in several]
        for name, several in runs.items()
    }
    about = json.dumps({"runs": clocks, "failed": dict(failed), "also": dict(also or {})})
    poses = {f"poses_{n}": several[0].poses for n, several in enumerate(runs.values())}
    np.savez(path, about=np.array(about), **poses)


if __name__ == "__main__":
    main()
