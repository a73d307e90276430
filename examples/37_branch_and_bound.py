"""Where in a plan a scan was taken, when nothing is known: branch and bound, counted.

Run it with `python examples/37_branch_and_bound.py`; docs/lesson/04_lidar_slam.md explains it.
"""

from heapq import heappop, heappush
from itertools import count, product

import numpy as np

import odomap
from odomap.geometry.planar import between_planar, to_plane, transform_planar
from odomap.lidar.grid import beside
from odomap.lidar.scans import Beams

Array = np.ndarray
CELL, SIDE = 0.1, 64  # m; cells of the largest squares


def search(walls: Array, points: Array) -> tuple[float, Array, int, int]:  # noqa: RET503
    """Return the best score; its x, y (cells) and heading; bounds computed; poses there are."""
    levels = [np.pad(np.where(walls, 1.0, 0.5 * beside(walls)), SIDE)]
    for by in (1, 2, 4, 8, 16, 32):
        m = np.pad(levels[-1], ((0, by), (0, by)))
        levels.append(np.max([m[:-by, :-by], m[by:, :-by], m[:-by, by:], m[by:, by:]], axis=0))
    height, width = walls.shape
    headings = np.arange(0.0, 2 * np.pi, CELL / np.linalg.norm(points, axis=1).max())
    turned = [transform_planar(np.array([0, 0, a]), points) / CELL for a in headings]
    cells = SIDE + np.floor(turned).astype(int)

    def bounded(h: int, a: int, x: int, y: int) -> tuple[float, int, int, int, int]:
        column, row = np.clip(cells[a] + (x, y), 0, (width + SIDE, height + SIDE)).T
        return -float(levels[h][row, column].mean()), h, a, x, y

    ways = product(range(len(headings)), range(0, width, SIDE), range(0, height, SIDE))
    heap = sorted(bounded(len(levels) - 1, *way) for way in ways)  # the highest bound first
    for splits in count():
        bound, h, a, x, y = heappop(heap)
        if h == 0:  # a single pose, and what is left cannot be better
            poses = len(headings) * width * height
            return -bound, np.array([x, y, headings[a]]), len(heap) + 1 + splits, poses
        for i, j in product((0, 1 << (h - 1)), repeat=2):
            heappush(heap, bounded(h - 1, a, x + i, y + j))


def main() -> tuple[float, float, float]:
    source = odomap.open("sim:hall?sensors=laser&seed=1&beams=181&rate_hz=2")
    (walls, corner), beams = source.world.plan.occupied(CELL), Beams(source.rig.lidars[0])
    score, best, bounds, poses = search(walls, beams.points(source.frame(40).scan).hits)
    x_found = np.append(corner + CELL * best[:2], best[2])
    x, y, turn = between_planar(to_plane(source.truth.Ts_world_body[40]), x_found)
    print(f"{bounds} bounds instead of {poses} poses; score {score:.2f}, ", end="")
    print(f"off by {100 * np.hypot(x, y):.0f} cm and {np.degrees(abs(turn)):.1f} deg")
    return score, bounds / poses, float(np.hypot(x, y))


if __name__ == "__main__":
    main()
