"""A walk ends beside its beginning: spread the gap along the path, or ask where it came from.

Run it with `python examples/12_spread_the_drift.py`; chapter 5 of docs/lesson explains it.
"""

from itertools import accumulate

import numpy as np

from odomap import PoseGraph, solve
from odomap.geometry.lie import se2_exp, se2_inverse, se2_log

# Ahead, a sharp corner, home on wide bends: steps of half a metre, each with a turn in radians.
TURN = np.radians(np.repeat([0, 90, -3.6, 0, -3.6], [40, 1, 75, 41, 25]))
TRUE = se2_exp(np.column_stack([0 * TURN + 0.5, 0 * TURN, TURN]))
# Wheels are good at going straight ahead and bad at turning: a tenth of each turn is noise.
SIGMA = np.column_stack([0 * TURN + 0.01, 0 * TURN + 0.005, 0.001 + 0.1 * abs(TURN)])


def walk(seed: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the measured steps, and the path by truth, odometry, and each correction."""
    steps = TRUE @ se2_exp(SIGMA * np.random.default_rng(seed).standard_normal(SIGMA.shape))
    truth, odometry = (np.array([*accumulate([np.eye(3), *s], np.matmul)]) for s in (TRUE, steps))
    paths = {"truth": truth, "odometry": odometry, "gap spread": odometry.copy()}
    T_start_end, n = truth[-1], len(steps)  # at the end the start is recognised, and how it lies
    share = np.linspace(0.0, 1.0, n + 1)[:, None]
    paths["gap spread"][:, :2, 2] += share * (T_start_end - odometry[-1])[:2, 2]
    correction = se2_log(T_start_end @ se2_inverse(odometry[-1]))
    paths["motion spread"] = se2_exp(share * correction) @ odometry
    first, second = np.append(np.arange(n), 0), np.append(np.arange(1, n + 1), n)
    alike = SIGMA * 0 + np.sqrt(np.mean(SIGMA**2, axis=0))
    for name, sigma in (("graph, all steps alike", alike), ("graph", SIGMA)):
        information = np.eye(3) / np.vstack([sigma, [0.02, 0.02, 0.005]])[:, None] ** 2
        measured = np.concatenate([steps, [T_start_end]])
        graph = PoseGraph("SE2", odometry, first, second, measured, information)
        paths[name] = solve(graph).Ts_world_node
    return steps, paths


def ate(path: np.ndarray, truth: np.ndarray) -> float:
    """Return the ATE in metres: a point of the plane is a complex number, a turn is a factor."""
    p, q = ((Ts - Ts.mean(axis=0))[:, :2, 2] @ [1.0, 1.0j] for Ts in (path, truth))
    turn = np.vdot(p, q) / abs(np.vdot(p, q))
    return float(np.sqrt(np.mean(abs(q - turn * p) ** 2)))


def main() -> dict[str, list[float]]:
    walks, results = [walk(seed) for seed in range(20)], {}
    print(f"{'':24}ATE of one walk   of 20 (median)   a step contradicted by")
    for name, path in list(walks[1][1].items())[1:]:
        errors = [ate(paths[name], paths["truth"]) for _, paths in walks]
        off = np.abs(se2_log(se2_inverse(path[:-1] @ walks[1][0]) @ path[1:]) / SIGMA).max()
        results[name] = [errors[1], float(np.median(errors)), float(off)]
        print("{:24}{:11.2f} m {:14.2f} m {:14.1f} sigma".format(name, *results[name]))
    return results


if __name__ == "__main__":
    main()
