"""Matching features: where a sweep's edges and planes lie on those of the map.

    x = T p  →  the voxel's plane, or the nearest around:  r = nᵀ(μ - x)
             →  the voxel's edge, or the nearest around:   e = (I - d dᵀ)(μ - x)

    min_T  Σ ρ(r² / s_v²) + Σ ρ(|e|² / s_v²),    s_v² = κ² (λ_thin + σ₀²)

by Gauss-Newton, with ρ after Geman and McClure, and κ from the median of the residuals one step
before, so that it tightens; where no plane is around, that of the large voxel counts. Stages hold
some directions: LeGO-LOAM finds z, roll and pitch from the ground alone, then x, y and yaw from
edges, then all from all, from the first guess if that fits better: few edges may lead anywhere.

What is said of the result (`featurepairs`, `degeneracy`) is not more than the map can know. What
nothing fixes is held at the first guess in a second go, and of it I is zero.

Cost: 0.2 µs for the shape of a feature, 0.1 µs for each and step.

Reference: J. Zhang, S. Singh, "LOAM: lidar odometry and mapping in real-time", RSS 2014; T. Shan,
B. Englot, "LeGO-LOAM", IROS 2018, section III-D.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.lidar.degeneracy import UPPER, Certainty, holding, judge
from odomap.lidar.featuremap import AXIS, MEAN, SPREAD, VoxelShapes
from odomap.lidar.featurepairs import (
    ALL,
    EDGES,
    GROUND,
    PLANES,
    SIGMA,
    pairs_of,
    with_common,
)
from odomap.lidar.frontend import SweepMatch
from odomap.lidar.icp import COUNT, SLOTS, add_metric, add_plane, newton_step
from odomap.lidar.voxels import COARSER, FAR_AWAY, key_of, slot_of

__all__ = ["ALL", "EDGES", "GROUND", "PLANES", "FeatureStage", "match_features", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Kinds = NDArray[np.uint8]

FEWEST = 20
"""Features on the map below which nothing is known."""
KNOWN = 5
"""One in so many features must lie where something is known."""
GROSS = 9.0
"""Squares of this many s² and more are of something else."""
SEEN = 0.0015
"""Share of a motion that must be seen beyond chance: tunnels show 0.0009, KITTI's roads 0.003."""
ALONE = 3.0
"""Features that say the same of a motion, below which they may all be astray."""
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
    rules = [(s.kinds, s.held, s.reach * planes.voxel, s.iterations) for s in stages]
    seen = points, kinds, np.array(rules, np.float64), planes, edges, T_map_body
    laid = _lay(*seen, np.zeros((6, 6)))
    said = laid.said
    if said is None:
        nothing = np.zeros((6, 6))
        reason = f"only {laid.met} of {len(points)} edges and planes lie on what was seen before"
        return SweepMatch(T_map_body, nothing, laid.met, laid.asked, 0.0, False, reason)
    if len(said.weak_directions):  # it went where tilts led it
        held = _lay(*seen, _hold_of(said.weak_directions, laid))
        if held.said is not None:
            laid, said = held, max(held.said, said, key=lambda one: len(one.weak_directions))
    information = with_common(said.information, common)
    is_still = laid.moved < 1.0
    return SweepMatch(
        laid.T_map_body, information, laid.met, laid.asked, said.error, is_still, said.reason
    )


@dataclass(frozen=True, eq=False)
class _Laid:
    """Features where steps ended.

    Attributes:
        T_map_body: (4, 4).
        moved: by the last step, in units of the smallest that counts.
        met: features that lie on the map. asked: of which that can be said.
        middle: (3,) of those, in the body; weak directions are about it.
        said: how well they fix the motion; None where they are too few.
    """

    T_map_body: Array
    moved: float
    met: int
    asked: int
    middle: Array
    said: Certainty | None


def _lay(
    points: Array, kinds: Kinds, rules: Array, planes: VoxelShapes, edges: VoxelShapes,
    T_map_body: Array, hold: Array,
) -> _Laid:  # fmt: skip
    """Lay features onto a map from a first guess; hold (6, 6) is added to H."""
    T = np.array(T_map_body)
    R, t = T[:3, :3].copy(), T[:3, 3].copy()
    rows, squares = np.full(len(points), -1, np.int64), np.zeros(len(points))
    moved = _match(
        points, kinds, rules, planes.table, planes.shapes, planes.voxel, edges.table, edges.shapes,
        edges.voxel, hold[UPPER], R, t, rows, squares,
    )  # fmt: skip
    on = (rows >= 0) & (squares < GROSS)
    met = int(np.count_nonzero(on))
    # Of a place that was not seen yet nobody can say whether it fits; but some must be known.
    asked = max(int(np.count_nonzero(rows >= 0)), len(points) // KNOWN, 1)
    if met < FEWEST or not moved >= 0.0:
        return _Laid(T, moved, met, asked, np.zeros(3), None)
    T[:3, :3], T[:3, 3] = R, t
    at = np.flatnonzero(on)
    p, e, n, spreads, own = pairs_of(points[at], kinds[at], rows[at], planes, edges, R, t)
    middle = p.mean(axis=0)
    least = max(SEEN, ALONE / float(own.sum()))
    said = judge(p - middle, e, n, spreads, own, R, middle, False, least)
    return _Laid(T, moved, met, asked, middle, said)


def _hold_of(weak: Array, laid: _Laid) -> Array:
    """Return what (6, 6) is added to H for directions (K, 6) about the features' middle to be held.

    H is of turns about the body and along the axes of the map.
    """
    R = laid.T_map_body[:3, :3]
    moves = weak[:, :3] - np.cross(weak[:, 3:], laid.middle)
    return holding(np.column_stack([moves @ R.T, weak[:, 3:] @ R.T]), laid.met / SIGMA**2)


@kernel
def _shape_at(
    x: float, y: float, z: float, table: Index, shapes: Array, size: float, reach2: float
) -> int:
    """The shape of the voxel a point is in; else of those around the one with the nearest mean.

    Where there is none, that of the large voxel.
    """
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
    if best >= 0:
        return best
    size *= COARSER
    i, j, k = int(np.floor(x / size)), int(np.floor(y / size)), int(np.floor(z / size))
    v = table[slot_of(key_of(i + FAR_AWAY, j, k), table), 1]
    return int(v) if v >= 0 and shapes[v, SPREAD] > 0.0 else -1


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
def _misfit(rows: Index, squares: Array) -> float:
    """Σ min(r², what is gross at first) of features, those that lie on nothing counted as gross."""
    most, misfit = GROSS * WIDE * WIDE, 0.0
    for i in range(rows.shape[0]):
        misfit += min(squares[i], most) if rows[i] >= 0 else most
    return misfit


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
    planes_size: float, edges_table: Index, edges: Array, edges_size: float, hold: Array, R: Array,
    t: Array, rows: Index, squares: Array,
) -> float:  # fmt: skip
    """All steps of all stages; R and t are moved, squares left in units of κ². The last step in
    units of the smallest that counts, -1 where features are too few. hold (21,) is added to H."""
    total, H, xi = np.empty(SLOTS), np.empty((6, 6)), np.empty(6)
    kappa2, moved, sample = WIDE * WIDE, -1.0, np.empty(points.shape[0])
    R_0, t_0 = R.copy(), t.copy()
    for stage in range(stages.shape[0]):
        wanted, held, reach = int(stages[stage, 0]), int(stages[stage, 1]), stages[stage, 2]
        glanced, is_new = 0 if stage == stages.shape[0] - 1 else GLANCED, True
        if wanted == ALL and stage > 0 and int(stages[stage - 1, 0]) != ALL:
            misfits = np.empty(2)
            for at in range(2):
                R_at, t_at = R if at else R_0, t if at else t_0
                _meet(
                    points, kinds, ALL, GLANCED, reach * reach, planes_table, planes, planes_size,
                    edges_table, edges, edges_size, R_at, t_at, rows,
                )  # fmt: skip
                _sum(points, kinds, rows, planes, edges, R_at, t_at, kappa2, squares, total)
                misfits[at] = _misfit(rows, squares)
            if misfits[0] < misfits[1]:
                R[:], t[:], kappa2 = R_0, t_0, WIDE * WIDE
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
            for c in range(hold.shape[0]):
                total[c] += hold[c]
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
