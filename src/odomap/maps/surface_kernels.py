"""Surface nets: a vertex per cell that the surface crosses, a quad per edge that it crosses.

A cell has eight voxels as corners. Where an edge from voxel a to b has distances of opposite sign,
the surface crosses it at a + (b - a) Dₐ / (Dₐ - D_b). The cell's vertex is the mean of its
crossings; every crossed edge is shared by four cells, whose vertices make a quad. There is no table
of cases, and triangles are evenly shaped.

A signed distance changes by at most the way one goes: an edge whose ends differ by more than two
voxels is no surface but the border between what one image saw through and what another believes to
be inside, and counts as not crossed.

Reference: S. F. F. Gibson, "Constrained elastic surface nets: generating smooth surfaces from
binary segmented data", MICCAI 1998.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.maps.tsdf_kernels import SIDE, block_at

__all__ = ["quads_kernel", "vertices_kernel", "warm_up"]

F32 = NDArray[np.float32]
Ints = NDArray[np.int64]
N = SIDE + 1
"""Voxels along a side of a block with the first ones of the next."""


@kernel
def _gather(b: int, slots: Ints, coords: Ints, distances: F32, weights: F32, D: F32) -> bool:
    """Fill D (9³) with a block and its neighbours' first voxels, NaN where nothing was seen.

    Return whether it has both signs.
    """
    low, high = False, False
    D[:] = np.nan
    for n in range(8):
        nx, ny, nz = n >> 2, (n >> 1) & 1, n & 1
        other = b
        if n > 0:
            other = block_at(coords[b, 0] + nx, coords[b, 1] + ny, coords[b, 2] + nz, slots, coords)
        if other < 0:
            continue
        for i in range(1 if nx else SIDE):
            for j in range(1 if ny else SIDE):
                for k in range(1 if nz else SIDE):
                    at = (i * SIDE + j) * SIDE + k
                    if weights[other, at] > 0.0:
                        d = distances[other, at]
                        D[((i + SIDE * nx) * N + j + SIDE * ny) * N + k + SIDE * nz] = d
                        low, high = low or d < 0.0, high or d >= 0.0
    return low and high


@kernel
def _crosses(a: float, b: float, steepest: float) -> bool:
    """Whether the surface crosses the edge between two distances; NaN never does."""
    return (a < 0.0) != (b < 0.0) and abs(a - b) <= steepest


@kernel
def _voxel(b: int, i: int, j: int, k: int, slots: Ints, coords: Ints) -> int:
    """Return block · 512 + voxel of a place in or beside block b, or -1."""
    x, y, z = i // SIDE, j // SIDE, k // SIDE
    other = b
    if x != 0 or y != 0 or z != 0:
        other = block_at(coords[b, 0] + x, coords[b, 1] + y, coords[b, 2] + z, slots, coords)
    if other < 0:
        return -1
    return ((other * SIDE + i - SIDE * x) * SIDE + j - SIDE * y) * SIDE + k - SIDE * z


@kernel
def vertices_kernel(
    slots: Ints, coords: Ints, distances: F32, weights: F32, colours: NDArray[np.uint16],
    views: NDArray[np.uint8], shape: NDArray[np.float64], index: NDArray[np.int32], fill: bool,
    points: F32, normals: F32, rgb: NDArray[np.uint8],
) -> int:  # fmt: skip
    """Number the crossed cells in index (blocks, 512), -1 the others, and return how many.

    With `fill`, also write their vertices: p = mean of crossings, n = ∇D normalised, colour = mean
    of the corners by 1 / (|D| + voxel/4). shape: voxel, steepest edge, least views.
    """
    voxel, steepest, least = shape[0], shape[1], shape[2]
    strides = (N * N, N, 1)
    D = np.empty(N * N * N, np.float32)
    place, gradient, colour = np.empty(3), np.empty(3), np.empty(3)
    count = 0
    for b in range(coords.shape[0]):
        index[b, :] = -1
        if not _gather(b, slots, coords, distances, weights, D):
            continue
        for at in range(SIDE * SIDE * SIDE):
            i, j, k = at >> 6, (at >> 3) & 7, at & 7
            base = (i * N + j) * N + k
            place[:], gradient[:] = 0.0, 0.0
            crossings, total = 0, 0.0
            for axis in range(3):
                sa, sb, sc = strides[axis], strides[(axis + 1) % 3], strides[(axis + 2) % 3]
                for e in range(4):
                    ob, oc = e >> 1, e & 1
                    d0 = D[base + ob * sb + oc * sc]
                    d1 = D[base + ob * sb + oc * sc + sa]
                    gradient[axis] += d1 - d0
                    total += d0 + d1
                    if _crosses(d0, d1, steepest):
                        crossings += 1
                        place[axis] += d0 / (d0 - d1)
                        place[(axis + 1) % 3] += ob
                        place[(axis + 2) % 3] += oc
            if crossings == 0 or not np.isfinite(total):
                continue
            most, parts = 0, 0.0
            colour[:] = 0.0
            for e in range(8):
                ci, cj, ck = i + (e >> 2), j + ((e >> 1) & 1), k + (e & 1)
                corner = _voxel(b, ci, cj, ck, slots, coords)
                if corner < 0:
                    continue
                block, inside = corner >> 9, corner & 511
                if views[block, inside] == 0:
                    continue
                most = max(most, int(views[block, inside]))
                part = 1.0 / (abs(D[(ci * N + cj) * N + ck]) + 0.25 * voxel)
                parts += part
                for axis in range(3):
                    colour[axis] += part * colours[block, inside, axis]
            if most < least:
                continue
            index[b, at] = count
            if fill:
                length = np.sqrt(gradient[0] ** 2 + gradient[1] ** 2 + gradient[2] ** 2)
                for axis in range(3):
                    cell = coords[b, axis] * SIDE + (at >> (6 - 3 * axis)) % SIDE
                    points[count, axis] = (cell + place[axis] / crossings) * voxel
                    normals[count, axis] = gradient[axis] / length if length > 0.0 else 0.0
                    rgb[count, axis] = min(255.0, colour[axis] / parts / 256.0 + 0.5)
            count += 1
    return count


@kernel
def quads_kernel(
    slots: Ints, coords: Ints, distances: F32, weights: F32, steepest: float,
    index: NDArray[np.int32], points: F32, fill: bool, faces: NDArray[np.int32],
) -> int:  # fmt: skip
    """Write two triangles for each crossed edge whose four cells have vertices; return how many.

    They turn counter-clockwise seen from where D grows; the quad is parted along its shorter
    diagonal.
    """
    strides = (N * N, N, 1)
    D = np.empty(N * N * N, np.float32)
    corner, at, count = np.empty(4, np.int64), np.empty(3, np.int64), 0
    for b in range(coords.shape[0]):
        if not _gather(b, slots, coords, distances, weights, D):
            continue
        for inside in range(SIDE * SIDE * SIDE):
            i, j, k = inside >> 6, (inside >> 3) & 7, inside & 7
            base = (i * N + j) * N + k
            for axis in range(3):
                d0, d1 = D[base], D[base + strides[axis]]
                if not _crosses(d0, d1, steepest):
                    continue
                whole = True
                for e in range(4):
                    at[0], at[1], at[2] = i, j, k
                    at[(axis + 1) % 3] -= 1 if e == 0 or e == 3 else 0
                    at[(axis + 2) % 3] -= 1 if e < 2 else 0
                    voxel = _voxel(b, at[0], at[1], at[2], slots, coords)
                    corner[e] = -1
                    if voxel >= 0:
                        corner[e] = index[voxel >> 9, voxel & 511]
                    whole = whole and corner[e] >= 0
                if not whole:
                    continue
                if fill:
                    if d0 >= 0.0:
                        corner[1], corner[3] = corner[3], corner[1]
                    p, q, r, s = corner[0], corner[1], corner[2], corner[3]
                    across, along = 0.0, 0.0
                    for m in range(3):
                        across += (points[p, m] - points[r, m]) ** 2
                        along += (points[q, m] - points[s, m]) ** 2
                    if along < across:
                        p, q, r, s = q, r, s, p
                    faces[count, 0], faces[count, 1], faces[count, 2] = p, q, r
                    faces[count + 1, 0], faces[count + 1, 1], faces[count + 1, 2] = p, r, s
                count += 2
    return count


def warm_up() -> None:
    """Compile the kernels of this module."""
    slots, coords = np.full(4, -1, np.int64), np.zeros((1, 3), np.int64)
    slots[0] = 0
    planes = np.repeat(np.linspace(-0.3, 0.4, 8, dtype=np.float32), 64)[None]
    ones = np.ones((1, 512), np.float32)
    index, points = np.empty((1, 512), np.int32), np.empty((512, 3), np.float32)
    shape = np.array([0.1, 0.2, 1.0])
    vertices_kernel(
        slots, coords, planes, ones, np.zeros((1, 512, 3), np.uint16), np.ones((1, 512), np.uint8),
        shape, index, True, points, points.copy(), np.empty((512, 3), np.uint8),
    )  # fmt: skip
    faces = np.empty((2048, 3), np.int32)
    quads_kernel(slots, coords, planes, ones, 0.2, index, points, True, faces)
