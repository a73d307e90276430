"""Optical flow of points: small patches aligned between two images, coarse to fine.

For each point a patch T around c in the template image is found again in the target image I by

    min_p  Σ_d [ (I(p + d) − Ī) − s (T(c + B d) − T̄) ]²

over the position p, with the means Ī, T̄ and the gain s removed in closed form, so that exposure and
vignetting do not pull the answer. B is the local affine map of target offsets to template offsets
that the predicted motion implies (identity when nothing is known): with it a patch keeps its content
when the camera rolls or approaches. The inverse-compositional form linearises the template, hence
one 2x2 Hessian per point and level. A point is followed from the coarsest level of a pyramid to the
finest; what it found is trusted if the correlation of the patches is high and, for the
forward–backward check, if tracking back ends where it began.

Cost: points x levels x iterations x patch area; 400 points take a few milliseconds.

Reference: Baker, Matthews, "Lucas-Kanade 20 Years On", IJCV 2004; Kalal, Mikolajczyk, Matas,
"Forward-Backward Error", ICPR 2010.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = ["Flow", "FlowConfig", "align_patches", "pyramid", "track"]

Image = NDArray[np.uint8]
Points = NDArray[np.float64]


@dataclass(frozen=True)
class FlowConfig:
    """How points are followed from image to image."""

    half_window_px: int = 5
    """Half the patch's side: 5 gives 11x11 pixels."""
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
    """Where points went: (N, 2) float64 pixels, (N,) bool whether found, (N,) patch correlations."""

    points: Points
    found: NDArray[np.bool_]
    correlation: NDArray[np.float64]


def pyramid(image: Image, levels: int) -> tuple[Image, ...]:
    """Return the image and its halvings, finest first, each smoothed before it is sampled."""
    images = [np.ascontiguousarray(image)]
    for _ in range(levels - 1):
        images.append(cv2.pyrDown(images[-1]))
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
            target, template, forward.points[index], start, np.linalg.inv(warp[index]), config, 2
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


@kernel
def _sample_template(
    image: Image, x: float, y: float, B: NDArray[np.float64], half: int, patch: NDArray[np.float32]
) -> bool:
    """patch[v, u] = image((x, y) + B (u, v)), bilinear, with a margin of one pixel for gradients."""
    height, width = image.shape
    reach = half + 1.0
    rx = (abs(B[0, 0]) + abs(B[0, 1])) * reach
    ry = (abs(B[1, 0]) + abs(B[1, 1])) * reach
    if not (x - rx >= 0.0 and y - ry >= 0.0 and x + rx < width - 1.0 and y + ry < height - 1.0):
        return False
    for v in range(-half - 1, half + 2):
        for u in range(-half - 1, half + 2):
            sx = x + B[0, 0] * u + B[0, 1] * v
            sy = y + B[1, 0] * u + B[1, 1] * v
            ix, iy = int(sx), int(sy)
            fx, fy = sx - ix, sy - iy
            top = image[iy, ix] * (1.0 - fx) + image[iy, ix + 1] * fx
            low = image[iy + 1, ix] * (1.0 - fx) + image[iy + 1, ix + 1] * fx
            patch[v + half + 1, u + half + 1] = top * (1.0 - fy) + low * fy
    return True


@kernel
def _sample_target(image: Image, x: float, y: float, half: int, patch: NDArray[np.float32]) -> bool:
    """patch[v, u] = image((x, y) + (u, v)), bilinear; the four weights are the same for all pixels."""
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
        upper, lower = image[top + v], image[top + v + 1]
        for u in range(side):
            patch[v, u] = (
                w00 * np.float32(upper[left + u])
                + w01 * np.float32(upper[left + u + 1])
                + w10 * np.float32(lower[left + u])
                + w11 * np.float32(lower[left + u + 1])
            )
    return True


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
    area = np.float32(side * side)
    wide = np.empty((side + 2, side + 2), np.float32)
    T = np.empty((side, side), np.float32)
    gx = np.empty((side, side), np.float32)
    gy = np.empty((side, side), np.float32)
    patch = np.empty((side, side), np.float32)
    for i in range(len(points)):
        if not (np.isfinite(positions[i, 0]) and np.isfinite(positions[i, 1])):
            continue
        if not _sample_template(template, points[i, 0], points[i, 1], warp[i], half, wide):
            continue
        mean, mean_x, mean_y = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for v in range(side):
            for u in range(side):
                T[v, u] = wide[v + 1, u + 1]
                gx[v, u] = np.float32(0.5) * (wide[v + 1, u + 2] - wide[v + 1, u])
                gy[v, u] = np.float32(0.5) * (wide[v + 2, u + 1] - wide[v, u + 1])
                mean += T[v, u]
                mean_x += gx[v, u]
                mean_y += gy[v, u]
        mean, mean_x, mean_y = mean / area, mean_x / area, mean_y / area
        xx, xy, yy, energy = 0.0, 0.0, 0.0, np.float32(0.0)
        for v in range(side):
            for u in range(side):
                T[v, u] -= mean
                gx[v, u] -= mean_x
                gy[v, u] -= mean_y
                xx += gx[v, u] * gx[v, u]
                xy += gx[v, u] * gy[v, u]
                yy += gy[v, u] * gy[v, u]
                energy += T[v, u] * T[v, u]
        det = xx * yy - xy * xy
        smallest = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
        if (
            smallest < 2.0 * area or energy <= 0.0
        ):  # less than 1.4 grey levels per pixel: no texture
            continue
        x, y = positions[i, 0], positions[i, 1]
        for _ in range(iterations):
            if not _sample_target(target, x, y, half, patch):
                found[i] = False
                break
            mean_i, cross, power = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for v in range(side):
                for u in range(side):
                    mean_i += patch[v, u]
            mean_i /= area
            for v in range(side):
                for u in range(side):
                    difference = patch[v, u] - mean_i
                    patch[v, u] = difference
                    cross += difference * T[v, u]
                    power += difference * difference
            gain = max(cross / energy, np.float32(0.2))
            bx, by = np.float32(0.0), np.float32(0.0)
            for v in range(side):
                for u in range(side):
                    error = patch[v, u] - gain * T[v, u]
                    bx += gx[v, u] * error
                    by += gy[v, u] * error
            dx = (yy * bx - xy * by) / (det * gain)
            dy = (xx * by - xy * bx) / (det * gain)
            length = np.sqrt(dx * dx + dy * dy)
            if length > 2.0:  # a linearisation is good for a pixel or two
                dx, dy = dx * 2.0 / length, dy * 2.0 / length
            x, y = x - dx, y - dy
            correlation[i] = cross / np.sqrt(max(power * energy, np.float32(1e-12)))
            found[i] = True
            if length < 0.01:
                break
        if found[i]:
            positions[i, 0], positions[i, 1] = x, y


def warm_up() -> None:
    """Compile the kernels of this module."""
    image = np.random.default_rng(0).integers(0, 255, (32, 32)).astype(np.uint8)
    points = np.array([[16.0, 16.0]])
    track((image,), (image,), points, points, FlowConfig(levels=1))
