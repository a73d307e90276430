"""Exact motions, put one after the other rightly and in three wrong ways.

Run it with `python examples/31_compose_motions.py`; docs/lesson/04_lidar_slam.md explains it.
"""

from collections.abc import Callable
from itertools import accumulate, pairwise

import numpy as np

import odomap
from odomap import SE2


def added(T: SE2, step: SE2) -> SE2:
    """Add numbers to numbers: x + dx, y + dy, heading + turn."""
    return SE2.from_parts(T.theta + step.theta, T.t + step.t)


WAYS: dict[str, Callable[[SE2, SE2], SE2]] = {
    "T_world_prev @ T_prev_cur": lambda T, step: T @ step,
    "added in the world frame": added,
    "T_prev_cur @ T_world_prev": lambda T, step: step @ T,
    "T_world_prev @ T_cur_prev": lambda T, step: T @ step.inverse(),
}


def drive() -> list[SE2]:
    """Return where a robot was, a pose each half second, as seen from the first."""
    truth = odomap.open("sim:hall?sensors=laser&seed=1").truth
    Ts = truth.Ts_world_body[::5]
    poses = [SE2.from_parts(np.arctan2(T[1, 0], T[0, 0]), T[:2, 3]) for T in Ts]
    return [poses[0].inverse() @ T for T in poses]


def chained(poses: list[SE2], way: Callable[[SE2, SE2], SE2]) -> np.ndarray:
    """Return (N, 2) positions from the motions between poses, put together in some way."""
    steps = (a.inverse() @ b for a, b in pairwise(poses))
    return np.array([T.t for T in accumulate(steps, way, initial=SE2.identity())])


def main() -> dict[str, float]:
    poses, results = drive(), {}
    truth = np.array([T.t for T in poses])
    length = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    print(f"{len(poses) - 1} exact motions along {length:.1f} m, once round a hall")
    for name, way in WAYS.items():
        path = chained(poses, way)
        results[name] = float(np.linalg.norm(path - truth, axis=1).max())
        gap = np.linalg.norm(path[-1] - path[0])
        print(
            f"{name:25}: at most {results[name]:5.2f} m off, ends {gap:5.2f} m from where it began"
        )
    return results


if __name__ == "__main__":
    main()
