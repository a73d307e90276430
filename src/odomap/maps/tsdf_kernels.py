"""Voxel blocks by hash, and depth images averaged into them.

The grid is endless but only its blocks of 8³ voxels near a surface exist. A block is found by the
hash of its whole-numbered place, h = (73856093 x ⊕ 19349663 y ⊕ 83492791 z) mod size, and linear
probing: O(1). A voxel p, seen at pixel π(T⁻¹p) with depth z there and its own depth Z, is off by

    d = (z - Z) · slant,      D ← (W D + w d) / (W + w),      W ← W + w

if d >= -band; d is cut at +band in front. The noise of depth grows with z², so w falls with z⁴; and
it falls behind the surface: what lies there was not seen, and may be another one.

Reference: B. Curless, M. Levoy, "A volumetric method for building complex models from range
images", SIGGRAPH 1996; M. Nießner et al., "Real-time 3D reconstruction at scale using voxel
hashing", SIGGRAPH Asia 2013.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel
from odomap.maps.tsdf_depth import CELL

__all__ = [
    "EMPTY",
    "SIDE",
    "TILE",
    "block_at",
    "enter_kernel",
    "integrate_kernel",
    "rehash_kernel",
    "warm_up",
]

F32 = NDArray[np.float32]
Array = NDArray[np.float64]
Ints = NDArray[np.int64]

SIDE = 8
"""Voxels along a side of a block."""
TILE = 16
"""Pixels along a side of the tiles whose farthest depth tells whether a block is hidden."""
EMPTY = -1
FURTHEST = 1 << 20
"""Blocks beyond this many from the origin do not exist."""


@kernel
def block_at(x: int, y: int, z: int, slots: Ints, coords: Ints) -> int:
    """Return the block at a place, or -1 - slot, slot being where it would be entered."""
    mask = slots.shape[0] - 1
    at = ((x * 73856093) ^ (y * 19349663) ^ (z * 83492791)) & mask
    while slots[at] >= 0:
        b = slots[at]
        if coords[b, 0] == x and coords[b, 1] == y and coords[b, 2] == z:
            return int(b)
        at = (at + 1) & mask
    return -1 - int(at)


@kernel
def rehash_kernel(slots: Ints, coords: Ints, count: int) -> None:
    """Enter the first `count` blocks into an empty table."""
    for b in range(count):
        slot = -1 - block_at(coords[b, 0], coords[b, 1], coords[b, 2], slots, coords)
        slots[slot] = b


@kernel
def enter_kernel(
    depth: F32, pinhole: Array, T: Array, shape: Array, stride: int, slots: Ints, coords: Ints,
    count: int, room: int,
) -> int:  # fmt: skip
    """Enter the blocks within a band around the depths; return how many there are then.

    P = t + s R (x, y, 1), s from z - b to z + b with b = band / |(x, y, 1)|, in quarters of a
    block. shape: voxel, band. -1: there is no room for as many; what is entered stays.
    """
    side, band = SIDE * shape[0], shape[1]
    near_x, near_y, near_z = FURTHEST, FURTHEST, FURTHEST
    for row in range(0, depth.shape[0], stride):
        y = (row - pinhole[3]) / pinhole[1]
        for column in range(0, depth.shape[1], stride):
            z = depth[row, column]
            if z == 0.0:
                continue
            x = (column - pinhole[2]) / pinhole[0]
            reach = band / np.sqrt(x * x + y * y + 1.0)
            steps = int(np.ceil(8.0 * band / side))
            for k in range(steps + 1):
                s = (z + reach * (2.0 * k / steps - 1.0)) / side
                bx = int(np.floor(T[0, 3] / side + s * (T[0, 0] * x + T[0, 1] * y + T[0, 2])))
                by = int(np.floor(T[1, 3] / side + s * (T[1, 0] * x + T[1, 1] * y + T[1, 2])))
                bz = int(np.floor(T[2, 3] / side + s * (T[2, 0] * x + T[2, 1] * y + T[2, 2])))
                if bx == near_x and by == near_y and bz == near_z:
                    continue
                near_x, near_y, near_z = bx, by, bz
                if max(abs(bx), abs(by), abs(bz)) >= FURTHEST:
                    continue
                found = block_at(bx, by, bz, slots, coords)
                if found >= 0:
                    continue
                if count >= room:
                    return -1
                coords[count, 0], coords[count, 1], coords[count, 2] = bx, by, bz
                slots[-1 - found] = count
                count += 1
    return count


@kernel
def _is_seen(centre: Array, radius: float, pinhole: Array, band: float, tiles: F32) -> bool:
    """Whether a ball in the camera frame can hold a voxel in front of a depth plus the band."""
    near = centre[2] - radius
    if near <= 0.05:
        return bool(centre[2] + radius > 0.05)
    spread = 1.3 * radius / near
    x, y = centre[0] / centre[2], centre[1] / centre[2]
    left = int((pinhole[0] * (x - spread) + pinhole[2]) / TILE - 1.0)
    right = int((pinhole[0] * (x + spread) + pinhole[2]) / TILE + 1.0)
    top = int((pinhole[1] * (y - spread) + pinhole[3]) / TILE - 1.0)
    bottom = int((pinhole[1] * (y + spread) + pinhole[3]) / TILE + 1.0)
    for i in range(max(0, top), min(tiles.shape[0] - 1, bottom) + 1):
        for j in range(max(0, left), min(tiles.shape[1] - 1, right) + 1):
            if tiles[i, j] > 0.0 and tiles[i, j] + 10.0 * band > near:
                return True
    return False


@kernel
def integrate_kernel(
    depth: F32, slants: F32, tiles: F32, colour: NDArray[np.uint8], pinhole: Array, T: Array,
    shape: Array, coords: Ints, count: int, distances: F32, weights: F32,
    colours: NDArray[np.uint16], views: NDArray[np.uint8],
) -> None:  # fmt: skip
    """D ← (W D + w d) / (W + w) over all voxels that the camera sees; T maps world to camera.

    w = slant / z⁴ · (1 + d / band if d < 0). shape: voxel, band, share of jumps, most weight,
    weight of free space. Colours are means over views, in 1/256 of a grey level.
    """
    voxel, band, jump, most, free = shape[0], shape[1], shape[2], shape[3], shape[4]
    height, width = depth.shape
    radius = 0.5 * np.sqrt(3.0) * SIDE * voxel
    centre = np.empty(3)
    # One voxel further along z, in the camera's axes.
    step_x, step_y, step_z = T[0, 2] * voxel, T[1, 2] * voxel, T[2, 2] * voxel
    fx, fy, cx, cy = pinhole[0], pinhole[1], pinhole[2], pinhole[3]
    for b in range(count):
        for k in range(3):
            centre[k] = T[k, 3]
            for m in range(3):
                centre[k] += T[k, m] * (coords[b, m] * SIDE + 0.5 * (SIDE - 1)) * voxel
        if not _is_seen(centre, radius, pinhole, band, tiles):
            continue
        for at in range(SIDE * SIDE * SIDE):
            if at & 7 == 0:
                px = (coords[b, 0] * SIDE + (at >> 6)) * voxel
                py = (coords[b, 1] * SIDE + ((at >> 3) & 7)) * voxel
                pz = coords[b, 2] * SIDE * voxel
                X = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
                Y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
                Z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
            else:
                X += step_x
                Y += step_y
                Z += step_z
            if Z < 0.05:
                continue
            inverse = 1.0 / Z
            u, v = fx * X * inverse + cx, fy * Y * inverse + cy
            if not (u >= 0.0 and v >= 0.0 and u < width - 1.0 and v < height - 1.0):
                continue
            near_row, near_column = int(v + 0.5), int(u + 0.5)
            z = float(depth[near_row, near_column])
            if z == 0.0:
                continue
            slant = slants[near_row // CELL, near_column // CELL]
            d = (z - Z) * slant
            if slant < 0.1 or d < -1.5 * band:
                continue
            if d < 1.5 * band:
                column, row = int(u), int(v)
                z00, z01 = depth[row, column], depth[row, column + 1]
                z10, z11 = depth[row + 1, column], depth[row + 1, column + 1]
                low, high = min(z00, z01, z10, z11), max(z00, z01, z10, z11)
                if low > 0.0 and high - low <= jump * low:
                    right, down = u - column, v - row
                    upper, lower = z00 + right * (z01 - z00), z10 + right * (z11 - z10)
                    z = upper + down * (lower - upper)
                    d = (z - Z) * slant
            if d < -band:
                continue
            w = slant / (z * z * z * z)
            if d > band:
                d, w = band, free * w
            elif d < 0.0:
                w *= 1.0 + d / band
            total = weights[b, at] + w
            if total <= 0.0:
                continue
            distances[b, at] += np.float32(w / total * (d - distances[b, at]))
            weights[b, at] = min(total, most)
            if abs(d) > 0.75 * band:
                continue
            if views[b, at] < 255:
                views[b, at] += np.uint8(1)
            for k in range(3):
                before = float(colours[b, at, k])
                now = 256.0 * colour[near_row, near_column, k]
                colours[b, at, k] = np.uint16(before + (now - before) / views[b, at] + 0.5)


def warm_up() -> None:
    """Compile the kernels of this module."""
    depth, pinhole = np.ones((16, 16), np.float32), np.array([16.0, 16.0, 8.0, 8.0])
    shape = np.array([0.05, 0.2, 0.04, 100.0, 1.0])
    slots, coords = np.full(1024, EMPTY, np.int64), np.zeros((64, 3), np.int64)
    count = enter_kernel(depth, pinhole, np.eye(4), shape, 2, slots, coords, 0, 64)
    voxels = SIDE**3
    integrate_kernel(
        depth, np.ones((4, 4), np.float32), np.ones((1, 1), np.float32),
        np.zeros((16, 16, 3), np.uint8), pinhole, np.eye(4), shape, coords, count,
        np.zeros((64, voxels), np.float32), np.zeros((64, voxels), np.float32),
        np.zeros((64, voxels, 3), np.uint16), np.zeros((64, voxels), np.uint8),
    )  # fmt: skip
    rehash_kernel(np.full(1024, EMPTY, np.int64), coords, count)
