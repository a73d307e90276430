"""Turning: how a camera turned between two images, from the images as a whole.

A hand turns a camera by degrees per frame, which moves all points by tens of pixels: more than
patches can be followed over, and more than a constant velocity foresees. Small blurred images
still overlap. With the ray b of a pixel x, a turn R moves the pixel to π(K R b), and the R wanted
minimises

    Σ_x ( I_now(π(K R b)) − I_before(x) − m )²

over all pixels, m the difference in mean brightness, by Gauss-Newton from no turn at all. The
roles are exchanged in each step (inverse composition), so that Jacobian and normal matrix belong
to the first image and are made once.

Cost: a few thousand pixels x 15 steps, half a millisecond.

Reference: Klein, Murray, "Improving the Agility of Keyframe-Based SLAM", ECCV 2008; Baker,
Matthews, "Lucas-Kanade 20 Years On", IJCV 2004.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.geometry.camera import Camera
from odomap.geometry.lie import so3_exp
from odomap.kernels import kernel

__all__ = ["Thumbnail", "turn_between", "warm_up"]

Array = NDArray[np.float64]

LARGEST_SIDE_PX = 110
"""Images are halved until they are no wider."""
STEPS = 15
LARGEST_TURN = 0.5
"""Radians; beyond this the images hardly overlap."""
LEAST_SLOPE = 0.01
"""Grey levels per pixel that a turn about any axis must change; less is rounding and noise."""


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """A small blurred image.

    Attributes:
        image: (h, w) float32.
        intrinsics: (4,) fx fy cx cy of it, pixels.
    """

    image: NDArray[np.float32]
    intrinsics: Array

    @staticmethod
    def of(image: NDArray[np.uint8], camera: Camera) -> "Thumbnail":
        """Make one.

        Args:
            image: (H, W) of a pinhole, or a halving of it.
            camera: the pinhole.
        """
        scale = image.shape[1] / camera.width
        small = image
        while small.shape[1] > LARGEST_SIDE_PX:
            small, scale = np.asarray(cv2.pyrDown(small), np.uint8), 0.5 * scale
        blurred = cv2.GaussianBlur(small.astype(np.float32), (0, 0), 1.5)
        return Thumbnail(np.ascontiguousarray(blurred), scale * np.array(camera.intrinsics))


def turn_between(before: Thumbnail, now: Thumbnail) -> Array | None:
    """Find how the camera turned.

    Args:
        before: the earlier image.
        now: the later one, of the same camera.

    Returns:
        R_before_now (3, 3), or None if no turn makes the images agree better than none does, or
        the earlier one has no texture.
    """
    R, lowest = np.eye(3), np.inf
    J, H = np.empty((*before.image.shape, 3)), np.zeros((3, 3))
    _jacobian_kernel(before.image, before.intrinsics, J, H)
    unit = J.shape[0] * J.shape[1] * before.intrinsics[0] ** 2
    if not np.linalg.eigvalsh(H)[0] > LEAST_SLOPE**2 * unit:
        return None
    inverse, best, gradient = np.linalg.inv(H), np.eye(3), np.empty(3)
    for _ in range(STEPS):
        cost = _residual_kernel(before.image, now.image, before.intrinsics, R, J, gradient)
        if not np.isfinite(cost):
            break
        if cost < lowest:
            best, lowest = R, cost
        move = inverse @ gradient
        R = R @ so3_exp(-move)
        if np.linalg.norm(move) < 1e-4:
            break
    angle = np.arccos(np.clip(0.5 * (np.trace(best) - 1.0), -1.0, 1.0))
    return np.ascontiguousarray(best.T) if 0.0 < angle <= LARGEST_TURN else None


@kernel
def _jacobian_kernel(image: NDArray[np.float32], intrinsics: Array, J: Array, H: Array) -> None:
    """J = ∇I ∂π(K exp(φ^) b)/∂φ at 0 for each pixel, zero at the rim; H = Σ Jᵀ J."""
    fx, fy, cx, cy = intrinsics
    height, width = image.shape
    J[:, :, :] = 0.0
    for v in range(1, height - 1):
        for u in range(1, width - 1):
            gx = 0.5 * (image[v, u + 1] - image[v, u - 1]) * fx
            gy = 0.5 * (image[v + 1, u] - image[v - 1, u]) * fy
            x, y = (u - cx) / fx, (v - cy) / fy
            # A turn by φ moves (x, y, 1) by φ × (x, y, 1).
            J[v, u, 0] = -gx * x * y - gy * (1.0 + y * y)
            J[v, u, 1] = gx * (1.0 + x * x) + gy * x * y
            J[v, u, 2] = -gx * y + gy * x
            for a in range(3):
                for b in range(3):
                    H[a, b] += J[v, u, a] * J[v, u, b]


@kernel
def _residual_kernel(
    before: NDArray[np.float32],
    now: NDArray[np.float32],
    intrinsics: Array,
    R: Array,
    J: Array,
    gradient: Array,
) -> float:
    """Write Σ Jᵀ r over the overlap, scaled to all pixels; return the mean of r², or infinity."""
    fx, fy, cx, cy = intrinsics
    height, width = before.shape
    mean, count = 0.0, 0
    for turn in range(2):
        total, squares = 0.0, 0.0
        gradient[:] = 0.0
        for v in range(height):
            for u in range(width):
                x, y = (u - cx) / fx, (v - cy) / fy
                Z = R[2, 0] * x + R[2, 1] * y + R[2, 2]
                if Z < 0.1:
                    continue
                p = fx * (R[0, 0] * x + R[0, 1] * y + R[0, 2]) / Z + cx
                q = fy * (R[1, 0] * x + R[1, 1] * y + R[1, 2]) / Z + cy
                if not (p >= 0.0 and q >= 0.0 and p < width - 1 and q < height - 1):
                    continue
                i, k = int(p), int(q)
                a, b = p - i, q - k
                top = (1.0 - a) * now[k, i] + a * now[k, i + 1]
                low = (1.0 - a) * now[k + 1, i] + a * now[k + 1, i + 1]
                r = (1.0 - b) * top + b * low - before[v, u] - mean
                total += r
                squares += r * r
                for c in range(3):
                    gradient[c] += J[v, u, c] * r
                if turn == 0:
                    count += 1
        if count < 0.2 * height * width:
            return np.inf
        if turn == 0:
            mean = total / count
        else:
            for c in range(3):
                gradient[c] *= height * width / count
            return squares / count
    return np.inf


def warm_up() -> None:
    """Compile the kernels of this module."""
    image = np.random.default_rng(0).integers(0, 255, (24, 32)).astype(np.uint8)
    camera = Camera(intrinsics=np.array([30.0, 30.0, 15.5, 11.5]), resolution=(32, 24))
    turn_between(Thumbnail.of(image, camera), Thumbnail.of(image, camera))
