"""Zhang's start: a first guess of a camera from pictures of a plane.

The problem: a plane z = 0 seen by a pinhole K maps to the image by a homography
H = (h₁ h₂ h₃) ∝ K (r₁ r₂ t). That r₁ and r₂ are of one length and across each other gives two
equations per view, linear in the symmetric matrix ω = K⁻ᵀ K⁻¹,

    h₁ᵀ ω h₂ = 0,    h₁ᵀ ω h₁ = h₂ᵀ ω h₂,

whose null vector holds fx, fy, cx, cy once three views turn the plane in different ways. Distortion
and few or parallel views make the full solution wild, so two humbler ones stand beside it (centre
in the middle; square pixels too), and a caller compares what they explain. The pose of a plane
comes from the homography of its rays, turned so that they surround the axis: that works at the edge
of a fisheye picture, too. A small or distant plane has a second pose that looks nearly the same,
tilted the other way; both are refined and the better one is kept. O(V N).

Reference: Z. Zhang, "A flexible new technique for camera calibration", IEEE T-PAMI 22(11), 2000.
"""

import numpy as np
from numpy.typing import ArrayLike

from odomap.errors import InputError
from odomap.geometry.camera import Camera
from odomap.geometry.pnp import refine_pose
from odomap.geometry.pose import SE3
from odomap.geometry.so3 import Array, orthonormalize, tail_shape
from odomap.geometry.twoview import homography

__all__ = ["intrinsics_of_plane_views", "pose_of_plane"]

START_POINTS = 20


def intrinsics_of_plane_views(homographies: ArrayLike, resolution: tuple[int, int]) -> list[Array]:
    """Return guesses of fx fy cx cy from pictures of a plane, the most general one first.

    Args:
        homographies: (V, 3, 3) from the plane to pixels, V ≥ 1.
        resolution: width and height of the images, pixels.

    Returns:
        Up to three (4,) pixels; fewer where the views leave one undetermined.

    Example:
        >>> K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
        >>> view = lambda R: K @ np.column_stack([R[:, 0], R[:, 1], [0.0, 0.0, 2.0]])
        >>> turns = [(0.4, 0, 0.1), (0, 0.5, 0), (0.3, -0.4, 0.2)]
        >>> from odomap.geometry.lie import so3_exp
        >>> Hs = [view(so3_exp(np.array(turn))) for turn in turns]
        >>> intrinsics_of_plane_views(Hs, (640, 480))[0].round(6)
        array([500., 500., 320., 240.])
    """
    H = tail_shape(homographies, (3, 3), "homographies")
    if H.ndim != 3 or len(H) == 0:
        raise InputError(f"homographies: has shape {H.shape}, give (V, 3, 3)")
    width, height = resolution
    centre, scale = 0.5 * (np.array([width, height]) - 1.0), float(max(width, height))
    T = np.array(
        [[1 / scale, 0, -centre[0] / scale], [0, 1 / scale, -centre[1] / scale], [0, 0, 1]]
    )
    H = T @ H
    H = H / np.linalg.norm(H, axis=(1, 2), keepdims=True)
    h1, h2 = H[:, :, 0], H[:, :, 1]
    rows = np.concatenate([_row(h1, h2), _row(h1, h1) - _row(h2, h2)])
    guesses = []
    for columns in (slice(0, 5), slice(0, 3)):
        if len(rows) >= rows[:, columns].shape[1] - 1:
            guesses.append(_read_off(_null_vector(rows[:, columns])))
    square = np.stack([rows[:, 0] + rows[:, 1], rows[:, 2]], axis=1)
    a, c = _null_vector(square)
    guesses.append(_read_off(np.array([a, a, c])))
    found = []
    for guess in guesses:
        if guess is not None and np.all(np.abs(guess[2:]) < 0.5):
            pixels = scale * guess
            pixels[2:] += centre
            found.append(pixels)
    return found


def _row(a: Array, b: Array) -> Array:
    """Return the coefficients (V, 5) of ω₁₁ ω₂₂ ω₃₃ ω₁₃ ω₂₃ in aᵀ ω b, ω₁₂ = 0."""
    return np.stack(
        [
            a[:, 0] * b[:, 0],
            a[:, 1] * b[:, 1],
            a[:, 2] * b[:, 2],
            a[:, 0] * b[:, 2] + a[:, 2] * b[:, 0],
            a[:, 1] * b[:, 2] + a[:, 2] * b[:, 1],
        ],
        axis=1,
    )


def _null_vector(rows: Array) -> Array:
    return np.asarray(np.linalg.svd(np.pad(rows, ((0, rows.shape[1]), (0, 0))))[2][-1])


def _read_off(omega: Array) -> Array | None:
    """Return fx fy cx cy of ω₁₁ ω₂₂ ω₃₃ [ω₁₃ ω₂₃] of any sign, or None if no camera has it."""
    w11, w22, w33, w13, w23 = np.pad(omega, (0, 5 - len(omega)))
    if w11 == 0 or w22 == 0:
        return None
    scale = w33 - w13 * w13 / w11 - w23 * w23 / w22
    fx2, fy2 = scale / w11, scale / w22
    if not (1e-4 < fx2 < 1e4 and 1e-4 < fy2 < 1e4):
        return None
    return np.array([np.sqrt(fx2), np.sqrt(fy2), -w13 / w11, -w23 / w22])


def pose_of_plane(
    points_plane: ArrayLike, pixels: ArrayLike, camera: Camera, *, mirrored: bool = True
) -> tuple[SE3, float]:
    """Find where a camera sees known points of the plane z = 0.

    Args:
        points_plane: (N, 3) metres, z = 0, N ≥ 6.
        pixels: (N, 2) raw image.
        camera: the camera, at least roughly known.
        mirrored: whether to try the pose tilted the other way, too.

    Returns:
        T_camera_plane, and the root mean square reprojection error in pixels; infinite where no
        pose was found.
    """
    points, uv = tail_shape(points_plane, (3,), "points_plane"), tail_shape(pixels, (2,), "pixels")
    rays = camera.unproject(uv)
    seen = np.asarray(np.isfinite(rays).all(axis=1))
    # The refinement works on x/z: what a fisheye sees beside or behind itself has no say there.
    ahead = np.where((rays[:, 2:] > 0.1) & seen[:, None], uv, np.nan)
    if np.count_nonzero(seen) < 6:
        return SE3.identity(), np.inf
    # A start needs no more than a few points, spread over all of them.
    count = np.count_nonzero(seen)
    few = np.unique(np.linspace(0, count - 1, START_POINTS).round().astype(int))
    start = _pose_of_rays(points[seen][few], rays[seen][few])
    if start is None:
        return SE3.identity(), np.inf
    best, least = start, _error(start, points, uv, camera)
    guesses = [start, _tilted_back(start, points.mean(axis=0))] if mirrored else [start]
    for guess in guesses:
        found = refine_pose(
            points, ahead, camera, guess.inverse(), huber=3.0
        ).T_world_camera.inverse()
        error = _error(found, points, uv, camera)
        if error < least:
            best, least = found, error
    return best, least


def _error(T_camera_plane: SE3, points: Array, pixels: Array, camera: Camera) -> float:
    gap = camera.project(T_camera_plane @ points) - pixels
    # A point the lens cannot see is as wrong as the image is large.
    gap = np.where(np.isfinite(gap), gap, float(camera.width))
    return float(np.sqrt(np.mean(np.sum(gap * gap, axis=1))))


def _pose_of_rays(points: Array, rays: Array) -> SE3 | None:
    """Return the pose from the homography of rays, turned so that their mean is the axis."""
    z = rays.mean(axis=0)
    z /= np.linalg.norm(z)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    turn = np.stack([x, np.cross(z, x), z])
    ahead = rays @ turn.T
    if np.any(ahead[:, 2] < 0.05):
        return None
    H = homography(points[:, :2], ahead[:, :2] / ahead[:, 2:])
    lengths = np.linalg.norm(H[:, :2], axis=0)
    if np.any(lengths < 1e-12):
        return None
    H = H * (2.0 / lengths.sum()) * (1.0 if H[2] @ [*points[:, :2].mean(axis=0), 1.0] > 0 else -1.0)
    R = np.column_stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])])
    return SE3.from_parts(turn.T @ orthonormalize(R), turn.T @ H[:, 2])


def _tilted_back(T_camera_plane: SE3, middle: Array) -> SE3:
    """Mirror a plane in the plane across the line of sight to its middle."""
    at = T_camera_plane @ middle
    sight = at / np.linalg.norm(at)
    r = T_camera_plane.R[:, :2]
    r = r - 2.0 * np.outer(sight, sight @ r)
    R = np.column_stack([r, np.cross(r[:, 0], r[:, 1])])
    return SE3.from_parts(R, at - R @ middle)
