"""Where in a map a scan was taken, when nothing is known of it: every submap is searched.

Branch and bound over all of a submap, in all directions, is quick once a good pose is known: what
the best submap so far gave is the bound of the next. The scan is then matched exactly, and believed
if nearly none of its beams ends where the submap is free. One scan cannot tell places that look the
same; of those the best fit is taken.

Cost: some ten milliseconds for each submap, of which most is the pyramid of its grid.

Reference: W. Hess, D. Kohler, H. Rapp, D. Andor, "Real-time loop closure in 2D LIDAR SLAM", ICRA
2016, section V.
"""

from collections.abc import Sequence

import numpy as np

from odomap.geometry.planar import transform_planar
from odomap.lidar.branchbound import Found, GridPyramid
from odomap.lidar.gridmatching import GridMatch, lay_on_grid
from odomap.lidar.scans import ScanPoints
from odomap.system.submaps import Submap

__all__ = ["recognise_scan"]


def recognise_scan(
    submaps: Sequence[Submap], scan: ScanPoints, score: float, in_free: float
) -> tuple[Submap, GridMatch] | str:
    """Find a scan in the submaps of a map.

    Args:
        submaps: finished.
        scan: with some hits.
        score: share of beams that must meet walls.
        in_free: share that may end in the open, relative to those that meet walls or do so.

    Returns:
        The submap that it fits best, and how it lies there; or why it is in none.
    """
    best: tuple[Submap, Found] | None = None
    for submap in submaps:
        bound = score if best is None else best[1].score
        middle = np.array([*submap.middle, 0.0])
        found = GridPyramid(submap.grid).search(scan.hits, middle, submap.radius, np.pi, bound)
        if found is not None:
            best = submap, found
    if best is None:
        return f"in none of {len(submaps)} submaps {score:.0%} of the scan meet walls"
    submap, found = best
    match = lay_on_grid(scan, submap.grid, found.x_grid_body)
    free = submap.grid.share_in_free(transform_planar(match.x_grid_body, scan.hits))
    if free > in_free * (free + match.on_walls):
        return f"where {match.on_walls:.0%} of the beams meet walls {free:.0%} end in the open"
    return submap, match
