"""Normals: which way the surface around a point faces, and how sure that is.

The points around one are spread along the surface and hardly across it. Their covariance

    C = (1/n) Σ (p - p̄)(p - p̄)ᵀ = Σ_i λ_i v_i v_iᵀ,    λ₀ ≤ λ₁ ≤ λ₂

has the normal v₀ as the eigenvector of its smallest eigenvalue; λ₀ is the noise, λ₁ and λ₂ the
extent of what was looked at. Noise tilts the normal of n points by a variance of about

    δ²_i = λ₀ λ_i / (n (λ_i - λ₀)²)    about the axis across v_i,  i = 1, 2

which is how much of "normal" is along v_i by chance: what a corridor seems to know of its length
(`degeneracy`). Neighbours are all raw points in the 27 cells around where points were down-sampled
(26 additions instead of a search), or in 125 where those are empty, else the k nearest. In the
plane there are λ₀ and λ₁ alone.

Eigenvalues of a 3x3 matrix in closed form, the eigenvector as the longest cross product of two rows
of C - λ₀ I. Cost: 0.3 µs per point from cells, 2 µs from the ten nearest.

Reference: N. J. Mitra, A. Nguyen, "Estimating surface normals in noisy point cloud data", SoCG
2003.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.lidar.neighbours import k_nearest
from odomap.lidar.voxels import Cells, axis_of_key, into_cells, key_of, slot_of

__all__ = [
    "cell_covariances",
    "longest_cross",
    "nearest_covariances",
    "normals_of",
    "warm_up",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

FEWEST = 5
"""Points from which the cells around one say how its surface lies."""
FEWEST_CELLS = 5
"""And how many of them must be occupied: a plane fills nine."""
FEWEST_CELLS_IN_PLANE = 2
"""A wall seen in the plane fills three, two at its end."""
FAR = 16.0
"""Cells in the side of those in which the nearest of lonely points are searched."""
LINE = 0.03
"""Of λ₂: what λ₁ must exceed λ₀ by, else points lie on a line, about which any normal may turn."""


@kernel
def _around_kernel(
    which: Index, reach: int, keys: Index, sums: Array, table: Index, size: float, out: Array
) -> None:
    """Out = n, C (xx, xy, xz, yy, yz, zz), cells, p̄ - mean, own share: of cells within reach."""
    for row in range(which.shape[0]):
        cell = which[row]
        key = keys[cell]
        i, j, k = axis_of_key(key, 0), axis_of_key(key, 1), axis_of_key(key, 2)
        n, sx, sy, sz, occupied = 0.0, 0.0, 0.0, 0.0, 0.0
        xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for a in range(-reach, reach + 1):
            for b in range(-reach, reach + 1):
                for c in range(-reach, reach + 1):
                    o = table[slot_of(key_of(i + a, j + b, k + c), table), 1]
                    if o < 0:
                        continue
                    m, u, v, w = sums[o, 0], sums[o, 1], sums[o, 2], sums[o, 3]
                    x, y, z = a * size, b * size, c * size
                    n, occupied = n + m, occupied + 1.0
                    sx, sy, sz = sx + u + m * x, sy + v + m * y, sz + w + m * z
                    xx += sums[o, 4] + 2.0 * x * u + m * x * x
                    xy += sums[o, 5] + x * v + y * u + m * x * y
                    xz += sums[o, 6] + x * w + z * u + m * x * z
                    yy += sums[o, 7] + 2.0 * y * v + m * y * y
                    yz += sums[o, 8] + y * w + z * v + m * y * z
                    zz += sums[o, 9] + 2.0 * z * w + m * z * z
        sx, sy, sz = sx / n, sy / n, sz / n
        out[cell, 0], out[cell, 7] = n, occupied
        m = sums[cell, 0]
        out[cell, 8] = sx - sums[cell, 1] / m
        out[cell, 9] = sy - sums[cell, 2] / m
        out[cell, 10] = sz - sums[cell, 3] / m
        out[cell, 11] = m / n
        out[cell, 1], out[cell, 2], out[cell, 3] = (
            xx / n - sx * sx,
            xy / n - sx * sy,
            xz / n - sx * sz,
        )
        out[cell, 4], out[cell, 5], out[cell, 6] = (
            yy / n - sy * sy,
            yz / n - sy * sz,
            zz / n - sz * sz,
        )


@kernel
def _nearest_kernel(points: Array, queries: Index, rows: Index, out: Array) -> None:
    """Out = n, C, n, 0, 1 of the nearest of each query; about the query, for precision."""
    for q in range(rows.shape[0]):
        p = queries[q]
        n, sx, sy, sz = 0.0, 0.0, 0.0, 0.0
        xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for c in range(rows.shape[1]):
            o = rows[q, c]
            if o < 0:
                break
            x = points[o, 0] - points[p, 0]
            y = points[o, 1] - points[p, 1]
            z = points[o, 2] - points[p, 2]
            n, sx, sy, sz = n + 1.0, sx + x, sy + y, sz + z
            xx, xy, xz = xx + x * x, xy + x * y, xz + x * z
            yy, yz, zz = yy + y * y, yz + y * z, zz + z * z
        sx, sy, sz = sx / n, sy / n, sz / n
        out[p, 0], out[p, 7] = n, n
        out[p, 8], out[p, 9], out[p, 10], out[p, 11] = 0.0, 0.0, 0.0, 1.0
        out[p, 1], out[p, 2] = xx / n - sx * sx, xy / n - sx * sy
        out[p, 3] = xz / n - sx * sz
        out[p, 4], out[p, 5] = yy / n - sy * sy, yz / n - sy * sz
        out[p, 6] = zz / n - sz * sz


@kernel
def eigenvalues(
    a: float, b: float, c: float, d: float, e: float, f: float
) -> tuple[float, float, float]:
    """λ₀ ≤ λ₁ ≤ λ₂ of C = [[a, b, c], [b, d, e], [c, e, f]].

    λ = m + 2 p cos(φ + 2πk/3),  m = tr C / 3,  p² = |C - m I|² / 6,  φ = ⅓ acos(det(C - m I) / 2p³)
    """
    m = (a + d + f) / 3.0
    u, v, w = a - m, d - m, f - m
    p2 = (u * u + v * v + w * w + 2.0 * (b * b + c * c + e * e)) / 6.0
    p = np.sqrt(p2)
    det = u * (v * w - e * e) - b * (b * w - e * c) + c * (b * e - v * c)
    turn = 0.0
    if p2 * p > 0.0:
        turn = np.arccos(min(max(det / (2.0 * p2 * p), -1.0), 1.0)) / 3.0
    largest = m + 2.0 * p * np.cos(turn)
    least = m + 2.0 * p * np.cos(turn + 2.0 * np.pi / 3.0)
    return least, 3.0 * m - largest - least, largest


@kernel
def longest_cross(
    a: float, b: float, c: float, d: float, e: float, f: float
) -> tuple[float, float, float, float]:
    """The longest cross product of two rows of [[a, b, c], [b, d, e], [c, e, f]]; its square."""
    x0, y0, z0 = b * e - c * d, c * b - a * e, a * d - b * b
    x1, y1, z1 = b * f - c * e, c * c - a * f, a * e - b * c
    x2, y2, z2 = d * f - e * e, e * c - b * f, b * e - c * d
    n0 = x0 * x0 + y0 * y0 + z0 * z0
    n1 = x1 * x1 + y1 * y1 + z1 * z1
    n2 = x2 * x2 + y2 * y2 + z2 * z2
    if n0 >= n1 and n0 >= n2:
        return x0, y0, z0, n0
    if n1 >= n2:
        return x1, y1, z1, n1
    return x2, y2, z2, n2


@kernel
def _normal_kernel(spread: Array, planar: bool, normals: Array, tilts: Array) -> None:
    """Normals v₀ of spreads n, C, unless the points lie on a line; tilts: n (0: none), λ, share."""
    for r in range(spread.shape[0]):
        a, b, c = spread[r, 1], spread[r, 2], spread[r, 3]
        d, e, f = spread[r, 4], spread[r, 5], spread[r, 6]
        if planar:
            c, e, f = 0.0, 0.0, 4.0 * (a + d)
        least, middle, largest = eigenvalues(a, b, c, d, e, f)
        x, y, z, n2 = longest_cross(a - least, b, c, d - least, e, f - least)
        known = spread[r, 0] >= 3.0 and n2 > 0.0 and middle - least > LINE * largest
        size = 1.0 / np.sqrt(n2) if known else 0.0
        normals[r, 0], normals[r, 1], normals[r, 2] = x * size, y * size, z * size
        tilts[r, 0] = spread[r, 0] if known else 0.0
        tilts[r, 1], tilts[r, 2], tilts[r, 3] = max(least, 0.0), middle, largest
        tilts[r, 4] = spread[r, 11]


def cell_covariances(cells: Cells, means: Array, k: int, planar: bool = False) -> Array:
    """Return (V, 12) what is around each cell: number of points, their covariance, cells occupied,
    from the cell's mean to theirs, and the cell's own share of them.

    Args:
        cells: the occupied ones.
        means: (V, 3) the mean of each.
        k: how many of the nearest means are taken where too few cells are occupied around one.
        planar: whether points lie in the plane z = 0.
    """
    spread = np.empty((len(cells), 12))
    fewest = FEWEST_CELLS_IN_PLANE if planar else FEWEST_CELLS
    few = np.arange(len(cells))
    for reach in (1, 2):
        _around_kernel(few, reach, cells.keys, cells.sums, cells.table, cells.size, spread)
        few = few[(spread[few, 0] < FEWEST) | (spread[few, 7] < fewest)]
    _from_nearest(means, few, k, spread, FAR * cells.size)
    return spread


def nearest_covariances(points: Array, k: int) -> Array:
    """Return (N, 12) the same of the k nearest of each of the points (N, 3), share 1."""
    spread = np.empty((len(points), 12))
    _from_nearest(points, np.arange(len(points)), k, spread)
    return spread


def _from_nearest(points: Array, which: Index, k: int, spread: Array, size: float = 0.0) -> None:
    if len(which):
        rows, _ = k_nearest(points[which], points, k, size=size)
        _nearest_kernel(points, which, rows, spread)


def normals_of(spread: Array, planar: bool) -> tuple[Array, Array]:
    """Return unit normals (N, 3), zero where there is none; (N, 5) n, λ₀, λ₁, λ₂, own share."""
    normals, tilts = np.empty((len(spread), 3)), np.empty((len(spread), 5))
    _normal_kernel(spread, planar, normals, tilts)
    return normals, tilts


def warm_up() -> None:
    """Compile the kernels of this file."""
    points = np.eye(3)
    cells = into_cells(points, 1.0)
    normals_of(cell_covariances(cells, points, 2), False)
