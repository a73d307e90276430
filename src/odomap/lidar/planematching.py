"""Matching a sweep to surfaces: Gauss–Newton on distances from voxels' planes, robustly.

With points p of a sweep where they are seen from one instant (`deskew`), and a map of voxels with
means μ and normals n in units of their thickness (`planemap`),

    T* = argmin Σ ρ_k(r²(T p)),     r = nᵀ (μ - T p),     ρ_k(s) = k s / (k + s),

where a point belongs to the small voxel that it lies in, or if that has no plane to the large one;
at first also to the nearest beside them. ρ is Geman and McClure's; k narrows from how far the guess
may be off to what noise can do, so that what moved by itself counts for nothing in the end. Until
then a thousand points say as well where to go; and a step of millimetres changes no voxel.

H = Σ w a aᵀ, a = (n, x × n), counts each point as a witness of its own; who uses it says how many
are one. What tilts of noisy normals pretend is taken off (`degeneracy`). Tangents W of which little
is left stay as near to the guess as they can, in the metric M of how bodies move: H gets β M W
(Wᵀ M W)⁻¹ Wᵀ M. Not in that of how points move: before a wall far ahead a body that turns would go
sideways for its points to stay. An error w of a sweep stays in the map by (Σ w A a aᵀ)⁻¹ H, A being
the age of surfaces in sweeps: with x = Σ_j a_j x_j + w, errors go on by w / Σ_j j a_j.

Cost: 60 ns for the voxel of a point, 20 ns for a step; 4 to 10 steps, and 0.3 ms for what is known.

Reference: K. Koide et al., "Voxelized GICP for fast and accurate 3D point cloud registration", ICRA
2021; H. Yang et al., "Graduated non-convexity for robust spatial perception", RA-L 5(2), 2020.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.lidar.degeneracy import UPPER, holding, known_part, symmetric
from odomap.lidar.icp import COST, COUNT, SLOTS, add_metric, add_plane, newton_step
from odomap.lidar.planemap import (
    NONE,
    NORMAL,
    OLD,
    SURFACE,
    TILT,
    WHEN,
    PlaneMap,
    plane_kernel,
)
from odomap.lidar.voxels import COARSER, FAR_AWAY, key_of, slot_of

__all__ = ["PlaneMatch", "lying", "match_planes"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Flags = NDArray[np.int8]

GRAZING2 = 0.03**2
"""κ²: squared sine of the incidence at which a point counts half."""
STEPS = 20
"""Most that are taken."""
STILL = 1e-3, 2e-5
"""A step that is not one, metres and radians."""
SAME = 0.02, 5e-4
"""A step after which points belong to the voxels that they did, metres and radians."""
GLANCED = 1000
"""Points that say where to go while the search is wide: more say no more."""
DAMPED = 1e-3
"""Share of the traces of H, of places and of turns, that is added to their diagonals: where next to
nothing is seen, as of height between upright walls, a step would go anywhere."""
NARROW = 9.0
"""k in the end: three standard deviations."""
NARROWING = 0.25
"""By how much it narrows from step to step."""
FEWEST = 30
"""Points on surfaces below which nothing can be said."""
INLIER = 9.0
"""r² of points that lie on something."""
SEEN = 0.005
"""Share of a motion that must be seen across surfaces. Tunnels show 0.002, hardly ever 0.006, since
voxels are not planes; streets 0.03 and more, at first, with 16 beams, 0.008."""
ASKED = 600
"""Points that say what is known: more say no more."""
LEAST = 1e-9
"""Share of how points move that a motion moves them by at least, as turning about their line."""


@dataclass(frozen=True, eq=False)
class PlaneMatch:
    """How points lie on surfaces.

    Attributes:
        T_map_body: (4, 4).
        information: (6, 6) inverse covariance of a right update, of points that are each a witness
            of its own; zero along what is weak.
        weak: (K, 6) tangents of the body of which nothing is known.
        stays: (6, 6) what an error of a sweep like it leaves in the map, as is seen from then on.
        bends: (6, 6) how far it is off per tangent by which points are, each by its share.
        on: how many points lie on something.
        mean: their mean square, in variances.
        is_still: whether it came to rest.
    """

    T_map_body: Array
    information: Array
    weak: Array
    stays: Array
    bends: Array
    on: int
    mean: float
    is_still: bool


@kernel
def _surface(
    i: int, j: int, k: int, size: float, table: Index, keys: Index, sums: Array, flags: Flags,
    planes: Array, sigma2: float,
) -> int:  # fmt: skip
    """The voxel of a place in the table if it has a plane, else -1."""
    v = int(table[slot_of(key_of(i, j, k), table), 1])
    if v < 0:
        return -1
    if flags[v] == OLD:
        known = plane_kernel(v, keys[v], size, sums, sigma2, planes)
        flags[v] = SURFACE if known else NONE
    return v if flags[v] == SURFACE else -1


@kernel
def _voxel_of(
    x: float, y: float, z: float, size: float, table: Index, keys: Index, sums: Array,
    flags: Flags, planes: Array, sigma2: float, beside: bool,
) -> int:  # fmt: skip
    """The voxel with a plane that a point belongs to, or is beside; -1 where there is none."""
    for level in range(2):
        side, far = (size * COARSER, FAR_AWAY) if level else (size, 0)
        i, j, k = int(np.floor(x / side)) + far, int(np.floor(y / side)), int(np.floor(z / side))
        v = _surface(i, j, k, size, table, keys, sums, flags, planes, sigma2)
        if v >= 0:
            return v
    if not beside:
        return -1
    for level in range(2):
        side, far = (size * COARSER, FAR_AWAY) if level else (size, 0)
        i, j, k = int(np.floor(x / side)) + far, int(np.floor(y / side)), int(np.floor(z / side))
        nearest, least = -1, np.inf
        for face in range(6):
            step = 1 if face % 2 else -1
            a, b = i + (step if face < 2 else 0), j + (step if face // 2 == 1 else 0)
            c = k + (step if face > 3 else 0)
            v = _surface(a, b, c, size, table, keys, sums, flags, planes, sigma2)
            if v < 0:
                continue
            d_x, d_y, d_z = planes[v, 0] - x, planes[v, 1] - y, planes[v, 2] - z
            square = d_x * d_x + d_y * d_y + d_z * d_z
            if square < least:
                nearest, least = v, square
        if nearest >= 0:
            return nearest
    return -1


@kernel
def _meet_kernel(
    points: Array, every: int, R: Array, t: Array, size: float, table: Index, keys: Index,
    sums: Array, flags: Flags, planes: Array, sigma2: float, beside: bool, met: Index,
) -> None:  # fmt: skip
    """met (N,) ← the voxel that each point belongs to, or -1; of one in `every`."""
    for n in range(0, points.shape[0], every):
        x = R[0, 0] * points[n, 0] + R[0, 1] * points[n, 1] + R[0, 2] * points[n, 2] + t[0]
        y = R[1, 0] * points[n, 0] + R[1, 1] * points[n, 1] + R[1, 2] * points[n, 2] + t[1]
        z = R[2, 0] * points[n, 0] + R[2, 1] * points[n, 1] + R[2, 2] * points[n, 2] + t[2]
        met[n] = _voxel_of(
            x, y, z, size, table, keys, sums, flags, planes, sigma2, beside
        )  # fmt: skip


@kernel
def _residual(
    p: Array, plane: Array, R: Array, t: Array
) -> tuple[float, float, float, float, float, float, float, float]:
    """x = R p, n, r = nᵀ (μ - x - t), and s⁴ / (s⁴ + (κ² + (3 δ)²)²), s being the sine at which a
    beam meets the plane.

    Through leaves a beam draws a plane, its own path, which turns with the LiDAR and would hold its
    tilt; a surface is met under an angle, of more than the normal is unsure by, δ.
    """
    x = R[0, 0] * p[0] + R[0, 1] * p[1] + R[0, 2] * p[2]
    y = R[1, 0] * p[0] + R[1, 1] * p[1] + R[1, 2] * p[2]
    z = R[2, 0] * p[0] + R[2, 1] * p[1] + R[2, 2] * p[2]
    a, b, c = plane[NORMAL], plane[NORMAL + 1], plane[NORMAL + 2]
    r = a * (plane[0] - x - t[0]) + b * (plane[1] - y - t[1]) + c * (plane[2] - z - t[2])
    into = (a * x + b * y + c * z) ** 2
    along = (GRAZING2 + 9.0 * plane[TILT]) * plane[NORMAL + 3] * (x * x + y * y + z * z)
    return x, y, z, a, b, c, r, into * into / (into * into + along * along)


@kernel
def _sum_kernel(
    points: Array, met: Index, every: int, R: Array, t: Array, planes: Array, k: float,
    total: Array,
) -> int:  # fmt: skip
    """total ← H, g, Σ w r², Σ w over points; returns how many lie on something."""
    total[:] = 0.0
    on = 0
    for n in range(0, points.shape[0], every):
        v = met[n]
        if v < 0:
            continue
        x, y, z, a, b, c, r, met_well = _residual(points[n], planes[v], R, t)
        square = met_well * r * r
        w = k / (k + square)
        w *= w
        add_plane(x, y, z, a, b, c, r, w * met_well, total)
        total[COST] += w * square
        total[COUNT] += w
        if square < INLIER:
            on += 1
    return on


@kernel
def _match_kernel(
    points: Array, R: Array, t: Array, size: float, table: Index, keys: Index, sums: Array,
    flags: Flags, planes: Array, sigma2: float, wide: float, hold: Array, met: Index, total: Array,
) -> tuple[int, bool, int]:  # fmt: skip
    """R, t ← where Gauss–Newton ends; total: the sums there. How many on surfaces, still, steps.

    hold (21,) is added to H, and DAMPED of its traces. met (N,) ← the voxels that points met.
    """
    H, xi, k, on = np.empty((6, 6)), np.empty(6), max(wide, NARROW), 0
    some, is_new = points.shape[0] // GLANCED + 1, True
    for step in range(STEPS):
        beside = k > NARROW
        every = some if beside else 1
        if is_new:
            _meet_kernel(
                points, every, R, t, size, table, keys, sums, flags, planes, sigma2, beside, met
            )
        on = every * _sum_kernel(points, met, every, R, t, planes, k, total)
        if on < FEWEST and total[COUNT] < FEWEST:
            return on, False, step
        for c in range(hold.shape[0]):
            total[c] += hold[c]
        moves = DAMPED * (total[0] + total[6] + total[11])
        turns = DAMPED * (total[15] + total[18] + total[20])
        for c in (0, 6, 11):
            total[c] += moves
        for c in (15, 18, 20):
            total[c] += turns
        if not newton_step(total, False, R, t, H, xi):
            return on, False, step
        moved = np.sqrt(xi[0] ** 2 + xi[1] ** 2 + xi[2] ** 2)
        turned = np.sqrt(xi[3] ** 2 + xi[4] ** 2 + xi[5] ** 2)
        if not beside and moved < STILL[0] and turned < STILL[1]:
            return on, True, step + 1
        is_new = beside or moved > SAME[0] or turned > SAME[1]
        k = max(NARROWING * k, NARROW)
    return on, False, STEPS


@kernel
def _known_kernel(
    points: Array, met: Index, bent: Array, sweeps: float, R: Array, t: Array, planes: Array,
    sums: Array, known: Array,
) -> int:  # fmt: skip
    """known (5, SLOTS) ← sums over points, the number of which it returns.

    Of w a aᵀ, of w δ² Jᵀ (I - n nᵀ) J, of w Jᵀ J; of w a aᵀ times the age of the surface, as many
    sweeps ago as it was seen in the mean; and times the point's share of what bends the sweep. Of
    many points some are asked, and the sums are as if all were.
    """
    on, every = 0, points.shape[0] // ASKED + 1
    for n in range(0, points.shape[0], every):
        v = met[n]
        if v < 0:
            continue
        x, y, z, a, b, c, r, met_well = _residual(points[n], planes[v], R, t)
        square = met_well * r * r
        if not square < INLIER:
            continue
        w = NARROW / (NARROW + square)
        w *= w * every * met_well
        m, d = w * planes[v, NORMAL + 3], min(planes[v, TILT], 1.0)
        add_plane(x, y, z, a, b, c, 0.0, w, known[0])
        add_metric(
            x, y, z, d * (m - w * a * a), -d * w * a * b, -d * w * a * c, d * (m - w * b * b),
            -d * w * b * c, d * (m - w * c * c), 0.0, 0.0, 0.0, known[1],
        )  # fmt: skip
        add_metric(x, y, z, m, 0.0, 0.0, m, 0.0, m, 0.0, 0.0, 0.0, known[2])
        age = sweeps + 1.0 - sums[v, WHEN] / sums[v, 0]
        add_plane(x, y, z, a, b, c, 0.0, w * age, known[3])
        add_plane(x, y, z, a, b, c, 0.0, w * bent[n], known[4])
        on += 1
    return on


def match_planes(
    surfaces: PlaneMap, points: Array, bent: Array, T_map_body: Array, wide: float
) -> PlaneMatch:
    """Lay points onto surfaces.

    Args:
        surfaces: of sweeps before.
        points: (N, 3) seen from the body at one instant.
        bent: (N,) shares of a tangent, the same for all, by which they may be off.
        T_map_body: (4, 4) first guess.
        wide: how far off surfaces points may be then, standard deviations, squared.
    """
    seen = points, bent, wide
    match, hold = _match(surfaces, seen, T_map_body, np.zeros((6, 6)))
    if len(match.weak) == 6:
        return replace(match, T_map_body=T_map_body)
    if len(match.weak):  # it went where tilts led it
        match, _ = _match(surfaces, seen, T_map_body, hold)
    return match


def lying(surfaces: PlaneMap, points: Array, T_map_body: Array) -> tuple[int, float]:
    """Return how many points lie on surfaces where they are, and their mean square, in variances.

    Args:
        surfaces: of sweeps before.
        points: (N, 3) seen from the body at one instant.
        T_map_body: (4, 4) of the body.
    """
    s, total, met = surfaces, np.zeros(SLOTS), np.empty(len(points), np.int64)
    R, t = np.ascontiguousarray(T_map_body[:3, :3]), np.array(T_map_body[:3, 3])
    arrays = s.voxel, s.table, s.keys, s.sums, s.flags, s.planes, s.sigma**2
    _meet_kernel(points, 1, R, t, *arrays, False, met)
    on = _sum_kernel(points, met, 1, R, t, s.planes, NARROW, total)
    return on, float(total[COST] / max(total[COUNT], 1e-9))


def _match(
    surfaces: PlaneMap, seen: tuple[Array, Array, float], T_map_body: Array, hold: Array
) -> tuple[PlaneMatch, Array]:
    """Lay points onto surfaces with some tangents held; what is to be held, of what is weak."""
    s, (points, bent, wide) = surfaces, seen
    R, t = np.ascontiguousarray(T_map_body[:3, :3]), np.array(T_map_body[:3, 3])
    total, known, met = np.zeros(SLOTS), np.zeros((5, SLOTS)), np.full(len(points), -1)
    arrays = s.voxel, s.table, s.keys, s.sums, s.flags, s.planes, s.sigma**2
    on, is_still, _ = _match_kernel(points, R, t, *arrays, wide, hold[UPPER], met, total)
    T, turned = np.eye(4), np.zeros((6, 6))
    T[:3, :3], T[:3, 3] = R, t
    turned[:3, :3] = turned[3:, 3:] = R
    mean = float(total[COST] / max(total[COUNT], 1e-9))
    if _known_kernel(points, met, bent, float(s.sweeps), R, t, s.planes, s.sums, known) < FEWEST:
        none = np.zeros((6, 6))
        return PlaneMatch(T, none, np.eye(6), np.eye(6), none, on, mean, False), hold
    H, noise, motion, aged, bending = (symmetric(row) for row in known)
    motion += LEAST * np.diag(np.repeat([motion[0, 0], np.trace(motion[3:, 3:])], 3))
    root, weak = known_part(H - noise, noise, motion, SEEN)
    root, hold, tiny = turned.T @ root, holding(weak, motion[0, 0]), LEAST * motion
    stays = turned.T @ np.linalg.solve(aged + tiny, H + tiny) @ turned
    bends = turned.T @ np.linalg.solve(H + hold + tiny, bending) @ turned
    match = PlaneMatch(T, root @ root.T, weak @ turned, stays, bends, on, mean, is_still)
    return match, hold


def warm_up() -> None:
    """Compile the kernels of this file."""
    surfaces = PlaneMap(1.0, 0.05)
    points = np.array([[x, y, 0.01 * x * y] for x in range(7) for y in range(7)]) / 7.0
    surfaces.insert(points)
    match_planes(surfaces, points, np.zeros(len(points)), np.eye(4), 9.0)
    lying(surfaces, points, np.eye(4))
