"""Ceres on one bundle adjustment problem, in a Python that has it: when was which cost reached?

    python bundle_peers.py PROBLEM.npz OUT.npz [--repeats 2] [--cap 300] [--core 1]

Ceres is reached through pyceres; the cost functions are C++ too, COLMAP's automatically
differentiated ones (pycolmap): its RADIAL model with the principal point held at zero is that of
BAL, once y and z point the other way. Each configuration is tried once and the fastest again.
Clocks count processor time and start after Ceres' preprocessor, whose seconds are noted beside;
building the problem is not in them.
Needs numpy, pyceres and pycolmap; odomap is not imported.
"""

import argparse
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from graph_peers import Run, pin, race, write  # isort: skip; first: sets the threads of numpy

import numpy as np
from meter import peak_memory_mb
from numpy.typing import NDArray

Array = NDArray[np.float64]
MOST_ITERATIONS = 100
MOST_DENSE = 400
"""Views up to which a dense reduced camera matrix is tried."""
FLIP = np.diag([1.0, -1.0, -1.0])
"""From BAL's camera (looks along -z, y up) to COLMAP's (along z, y down)."""

LARGE = (
    ("SPARSE_SCHUR", "SCHUR_JACOBI", "LEVENBERG_MARQUARDT"),
    ("ITERATIVE_SCHUR", "SCHUR_JACOBI", "LEVENBERG_MARQUARDT"),
)
SMALL = (
    ("DENSE_SCHUR", "SCHUR_JACOBI", "LEVENBERG_MARQUARDT"),
    ("DENSE_SCHUR", "SCHUR_JACOBI", "DOGLEG"),
    ("SPARSE_SCHUR", "SCHUR_JACOBI", "DOGLEG"),
    ("ITERATIVE_SCHUR", "JACOBI", "LEVENBERG_MARQUARDT"),
    *LARGE,
)
"""Linear solver, preconditioner of the iterative one, trust region.

What is tried with few views only either has no chance with many (a dense matrix) or was slower
throughout (the dogleg, the weaker preconditioner), and a run with many takes minutes.
"""


class Ceres:
    """A problem built for Ceres; its parameters are the arrays of this object."""

    def __init__(self, problem: Mapping[str, Array]) -> None:
        import pyceres
        import pycolmap

        self.start = parameters(problem)
        self.quaternions, self.shifts, self.points, self.lenses = (
            array.copy() for array in self.start
        )
        self.problem = pyceres.Problem()
        self.preprocessor_s = np.inf
        model = pycolmap.CameraModelId.RADIAL
        cost = pycolmap.cost_functions.ReprojErrorCost
        views = list(zip(self.quaternions, self.shifts, self.lenses, strict=True))
        points = list(self.points)
        pixels = problem["pixels"] * [1.0, -1.0]
        for k, m, pixel in zip(
            problem["view"].tolist(), problem["point"].tolist(), pixels, strict=True
        ):
            quaternion, shift, lens = views[k]
            self.problem.add_residual_block(
                cost(model, pixel), None, [quaternion, shift, points[m], lens]
            )
        for quaternion, _, lens in views:
            self.problem.set_manifold(quaternion, pyceres.EigenQuaternionManifold())
            self.problem.set_manifold(lens, pyceres.SubsetManifold(5, [1, 2]))

    def run(self, solver: str, preconditioner: str, strategy: str, cap: float) -> Run:
        """Solve from the start; poses of the run are those of `Run`, see `result`."""
        import pyceres

        now = (self.quaternions, self.shifts, self.points, self.lenses)
        for array, start in zip(now, self.start, strict=True):
            array[...] = start
        options = pyceres.SolverOptions()
        options.linear_solver_type = getattr(pyceres.LinearSolverType, solver)
        options.preconditioner_type = getattr(pyceres.PreconditionerType, preconditioner)
        options.trust_region_strategy_type = getattr(pyceres.TrustRegionStrategyType, strategy)
        options.num_threads = 1
        options.max_num_iterations = MOST_ITERATIONS
        options.max_solver_time_in_seconds = cap
        options.function_tolerance = 1e-8
        options.gradient_tolerance = options.parameter_tolerance = 0.0
        seconds: list[float] = []
        costs: list[float] = []

        class Note(pyceres.IterationCallback):  # type: ignore[misc]
            def __call__(self, summary):  # type: ignore[no-untyped-def]
                seconds.append(time.process_time() - begin)
                costs.append(summary.cost)
                return pyceres.CallbackReturnType.SOLVER_CONTINUE

        note = Note()
        options.callbacks = [note]
        summary = pyceres.SolverSummary()
        wall, begin = time.perf_counter(), time.process_time()
        pyceres.solve(options, self.problem, summary)
        share = (time.process_time() - begin) / (time.perf_counter() - wall)
        before = share * summary.preprocessor_time_in_seconds
        self.preprocessor_s = min(self.preprocessor_s, before)
        best = np.minimum.accumulate(costs).tolist()  # a refused step leaves the cost where it was
        return Run([s - before for s in seconds], best, self.result())

    def result(self) -> Array:
        """Return all that was found in one row: poses (K, 4, 4), points (M, 3), lenses (K, 3)."""
        poses = np.tile(np.eye(4), (len(self.shifts), 1, 1))
        poses[:, :3, :3] = FLIP @ rotations(self.quaternions)
        poses[:, :3, 3] = self.shifts @ FLIP
        lenses = self.lenses[:, [0, 3, 4]]
        return np.concatenate([poses.ravel(), self.points.ravel(), lenses.ravel()])


def parameters(problem: Mapping[str, Array]) -> tuple[Array, Array, Array, Array]:
    """Return quaternions xyzw, shifts, points and lenses (f cx cy k1 k2) as COLMAP has them."""
    poses = problem["poses"]
    lenses = np.zeros((len(poses), 5))
    lenses[:, [0, 3, 4]] = problem["intrinsics"]
    turned = np.array([quaternion(FLIP @ R) for R in poses[:, :3, :3]])
    return turned, poses[:, :3, 3] @ FLIP, problem["points"].copy(), lenses


def quaternion(R: Array) -> Array:
    """Return x y z w of a rotation: the eigenvector of a matrix that is linear in it."""
    K = np.empty((4, 4))
    K[:3, :3] = R + R.T - np.trace(R) * np.eye(3)
    K[3, :3] = K[:3, 3] = [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]
    K[3, 3] = np.trace(R)
    return np.linalg.eigh(K)[1][:, -1]


def rotations(quaternions: Array) -> Array:
    """Return the rotations (n, 3, 3) of quaternions x y z w (n, 4), of any length."""
    v, w = quaternions[:, :3], quaternions[:, 3]
    square = (quaternions**2).sum(axis=1)[:, None, None]
    hat = np.zeros((len(v), 3, 3))
    hat[:, [2, 0, 1], [1, 2, 0]] = v
    hat[:, [1, 2, 0], [2, 0, 1]] = -v
    outer = v[:, :, None] * v[:, None]
    size = (w * w - (v * v).sum(axis=1))[:, None, None]
    return (2 * outer + size * np.eye(3) + 2 * w[:, None, None] * hat) / square


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("problem")
    parser.add_argument("out")
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--cap", type=float, default=300.0, help="seconds of one run")
    parser.add_argument("--core", type=int, default=-1, help="run on this one alone")
    parser.add_argument("--only", help="the configuration whose name begins so")
    options = parser.parse_args()
    pin(options.core)
    with np.load(options.problem) as arrays:
        problem = dict(arrays)
    try:
        ceres = Ceres(problem)
    except ImportError as error:
        sys.exit(f"{sys.executable} has no Ceres: {error}")
    built = peak_memory_mb()
    runners: dict[str, Callable[[], Run]] = {
        " ".join(choice): partial(ceres.run, *choice, options.cap)
        for choice in (SMALL if len(problem["poses"]) <= MOST_DENSE else LARGE)
        if " ".join(choice).startswith(options.only or "")
    }
    runs, failed = race(runners, options.repeats, finalists=1)
    also = {
        "built_memory_mb": built,
        "peak_memory_mb": peak_memory_mb(),
        "preprocessor_s": ceres.preprocessor_s,
    }
    write(Path(options.out), runs, failed, also)


if __name__ == "__main__":
    main()
