"""NDT in NumPy: how well a sweep fits the cells of another, wherever it is put along the street.

Run it with `python examples/40_ndt.py`; docs/lesson/04_lidar_slam.md explains it.
"""

from collections import defaultdict

import numpy as np

import odomap
from odomap.geometry.lie import se3_inverse, se3_log
from odomap.lidar.deskew import deskew

Array = np.ndarray
TOWN = "sim:street?sensors=lidar3d&seed=5&beams=16&columns=900"
SHIFTS, AHEAD = np.linspace(-6.0, 6.0, 49), np.array([1.0, 0.0, 0.0])  # m


def seen_from(source: odomap.Source, k: int, at: int) -> Array:
    """Return the points of sweep k, by the true motion as they would be seen at sweep `at`."""
    Ts, cloud = source.truth.Ts_world_body, source.frame(k).cloud
    points = deskew(cloud.points, cloud.times, 10 * se3_log(se3_inverse(Ts[k]) @ Ts[k + 1]))
    T = se3_inverse(Ts[at]) @ Ts[k]
    return points @ T[:3, :3].T + T[:3, 3]


def distributions(points: Array, size: float) -> dict[tuple[int, ...], tuple[Array, Array]]:
    """Return the mean and the inverse covariance of the points in each cell."""
    cells, found = defaultdict(list), {}
    for p, key in zip(points, map(tuple, np.floor(points / size).astype(int).tolist())):
        cells[key].append(p)
    for key, inside in cells.items():
        if len(inside) >= 5:
            values, axes = np.linalg.eigh(np.cov(np.array(inside).T))
            values = np.maximum(values, 0.01 * values[2])  # a wall is not infinitely thin
            found[key] = np.mean(inside, axis=0), axes / values @ axes.T
    return found


def score(points: Array, cells: dict[tuple[int, ...], tuple[Array, Array]], size: float) -> float:
    """Return how well points fit the cells they lie in: 1 at most."""
    keys = map(tuple, np.floor(points / size).astype(int).tolist())
    off = [(p - cells[key][0], cells[key][1]) for p, key in zip(points, keys) if key in cells]
    return sum(np.exp(-0.5 * e @ inverse @ e) for e, inverse in off) / len(points)


def main() -> dict[float, Array]:
    source, results = odomap.open(TOWN), {}
    target, points = seen_from(source, 20, 20), seen_from(source, 24, 20)[::8]  # 3 m apart
    for size in (4.0, 2.0, 1.0):
        cells = distributions(target, size)
        results[size] = s = np.array([score(points + x * AHEAD, cells, size) for x in SHIFTS])
        best, wide = SHIFTS[s.argmax()], np.ptp(SHIFTS[s > (s.min() + s.max()) / 2])
        print(f"{len(cells):3} cells of {size:.0f} m: best at {best:.2f} m, a hill of {wide:.2f} m")
    return results


if __name__ == "__main__":
    main()
