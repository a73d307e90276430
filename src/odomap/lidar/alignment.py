"""Alignment: the loop that all methods share, from a first guess until nothing moves.

    x = R p + t  →  nearest target point q within reach  →  sums of weighted pairs  →  a step

The source is looked at sparsely first, every eighth point with a wide reach, then at every other
one, then whole: the first steps are large and need no precision. Weights are those of a robust loss
of s = eᵀ M e / σ², with σ from the median of the pairs one step before, so that it tightens as the
clouds meet. The loop ends where a step moves the points by less than a tolerance, as a root mean
square, across the surface where there is one.

Sums are made in blocks of 1024 points and added in order: the result is the same, bit for bit,
whether one thread does it in one call, or two share the blocks.

Cost: 0.5 µs per point and step.

Reference: S. Rusinkiewicz, M. Levoy, "Efficient variants of the ICP algorithm", 3DIM 2001.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.robust import Loss
from odomap.geometry.robust_kernels import loss_code, loss_weight
from odomap.kernels import kernel
from odomap.lidar.gicp import EPSILON, disc_metric_into
from odomap.lidar.icp import (
    COST,
    COUNT,
    SLOTS,
    add_metric,
    add_pair,
    add_plane,
    newton_step,
    pair_step,
)
from odomap.lidar.ndt import Distributions, add_cells, outlier_constant
from odomap.lidar.neighbours import Grid, nearest_kernel

__all__ = ["GICP", "ICP", "PLANE", "Aligned", "Stage", "align", "sum_pairs", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

ICP, PLANE, GICP, NDT = 0, 1, 2, 3
BLOCK = 1024
FEWEST = 6
"""Pairs below which there is nothing to align."""
MEDIANS = (2.366, 0.4549, 0.4549, 0.4549)
"""Median of χ² with as many degrees of freedom as a pair of each method mostly has."""


@dataclass(frozen=True)
class Stage:
    """How the source is looked at for some steps.

    Attributes:
        stride: every how many-th point.
        reach: farthest that a pair may be apart, metres.
        iterations: most steps.
        tolerance: the points' motion below which it is over, metres.
    """

    stride: int
    reach: float
    iterations: int
    tolerance: float


@dataclass(frozen=True, eq=False)
class Aligned:
    """Where a loop ended.

    Attributes:
        R: (3, 3) source to target. t: (3,).
        rows: (N,) target point of each source point, -1 for none, at the last step.
        iterations: steps in all stages.
        converged: whether the last stage ended below its tolerance.
    """

    R: Array
    t: Array
    rows: Index
    iterations: int
    converged: bool


@kernel
def sum_pairs(
    first: int, last: int, stride: int, method: int, p: Array, m: Array, R: Array, t: Array,
    q: Array, n: Array, start: Index, stop: Index, table: Index, size: float, reach2: float,
    loss: int, width: float, scale2: float, rows: Index, squares: Array, out: Array,
) -> None:  # fmt: skip
    """Pair points p (normals m) first … last with target points q (normals n); sum in out (32,).

    rows and squares: the target point of each, -1 for none, and eᵀ M e. For NDT q are the means of
    cells, n their Σ⁻¹, and `width` is d₂ (`ndt`).
    """
    M = np.empty(6)
    r00, r01, r02, r10, r11 = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1]
    r12, r20, r21, r22 = R[1, 2], R[2, 0], R[2, 1], R[2, 2]
    t0, t1, t2 = t[0], t[1], t[2]
    for c in range(SLOTS):
        out[c] = 0.0
    for i in range((first + stride - 1) // stride * stride, last, stride):
        x = r00 * p[i, 0] + r01 * p[i, 1] + r02 * p[i, 2]
        y = r10 * p[i, 0] + r11 * p[i, 1] + r12 * p[i, 2]
        z = r20 * p[i, 0] + r21 * p[i, 1] + r22 * p[i, 2]
        if method == NDT:
            j, s = add_cells(x, y, z, t0, t1, t2, q, n, table, size, width, out)
            rows[i], squares[i] = j, s
            if j >= 0:
                out[COST] += s
                out[COUNT] += 1.0
            continue
        j, d2 = nearest_kernel(
            x + t0, y + t1, z + t2, q, start, stop, table, size, reach2
        )  # fmt: skip
        rows[i] = j
        if j < 0:
            continue
        e0, e1, e2 = q[j, 0] - x - t0, q[j, 1] - y - t1, q[j, 2] - z - t2
        nx, ny, nz = n[j, 0], n[j, 1], n[j, 2]
        s, g0, g1, g2 = d2, e0, e1, e2
        if method == PLANE:
            r = nx * e0 + ny * e1 + nz * e2
            s = r * r
        elif method == GICP:
            a = r00 * m[i, 0] + r01 * m[i, 1] + r02 * m[i, 2]
            b = r10 * m[i, 0] + r11 * m[i, 1] + r12 * m[i, 2]
            c = r20 * m[i, 0] + r21 * m[i, 1] + r22 * m[i, 2]
            disc_metric_into(nx, ny, nz, a, b, c, M)
            g0 = M[0] * e0 + M[1] * e1 + M[2] * e2
            g1 = M[1] * e0 + M[3] * e1 + M[4] * e2
            g2 = M[2] * e0 + M[4] * e1 + M[5] * e2
            s = g0 * e0 + g1 * e1 + g2 * e2
        squares[i] = s
        w = loss_weight(loss, width, s / scale2) if loss > 0 and scale2 > 0.0 else 1.0
        if method == ICP:
            add_pair(p, q, i, j, w, out)
        elif method == PLANE:
            add_plane(x, y, z, nx, ny, nz, r, w, out)
        else:
            add_metric(
                x, y, z, w * M[0], w * M[1], w * M[2], w * M[3], w * M[4], w * M[5],
                w * g0, w * g1, w * g2, out,
            )  # fmt: skip
        out[COST] += w * s
        out[COUNT] += 1.0


@kernel
def _median(stride: int, rows: Index, squares: Array) -> float:
    """The median of the squares of paired points, to 1 %, by halving where it may be."""
    largest, count = 0.0, 0
    for i in range(0, rows.shape[0], stride):
        if rows[i] >= 0:
            largest, count = max(largest, squares[i]), count + 1
    low, high = 0.0, largest
    for _ in range(60):
        middle = np.sqrt(low * high) if low > 0.0 else 1e-3 * high
        below = 0
        for i in range(0, rows.shape[0], stride):
            if rows[i] >= 0 and squares[i] <= middle:
                below += 1
        if 2 * below < count:
            low = middle
        else:
            high = middle
        if high <= 1.01 * low or high <= 1e-24 * largest:
            break
    return high


@kernel
def _motion(xi: Array, radius: float) -> float:
    """How far a step moves the points: √(|ρ|² + r² |φ|²)."""
    moved2 = xi[0] * xi[0] + xi[1] * xi[1] + xi[2] * xi[2]
    turned2 = xi[3] * xi[3] + xi[4] * xi[4] + xi[5] * xi[5]
    return float(np.sqrt(moved2 + radius * radius * turned2))


@kernel
def _step(
    method: int, planar: bool, sums: Array, total: Array, radius: float, R: Array, t: Array,
    H: Array, xi: Array,
) -> float:  # fmt: skip
    """Add the blocks' sums in order and take the step; returns how far points move, -1 for none.

    For surfaces that is across them, √(ξᵀ H ξ / N): along a corridor points may move for nothing.
    """
    for c in range(SLOTS):
        total[c] = 0.0
        for b in range(sums.shape[0]):
            total[c] += sums[b, c]
    if total[COUNT] < FEWEST:
        return -1.0
    if method == ICP:
        if not pair_step(total, planar, R, t, xi):
            return -1.0
        return _motion(xi, radius)
    if not newton_step(total, planar, R, t, H, xi):
        return -1.0
    if method == NDT:
        return _motion(xi, radius)
    gain = 0.0
    for c in range(6):
        gain += xi[c] * total[21 + c]
    if method == GICP:
        return float(np.sqrt(max(2.0 * EPSILON * gain, 0.0) / total[COUNT]))
    return float(np.sqrt(max(gain, 0.0) / (total[0] + total[6] + total[11])))  # Σ w |n|²


@kernel
def _align(
    method: int, planar: bool, stages: Array, radius: float, p: Array, m: Array, R: Array, t: Array,
    q: Array, n: Array, start: Index, stop: Index, table: Index, size: float, loss: int,
    width: float, median: float, rows: Index, squares: Array, sums: Array,
) -> tuple[int, float]:  # fmt: skip
    """All steps of all stages; R and t are moved. Returns steps, and the last motion."""
    total, H, xi, scale2 = np.empty(SLOTS), np.empty((6, 6)), np.empty(6), 0.0
    steps, moved, count = 0, -1.0, p.shape[0]
    for stage in range(stages.shape[0]):
        stride, reach = int(stages[stage, 0]), stages[stage, 1]
        for _ in range(int(stages[stage, 2])):
            for b in range(sums.shape[0]):
                sum_pairs(
                    b * BLOCK, min((b + 1) * BLOCK, count), stride, method, p, m, R, t, q, n, start,
                    stop, table, size, reach * reach, loss, width, scale2, rows, squares, sums[b],
                )  # fmt: skip
            if loss > 0:
                scale2 = _median(stride, rows, squares) / median
            moved = _step(method, planar, sums, total, radius, R, t, H, xi)
            steps += 1
            if moved < stages[stage, 3]:
                break
    return steps, moved


def align(
    method: int,
    planar: bool,
    stages: list[Stage],
    source: tuple[Array, Array],
    target: tuple[Grid, Array] | Distributions,
    R: Array,
    t: Array,
    loss: Loss,
    threads: int = 1,
) -> Aligned:
    """Lay source points onto target points.

    Args:
        method: ICP, PLANE, GICP or NDT.
        planar: whether x, y and θ alone are free.
        stages: one after the other.
        source: points (N, 3) about their mean, and normals (N, 3).
        target: sorted points, and normals (M, 3) in the order of the grid; or, for NDT, cells.
        R: (3, 3) first guess. t: (3,).
        loss: robust loss; NDT has its own.
        threads: how many share the points.
    """
    p, m = source
    R, t = np.array(R), np.array(t)
    radius = float(np.sqrt(3.0 * np.mean(p * p))) if len(p) else 0.0
    rows, squares = np.full(len(p), -1, np.int64), np.zeros(len(p))
    sums = np.zeros((-(-len(p) // BLOCK), SLOTS))
    table = np.array([(s.stride, s.reach, s.iterations, s.tolerance) for s in stages], np.float64)
    code, width = loss_code(loss)
    surface: tuple[Any, ...]
    if isinstance(target, Distributions):
        none = np.empty(0, np.int64)
        code, width = 0, outlier_constant()
        surface = target.means, target.metrics, none, none, target.table, target.size
    else:
        grid, n = target
        surface = grid.points, n, grid.start, grid.stop, grid.table, grid.size
    arrays = p, m, R, t, *surface
    if threads > 1 and len(sums) > 1:
        steps, moved = _align_shared(
            method, planar, table, radius, arrays, code, width, rows, squares, sums, threads
        )
    else:
        rest = code, width, MEDIANS[method], rows, squares, sums
        steps, moved = _align(method, planar, table, radius, *arrays, *rest)
    return Aligned(R, t, rows, steps, 0.0 <= moved < stages[-1].tolerance)


def _align_shared(
    method: int, planar: bool, stages: Array, radius: float, arrays: Any, code: int,
    width: float, rows: Index, squares: Array, sums: Array, threads: int,
) -> tuple[int, float]:  # fmt: skip
    """Take the same steps with the blocks of each shared among threads."""
    p, R, t = arrays[0], arrays[2], arrays[3]
    add: Any = sum_pairs
    total, H, xi, scale2 = np.empty(SLOTS), np.empty((6, 6)), np.empty(6), 0.0
    steps, moved = 0, -1.0
    shares = np.array_split(np.arange(len(sums)), threads)

    def work(share: Index, stride: int, reach2: float) -> None:
        for b in share.tolist():
            add(
                b * BLOCK, min((b + 1) * BLOCK, len(p)), stride, method, *arrays, reach2, code,
                width, scale2, rows, squares, sums[b],
            )  # fmt: skip

    with ThreadPoolExecutor(threads - 1) as pool:
        for stride, reach, iterations, tolerance in stages.tolist():
            for _ in range(int(iterations)):
                others = [pool.submit(work, s, int(stride), reach * reach) for s in shares[1:]]
                work(shares[0], int(stride), reach * reach)
                for other in others:
                    other.result()
                if code > 0:
                    scale2 = _median(int(stride), rows, squares) / MEDIANS[method]
                moved = _step(method, planar, sums, total, radius, R, t, H, xi)
                steps += 1
                if moved < tolerance:
                    break
    return steps, moved


def warm_up() -> None:
    """Compile the kernels of this file."""
    points = np.array([[x, y, x * y] for x in range(3) for y in range(3)], np.float64)
    grid = Grid.of(points, 1.0)
    normals = np.zeros((9, 3))
    for threads in (1, 2):
        align(
            GICP, False, [Stage(1, 1.0, 1, 0.0)], (points, normals), (grid, normals), np.eye(3),
            np.zeros(3), Loss(), threads,
        )  # fmt: skip
