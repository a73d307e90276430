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
from odomap.vision.hamming import CELL_PX, fill_cells, search_circles

__all__ = ["expect", "look", "refind", "stand_apart", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Keypoints = NDArray[np.float32]
Levels = NDArray[np.uint8]
Words = NDArray[np.uint64]


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


@kernel
def refind(
    searched: Index,
    newest: int,
    keypoint_of: Index,
    points: Array,
    seen: Array,
    looks: Words,
    Ts_camera_world: Array,
    pinhole: Array,
    cos_angle: float,
    log_scale: float,
    reach: Array,
    first: Index,
    keypoints: Keypoints,
    levels: Levels,
    descriptors: Words,
    ratio: float,
    limit: int,
    hits: Index,
    shown: Array,
) -> int:
    """Look for landmarks in keyframes by `expect` and `search_circles`; return how many hit.

    In the newest keyframe for all that it does not see, in others for what the newest sees and they
    do not. Keypoints of keyframe k are the rows first[k] up to first[k + 1]; `reach` is the radius
    on each level. Written are keyframe, landmark and keypoint, and u v 1/Z as expected.
    """
    M, top, found = len(points), len(reach) - 1, 0
    wanted, level, matches = np.empty(M, np.bool_), np.empty(M, np.int64), np.empty(M, np.int64)
    lowest, highest = np.empty(M, np.int64), np.empty(M, np.int64)
    expected, guess, radius = np.empty((M, 3)), np.empty((M, 2)), np.empty(M)
    cols, rows = int(pinhole[4] / CELL_PX) + 1, int(pinhole[5] / CELL_PX) + 1
    start, order = np.empty(rows * cols + 1, np.int64), np.empty(len(keypoints), np.int64)
    for k in searched:
        for m in range(M):
            own = keypoint_of[newest, m] >= 0
            wanted[m] = not own if k == newest else own and keypoint_of[k, m] < 0
        T = Ts_camera_world[k]
        expect(points, seen, wanted, T, pinhole, cos_angle, log_scale, top, expected, level)
        for m in range(M):
            guess[m, 0], guess[m, 1] = expected[m, 0], expected[m, 1]
            radius[m], matches[m] = reach[max(level[m], 0)], -1
            lowest[m], highest[m] = max(level[m] - 1, 0), min(level[m] + 1, top)
        here, there = first[k], first[k + 1]
        fill_cells(keypoints[here:there], cols, start, order)
        search_circles(
            looks,
            guess,
            radius,
            lowest,
            highest,
            descriptors[here:there],
            keypoints[here:there],
            levels[here:there],
            start,
            order,
            cols,
            ratio,
            limit,
            matches,
        )
        for m in range(M):
            if matches[m] >= 0:
                hits[found, 0], hits[found, 1], hits[found, 2] = k, m, matches[m]
                for j in range(3):
                    shown[found, j] = expected[m, j]
                found += 1
    return found


@kernel
def _apart_in_view(p: Array, q: Array, T: Array, pinhole: Array) -> float:
    """Pixels between the projections of two points, NaN where one lies behind the camera."""
    total = 0.0
    pz = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
    qz = T[2, 0] * q[0] + T[2, 1] * q[1] + T[2, 2] * q[2] + T[2, 3]
    if not (pz > 0.0 and qz > 0.0):
        return np.nan
    for axis in range(2):
        here = T[axis, 0] * p[0] + T[axis, 1] * p[1] + T[axis, 2] * p[2] + T[axis, 3]
        there = T[axis, 0] * q[0] + T[axis, 1] * q[1] + T[axis, 2] * q[2] + T[axis, 3]
        total += (pinhole[axis] * (here / pz - there / qz)) ** 2
    return float(np.sqrt(total))


@kernel
def stand_apart(
    pairs: Index,
    keypoint_of: Index,
    first: Index,
    keypoints: Keypoints,
    levels: Levels,
    noise: Array,
    points: Array,
    Ts_camera_world: Array,
    pinhole: Array,
    apart: NDArray[np.bool_],
) -> None:
    """Say of pairs of landmarks whether a keyframe sees both, and they project apart as well.

    Apart is further than noise[l] pixels, l the coarser of the two levels. A point behind a camera
    that sees it is no evidence that the two are one.
    """
    for i in range(len(pairs)):
        a, b = pairs[i, 0], pairs[i, 1]
        apart[i] = False
        for k in range(len(keypoint_of)):
            if keypoint_of[k, a] < 0 or keypoint_of[k, b] < 0:
                continue
            r, s = first[k] + keypoint_of[k, a], first[k] + keypoint_of[k, b]
            dx, dy = keypoints[r, 0] - keypoints[s, 0], keypoints[r, 1] - keypoints[s, 1]
            least = noise[max(levels[r], levels[s])]
            if not np.sqrt(dx * dx + dy * dy) > least:
                continue
            if not _apart_in_view(points[a], points[b], Ts_camera_world[k], pinhole) <= least:
                apart[i] = True
                break


def warm_up() -> None:
    """Compile the kernels of this module."""
    points, seen, rows = np.ones((2, 3)), np.zeros((2, 4)), np.zeros(1, np.int64)
    look(points, np.zeros((1, 3)), rows, rows, rows, 0.2, seen)
    shown = np.zeros((2, 3)), np.zeros(2, np.int64)
    expect(points, seen, np.ones(2, np.bool_), np.eye(4), np.ones(6), 0.5, 0.2, 7, *shown)
    keypoint_of, words, Ts = (
        np.zeros((1, 2), np.int64),
        np.zeros((2, 4), np.uint64),
        np.eye(4)[None],
    )
    first, keypoints, levels = np.array([0, 2]), np.zeros((2, 2), np.float32), np.zeros(2, np.uint8)
    scene = (0, keypoint_of, points, seen, words, Ts, np.ones(6), 0.5, 0.2, np.ones(8))
    hits, pairs, apart = (
        np.empty((2, 3), np.int64),
        np.zeros((1, 2), np.int64),
        np.zeros(1, np.bool_),
    )
    refind(rows, *scene, first, keypoints, levels, words, 0.8, 64, hits, np.empty((2, 3)))
    views = (keypoint_of, first, keypoints, levels, np.ones(8), points, Ts, np.ones(6))
    stand_apart(pairs, *views, apart)
