"""The odometry of a LiDAR by hand: a loop over prepare, match and insert of three front-ends.

Run it with `python examples/45_three_front_ends.py`; docs/lesson/04_lidar_slam.md explains it.
"""

from dataclasses import replace

import numpy as np

import odomap
from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.lidar.lego import LegoFrontEnd
from odomap.lidar.loam import LoamFrontEnd
from odomap.lidar.planefrontend import PlaneFrontEnd
from odomap.lidar.sweeps import SweepPoints, points_of

TOWN = "sim:street?sensors=lidar3d&seed=5&beams=16&columns=900&frames=70"
DT, MIDDLE = 0.1, 0.05  # s: from sweep to sweep, from the stamp to its middle


def place(front_end, sweep, T_before: np.ndarray, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lay a sweep down where it should be, and again with the motion that this gives."""
    T = T_before @ se3_exp(DT * xi)
    for _ in range(2):
        T = front_end.match(sweep, T, xi).T_map_body
        xi = se3_log(se3_inverse(T_before) @ T) / DT
    return T, xi


def follow(front_end, sweeps: list[SweepPoints]) -> np.ndarray:
    """Return (N, 4, 4) poses at the middles of sweeps."""
    (first, *others), Ts, xi = map(front_end.prepare, sweeps), [np.eye(4)], np.zeros(6)
    for _ in range(3):  # only the second sweep tells how the body moved over the first
        front_end.clear()
        front_end.insert(first, Ts[0], xi)
        xi = place(front_end, others[0], Ts[0], xi)[1]
    for sweep in others:
        T, xi = place(front_end, sweep, Ts[-1], xi)
        front_end.insert(sweep, T, xi)
        Ts.append(T)
    return np.array(Ts)


def main() -> dict[str, float]:
    source, results = odomap.open(TOWN), {}
    Ts = source.world.path.at(DT * np.arange(len(source)) + MIDDLE).Ts_world_body
    truth = odomap.Trajectory(source.stamps_ns, Ts)
    sweeps = [points_of(frame.cloud, source.rig.lidars[0]) for frame in source]
    for how, share in (("deskewed", 1.0), ("as they came", 0.0)):
        timed = [replace(sweep, times=share * (sweep.times - MIDDLE)) for sweep in sweeps]
        for make in (PlaneFrontEnd, LoamFrontEnd, LegoFrontEnd):
            path = odomap.Trajectory(source.stamps_ns, follow(make(), timed))
            results[make.__name__, how] = e = odomap.ate(path, truth).rmse
            print(f"{make.__name__:13}, {how:12}: ATE {1000 * e:3.0f} mm")
    return results


if __name__ == "__main__":
    main()
