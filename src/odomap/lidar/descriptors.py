"""Descriptors: what the surface around a point looks like from anywhere.

The problem: to find the same place in two clouds without a guess how they lie, points must be
described by what does not change with the frame. Of a point p and each neighbour q at distance d
along the unit direction u, with normals n and m, three numbers are

    |nᵀ u|,    |mᵀ u|,    |nᵀ m|

Each is counted in eleven bins of equal width; these simple histograms S of the neighbours are added
by their nearness, and each of the three parts is scaled to one:

    F(p) = S(p) + (1/k) Σ S(q) / (d / d̄)

The paper measures angles with signs in a frame that normals must point out of; without signs it
does not matter from where a cloud was seen.

Cost: O(N k), 1 µs per neighbour.

Reference: R. B. Rusu, N. Blodow, M. Beetz, "Fast point feature histograms (FPFH) for 3D
registration", ICRA 2009.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.lidar.neighbours import k_nearest

__all__ = ["BINS", "describe", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

BINS = 11


@kernel
def _simple_kernel(points: Array, normals: Array, rows: Index, out: Array) -> None:
    """Histograms of |nᵀu|, |mᵀu|, |nᵀm| over the neighbours of each point, but the point itself."""
    for i in range(points.shape[0]):
        for c in range(out.shape[1]):
            out[i, c] = 0.0
        for k in range(rows.shape[1]):
            j = rows[i, k]
            if j < 0 or j == i:
                continue
            x, y = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
            z = points[j, 2] - points[i, 2]
            d = np.sqrt(x * x + y * y + z * z)
            if not d > 0.0:
                continue
            a = (normals[i, 0] * x + normals[i, 1] * y + normals[i, 2] * z) / d
            b = (normals[j, 0] * x + normals[j, 1] * y + normals[j, 2] * z) / d
            c0 = normals[i, 0] * normals[j, 0] + normals[i, 1] * normals[j, 1]
            c0 += normals[i, 2] * normals[j, 2]
            out[i, min(int(abs(a) * BINS), BINS - 1)] += 1.0
            out[i, BINS + min(int(abs(b) * BINS), BINS - 1)] += 1.0
            out[i, 2 * BINS + min(int(abs(c0) * BINS), BINS - 1)] += 1.0


@kernel
def _gather_kernel(simple: Array, rows: Index, distances: Array, scale: float, out: Array) -> None:
    """F = S + (1/k) Σ S_j scale / d_j, each third scaled to one."""
    width = simple.shape[1]
    for i in range(simple.shape[0]):
        count = 0
        for k in range(rows.shape[1]):
            if rows[i, k] >= 0 and distances[i, k] > 0.0:
                count += 1
        for c in range(width):
            out[i, c] = simple[i, c]
        for k in range(rows.shape[1]):
            j = rows[i, k]
            if j < 0 or not distances[i, k] > 0.0:
                continue
            w = scale / (distances[i, k] * count)
            for c in range(width):
                out[i, c] += w * simple[j, c]
        for part in range(3):
            total = 0.0
            for c in range(part * BINS, (part + 1) * BINS):
                total += out[i, c]
            if total > 0.0:
                for c in range(part * BINS, (part + 1) * BINS):
                    out[i, c] /= total


def describe(points: Array, normals: Array, radius: float, k: int = 64) -> Array:
    """Return (N, 33) descriptors of points (N, 3).

    Args:
        points: (N, 3).
        normals: (N, 3) unit, of any sign.
        radius: how far around a point is looked, metres.
        k: most neighbours that are looked at.
    """
    rows, distances = k_nearest(points, points, k, radius)
    simple, out = np.empty((len(points), 3 * BINS)), np.empty((len(points), 3 * BINS))
    _simple_kernel(points, normals, rows, simple)
    _gather_kernel(simple, rows, distances, 0.5 * radius, out)
    return out


def warm_up() -> None:
    """Compile the kernels of this file."""
    describe(np.eye(3), np.eye(3), 2.0, 2)
