"""Sweeps of beams against solids: the nearest hit of each, and what surface it is.

A sweep is S steps of B beams; all beams of a step leave T_world_lidar(t) together. A beam o + t d
meets a rectangle where its plane is, t = (n·c - n·o)/n·d, if there 0 <= u·x - u·c <= a and the same
of v; a cylinder where |o + t d - axis| = r; a ball of leaves a random length behind where the beam
enters. The ground is followed from above: no slope is steeper than L, so that from a height f

    t ← t + f / (|d_xy| L - d_z)

over it never goes through, and where beams are steeper than the ground Newton's steps,
f / (g·d_xy - d_z), end at its one root. What bounds the search is met first: the ground, then what
the same beam met in the step before, so that most of the tree is never entered.

Cost: about 0.2 µs a beam in a town of 5,000 shapes.

Paper: A. Williams, S. Barrus, R. K. Morley, P. Shirley, "An efficient and robust ray-box
intersection algorithm", Journal of Graphics Tools 10(1), 2005.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.simulation.solids import CYLINDER, RECTANGLE, Ground, Solids

__all__ = ["GROUND", "NOTHING", "cast", "warm_up"]

Array = NDArray[np.float64]
F32 = NDArray[np.float32]
Index = NDArray[np.int64]
Ids = NDArray[np.int32]

NOTHING, GROUND = -1, -2
"""Whom a beam met that met no shape."""
DEPTH = 64
MARGIN_M = 5.0
"""No mover comes nearer by more within a sweep."""
BELOW = -1e9
"""Height of the ground where there is none."""


def cast(
    solids: Solids, Ts_world_lidar: Array, delays: Array, directions: Array, chances: F32,
    time: float, farthest: float,
) -> tuple[Array, Ids, Array]:  # fmt: skip
    """Cast a sweep.

    Args:
        solids: what is there.
        Ts_world_lidar: (S, 4, 4) at each step.
        delays: (S,) of the steps since `time`, seconds.
        directions: (S, B, 3) of the beams in the LiDAR, unit length.
        chances: (S, B) from 0 to 1, which decide how far beams go into leaves.
        time: of the beginning, seconds; movers go on straight from where they are then.
        farthest: beyond nothing returns, metres.

    Returns:
        (S, B) distances, whom each met: a row of the shapes, GROUND or NOTHING, and (S, B, 3) the
        normals of the surfaces in the world, towards the LiDAR, NaN where there is none.
    """
    Ts, velocities = solids.motions(time)
    spheres = np.column_stack([Ts[:, :3, 3], solids.radii])
    first = solids.num_still + np.searchsorted(solids.mover, np.arange(len(Ts) + 1))
    away = np.linalg.norm(Ts[:, :3, 3] - Ts_world_lidar[0, :3, 3], axis=1) - solids.radii
    near = away < farthest + MARGIN_M
    shape = directions.shape[:2]
    distance, hit = np.empty(shape), np.empty(shape, np.int32)
    normals = np.empty((*shape, 3))
    ground = solids.ground
    _cast_kernel(
        np.ascontiguousarray(Ts_world_lidar), delays, directions, chances, farthest,
        solids.placed(Ts), solids.forms, solids.boxes, solids.nodes, solids.num_still,
        spheres[near], velocities[near], np.column_stack([first[:-1], first[1:]])[near],
        ground.heights, ground.corner, ground.steepest, distance, hit, normals,
    )  # fmt: skip
    return distance, hit, normals


@kernel
def _meet(
    p: Array, form: int, i: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float,
    chance: float, best: float,
) -> float:  # fmt: skip
    """Return where o + t d meets shape i if at 1e-6 < t < best, else best."""
    if form == RECTANGLE:
        t: float = (p[i, 3] - p[i, 0] * ox - p[i, 1] * oy - p[i, 2] * oz) / (
            p[i, 0] * dx + p[i, 1] * dy + p[i, 2] * dz
        )
        if not (t > 1e-6 and t < best):
            return best
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        s = p[i, 4] * x + p[i, 5] * y + p[i, 6] * z - p[i, 7]
        if s < 0.0 or s > p[i, 12]:
            return best
        s = p[i, 8] * x + p[i, 9] * y + p[i, 10] * z - p[i, 11]
        return best if s < 0.0 or s > p[i, 13] else t
    if form == CYLINDER:
        x, y = ox - p[i, 0], oy - p[i, 1]
        a, b = dx * dx + dy * dy, x * dx + y * dy
        under = b * b - a * (x * x + y * y - p[i, 2] * p[i, 2])
        if not under > 0.0:
            return best
        t = (-b - np.sqrt(under)) / a
        if not (t > 1e-6 and t < best):
            return best
        z = oz + t * dz
        return best if z < p[i, 3] or z > p[i, 4] else t
    x, y, z = ox - p[i, 0], oy - p[i, 1], oz - p[i, 2]
    b = x * dx + y * dy + z * dz
    under = b * b - x * x - y * y - z * z + p[i, 3] * p[i, 3]
    if not under > 0.0:
        return best
    root = np.sqrt(under)
    # Every ball has a chance of its own: the beam's, shifted by the golden ratio.
    chance = (chance + 0.6180339887 * i) % 1.0
    t = max(-b - root, 0.0) - p[i, 4] * np.log(1.0 - 0.999999 * chance)
    return t if t < -b + root and t > 1e-6 and t < best else best


@kernel
def _height(
    h: Array, x0: float, y0: float, per: float, x: float, y: float
) -> tuple[float, float, float]:
    """Return h(x, y) and its slopes; BELOW where there is no ground."""
    u, v = (x - x0) * per, (y - y0) * per
    if not (u >= 0.0 and v >= 0.0 and u < h.shape[1] - 1 and v < h.shape[0] - 1):
        return BELOW, 0.0, 0.0
    i, j = int(u), int(v)
    a, b = u - i, v - j
    low, high = h[j, i], h[j + 1, i]
    low_step, high_step = h[j, i + 1] - low, h[j + 1, i + 1] - high
    low, high = low + a * low_step, high + a * high_step
    value: float = low + b * (high - low)
    return value, per * (low_step + b * (high_step - low_step)), per * (high - low)


@kernel
def _follow(
    h: Array, corner: Array, steepest: float, ox: float, oy: float, oz: float, dx: float,
    dy: float, dz: float, best: float,
) -> float:  # fmt: skip
    """Return where o + t d first meets the ground if at t < best, else best."""
    closing = steepest * np.sqrt(dx * dx + dy * dy) - dz
    if closing <= 1e-9 or h.shape[0] < 2:
        return best
    x0, y0, per = corner[0], corner[1], 1.0 / corner[2]
    is_steep = -dz > 1.5 * steepest
    t = 0.0
    for _ in range(200):
        z, zx, zy = _height(h, x0, y0, per, ox + t * dx, oy + t * dy)
        f = oz + t * dz - z
        if abs(f) < 1e-9:
            return t
        rate = zx * dx + zy * dy - dz
        if rate > 0.0 and z > BELOW and (is_steep or f < 1e-3):
            t += f / rate
        else:
            t += f / closing
        if not (t < best and t > 0.0):
            return best
    return t


@kernel
def _enters(
    box: Array, i: int, k: int, ox: float, oy: float, oz: float, ix: float, iy: float, iz: float,
    best: float,
) -> float:  # fmt: skip
    """Return where o + t d, with 1/d = (ix, iy, iz), enters a box; infinity if not before best."""
    ax, bx = (box[i, k] - ox) * ix, (box[i, k + 3] - ox) * ix
    ay, by = (box[i, k + 1] - oy) * iy, (box[i, k + 4] - oy) * iy
    az, bz = (box[i, k + 2] - oz) * iz, (box[i, k + 5] - oz) * iz
    enter = max(min(ax, bx), min(ay, by), min(az, bz), 0.0)
    leave = min(max(ax, bx), max(ay, by), max(az, bz), best)
    return enter if enter <= leave else np.inf


@kernel
def _through_tree(
    o: Array, rays: Array, chances: F32, shapes: Array, forms: Index, boxes: Array, nodes: Index,
    stack: Index, enters: Array, best: Array, who: Ids,
) -> None:  # fmt: skip
    """Let all beams o + t rays[b] of a step meet what stands still, where that is before best."""
    ox, oy, oz = o[0], o[1], o[2]
    for r in range(rays.shape[0]):
        dx, dy, dz = rays[r, 0], rays[r, 1], rays[r, 2]
        ix, iy, iz = 1.0 / dx, 1.0 / dy, 1.0 / dz
        chance: float = chances[r]
        near, found = best[r], who[r]
        stack[0], enters[0] = 0, 0.0
        top = 1
        while top > 0:
            top -= 1
            if enters[top] >= near:
                continue
            node = stack[top]
            ta = _enters(boxes, node, 0, ox, oy, oz, ix, iy, iz, near)
            tb = _enters(boxes, node, 6, ox, oy, oz, ix, iy, iz, near)
            # The nearer child first: a leaf is searched at once, a node goes on the stack last.
            first = 0 if ta <= tb else 2
            for turn in range(2):
                side = first if turn == 0 else 2 - first
                if (ta if side == 0 else tb) < near and nodes[node, side] < 0:
                    begin = -1 - nodes[node, side]
                    for k in range(begin, begin + nodes[node, side + 1]):
                        t = _meet(shapes, forms[k], k, ox, oy, oz, dx, dy, dz, chance, near)
                        if t < near:
                            near, found = t, np.int32(k)
            for turn in range(2):
                side = 2 - first if turn == 0 else first
                enter = ta if side == 0 else tb
                if enter < near and nodes[node, side] >= 0:
                    stack[top], enters[top] = nodes[node, side], enter
                    top += 1
        best[r], who[r] = near, found


@kernel
def _movers_ahead(
    o: Array, rays: Array, spheres: Array, velocities: Array, delay: float, ahead: Index
) -> int:
    """Write the movers that the beams (B, 3) of a step can meet, and return how many.

    With the middle m of the beams and their greatest angle from it, α, those with the angle from m
    to a centre, distance c and radius r, at most α + asin(r/c).
    """
    if spheres.shape[0] == 0:
        return 0
    mx, my, mz = 0.0, 0.0, 0.0
    for b in range(rays.shape[0]):
        mx, my, mz = mx + rays[b, 0], my + rays[b, 1], mz + rays[b, 2]
    long = max(np.sqrt(mx * mx + my * my + mz * mz), 1e-12)
    mx, my, mz = mx / long, my / long, mz / long
    least = 1.0
    for b in range(rays.shape[0]):
        least = min(least, mx * rays[b, 0] + my * rays[b, 1] + mz * rays[b, 2])
    widest = np.arccos(max(min(least, 1.0), -1.0)) + 1e-6
    count = 0
    for k in range(spheres.shape[0]):
        x = spheres[k, 0] + velocities[k, 0] * delay - o[0]
        y = spheres[k, 1] + velocities[k, 1] * delay - o[1]
        z = spheres[k, 2] + velocities[k, 2] * delay - o[2]
        away = np.sqrt(x * x + y * y + z * z)
        if away > spheres[k, 3]:
            cosine = (x * mx + y * my + z * mz) / away
            if np.arccos(max(min(cosine, 1.0), -1.0)) > widest + np.arcsin(spheres[k, 3] / away):
                continue
        ahead[count] = k
        count += 1
    return count


@kernel
def _among_movers(
    o: Array, rays: Array, delay: float, shapes: Array, forms: Index, spheres: Array,
    velocities: Array, first: Index, ahead: Index, count: int, best: Array, who: Ids,
) -> None:  # fmt: skip
    """Let all beams of a step meet what moves, where that is before best."""
    for n in range(count):
        k = ahead[n]
        ox = o[0] - velocities[k, 0] * delay
        oy = o[1] - velocities[k, 1] * delay
        oz = o[2] - velocities[k, 2] * delay
        x, y, z = ox - spheres[k, 0], oy - spheres[k, 1], oz - spheres[k, 2]
        beyond = x * x + y * y + z * z - spheres[k, 3] * spheres[k, 3]
        for r in range(rays.shape[0]):
            dx, dy, dz = rays[r, 0], rays[r, 1], rays[r, 2]
            b = x * dx + y * dy + z * dz
            if b * b < beyond or (beyond > 0.0 and b > 0.0):
                continue
            for i in range(first[k, 0], first[k, 1]):
                t = _meet(shapes, forms[i], i, ox, oy, oz, dx, dy, dz, 0.0, best[r])
                if t < best[r]:
                    best[r], who[r] = t, i


@kernel
def _bound(
    o: Array, rays: Array, chances: F32, farthest: float, shapes: Array, forms: Index,
    heights: Array, corner: Array, steepest: float, last: Ids, best: Array, who: Ids,
) -> None:  # fmt: skip
    """Let all beams of a step meet the ground, and what stood before the same beam a step ago."""
    for r in range(rays.shape[0]):
        dx, dy, dz = rays[r, 0], rays[r, 1], rays[r, 2]
        who[r] = NOTHING
        best[r] = _follow(heights, corner, steepest, o[0], o[1], o[2], dx, dy, dz, farthest)
        if best[r] < farthest:
            who[r] = GROUND
        i = last[r]
        if i >= 0:
            t = _meet(shapes, forms[i], i, o[0], o[1], o[2], dx, dy, dz, chances[r], best[r])
            if t < best[r]:
                best[r], who[r] = t, i


@kernel
def _normals(
    o: Array, rays: Array, best: Array, who: Ids, shapes: Array, forms: Index, heights: Array,
    corner: Array, normals: Array,
) -> None:  # fmt: skip
    """Write the normals of what the beams of a step met, towards the LiDAR."""
    for r in range(rays.shape[0]):
        dx, dy, dz = rays[r, 0], rays[r, 1], rays[r, 2]
        x, y = o[0] + best[r] * dx, o[1] + best[r] * dy
        i = who[r]
        nx, ny, nz = np.nan, np.nan, np.nan
        if i == GROUND:
            _, zx, zy = _height(heights, corner[0], corner[1], 1.0 / corner[2], x, y)
            nz = 1.0 / np.sqrt(1.0 + zx * zx + zy * zy)
            nx, ny = -zx * nz, -zy * nz
        elif i >= 0 and forms[i] == RECTANGLE:
            nx, ny, nz = shapes[i, 0], shapes[i, 1], shapes[i, 2]
            if nx * dx + ny * dy + nz * dz > 0.0:
                nx, ny, nz = -nx, -ny, -nz
        elif i >= 0 and forms[i] == CYLINDER:
            nx, ny = (x - shapes[i, 0]) / shapes[i, 2], (y - shapes[i, 1]) / shapes[i, 2]
            nz = 0.0
        normals[r, 0], normals[r, 1], normals[r, 2] = nx, ny, nz


@kernel
def _cast_kernel(
    Ts: Array, delays: Array, directions: Array, chances: F32, farthest: float, shapes: Array,
    forms: Index, boxes: Array, nodes: Index, num_still: int, spheres: Array, velocities: Array,
    first: Index, heights: Array, corner: Array, steepest: float, distance: Array, hit: Ids,
    normals: Array,
) -> None:  # fmt: skip
    """Write the nearest hit of every beam T d: distance, whom, and the normal there."""
    stack, enters = np.empty(DEPTH, np.int64), np.empty(DEPTH)
    ahead = np.empty(spheres.shape[0], np.int64)
    rays, o = np.empty((directions.shape[1], 3)), np.empty(3)
    last = np.full(directions.shape[1], NOTHING, np.int32)
    for s in range(directions.shape[0]):
        T = Ts[s]
        for axis in range(3):
            o[axis] = T[axis, 3]
            for b in range(rays.shape[0]):
                rays[b, axis] = (
                    T[axis, 0] * directions[s, b, 0]
                    + T[axis, 1] * directions[s, b, 1]
                    + T[axis, 2] * directions[s, b, 2]
                )
        best, who = distance[s], hit[s]
        _bound(
            o, rays, chances[s], farthest, shapes, forms, heights, corner, steepest, last, best, who
        )
        count = _movers_ahead(o, rays, spheres, velocities, delays[s], ahead)
        _among_movers(
            o, rays, delays[s], shapes, forms, spheres, velocities, first, ahead, count, best, who
        )
        _through_tree(o, rays, chances[s], shapes, forms, boxes, nodes, stack, enters, best, who)
        _normals(o, rays, best, who, shapes, forms, heights, corner, normals[s])
        for b in range(rays.shape[0]):
            last[b] = who[b] if who[b] < num_still else NOTHING


def warm_up() -> None:
    """Compile the kernels of this file."""
    from odomap.simulation.solids import SolidsBuilder

    builder = SolidsBuilder(np.random.default_rng(0), Ground.none())
    builder.box(np.array([3.0, 0, 0]), (1.0, 1.0, 1.0), "building")
    beams = np.array([[[1.0, 1e-9, 1e-9]]])
    cast(builder.build(), np.eye(4)[None], np.zeros(1), beams, np.zeros((1, 1), np.float32), 0.0, 9)
