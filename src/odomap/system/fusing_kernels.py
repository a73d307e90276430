"""Where landmarks should show: how they were seen so far, and what that means for another view.

What is known of a landmark p is from where it was seen, and on which pyramid level. A level is one
step of the distance: what shows on level l at the distance r shows on the finest one, 0, at r
scaleˡ. So (M, 4) numbers tell its look,

    Σ_k (c_k − p)/|c_k − p|,    mean_k (log |c_k − p| + l_k log scale),

and in a view from c it is expected on the level ((the latter) − log |c − p|) / log scale, as long
as c lies in about the direction of the former.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section V-D.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["expect", "look", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@kernel
def look(
    points: Array,
    centers: Array,
    keyframe: Index,
    landmark: Index,
    level: Index,
    log_scale: float,
    seen: Array,
) -> None:
    """Write (M, 4): Σ (c − p)/|c − p| and the mean of log |c − p| + l log scale, NaN if unseen."""
    counts = np.zeros(len(points), np.int64)
    for m in range(len(points)):
        for j in range(4):
            seen[m, j] = 0.0
    for i in range(len(keyframe)):
        m, k = landmark[i], keyframe[i]
        x = centers[k, 0] - points[m, 0]
        y = centers[k, 1] - points[m, 1]
        z = centers[k, 2] - points[m, 2]
        r = np.sqrt(x * x + y * y + z * z)
        seen[m, 0] += x / r
        seen[m, 1] += y / r
        seen[m, 2] += z / r
        seen[m, 3] += np.log(r) + level[i] * log_scale
        counts[m] += 1
    for m in range(len(points)):
        seen[m, 3] = seen[m, 3] / counts[m] if counts[m] else np.nan


@kernel
def expect(
    points: Array,
    seen: Array,
    wanted: NDArray[np.bool_],
    T_camera_world: Array,
    pinhole: Array,
    cos_angle: float,
    log_scale: float,
    top: int,
    expected: Array,
    levels: Index,
) -> None:
    """Write where points show: u = f X/Z + c, 1/Z and the level; NaN and −1 where they do not.

    `pinhole` is fx fy cx cy width height. A level more than one step beyond the finest or the
    coarsest is too far or too near; where there is only one, levels say nothing.
    """
    T = T_camera_world
    for m in range(len(points)):
        expected[m, 0], expected[m, 1], expected[m, 2], levels[m] = np.nan, np.nan, np.nan, -1
        if not wanted[m] or not np.isfinite(seen[m, 3]):
            continue
        p = points[m]
        X = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
        Y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
        Z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
        if not Z > 0.0:
            continue
        u, v = pinhole[0] * X / Z + pinhole[2], pinhole[1] * Y / Z + pinhole[3]
        if not (0.0 <= u <= pinhole[4] - 1.0 and 0.0 <= v <= pinhole[5] - 1.0):
            continue
        # Towards the camera, in its axes, is −(X, Y, Z); the sum of directions is in the world's.
        along, total = 0.0, 0.0
        for j in range(3):
            d = T[j, 0] * seen[m, 0] + T[j, 1] * seen[m, 1] + T[j, 2] * seen[m, 2]
            along -= d * (X if j == 0 else (Y if j == 1 else Z))
            total += d * d
        r = np.sqrt(X * X + Y * Y + Z * Z)
        if along < cos_angle * r * np.sqrt(total):
            continue
        level = (seen[m, 3] - np.log(r)) / log_scale
        if top > 0 and not -1.0 <= level <= top + 1.0:
            continue
        levels[m] = min(max(int(np.floor(level + 0.5)), 0), top)
        expected[m, 0], expected[m, 1], expected[m, 2] = u, v, 1.0 / Z


def warm_up() -> None:
    """Compile the kernels of this module."""
    points, seen, rows = np.ones((2, 3)), np.zeros((2, 4)), np.zeros(1, np.int64)
    look(points, np.zeros((1, 3)), rows, rows, rows, 0.2, seen)
    shown = np.zeros((2, 3)), np.zeros(2, np.int64)
    expect(points, seen, np.ones(2, np.bool_), np.eye(4), np.ones(6), 0.5, 0.2, 7, *shown)
