"""How landmarks look, one after the other: what `views` computes, in a loop over observations.

With p = S_anchor p_anchor, the rays r_k = p − c_k from the centres of the cameras that see it, and
the reference observation (the anchor's, else the oldest keyframe's),

    n = Σ_k r_k/|r_k| normalised,   d = |r_ref|,   l = the pyramid level of the reference keypoint.

A landmark that nobody sees is as if its anchor saw it, at no keypoint.

Reference: R. Mur-Artal, J. Montiel, J. Tardós, ORB-SLAM: a versatile and accurate monocular SLAM
system, 2015 (map points).
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["look_from", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

TINY = np.finfo(np.float64).tiny


@kernel
def look_from(
    anchor: Index,
    p_anchor: Array,
    indptr: Index,
    observer: Index,
    keypoint: NDArray[np.int32],
    Ts: Array,
    scales: Array,
    centers: Array,
    first: Index,
    levels: NDArray[np.uint8],
    points: Array,
    normals: Array,
    distance: Array,
    level: NDArray[np.uint8],
) -> None:
    """Write p, n, d and l of landmarks; levels of keyframe k are levels[first[k]:first[k + 1]]."""
    for i in range(len(anchor)):
        a = anchor[i]
        T, scale, q, p, n = Ts[a], scales[a], p_anchor[i], points[i], normals[i]
        for j in range(3):
            p[j] = scale * (T[j, 0] * q[0] + T[j, 1] * q[1] + T[j, 2] * q[2]) + T[j, 3]
            n[j] = 0.0
        begin, end = indptr[i], indptr[i + 1]
        reference, at = -1, -1
        for o in range(begin, max(end, begin + 1)):
            k = observer[o] if end > begin else a
            x, y, z = p[0] - centers[k, 0], p[1] - centers[k, 1], p[2] - centers[k, 2]
            length = np.sqrt(x * x + y * y + z * z)
            by = max(length, TINY)
            n[0] += x / by
            n[1] += y / by
            n[2] += z / by
            if reference < 0 or k == a or (reference != a and k < reference):
                reference, at, distance[i] = k, int(keypoint[o]) if end > begin else -1, length
        size = max(np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]), TINY)
        for j in range(3):
            n[j] /= size
        is_known = 0 <= at < first[reference + 1] - first[reference]
        level[i] = levels[first[reference] + at] if is_known else 0


def warm_up() -> None:
    """Compile the kernel of this module."""
    rows, points, one = np.zeros(1, np.int64), np.ones((1, 3)), np.ones(1)
    level, spans = np.zeros(1, np.uint8), np.array([0, 1])
    Ts, found = np.eye(4)[None], np.zeros(1, np.int32)
    seen = rows, points, spans, rows, found, Ts, one, points, spans, level
    look_from(*seen, points.copy(), points.copy(), one.copy(), level.copy())
