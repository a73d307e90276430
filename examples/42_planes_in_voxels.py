"""A sweep laid onto planes of voxels, in NumPy, in a street full of cars that drive.

Run it with `python examples/42_planes_in_voxels.py`; docs/lesson/04_lidar_slam.md explains it.
"""

import numpy as np

import odomap
from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.lidar.deskew import deskew

Array = np.ndarray
TOWN = "sim:street?sensors=lidar3d&seed=1&beams=16&columns=900&moving_objects=60"
LAST, SIDE, SIGMA = 30, 1.0, 0.03  # sweep; of a voxel, m; least thickness, m


def seen_from_last(source: odomap.Source, k: int) -> Array:
    """Return the points of sweep k, by the true motion as they would be seen at the last one."""
    Ts, cloud = source.truth.Ts_world_body, source.frame(k).cloud
    points = deskew(cloud.points, cloud.times, 10 * se3_log(se3_inverse(Ts[k]) @ Ts[k + 1]))
    return points @ (T := se3_inverse(Ts[LAST]) @ Ts[k])[:3, :3].T + T[:3, 3]


def planes_of(points: Array) -> dict[tuple[int, ...], tuple[Array, Array]]:
    """Return the mean and n of the voxels whose points lie in a plane, |n| = 1 / its thickness."""
    keys, of = np.unique(np.floor(points / SIDE).astype(int), axis=0, return_inverse=True)
    parts, found = np.cumsum(np.bincount(of.ravel()))[:-1], {}
    for key, p in zip(keys.tolist(), np.split(points[np.argsort(of.ravel())], parts)):
        values, axes = np.linalg.eigh(np.cov(p.T) if len(p) > 5 else np.eye(3))
        if 3 * values[0] < values[1] > values[0] + 0.03 * values[2]:
            found[tuple(key)] = p.mean(axis=0), axes[:, 0] / np.sqrt(values[0] + SIGMA**2)
    return found


def step(planes: dict[tuple[int, ...], tuple[Array, Array]], p: Array, T: Array, k: float) -> Array:
    """Return the pose after a step of Gauss-Newton with the loss k r^2 / (k + r^2)."""
    keys = map(tuple, np.floor((p @ T[:3, :3].T + T[:3, 3]) / SIDE).astype(int).tolist())
    mean, n, p = map(np.array, zip(*((*planes[i], x) for i, x in zip(keys, p) if i in planes)))
    r, a = np.sum(n * (mean - p @ T[:3, :3].T - T[:3, 3]), axis=1), n @ T[:3, :3]
    J, w = np.column_stack([a, np.cross(p, a)]), (k / (k + r * r))[:, None] ** 2
    return T @ se3_exp(np.linalg.solve(J.T @ (w * J), J.T @ (w[:, 0] * r)))


def main() -> dict[str, list[float]]:
    source, results = odomap.open(TOWN), {"squares": [], "robust": []}
    *before, sweep = (seen_from_last(source, k) for k in range(LAST - 12, LAST + 1))
    planes = planes_of(np.concatenate(before))
    print(f"{sum(map(len, before))} points of 12 sweeps: {len(planes)} voxels with a plane")
    for (name, off), limits in zip(results.items(), (9 * [1e9], [100.0, 25.0, *7 * [9.0]])):
        T = se3_exp(np.array([0.4, -0.3, 0.1, 0.0, 0.0, 0.026]))  # the guess; the truth is 1
        for k in limits:
            off.append(1000 * np.linalg.norm(T[:3, 3]))
            T = step(planes, sweep[::3], T, k)
        print(f"{name:7}", *(f"{mm:4.0f}" for mm in off), "mm off")
    return results


if __name__ == "__main__":
    main()
