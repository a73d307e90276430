"""A grid saved as PGM and YAML and loaded again; a robot put down anywhere in it finds itself.

Run it with `python examples/38_localise_in_a_grid.py`; docs/lesson/04_lidar_slam.md explains it.
"""

import tempfile
from pathlib import Path

import numpy as np

import odomap
from odomap.geometry.planar import between_planar, compose_planar, to_plane
from odomap.lidar.branchbound import GridPyramid
from odomap.lidar.gridmatching import match_to_grid
from odomap.lidar.scans import Beams

Array = np.ndarray
HALL = "sim:hall?sensors=laser&seed=1&beams=181&rate_hz=4"
WHEELS = np.diag(np.array([0.03, 0.03, 0.02]) ** -2)  # information of a step by the wheels


def mapped(file: Path) -> Array:
    """Map the hall, save its grid, and return the true pose (4, 4) of the map in the hall."""
    source = odomap.open(HALL)
    system = odomap.Slam(source.rig)
    for frame in source:
        system.track(frame)
    odomap.save_grid(file, odomap.occupancy_grid(system.finish().map, source.rig))
    return source.truth.Ts_world_body[0]


def main() -> dict[int, Array]:
    with tempfile.TemporaryDirectory() as folder:
        T_hall_map = mapped(file := Path(folder) / "hall.yaml")
        grid = odomap.load_grid(file)
        print(file.read_text(), end="")
    source, results = odomap.open(HALL + "&rounds=2&moving_objects=3"), {}
    beams, wheels = Beams(source.rig.lidars[0]), to_plane(source.odometry)
    truth = to_plane(np.linalg.inv(T_hall_map) @ source.truth.Ts_world_body)
    pyramid, size = GridPyramid(grid), grid.resolution * np.array(grid.log_odds.shape[::-1])
    anywhere = np.append(grid.origin + size / 2, 0.0), size.max() / 2, np.pi
    for first in (350, 430, 510):
        x = pyramid.search(beams.points(source.frame(first).scan).hits, *anywhere, 0.4).x_grid_body
        off = []
        for k in range(first, first + 30):
            seen = beams.points(source.frame(k).scan)
            if k > first:
                x = compose_planar(x, between_planar(wheels[k - 1], wheels[k]))
            x = match_to_grid(grid, seen.hits, seen.normals, x, WHEELS, x).x_grid_body
            off.append(1000 * np.hypot(*between_planar(truth[k], x)[:2]))
        results[first] = np.array(off)
        print(f"scan {first}: found, off by {off[0]:.0f} mm; ", end="")
        print(f"the 30 from there on {np.median(off):.0f} mm in the median, {max(off):.0f} at most")
    return results


if __name__ == "__main__":
    main()
