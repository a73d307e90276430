"""The colour of a pixel: texture at the right scale, light, sky.

With 1/z, s/z and t/z linear over the image (`render`), the footprint of a pixel on the texture is

    J = ∂(s, t)/∂(column, row),      e.g.  ∂s/∂column = z (∂(s/z)/∂column - s ∂(1/z)/∂column).

Its longer axis gets up to eight samples; each interpolates linearly between texels and between the
two pyramid levels whose texels bracket the shorter axis. A pixel that sees several surfaces is
the mean over its sub-samples, each surface being coloured once.

Cost: O(pixels x samples).

Paper: P. S. Heckbert, "Fundamentals of texture mapping and image warping", 1989.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["planes_kernel", "shade_kernel"]

Array = NDArray[np.float64]
Ids = NDArray[np.int32]
MOST_SAMPLES = 8
REUSE = 4


@kernel
def planes_kernel(frames: Array, faces: Array, pinhole: Array, planes: Array) -> None:
    """Write 1/z, s/z and t/z of each rectangle as planes over the image; s, t in texels."""
    fx, fy, cx, cy = pinhole[0], pinhole[1], pinhole[2], pinhole[3]
    for i in range(frames.shape[0]):
        f = frames[i]
        nx = f[4] * f[8] - f[5] * f[7]
        ny = f[5] * f[6] - f[3] * f[8]
        nz = f[3] * f[7] - f[4] * f[6]
        distance = nx * f[0] + ny * f[1] + nz * f[2]
        scale = faces[i, 2]
        for k in range(3):
            # The row of 1/z, then that of u and v: (u·r - (u·c)/z) scale + offset/z.
            x, y, z, w = nx / distance, ny / distance, nz / distance, 0.0
            if k > 0:
                j = 3 * k
                w = faces[i, 2 + k] - scale * (f[j] * f[0] + f[j + 1] * f[1] + f[j + 2] * f[2])
                x, y, z = (
                    scale * f[j] + w * x,
                    scale * f[j + 1] + w * y,
                    scale * f[j + 2] + w * z,
                )
            planes[i, 3 * k] = x / fx
            planes[i, 3 * k + 1] = y / fy
            planes[i, 3 * k + 2] = z - x / fx * cx - y / fy * cy


@kernel
def _texel(
    texels: NDArray[np.uint8], first: int, log_w: int, log_h: int, s: float, t: float
) -> float:
    """Interpolate a wrapping image of 2^log_w x 2^log_h texels at (s, t)."""
    x, y = s - 0.5, t - 0.5
    x0, y0 = np.floor(x), np.floor(y)
    wx, wy = x - x0, y - y0
    mask_s, mask_t = (1 << log_w) - 1, (1 << log_h) - 1
    i0, j0 = int(x0) & mask_s, int(y0) & mask_t
    i1, j1 = (i0 + 1) & mask_s, (j0 + 1) & mask_t
    row0, row1 = first + (j0 << log_w), first + (j1 << log_w)
    upper = texels[row0 + i0] * (1.0 - wx) + texels[row0 + i1] * wx
    lower = texels[row1 + i0] * (1.0 - wx) + texels[row1 + i1] * wx
    value: float = upper * (1.0 - wy) + lower * wy
    return value


@kernel
def _footprint(
    coarsest: int, sx: float, sy: float, tx: float, ty: float
) -> tuple[int, int, float, float, float]:
    """Return samples, level, weight of the next level, and step (s, t) of a footprint in texels.

    The pixel's disc becomes the ellipse J Jᵀ, J having the columns (sx, tx) and (sy, ty).
    """
    ss, tt, st = sx * sx + sy * sy, tx * tx + ty * ty, sx * tx + sy * ty
    spread = np.sqrt(0.25 * (ss - tt) * (ss - tt) + st * st)
    longer = np.sqrt(0.5 * (ss + tt) + spread)
    if longer <= 1.0:
        return 1, 0, 0.0, 0.0, 0.0
    shorter = abs(sx * ty - sy * tx) / longer
    samples = max(1, int(np.ceil(min(longer / max(shorter, 1.0), MOST_SAMPLES) - 0.4)))
    size = max(shorter, longer / samples)
    step_s, step_t = 0.0, 0.0
    if samples > 1:
        step_s, step_t = 0.5 * (ss - tt) + spread, st
        if ss < tt:
            step_s, step_t = st, 0.5 * (tt - ss) + spread
        norm = longer / (samples * max(np.sqrt(step_s * step_s + step_t * step_t), 1e-12))
        step_s, step_t = step_s * norm, step_t * norm
    # Level and weight: log2 of the size, taken as linear between powers of two.
    level = 0
    while size >= 2.0 and level < coarsest - 1:
        size *= 0.5
        level += 1
    return samples, level, min(max(size - 1.0, 0.0), 1.0), step_s, step_t


@kernel
def _sky(column: float, row: float, pinhole: Array, R: Array, sky: Array) -> float:
    """Return the sky's brightness: from the horizon's to the zenith's by the sine of the height."""
    x, y = (column - pinhole[2]) / pinhole[0], (row - pinhole[3]) / pinhole[1]
    up = (R[2, 0] * x + R[2, 1] * y + R[2, 2]) / np.sqrt(x * x + y * y + 1.0)
    value: float = sky[0] + (sky[1] - sky[0]) * min(max(up, 0.0), 1.0)
    return value


@kernel
def _run(ids: Ids, places: Array, k: int, row: int, column: int) -> tuple[int, float, float]:
    """Return how many sub-samples from k on see the same surface, and their centre."""
    x, y, n = 0.0, 0.0, 0
    while k + n < ids.shape[0] and ids[k + n, row, column] == ids[k, row, column]:
        x += places[k + n, 0]
        y += places[k + n, 1]
        n += 1
    return n, column + x / n, row + y / n


@kernel
def shade_kernel(
    ids: Ids, mixed: NDArray[np.bool_], planes: Array, end: Array, faces: Array,
    codes: NDArray[np.int64],
    texels: NDArray[np.uint8], table: NDArray[np.int64], light: NDArray[np.float32],
    pinhole: Array, R: Array, sky: Array, places: Array,
    radiance: NDArray[np.float32], depth: NDArray[np.float32], flow: NDArray[np.float32],
) -> None:  # fmt: skip
    """Colour pixels from who is visible at their centre (layer 0) and at their sub-samples."""
    # One loop body for all, because calls that take arrays cost more than what they do.
    layers, height, width = ids.shape
    for row in range(height):
        last, samples, level, w, step_s, step_t = -1, 1, 0, 0.0, 0.0, 0.0
        first, log_w, log_h, shrink = 0, 0, 0, 1.0
        for column in range(width):
            centre = ids[0, row, column]
            k, n, x, y = 0, 1, float(column), float(row)
            own, total = 0.0, 0.0
            depth[row, column] = 0.0
            flow[row, column, 0] = 0.0
            flow[row, column, 1] = 0.0
            while k < layers:
                i = ids[k, row, column]
                if k > 0:
                    n, x, y = _run(ids, places, k, row, column)
                value = own
                if i < 0:
                    value = _sky(x, y, pinhole, R, sky)
                elif k == 0 or i != centre:
                    z = 1.0 / (planes[i, 0] * x + planes[i, 1] * y + planes[i, 2])
                    s = z * (planes[i, 3] * x + planes[i, 4] * y + planes[i, 5])
                    t = z * (planes[i, 6] * x + planes[i, 7] * y + planes[i, 8])
                    which = codes[i, 0]
                    if i != last or column % REUSE == 0:
                        # ∂s = z (∂(s/z) - s ∂(1/z)), the same for t.
                        log_w, log_h = table[which, 1], table[which, 2]
                        samples, level, w, step_s, step_t = _footprint(
                            min(log_w, log_h),
                            z * (planes[i, 3] - s * planes[i, 0]),
                            z * (planes[i, 4] - s * planes[i, 1]),
                            z * (planes[i, 6] - t * planes[i, 0]),
                            z * (planes[i, 7] - t * planes[i, 1]),
                        )
                        last = i
                        # Level l starts after the sum of 4^-k of the area, k < l.
                        area = 1 << (log_w + log_h)
                        first = table[which, 0] + (4 * area - 4 * (area >> (2 * level))) // 3
                        log_w, log_h, shrink = log_w - level, log_h - level, 0.5**level
                    # The place of a sub-sample may lie just off the rectangle: stay on it.
                    scale = faces[i, 2]
                    part_s = min(max((s - faces[i, 3]) / (faces[i, 0] * scale), 0.0), 1.0)
                    part_t = min(max((t - faces[i, 4]) / (faces[i, 1] * scale), 0.0), 1.0)
                    s = part_s * faces[i, 0] * scale + faces[i, 3]
                    t = part_t * faces[i, 1] * scale + faces[i, 4]
                    albedo, fine = 0.0, 1.0 - w
                    for m in range(samples):
                        f = m - 0.5 * (samples - 1)
                        a, b = (s + f * step_s) * shrink, (t + f * step_t) * shrink
                        albedo += fine * _texel(texels, first, log_w, log_h, a, b)
                        if w > 0.0:
                            coarse = first + (1 << (log_w + log_h))
                            albedo += w * _texel(
                                texels, coarse, log_w - 1, log_h - 1, 0.5 * a, 0.5 * b
                            )
                    lit = _lit(light, codes[i, 1], codes[i, 2], codes[i, 3], part_s, part_t)
                    value = albedo * faces[i, 5] * lit / (255.0 * samples)
                    if k == 0:
                        depth[row, column] = z
                        a, b = part_s * faces[i, 0], part_t * faces[i, 1]
                        x1, y1 = _project(end, i, a, b, pinhole)
                        flow[row, column, 0] = 2.0 * (x1 - x)
                        flow[row, column, 1] = 2.0 * (y1 - y)
                if k == 0:
                    own = value
                    if not mixed[row, column]:
                        total = value * (layers - 1)
                        break
                else:
                    total += n * value
                k += n
            radiance[row, column] = total / (layers - 1)


@kernel
def _lit(
    values: NDArray[np.float32], first: int, columns: int, rows: int, x: float, y: float
) -> float:
    """Interpolate a light grid at x, y in 0..1."""
    x, y = x * 0.999999 * (columns - 1), y * 0.999999 * (rows - 1)
    i, j = int(x), int(y)
    wx, wy = x - i, y - j
    k = first + j * columns + i
    upper = values[k] * (1.0 - wx) + values[k + 1] * wx
    lower = values[k + columns] * (1.0 - wx) + values[k + columns + 1] * wx
    value: float = upper * (1.0 - wy) + lower * wy
    return value


@kernel
def _project(frames: Array, i: int, s: float, t: float, pinhole: Array) -> tuple[float, float]:
    """Project c + s u + t v of rectangle i to column and row."""
    z = frames[i, 2] + s * frames[i, 5] + t * frames[i, 8]
    x = frames[i, 0] + s * frames[i, 3] + t * frames[i, 6]
    y = frames[i, 1] + s * frames[i, 4] + t * frames[i, 7]
    near = 1.0 / max(z, 0.01)
    return pinhole[0] * x * near + pinhole[2], pinhole[1] * y * near + pinhole[3]
