"""Matching a sweep to surfaces: Gauss–Newton on distances from voxels' planes, robustly.

With points p of a sweep where they are seen from one instant (`deskew`), and a map of voxels with
means μ and normals n in units of their thickness (`planemap`),

    T* = argmin Σ ρ_k(r²(T p)),     r = nᵀ (μ - T p),     ρ_k(s) = k s / (k + s),

where a point belongs to the small voxel that it lies in, or if that has no plane to the large one;
at first also to the nearest beside them. ρ is Geman and McClure's; k narrows from how far the guess
may be off to what noise can do, so that what moved by itself counts for nothing in the end.

H = Σ w a aᵀ, a = (n, x × n), counts each point as a witness of its own; who uses it says how many
are one. What tilts of noisy normals pretend is taken off (`degeneracy`). Tangents W of which little
is left stay as near to the guess as they can, in the metric M of how bodies move: H gets β M W
(Wᵀ M W)⁻¹ Wᵀ M. Not in that of how points move: before a wall far ahead a body that turns would go
sideways for its points to stay. An error w of a sweep stays in the map by (Σ w A a aᵀ)⁻¹ H, A being
the age of surfaces in sweeps: with x = Σ_j a_j x_j + w, errors go on by w / Σ_j j a_j.

Cost: 0.25 µs a point and step, 4 to 10 steps, and 0.3 ms for what is known.

Reference: K. Koide et al., "Voxelized GICP for fast and accurate 3D point cloud registration", ICRA
2021; H. Yang et al., "Graduated non-convexity for robust spatial perception", RA-L 5(2), 2020.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.lidar.degeneracy import known_part
from odomap.lidar.icp import COST, COUNT, SLOTS, add_metric, add_plane, newton_step
from odomap.lidar.planemap import (
    COARSER,
    FAR_AWAY,
    NONE,
    OLD,
    SURFACE,
    TILT,
    WHEN,
    PlaneMap,
    plane_kernel,
)
from odomap.lidar.voxels import key_of, slot_of

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
HELD = 1e4
"""β, where a motion is seen by 1 at most."""
LEVER = 2.0
"""Metres that a body is moved as easily as it is turned by a radian."""


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
    means: Array, normals: Array, sigma2: float,
) -> int:  # fmt: skip
    """The voxel of a place in the table if it has a plane, else -1."""
    v = int(table[slot_of(key_of(i, j, k), table), 1])
    if v < 0:
        return -1
    if flags[v] == OLD:
        known = plane_kernel(v, keys[v], size, sums, sigma2, means, normals)
        flags[v] = SURFACE if known else NONE
    return v if flags[v] == SURFACE else -1


@kernel
def _voxel_of(
    x: float, y: float, z: float, size: float, table: Index, keys: Index, sums: Array,
    flags: Flags, means: Array, normals: Array, sigma2: float, beside: bool,
) -> int:  # fmt: skip
    """The voxel with a plane that a point belongs to, or is beside; -1 where there is none."""
    for level in range(2):
        side, far = (size * COARSER, FAR_AWAY) if level else (size, 0)
        i, j, k = int(np.floor(x / side)) + far, int(np.floor(y / side)), int(np.floor(z / side))
        v = _surface(i, j, k, size, table, keys, sums, flags, means, normals, sigma2)
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
            v = _surface(a, b, c, size, table, keys, sums, flags, means, normals, sigma2)
            if v < 0:
                continue
            d_x, d_y, d_z = means[v, 0] - x, means[v, 1] - y, means[v, 2] - z
            square = d_x * d_x + d_y * d_y + d_z * d_z
            if square < least:
                nearest, least = v, square
        if nearest >= 0:
            return nearest
    return -1


@kernel
def _weight(x: float, y: float, z: float, a: float, b: float, c: float, tilt2: float) -> float:
    """s⁴ / (s⁴ + (κ² + (3 δ)²)²) of a beam (x, y, z) that meets a plane (a, b, c) at a sine of s.

    Through leaves a beam draws a plane, its own path, which turns with the LiDAR and would hold its
    tilt; a surface is met under an angle, of more than the normal is unsure by, δ.
    """
    into = (a * x + b * y + c * z) ** 2
    most = (a * a + b * b + c * c) * (x * x + y * y + z * z)
    along = (GRAZING2 + 9.0 * tilt2) * most
    return float(into * into / (into * into + along * along))


@kernel
def _sum_kernel(
    points: Array, R: Array, t: Array, size: float, table: Index, keys: Index, sums: Array,
    flags: Flags, means: Array, normals: Array, sigma2: float, k: float, total: Array,
) -> int:  # fmt: skip
    """total ← H, g, Σ w r², Σ w over points; returns how many lie on something."""
    for c in range(SLOTS):
        total[c] = 0.0
    on = 0
    for n in range(points.shape[0]):
        x = R[0, 0] * points[n, 0] + R[0, 1] * points[n, 1] + R[0, 2] * points[n, 2]
        y = R[1, 0] * points[n, 0] + R[1, 1] * points[n, 1] + R[1, 2] * points[n, 2]
        z = R[2, 0] * points[n, 0] + R[2, 1] * points[n, 1] + R[2, 2] * points[n, 2]
        v = _voxel_of(
            x + t[0], y + t[1], z + t[2], size, table, keys, sums, flags, means, normals, sigma2,
            k > NARROW,
        )  # fmt: skip
        if v < 0:
            continue
        a, b, c = normals[v, 0], normals[v, 1], normals[v, 2]
        r = a * (means[v, 0] - x - t[0]) + b * (means[v, 1] - y - t[1])
        r += c * (means[v, 2] - z - t[2])
        q = np.sqrt(_weight(x, y, z, a, b, c, means[v, TILT]))
        a, b, c, r = q * a, q * b, q * c, q * r
        w = k / (k + r * r)
        w *= w
        add_plane(x, y, z, a, b, c, r, w, total)
        total[COST] += w * r * r
        total[COUNT] += w
        if r * r < INLIER:
            on += 1
    return on


@kernel
def _match_kernel(
    points: Array, R: Array, t: Array, size: float, table: Index, keys: Index, sums: Array,
    flags: Flags, means: Array, normals: Array, sigma2: float, wide: float, hold: Array,
    total: Array,
) -> tuple[int, bool, int]:  # fmt: skip
    """R, t ← where Gauss–Newton ends; total: the sums there. How many on surfaces, still, steps.

    hold (21,) is added to H, and DAMPED of its traces.
    """
    H, xi, k, on = np.empty((6, 6)), np.empty(6), max(wide, NARROW), 0
    for step in range(STEPS):
        on = _sum_kernel(
            points, R, t, size, table, keys, sums, flags, means, normals, sigma2, k, total
        )
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
        if k <= NARROW and moved < STILL[0] and turned < STILL[1]:
            return on, True, step + 1
        k = max(NARROWING * k, NARROW)
    return on, False, STEPS


@kernel
def _known_kernel(
    points: Array, bent: Array, sweeps: float, R: Array, t: Array, size: float, table: Index,
    keys: Index, sums: Array, flags: Flags, means: Array, normals: Array, sigma2: float,
    known: Array,
) -> int:  # fmt: skip
    """known (5, SLOTS) ← sums over points, the number of which it returns.

    Of w a aᵀ, of w δ² Jᵀ (I - n nᵀ) J, of w Jᵀ J; of w a aᵀ times the age of the surface, as many
    sweeps ago as it was seen in the mean; and times the point's share of what bends the sweep. Of
    many points some are asked, and the sums are as if all were.
    """
    on, every = 0, points.shape[0] // ASKED + 1
    for n in range(0, points.shape[0], every):
        # As in `_sum_kernel`: a kernel of its own for these lines made matching a third slower.
        x = R[0, 0] * points[n, 0] + R[0, 1] * points[n, 1] + R[0, 2] * points[n, 2]
        y = R[1, 0] * points[n, 0] + R[1, 1] * points[n, 1] + R[1, 2] * points[n, 2]
        z = R[2, 0] * points[n, 0] + R[2, 1] * points[n, 1] + R[2, 2] * points[n, 2]
        v = _voxel_of(
            x + t[0], y + t[1], z + t[2], size, table, keys, sums, flags, means, normals, sigma2,
            False,
        )  # fmt: skip
        if v < 0:
            continue
        a, b, c = normals[v, 0], normals[v, 1], normals[v, 2]
        r = a * (means[v, 0] - x - t[0]) + b * (means[v, 1] - y - t[1])
        r += c * (means[v, 2] - z - t[2])
        q = np.sqrt(_weight(x, y, z, a, b, c, means[v, TILT]))
        a, b, c, r = q * a, q * b, q * c, q * r
        if not r * r < INLIER:
            continue
        w = NARROW / (NARROW + r * r)
        w *= w * every
        m = w * (a * a + b * b + c * c)
        d = min(means[v, TILT], 1.0)
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
    s, total = surfaces, np.zeros(SLOTS)
    R, t = np.ascontiguousarray(T_map_body[:3, :3]), np.array(T_map_body[:3, 3])
    arrays = s.voxel, s.table, s.keys, s.sums, s.flags, s.means, s.normals, s.sigma**2
    on = _sum_kernel(points, R, t, *arrays, NARROW, total)
    return on, float(total[COST] / max(total[COUNT], 1e-9))


def _match(
    surfaces: PlaneMap, seen: tuple[Array, Array, float], T_map_body: Array, hold: Array
) -> tuple[PlaneMatch, Array]:
    """Lay points onto surfaces with some tangents held; what is to be held, of what is weak."""
    s, (points, bent, wide) = surfaces, seen
    R, t = np.ascontiguousarray(T_map_body[:3, :3]), np.array(T_map_body[:3, 3])
    total, known = np.zeros(SLOTS), np.zeros((5, SLOTS))
    arrays = s.voxel, s.table, s.keys, s.sums, s.flags, s.means, s.normals, s.sigma**2
    held = hold[np.triu_indices(6)]
    on, is_still, _ = _match_kernel(points, R, t, *arrays, wide, held, total)
    T, turned = np.eye(4), np.zeros((6, 6))
    T[:3, :3], T[:3, 3] = R, t
    turned[:3, :3] = turned[3:, 3:] = R
    mean = float(total[COST] / max(total[COUNT], 1e-9))
    if _known_kernel(points, bent, float(s.sweeps), R, t, *arrays, known) < FEWEST:
        none = np.zeros((6, 6))
        return PlaneMatch(T, none, np.eye(6), np.eye(6), none, on, mean, False), hold
    H, noise, motion, aged, bending = (_symmetric(row) for row in known)
    motion += LEAST * np.diag(np.repeat([motion[0, 0], np.trace(motion[3:, 3:])], 3))
    root, weak = known_part(H - noise, noise, motion, SEEN)
    root, hold, tiny = turned.T @ root, _holding(motion, weak), LEAST * motion
    stays = turned.T @ np.linalg.solve(aged + tiny, H + tiny) @ turned
    bends = turned.T @ np.linalg.solve(H + hold + tiny, bending) @ turned
    match = PlaneMatch(T, root @ root.T, weak @ turned, stays, bends, on, mean, is_still)
    return match, hold


def _holding(motion: Array, weak: Array) -> Array:
    """Return what (6, 6) is added to H for the tangents (K, 6) to be held."""
    if not len(weak):
        return np.zeros((6, 6))
    unlikely = motion[0, 0] * np.diag(np.repeat([1.0, LEVER**2], 3))
    moved = unlikely @ weak.T
    return np.asarray(HELD * moved @ np.linalg.solve(weak @ moved, moved.T))


def _symmetric(total: Array) -> Array:
    """Return (6, 6) of its 21 entries above the diagonal."""
    M = np.zeros((6, 6))
    M[np.triu_indices(6)] = total[:21]
    return M + np.triu(M, 1).T


def warm_up() -> None:
    """Compile the kernels of this file."""
    surfaces = PlaneMap(1.0, 0.05)
    points = np.array([[x, y, 0.01 * x * y] for x in range(7) for y in range(7)]) / 7.0
    surfaces.insert(points)
    match_planes(surfaces, points, np.zeros(len(points)), np.eye(4), 9.0)
    lying(surfaces, points, np.eye(4))
