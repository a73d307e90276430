"""A grid of hits alone and one with rays, where people walk; and beams that bring nothing back.

Run it with `python examples/35_rays.py`; docs/lesson/04_lidar_slam.md explains it.
"""

import numpy as np

import odomap
from odomap.geometry.planar import to_plane, transform_planar
from odomap.lidar.scanconfig import ScanConfig
from odomap.lidar.scans import Beams

HALL = "sim:hall?sensors=laser&seed=1&beams=181&rate_hz=2&moving_objects=4&range_m=6"
CASES = {
    "hits alone": {"rays": False},
    "hits and rays": {},
    "nothing back: free": {"free": 6.0},
    "lost: free, too": {"free": 6.0, "lost_is_far": True},
}


def grid_of(
    source: odomap.Source,
    frames: list[odomap.Frame],
    rays: bool = True,
    free: float = 0.0,
    lost_is_far: bool = False,
) -> odomap.OccupancyGrid:
    """Return a grid of all scans at their true poses; beams are free so far that met nothing."""
    grid = odomap.OccupancyGrid(0.05)
    beams = Beams(source.rig.lidars[0], ScanConfig(free=free))
    for frame, x in zip(frames, to_plane(source.truth.Ts_world_body)):
        scan = np.where(np.isnan(frame.scan), np.inf, frame.scan) if lost_is_far else frame.scan
        seen = beams.points(scan)
        parts = seen.origin[None], seen.hits, seen.free
        eye, hits, ends = (transform_planar(x, points) for points in parts)
        grid.insert(eye[0], hits if rays else hits[:0], between=hits, free=ends)
    return grid


def main() -> dict[str, tuple[int, int, float, float]]:
    source, results = odomap.open(HALL), {}
    frames = list(source)
    walls = source.world.plan.walls[:4, :2]  # the corners of the hall
    for name, options in CASES.items():
        grid = grid_of(source, frames, **options)
        signs = np.sign(grid.log_odds)
        occupied, free = (grid.centres(np.argwhere(signs == sign)) for sign in (1, -1))
        ghosts = int(np.sum(source.world.plan.distances(occupied) > 0.15))
        outside = ((free < walls.min(axis=0)) | (free > walls.max(axis=0))).any(axis=1).sum()
        m2 = [cells * grid.resolution**2 for cells in (len(free), outside)]
        results[name] = len(occupied), ghosts, *m2
        cells = f"{len(occupied)} cells occupied, {ghosts:3} where no wall is"
        print(f"{name:18}: {cells}; {m2[0]:3.0f} m2 free, {m2[1]:2.0f} outside the hall")
    return results


if __name__ == "__main__":
    main()
