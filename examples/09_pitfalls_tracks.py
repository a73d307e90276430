"""A way to spoil good tracks: looking for corners where there are tracks already.

Run it with `python examples/09_pitfalls_tracks.py`; docs/lesson/02_visual_odometry.md explains it.
"""

import numpy as np
from scipy.spatial import cKDTree

from odomap import World
from odomap.vision.features import FeatureConfig, detect
from odomap.vision.flow import FlowConfig, pyramid, track


def follow(images: list[np.ndarray], way: str) -> tuple[float, float, float]:
    """Track, top up each frame; return frames per track, doubles and cover of the last in %."""
    config, at, old = FeatureConfig(count=300), np.empty((0, 2)), pyramid(images[0], 3)
    tracks = seen = 0
    for image in images:
        new = pyramid(image, 3)
        flow = track(old, new, at, at, FlowConfig())
        at, old = flow.points[flow.found], new
        if way == "start anew" and len(at) < 200:
            at = np.empty((0, 2))
        if way != "start anew" or not len(at):
            occupied = at.astype(np.float32) if way == "look elsewhere" else None
            fresh = detect(image, config, config.count - len(at), occupied).keypoints
            at, tracks = np.vstack([at, fresh]), tracks + len(fresh)
        seen += len(at)
    doubles = len(np.unique(cKDTree(at).query_pairs(3.0, output_type="ndarray"))) / len(at)
    cells = len(np.unique((at // 40).astype(int), axis=0)) / (16 * 10)
    return seen / tracks, 100 * doubles, 100 * cells


def main() -> dict[str, tuple[float, float, float]]:
    world = World.make(seed=2, frames=25, sensors=("mono",))
    images = [world.frame(k).images[0] for k in range(25)]
    results = {}
    for way in ("start anew", "add anywhere", "look elsewhere"):
        length, doubles, cover = results[way] = follow(images, way)
        print(f"{way:14}: {length:3.1f} frames per track, {doubles:2.0f} % of them doubles, "
              f"on {cover:2.0f} % of the image")  # fmt: skip
    return results


if __name__ == "__main__":
    main()
