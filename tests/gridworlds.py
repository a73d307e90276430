"""Maps whose keyframes are where they truly are, and what the truth of their grids is."""

import functools

import numpy as np

from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sources.simulated import SimulatedSource

SWEEPS = "sim:room?seed=2&frames=60&rate_hz=20&columns=900&sensors=lidar3d"
DEPTH = "sim:room?seed=1&frames=300&resolution=320x200&sensors=mono,depth"
LASER = "sim:hall?seed=1&sensors=laser&frames=200"


@functools.cache
def recorded(data):
    return SimulatedSource(data)


def true_map(data, every, T_new_world=None):
    """Return a map of every so many frames' scans and clouds, at their true poses."""
    source, m = recorded(data), Map()
    move = np.eye(4) if T_new_world is None else T_new_world
    for index in range(0, len(source), every):
        frame = source.frame(index)
        cloud = None if frame.cloud is None else frame.cloud.points.astype(np.float32)
        keyframe = Keyframe(m.new_keyframe_id(), frame.stamp_ns, scan=frame.scan, cloud=cloud)
        m.add_keyframe(keyframe, move @ source.truth.Ts_world_body[index])
    return m


def surfaces(data, low, high, step=0.02):
    """Return (N, 2) points of the room's surfaces between two heights, seen from above."""
    parts = []
    for corner, u, v, sizes in rectangles(recorded(data).world):
        sides = (np.arange(0.0, size + step, step).clip(0, size) for size in sizes)
        s, t = (grid.reshape(-1, 1) for grid in np.meshgrid(*sides))
        points = corner + s * u + t * v
        parts.append(points[(points[:, 2] >= low) & (points[:, 2] <= high), :2])
    return np.concatenate(parts)


def rectangles(world):
    """Yield corner, sides and lengths of the rectangles of a world with or without pictures."""
    if hasattr(world, "solids"):
        for p in world.solids.shapes:
            axes = p[[0, 1, 2, 4, 5, 6, 8, 9, 10]].reshape(3, 3)
            yield p[[3, 7, 11]] @ axes, axes[1], axes[2], p[12:]
        return
    for f, face in zip(world.scene.rectangles.frames, world.scene.rectangles.faces, strict=True):
        yield f[:3], f[3:6], f[6:], face[:2]


def occupied(grid):
    return grid.centres(np.argwhere(grid.log_odds > np.log(0.65 / 0.35)))


def distances(points, others):
    from scipy.spatial import cKDTree

    return cKDTree(others).query(points)[0]
