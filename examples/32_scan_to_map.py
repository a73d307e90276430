"""The path of a laser: each scan laid onto the last one, onto a keyframe, or onto a map.

Run it with `python examples/32_scan_to_map.py`; docs/lesson/04_lidar_slam.md explains it.
"""

import numpy as np

import odomap
from odomap.lidar.scans import Beams
from odomap.lidar.voxelmap import VoxelMap

Array = np.ndarray
WAYS = "last scan", "keyframe", "map"
NEW = 0.5  # m, after which a scan becomes a keyframe, or part of the map


def walk() -> tuple[list[Array], odomap.Trajectory]:
    """Return scans as points (N, 3) in the body, two each second, and the true path."""
    source = odomap.open("sim:building?sensors=laser&seed=0&beams=181&rate_hz=2&rounds=0.7")
    beams = Beams(source.rig.lidars[0])
    hits = [beams.points(frame.scan).hits for frame in source]
    return [np.column_stack([p, np.zeros(len(p))]) for p in hits], source.truth


def follow(scans: list[Array], way: str) -> Array:
    """Return (N, 4, 4) poses by laying each scan onto what is kept of those before it."""
    Ts, T_prev_cur, T_kept, kept = [np.eye(4)], np.eye(4), np.eye(4), VoxelMap(0.2, is_planar=True)
    kept.insert(scans[0])
    target = kept.target(0.5)
    for points in scans[1:]:
        guess, cloud = Ts[-1] @ T_prev_cur, odomap.Cloud(points, is_planar=True)
        Ts.append(odomap.register(cloud, target, "plane", initial=guess).T_target_source)
        T_prev_cur = np.linalg.inv(Ts[-2]) @ Ts[-1]
        if way == "last scan" or np.linalg.norm((Ts[-1] - T_kept)[:2, 3]) > NEW:
            if way != "map":
                kept = VoxelMap(0.2, is_planar=True)  # all of earlier scans is forgotten
            kept.insert(points @ Ts[-1][:3, :3].T + Ts[-1][:3, 3])
            target, T_kept = kept.target(0.5), Ts[-1]
    return np.array(Ts)


def main() -> dict[str, float]:
    (scans, truth), results = walk(), {}
    for way in WAYS:
        path = odomap.Trajectory(truth.stamps_ns, follow(scans, way))
        error = odomap.ate(path, truth, align="first")
        results[way] = error.rmse
        in_the_end = f"{100 * error.errors[-1]:5.1f} cm after {error.path_m:.0f} m"
        print(f"onto the {way:9}: ATE {100 * error.rmse:5.1f} cm, off by {in_the_end}")
    return results


if __name__ == "__main__":
    main()
