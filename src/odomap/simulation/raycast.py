"""Pictures through any lens: a ray for every pixel.

A lens that bends makes curves of straight edges, so nothing is linear over the image and spans
cannot be filled (`render`). What stays linear is the ray: with the direction r of a pixel, and
a rectangle c + s u + t v with normal N = u × v, in camera axes,

    1/d = N·r / N·c,      s/d = u·r - (u·c)/d,      t/d = v·r - (v·c)/d

at the distance d r, also beside and behind the camera. Who is nearest is found by casting the ray
through the tree of boxes, the neighbour's rectangle first, which is mostly the answer and prunes
the rest. Pixels whose neighbours see something else get eight rays more. The footprint of a pixel
is that of `shade`, with the derivative of r in place of that of (x, y, 1).

Cost: about 1 µs per pixel, one core.

Paper: T. Whitted, "An improved illumination model for shaded display", CACM 23(6), 1980.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.camera import Camera
from odomap.kernels import kernel
from odomap.simulation.rays import DEPTH
from odomap.simulation.scene import Scene
from odomap.simulation.shade import _footprint, _lit, _texel, planes_kernel

__all__ = ["raycast", "warm_up"]

Array = NDArray[np.float64]
F32 = NDArray[np.float32]
Ids = NDArray[np.int32]
SKY, DARK = -1, -2
"""What a ray meets where there is no surface, and where the lens lets no ray through."""


def raycast(
    scene: Scene, camera: Camera, T_world_camera: Array, views: tuple[Array, Array],
    world: Array, offsets: Array,
) -> tuple[F32, F32, F32]:  # fmt: skip
    """Look at a scene through any lens.

    Args:
        scene: what is there.
        camera: of any model.
        T_world_camera: (4, 4) at the middle of the exposure.
        views: the scene's frames (N, 9) in camera axes at the middle and the end of the exposure.
        world: the same (N, 9) in the world, at the middle.
        offsets: (K, 2) places in a pixel at which edges are sampled.

    Returns:
        radiance, depth and flow as in `render.Picture`.
    """
    shape = (camera.height, camera.width)
    columns, rows = np.meshgrid(np.arange(float(shape[1])), np.arange(float(shape[0])))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    rays = camera.unproject(pixels)
    surfaces = np.empty((len(world), 11))
    surfaces_kernel(T_world_camera[:3, 3].copy(), world, scene.rectangles.faces, surfaces)
    ids = _who(scene, surfaces, T_world_camera, rays)
    edges = _edges(ids.reshape(shape))
    around = (pixels[edges, None, :] + offsets).reshape(-1, 2)
    fine = camera.unproject(around)
    fine_ids = _who(scene, surfaces, T_world_camera, fine)
    planes = np.empty((len(world), 9))
    planes_kernel(views[0], scene.rectangles.faces, np.array([1.0, 1.0, 0.0, 0.0]), planes)
    radiance, depth = np.empty(len(rays), np.float32), np.empty(len(rays), np.float32)
    moved = np.empty((len(rays), 3))
    start = np.full(len(rays), -1)
    start[edges] = np.arange(len(edges)) * len(offsets)
    slopes = np.stack(np.gradient(rays.reshape(*shape, 3), axis=(1, 0)), axis=2).reshape(-1, 6)
    raycast_kernel(
        rays, np.nan_to_num(slopes), ids, start, len(offsets), fine, fine_ids, planes, views[1],
        scene.rectangles.faces, scene.rectangles.codes, scene.atlas.texels, scene.atlas.table,
        scene.light.values, T_world_camera[2, :3].copy(), np.array(scene.sky),
        radiance, depth, moved,
    )  # fmt: skip
    flow = np.nan_to_num(2.0 * (camera.project(moved) - pixels)).astype(np.float32)
    return radiance.reshape(shape), depth.reshape(shape), flow.reshape(*shape, 2)


def _who(scene: Scene, surfaces: Array, T_world_camera: Array, rays: Array) -> Ids:
    """Return whom each ray (N, 3) in camera axes meets first."""
    ids = np.empty(len(rays), np.int32)
    boxes = scene.tree.boxes - np.tile(T_world_camera[:3, 3], 2)
    movers = np.flatnonzero(scene.rectangles.mover >= 0)
    directions = np.ascontiguousarray(rays @ T_world_camera[:3, :3].T)
    tree = scene.tree
    nearest_kernel(directions, surfaces, boxes, tree.nodes, tree.order, movers, ids)
    return ids


def _edges(ids: Ids) -> NDArray[np.int64]:
    """Return the pixels whose eight neighbours do not all see what they see."""
    padded = np.pad(ids, 1, mode="edge")
    height, width = ids.shape
    mixed = np.zeros(ids.shape, np.bool_)
    for row in range(3):
        for column in range(3):
            mixed |= padded[row : row + height, column : column + width] != ids
    return np.flatnonzero(mixed)


@kernel
def surfaces_kernel(o: Array, frames: Array, faces: Array, surfaces: Array) -> None:
    """Write 1/t, s/t and t'/t of each rectangle as linear forms of a ray o + t d, and its sides.

    q = N / N·(c - o),   u - u·(c - o) q,   v - v·(c - o) q,   a, b; zeros where o is behind it.
    """
    for i in range(frames.shape[0]):
        f = frames[i]
        x, y, z = f[0] - o[0], f[1] - o[1], f[2] - o[2]
        nx = f[4] * f[8] - f[5] * f[7]
        ny = f[5] * f[6] - f[3] * f[8]
        nz = f[3] * f[7] - f[4] * f[6]
        distance = nx * x + ny * y + nz * z
        surfaces[i] = 0.0
        if distance <= 1e-9 and (faces[i, 6] == 0.0 or distance >= -1e-9):
            continue
        q = nx / distance, ny / distance, nz / distance
        uc = f[3] * x + f[4] * y + f[5] * z
        vc = f[6] * x + f[7] * y + f[8] * z
        for k in range(3):
            surfaces[i, k] = q[k]
            surfaces[i, 3 + k] = f[3 + k] - uc * q[k]
            surfaces[i, 6 + k] = f[6 + k] - vc * q[k]
        surfaces[i, 9], surfaces[i, 10] = faces[i, 0], faces[i, 1]


@kernel
def _nearer(p: Array, i: int, x: float, y: float, z: float, near: float) -> float:
    """Return 1/t of the ray d = (x, y, z) if it meets rectangle i nearer than 1/near, else near."""
    w: float = p[i, 0] * x + p[i, 1] * y + p[i, 2] * z
    if w > near:
        s = p[i, 3] * x + p[i, 4] * y + p[i, 5] * z
        if 0.0 <= s <= p[i, 9] * w:
            s = p[i, 6] * x + p[i, 7] * y + p[i, 8] * z
            if 0.0 <= s <= p[i, 10] * w:
                return w
    return near


@kernel
def _enters(box: Array, i: int, x: float, y: float, z: float) -> float:
    """Return where o + t d, with 1/d = (x, y, z), enters a box relative to o; infinity if never."""
    ax, bx = box[i, 0] * x, box[i, 3] * x
    ay, by = box[i, 1] * y, box[i, 4] * y
    az, bz = box[i, 2] * z, box[i, 5] * z
    enter = max(min(ax, bx), min(ay, by), min(az, bz), 0.0)
    leave = min(max(ax, bx), max(ay, by), max(az, bz))
    return enter if enter <= leave else np.inf


@kernel
def nearest_kernel(
    directions: Array, surfaces: Array, boxes: Array, nodes: NDArray[np.int64],
    order: NDArray[np.int64], movers: NDArray[np.int64], ids: Ids,
) -> None:  # fmt: skip
    """Write whom each ray o + t d meets first; SKY for nobody, DARK where d is NaN."""
    stack, enters = np.empty(DEPTH, np.int64), np.empty(DEPTH)
    who = SKY
    for r in range(directions.shape[0]):
        x, y, z = directions[r, 0], directions[r, 1], directions[r, 2]
        if not x * x + y * y + z * z > 0.0:
            ids[r] = DARK
            continue
        near = 0.0
        if who >= 0:
            near = _nearer(surfaces, who, x, y, z, 0.0)
        if near == 0.0:
            who = SKY
        ix, iy, iz = 1.0 / x, 1.0 / y, 1.0 / z
        stack[0], enters[0] = 0, 0.0
        top = 1
        while top > 0:
            top -= 1
            if enters[top] * near >= 1.0:
                continue
            a, b = nodes[stack[top], 0], nodes[stack[top], 1]
            if a < 0:
                for k in range(-1 - a, -1 - a + b):
                    w = _nearer(surfaces, order[k], x, y, z, near)
                    if w > near:
                        near, who = w, order[k]
                continue
            # The nearer child is visited first: it goes on the stack last.
            ta, tb = _enters(boxes, a, ix, iy, iz), _enters(boxes, b, ix, iy, iz)
            if ta < tb:
                a, b, ta, tb = b, a, tb, ta
            if ta < np.inf:
                stack[top], enters[top] = a, ta
                top += 1
            if tb < np.inf:
                stack[top], enters[top] = b, tb
                top += 1
        for k in range(movers.shape[0]):
            w = _nearer(surfaces, movers[k], x, y, z, near)
            if w > near:
                near, who = w, movers[k]
        ids[r] = who


@kernel
def _colour(
    i: int, r: Array, slope: Array, planes: Array, faces: Array, codes: NDArray[np.int64],
    texels: NDArray[np.uint8], table: NDArray[np.int64], light: F32,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Return colour, distance d, and s, t in metres, where the ray r meets rectangle i."""
    p = planes[i]
    d = 1.0 / (p[0] * r[0] + p[1] * r[1] + p[2] * r[2])
    s = d * (p[3] * r[0] + p[4] * r[1] + p[5] * r[2])
    t = d * (p[6] * r[0] + p[7] * r[1] + p[8] * r[2])
    # ∂s = d (∂(s/d) - s ∂(1/d)) along a column and along a row, the same for t.
    ax, ay, az, bx, by, bz = slope[0], slope[1], slope[2], slope[3], slope[4], slope[5]
    na, nb = p[0] * ax + p[1] * ay + p[2] * az, p[0] * bx + p[1] * by + p[2] * bz
    log_w, log_h = table[codes[i, 0], 1], table[codes[i, 0], 2]
    samples, level, w, step_s, step_t = _footprint(
        min(log_w, log_h),
        d * (p[3] * ax + p[4] * ay + p[5] * az - s * na),
        d * (p[3] * bx + p[4] * by + p[5] * bz - s * nb),
        d * (p[6] * ax + p[7] * ay + p[8] * az - t * na),
        d * (p[6] * bx + p[7] * by + p[8] * bz - t * nb),
    )
    # Level l starts after the sum of 4^-k of the area, k < l.
    area = 1 << (log_w + log_h)
    first = table[codes[i, 0], 0] + (4 * area - 4 * (area >> (2 * level))) // 3
    log_w, log_h, shrink = log_w - level, log_h - level, 0.5**level
    scale = faces[i, 2]
    part_s = min(max((s - faces[i, 3]) / (faces[i, 0] * scale), 0.0), 1.0)
    part_t = min(max((t - faces[i, 4]) / (faces[i, 1] * scale), 0.0), 1.0)
    s = part_s * faces[i, 0] * scale + faces[i, 3]
    t = part_t * faces[i, 1] * scale + faces[i, 4]
    albedo = 0.0
    for m in range(samples):
        f = m - 0.5 * (samples - 1)
        a, b = (s + f * step_s) * shrink, (t + f * step_t) * shrink
        albedo += (1.0 - w) * _texel(texels, first, log_w, log_h, a, b)
        if w > 0.0:
            coarse = first + (1 << (log_w + log_h))
            albedo += w * _texel(texels, coarse, log_w - 1, log_h - 1, 0.5 * a, 0.5 * b)
    lit = _lit(light, codes[i, 1], codes[i, 2], codes[i, 3], part_s, part_t)
    value = albedo * faces[i, 5] * lit / (255.0 * samples)
    return value, d, part_s * faces[i, 0], part_t * faces[i, 1]


@kernel
def raycast_kernel(
    rays: Array, slopes: Array, ids: Ids, start: NDArray[np.int64], count: int, fine: Array,
    fine_ids: Ids, planes: Array, end: Array, faces: Array, codes: NDArray[np.int64],
    texels: NDArray[np.uint8], table: NDArray[np.int64], light: F32, up: Array, sky: Array,
    radiance: F32, depth: F32, moved: Array,
) -> None:  # fmt: skip
    """Colour rays (N, 3); where start >= 0, the mean over the finer rays start .. start + count.

    `moved` is where what a ray meets is at the end of the exposure, in camera axes; NaN for none.
    """
    for n in range(rays.shape[0]):
        i = ids[n]
        own = 0.0
        depth[n] = 0.0
        moved[n, 0], moved[n, 1], moved[n, 2] = np.nan, np.nan, np.nan
        if i >= 0:
            own, d, s, t = _colour(
                i, rays[n], slopes[n], planes, faces, codes, texels, table, light
            )
            depth[n] = max(d * rays[n, 2], 0.0)
            for k in range(3):
                moved[n, k] = end[i, k] + s * end[i, 3 + k] + t * end[i, 6 + k]
        elif i == SKY:
            own = _sky(rays[n], up, sky)
        if start[n] < 0:
            radiance[n] = own
            continue
        total = 0.0
        for m in range(start[n], start[n] + count):
            j = fine_ids[m]
            if j == i and j >= 0:
                total += own
            elif j >= 0:
                total += _colour(j, fine[m], slopes[n], planes, faces, codes, texels, table, light)[
                    0
                ]
            elif j == SKY:
                total += _sky(fine[m], up, sky)
        radiance[n] = total / count


@kernel
def _sky(r: Array, up: Array, sky: Array) -> float:
    """Return the sky's brightness along a ray of length 1: as in `shade`, by its height."""
    height = min(max(up[0] * r[0] + up[1] * r[1] + up[2] * r[2], 0.0), 1.0)
    value: float = sky[0] + (sky[1] - sky[0]) * height
    return value


def warm_up() -> None:
    """Compile the kernels."""
    frames = np.array([[-0.5, -0.5, 1, 1, 0, 0, 0, 1, 0]])
    faces = np.array([[1.0, 1, 1, 0, 0, 1, 0, 0]])
    rays, ids = np.array([[1e-9, 1e-9, 1.0]]), np.empty(1, np.int32)
    surfaces = np.empty((1, 11))
    surfaces_kernel(np.zeros(3), frames, faces, surfaces)
    nearest_kernel(
        rays, surfaces, np.array([[-1.0, -1, -1, 1, 1, 1]]), np.array([[-1, 1]]),
        np.zeros(1, np.int64), np.zeros(0, np.int64), ids,
    )  # fmt: skip
    planes = np.empty((1, 9))
    planes_kernel(frames, faces, np.array([1.0, 1.0, 0.0, 0.0]), planes)
    raycast_kernel(
        rays, np.zeros((1, 6)), ids, np.zeros(1, np.int64), 1, rays, ids, planes, frames, faces,
        np.array([[0, 0, 2, 2]]), np.full(5, 128, np.uint8), np.array([[0, 1, 1]]),
        np.ones(4, np.float32), np.zeros(3), np.ones(2), np.empty(1, np.float32),
        np.empty(1, np.float32), np.empty((1, 3)),
    )  # fmt: skip
