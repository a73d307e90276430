"""Matching features: where a sweep's edges and planes lie on those of the map.

    x = T p  →  the voxel's plane, or the nearest around:  r = nᵀ(μ - x)
             →  the voxel's edge, or the nearest around:   e = (I - d dᵀ)(μ - x)

    min_T  Σ ρ(r² / s_v²) + Σ ρ(|e|² / s_v²),    s_v² = κ² (λ_thin + σ₀²)

by Gauss-Newton, with ρ after Geman and McClure, and κ from the median of the residuals one step
before, so that it tightens. Stages hold some directions: LeGO-LOAM finds z, roll and pitch from the
ground alone, then x, y and yaw from edges, then all from all.

What is said of the result (`degeneracy`) is not more than the map can know: points on one voxel
share its error, so that m of them count as m / (1 + m q) with q the share of the variance that they
have in common, and all share D of what is the same for the whole sweep, such as motion that was not
constant: (I⁻¹ + D)⁻¹. In directions that nothing fixes the first guess stays, and I is zero.

Cost: 0.2 µs for the shape of a feature, 0.1 µs for each and step.

Reference: J. Zhang, S. Singh, "LOAM: lidar odometry and mapping in real-time", RSS 2014; T. Shan,
B. Englot, "LeGO-LOAM", IROS 2018, section III-D.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_exp, se3_log
from odomap.kernels import kernel
from odomap.lidar.degeneracy import judge
from odomap.lidar.featuremap import AXIS, MEAN, SPREAD, VoxelShapes
from odomap.lidar.frontend import SweepMatch
from odomap.lidar.icp import COUNT, SLOTS, add_metric, add_plane, newton_step
from odomap.lidar.voxels import key_of, slot_of

__all__ = ["ALL", "EDGES", "GROUND", "PLANES", "FeatureStage", "match_features", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Kinds = NDArray[np.uint8]

EDGES, PLANES, GROUND = 1, 2, 4
"""Kinds of features, as bits."""
ALL = EDGES | PLANES | GROUND
FEWEST = 20
"""Features on the map below which nothing is known."""
KNOWN = 5
"""One in so many features must lie where something is known."""
SIGMA = 0.02
"""Standard deviation of a feature across what it lies on, metres."""
GROSS = 9.0
"""Squares of this many s² and more are of something else."""
SHARED = 0.1
"""Share of the variance that points on one voxel have in common."""
IN_COMMON = 0.002, 0.0002
"""Standard deviation of what all points of a sweep are off by together: metres, radians."""
STILL = 5e-4, 5e-5
"""What a step may be to be the last: metres, radians."""
SAME = 0.01, 5e-4
"""A step after which features lie on the shapes that they did: metres, radians."""
GLANCED = 2000
"""Features that say where to go before the last stage: more say no more."""
WIDE = 3.0
"""κ at the first step of the first stage: the guess may be off by this many s more."""


@dataclass(frozen=True)
class FeatureStage:
    """How features are matched for some steps.

    Attributes:
        kinds: bits of those that are.
        held: (x, y, z, roll, pitch, yaw) that are held, as bits 1, 2, 4, 8, 16, 32.
        reach: farthest a feature may be from the mean of what it lies on beside its voxel, in
            voxels.
        iterations: steps at most.
    """

    kinds: int = ALL
    held: int = 0
    reach: float = 1.0
    iterations: int = 10


def match_features(
    points: Array, kinds: Kinds, planes: VoxelShapes, edges: VoxelShapes, T_map_body: Array,
    stages: tuple[FeatureStage, ...], common: float = 1.0,
) -> SweepMatch:  # fmt: skip
    """Lay features onto a map.

    Args:
        points: (N, 3) as seen from the body at one instant.
        kinds: (N,) what each is: EDGES, PLANES or GROUND.
        planes: of the map. edges: of the map.
        T_map_body: (4, 4) first guess.
        stages: one after the other.
        common: factor on what all points of a sweep are off by together.
    """
    R, t = np.ascontiguousarray(T_map_body[:3, :3]), np.ascontiguousarray(T_map_body[:3, 3])
    R, t = R.copy(), t.copy()
    rows, squares = np.full(len(points), -1, np.int64), np.zeros(len(points))
    rules = [(s.kinds, s.held, s.reach * planes.voxel, s.iterations) for s in stages]
    table = np.array(rules, np.float64)
    moved = _match(
        points, kinds, table, planes.table, planes.shapes, planes.voxel, edges.table, edges.shapes,
        edges.voxel, R, t, rows, squares,
    )  # fmt: skip
    on = (rows >= 0) & (squares < GROSS)
    met = int(np.count_nonzero(on))
    # Of a place that was not seen yet nobody can say whether it fits; but some must be known.
    asked = max(int(np.count_nonzero(rows >= 0)), len(points) // KNOWN, 1)
    if met < FEWEST or not moved >= 0.0:
        reason = f"only {met} of {len(points)} edges and planes lie on what was seen before"
        return SweepMatch(T_map_body, np.zeros((6, 6)), met, asked, 0.0, False, reason)
    at = np.flatnonzero(on)
    p, e, n, spreads, own = _pairs(points[at], kinds[at], rows[at], planes, edges, R, t)
    middle = p.mean(axis=0)
    said = judge(p - middle, e, n, spreads, own, R, middle, False)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    if len(said.weak_directions):
        T = _kept(T, T_map_body, said.weak_directions, p - middle, middle)
    information = _with_common(said.information, common)
    return SweepMatch(T, information, met, asked, said.error, moved < 1.0, said.reason)


def _with_common(information: Array, common: float) -> Array:
    """(I⁻¹ + D)⁻¹ = R (1 + Rᵀ D R)⁻¹ Rᵀ of I = R Rᵀ, which need not be regular."""
    values, axes = np.linalg.eigh(information)
    root = axes * np.sqrt(np.maximum(values, 0.0))
    sigma = common * np.repeat(IN_COMMON, 3)[:, None]
    inner = np.linalg.inv(np.eye(6) + (sigma * root).T @ (sigma * root))
    return np.asarray(root @ (0.5 * (inner + inner.T)) @ root.T)


def _kept(T: Array, guess: Array, weak: Array, p: Array, middle: Array) -> Array:
    """Return T with what it says along weak directions as the guess has it.

    Of all that differ from T along these alone, it is the nearest to the guess: ξ - W c with c the
    least squares of how points move, Wᵀ K W c = Wᵀ K ξ. Tangents are about the features' mean.
    """
    shift = np.eye(4)
    shift[:3, 3] = middle
    back = np.linalg.inv(shift)
    xi = se3_log(back @ np.linalg.inv(guess) @ T @ shift)
    second = p.T @ p / len(p)
    K = np.zeros((6, 6))
    K[:3, :3], K[3:, 3:] = np.eye(3), np.trace(second) * np.eye(3) - second
    W = weak.T
    c = np.linalg.lstsq(W.T @ K @ W, W.T @ K @ xi, rcond=None)[0]
    return np.asarray(guess @ shift @ se3_exp(xi - W @ c) @ back)


def _pairs(
    points: Array, kinds: Kinds, rows: Index, planes: VoxelShapes, edges: VoxelShapes, R: Array,
    t: Array,
) -> tuple[Array, Array, Array, Array, Array]:  # fmt: skip
    """Return points, where they should be, normals, spreads and own shares for `judge`.

    An edge is two planes across one another that meet in it.
    """
    count = len(points) + int(np.count_nonzero(kinds == EDGES))
    p, e, n = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 3))
    spreads, own = np.ones((count, 5)), np.empty(count)
    met = np.zeros((2, max(len(planes.shapes), len(edges.shapes))))
    _pairs_kernel(
        points, kinds, rows, planes.shapes, edges.shapes, R, t, met, p, e, n, spreads, own
    )
    return p, e, n, spreads, own


@kernel
def _pairs_kernel(
    points: Array, kinds: Kinds, rows: Index, planes: Array, edges: Array, R: Array, t: Array,
    met: Array, p: Array, e: Array, n: Array, spreads: Array, own: Array,
) -> None:  # fmt: skip
    """Rows of `_pairs`; met: points on each plane, and on each edge."""
    for i in range(points.shape[0]):
        met[1 if kinds[i] == EDGES else 0, rows[i]] += 1.0
    k = 0
    for i in range(points.shape[0]):
        is_edge = kinds[i] == EDGES
        s = edges[rows[i]] if is_edge else planes[rows[i]]
        m = met[1 if is_edge else 0, rows[i]]
        ax, ay, az = s[AXIS], s[AXIS + 1], s[AXIS + 2]
        for side in range(2 if is_edge else 1):
            for r in range(3):
                x = R[r, 0] * points[i, 0] + R[r, 1] * points[i, 1] + R[r, 2] * points[i, 2] + t[r]
                e[k, r], p[k, r] = s[MEAN + r] - x, points[i, r]
                n[k, r] = s[AXIS + r]
            if is_edge and side == 0:  # across the edge, and level where it is not upright
                if abs(az) < 0.9:
                    ux, uy, uz = -ay, ax, 0.0
                else:
                    ux, uy, uz = 0.0, -az, ay
                size = np.sqrt(ux * ux + uy * uy + uz * uz)
                n[k, 0], n[k, 1], n[k, 2] = ux / size, uy / size, uz / size
            elif is_edge:
                bx, by, bz = n[k - 1, 0], n[k - 1, 1], n[k - 1, 2]
                n[k, 0], n[k, 1] = ay * bz - az * by, az * bx - ax * bz
                n[k, 2] = ax * by - ay * bx
            spreads[k, 0] = s[SPREAD]
            spreads[k, 1], spreads[k, 2] = s[SPREAD + 1], s[SPREAD + 2]
            spreads[k, 3] = s[SPREAD + 3]
            own[k] = SIGMA * SIGMA / (s[SPREAD + 1] + SIGMA * SIGMA) / (1.0 + SHARED * m)
            k += 1


@kernel
def _shape_at(
    x: float, y: float, z: float, table: Index, shapes: Array, size: float, reach2: float
) -> int:
    """The shape of the voxel a point is in; else of those around the one with the nearest mean."""
    i, j, k = int(np.floor(x / size)), int(np.floor(y / size)), int(np.floor(z / size))
    v = table[slot_of(key_of(i, j, k), table), 1]
    if v >= 0 and shapes[v, SPREAD] > 0.0:
        return int(v)
    best, best2 = -1, reach2
    fx, fy, fz = x - i * size, y - j * size, z - k * size
    for a in range(-1, 2):
        ex = (a * size - fx) if a > 0 else (fx if a < 0 else 0.0)
        if ex * ex >= best2:
            continue
        for b in range(-1, 2):
            ey = (b * size - fy) if b > 0 else (fy if b < 0 else 0.0)
            if ex * ex + ey * ey >= best2:
                continue
            for c in range(-1, 2):
                ez = (c * size - fz) if c > 0 else (fz if c < 0 else 0.0)
                if ex * ex + ey * ey + ez * ez >= best2:
                    continue
                v = table[slot_of(key_of(i + a, j + b, k + c), table), 1]
                if v < 0 or not shapes[v, SPREAD] > 0.0:
                    continue
                u, w, q = shapes[v, MEAN] - x, shapes[v, MEAN + 1] - y, shapes[v, MEAN + 2] - z
                d2 = u * u + w * w + q * q
                if d2 < best2:
                    best, best2 = int(v), d2
    return best


@kernel
def _meet(
    points: Array, kinds: Kinds, wanted: int, glanced: int, reach2: float, planes_table: Index,
    planes: Array, planes_size: float, edges_table: Index, edges: Array, edges_size: float,
    R: Array, t: Array, rows: Index,
) -> None:  # fmt: skip
    """rows ← the shape of each feature, or -1; of about `glanced` of them if that is not 0."""
    seen, every = 0, 1
    for i in range(points.shape[0]):
        seen += (kinds[i] & wanted) != 0
    if glanced > 0:
        every = seen // glanced + 1
    seen = 0
    for i in range(points.shape[0]):
        rows[i] = -1
        if (kinds[i] & wanted) == 0:
            continue
        seen += 1
        if seen % every != 0:
            continue
        u, v, w = points[i, 0], points[i, 1], points[i, 2]
        x = R[0, 0] * u + R[0, 1] * v + R[0, 2] * w + t[0]
        y = R[1, 0] * u + R[1, 1] * v + R[1, 2] * w + t[1]
        z = R[2, 0] * u + R[2, 1] * v + R[2, 2] * w + t[2]
        if kinds[i] == EDGES:
            rows[i] = _shape_at(x, y, z, edges_table, edges, edges_size, reach2)
        else:
            rows[i] = _shape_at(x, y, z, planes_table, planes, planes_size, reach2)


@kernel
def _sum(
    points: Array, kinds: Kinds, rows: Index, planes: Array, edges: Array, R: Array, t: Array,
    kappa2: float, squares: Array, out: Array,
) -> None:  # fmt: skip
    """Sums of H, g and how many, of features on shapes; squares: r² / (λ_thin + σ₀²)."""
    out[:] = 0.0
    for i in range(points.shape[0]):
        j = rows[i]
        if j < 0:
            continue
        u, v, w = points[i, 0], points[i, 1], points[i, 2]
        x = R[0, 0] * u + R[0, 1] * v + R[0, 2] * w
        y = R[1, 0] * u + R[1, 1] * v + R[1, 2] * w
        z = R[2, 0] * u + R[2, 1] * v + R[2, 2] * w
        is_edge = kinds[i] == EDGES
        s = edges[j] if is_edge else planes[j]
        a, b, c = s[AXIS], s[AXIS + 1], s[AXIS + 2]
        u, v, w = s[MEAN] - x - t[0], s[MEAN + 1] - y - t[1], s[MEAN + 2] - z - t[2]
        r = a * u + b * v + c * w
        variance = s[SPREAD + 1] + SIGMA * SIGMA
        square = max(u * u + v * v + w * w - r * r, 0.0) if is_edge else r * r
        squares[i] = square / variance
        root = 1.0 / (1.0 + squares[i] / (GROSS * kappa2))
        weight = root * root / variance
        out[COUNT] += 1.0
        if is_edge:
            add_metric(
                x, y, z, weight * (1.0 - a * a), -weight * a * b, -weight * a * c,
                weight * (1.0 - b * b), -weight * b * c, weight * (1.0 - c * c),
                weight * (u - r * a), weight * (v - r * b), weight * (w - r * c), out,
            )  # fmt: skip
        else:
            add_plane(x, y, z, a, b, c, r, weight, out)


@kernel
def _hold(total: Array, held: int) -> None:
    """Make H and g those of the directions that are not held."""
    if held == 0:
        return
    at = 0
    for i in range(6):
        for j in range(i, 6):
            if (held >> i) & 1 or (held >> j) & 1:
                total[at] = 1.0 if i == j else 0.0
            at += 1
        if (held >> i) & 1:
            total[21 + i] = 0.0


@kernel
def _match(
    points: Array, kinds: Kinds, stages: Array, planes_table: Index, planes: Array,
    planes_size: float, edges_table: Index, edges: Array, edges_size: float, R: Array, t: Array,
    rows: Index, squares: Array,
) -> float:  # fmt: skip
    """All steps of all stages; R and t are moved, squares left in units of κ². The last step in
    units of the smallest that counts, -1 where features are too few."""
    total, H, xi = np.empty(SLOTS), np.empty((6, 6)), np.empty(6)
    kappa2, moved, sample = WIDE * WIDE, -1.0, np.empty(points.shape[0])
    for stage in range(stages.shape[0]):
        wanted, held, reach = int(stages[stage, 0]), int(stages[stage, 1]), stages[stage, 2]
        glanced, is_new = 0 if stage == stages.shape[0] - 1 else GLANCED, True
        for step in range(int(stages[stage, 3])):
            if is_new:
                _meet(
                    points, kinds, wanted, glanced, reach * reach, planes_table, planes,
                    planes_size, edges_table, edges, edges_size, R, t, rows,
                )  # fmt: skip
            _sum(points, kinds, rows, planes, edges, R, t, kappa2, squares, total)
            if total[COUNT] < FEWEST:
                moved = -1.0
                break
            count = 0
            for i in range(points.shape[0]):
                if rows[i] >= 0:
                    sample[count] = squares[i]
                    count += 1
            kappa2 = max(np.median(sample[:count]) / 0.4549, 1.0)
            _hold(total, held)
            if not newton_step(total, False, R, t, H, xi):
                moved = -1.0
                break
            shift = np.sqrt(xi[0] ** 2 + xi[1] ** 2 + xi[2] ** 2)
            turn = np.sqrt(xi[3] ** 2 + xi[4] ** 2 + xi[5] ** 2)
            is_new = shift > SAME[0] or turn > SAME[1]
            moved = max(shift / STILL[0], turn / STILL[1])
            if moved < 1.0 and step > 0:
                break
    for i in range(points.shape[0]):
        squares[i] /= kappa2
    return moved


def warm_up() -> None:
    """Compile the kernels of this file."""
    grid = np.arange(6) / 6.0
    points = np.array([[x, y, 0.01 * x * y] for x in grid for y in grid])
    planes, edges = VoxelShapes(1.0, False, 0.1, 99), VoxelShapes(1.0, True, 0.1, 99)
    planes.insert(points)
    kinds = np.full(len(points), PLANES, np.uint8)
    match_features(points, kinds, planes, edges, np.eye(4), (FeatureStage(),))
