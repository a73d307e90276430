"""Patches: small windows of one image found in another to a fraction of a pixel.

For each point a patch T around c in the template image is found again in the target image I by

    min_p  Σ_d [ (I(p + d) − Ī) − s (T(c + B d) − T̄) ]²

over the position p, with the means Ī, T̄ and the gain s removed in closed form, so that exposure and
vignetting do not pull the answer. B maps target offsets to template offsets (identity when nothing
is known). The inverse-compositional form linearises the template, hence one 2x2 Hessian per point.

Cost: points x iterations x patch area; a point takes some 4 µs, and two cores share them.

Reference: Baker, Matthews, "Lucas-Kanade 20 Years On", IJCV 2004.
"""

import functools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["PRECISION_PX", "Flow", "align_patches"]

Image = NDArray[np.uint8]
Points = NDArray[np.float64]

PRECISION_PX = 0.02
"""A step shorter than this ends the alignment of a patch."""
WORTH_TWO_CORES = 64
"""From this many points on the second core helps more than waking it costs."""


@dataclass(frozen=True)
class Flow:
    """Where points went: (N, 2) pixels, (N,) whether found, (N,) patch correlations."""

    points: Points
    found: NDArray[np.bool_]
    correlation: NDArray[np.float64]


@functools.cache
def _second_core() -> ThreadPoolExecutor:
    """Return a thread for half of the points; kernels run without the interpreter's lock."""
    return ThreadPoolExecutor(1, thread_name_prefix="flow")


def align_patches(
    template: Image,
    target: Image,
    points: Points,
    guess: Points,
    warp: NDArray[np.float64],
    half_window_px: int,
    iterations: int,
    precision_px: float = PRECISION_PX,
) -> Flow:
    """Align patches on one pair of images (see the module's equation).

    Args:
        template: (H, W) uint8.
        target: (H', W') uint8.
        points: (N, 2) patch centres in the template.
        guess: (N, 2) where to start in the target.
        warp: (N, 2, 2) offsets in the template per offset in the target.
        half_window_px: half the patch's side.
        iterations: most Gauss-Newton steps.
        precision_px: a step shorter than this is the last.

    Returns:
        Positions in the target, whether the patch stayed inside and converged, and correlations.
    """
    positions = np.array(guess, np.float64)
    found = np.zeros(len(points), np.bool_)
    correlation = np.zeros(len(points))
    centres = np.ascontiguousarray(points, np.float64)
    warp = np.ascontiguousarray(warp, np.float64)

    def align(rows: slice) -> None:
        _align_kernel(
            template,
            target,
            centres[rows],
            positions[rows],
            warp[rows],
            found[rows],
            correlation[rows],
            half_window_px,
            iterations,
            precision_px,
        )

    # Points do not know of each other: two cores take half of them each, with the same result.
    half = len(points) // 2 if len(points) >= WORTH_TWO_CORES else 0
    other = _second_core().submit(align, slice(0, half)) if half else None
    align(slice(half, None))
    if other is not None:
        other.result()
    return Flow(positions, found, correlation)


@kernel(reorder=True)
def _sample_template(
    image: Image, x: float, y: float, B: NDArray[np.float64], half: int, patch: NDArray[np.float32]
) -> bool:
    """patch[v, u] = image((x, y) + B (u, v)), bilinear, with a margin for gradients."""
    height, width = image.shape
    reach = half + 1.001  # single precision must not round over the border
    rx = (abs(B[0, 0]) + abs(B[0, 1])) * reach
    ry = (abs(B[1, 0]) + abs(B[1, 1])) * reach
    if not (x - rx >= 0.0 and y - ry >= 0.0 and x + rx < width - 1.0 and y + ry < height - 1.0):
        return False
    b00, b01, b10, b11 = (
        np.float32(B[0, 0]),
        np.float32(B[0, 1]),
        np.float32(B[1, 0]),
        np.float32(B[1, 1]),
    )
    # Offsets from a whole pixel keep single precision exact enough in large images.
    x0, y0 = int(x) - int(rx) - 1, int(y) - int(ry) - 1
    ox, oy = np.float32(x - x0), np.float32(y - y0)
    i, one = 0, np.uint64(1)
    for v in range(-half - 1, half + 2):
        for u in range(-half - 1, half + 2):
            sx = ox + b00 * np.float32(u) + b01 * np.float32(v)
            sy = oy + b10 * np.float32(u) + b11 * np.float32(v)
            ix, iy = np.int32(sx), np.int32(sy)
            fx, fy = sx - np.float32(ix), sy - np.float32(iy)
            r, c = np.uint64(y0 + iy), np.uint64(x0 + ix)  # unsigned: no test for negative indices
            i00, i01 = np.float32(image[r, c]), np.float32(image[r, c + one])
            i10, i11 = np.float32(image[r + one, c]), np.float32(image[r + one, c + one])
            top = i00 + fx * (i01 - i00)
            low = i10 + fx * (i11 - i10)
            patch[i] = top + fy * (low - top)
            i += 1
    return True


@kernel(reorder=True)
def _sample_target(image: Image, x: float, y: float, half: int, patch: NDArray[np.float32]) -> bool:
    """patch[v, u] = image((x, y) + (u, v)), bilinear; the same four weights for all."""
    height, width = image.shape
    left, top = int(np.floor(x)) - half, int(np.floor(y)) - half
    side = 2 * half + 1
    if left < 0 or top < 0 or left + side >= width or top + side >= height:
        return False
    fx, fy = np.float32(x - np.floor(x)), np.float32(y - np.floor(y))
    one = np.float32(1.0)
    w00, w01 = (one - fx) * (one - fy), fx * (one - fy)
    w10, w11 = (one - fx) * fy, fx * fy
    for v in range(side):
        upper = image[top + v, left : left + side + 1]
        lower = image[top + v + 1, left : left + side + 1]
        row = patch[v * side : (v + 1) * side]
        for u in range(side):
            row[u] = (
                w00 * np.float32(upper[u])
                + w01 * np.float32(upper[u + 1])
                + w10 * np.float32(lower[u])
                + w11 * np.float32(lower[u + 1])
            )
    return True


@kernel(reorder=True)
def _prepare_template(
    wide: NDArray[np.float32],
    side: int,
    T: NDArray[np.float32],
    gx: NDArray[np.float32],
    gy: NDArray[np.float32],
    sums: NDArray[np.float64],
) -> None:
    """Write T − T̄, ∇T − mean(∇T), and sums = (Σ gx², Σ gx gy, Σ gy², Σ T²)."""
    stride, half = side + 2, np.float32(0.5)
    mean, mean_x, mean_y = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for v in range(side):
        above = wide[v * stride + 1 : (v + 1) * stride - 1]
        here = wide[(v + 1) * stride : (v + 2) * stride]
        below = wide[(v + 2) * stride + 1 : (v + 3) * stride - 1]
        rows = slice(v * side, (v + 1) * side)
        T_row, gx_row, gy_row = T[rows], gx[rows], gy[rows]
        for u in range(side):
            T_row[u] = here[u + 1]
            gx_row[u] = half * (here[u + 2] - here[u])
            gy_row[u] = half * (below[u] - above[u])
            mean += T_row[u]
            mean_x += gx_row[u]
            mean_y += gy_row[u]
    area = side * side
    mean, mean_x, mean_y = mean / area, mean_x / area, mean_y / area
    xx, xy, yy, tt = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for i in range(area):
        T[i] -= np.float32(mean)
        gx[i] -= np.float32(mean_x)
        gy[i] -= np.float32(mean_y)
        xx += gx[i] * gx[i]
        xy += gx[i] * gy[i]
        yy += gy[i] * gy[i]
        tt += T[i] * T[i]
    sums[0], sums[1], sums[2], sums[3] = xx, xy, yy, tt


@kernel(reorder=True)
def _compare(
    patch: NDArray[np.float32],
    T: NDArray[np.float32],
    gx: NDArray[np.float32],
    gy: NDArray[np.float32],
    sums: NDArray[np.float64],
) -> None:
    """Write sums[4:] = (Σ I' T, Σ I'², Σ gx I', Σ gy I', Σ gx T, Σ gy T), I' = I − Ī."""
    mean = np.float32(0.0)
    area = len(T)
    for i in range(area):
        mean += patch[i]
    mean = np.float32(mean / area)
    cross, power = np.float32(0.0), np.float32(0.0)
    bx, by, tx, ty = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for i in range(area):
        value = patch[i] - mean
        cross += value * T[i]
        power += value * value
        bx += gx[i] * value
        by += gy[i] * value
        tx += gx[i] * T[i]
        ty += gy[i] * T[i]
    sums[4], sums[5], sums[6], sums[7], sums[8], sums[9] = cross, power, bx, by, tx, ty


@kernel
def _align_kernel(
    template: Image,
    target: Image,
    points: Points,
    positions: Points,
    warp: NDArray[np.float64],
    found: NDArray[np.bool_],
    correlation: NDArray[np.float64],
    half: int,
    iterations: int,
    precision: float,
) -> None:
    """Gauss-Newton on p: H δ = Σ g̃ [(I − Ī) − s (T − T̄)] / s, p ← p − δ, with g̃ = ∇T − mean(∇T)."""
    side = 2 * half + 1
    area = side * side
    wide = np.empty((side + 2) * (side + 2), np.float32)
    T, patch = np.empty(area, np.float32), np.empty(area, np.float32)
    gx, gy = np.empty(area, np.float32), np.empty(area, np.float32)
    sums = np.empty(10)
    for i in range(len(points)):
        if not (np.isfinite(positions[i, 0]) and np.isfinite(positions[i, 1])):
            continue
        if not _sample_template(template, points[i, 0], points[i, 1], warp[i], half, wide):
            continue
        _prepare_template(wide, side, T, gx, gy, sums)
        xx, xy, yy, energy = sums[0], sums[1], sums[2], sums[3]
        det = xx * yy - xy * xy
        smallest = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
        if smallest < 2.0 * area or energy <= 0.0:  # under 1.4 grey levels per pixel: no texture
            continue
        x, y = positions[i, 0], positions[i, 1]
        for _ in range(iterations):
            if not _sample_target(target, x, y, half, patch):
                found[i] = False
                break
            _compare(patch, T, gx, gy, sums)
            gain = max(sums[4] / energy, 0.2)
            bx, by = sums[6] - gain * sums[8], sums[7] - gain * sums[9]
            dx = (yy * bx - xy * by) / (det * gain)
            dy = (xx * by - xy * bx) / (det * gain)
            length = np.sqrt(dx * dx + dy * dy)
            if length > 2.0:  # a linearisation is good for a pixel or two
                dx, dy = dx * 2.0 / length, dy * 2.0 / length
            x, y = x - dx, y - dy
            correlation[i] = sums[4] / np.sqrt(max(sums[5] * energy, 1e-12))
            found[i] = True
            if length < precision:
                break
        if found[i]:
            positions[i, 0], positions[i, 1] = x, y


def warm_up() -> None:
    """Compile the kernels of this module."""
    image = np.random.default_rng(0).integers(0, 255, (32, 32)).astype(np.uint8)
    points = np.array([[16.0, 16.0]])
    align_patches(image, image, points, points, np.eye(2)[None], 5, 5)
