"""How sure a path is, before and after a loop; and what is claimed against what is true.

Run it with `python examples/27_surer_after_a_loop.py`; chapter 3c of docs/lesson explains it.
"""

import numpy as np

from odomap import PoseGraph, covariances, solve
from odomap.geometry.lie import se2_exp, se2_inverse, se2_log

COUNT, TRIALS = 60, 100
STEP_SIGMA = np.array([0.03, 0.01, 0.01])  # of a step: ahead, sideways, heading
LOOP_SIGMA = np.array([0.02, 0.02, 0.005])


def ring(seed: int, loops: int) -> tuple[PoseGraph, np.ndarray]:
    """Return a walk on a ring of 60 m with so many copies of one loop, and the true poses."""
    rng, k = np.random.default_rng(seed), np.arange(COUNT)
    step = se2_exp([1.0, 0.0, 2 * np.pi / COUNT])
    Ts = np.stack([np.linalg.matrix_power(step, n) for n in k])
    i, j = np.append(k[:-1], 0), np.append(k[1:], COUNT - 1)
    sigma = np.vstack([np.tile(STEP_SIGMA, (COUNT - 1, 1)), LOOP_SIGMA])
    measured = se2_inverse(Ts[i]) @ Ts[j] @ se2_exp(rng.normal(0.0, sigma))
    edges = np.concatenate([k[:-1], np.full(loops, COUNT - 1)])
    information = np.eye(3) / sigma[:, None] ** 2
    unknown, held = np.full_like(Ts, np.nan), k == 0
    unknown[0] = np.eye(3)
    parts = (a[edges] for a in (i, j, measured, information))
    return PoseGraph("SE2", unknown, *parts, is_fixed=held), Ts


def main() -> dict[str, tuple[float, float]]:
    results = {}
    for name, loops in (("odometry", 0), ("one loop", 1), ("the same 20 times", 20)):
        off = np.zeros((TRIALS, COUNT, 3))
        for seed in range(TRIALS):
            graph, Ts = ring(seed, loops)
            found = solve(graph).graph
            off[seed] = se2_log(se2_inverse(Ts) @ found.Ts_world_node)
        claimed = covariances(found)[1:]
        last = off[:, -1]
        nees = np.einsum("ta,ab,tb->t", last, np.linalg.inv(claimed[-1]), last).mean() / 3
        sigma = np.sqrt(np.trace(claimed[:, :2, :2], axis1=1, axis2=2))
        results[name] = float(sigma[-1]), float(nees)
        shown = " ".join(f"{sigma[k]:.2f}" for k in (14, 29, 44, 58))
        print(f"{name:17}: sigma {shown} m at 1/4, 1/2, 3/4, the end; NEES {nees:4.1f}")
    return results


if __name__ == "__main__":
    main()
