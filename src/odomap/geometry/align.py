"""Alignment: the motion that brings one set of points onto another.

The problem: an estimated path lives in its own frame, a monocular one also at its own scale. Find
s, R, t that minimise Σ |y_i - (s R x_i + t)|². With centred points and the singular value
decomposition of their covariance, (1/n) Σ y xᵀ = U D Vᵀ,

    R = U S Vᵀ,   s = tr(D S) / var(x),   t = ȳ - s R x̄,   S = diag(1, 1, det U det V)

S keeps R a rotation where the points are flat or mirrored. When gravity is known only the heading
is free: R = Rz(ψ), ψ = atan2(Σ x₁y₂ - x₂y₁, Σ x₁y₁ + x₂y₂). O(N), closed form.

Reference: S. Umeyama, "Least-squares estimation of transformation parameters between two point
patterns", IEEE T-PAMI 13(4), 1991.
"""

import numpy as np
from numpy.typing import ArrayLike

from odomap.errors import InputError
from odomap.geometry.pose import Sim3
from odomap.geometry.so3 import Array, tail_shape

__all__ = ["umeyama", "yaw_only"]


def umeyama(source: ArrayLike, target: ArrayLike, with_scale: bool = False) -> Sim3:
    """Return the similarity that best maps source points onto target points.

    Args:
        source: (N, 3), N ≥ 3.
        target: (N, 3), the same points in the target frame.
        with_scale: also estimate the scale; else it is 1.

    Returns:
        T_target_source.

    Raises:
        InputError: wrong shapes, fewer than 3 points, not finite, or no scale in points that agree.

    Example:
        >>> points = np.eye(3)
        >>> round(umeyama(points, 2.0 * points, with_scale=True).scale, 9)
        2.0
    """
    x, y = _pairs(source, target)
    x_mean, y_mean = x.mean(axis=0), y.mean(axis=0)
    xc, yc = x - x_mean, y - y_mean
    U, d, Vt = np.linalg.svd(yc.T @ xc / len(x))
    sign = np.ones(3)
    sign[2] = 1.0 if np.linalg.det(U) * np.linalg.det(Vt) > 0 else -1.0
    R = (U * sign) @ Vt
    scale = 1.0
    if with_scale:
        spread = float(np.sum(xc * xc)) / len(x)
        scale = float(d @ sign) / spread if spread > 0 else 0.0
        if not scale > 0:
            raise InputError("umeyama: points coincide or are mirrored, the scale is undefined")
    return Sim3.from_parts(scale, R, y_mean - scale * R @ x_mean)


def yaw_only(source: ArrayLike, target: ArrayLike) -> Sim3:
    """Return the shift and turn about z that best map source points onto target points.

    Args:
        source: (N, 3), N ≥ 3, z up.
        target: (N, 3), the same points in the target frame, z up.

    Returns:
        T_target_source, of scale 1.
    """
    x, y = _pairs(source, target)
    x_mean, y_mean = x.mean(axis=0), y.mean(axis=0)
    xc, yc = x - x_mean, y - y_mean
    sine = float(np.sum(xc[:, 0] * yc[:, 1] - xc[:, 1] * yc[:, 0]))
    cosine = float(np.sum(xc[:, 0] * yc[:, 0] + xc[:, 1] * yc[:, 1]))
    psi = np.arctan2(sine, cosine)
    c, s = np.cos(psi), np.sin(psi)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return Sim3.from_parts(1.0, R, y_mean - R @ x_mean)


def _pairs(source: ArrayLike, target: ArrayLike) -> tuple[Array, Array]:
    x, y = tail_shape(source, (3,), "source"), tail_shape(target, (3,), "target")
    if x.ndim != 2 or x.shape != y.shape:
        raise InputError(f"source, target: have shapes {x.shape}, {y.shape}, give (N, 3) twice")
    if len(x) < 3:
        raise InputError(f"source, target: {len(x)} points, at least 3 are needed")
    if not (np.all(np.isfinite(x)) and np.all(np.isfinite(y))):
        raise InputError("source, target: have NaN or infinite entries, drop those rows")
    return x, y
