"""Depth images made ready for fusion: flying pixels removed, slants of the surfaces measured.

Where depth jumps, a pixel sees both the near and the far surface, and its depth lies between them:
it hangs in the air. Such pixels are dropped; a jump is a step to a neighbour of more than a share
of the depth. Of what remains the slant is needed: with n·P = 1 the plane around a pixel,

    1/z = n·(x, y, 1),      slant = |n̂·(x, y, 1)| = 1 / (z |n|)

so inverse depth is affine in image coordinates, and a plane is fitted to it by least squares over a
window, once for every few pixels. What a depth is off along its ray, times the slant, is what it is
off from the plane: the distance that a signed distance field should hold.

Cost: about 20 ns per pixel.

Reference: C. Nguyen, S. Izadi, D. Lovell, "Modeling Kinect sensor noise for improved 3D
reconstruction and tracking", 3DIMPVT 2012 (noise over depth and slant).
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["CELL", "clean_kernel", "slant_kernel", "tile_kernel", "warm_up"]

F32 = NDArray[np.float32]
Array = NDArray[np.float64]

CELL = 4
"""Pixels along a side for which one slant is measured."""
REACH = 4
"""Pixels around such a cell that its plane is fitted to, every other of them."""


@kernel
def clean_kernel(depth: F32, near: float, far: float, jump: float, out: F32) -> None:
    """out = depth where near <= depth <= far and no neighbour is off by jump · depth; else 0."""
    height, width = depth.shape
    for row in range(height):
        for column in range(width):
            z = depth[row, column]
            out[row, column] = 0.0
            if not (z >= near and z <= far):
                continue
            limit = jump * z
            flies = False
            for k in range(4):
                r = row + (k == 0) - (k == 1)
                c = column + (k == 2) - (k == 3)
                if r < 0 or c < 0 or r >= height or c >= width:
                    continue
                other = depth[r, c]
                if other > 0.0 and not abs(other - z) <= limit:
                    flies = True
            if not flies:
                out[row, column] = z


@kernel
def slant_kernel(depth: F32, pinhole: Array, jump: float, slants: F32) -> None:
    """slants[cell] = 1 / (z |n|), n from least squares of 1/z = n·(x, y, 1); 0 where unknown.

    x and y are taken from the middle of the cell, which keeps the normal equations well scaled.
    """
    height, width = depth.shape
    for i in range(slants.shape[0]):
        for j in range(slants.shape[1]):
            slants[i, j] = 0.0
            z0 = np.float32(0.0)
            top, left = i * CELL, j * CELL
            for row in range(top, min(top + CELL, height)):
                for column in range(left, min(left + CELL, width)):
                    if depth[row, column] > 0.0:
                        z0 = depth[row, column]
            if z0 == 0.0:
                continue
            r0, c0 = top + 0.5 * (CELL - 1), left + 0.5 * (CELL - 1)
            n, sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            sq, sxq, syq = 0.0, 0.0, 0.0
            limit = 4.0 * jump * z0
            for row in range(max(0, top - REACH), min(height, top + CELL + REACH), 2):
                y = (row - r0) / pinhole[1]
                for column in range(max(0, left - REACH), min(width, left + CELL + REACH), 2):
                    z = depth[row, column]
                    if z == 0.0 or abs(z - z0) > limit:
                        continue
                    x, q = (column - c0) / pinhole[0], 1.0 / z
                    n += 1.0
                    sx += x
                    sy += y
                    sxx += x * x
                    sxy += x * y
                    syy += y * y
                    sq += q
                    sxq += x * q
                    syq += y * q
            if n < 6.0:
                continue
            mx, my, mq = sx / n, sy / n, sq / n
            vxx, vxy, vyy = sxx / n - mx * mx, sxy / n - mx * my, syy / n - my * my
            cx, cy = sxq / n - mx * mq, syq / n - my * mq
            det = vxx * vyy - vxy * vxy
            if not det > 0.05 * vxx * vyy:
                continue
            a, b = (vyy * cx - vxy * cy) / det, (vxx * cy - vxy * cx) / det
            q0 = mq - a * mx - b * my
            x0, y0 = (c0 - pinhole[2]) / pinhole[0], (r0 - pinhole[3]) / pinhole[1]
            c = q0 - a * x0 - b * y0
            slants[i, j] = q0 / np.sqrt(a * a + b * b + c * c)


@kernel
def tile_kernel(depth: F32, size: int, farthest: F32) -> None:
    """farthest[i, j] = the largest depth of a tile of size² pixels; 0 where it has none."""
    farthest[:] = 0.0
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            if depth[row, column] > farthest[row // size, column // size]:
                farthest[row // size, column // size] = depth[row, column]


def warm_up() -> None:
    """Compile the kernels of this module."""
    depth, out = np.ones((16, 16), np.float32), np.empty((16, 16), np.float32)
    clean_kernel(depth, 0.1, 4.0, 0.04, out)
    slant_kernel(out, np.array([16.0, 16.0, 8.0, 8.0]), 0.04, np.empty((4, 4), np.float32))
    tile_kernel(out, 16, np.empty((1, 1), np.float32))
