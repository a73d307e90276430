"""A way to spoil good depth: looking it up at whole pixels; and what to do instead.

Run it with `python examples/08_pitfalls_depth.py`; docs/lesson/02_visual_odometry.md explains it.
"""

from dataclasses import replace

import numpy as np

from odomap import World
from odomap.simulation.render import render
from odomap.vision.features import FeatureConfig, detect

WAYS = ("depth[int(v), int(u)]", "four pixels blended", "1/z, on one surface")


def truncated(depth: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Take the pixel left and above: depth[int(v), int(u)]."""
    u, v = at.astype(int).T
    return np.where(depth[v, u] > 0, depth[v, u], np.nan)


def blended(depth: np.ndarray, at: np.ndarray, careful: bool) -> np.ndarray:
    """Blend the four pixels around; carefully: 1/z (linear on a plane), where they agree."""
    (u, v), (a, b) = at.astype(int).T, (at % 1.0).T
    four = depth[[v, v, v + 1, v + 1], [u, u + 1, u, u + 1]]
    weights = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    if not careful:
        return np.sum(weights * four, axis=0)  # holes (0) and far walls blend in
    four = np.where(four.max(axis=0) < 1.03 * four.min(axis=0), four, np.nan)  # one surface
    return 1.0 / np.sum(weights / four, axis=0)


def truth(world: World, at: np.ndarray) -> np.ndarray:
    """Return the true depth at fractions of a pixel, from a picture of four times the size."""
    camera, Ts = world.rig.cameras[0].camera, np.tile(world.truth.Ts_world_body[0], (2, 1, 1))
    size = (4 * camera.width, 4 * camera.height)
    fine = replace(camera, intrinsics=camera.intrinsics * 4 + [0, 0, 1.5, 1.5], resolution=size)
    depth = render(world.scene, fine, Ts, np.zeros(2), supersample=1).depth
    return depth[tuple(np.rint(4 * at + 1.5).astype(int).T[::-1])]


def main() -> dict[str, float]:
    world = World.make(seed=4, frames=1, sensors=("mono", "depth"), calibration_px=0.0)
    frame, results = world.frame(0), {}
    depth, corners = frame.depth, detect(frame.images[0], FeatureConfig(count=800)).keypoints
    at = corners + np.random.default_rng(0).uniform(0, 1, corners.shape)  # as tracks lie
    print("                          bias  median  above 5 %    kept")
    blends = (blended(depth, at, careful) for careful in (False, True))
    for name, z in zip(WAYS, (truncated(depth, at), *blends)):
        error = 100 * (z / truth(world, at) - 1)[np.isfinite(z)]
        half, wild, kept = np.median(abs(error)), np.mean(abs(error) > 5), len(error) / len(z)
        print(f"{name:21} {np.median(error):+.2f} %  {half:.2f} %  {wild:8.1%}  {kept:6.0%}")
        results[name] = half
    return results


if __name__ == "__main__":
    main()
