"""Optical flow of points: small patches followed between two images, coarse to fine.

A point is followed from the coarsest level of a pyramid, where a motion of many pixels is one of
few, to the finest, where its patch is aligned to a fiftieth of a pixel (`patches`). What was found
is trusted if the correlation of the patches is high and, for the forward–backward check, if
tracking back ends where it began. A local affine map, from the motion that is expected, lets a
patch keep its content when the camera rolls or approaches.

Cost: points x levels x iterations x patch area; 400 points take a few milliseconds.

Reference: Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", 2000; Kalal,
Mikolajczyk, Matas, "Forward-Backward Error", ICPR 2010.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.vision.patches import PRECISION_PX, Flow, align_patches
from odomap.vision.visionconfig import FlowConfig

__all__ = ["FlowConfig", "facing_warp", "pyramid", "track"]

Image = NDArray[np.uint8]
Points = NDArray[np.float64]

COARSE_PRECISION_PX = 0.1
"""The same on coarse levels, whose answer the next finer one improves on."""


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
        # The way back starts off by as much as the prediction was, as far as the finest level can
        # reach: from the answer itself it would agree too easily.
        start = points[index] + (forward.points[index] - guess[index]).clip(-2.0, 2.0)
        back = _coarse_to_fine(
            target,
            template,
            forward.points[index],
            start,
            np.asarray(np.linalg.inv(warp[index]), np.float64),
            config,
            1,
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
            PRECISION_PX if level == 0 else COARSE_PRECISION_PX,
        )
        # A patch that leaves the image or finds no texture on a coarse level keeps its position.
        positions = np.where(fine.found[:, None], fine.points / scale, positions)
        status, correlation = fine.found, fine.correlation
    return Flow(positions, status, correlation)


def facing_warp(points_camera: Points, T_template_camera: NDArray[np.float64]) -> Points:
    """Return how patches deform between two views, if their surfaces face the camera.

    Args:
        points_camera: (N, 3) the patches' centres in the target camera.
        T_template_camera: (4, 4) or (N, 4, 4) from the target to the template camera.

    Returns:
        (N, 2, 2) offsets in the template per offset in the target.
    """
    R = T_template_camera[..., :3, :3]
    there = (R @ points_camera[:, :, None])[:, :, 0] + T_template_camera[..., :3, 3]
    xy = there[:, :2] / there[:, 2:]
    ratio = (points_camera[:, 2] / there[:, 2])[:, None, None]
    return np.asarray(ratio * (R[..., :2, :2] - xy[:, :, None] * R[..., 2:, :2]))
