"""Compiled rotations and poses, for kernels that move one pose at a time.

The problem: inside a compiled loop NumPy's batched functions of `lie` cannot be called, and an
allocation per step would cost more than the step. These are the same formulas, written into arrays
the caller owns; output arrays may be the input arrays except where said.

    R(φ) = I + c₁ φ^ + c₂ φ^²,   V = I + c₂ φ^ + c₃ φ^²,   T ⊞ ξ = (R R(φ), R V ρ + t)

A rotation that is multiplied thousands of times drifts; `se3_retract` takes one Newton step of the
polar decomposition, R ← R (3I - RᵀR) / 2, each time. O(1), no allocation.

Reference: J. Solà, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics",
arXiv:1812.01537, 2018.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.kernels import kernel

__all__ = [
    "half_cot",
    "half_cot_slope",
    "se3_compose_into",
    "se3_exp_into",
    "se3_inverse_into",
    "se3_log_into",
    "se3_retract",
    "se3_right_jacobian_inverse_into",
    "so3_exp_into",
    "so3_left_jacobian_inverse_into",
    "so3_log_into",
    "so3_orthonormalize_into",
    "so3_right_jacobian_into",
    "stumpff_123",
    "warm_up",
]

Array = NDArray[np.float64]


@kernel
def stumpff_123(x: float) -> tuple[float, float, float]:
    """c₁, c₂, c₃ at x = θ²: c_k = Σ (-x)^m / (2m+k)!; the series below θ = 0.5."""
    if x < 0.25:
        c1 = 1.0 - x / 110.0 * (1.0 - x / 156.0 * (1.0 - x / 210.0))
        c1 = 1.0 - x / 6.0 * (1.0 - x / 20.0 * (1.0 - x / 42.0 * (1.0 - x / 72.0 * c1)))
        c2 = 1.0 - x / 132.0 * (1.0 - x / 182.0 * (1.0 - x / 240.0))
        c2 = 1.0 - x / 12.0 * (1.0 - x / 30.0 * (1.0 - x / 56.0 * (1.0 - x / 90.0 * c2)))
        c3 = 1.0 - x / 156.0 * (1.0 - x / 210.0 * (1.0 - x / 272.0))
        c3 = 1.0 - x / 20.0 * (1.0 - x / 42.0 * (1.0 - x / 72.0 * (1.0 - x / 110.0 * c3)))
        return c1, c2 / 2.0, c3 / 6.0
    theta = np.sqrt(x)
    half = np.sin(0.5 * theta)
    c1 = np.sin(theta) / theta
    return c1, 2.0 * half * half / x, (1.0 - c1) / x


@kernel
def half_cot(x: float) -> float:
    """(1 - θ/2 cot θ/2) / θ² at x = θ²; the series below θ = 0.2."""
    if x < 0.04:
        d = 1.0 / 1209600.0 + x * (1.0 / 47900160.0 + x * 691.0 / 1307674368000.0)
        return 1.0 / 12.0 + x * (1.0 / 720.0 + x * (1.0 / 30240.0 + x * d))
    half = 0.5 * np.sqrt(x)
    return float((1.0 - half * np.cos(half) / np.sin(half)) / x)


@kernel
def half_cot_slope(x: float) -> float:
    """dh/dx of h = `half_cot`; the series below θ = 0.5, where the closed form cancels."""
    if x < 0.25:
        d = 5.0 * 691.0 / 1307674368000.0 + x * (6.0 / 74724249600.0 + x * 7.0 * 3.3896804e-13)
        d = 3.0 / 1209600.0 + x * (4.0 / 47900160.0 + x * d)
        return 1.0 / 720.0 + x * (2.0 / 30240.0 + x * d)
    theta = np.sqrt(x)
    sine = np.sin(0.5 * theta)
    slope = 0.25 * (np.cos(0.5 * theta) / sine / theta - 0.5 / (sine * sine))
    return float((-slope - half_cot(x)) / x)


@kernel
def _rotation_series(phi: Array, a: float, b: float, out: Array) -> None:
    """out = I + a φ^ + b φ^²."""
    x, y, z = phi[0], phi[1], phi[2]
    out[0, 0] = 1.0 - b * (y * y + z * z)
    out[0, 1] = b * x * y - a * z
    out[0, 2] = b * x * z + a * y
    out[1, 0] = b * x * y + a * z
    out[1, 1] = 1.0 - b * (x * x + z * z)
    out[1, 2] = b * y * z - a * x
    out[2, 0] = b * x * z - a * y
    out[2, 1] = b * y * z + a * x
    out[2, 2] = 1.0 - b * (x * x + y * y)


@kernel
def so3_exp_into(phi: Array, R: Array) -> None:
    """R = I + c₁ φ^ + c₂ φ^²."""
    c1, c2, _ = stumpff_123(phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2])
    _rotation_series(phi, c1, c2, R)


@kernel
def so3_right_jacobian_into(phi: Array, J: Array) -> None:
    """J = I - c₂ φ^ + c₃ φ^²."""
    _, c2, c3 = stumpff_123(phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2])
    _rotation_series(phi, -c2, c3, J)


@kernel
def so3_left_jacobian_inverse_into(phi: Array, J: Array) -> None:
    """J = I - φ^/2 + d φ^², d = (1 - θ/2 cot θ/2) / θ²."""
    x = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    d = half_cot(x)
    _rotation_series(phi, -0.5, d, J)


@kernel
def so3_log_into(R: Array, phi: Array) -> None:
    """φ = 2 atan2(|v|, w) v / |v| of the quaternion (w, v), the largest component taken first."""
    a, b, c = R[0, 0], R[1, 1], R[2, 2]
    trace = a + b + c
    if trace >= a and trace >= b and trace >= c:
        w, x, y, z = 1.0 + trace, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    elif a >= b and a >= c:
        w, x, y, z = R[2, 1] - R[1, 2], 1.0 + a - b - c, R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]
    elif b >= c:
        w, x, y, z = R[0, 2] - R[2, 0], R[0, 1] + R[1, 0], 1.0 - a + b - c, R[1, 2] + R[2, 1]
    else:
        w, x, y, z = R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], 1.0 - a - b + c
    sign = -1.0 if w < 0.0 else 1.0
    n = np.sqrt(x * x + y * y + z * z)
    if n < 1e-10 * abs(w):
        scale = 2.0 / w
    else:
        scale = sign * 2.0 * np.arctan2(n, abs(w)) / n
    phi[0], phi[1], phi[2] = scale * x, scale * y, scale * z


@kernel
def so3_orthonormalize_into(R: Array, out: Array) -> None:
    """out = R (3I - RᵀR) / 2, one Newton step to the nearest rotation; out may be R."""
    g00 = R[0, 0] * R[0, 0] + R[1, 0] * R[1, 0] + R[2, 0] * R[2, 0]
    g11 = R[0, 1] * R[0, 1] + R[1, 1] * R[1, 1] + R[2, 1] * R[2, 1]
    g22 = R[0, 2] * R[0, 2] + R[1, 2] * R[1, 2] + R[2, 2] * R[2, 2]
    g01 = R[0, 0] * R[0, 1] + R[1, 0] * R[1, 1] + R[2, 0] * R[2, 1]
    g02 = R[0, 0] * R[0, 2] + R[1, 0] * R[1, 2] + R[2, 0] * R[2, 2]
    g12 = R[0, 1] * R[0, 2] + R[1, 1] * R[1, 2] + R[2, 1] * R[2, 2]
    for i in range(3):
        a, b, c = R[i, 0], R[i, 1], R[i, 2]
        out[i, 0] = 0.5 * (a * (3.0 - g00) - b * g01 - c * g02)
        out[i, 1] = 0.5 * (b * (3.0 - g11) - a * g01 - c * g12)
        out[i, 2] = 0.5 * (c * (3.0 - g22) - a * g02 - b * g12)


@kernel
def se3_exp_into(xi: Array, R: Array, t: Array) -> None:
    """R = exp(φ^), t = V ρ = ρ + c₂ φ × ρ + c₃ φ × (φ × ρ)."""
    phi = xi[3:]
    c1, c2, c3 = stumpff_123(phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2])
    x, y, z = phi[0], phi[1], phi[2]
    p, q, r = xi[0], xi[1], xi[2]
    a, b, c = y * r - z * q, z * p - x * r, x * q - y * p
    t[0] = p + c2 * a + c3 * (y * c - z * b)
    t[1] = q + c2 * b + c3 * (z * a - x * c)
    t[2] = r + c2 * c + c3 * (x * b - y * a)
    _rotation_series(phi, c1, c2, R)


@kernel
def se3_log_into(R: Array, t: Array, xi: Array) -> None:
    """φ = log R, ρ = V⁻¹ t = t - φ × t / 2 + d φ × (φ × t)."""
    phi = xi[3:]
    so3_log_into(R, phi)
    x, y, z = phi[0], phi[1], phi[2]
    s = x * x + y * y + z * z
    d = half_cot(s)
    a, b, c = y * t[2] - z * t[1], z * t[0] - x * t[2], x * t[1] - y * t[0]
    xi[0] = t[0] - 0.5 * a + d * (y * c - z * b)
    xi[1] = t[1] - 0.5 * b + d * (z * a - x * c)
    xi[2] = t[2] - 0.5 * c + d * (x * b - y * a)


@kernel
def se3_right_jacobian_inverse_into(xi: Array, J: Array) -> None:
    """J = [[A, B], [0, A]], A = I + φ^/2 + h φ^², B = ρ^/2 + h (φ^ρ^ + ρ^φ^) + 2 h' (φ·ρ) φ^².

    h = `half_cot`, h' its slope: J = Σ Bₙ (-ad)ⁿ / n! with (ad² + θ²)² ad = 0.
    """
    p, q, r, x, y, z = xi[0], xi[1], xi[2], xi[3], xi[4], xi[5]
    s = x * x + y * y + z * z
    h, dot = half_cot(s), x * p + y * q + z * r
    slope = 2.0 * half_cot_slope(s) * dot
    J[0, 0] = 1.0 - h * (y * y + z * z)
    J[0, 1] = h * x * y - 0.5 * z
    J[0, 2] = h * x * z + 0.5 * y
    J[1, 0] = h * x * y + 0.5 * z
    J[1, 1] = 1.0 - h * (x * x + z * z)
    J[1, 2] = h * y * z - 0.5 * x
    J[2, 0] = h * x * z - 0.5 * y
    J[2, 1] = h * y * z + 0.5 * x
    J[2, 2] = 1.0 - h * (x * x + y * y)
    # a^ b^ = b aᵀ - (a·b) I, so φ^ρ^ + ρ^φ^ = ρ φᵀ + φ ρᵀ - 2 (φ·ρ) I.
    J[0, 3] = 2.0 * h * (p * x - dot) - slope * (y * y + z * z)
    J[0, 4] = h * (p * y + q * x) + slope * x * y - 0.5 * r
    J[0, 5] = h * (p * z + r * x) + slope * x * z + 0.5 * q
    J[1, 3] = h * (p * y + q * x) + slope * x * y + 0.5 * r
    J[1, 4] = 2.0 * h * (q * y - dot) - slope * (x * x + z * z)
    J[1, 5] = h * (q * z + r * y) + slope * y * z - 0.5 * p
    J[2, 3] = h * (p * z + r * x) + slope * x * z - 0.5 * q
    J[2, 4] = h * (q * z + r * y) + slope * y * z + 0.5 * p
    J[2, 5] = 2.0 * h * (r * z - dot) - slope * (x * x + y * y)
    for i in range(3):
        for j in range(3):
            J[3 + i, j] = 0.0
            J[3 + i, 3 + j] = J[i, j]


@kernel
def se3_compose_into(
    R_a: Array, t_a: Array, R_b: Array, t_b: Array, R_out: Array, t_out: Array
) -> None:
    """R = R_a R_b, t = R_a t_b + t_a; outputs must not be inputs."""
    for i in range(3):
        t_out[i] = R_a[i, 0] * t_b[0] + R_a[i, 1] * t_b[1] + R_a[i, 2] * t_b[2] + t_a[i]
        for j in range(3):
            R_out[i, j] = R_a[i, 0] * R_b[0, j] + R_a[i, 1] * R_b[1, j] + R_a[i, 2] * R_b[2, j]


@kernel
def se3_inverse_into(R: Array, t: Array, R_out: Array, t_out: Array) -> None:
    """R⁻¹ = Rᵀ, t⁻¹ = -Rᵀ t; outputs must not be inputs."""
    for i in range(3):
        t_out[i] = -(R[0, i] * t[0] + R[1, i] * t[1] + R[2, i] * t[2])
        for j in range(3):
            R_out[i, j] = R[j, i]


@kernel
def se3_retract(R: Array, t: Array, xi: Array, R_out: Array, t_out: Array) -> None:
    """(R_out, t_out) = (R, t) · exp(ξ), re-orthonormalised; outputs may be the inputs."""
    phi = xi[3:]
    c1, c2, c3 = stumpff_123(phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2])
    x, y, z = phi[0], phi[1], phi[2]
    p, q, r = xi[0], xi[1], xi[2]
    a, b, c = y * r - z * q, z * p - x * r, x * q - y * p
    p, q, r = (
        p + c2 * a + c3 * (y * c - z * b),
        q + c2 * b + c3 * (z * a - x * c),
        r + c2 * c + c3 * (x * b - y * a),
    )
    for i in range(3):
        u, v, w = R[i, 0], R[i, 1], R[i, 2]
        t_out[i] = t[i] + u * p + v * q + w * r
        # Row of R · exp(φ^): m + c₁ m φ^ + c₂ (m φ^) φ^, where m φ^ = m × φ.
        e, f, g = v * z - w * y, w * x - u * z, u * y - v * x
        R_out[i, 0] = u + c1 * e + c2 * (f * z - g * y)
        R_out[i, 1] = v + c1 * f + c2 * (g * x - e * z)
        R_out[i, 2] = w + c1 * g + c2 * (e * y - f * x)
    so3_orthonormalize_into(R_out, R_out)


def warm_up() -> None:
    """Compile the kernels of this file."""
    R, t, xi = np.eye(3), np.zeros(3), np.zeros(6)
    R_out, t_out, phi = np.empty((3, 3)), np.empty(3), np.zeros(3)
    stumpff_123(0.1)
    half_cot(0.1)
    half_cot_slope(0.1)
    so3_exp_into(phi, R_out)
    so3_right_jacobian_into(phi, R_out)
    so3_left_jacobian_inverse_into(phi, R_out)
    so3_log_into(R, phi)
    so3_orthonormalize_into(R, R_out)
    se3_exp_into(xi, R_out, t_out)
    se3_log_into(R, t, xi)
    se3_right_jacobian_inverse_into(xi, np.empty((6, 6)))
    se3_compose_into(R, t, R, t, R_out, t_out)
    se3_inverse_into(R, t, R_out, t_out)
    se3_retract(R, t, xi, R_out, t_out)
