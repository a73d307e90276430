"""Rotations in space: SO(3) and unit quaternions.

The problem: a rotation has three degrees of freedom but is applied as a 3x3 matrix. The tangent
φ = θ·axis (radians) is the minimal form; exp and log go between them:

    R = exp(φ^) = I + c₁ φ^ + c₂ φ^²        J_l = I + c₂ φ^ + c₃ φ^²

with the Stumpff functions c_k(θ²) = Σ (-1)^m θ^2m / (2m+k)!, that is c₁ = sin θ / θ,
c₂ = (1 - cos θ) / θ², c₃ = (θ - sin θ) / θ³. They are entire, so one series below θ = 1 and the
closed form above give full precision everywhere. The logarithm goes through the quaternion,
θ = 2 atan2(|v|, w), which stays exact to the last digit at 0 and at π, where the trace formula
loses half of them. J_r(φ) = J_l(-φ). Batched over leading dimensions, O(1) per item.

Reference: J. Solà, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics",
arXiv:1812.01537, 2018.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import InputError

__all__ = [
    "Array",
    "half_cot",
    "hat",
    "orthonormalize",
    "quaternion_from_rotation",
    "rotation_from_quaternion",
    "so3_exp",
    "so3_left_jacobian",
    "so3_left_jacobian_inverse",
    "so3_log",
    "so3_right_jacobian",
    "so3_right_jacobian_inverse",
    "stumpff",
    "tail_shape",
    "vee",
]

Array = NDArray[np.float64]

_TERMS = 11
"""At θ² = 1 the twelfth term is below 1e-22."""

_SERIES = np.array(
    [[(-1) ** m / math.factorial(2 * m + k) for m in range(_TERMS)] for k in range(6)],
    dtype=np.float64,
)

_COT_SERIES = np.array(
    [[1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000]]
)
"""(1 - x/2 cot x/2) / x² in powers of x²: |B_2m| / (2m)!."""


def tail_shape(value: ArrayLike, tail: tuple[int, ...], name: str) -> Array:
    """Return a float64 array whose trailing dimensions are `tail`, or say what is wrong.

    Args:
        value: anything array-like.
        tail: the trailing shape it must have.
        name: what to call it in the message.

    Returns:
        (..., *tail) float64.

    Raises:
        InputError: of another shape, or not numbers.
    """
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name}: not an array of numbers, give shape (..., {tail})") from None
    if array.shape[array.ndim - len(tail) :] != tail or array.ndim < len(tail):
        wanted = ", ".join(["...", *(str(n) for n in tail)])
        raise InputError(f"{name}: has shape {array.shape}, give shape ({wanted})")
    return array


def stumpff(theta2: ArrayLike) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Evaluate the Stumpff functions c₀ … c₅ at θ² ≥ 0.

    Args:
        theta2: (...) squared angles, rad².

    Returns:
        c₀ = cos θ, c₁ = sin θ / θ, c₂ = (1 - cos θ) / θ², then c_{k+2} = (1/k! - c_k) / θ².
    """
    x = np.asarray(theta2, dtype=np.float64)
    small = x < 1.0
    theta = np.sqrt(x)
    half = np.sin(0.5 * theta)
    big = np.where(small, 1.0, x)
    near = np.where(small, x, 0.0)
    c1 = np.sin(theta) / np.where(theta == 0, 1.0, theta)
    c2 = 2.0 * half * half / np.where(theta == 0, 1.0, x)
    c1, c2 = np.where(theta == 0, 1.0, c1), np.where(theta == 0, 0.5, c2)
    c3 = (1.0 - c1) / big
    c4 = (0.5 - c2) / big
    c5 = (1.0 / 6.0 - c3) / big
    if np.any(small):
        series = _power_series(near, _SERIES[3:])
        c3 = np.where(small, series[..., 0], c3)
        c4 = np.where(small, series[..., 1], c4)
        c5 = np.where(small, series[..., 2], c5)
    return np.cos(theta), c1, c2, c3, c4, c5


def _power_series(x: Array, coefficients: Array) -> Array:
    """Sum K series (K, terms) at x (...) to (..., K) in few calls: x is often one number."""
    powers = np.ones((*x.shape, coefficients.shape[1]))
    powers[..., 1:] = x[..., None]
    return np.asarray(np.multiply.accumulate(powers, axis=-1) @ coefficients.T)


def half_cot(theta2: ArrayLike) -> Array:
    """Evaluate (1 - θ/2 · cot θ/2) / θ², which goes with φ^² in the inverse Jacobian of SO(3)."""
    x = np.asarray(theta2, dtype=np.float64)
    small = x < 0.04
    theta = np.sqrt(np.where(small, 1.0, x))
    far = (1.0 - 0.5 * theta * np.cos(0.5 * theta) / np.sin(0.5 * theta)) / (theta * theta)
    if not np.any(small):
        return np.asarray(far)
    return np.where(small, _power_series(np.where(small, x, 0.0), _COT_SERIES)[..., 0], far)


def hat(phi: ArrayLike) -> Array:
    """Return the skew matrix with `hat(a) @ b = a × b`.

    Args:
        phi: (..., 3).

    Returns:
        (..., 3, 3).
    """
    v = tail_shape(phi, (3,), "phi")
    out = np.zeros((*v.shape, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    out[..., 1, 2], out[..., 2, 0], out[..., 0, 1] = -v[..., 0], -v[..., 1], -v[..., 2]
    return out


def vee(skew: ArrayLike) -> Array:
    """Return the vector of a skew matrix, the inverse of `hat`.

    Args:
        skew: (..., 3, 3).

    Returns:
        (..., 3).
    """
    m = tail_shape(skew, (3, 3), "skew")
    return np.stack([m[..., 2, 1], m[..., 0, 2], m[..., 1, 0]], axis=-1)


def _series_of_hat(phi: Array, first: Array, second: Array) -> Array:
    """Return I + first φ^ + second φ^²."""
    skew = hat(phi)
    return np.eye(3) + first[..., None, None] * skew + second[..., None, None] * (skew @ skew)


def so3_exp(phi: ArrayLike) -> Array:
    """Return the rotation by |phi| radians about phi.

    Args:
        phi: (..., 3) rotation vectors, rad.

    Returns:
        (..., 3, 3) rotation matrices.

    Example:
        >>> so3_exp([0.0, 0.0, np.pi / 2]).round(3) @ [1, 0, 0]
        array([0., 1., 0.])
    """
    v = tail_shape(phi, (3,), "phi")
    _, c1, c2, *_ = stumpff(np.sum(v * v, axis=-1))
    return _series_of_hat(v, c1, c2)


def so3_log(R: ArrayLike) -> Array:
    """Return the rotation vector of a rotation matrix, of length 0 to π.

    Args:
        R: (..., 3, 3) rotation matrices.

    Returns:
        (..., 3), rad.
    """
    q = quaternion_from_rotation(R)
    w, v = q[..., 0], q[..., 1:]
    n = np.sqrt(np.sum(v * v, axis=-1))
    tiny = n < 1e-10
    scale = np.where(tiny, 2.0, 2.0 * np.arctan2(n, w) / np.where(tiny, 1.0, n))
    return scale[..., None] * v


def so3_left_jacobian(phi: ArrayLike) -> Array:
    """Return J_l with exp(φ + δ) ≈ exp(J_l δ) exp(φ); also the V matrix of SE(3).

    Args:
        phi: (..., 3) rotation vectors, rad.

    Returns:
        (..., 3, 3).
    """
    v = tail_shape(phi, (3,), "phi")
    _, _, c2, c3, *_ = stumpff(np.sum(v * v, axis=-1))
    return _series_of_hat(v, c2, c3)


def so3_right_jacobian(phi: ArrayLike) -> Array:
    """Return J_r with exp(φ + δ) ≈ exp(φ) exp(J_r δ); shapes as `so3_left_jacobian`."""
    return so3_left_jacobian(-tail_shape(phi, (3,), "phi"))


def so3_left_jacobian_inverse(phi: ArrayLike) -> Array:
    """Return the inverse of `so3_left_jacobian`; singular only at |phi| = 2π.

    Args:
        phi: (..., 3) rotation vectors, rad.

    Returns:
        (..., 3, 3).
    """
    v = tail_shape(phi, (3,), "phi")
    second = half_cot(np.sum(v * v, axis=-1))
    return _series_of_hat(v, np.full_like(second, -0.5), second)


def so3_right_jacobian_inverse(phi: ArrayLike) -> Array:
    """Return the inverse of `so3_right_jacobian`; shapes as `so3_left_jacobian_inverse`."""
    return so3_left_jacobian_inverse(-tail_shape(phi, (3,), "phi"))


def quaternion_from_rotation(R: ArrayLike) -> Array:
    """Return the unit quaternion of a rotation matrix.

    All of 4·q qᵀ can be read off R; the row with the largest diagonal is divided by its length, so
    that no digit is lost at any angle (Shepperd 1978).

    Args:
        R: (..., 3, 3) rotation matrices.

    Returns:
        (..., 4) w x y z, w ≥ 0.
    """
    m = tail_shape(R, (3, 3), "R")
    if m.ndim == 2:
        return _quaternion_of_one(m)
    a, b, c = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    outer = np.empty((*m.shape[:-2], 4, 4))
    outer[..., 0, 0], outer[..., 1, 1] = 1 + a + b + c, 1 + a - b - c
    outer[..., 2, 2], outer[..., 3, 3] = 1 - a + b - c, 1 - a - b + c
    for i, j, k in ((1, 2, 3), (2, 3, 1), (3, 1, 2)):
        w_i = m[..., k - 1, j - 1] - m[..., j - 1, k - 1]
        i_j = m[..., i - 1, j - 1] + m[..., j - 1, i - 1]
        outer[..., 0, i] = outer[..., i, 0] = w_i
        outer[..., i, j] = outer[..., j, i] = i_j
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.sqrt(np.sum(q * q, axis=-1, keepdims=True))
    return np.asarray(np.where(q[..., :1] < 0, -q, q))


def _quaternion_of_one(R: Array) -> Array:
    """Return the same of (3, 3), without arrays: a tenth of the time."""
    (a, r, s), (t, b, u), (v, w, c) = R.tolist()
    trace, x, y, z = 1 + a + b + c, 1 + a - b - c, 1 - a + b - c, 1 - a - b + c
    if trace >= x and trace >= y and trace >= z:
        q = trace, w - u, s - v, t - r
    elif x >= y and x >= z:
        q = w - u, x, r + t, v + s
    elif y >= z:
        q = s - v, r + t, y, u + w
    else:
        q = t - r, v + s, u + w, z
    length = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return np.array(q) / (-length if q[0] < 0 else length)


def rotation_from_quaternion(q: ArrayLike) -> Array:
    """Return the rotation matrix of a quaternion, which need not be of unit length.

    Args:
        q: (..., 4) w x y z.

    Returns:
        (..., 3, 3).

    Raises:
        InputError: a quaternion is zero or not finite.
    """
    q = tail_shape(q, (4,), "quaternion")
    n2 = np.sum(q * q, axis=-1)
    if not np.all(np.isfinite(n2) & (n2 > 1e-24)):
        raise InputError(
            "quaternion: has length 0 or is not finite, give a unit quaternion w x y z"
        )
    w, x, y, z = np.moveaxis(q / np.sqrt(n2)[..., None], -1, 0)
    out = np.empty((*q.shape[:-1], 3, 3))
    out[..., 0, 0], out[..., 0, 1] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w)
    out[..., 0, 2], out[..., 1, 0] = 2 * (x * z + y * w), 2 * (x * y + z * w)
    out[..., 1, 1], out[..., 1, 2] = 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    out[..., 2, 0], out[..., 2, 1] = 2 * (x * z - y * w), 2 * (y * z + x * w)
    out[..., 2, 2] = 1 - 2 * (x * x + y * y)
    return out


def orthonormalize(R: ArrayLike) -> Array:
    """Return the rotation nearest to a matrix (Frobenius), by singular value decomposition.

    Args:
        R: (..., n, n) of full rank, any n.

    Returns:
        (..., n, n) with determinant +1.
    """
    m = np.asarray(R, dtype=np.float64)
    u, _, vt = np.linalg.svd(m)
    u[..., :, -1] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))[..., None]
    return np.asarray(u @ vt)
