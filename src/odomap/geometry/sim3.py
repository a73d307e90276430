"""Similarities in space: Sim(3), a rigid motion with a scale.

The problem: a single camera knows no metres, so maps made from it meet at different scales. The
tangent is ξ = (ρ, φ, λ): translation, rotation, log of the scale.

    exp(ξ) = [[e^λ exp(φ^), W ρ], [0, 1]],   W = ∫₀¹ e^{λu} exp(u φ^) du = C I + A φ^ + B φ^²
    A = (e^λ (λ c₁ - c₀) + 1) / (λ² + θ²)
    B = (e^λ (λ c₂ - c₁) + C) / (λ² + θ²),   C = (e^λ - 1) / λ

c_k(θ²) are the Stumpff functions of `so3`. Written so, nothing cancels once λ² + θ² ≥ 1; below, A
and B are summed as the power series of (e^z - 1)/z at z = λ + iθ, by a real three-term recursion.
Ad(T) = [[sR, t^ R, -t], [0, R, 0], [0, 0, 1]], and J_l = Σ adⁿ/(n+1)! is summed for ad/2^k and
doubled k times by J(2x) = (exp(ad x) + I) J(x) / 2. Batched over leading dimensions.

Reference: H. Strasdat, J. M. M. Montiel, A. J. Davison, "Scale drift-aware large scale monocular
SLAM", RSS 2010; E. Eade, "Lie groups for 2D and 3D transformations", 2013 (the series branches).
"""

import numpy as np
from numpy.typing import ArrayLike

from odomap.errors import InputError
from odomap.geometry.so3 import Array, hat, so3_exp, so3_log, stumpff, tail_shape

__all__ = [
    "sim3_adjoint",
    "sim3_exp",
    "sim3_inverse",
    "sim3_left_jacobian",
    "sim3_left_jacobian_inverse",
    "sim3_log",
    "sim3_right_jacobian",
    "sim3_right_jacobian_inverse",
]


def _near_coefficients(theta2: Array, log_scale: Array) -> tuple[Array, Array]:
    """Sum A and B for λ² + θ² < 1: zⁿ = aₙ + iθ bₙ and λⁿ - aₙ = θ² dₙ, divided by (n+1)!."""
    a = np.ones_like(theta2)
    b, d = np.zeros_like(theta2), np.zeros_like(theta2)
    A, B = np.zeros_like(theta2), np.zeros_like(theta2)
    inverse_factorial = 1.0
    for n in range(1, 19):
        a, b, d = log_scale * a - theta2 * b, a + log_scale * b, log_scale * d + b
        inverse_factorial /= n + 1
        A += inverse_factorial * b
        B += inverse_factorial * d
    return A, B


def _translation_matrix(phi: Array, log_scale: Array) -> Array:
    """Return W, which maps the tangent's translation to the motion's."""
    theta2 = np.sum(phi * phi, axis=-1)
    c0, c1, c2, *_ = stumpff(theta2)
    grown, size = np.exp(log_scale), theta2 + log_scale * log_scale
    still = np.abs(log_scale) < 1e-300
    C = np.where(still, 1.0, np.expm1(log_scale) / np.where(still, 1.0, log_scale))
    near = size < 1.0
    safe = np.where(near, 1.0, size)
    A = (grown * (log_scale * c1 - c0) + 1.0) / safe
    B = (grown * (log_scale * c2 - c1) + C) / safe
    if np.any(near):
        A_near, B_near = _near_coefficients(
            np.where(near, theta2, 0.0), np.where(near, log_scale, 0.0)
        )
        A, B = np.where(near, A_near, A), np.where(near, B_near, B)
    skew = hat(phi)
    A, B, C = (c[..., None, None] for c in (A, B, C))
    return np.asarray(C * np.eye(3) + A * skew + B * (skew @ skew))


def _parts(T: ArrayLike) -> tuple[Array, Array, Array]:
    """Return scale (...), rotation (..., 3, 3) and translation (..., 3) of a similarity."""
    m = tail_shape(T, (4, 4), "T")
    determinant = np.linalg.det(m[..., :3, :3])
    if not np.all(determinant > 0):
        raise InputError("T: the scale is not positive, give a similarity [[sR, t], [0, 1]]")
    scale = np.cbrt(determinant)
    return scale, m[..., :3, :3] / scale[..., None, None], m[..., :3, 3]


def sim3_exp(xi: ArrayLike) -> Array:
    """Return the similarity of following the twist for unit time.

    Args:
        xi: (..., 7) translation, rotation, log of the scale.

    Returns:
        (..., 4, 4) [[sR, t], [0, 1]].
    """
    v = tail_shape(xi, (7,), "xi")
    phi, log_scale = v[..., 3:6], v[..., 6]
    out = np.zeros((*v.shape[:-1], 4, 4))
    out[..., :3, :3] = np.exp(log_scale)[..., None, None] * so3_exp(phi)
    out[..., :3, 3:] = _translation_matrix(phi, log_scale) @ v[..., :3, None]
    out[..., 3, 3] = 1.0
    return out


def sim3_log(T: ArrayLike) -> Array:
    """Return the twist of a similarity, its rotation of length 0 to π.

    Args:
        T: (..., 4, 4) [[sR, t], [0, 1]].

    Returns:
        (..., 7) translation, rotation, log of the scale.

    Raises:
        InputError: the scale is not positive.
    """
    scale, R, t = _parts(T)
    phi, log_scale = so3_log(R), np.log(scale)
    rho = np.linalg.solve(_translation_matrix(phi, log_scale), t[..., None])[..., 0]
    return np.concatenate([rho, phi, log_scale[..., None]], axis=-1)


def sim3_inverse(T: ArrayLike) -> Array:
    """Return the inverse similarity.

    Args:
        T: (..., 4, 4).

    Returns:
        (..., 4, 4).
    """
    scale, R, t = _parts(T)
    out = np.zeros((*scale.shape, 4, 4))
    out[..., :3, :3] = np.swapaxes(R, -1, -2) / scale[..., None, None]
    out[..., :3, 3:] = -out[..., :3, :3] @ t[..., None]
    out[..., 3, 3] = 1.0
    return out


def sim3_adjoint(T: ArrayLike) -> Array:
    """Return Ad with T exp(ξ) = exp(Ad ξ) T.

    Args:
        T: (..., 4, 4).

    Returns:
        (..., 7, 7).
    """
    scale, R, t = _parts(T)
    out = np.zeros((*scale.shape, 7, 7))
    out[..., :3, :3] = scale[..., None, None] * R
    out[..., :3, 3:6] = hat(t) @ R
    out[..., :3, 6] = -t
    out[..., 3:6, 3:6] = R
    out[..., 6, 6] = 1.0
    return out


def sim3_left_jacobian(xi: ArrayLike) -> Array:
    """Return J_l with exp(ξ + δ) ≈ exp(J_l δ) exp(ξ).

    Args:
        xi: (..., 7) translation, rotation, log of the scale.

    Returns:
        (..., 7, 7).
    """
    v = tail_shape(xi, (7,), "xi")
    ad = np.zeros((*v.shape, 7))
    ad[..., :3, :3] = hat(v[..., 3:6]) + v[..., 6, None, None] * np.eye(3)
    ad[..., :3, 3:6] = hat(v[..., :3])
    ad[..., :3, 6] = -v[..., :3]
    ad[..., 3:6, 3:6] = hat(v[..., 3:6])
    # ρ sits in a nilpotent corner, so only φ and λ decide how often to halve.
    largest = float(np.max(np.abs(v[..., 3:]), initial=0.0))
    halvings = max(0, int(np.ceil(np.log2(max(largest, 1e-9)))) + 2)
    ad /= 2.0**halvings
    identity = np.eye(7)
    mean = np.broadcast_to(identity, ad.shape)
    for n in range(18, 1, -1):
        mean = identity + ad @ mean / n
    grown = identity + ad @ mean
    for _ in range(halvings):
        mean = 0.5 * (grown + identity) @ mean
        grown = grown @ grown
    return np.asarray(mean)


def sim3_right_jacobian(xi: ArrayLike) -> Array:
    """Return J_r with exp(ξ + δ) ≈ exp(ξ) exp(J_r δ); shapes as `sim3_left_jacobian`."""
    return sim3_left_jacobian(-tail_shape(xi, (7,), "xi"))


def sim3_left_jacobian_inverse(xi: ArrayLike) -> Array:
    """Return the inverse of `sim3_left_jacobian`; singular at a rotation of 2π."""
    return np.asarray(np.linalg.inv(sim3_left_jacobian(xi)))


def sim3_right_jacobian_inverse(xi: ArrayLike) -> Array:
    """Return the inverse of `sim3_right_jacobian`; singular at a rotation of 2π."""
    return np.asarray(np.linalg.inv(sim3_right_jacobian(xi)))
