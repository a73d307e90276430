"""Scale in monocular odometry: free, but constant, because the landmarks carry it.

Run it with `python examples/04_scale_and_window.py`; docs/lesson/02_visual_odometry.md explains it.
"""

import numpy as np

from odomap import SE3, Camera, Trajectory, ate
from odomap.backend.bundle import Bundle, BundleConfig, solve_bundle
from odomap.geometry.pnp import solve_pnp
from odomap.geometry.triangulate import triangulate
from odomap.geometry.twoview import relative_pose

CAMERA = Camera(intrinsics=(400.0, 400.0, 320.0, 200.0), resolution=(640, 400))
SIGMA_PX = 0.5


def scene(views: int = 10, count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Return true poses on an arc, at a speed that varies, and what each view sees."""
    rng = np.random.default_rng(0)
    way = np.cumsum(rng.uniform(0.05, 0.25, views)) - 0.5
    poses = [SE3.exp([s, 0.1 * s * s, 0, 0, -0.15 * s, 0.02 * s]) for s in way]
    points = rng.uniform((-2, -1.2, 3), (2.5, 1.2, 8), (count, 3))
    pixels = np.stack([CAMERA.project(T.inverse() @ points) for T in poses])
    return np.stack([T.matrix for T in poses]), pixels + rng.normal(0, SIGMA_PX, pixels.shape)


def error_mm(*Ts: np.ndarray) -> float:
    """Return the position error of poses (N, 4, 4) against true ones after the best similarity."""
    return 1000 * ate(*(Trajectory(np.arange(len(T)), T) for T in Ts), align="sim3").rmse


def main() -> dict[str, float]:
    Ts_true, pixels = scene()
    seen = np.stack([CAMERA.undistort(view) for view in pixels])
    # Two views make a motion of length 1, and points in that unit.
    motion = relative_pose(seen[0], seen[4], 2.0 / CAMERA.fx).T_second_first.inverse()
    points = triangulate([np.eye(4), motion.matrix], seen[[0, 4]]).points_world
    # All views are then placed by the points, and so in their unit.
    placed = [solve_pnp(points, view, CAMERA, threshold_px=3.0) for view in pixels]
    Ts = np.stack([found.T_world_camera.matrix for found in placed])
    step, true_step = (np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1) for T in (Ts, Ts_true))
    for name, values in (("true steps, m", true_step), ("estimated / true", step / true_step)):
        print(f"{name:17}", *(f"{value:.2f}" for value in values))
    # A window moves all at once. A first pose holds place and direction, a second the scale.
    (pose, point), alone = np.indices((10, 200)).reshape(2, -1), np.full(2000, np.nan)
    weights = np.full((2000, 2), CAMERA.fx / SIGMA_PX)
    measured = (pose, point, 0 * pose, seen.reshape(-1, 2), alone, weights)
    print(f"placed one by one: {error_mm(Ts, Ts_true):.1f} mm")
    for held in ((0, 9), (0,)):
        problem = (Ts, np.isin(np.arange(10), held), points, np.eye(4)[None], np.ones(1), *measured)
        solved = solve_bundle(Bundle(*problem), BundleConfig(iterations=30, tolerance=1e-6))
        error = error_mm(solved.Ts_world_body, Ts_true)
        print(f"window, poses {held} held: {error:.1f} mm; {solved.reason}")
    return {"spread": np.ptp(step / true_step), "after_mm": error}


if __name__ == "__main__":
    main()
