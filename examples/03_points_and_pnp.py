"""Points from two rays, a pose from points: and how sure each of them is.

Run it with `python examples/03_points_and_pnp.py`; docs/lesson/02_visual_odometry.md explains it.
"""

import numpy as np

from odomap import SE3, Camera
from odomap.evaluation.consistency import nees
from odomap.geometry.pnp import solve_pnp
from odomap.geometry.triangulate import triangulate

CAMERA = Camera(intrinsics=(400.0, 400.0, 320.0, 200.0), resolution=(640, 400))
SIGMA_PX = 0.5


def triangulated(baseline: float, depth: float, draws: int = 2000) -> tuple[np.ndarray, float]:
    """Triangulate one point again and again, each time with other noise in both images."""
    Ts = np.stack([np.eye(4), SE3.exp([baseline, 0, 0, 0, 0, 0]).matrix])
    ahead = np.array([[0.0, 0.0, depth]])
    seen = np.vstack([CAMERA.project(ahead), CAMERA.project(ahead - Ts[1, :3, 3])])
    noisy = seen[:, None] + np.random.default_rng(0).normal(0.0, SIGMA_PX, (2, draws, 2))
    found = triangulate(Ts, np.stack([CAMERA.undistort(view) for view in noisy]))
    return found.points_world[found.ahead], float(np.degrees(np.median(found.parallax)))


def pose_errors(trials: int = 100, wrong: float = 0.3) -> tuple[float, float, float]:
    """Solve PnP with a share of wrong matches; return position, rotation error and NEES / 6."""
    errors, covariances = np.empty((trials, 6)), np.empty((trials, 6, 6))
    true = SE3.exp([0.4, -0.2, 0.1, 0.05, -0.3, 0.1])  # T_world_camera
    for trial in range(trials):
        rng = np.random.default_rng(trial)
        points_camera = rng.uniform((-2, -1.2, 2.5), (2, 1.2, 8), (150, 3))
        pixels = CAMERA.project(points_camera) + rng.normal(0.0, SIGMA_PX, (150, 2))
        bad = rng.random(150) < wrong
        pixels[bad] = rng.uniform((0, 0), (640, 400), (np.count_nonzero(bad), 2))
        points = true @ points_camera
        found = solve_pnp(points, pixels, CAMERA, seed=trial, sigma_px=SIGMA_PX, threshold_px=2.0)
        errors[trial] = (true.inverse() @ found.T_world_camera).log()
        covariances[trial] = found.covariance
    position, rotation = (np.sqrt(np.mean(np.sum(e**2, axis=1))) for e in np.hsplit(errors, 2))
    return position, rotation, nees(errors, covariances).mean() / 6


def main() -> dict[str, float]:
    print("baseline  parallax   sideways    in depth   z^2 sqrt(2) sigma / (f b)")
    for baseline in (0.05, 0.2, 0.8):
        points, angle = triangulated(baseline, 4.0)
        side, deep = points[:, 1].std(), points[:, 2].std()
        rule = 16.0 * np.sqrt(2.0) * SIGMA_PX / (CAMERA.fx * baseline)
        print(f"{baseline:4.2f} m {angle:6.1f} deg {side:9.4f} m {deep:11.3f} m {rule:7.3f} m")
    position, rotation, ratio = pose_errors()
    print(f"PnP, 30 % wrong: {1000 * position:.1f} mm, {np.degrees(rotation):.3f} deg")
    print(f"squared error over its own covariance, per degree of freedom: {ratio:.2f}")
    return {"depth_ratio": deep / rule, "position_m": position, "nees": ratio}


if __name__ == "__main__":
    main()
