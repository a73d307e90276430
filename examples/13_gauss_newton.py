"""Gauss-Newton on a pose graph in NumPy, and what it does with a line of it forgotten.

Run it with `python examples/13_gauss_newton.py`; chapter 5 of docs/lesson explains it.
"""

from itertools import accumulate

import numpy as np

from odomap import PoseGraph, solve
from odomap.geometry import lie


def two_rounds(seed: int) -> PoseGraph:
    """Return a graph of two rounds on a circle, each place of the second known from the first."""
    k, per = np.arange(60), 30
    first, second = np.append(k[:-1], k[:-per:5]), np.append(k[1:], k[per::5])
    true = lie.se2_exp((second - first)[:, None] * [np.pi / 4, 0.0, 2 * np.pi / per])
    sigma = np.where((second - first == 1)[:, None], [0.05, 0.05, 0.1], [0.1, 0.1, 0.5])
    steps = true @ lie.se2_exp(np.random.default_rng(seed).normal(0.0, sigma))
    odometry = [*accumulate([np.eye(3), *steps[:59]], np.matmul)]
    return PoseGraph("SE2", odometry, first, second, steps, np.eye(3) / sigma[:, None] ** 2)


def gauss_newton(graph: PoseGraph, forget: str = "") -> tuple[list[float], np.ndarray]:
    """Return the cost before each of 15 steps, and the Jacobian of the last."""
    Ts, i, j, Z = graph.Ts_world_node.copy(), graph.first, graph.second, graph.Ts_first_second
    root, costs = np.sqrt(graph.information), []  # it is diagonal here
    for _ in range(15):
        D = lie.se2_inverse(Ts[i]) @ Ts[j]
        r = lie.se2_log(lie.se2_inverse(Z) @ D)
        if forget == "wrap":
            r[:, 2] = np.diff(lie.so2_log(Ts[[i, j], :2, :2]), axis=0) - lie.so2_log(Z[:, :2, :2])
        J_j = np.eye(3) if forget == "J_r" else lie.se2_right_jacobian_inverse(r)
        J_i = -J_j @ (np.eye(3) if forget == "adjoint" else lie.se2_adjoint(lie.se2_inverse(D)))
        J, edge = np.zeros((len(r), 3, len(Ts), 3)), np.arange(len(r))
        J[edge, :, i], J[edge, :, j] = root @ J_i, root @ J_j  # unit: standard deviations
        J, r = J.reshape(r.size, -1), (root @ r[:, :, None]).ravel()
        J = J[:, 0 if forget == "gauge" else 3 :]  # the first pose is held
        costs.append(0.5 * float(r @ r))
        step = np.linalg.solve(J.T @ J, -J.T @ r).reshape(-1, 3)
        Ts[-len(step) :] = Ts[-len(step) :] @ lie.se2_exp(step)
    return costs, J


def main() -> dict[str, float]:
    graph, results = two_rounds(0), {}
    print(f"odomap           : {solve(graph).cost_after:.4f}")
    for forget in ("", "wrap", "adjoint", "J_r", "gauge"):
        costs, J = gauss_newton(graph, forget)
        results[forget], values = costs[-1], np.linalg.eigvalsh(J.T @ J)
        end = f"{costs[-1]:.4f}, {np.sum(values < 1e-9 * values[-1])} directions are free"
        end = end if costs[-1] < costs[0] else "worse than at the start"
        print(f"without {forget or 'a mistake':9}: {end}")
    return results


if __name__ == "__main__":
    main()
