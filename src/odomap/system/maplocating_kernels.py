"""Where landmarks of the local map should show in a frame, and how sure a match is.

A landmark p, seen before along the mean direction n from the distance d on the level l, is expected
in a camera (R, t) at u = f X/Z + c, (X, Y, Z) = R p + t, if it lies ahead and in the image, if
n is within 60 degrees of R p + t, and on the level

    l + log(d / |R p + t|) / log(scale).

Its depth is known to a fraction ε only, along the ray n. That moves the projection by

    slide = f ε d |(R n)_xy − (X/Z, Y/Z) (R n)_z| / Z,

which adds to the noise σ s^l of the keypoint it was matched to.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section V-D.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["foresee", "warm_up", "weigh"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

NEAREST = 0.05
"""Nothing nearer in front of the camera is looked for, metres."""
LEAST_DEPTH = 1e-6
"""Depth that a match has at least, so that nothing is divided by zero."""


@kernel
def foresee(
    points: Array,
    normals: Array,
    distance: Array,
    level: NDArray[np.uint8],
    rows: Index,
    T: Array,
    pinhole: Array,
    limits: Array,
    levels: int,
    shown: Index,
    points_camera: Array,
    pixels: Array,
    predicted: Index,
) -> int:
    """Write the rows that should show, (X, Y, Z), u and the level; return how many there are.

    T is T_camera_world, `pinhole` fx fy cx cy width height, `limits` the margin in pixels, the
    least cosine between n and the ray, and log(scale).
    """
    right, bottom = pinhole[4] - 1.0 - limits[0], pinhole[5] - 1.0 - limits[0]
    found = 0
    for i in range(len(rows)):
        m = rows[i]
        p, n = points[m], normals[m]
        Z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
        if not Z > NEAREST:
            continue
        X = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
        Y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
        u, v = X / Z * pinhole[0] + pinhole[2], Y / Z * pinhole[1] + pinhole[3]
        if not (limits[0] <= u <= right and limits[0] <= v <= bottom):
            continue
        away = np.sqrt(X * X + Y * Y + Z * Z)
        along = 0.0
        for j in range(3):
            q = T[j, 0] * n[0] + T[j, 1] * n[1] + T[j, 2] * n[2]
            along += q * (X if j == 0 else (Y if j == 1 else Z))
        if not along > limits[1] * away:
            continue
        at = level[m] + np.log(distance[m] / away) / limits[2]
        if not (-1.5 < at < levels + 0.5):
            continue
        shown[found], predicted[found] = m, min(max(int(np.rint(at)), 0), levels - 1)
        points_camera[found, 0], points_camera[found, 1], points_camera[found, 2] = X, Y, Z
        pixels[found, 0], pixels[found, 1] = u, v
        found += 1
    return found


@kernel
def weigh(
    points: Array,
    normals: Array,
    distance: Array,
    relative: Array,
    rows: Index,
    T: Array,
    pinhole: Array,
    keypoints: NDArray[np.float32],
    levels: NDArray[np.uint8],
    found: Index,
    sigma: Array,
    places: Array,
    xy: Array,
    weights: Array,
) -> None:
    """Write the places of matched landmarks, where they were seen at z = 1, and (f/σ, 1).

    T is T_camera_world, `pinhole` begins with fx fy cx cy, `sigma` holds σ s^l of each level.
    """
    for i in range(len(rows)):
        m, k = rows[i], found[i]
        p, n = points[m], normals[m]
        X = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
        Y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
        Z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
        Z = max(Z, LEAST_DEPTH)
        rx = T[0, 0] * n[0] + T[0, 1] * n[1] + T[0, 2] * n[2]
        ry = T[1, 0] * n[0] + T[1, 1] * n[1] + T[1, 2] * n[2]
        rz = T[2, 0] * n[0] + T[2, 1] * n[1] + T[2, 2] * n[2]
        sx, sy = rx - X / Z * rz, ry - Y / Z * rz
        error = min(relative[m], 1.0) * distance[m]
        slide = pinhole[0] * np.sqrt(sx * sx + sy * sy) * error / Z
        noise = sigma[levels[k]]
        for j in range(3):
            places[i, j] = p[j]
        xy[i, 0] = (keypoints[k, 0] - pinhole[2]) / pinhole[0]
        xy[i, 1] = (keypoints[k, 1] - pinhole[3]) / pinhole[1]
        weights[i, 0] = pinhole[0] / np.sqrt(noise * noise + slide * slide)
        weights[i, 1] = 1.0


def warm_up() -> None:
    """Compile the kernels of this module."""
    points, rows, level = np.ones((1, 3)), np.zeros(1, np.int64), np.zeros(1, np.uint8)
    seen, T, six = (points, points, np.ones(1)), np.eye(4), np.ones(6)
    pixels, made = np.ones((1, 2)), (np.ones((1, 3)), np.ones((1, 2)), np.ones((1, 2)))
    foresee(*seen, level, rows, T, six, np.ones(3), 8, rows.copy(), made[0], pixels, rows.copy())
    keypoints = np.ones((1, 2), np.float32)
    weigh(*seen, np.ones(1), rows, T, six, keypoints, level, rows, six, *made)
