"""SLAM with a 3D LiDAR round a block, without loops and with; the map as a cloud, and as a file.

Run it with `python examples/47_cloud_map.py`; docs/lesson/04_lidar_slam.md explains it.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import odomap
from odomap.files.cloudfiles import write_cloud
from odomap.geometry.lie import se3_inverse
from odomap.maps.cloudmap import cloud_of_map

TOWN = "sim:street?sensors=lidar3d&seed=4&beams=16&columns=360&speed=25"


def run(rig: odomap.Rig, frames: list[odomap.Frame], closing: bool) -> tuple:
    """Return the result of a run, and the loops that were looked for."""
    config, loops = odomap.preset("lidar"), []
    config = replace(config, cloud_closing=replace(config.cloud_closing, enabled=closing))
    system = odomap.Slam(rig, config)
    system.worker.on_loop.append(loops.append)
    for frame in frames:
        system.track(frame)
    return system.finish(), loops


def gap(result: odomap.Result, source: odomap.Source) -> float:
    """Return how far off the last pose is as seen from the place where one was there before."""
    Ts, true = result.trajectory.Ts_world_body, source.truth.Ts_world_body
    before = np.argmin(np.linalg.norm(true[: len(true) // 2, :3, 3] - true[-1, :3, 3], axis=1))
    seen, is_so = (se3_inverse(poses[before]) @ poses[-1] for poses in (Ts, true))
    return float(np.linalg.norm((seen - is_so)[:3, 3]))


def main() -> dict[str, tuple[float, float, int]]:
    source, results = odomap.open(TOWN), {}
    frames = list(source)
    for name, closing in (("without loops", False), ("with loops", True)):
        result, loops = run(source.rig, frames, closing)
        cloud = cloud_of_map(result.map, source.rig)
        ate, off = odomap.ate(result.trajectory, source.truth).rmse, gap(result, source)
        results[name] = ate, off, len(cloud.points)
        print(
            f"{name:13}: ATE {100 * ate:4.1f} cm, {100 * off:2.0f} cm off after the round; ", end=""
        )
        print(f"{len(cloud.points)} points, {sum(loop.is_accepted for loop in loops)} loops")
    with tempfile.TemporaryDirectory() as folder:
        write_cloud(Path(folder) / "cloud.pcd", cloud.columns())
        print(len(odomap.open(folder).frame(0).cloud), "points in cloud.pcd")
    return results


if __name__ == "__main__":
    main()
