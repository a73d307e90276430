"""Stereo: depth from disparity, how its error grows, and what far points are still good for.

Run it with `python examples/05_stereo_depth.py`; docs/lesson/02_visual_odometry.md explains it.
"""

import numpy as np

from odomap import SE3, Camera, World
from odomap.geometry.pnp import refine_pose
from odomap.vision.features import FeatureConfig, detect
from odomap.vision.stereo import StereoConfig, match_sparse

CAMERA = Camera(intrinsics=(400.0, 400.0, 320.0, 200.0), resolution=(640, 400))


def measure(seed: int) -> tuple[np.ndarray, float]:
    """Return true and stereo depth of corners in a room (N, 2), metres, and f b."""
    world = World.make(seed=seed, frames=1, sensors=("stereo", "depth"), calibration_px=0.0)
    frame, (left, right) = world.frame(0), world.rig.cameras
    corners = detect(frame.images[0], FeatureConfig(count=600)).keypoints.astype(np.float64)
    disparity = match_sparse(*frame.images, corners, StereoConfig())
    fb = left.camera.fx * right.T_body_camera.t[0]
    z = frame.depth[tuple(corners.round().astype(int).T[::-1])]
    known = (z > 0) & np.isfinite(disparity)
    return np.column_stack([z, fb / disparity])[known], fb


def sigma(values: np.ndarray) -> float:
    """Return the standard deviation, from medians: a few wrong matches do not count."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def pose_sigma(depth: float) -> tuple[float, float]:
    """Return how well points at one depth tell position (mm) and rotation (degrees)."""
    rays = np.random.default_rng(0).uniform((-0.7, -0.4), (0.7, 0.4), (200, 2))
    points = depth * np.column_stack([rays, np.ones(200)])
    found = refine_pose(points, CAMERA.project(points), CAMERA, SE3.identity(), sigma_px=0.5)
    metres2, radians2 = np.diag(found.covariance).reshape(2, 3).sum(axis=1)
    return 1000 * np.sqrt(metres2), np.degrees(np.sqrt(radians2))


def main() -> dict[str, float]:
    rooms = [measure(seed) for seed in range(4)]
    (z, measured), fb = np.concatenate([depths for depths, _ in rooms]).T, rooms[0][1]
    sigma_d = sigma(fb / measured - fb / z)
    print(f"{len(z)} corners, f b = {fb:.0f} px m, disparities are good to {sigma_d:.2f} px")
    print("depth, m   error measured   z^2 / (f b) sigma_d")
    for near, far in ((1.0, 2.0), (2.0, 3.0), (3.0, 4.5), (4.5, 7.0)):
        inside = (z >= near) & (z < far)
        found, rule = sigma((measured - z)[inside]), np.median(z[inside]) ** 2 / fb * sigma_d
        print(f"{np.median(z[inside]):6.2f} {1000 * found:14.0f} mm {1000 * rule:14.0f} mm")
    for depth in (3.0, 30.0, 300.0):
        mm, degrees = pose_sigma(depth)
        print(f"points at {depth:3.0f} m: position to {mm:5.1f} mm, rotation to {degrees:.3f} deg")
    return {"sigma_d_px": sigma_d, "far_ratio": found / rule}


if __name__ == "__main__":
    main()
