"""A map that fits is adjusted once more, window by window: what holds a window in its place?

Run it with `python examples/22_fixed_keyframes.py`; docs/lesson/03_orb_slam.md explains it.
"""

import numpy as np

from odomap import SE3, Camera
from odomap.backend.bundle import Bundle, BundleConfig, solve_bundle

CAMERA = Camera(intrinsics=(450.0, 450.0, 320.0, 240.0), resolution=(640, 480))
SIGMA, KEYFRAMES, POINTS = 1.0 / CAMERA.fx, 30, 800


def flight() -> tuple[np.ndarray, ...]:
    """Return poses, points, and (N,) pose, (N,) point and (N, 2) xy of all sights of them."""
    rng = np.random.default_rng(0)
    Ts = [SE3.exp([0.5 * k, 0, 0, 0, 0.1 * np.sin(k), 0]) for k in range(KEYFRAMES)]
    points = rng.uniform((-3, -2, 3), (18, 2, 8), (POINTS, 3))
    local = np.stack([T.inverse() @ points for T in Ts])
    seen = np.stack([CAMERA.is_inside(CAMERA.project(p)) for p in local])
    pose, point = np.nonzero(seen & (seen.sum(axis=0) > 2))
    xy = (local[:, :, :2] / local[:, :, 2:])[pose, point]
    return np.stack([T.matrix for T in Ts]), points, pose, point, rng.normal(xy, SIGMA)


def adjust(Ts, points, pose, point, xy, held) -> None:
    """Adjust what some sights show, in place; poses that are held stay."""
    (a, i), (b, j) = (np.unique(rows, return_inverse=True) for rows in (pose, point))
    unknown, weights = np.full(len(xy), np.nan), np.full((len(xy), 2), 1 / SIGMA)
    sights = (np.eye(4)[None], np.ones(1), i, j, np.zeros_like(i), xy, unknown, weights)
    solved = solve_bundle(Bundle(Ts[a], held[a], points[b], *sights), BundleConfig(iterations=30))
    Ts[a], points[b] = solved.Ts_world_body, solved.points_world


def main() -> dict[str, float]:
    Ts, points, pose, point, xy = flight()
    adjust(Ts, points, pose, point, xy, np.arange(KEYFRAMES) < 2)  # the best map there is
    results = {}
    for way, oldest in (("others that see it", 0), ("its oldest two", 2), ("its oldest one", 1)):
        T, p = Ts.copy(), points.copy()
        for first in range(1, KEYFRAMES - 4):
            inside = np.isin(pose, window := np.arange(first, first + 5))
            used = np.isin(point, point[inside]) & (inside | (oldest == 0))
            used &= np.bincount(point[used], minlength=POINTS)[point] > 1
            held = ~np.isin(np.arange(KEYFRAMES), window[oldest:])
            adjust(T, p, pose[used], point[used], xy[used], held)
        local = np.einsum("nba,nb->na", T[pose, :3, :3], p[point] - T[pose, :3, 3])
        off = np.linalg.norm(local[:, :2] / local[:, 2:] - xy, axis=1) / SIGMA
        results[way] = float(np.sqrt(np.mean(off**2)))
        print(f"{way:18}: RMS {results[way]:4.1f} px, {100 * np.mean(off > 4):4.1f} % off by 4 px")
    return results


if __name__ == "__main__":
    main()
