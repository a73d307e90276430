"""Edges made of what pairs of poses saw: how sure they are, and what is lost or counted twice.

Run it with `python examples/17_where_edges_come_from.py`; chapter 5 of docs/lesson explains it.
"""

import numpy as np

from odomap import PoseGraph, Sights, covariances, solve
from odomap.geometry.lie import se2_exp, se2_inverse, se2_log

POSES, POINTS, SIGMA_M, RANGE_M = 12, 60, 0.05, 3.5
TRUTH = se2_exp(np.arange(POSES)[:, None] * [0.5, 0.0, 0.05])


def edge(seen_i: np.ndarray, seen_j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return T_i_j from points (K, 2) that both poses saw, and its information."""
    a, b = (points @ [1.0, 1.0j] for points in (seen_i, seen_j))
    turn = np.exp(1j * np.angle(np.vdot(b - b.mean(), a - a.mean())))
    t = a.mean() - turn * b.mean()
    T_i_j = np.array([[turn.real, -turn.imag, t.real], [turn.imag, turn.real, t.imag], [0, 0, 1]])
    J = np.tile(np.eye(2, 3), (len(b), 1, 1))  # of R^-1 (T_i_j exp(xi) p_j - p_i): [I, p_j turned]
    J[:, :, 2] = np.stack([-seen_j[:, 1], seen_j[:, 0]], axis=1)
    return T_i_j, np.einsum("kba,kbc->ac", J, J) / (2.0 * SIGMA_M**2)  # both ends have noise


def graphs(seed: int) -> dict[str, PoseGraph]:
    """Return three graphs of the same sightings; edges of the last one say next to nothing."""
    points = np.random.default_rng(0).uniform((0.0, -1.5), (5.5, 3.0), (POINTS, 2))
    exact = np.array([points @ T[:2, :2].T + T[:2, 2] for T in se2_inverse(TRUTH)])
    is_seen = np.linalg.norm(exact, axis=2) < RANGE_M
    seen = np.random.default_rng(seed).normal(exact, SIGMA_M)
    i, j = np.triu_indices(POSES, 1)
    made = [edge(seen[a, k], seen[b, k]) for a, b, k in zip(i, j, is_seen[i] & is_seen[j])]
    Ts, information = (np.array(part) for part in zip(*made))
    edges = PoseGraph("SE2", TRUTH, i, j, Ts, information)
    node, point = np.nonzero(is_seen)
    certain = np.tile(np.eye(2) / SIGMA_M**2, (len(node), 1, 1))
    sights = Sights(points, np.arange(POINTS), node, point, seen[node, point], certain)
    bundle = PoseGraph("SE2", TRUTH, i, j, Ts, 1e-9 * information, points=sights)
    return {"edges, next": edges.without(j - i > 1), "edges, all": edges, "sightings": bundle}


def main() -> dict[str, float]:
    worlds, results = [graphs(seed) for seed in range(60)], {}
    print(f"{'made of':17}last pose off by    claimed    squared error over its claim")
    for name, graph in worlds[0].items():
        solved = [solve(world[name], initial="given") for world in worlds]
        P = np.array([covariances(found, [POSES - 1])[0] for found in solved])
        e = se2_log(se2_inverse(TRUTH[-1]) @ [found.Ts_world_node[-1] for found in solved])
        off, claimed = np.sum(e[:, :2] ** 2, axis=1), np.trace(P[:, :2, :2], axis1=1, axis2=2)
        results[name] = float(np.mean(e[:, None] @ np.linalg.solve(P, e[:, :, None]) / 3.0))
        rms = "".join(f"{1000 * np.mean(square) ** 0.5:12.0f} mm" for square in (off, claimed))
        print(f"{len(graph.points.node) or graph.num_edges:4} {name:12}{rms} {results[name]:12.2f}")
    return results


if __name__ == "__main__":
    main()
