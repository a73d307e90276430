"""Rigid motions in space: SE(3).

The problem: a pose has six degrees of freedom, ξ = (ρ, φ): translation first, metres and radians.

    exp(ξ) = [[exp(φ^), J ρ], [0, 1]]        J = J_l(φ) of SO(3)
    J_l(ξ) = [[J, Q], [0, J]]                J_l⁻¹ = [[J⁻¹, -J⁻¹ Q J⁻¹], [0, J⁻¹]]
    Q      = ρ^/2 + c₃ (φ^ρ^ + ρ^φ^ + φ^ρ^φ^) + c₄ (φ^φ^ρ^ + ρ^φ^φ^ - 3 φ^ρ^φ^)
             + (c₄ - 3 c₅)/2 (φ^ρ^φ^φ^ + φ^φ^ρ^φ^)

with the Stumpff functions c_k(θ²) of `so3`, in which none of these coefficients cancels at small
angles. Ad(T) = [[R, t^ R], [0, R]]. Batched over leading dimensions, O(1) per item.

Reference: T. D. Barfoot, P. T. Furgale, "Associating uncertainty with three-dimensional poses for
use in estimation problems", IEEE T-RO 30(3), 2014 (the Q matrix).
"""

import numpy as np
from numpy.typing import ArrayLike

from odomap.geometry.so3 import (
    Array,
    hat,
    so3_exp,
    so3_left_jacobian,
    so3_left_jacobian_inverse,
    so3_log,
    stumpff,
    tail_shape,
)

__all__ = [
    "se3_adjoint",
    "se3_exp",
    "se3_inverse",
    "se3_left_jacobian",
    "se3_left_jacobian_inverse",
    "se3_log",
    "se3_right_jacobian",
    "se3_right_jacobian_inverse",
]


def se3_exp(xi: ArrayLike) -> Array:
    """Return the motion of following the twist for unit time.

    Args:
        xi: (..., 6) translation, rotation; metres and radians.

    Returns:
        (..., 4, 4).
    """
    v = tail_shape(xi, (6,), "xi")
    out = np.zeros((*v.shape[:-1], 4, 4))
    out[..., :3, :3] = so3_exp(v[..., 3:])
    out[..., :3, 3:] = so3_left_jacobian(v[..., 3:]) @ v[..., :3, None]
    out[..., 3, 3] = 1.0
    return out


def se3_log(T: ArrayLike) -> Array:
    """Return the twist of a motion, its rotation of length 0 to π.

    Args:
        T: (..., 4, 4).

    Returns:
        (..., 6) translation, rotation.
    """
    m = tail_shape(T, (4, 4), "T")
    phi = so3_log(m[..., :3, :3])
    rho = (so3_left_jacobian_inverse(phi) @ m[..., :3, 3:])[..., 0]
    return np.concatenate([rho, phi], axis=-1)


def se3_inverse(T: ArrayLike) -> Array:
    """Return the inverse motion.

    Args:
        T: (..., 4, 4).

    Returns:
        (..., 4, 4).
    """
    m = tail_shape(T, (4, 4), "T")
    out = np.zeros_like(m)
    out[..., :3, :3] = np.swapaxes(m[..., :3, :3], -1, -2)
    out[..., :3, 3:] = -out[..., :3, :3] @ m[..., :3, 3:]
    out[..., 3, 3] = 1.0
    return out


def se3_adjoint(T: ArrayLike) -> Array:
    """Return Ad with T exp(ξ) = exp(Ad ξ) T.

    Args:
        T: (..., 4, 4).

    Returns:
        (..., 6, 6).
    """
    m = tail_shape(T, (4, 4), "T")
    R = m[..., :3, :3]
    out = np.zeros((*m.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., :3, 3:] = hat(m[..., :3, 3]) @ R
    return out


def _coupling(xi: Array) -> Array:
    """Return Q, the block of the left Jacobian that couples translation to rotation."""
    rho, phi = hat(xi[..., :3]), hat(xi[..., 3:])
    _, _, _, c3, c4, c5 = stumpff(np.sum(xi[..., 3:] ** 2, axis=-1))
    c3, c4, c6 = (c[..., None, None] for c in (c3, c4, 0.5 * (c4 - 3.0 * c5)))
    pr, rp = phi @ rho, rho @ phi
    prp = pr @ phi
    return np.asarray(
        0.5 * rho
        + c3 * (pr + rp + prp)
        + c4 * (phi @ pr + rp @ phi - 3.0 * prp)
        + c6 * (prp @ phi + phi @ prp)
    )


def se3_left_jacobian(xi: ArrayLike) -> Array:
    """Return J_l with exp(ξ + δ) ≈ exp(J_l δ) exp(ξ).

    Args:
        xi: (..., 6) translation, rotation.

    Returns:
        (..., 6, 6).
    """
    v = tail_shape(xi, (6,), "xi")
    out = np.zeros((*v.shape, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = so3_left_jacobian(v[..., 3:])
    out[..., :3, 3:] = _coupling(v)
    return out


def se3_right_jacobian(xi: ArrayLike) -> Array:
    """Return J_r with exp(ξ + δ) ≈ exp(ξ) exp(J_r δ); shapes as `se3_left_jacobian`."""
    return se3_left_jacobian(-tail_shape(xi, (6,), "xi"))


def se3_left_jacobian_inverse(xi: ArrayLike) -> Array:
    """Return the inverse of `se3_left_jacobian`; singular only at a rotation of 2π.

    Args:
        xi: (..., 6) translation, rotation.

    Returns:
        (..., 6, 6).
    """
    v = tail_shape(xi, (6,), "xi")
    inverse = so3_left_jacobian_inverse(v[..., 3:])
    out = np.zeros((*v.shape, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = inverse
    out[..., :3, 3:] = -inverse @ _coupling(v) @ inverse
    return out


def se3_right_jacobian_inverse(xi: ArrayLike) -> Array:
    """Return the inverse of `se3_right_jacobian`; shapes as `se3_left_jacobian_inverse`."""
    return se3_left_jacobian_inverse(-tail_shape(xi, (6,), "xi"))
