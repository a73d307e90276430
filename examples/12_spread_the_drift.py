"""A walk ends beside its beginning: spread the gap along the path, or ask where it came from.

Run it with `python examples/12_spread_the_drift.py`; chapter 5 of docs/lesson explains it.
"""

from itertools import accumulate, pairwise

import numpy as np

from odomap import PoseGraph, solve
from odomap.geometry.lie import se2_exp, se2_inverse, se2_log

# Ahead, a sharp corner, home on wide bends: steps of half a metre, each with a turn in radians.
TURN = np.radians(np.repeat([0, 90, -3.6, 0, -3.6], [40, 1, 75, 41, 25]))
TRUE = se2_exp(np.column_stack([0 * TURN + 0.5, 0 * TURN, TURN]))
# Wheels are good at going straight ahead and bad at turning: a tenth of each turn is noise.
SIGMA = np.column_stack([0 * TURN + 0.01, 0 * TURN + 0.005, 0.001 + 0.1 * abs(TURN)])
SIGMA_LOOP = [0.02, 0.02, 0.005]


def walk(seed: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the measured steps, and the path by truth, odometry, and each correction."""
    rng = np.random.default_rng(seed)
    steps = TRUE @ se2_exp(rng.normal(0.0, SIGMA))
    truth, odometry = (np.array([*accumulate([np.eye(3), *s], np.matmul)]) for s in (TRUE, steps))
    paths = {"truth": truth, "odometry": odometry, "gap spread": odometry.copy()}
    T_start_end = truth[-1] @ se2_exp(rng.normal(0.0, SIGMA_LOOP))  # recognised at the end
    share = np.linspace(0.0, 1.0, len(truth))[:, None]
    paths["gap spread"][:, :2, 2] += share * (T_start_end - odometry[-1])[:2, 2]
    correction = se2_log(T_start_end @ se2_inverse(odometry[-1]))
    paths["motion spread"] = se2_exp(share * correction) @ odometry
    ends = np.array([*pairwise(range(len(truth))), (0, len(truth) - 1)]).T
    alike = SIGMA * 0 + np.sqrt(np.mean(SIGMA**2, axis=0))
    for name, sigma in (("graph, all steps alike", alike), ("graph", SIGMA)):
        information = np.eye(3) / np.vstack([sigma, SIGMA_LOOP])[:, None] ** 2
        graph = PoseGraph("SE2", odometry, *ends, np.append(steps, [T_start_end], 0), information)
        paths[name] = solve(graph).Ts_world_node
    return steps, paths


def ate(path: np.ndarray, truth: np.ndarray) -> float:
    """Return the ATE in metres: a point of the plane is a complex number, a turn is a factor."""
    p, q = ((Ts - Ts.mean(axis=0))[:, :2, 2] @ [1.0, 1.0j] for Ts in (path, truth))
    return float(np.sqrt(np.mean(abs(q - np.exp(1j * np.angle(np.vdot(p, q))) * p) ** 2)))


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
