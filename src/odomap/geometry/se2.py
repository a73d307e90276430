"""Rigid motions of the plane: SO(2) and SE(2).

The problem: poses of wheeled robots and 2D scans. The tangent is ξ = (x, y, θ), metres and radians;

    exp(ξ) = [[R(θ), V ρ], [0, 1]],   V = [[c₁, -θ c₂], [θ c₂, c₁]]
    J_l    = [[V, (m_y, -m_x)], [0, 1]],   m = [[c₂, -θ c₃], [θ c₃, c₂]] ρ

with the Stumpff functions c_k(θ²) of `so3`; J_l is the mean of Ad(exp(u ξ)) over u in 0..1, which
gives m. The angle of the logarithm lies in (-π, π]. Batched over leading dimensions, O(1) per item.

Reference: J. Solà, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics",
arXiv:1812.01537, 2018.
"""

import numpy as np
from numpy.typing import ArrayLike

from odomap.geometry.so3 import Array, half_cot, stumpff, tail_shape

__all__ = [
    "se2_adjoint",
    "se2_exp",
    "se2_inverse",
    "se2_left_jacobian",
    "se2_left_jacobian_inverse",
    "se2_log",
    "se2_right_jacobian",
    "se2_right_jacobian_inverse",
    "so2_exp",
    "so2_log",
]


def so2_exp(theta: ArrayLike) -> Array:
    """Return the rotation of the plane by theta.

    Args:
        theta: (...) rad.

    Returns:
        (..., 2, 2).
    """
    angle = np.asarray(theta, dtype=np.float64)
    return _complex_matrix(np.cos(angle), np.sin(angle))


def so2_log(R: ArrayLike) -> Array:
    """Return the angle of a rotation of the plane.

    Args:
        R: (..., 2, 2).

    Returns:
        (...) in (-π, π].
    """
    m = tail_shape(R, (2, 2), "R")
    return np.asarray(np.arctan2(m[..., 1, 0] - m[..., 0, 1], m[..., 0, 0] + m[..., 1, 1]))


def _complex_matrix(real: Array, imaginary: Array) -> Array:
    """Return [[a, -b], [b, a]]: multiplication by a + ib."""
    out = np.empty((*np.shape(real), 2, 2))
    out[..., 0, 0] = out[..., 1, 1] = real
    out[..., 1, 0], out[..., 0, 1] = imaginary, -imaginary
    return out


def se2_exp(xi: ArrayLike) -> Array:
    """Return the motion of following the twist for unit time.

    Args:
        xi: (..., 3) x, y, θ; metres and radians.

    Returns:
        (..., 3, 3).
    """
    v = tail_shape(xi, (3,), "xi")
    theta = v[..., 2]
    _, c1, c2, *_ = stumpff(theta * theta)
    out = np.zeros((*v.shape, 3))
    out[..., :2, :2] = so2_exp(theta)
    out[..., :2, 2] = (_complex_matrix(c1, theta * c2) @ v[..., :2, None])[..., 0]
    out[..., 2, 2] = 1.0
    return out


def se2_log(T: ArrayLike) -> Array:
    """Return the twist of a motion, its angle in (-π, π].

    Args:
        T: (..., 3, 3).

    Returns:
        (..., 3) x, y, θ.
    """
    m = tail_shape(T, (3, 3), "T")
    theta = so2_log(m[..., :2, :2])
    V_inverse = _complex_matrix(1.0 - theta * theta * half_cot(theta * theta), -0.5 * theta)
    rho = (V_inverse @ m[..., :2, 2:])[..., 0]
    return np.concatenate([rho, theta[..., None]], axis=-1)


def se2_inverse(T: ArrayLike) -> Array:
    """Return the inverse motion.

    Args:
        T: (..., 3, 3).

    Returns:
        (..., 3, 3).
    """
    m = tail_shape(T, (3, 3), "T")
    out = np.zeros_like(m)
    out[..., :2, :2] = np.swapaxes(m[..., :2, :2], -1, -2)
    out[..., :2, 2:] = -out[..., :2, :2] @ m[..., :2, 2:]
    out[..., 2, 2] = 1.0
    return out


def se2_adjoint(T: ArrayLike) -> Array:
    """Return Ad with T exp(ξ) = exp(Ad ξ) T.

    Args:
        T: (..., 3, 3).

    Returns:
        (..., 3, 3).
    """
    m = tail_shape(T, (3, 3), "T")
    out = m.copy()
    out[..., 0, 2], out[..., 1, 2] = m[..., 1, 2], -m[..., 0, 2]
    return out


def se2_left_jacobian(xi: ArrayLike) -> Array:
    """Return J_l with exp(ξ + δ) ≈ exp(J_l δ) exp(ξ).

    Args:
        xi: (..., 3) x, y, θ.

    Returns:
        (..., 3, 3).
    """
    v = tail_shape(xi, (3,), "xi")
    theta = v[..., 2]
    _, c1, c2, c3, *_ = stumpff(theta * theta)
    mean = (_complex_matrix(c2, theta * c3) @ v[..., :2, None])[..., 0]
    out = np.zeros((*v.shape, 3))
    out[..., :2, :2] = _complex_matrix(c1, theta * c2)
    out[..., 0, 2], out[..., 1, 2] = mean[..., 1], -mean[..., 0]
    out[..., 2, 2] = 1.0
    return out


def se2_right_jacobian(xi: ArrayLike) -> Array:
    """Return J_r with exp(ξ + δ) ≈ exp(ξ) exp(J_r δ); shapes as `se2_left_jacobian`."""
    return se2_left_jacobian(-tail_shape(xi, (3,), "xi"))


def se2_left_jacobian_inverse(xi: ArrayLike) -> Array:
    """Return the inverse of `se2_left_jacobian`; singular only at |θ| = 2π."""
    return np.asarray(np.linalg.inv(se2_left_jacobian(xi)))


def se2_right_jacobian_inverse(xi: ArrayLike) -> Array:
    """Return the inverse of `se2_right_jacobian`; singular only at |θ| = 2π."""
    return np.asarray(np.linalg.inv(se2_right_jacobian(xi)))
