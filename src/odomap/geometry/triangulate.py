"""Triangulation: where a point is that several cameras saw.

The problem: the rays of one point never quite meet. The point nearest to all of them is linear,

    Σ (I - b bᵀ) (p - c) = 0        c a camera's centre, b its unit ray, world axes

and Gauss-Newton from there minimises the reprojection error Σ |π(T_camera_world p) - x|² on the
plane z = 1, which is what the noise is about. How well the depth is known depends on the parallax,
the widest angle between two rays: below a degree a point is a direction. All points at once:
O(views · points).

Reference: R. Hartley, A. Zisserman, "Multiple View Geometry in Computer Vision", 2nd ed., Cambridge
University Press 2004, chapter 12.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import InputError
from odomap.geometry.lie import se3_inverse
from odomap.geometry.so3 import Array, tail_shape

__all__ = ["Triangulation", "parallax", "triangulate"]

_PARALLEL = 1e-6
"""Radians between two rays below which they have no point in common."""


@dataclass(frozen=True)
class Triangulation:
    """Points and what speaks for them.

    Attributes:
        points_world: (N, 3) metres, NaN where fewer than two views saw the point, or along rays
            that are parallel to a millionth of a radian.
        parallax: (N,) widest angle between two observed rays, rad; 0 where fewer than two saw it.
        errors: (N,) root mean square reprojection error over the views, on the plane z = 1;
            infinite behind a camera.
        ahead: (N,) bool, the point lies in front of every camera that saw it.
    """

    points_world: Array
    parallax: Array
    errors: Array
    ahead: NDArray[np.bool_]


def triangulate(
    Ts_world_camera: ArrayLike, normalised: ArrayLike, iterations: int = 5
) -> Triangulation:
    """Find points from where several cameras saw them.

    Args:
        Ts_world_camera: (V, 4, 4) poses of the cameras, V ≥ 2.
        normalised: (V, N, 2) x/z, y/z as `Camera.undistort` gives them; NaN where not seen.
        iterations: Gauss-Newton steps.

    Returns:
        The points, with parallax, error, and whether they lie ahead.

    Raises:
        InputError: shapes do not agree.

    Example:
        >>> Ts = np.tile(np.eye(4), (2, 1, 1)); Ts[1, 0, 3] = 1.0
        >>> triangulate(Ts, [[[0.0, 0.0]], [[-0.5, 0.0]]]).points_world.round(6) + 0.0
        array([[0., 0., 2.]])
    """
    poses = tail_shape(Ts_world_camera, (4, 4), "Ts_world_camera")
    seen_at = tail_shape(normalised, (2,), "normalised")
    if poses.ndim != 3 or len(poses) < 2 or seen_at.ndim != 3 or len(seen_at) != len(poses):
        raise InputError(
            f"Ts_world_camera, normalised: shapes {poses.shape}, {seen_at.shape}, "
            "give (V, 4, 4), (V, N, 2) with V ≥ 2"
        )
    seen: NDArray[np.bool_] = np.all(np.isfinite(seen_at), axis=2)
    x = np.where(seen[..., None], seen_at, 0.0)
    weight: Array = seen.astype(np.float64)
    rays = np.einsum("vij,vnj->vni", poses[:, :3, :3], np.insert(x, 2, 1.0, axis=2))
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    angles = _widest_angle(rays, seen)
    enough = angles > _PARALLEL
    points = _nearest_to_rays(poses[:, :3, 3], rays, np.where(enough, weight, 0.0))
    views = se3_inverse(poses)
    points, cost = _refined(views, x, weight, points, iterations)
    depth = np.einsum("vj,nj->vn", views[:, 2, :3], points) + views[:, 2, 3, None]
    count = np.maximum(np.count_nonzero(seen, axis=0), 1)
    ahead = enough & np.all(~seen | (depth > 0), axis=0)
    points = np.where(enough[:, None], points, np.nan)
    return Triangulation(points, angles, np.sqrt(cost / count), ahead)


def _refined(
    views: Array, x: Array, weight: Array, points: Array, iterations: int
) -> tuple[Array, Array]:
    """Take damped Gauss-Newton steps, each point by itself; return the points and their cost."""
    cost, H, g = _linearised(views, x, weight, points)
    damping = np.full(len(points), 1e-6)
    for _ in range(iterations):
        lift = damping * np.trace(H, axis1=1, axis2=2)
        A = H + lift[:, None, None] * np.eye(3)
        A[~(np.abs(np.linalg.det(A)) > 0)] = np.eye(3)
        moved = points - np.linalg.solve(A, g[..., None])[..., 0]
        new_cost, new_H, new_g = _linearised(views, x, weight, moved)
        # Rays that meet behind a camera (infinite cost) are left there: no step makes them true.
        better = (new_cost <= cost) & np.isfinite(cost)
        points, cost = np.where(better[:, None], moved, points), np.where(better, new_cost, cost)
        H, g = np.where(better[:, None, None], new_H, H), np.where(better[:, None], new_g, g)
        damping = np.where(better, 0.1 * damping, 1e3 * damping)
    return points, cost


def parallax(centres: ArrayLike, points: ArrayLike) -> Array:
    """Return the widest angle under which points see the cameras.

    Args:
        centres: (V, 3) camera centres, metres.
        points: (N, 3) metres, same frame.

    Returns:
        (N,) rad.
    """
    c, p = tail_shape(centres, (3,), "centres"), tail_shape(points, (3,), "points")
    if c.ndim != 2 or p.ndim != 2:
        raise InputError(f"centres, points: shapes {c.shape}, {p.shape}, give (V, 3), (N, 3)")
    return _widest_angle(p[None] - c[:, None], np.ones((len(c), len(p)), dtype=np.bool_))


def _widest_angle(rays: Array, seen: NDArray[np.bool_]) -> Array:
    """The angle by atan2 of cross and dot product, which is exact for small ones."""
    widest = np.zeros(rays.shape[1])
    for i in range(len(rays)):
        for j in range(i + 1, len(rays)):
            cross = np.linalg.norm(np.cross(rays[i], rays[j]), axis=1)
            angle = np.arctan2(cross, np.sum(rays[i] * rays[j], axis=1))
            widest = np.where(seen[i] & seen[j], np.fmax(widest, angle), widest)
    return widest


def _nearest_to_rays(centres: Array, b: Array, weight: Array) -> Array:
    """Solve Σ w (I - b bᵀ)(p - c) = 0 for each point; those without weight come out as 0."""
    across = weight[..., None, None] * (np.eye(3) - b[..., :, None] * b[..., None, :])
    A = np.sum(across, axis=0)
    y = np.einsum("vnij,vj->ni", across, centres)
    A[~np.any(weight, axis=0)] = np.eye(3)
    return np.asarray(np.linalg.solve(A, y[..., None])[..., 0])


def _linearised(views: Array, x: Array, weight: Array, points: Array) -> tuple[Array, Array, Array]:
    """Return Σ w |r|², JᵀJ and Jᵀr of every point; infinite cost behind a camera."""
    R, t = views[:, :3, :3], views[:, :3, 3]
    p = np.einsum("vij,nj->vni", R, points) + t[:, None]
    behind = np.any((weight > 0) & (p[..., 2] <= 0), axis=0)
    z = np.where(p[..., 2] > 0, p[..., 2], 1.0)
    uv = p[..., :2] / z[..., None]
    r = weight[..., None] * (uv - x)
    J = (R[:, None, :2, :] - uv[..., None] * R[:, None, 2:, :]) * (weight / z)[..., None, None]
    cost = np.where(behind, np.inf, np.sum(r * r, axis=(0, 2)))
    return cost, np.einsum("vnki,vnkj->nij", J, J), np.einsum("vnki,vnk->ni", J, r)
