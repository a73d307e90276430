"""Two views of a still scene: how the camera moved between them, and when nobody can tell.

Run it with `python examples/02_two_views.py`; docs/lesson/02_visual_odometry.md explains it.
"""

import numpy as np

from odomap import SE3, Camera, World
from odomap.geometry.twoview import homography_ransac, relative_pose
from odomap.vision.features import FeatureConfig, detect
from odomap.vision.flow import FlowConfig, pyramid, track


def matches(world: World, first: int, second: int) -> tuple[np.ndarray, np.ndarray]:
    """Find corners in one image and follow them, frame by frame, to another."""
    image = world.frame(first).images[0]
    start = pixels = detect(image, FeatureConfig(count=400)).keypoints.astype(np.float64)
    old = pyramid(image, 3)
    for index in range(first + 1, second + 1):
        new = pyramid(world.frame(index).images[0], 3)
        flow = track(old, new, pixels, pixels, FlowConfig())
        start, pixels, old = start[flow.found], flow.points[flow.found], new
    return start, pixels


def who_explains(camera: Camera, points: np.ndarray, T_second_first: SE3) -> tuple[int, int]:
    """Count the matches that an essential matrix and a homography explain."""
    noise = np.random.default_rng(0).normal(0.0, 0.3, (2, len(points), 2))
    first = camera.undistort(camera.project(points) + noise[0])
    second = camera.undistort(camera.project(T_second_first @ points) + noise[1])
    motion = relative_pose(first, second, 1.5 / camera.fx)
    return motion.num_inliers, homography_ransac(first, second, 1.5 / camera.fx).num_inliers


def main() -> dict[str, float]:
    world = World.make(kind="room", seed=4, frames=9, sensors=("mono",))
    camera = world.rig.cameras[0].camera
    start, end = matches(world, 0, 8)
    found = relative_pose(camera.undistort(start), camera.undistort(end), 1.0 / camera.fx)
    true = world.truth.pose(8).inverse() @ world.truth.pose(0)  # T_second_first
    turn = np.degrees(np.linalg.norm((found.T_second_first.inverse() @ true).log()[3:]))
    aim = np.degrees(np.arccos(found.T_second_first.t @ true.t / np.linalg.norm(true.t)))
    print(f"{found.num_inliers} of {len(start)} matches agree on a motion")
    print(f"rotation off by {turn:.2f} deg, direction of the translation by {aim:.1f} deg")
    print(f"the true step has {np.linalg.norm(true.t):.3f} m; the one found is 1 unit long")

    rng = np.random.default_rng(1)
    deep = rng.uniform((-2, -1.2, 3), (2, 1.2, 9), (200, 3))
    wall = np.column_stack([deep[:, :2], np.full(200, 4.0)])
    step, turned = SE3.exp([0.3, 0, 0.1, 0, 0.05, 0]), SE3.exp([0, 0, 0, 0, 0.1, 0.02])
    cases = (("depth", deep, step), ("a wall", wall, step), ("rotation", deep, turned))
    for name, points, T in cases:
        by_E, by_H = who_explains(camera, points, T)
        print(f"{name:8}: E explains {by_E:3d} of 200, H {by_H:3d}")
    return {"turn_deg": float(turn), "aim_deg": float(aim)}


if __name__ == "__main__":
    main()
