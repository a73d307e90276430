"""Pose graphs as all solvers get them, and the one judge of what they return.

A problem is a graph with a start for every pose: that of the file, or, where a file has edges
only, poses chained along a breadth-first spanning tree from the first node. It travels to the
processes of the solvers as .npz; a peer's process needs numpy to read it and no odomap.
"""

from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.posegraph import PoseGraph
from odomap.files.g2o import read_g2o
from odomap.geometry.lie import se2_inverse, se2_log, se3_inverse, se3_log

Array = NDArray[np.float64]

CERTIFIED = {
    "manhattan": 6432.0,
    "city10000": 638.6,
    "CSAIL": 31.70,
    "intel": 52.35,
    "sphere2500": 1687.0,
    "torus3D": 24230.0,
    "parking-garage": 1.263,
}
"""Optima of the chordal cost, proved global by SE-Sync (IJRR 2019), to the digits printed there."""


@dataclass(frozen=True)
class Problem:
    """A pose graph and where to start.

    Attributes:
        name: of the graph.
        poses: (N, m, m) start, m = 3 in the plane and 4 in space.
        first, second: (E,) nodes of each edge.
        measured: (E, m, m) T_first_second.
        information: (E, k, k), tangent (translation, rotation).
    """

    name: str
    poses: Array
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    measured: Array
    information: Array

    @property
    def is_planar(self) -> bool:
        """Whether poses are in SE(2)."""
        return self.poses.shape[1] == 3

    def save(self, path: Path) -> None:
        """Write it for the solvers' processes."""
        np.savez(
            path,
            poses=self.poses,
            first=self.first,
            second=self.second,
            measured=self.measured,
            information=self.information,
        )

    def graph(self) -> PoseGraph:
        """Return it as odomap's type, at the start."""
        group = "SE2" if self.is_planar else "SE3"
        return PoseGraph(
            group, self.poses, self.first, self.second, self.measured, self.information
        )


def load(path: str | Path) -> Problem:
    """Read what `Problem.save` wrote."""
    with np.load(path) as arrays:
        return Problem(Path(path).stem, **arrays)


def read(path: Path) -> Problem:
    """Read a g2o file, and chain poses where it has none."""
    graph = read_g2o(path)
    name = path.name.split(".")[0].removesuffix("_vertex3")
    poses = graph.Ts_world_node
    if np.isnan(poses).any():
        poses = chained(graph.num_nodes, graph.first, graph.second, graph.Ts_first_second)
    return Problem(name, poses, graph.first, graph.second, graph.Ts_first_second, graph.information)


def chained(
    nodes: int, first: NDArray[np.int64], second: NDArray[np.int64], measured: Array
) -> Array:
    """Return poses (N, m, m) chained along a breadth-first tree from the first node."""
    ties: list[list[tuple[int, int]]] = [[] for _ in range(nodes)]
    for edge, (i, j) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
        ties[i].append((j, edge))
        ties[j].append((i, edge))
    inverse = se2_inverse if measured.shape[1] == 3 else se3_inverse
    backwards = inverse(measured)
    poses = np.full((nodes, *measured.shape[1:]), np.nan)
    poses[0] = np.eye(measured.shape[1])
    queue = deque([0])
    while queue:
        i = queue.popleft()
        for j, edge in ties[i]:
            if np.isnan(poses[j, 0, 0]):
                poses[j] = poses[i] @ (measured if first[edge] == i else backwards)[edge]
                queue.append(j)
    return poses


def geodesic_cost(problem: Problem, poses: Array) -> float:
    """Return ½ Σ rᵀ Ω r with r = log(Z⁻¹ T_i⁻¹ T_j): what odomap minimises unless told otherwise.

    Every solver's poses go through this function, whatever it minimised itself.
    """
    inverse, log = (se2_inverse, se2_log) if problem.is_planar else (se3_inverse, se3_log)
    found = inverse(poses[problem.first]) @ poses[problem.second]
    r = log(inverse(problem.measured) @ found)
    return 0.5 * float(np.einsum("ei,eij,ej->", r, problem.information, r))


def chordal_cost(problem: Problem, poses: Array) -> float:
    """Return Σ κ‖R_j - R_i R_ij‖² + τ‖t_j - t_i - R_i t_ij‖², the cost of SE-Sync's optima."""
    d = poses.shape[1] - 1
    shifting, turning = problem.information[:, :d, :d], problem.information[:, d:, d:]
    tau = d / np.trace(np.linalg.inv(shifting), axis1=1, axis2=2)
    kappa = (1.0 if d == 2 else 1.5) / np.trace(np.linalg.inv(turning), axis1=1, axis2=2)
    Ri, Rj = poses[problem.first, :d, :d], poses[problem.second, :d, :d]
    ti, tj = poses[problem.first, :d, d], poses[problem.second, :d, d]
    turn = Rj - Ri @ problem.measured[:, :d, :d]
    shift = tj - ti - np.einsum("eij,ej->ei", Ri, problem.measured[:, :d, d])
    squares = kappa * (turn**2).sum(axis=(1, 2)) + tau * (shift**2).sum(axis=1)
    return float(squares.sum())
