"""Optical flow of points: small patches aligned between two images, coarse to fine.

For each point a patch T around c in the template image is found again in the target image I by

    min_p  Σ_d [ (I(p + d) − Ī) − s (T(c + B d) − T̄) ]²

over the position p, with the means Ī, T̄ and the gain s removed in closed form, so that exposure
and vignetting do not pull the answer. B is the local affine map of target offsets to template
offsets that the predicted motion implies (identity when nothing is known): with it a patch keeps
its content when the camera rolls or approaches. The inverse-compositional form linearises the
template, hence one 2x2 Hessian per point and level. A point is followed from the coarsest level
of a pyramid to the finest; what it found is trusted if the correlation of the patches is high
and, for the forward–backward check, if tracking back ends where it began.

Cost: points x levels x iterations x patch area; 400 points take a few milliseconds.

Reference: Baker, Matthews, "Lucas-Kanade 20 Years On", IJCV 2004; Kalal, Mikolajczyk, Matas,
"Forward-Backward Error", ICPR 2010.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["Flow", "FlowConfig", "align_patches", "facing_warp", "pyramid", "track"]

Image = NDArray[np.uint8]
Points = NDArray[np.float64]


@dataclass(frozen=True)
class FlowConfig:
    """How points are followed from image to image."""

    half_window_px: int = 6
    """Half the patch side: 6 gives 13x13 pixels."""
    levels: int = 3
    """Pyramid levels; each doubles the motion that can be followed."""
    iterations: int = 12
    """Most Gauss-Newton steps per level."""
    min_correlation: float = 0.75
    """Smallest normalised correlation of a patch with its template."""
    max_backward_px: float = 0.7
    """Largest distance between a point and where tracking it back ends; 0 leaves the check out."""


@dataclass(frozen=True)
class Flow:
    """Where points went: (N, 2) pixels, (N,) whether found, (N,) patch correlations."""

    points: Points
    found: NDArray[np.bool_]
    correlation: NDArray[np.float64]


def pyramid(image: Image, levels: int) -> tuple[Image, ...]:
    """Return the image and its halvings, finest first, each smoothed before it is sampled."""
    images = [np.ascontiguousarray(image)]
    for _ in range(levels - 1):
        images.append(np.asarray(cv2.pyrDown(images[-1]), np.uint8))
    return tuple(images)


def track(
    template: tuple[Image, ...],
    target: tuple[Image, ...],
    points: Points,
    guess: Points,
    config: FlowConfig,
    warp: NDArray[np.float64] | None = None,
) -> Flow:
    """Follow points from one image to another.

    Args:
        template: pyramid of the image the points are known in.
        target: pyramid of the image they are wanted in.
        points: (N, 2) pixels in the template image.
        guess: (N, 2) pixels in the target image where each is expected.
        config: window, levels, checks.
        warp: (N, 2, 2) offsets in the template per offset in the target; default identity.

    Returns:
        Where they went and whether to believe it.
    """
    warp = np.tile(np.eye(2), (len(points), 1, 1)) if warp is None else warp
    forward = _coarse_to_fine(template, target, points, guess, warp, config, len(template))
    found = forward.found & (forward.correlation >= config.min_correlation)
    if config.max_backward_px > 0 and found.any():
        index = np.flatnonzero(found)
        # The way back starts off by as much as the prediction was: else it would agree too easily.
        start = points[index] + (forward.points[index] - guess[index]).clip(-4.0, 4.0)
        back = _coarse_to_fine(
            target,
            template,
            forward.points[index],
            start,
            np.asarray(np.linalg.inv(warp[index]), np.float64),
            config,
            2,
        )
        off = np.linalg.norm(back.points - points[index], axis=1)
        found[index] = back.found & (off <= config.max_backward_px)
    return Flow(forward.points, found, forward.correlation)


def _coarse_to_fine(
    template: tuple[Image, ...],
    target: tuple[Image, ...],
    points: Points,
    guess: Points,
    warp: NDArray[np.float64],
    config: FlowConfig,
    levels: int,
) -> Flow:
    positions = np.array(guess, np.float64)
    status = np.ones(len(points), np.bool_)
    correlation = np.zeros(len(points))
    for level in range(min(levels, len(template)) - 1, -1, -1):
        scale = 0.5**level
        at_level = positions * scale
        fine = align_patches(
            template[level],
            target[level],
            points * scale,
            at_level,
            warp,
            config.half_window_px,
            config.iterations,
        )
        # A patch that leaves the image or finds no texture on a coarse level keeps its position.
        positions = np.where(fine.found[:, None], fine.points / scale, positions)
        status, correlation = fine.found, fine.correlation
    return Flow(positions, status, correlation)


def facing_warp(points_camera: Points, T_template_camera: NDArray[np.float64]) -> Points:
    """Return how patches deform between two views, if their surfaces face the camera.

    Args:
        points_camera: (N, 3) the patches' centres in the target camera.
        T_template_camera: (4, 4) from the target to the template camera.

    Returns:
        (N, 2, 2) offsets in the template per offset in the target.
    """
    R = T_template_camera[:3, :3]
    there = points_camera @ R.T + T_template_camera[:3, 3]
    xy = there[:, :2] / there[:, 2:]
    ratio = (points_camera[:, 2] / there[:, 2])[:, None, None]
    return np.asarray(ratio * (R[None, :2, :2] - xy[:, :, None] * R[None, 2:, :2]))


def align_patches(
    template: Image,
    target: Image,
    points: Points,
    guess: Points,
    warp: NDArray[np.float64],
    half_window_px: int,
    iterations: int,
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

    Returns:
        Positions in the target, whether the patch stayed inside and converged, and correlations.
    """
    positions = np.array(guess, np.float64)
    found = np.zeros(len(points), np.bool_)
    correlation = np.zeros(len(points))
    _align_kernel(
        template,
        target,
        np.ascontiguousarray(points, np.float64),
        positions,
        np.ascontiguousarray(warp, np.float64),
        found,
        correlation,
        half_window_px,
        iterations,
    )
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
            if length < 0.015:
                break
        if found[i]:
            positions[i, 0], positions[i, 1] = x, y


def warm_up() -> None:
    """Compile the kernels of this module."""
    image = np.random.default_rng(0).integers(0, 255, (32, 32)).astype(np.uint8)
    points = np.array([[16.0, 16.0]])
    track((image,), (image,), points, points, FlowConfig(levels=1))
