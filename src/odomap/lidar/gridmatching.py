"""Matching a scan to a grid: the pose at which its points lie on what is occupied.

A cell with evidence l for it is occupied to the degree m = max(l, 0) / l_max; cells known to be
free and cells not known are not. Between the cells' middles m is a cubic surface with slopes,

    min_x  Σ_i (1 - m(T_x p_i))² / σ²  +  (x - x̂)ᵀ Λ (x - x̂),      x = (x, y, θ),

by Gauss-Newton from a pose a few cells off. What is predicted, x̂ with information Λ, keeps the pose
where walls do not say enough, as along a corridor. That cells of one wall differ says nothing of
the way along it: of the slope at a point only what is across its surface counts, ∇m ← n nᵀ ∇m. So
the Hessian H, what the scan says, is small in that direction; and as normals are a little off, by
σ_n, n nᵀ seems to say σ_n² t tᵀ along the surface, too, which is taken off again. A wall is known
by its cells, and may be anywhere in them, the same for all points on it: with D of a quarter of a
cell, the information is (H⁻¹ + D)⁻¹. Where a grid keeps the means μ of points in its cells, the
last steps are from points to lines, min Σ ρ(nᵀ(T_x p_i - μ) / σ) + ..., and D is a part of that.

Cost: 16 cells for each point and step.

Reference: S. Kohlbrecher et al., "A flexible and scalable SLAM system with full 3D motion
estimation", SSRR 2011; R. Keys, "Cubic convolution interpolation", IEEE ASSP 29(6), 1981.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.lidar.grid import Cells, Hits, OccupancyGrid
from odomap.lidar.scans import ScanPoints

__all__ = ["GridMatch", "lay_on_grid", "match_to_grid"]

Array = NDArray[np.float64]

SIGMA = 0.5
"""Standard deviation of 1 - m where a point lies on a wall."""
ON_WALL = 0.03
"""Least m of a point that lies on one: a single hit is enough."""
IN_COMMON = 0.25, 0.002
"""Standard deviation of what all points of a scan are off by together: in cells, in radians."""
LINE = 0.02
"""Standard deviation of a point across the line through the mean of a cell, metres."""
OFF_LINE = 3.0
"""How many of these off it counts half: it may be of another surface."""
IN_COMMON_LINES = 0.05, 0.0006
"""What all points of a scan are off by together then: in cells, in radians."""
NOTHING = np.float32(0.0)
NORMAL = 0.05
"""Standard deviation of a normal, radians."""
REFINED = 6
STEPS = 20
LONGEST = 2.0, 0.1
"""Most that a step may be: in cells, in radians."""
ENOUGH, FINE = (5e-3, 2e-5), (1e-3, 1e-6)
"""What a step may be to be the last: in cells, in radians; and where places in cells are known."""


@dataclass(frozen=True, eq=False)
class GridMatch:
    """How a scan lies in a grid.

    Attributes:
        x_grid_body: (3,) x, y, heading of the body in the grid, metres and radians.
        information: (3, 3) of what the scan says, without the prediction; tangent (x, y, heading)
            of the body, right update.
        score: mean m of its points, 0 to 1.
        on_walls: share of its points that lie on what is occupied.
    """

    x_grid_body: Array
    information: Array
    score: float
    on_walls: float


def match_to_grid(
    grid: OccupancyGrid,
    points_body: Array,
    normals_body: Array,
    x_guess: Array,
    information: Array | None = None,
    x_predicted: Array | None = None,
    weights: Array | None = None,
) -> GridMatch:
    """Lay a scan onto a grid.

    Args:
        grid: what is known.
        points_body: (N, 2), one at least, metres.
        normals_body: (N, 2) of unit length across the surface there; zero where it has none.
        x_guess: (3,) x, y, heading of the body in the grid, to begin with.
        information: (3, 3) of a prediction, tangent as that of the result; None says nothing.
        x_predicted: (3,) what is predicted; default the guess.
        weights: (N,) how much points without a normal say; default 1.
    """
    x = np.array(x_guess, float)
    expected = np.array(x if x_predicted is None else x_predicted, float)
    turned = _turn(expected[2])
    prior = np.zeros((3, 3)) if information is None else turned @ information @ turned.T
    H, slide, said = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(2)
    place = grid.origin, grid.resolution, grid.evidence.limit
    seen = points_body, normals_body
    weights = np.ones(len(points_body)) if weights is None else weights
    match_kernel(grid.log_odds, *place, *seen, weights, expected, prior, x, H, slide, said)
    common = IN_COMMON
    if grid.hits is not None:
        cells = grid.log_odds, grid.hits, grid.origin, grid.resolution
        refine_kernel(*cells, *seen, expected, prior, x, H, slide)
        common = IN_COMMON_LINES
    x, root = _without_slide(x, expected, H, slide)
    information = _with_cells(_turn(x[2]).T @ root, grid.resolution, common)
    return GridMatch(x, information, *(said / len(points_body)))


def lay_on_grid(
    scan: ScanPoints,
    grid: OccupancyGrid,
    x_guess: Array,
    information: Array | None = None,
    x_predicted: Array | None = None,
) -> GridMatch:
    """Lay a scan onto a grid; arguments and result as those of `match_to_grid`."""
    guess = x_guess, information, x_predicted
    return match_to_grid(grid, scan.hits, scan.normals, *guess, weights=scan.weights)


def _with_cells(root: Array, resolution: float, common: tuple[float, float]) -> Array:
    """(H⁻¹ + D)⁻¹ = R (I + Rᵀ D R)⁻¹ Rᵀ of H = R Rᵀ, which need not be regular."""
    sigma = np.array([[common[0] * resolution], [common[0] * resolution], [common[1]]])
    inside = np.linalg.inv(np.linalg.cholesky(np.eye(3) + (sigma * root).T @ (sigma * root)))
    half = root @ inside.T
    return np.asarray(half @ half.T)


def _without_slide(x: Array, expected: Array, H: Array, slide: Array) -> tuple[Array, Array]:
    """Return the pose, and R of H = R Rᵀ, without what errors of normals say along surfaces.

    With H v = λ S v, S what a scan would say were all its normals turned by a right angle, errors
    of normals make up σ² of each λ. Errors in the variables of a regression pull what it finds by
    the share they have in these; where they are all there is, what is expected stays.
    """
    factor = np.linalg.cholesky(slide + (1e-6 * np.trace(H) + 1e-9) * np.eye(3))
    inverse = np.linalg.inv(factor)
    values, axes = np.linalg.eigh(inverse @ H @ inverse.T)
    true = np.maximum(values - NORMAL**2, 0.0)
    off = x - expected
    off[2] -= 2.0 * np.pi * np.round(off[2] / (2.0 * np.pi))
    share = true / np.maximum(values, NORMAL**2)
    kept = inverse.T @ axes @ (share * (axes.T @ (factor.T @ off)))
    return expected + kept, np.asarray(factor @ axes * np.sqrt(true))


def _turn(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@kernel(reorder=True)
def cubic(t: float) -> tuple[float, float, float, float]:
    """Weights of the four values around, at 0 ≤ t < 1 from the second."""
    first, second = ((-0.5 * t + 1.0) * t - 0.5) * t, (1.5 * t - 2.5) * t * t + 1.0
    return first, second, ((-1.5 * t + 2.0) * t + 0.5) * t, (0.5 * t - 0.5) * t * t


@kernel(reorder=True)
def cubic_slope(t: float) -> tuple[float, float, float, float]:
    """Weights of the same four in the slope there."""
    first, second = (-1.5 * t + 2.0) * t - 0.5, (4.5 * t - 5.0) * t
    return first, second, (-4.5 * t + 4.0) * t + 0.5, (1.5 * t - 1.0) * t


@kernel(reorder=True)
def between_cells(
    cells: Cells, width: int, height: int, u: float, v: float
) -> tuple[float, float, float]:
    """max(l, 0) and its slopes along x and y, at (u, v) from the middle of the first; 0 outside."""
    column, row = int(np.floor(u)), int(np.floor(v))
    w, w_y = cubic(u - column), cubic(v - row)
    d, d_y = cubic_slope(u - column), cubic_slope(v - row)
    value, x, y = 0.0, 0.0, 0.0
    if 0 < column < width - 2 and 0 < row < height - 2:
        at = (row - 1) * width + column - 1
        for k in range(4):
            along, slope = 0.0, 0.0
            for j in range(4):
                occupied = max(cells[np.uint64(at + j)], NOTHING)  # unsigned: none is below 0
                along += w[j] * occupied
                slope += d[j] * occupied
            value += w_y[k] * along
            x += w_y[k] * slope
            y += d_y[k] * along
            at += width
        return value, x, y
    for k in range(max(0, 1 - row), min(4, height + 1 - row)):
        for j in range(max(0, 1 - column), min(4, width + 1 - column)):
            occupied = max(cells[(row - 1 + k) * width + column - 1 + j], NOTHING)
            value += w_y[k] * w[j] * occupied
            x += w_y[k] * d[j] * occupied
            y += d_y[k] * w[j] * occupied
    return value, x, y


@kernel
def solve_step(H: Array, g: Array, step: Array) -> bool:
    """H step = -g by Cholesky, 3 x 3."""
    a = np.sqrt(H[0, 0])
    if not a > 0.0:
        return False
    b, c = H[0, 1] / a, H[0, 2] / a
    d2 = H[1, 1] - b * b
    if not d2 > 1e-12 * H[1, 1]:
        return False
    d = np.sqrt(d2)
    e = (H[1, 2] - b * c) / d
    f2 = H[2, 2] - c * c - e * e
    if not f2 > 1e-12 * H[2, 2]:
        return False
    f = np.sqrt(f2)
    u = -g[0] / a
    v = (-g[1] - b * u) / d
    w = (-g[2] - c * u - e * v) / f
    step[2] = w / f
    step[1] = (v - e * step[2]) / d
    step[0] = (u - b * step[1] - c * step[2]) / a
    return True


@kernel
def add_square(H: Array, t_x: float, t_y: float, p_x: float, p_y: float, w: float) -> None:
    """H ← H + w J Jᵀ of a point p that moves along t."""
    turn = t_y * p_x - t_x * p_y
    H[0, 0] += w * t_x * t_x
    H[0, 1] += w * t_x * t_y
    H[0, 2] += w * t_x * turn
    H[1, 1] += w * t_y * t_y
    H[1, 2] += w * t_y * turn
    H[2, 2] += w * turn * turn
    H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]


@kernel(reorder=True)
def match_kernel(
    log_odds: Cells,
    origin: Array,
    resolution: float,
    limit: float,
    points: Array,
    normals: Array,
    weights: Array,
    x_guess: Array,
    prior: Array,
    x: Array,
    H: Array,
    slide: Array,
    said: Array,
) -> None:
    """x ← argmin Σ (1 - m(T_x p))² / σ² + |x - x̂|²_Λ; H of the sum, and as it would be along the
    surfaces; Σ m, points on walls."""
    g, A, b, step = np.empty(3), np.empty((3, 3)), np.empty(3), np.zeros(3)
    (height, width), cells = log_odds.shape, log_odds.reshape(-1)
    for n in range(STEPS + 1):
        c, s = np.cos(x[2]), np.sin(x[2])
        H[:], slide[:], g[:], said[:] = 0.0, 0.0, 0.0, 0.0
        for i in range(len(points)):
            p_x, p_y = c * points[i, 0] - s * points[i, 1], s * points[i, 0] + c * points[i, 1]
            u = (x[0] + p_x - origin[0]) / resolution - 0.5
            v = (x[1] + p_y - origin[1]) / resolution - 0.5
            m, m_x, m_y = between_cells(cells, width, height, u, v)
            m, m_x, m_y = m / limit, m_x / (limit * resolution), m_y / (limit * resolution)
            n_x, n_y = c * normals[i, 0] - s * normals[i, 1], s * normals[i, 0] + c * normals[i, 1]
            if n_x != 0.0 or n_y != 0.0:
                across = m_x * n_x + m_y * n_y
                m_x, m_y = across * n_x, across * n_y
                add_square(slide, -across * n_y, across * n_x, p_x, p_y, 1.0 / SIGMA**2)
            said[0] += m
            said[1] += m > ON_WALL
            add_square(H, m_x, m_y, p_x, p_y, weights[i])
            g[0] -= weights[i] * m_x * (1.0 - m)
            g[1] -= weights[i] * m_y * (1.0 - m)
            g[2] -= weights[i] * (m_y * p_x - m_x * p_y) * (1.0 - m)
        for k in range(3):
            b[k] = g[k] / SIGMA**2
            for j in range(3):
                H[k, j] /= SIGMA**2
                A[k, j] = H[k, j] + prior[k, j]
                off = x[j] - x_guess[j]
                if j == 2:
                    off -= 2.0 * np.pi * np.round(off / (2.0 * np.pi))
                b[k] += prior[k, j] * off
        if n == STEPS or not solve_step(A, b, step):
            return
        length = np.hypot(step[0], step[1]) / resolution
        share = min(1.0, LONGEST[0] / max(length, 1e-12), LONGEST[1] / max(abs(step[2]), 1e-12))
        if length < ENOUGH[0] and abs(step[2]) < ENOUGH[1]:
            return
        for k in range(3):
            x[k] += share * step[k]


@kernel
def nearest_mean(
    log_odds: Cells, hits: Hits, u: float, v: float, column: int, row: int, mean: Array
) -> bool:
    """mean ← that of the occupied cell beside (column, row) that is nearest to (u, v), in cells."""
    best = 2.0 * 2.0
    for y in range(max(row - 1, 0), min(row + 2, log_odds.shape[0])):
        for x in range(max(column - 1, 0), min(column + 2, log_odds.shape[1])):
            if log_odds[y, x] <= 0.0 or hits[y, x, 2] <= 0.0:
                continue
            count = float(hits[y, x, 2])
            m_x, m_y = x + hits[y, x, 0] / count, y + hits[y, x, 1] / count
            apart = (m_x - u) ** 2 + (m_y - v) ** 2
            if apart < best:
                best, mean[0], mean[1] = apart, m_x, m_y
    return best < 4.0


@kernel
def refine_kernel(
    log_odds: Cells,
    hits: Hits,
    origin: Array,
    resolution: float,
    points: Array,
    normals: Array,
    x_predicted: Array,
    prior: Array,
    x: Array,
    H: Array,
    slide: Array,
) -> None:
    """x ← argmin Σ ρ(nᵀ(T_x p - μ)/σ) + |x - x̂|²_Λ, where p has a normal; H of the sum, and as it
    would be along the surfaces."""
    b, A, step, mean = np.empty(3), np.empty((3, 3)), np.zeros(3), np.zeros(2)
    J = np.empty(3)
    for _ in range(REFINED):
        c, s = np.cos(x[2]), np.sin(x[2])
        H[:], slide[:], b[:] = 0.0, 0.0, 0.0
        for i in range(len(points)):
            n_x, n_y = c * normals[i, 0] - s * normals[i, 1], s * normals[i, 0] + c * normals[i, 1]
            if n_x == 0.0 and n_y == 0.0:
                continue
            p_x, p_y = c * points[i, 0] - s * points[i, 1], s * points[i, 0] + c * points[i, 1]
            u, v = (x[0] + p_x - origin[0]) / resolution, (x[1] + p_y - origin[1]) / resolution
            if not nearest_mean(log_odds, hits, u, v, int(np.floor(u)), int(np.floor(v)), mean):
                continue
            off = (n_x * (u - mean[0]) + n_y * (v - mean[1])) * resolution
            w = 1.0 / (1.0 + (off / (OFF_LINE * LINE)) ** 2) / LINE**2
            J[0], J[1], J[2] = n_x, n_y, n_y * p_x - n_x * p_y
            for k in range(3):
                b[k] += w * J[k] * off
                for j in range(3):
                    H[k, j] += w * J[k] * J[j]
            add_square(slide, -n_y, n_x, p_x, p_y, w)
        for k in range(3):
            for j in range(3):
                A[k, j] = H[k, j] + prior[k, j]
                apart = x[j] - x_predicted[j]
                if j == 2:
                    apart -= 2.0 * np.pi * np.round(apart / (2.0 * np.pi))
                b[k] += prior[k, j] * apart
            A[k, k] += 1e-6
        if not solve_step(A, b, step):
            return
        for k in range(3):
            x[k] += step[k]
        if np.hypot(step[0], step[1]) < FINE[0] * resolution and abs(step[2]) < FINE[1]:
            return


def warm_up() -> None:
    """Compile the kernels of this module."""
    grid = OccupancyGrid(0.1, keeps_hits=True)
    points = np.array([[0.3, 0.1], [0.3, -0.1]])
    grid.insert(np.zeros(2), points)
    for each in (grid, grid.finished()):
        match_to_grid(each, points, np.array([[1.0, 0.0], [0.0, 0.0]]), np.zeros(3), np.eye(3))
