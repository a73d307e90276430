"""Frames of a 2D laser in a room, without any simulator: walls as segments, wheels that slip."""

import numpy as np

from lidar.rooms import ROOM, cast
from odomap.geometry.lie import se3_inverse
from odomap.geometry.planar import between_planar, compose_planar, from_plane, to_plane
from odomap.sensors.frame import Frame
from odomap.sensors.rig import LidarMount, Rig

ANGLES = (-2.3, 2.3, 271)
RIG = Rig(lidars=(LidarMount("laser", range_m=(0.1, 30.0), rate_hz=10.0, angles=ANGLES),))
DIRECTIONS = np.linspace(*ANGLES)


def around(count, rounds=1.0, radius=1.2):
    """Return (N, 3) poses on an ellipse in the room, heading along it, the first at the origin."""
    t = 2 * np.pi * rounds * np.arange(count) / count
    x = np.stack([radius * 1.6 * np.sin(t), radius * (1 - np.cos(t)) - 0.6], axis=1)
    heading = np.unwrap(np.arctan2(np.sin(t), 1.6 * np.cos(t)))
    return np.column_stack([x, heading])


def frames(path, seed=0, walls=ROOM, odometry=True, sigma=0.01):
    """Return frames along (N, 3) poses; wheels are 2 % off and slip a little."""
    rng, wheels, made = np.random.default_rng(seed), np.zeros(3), []
    for n, x in enumerate(path):
        if n:
            step = between_planar(path[n - 1], x)
            scale = np.array([1.02, 1.02, 0.98])
            noise = rng.normal(0.0, [0.002, 0.002, 0.002])
            wheels = compose_planar(wheels, step * scale + noise)
        scan = cast(walls, x, DIRECTIONS, rng, sigma)
        told = from_plane(wheels) if odometry else None
        made.append(Frame(n, 100_000_000 * (n + 1), scan=scan, odometry=told))
    return made


def in_first(path):
    """Return (N, 3) poses as seen from the first."""
    return np.array([between_planar(path[0], x) for x in path])


def carried(source, *parts, odometry=True, dark=0):
    """Return frames of a source in parts (ranges), as if the body was carried from one to the next.

    Wheels do not turn while it is carried, and the laser sees nothing for some scans. Beside them,
    (N, 3) true poses.
    """
    made, true, wheels = [], [], np.eye(4)
    for part in parts:
        for n, k in enumerate(part):
            frame = source.frame(k)
            if n:
                wheels = wheels @ se3_inverse(source.odometry[part[n - 1]]) @ source.odometry[k]
            told = wheels if odometry else None
            stamp_ns = 100_000_000 * (len(made) + 1)
            is_dark = part is not parts[0] and n < dark
            scan = np.full_like(frame.scan, np.nan) if is_dark else frame.scan
            made.append(Frame(len(made), stamp_ns, scan=scan, odometry=told))
            true.append(to_plane(source.truth.Ts_world_body[k]))
    return made, np.array(true)
