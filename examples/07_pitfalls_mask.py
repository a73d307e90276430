"""A way to spoil a good start: landmarks from matches that RANSAC has found to be wrong.

Run it with `python examples/07_pitfalls_mask.py`; docs/lesson/02_visual_odometry.md explains it.
"""

import cv2
import numpy as np

from odomap import SE3, Camera
from odomap.geometry.triangulate import triangulate

CAMERA = Camera(intrinsics=(400.0, 400.0, 320.0, 200.0), resolution=(640, 400))
T_CUR_PREV = SE3.exp([0.8, 0.05, 0.1, 0.02, 0.12, 0.0])


def matched(seed: int, wrong: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points (N, 3), and where both views saw them; a share is matched with anything."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-2, -1.2, 3), (2, 1.2, 8), (150, 3))
    prev = CAMERA.project(points) + rng.normal(0.0, 0.5, (150, 2))
    cur = CAMERA.project(T_CUR_PREV @ points) + rng.normal(0.0, 0.5, (150, 2))
    bad = rng.random(150) < wrong
    cur[bad] = rng.uniform((0, 0), (640, 400), (np.count_nonzero(bad), 2))
    return points, prev, cur


def start(seed: int, use_mask: bool) -> float:
    """Make landmarks from two views; return the share of them whose depth is far off."""
    points, prev, cur = matched(seed, wrong=0.4)
    E, mask = cv2.findEssentialMat(prev, cur, CAMERA.K, cv2.RANSAC, 0.999, 1.0)
    if not use_mask:
        mask = np.full_like(mask, 255)
    _, R, t, mask = cv2.recoverPose(E, prev, cur, CAMERA.K, mask=mask)
    T_prev_cur = SE3.from_parts(R, t.ravel()).inverse()
    Ts = np.stack([np.eye(4), T_prev_cur.matrix])
    found = triangulate(Ts, np.stack([CAMERA.undistort(prev), CAMERA.undistort(cur)]))
    taken = np.isfinite(found.points_world[:, 2])
    if use_mask:
        taken &= (mask.ravel() > 0) & found.ahead
    z = found.points_world[taken, 2] * np.linalg.norm(T_CUR_PREV.t)
    return float(np.mean(np.abs(z / points[taken, 2] - 1.0) > 0.5))


def main() -> dict[str, float]:
    results = {}
    for name, use_mask in (("without the mask", False), ("with the mask", True)):
        results[name] = float(np.mean([start(seed, use_mask) for seed in range(20)]))
        print(f"{name:16}: {100 * results[name]:4.1f} % of the landmarks off by half their depth")
    return results


if __name__ == "__main__":
    main()
