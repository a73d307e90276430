"""SLAM with a poor 2D laser: the wheels alone, the laser without loops, and with loops.

Run it with `python examples/36_laser_slam.py`; docs/lesson/04_lidar_slam.md explains it.
"""

from dataclasses import replace

import numpy as np

import odomap
from odomap.evaluation.walls import compare_walls
from odomap.system.stages import Loop

WORLD = "sim:building?sensors=laser&seed=1&rounds=1.15&rate_hz=5&beams=61&range_m=6&noise=2"


def run(source: odomap.Source, closing: bool) -> tuple[odomap.Result, list[Loop]]:
    """Return the result of a run, and the loops that were looked for."""
    config = odomap.preset("lidar2d")
    config = replace(config, scan_closing=replace(config.scan_closing, enabled=closing))
    system, loops = odomap.Slam(source.rig, config), []
    system.worker.on_loop.append(loops.append)
    for frame in source:
        system.track(frame)
    return system.finish(), loops


def judged(source: odomap.Source, result: odomap.Result) -> tuple[float, float]:
    """Return the ATE, and the share of the true walls that the grid shows."""
    error = odomap.ate(result.trajectory, source.truth)
    grid, T = odomap.occupancy_grid(result.map, source.rig), error.T_reference_estimate
    cells = grid.centres(np.argwhere(grid.log_odds > 0)) @ T.R[:2, :2].T + T.t[:2]
    seen = np.concatenate([source.world.hits(k) for k in range(0, len(source), 10)])
    walls = compare_walls(cells, source.world.plan.distances(cells), seen, grid.resolution)
    return error.rmse, walls.found


def main() -> dict[str, tuple[float, float]]:
    source, results = odomap.open(WORLD), {}
    wheels = odomap.ate(odomap.Trajectory(source.stamps_ns, source.odometry), source.truth)
    print(f"wheels       : ATE {wheels.rmse:.2f} m along {wheels.path_m:.0f} m")
    for name, closing in (("without loops", False), ("with loops", True)):
        result, loops = run(source, closing)
        results[name] = judged(source, result)
        ate, found = results[name]
        print(f"{name:13}: ATE {ate:.2f} m, {found:.0%} of the walls within a cell")
    count = sum(loop.is_accepted for loop in loops)
    print(f"{len(loops)} times a keyframe was looked for in a submap, {count} times found")
    print(f"one that was not: {loops[0].reason}")
    return results


if __name__ == "__main__":
    main()
