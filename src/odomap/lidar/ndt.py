"""NDT: points against normal distributions, one per cell, without pairs of points.

The problem: nearest points jump from one to the next as a cloud moves. Let the target be cells of
which each says how its points are spread, N(μ, Σ), and look for the motion under which the source's
points are likely. The paper's score of a point, a normal density mixed with outliers and itself
approximated by a normal, is

    -d₁ exp(-½ d₂ eᵀ Σ⁻¹ e),    e = μ - T p

summed over the cell it lies in and its six neighbours, so that nothing jumps at a boundary. Each
step is Gauss-Newton of the weighted Σ w eᵀ Σ⁻¹ e with w = exp(-½ d₂ eᵀ Σ⁻¹ e): the Hessian without
its negative part, which is what keeps far starts from running away. Large cells first, small ones
then. Eigenvalues of Σ are at least a hundredth of the largest: a wall is not infinitely thin.

Cost: 0.3 µs per point and step.

Reference: P. Biber, W. Strasser, "The normal distributions transform", IROS 2003; M. Magnusson,
"The three-dimensional normal-distributions transform", thesis, Örebro 2009.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.lidar.icp import add_metric
from odomap.lidar.voxels import into_cells, key_of, mean_points, slot_of

__all__ = ["Distributions", "add_cells", "distributions", "outlier_constant", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

FEWEST = 4
"""Points from which a cell has a distribution."""
THINNEST = 0.01
"""Least eigenvalue, as a share of the largest."""
OUTLIERS = 0.55
"""Share of points that the mixture takes for outliers, the thesis' value."""
NEGLIGIBLE = 1e-3
"""Weight below which a distribution is passed over."""


@dataclass(frozen=True, eq=False)
class Distributions:
    """Cells and the normal distributions of their points.

    Attributes:
        size: side of a cell.
        table: (S, 2) key and number of each cell.
        means: (V, 3).
        metrics: (V, 6) Σ⁻¹ (xx, xy, xz, yy, yz, zz), zero where there are too few points.
    """

    size: float
    table: Index
    means: Array
    metrics: Array


def outlier_constant() -> float:
    """Return d₂ of the mixture.

    With c₁ and c₂ of the density and the outliers in a cell of unit size, so that both integrate
    to one, d₃ = -log c₂, d₁ = -log(c₁ + c₂) - d₃, d₂ = -2 log((-log(c₁ e^-½ + c₂) - d₃) / d₁).
    """
    c1, c2 = 10.0 * (1.0 - OUTLIERS), OUTLIERS
    d3 = -np.log(c2)
    d1 = -np.log(c1 + c2) - d3
    return float(-2.0 * np.log((-np.log(c1 * np.exp(-0.5) + c2) - d3) / d1))


def distributions(points: Array, size: float, planar: bool) -> Distributions:
    """Return the distributions of points (N, 3) in cells of a size."""
    cells = into_cells(points, size)
    means = np.empty((len(cells), 3))
    mean_points(cells.keys, cells.sums, size, means)
    n = cells.sums[:, 0]
    upper = np.triu_indices(3)
    C = np.zeros((len(cells), 3, 3))
    u = cells.sums[:, 1:4] / n[:, None]
    C[:, upper[0], upper[1]] = cells.sums[:, 4:] / n[:, None] - u[:, upper[0]] * u[:, upper[1]]
    C[:, upper[1], upper[0]] = C[:, upper[0], upper[1]]
    if planar:  # across the plane nothing is to be seen
        C[:, 2, 2] = np.trace(C, axis1=1, axis2=2)
    values, axes = np.linalg.eigh(C)
    values = np.maximum(values, THINNEST * values[:, 2:])
    good = (n >= FEWEST) & (values[:, 2] > 0.0)
    inverse = np.where(good[:, None], 1.0 / np.where(values > 0.0, values, 1.0), 0.0)
    M = (axes * inverse[:, None, :]) @ np.swapaxes(axes, 1, 2)
    return Distributions(size, cells.table, means, np.ascontiguousarray(M[:, upper[0], upper[1]]))


@kernel
def add_cells(
    x: float, y: float, z: float, t0: float, t1: float, t2: float, means: Array, metrics: Array,
    table: Index, size: float, constant: float, out: Array,
) -> tuple[int, float]:  # fmt: skip
    """Add the point (x, y, z) + t to the sums of `icp` for the cells around it.

    Returns the cell it fits best, -1 for none, and eᵀ Σ⁻¹ e there.
    """
    best, least, inverse = -1, np.inf, 1.0 / size
    i = int(np.floor((x + t0) * inverse))
    j = int(np.floor((y + t1) * inverse))
    k = int(np.floor((z + t2) * inverse))
    for c in range(7):
        a, b, d = 0, 0, 0
        if c == 1 or c == 2:
            a = 2 * c - 3
        elif c == 3 or c == 4:
            b = 2 * c - 7
        elif c > 4:
            d = 2 * c - 11
        v = table[slot_of(key_of(i + a, j + b, k + d), table), 1]
        if v < 0 or metrics[v, 0] == 0.0:
            continue
        e0, e1, e2 = means[v, 0] - x - t0, means[v, 1] - y - t1, means[v, 2] - z - t2
        g0 = metrics[v, 0] * e0 + metrics[v, 1] * e1 + metrics[v, 2] * e2
        g1 = metrics[v, 1] * e0 + metrics[v, 3] * e1 + metrics[v, 4] * e2
        g2 = metrics[v, 2] * e0 + metrics[v, 4] * e1 + metrics[v, 5] * e2
        s = g0 * e0 + g1 * e1 + g2 * e2
        w = np.exp(-0.5 * constant * s)
        if w < NEGLIGIBLE:
            continue
        if s < least:
            best, least = v, s
        add_metric(
            x, y, z, w * metrics[v, 0], w * metrics[v, 1], w * metrics[v, 2], w * metrics[v, 3],
            w * metrics[v, 4], w * metrics[v, 5], w * g0, w * g1, w * g2, out,
        )  # fmt: skip
    return best, least


def warm_up() -> None:
    """Compile the kernels of this file."""
    found = distributions(np.eye(3), 1.0, False)
    rest = found.means, found.metrics, found.table, 1.0, outlier_constant(), np.zeros(32)
    add_cells(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, *rest)
