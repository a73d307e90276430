"""One camera forgets its unit on the way: a loop of poses, and a loop of similarities.

Run it with `python examples/26_scale_drift.py`; docs/lesson/03c_closing_loops.md explains it.
"""

from itertools import accumulate

import numpy as np

from odomap import PoseGraph, Trajectory, ate, solve
from odomap.geometry.alignransac import Alignment, PairSights, refine_alignment, solve_alignment
from odomap.geometry.lie import se3_exp

COUNT, SHRINKS, UNIT = 80, 0.996, 0.996**79  # keyframes; each step is measured 0.4 % shorter
SIGMA = np.array([0.01] * 3 + [0.002] * 3 + [0.01])  # of a step: units, radians, log scale


def walk() -> tuple[np.ndarray, np.ndarray]:
    """Return true poses on a ring of 50 m, and the steps that one camera measures."""
    step = se3_exp([0.0, 0.0, 0.63, 0.0, 2 * np.pi / COUNT, 0.0])  # a camera looks along z
    steps = step @ se3_exp(np.random.default_rng(0).normal(0, SIGMA[:6] / 2, (COUNT - 1, 6)))
    steps[:, :3, 3] *= SHRINKS ** np.arange(COUNT - 1)[:, None]
    return np.stack([np.linalg.matrix_power(step, k) for k in range(COUNT)]), steps


def look_back(T_first_last: np.ndarray) -> Alignment:
    """Measure how the last keyframe lies to the first, by points that both have mapped."""
    rng, sigma = np.random.default_rng(1), 3 / 450  # 3 px: what was mapped is off, too
    q = rng.uniform((-6, -3, 4), (6, 3, 15), (200, 3))
    p = UNIT * (q - T_first_last[:3, 3]) @ T_first_last[:3, :3]
    q[:80] = rng.permutation(q[:80])  # 80 pairs are wrong
    x, y = (rng.normal(z[:, :2] / z[:, 2:], sigma) for z in (p, q))
    p, q = (z * rng.normal(1.0, 0.02, (200, 1)) for z in (p, q))  # depth to 2 %
    pairs = PairSights(p, x, np.full(200, sigma**-2), q, y, np.full(200, sigma**-2))
    return refine_alignment(pairs, solve_alignment(pairs, True, seed=0), with_scale=True)


def main() -> dict[str, tuple[float, float, np.ndarray]]:
    (Ts, steps), stamps, results = walk(), np.arange(COUNT), {}
    path, seen = np.array([*accumulate(steps, np.matmul, initial=np.eye(4))]), look_back(Ts[-1])
    print(f"{seen.num_inliers} of 200 pairs agree; scale {seen.scale:.3f}, it is {1 / UNIT:.3f}")
    ends = [*stamps[:-1], 0], [*stamps[1:], COUNT - 1]
    for name, dim in (("no loop", 0), ("SE3", 6), ("Sim3", 7)):
        if dim:
            loop = seen.T_second_first * np.where(np.arange(4) < 3, [1, seen.scale][dim - 6], 1.0)
            sure = np.tile(np.diag(SIGMA[:dim] ** -2), (COUNT, 1, 1))
            graph = PoseGraph(name, path, *ends, np.append(steps, loop[None], axis=0), sure)
        closed = solve(graph).Ts_world_node if dim else path
        scale = np.cbrt(np.linalg.det(closed[:, :3, :3]))
        found = Trajectory(stamps, closed / np.where(np.arange(4) < 3, scale[:, None], 1)[:, None])
        error = ate(found, Trajectory(stamps, Ts), align="sim3")
        found = found.transformed(error.T_reference_estimate)
        results[name] = error.rmse, float(UNIT * scale[-1]), found.positions
        print(f"{name:7}: ATE {error.rmse:.2f} m, last unit {results[name][1]:.2f} of the first")
    return results


if __name__ == "__main__":
    main()
