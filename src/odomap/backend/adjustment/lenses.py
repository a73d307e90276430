"""Lens models of bundle adjustment: pixels, and how they change with the point and the lens.

The problem: a free lens needs the derivative of its pixels by its own numbers θ as well as by the
point X in camera axes, a million times a second. With x', y' the plane at focal length 1,

    u = fx x' + cx,   ∂u/∂X = fx ∂x'/∂X,   ∂u/∂fx = x',   ∂u/∂cx = 1,   ∂u/∂kᵢ = fx ∂x'/∂kᵢ,

and the models of `lenses` and `fisheye` give, with s = r², g = up/down of the radial polynomial,

    pinhole          ∂x'/∂k₁ = x s / down,  ∂x'/∂k₄ = -x g s / down,  ∂x'/∂p₁ = 2xy, …
    kannala_brandt   ∂x'/∂kᵢ = θ^(2i+1) x / ρ
    double_sphere    ∂x'/∂ξ = -x ∂D/∂ξ / D²,  D = α d₂ + (1 - α) w

"bal" looks along -z, u = f (1 + k₁s + k₂s²) q with q = -(X, Y) / Z. Its data count points behind
the camera as if they were before it, and so does this model; the others see up to their `reach`.

Reference: V. Usenko, N. Demmel, D. Cremers, "The double sphere camera model", 3DV 2018 (a survey of
such models); those of `geometry.lenses` and `geometry.fisheye`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.backend.adjustment.problem import BAL, Adjustment, num_parameters
from odomap.errors import CalibrationError
from odomap.geometry.camera import MODELS
from odomap.geometry.lens_kernels import radtan_distort
from odomap.kernels import kernel

__all__ = ["WIDTH", "LensArrays", "lens_arrays", "project", "reaches", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

WIDTH = 12
"""Numbers kept per lens: fx fy cx cy and eight coefficients."""

_BAL, _PINHOLE, _RADTAN, _KANNALA_BRANDT, _DOUBLE_SPHERE = range(5)
_ENDS = (7, 8, 16, 12, 10)
"""Columns `project` writes of each kind."""
_KINDS = (BAL, "pinhole", "", "kannala_brandt", "double_sphere")


class LensArrays(NamedTuple):
    """Lenses: theta (L, 12) padded, kind (L,), used (L,) how many of them, reach (L,)."""

    theta: Array
    kind: Index
    used: Index
    reach: Array


def lens_arrays(problem: Adjustment) -> LensArrays:
    """Lay the lenses of a problem out as the kernels want them."""
    width = problem.intrinsics.shape[1]
    count = np.array([num_parameters(name, width) for name in problem.models], np.int64)
    kind = np.array([_KINDS.index(name) for name in problem.models], np.int64)
    kind[(kind == _PINHOLE) & (count > 4)] = _RADTAN
    theta = np.zeros((len(count), WIDTH))
    for row, n in enumerate(count):
        theta[row, :n] = problem.intrinsics[row, :n]
    lenses = LensArrays(theta, kind, count, np.zeros(len(count)))
    lenses.reach[:] = reaches(lenses, np.arange(len(count)))
    return lenses


def reaches(lenses: LensArrays, which: Index) -> Array:
    """Return how far from the axis each of some lenses is one-to-one; NaN where it is no lens.

    Args:
        lenses: (L,).
        which: (Q,) indices.

    Returns:
        (Q,) in the lens's own measure (see `LensModel.reach`).
    """
    out = np.full(len(which), np.inf)
    for row, index in enumerate(which):
        theta, kind = lenses.theta[index], lenses.kind[index]
        if theta[0] <= 0 or (kind != _BAL and theta[1] <= 0):
            out[row] = np.nan
        elif kind in (_RADTAN, _KANNALA_BRANDT, _DOUBLE_SPHERE):
            model = MODELS[_KINDS[kind] or "pinhole"]
            try:
                out[row] = model.reach(theta[4 : lenses.used[index]])
            except CalibrationError:
                out[row] = np.nan
    return out


@kernel
def project(
    kind: int,
    theta: Array,
    q: int,
    reach: float,
    X: float,
    Y: float,
    Z: float,
    slopes: bool,
    out: Array,
) -> bool:
    """Write π(θ, X) and, if wanted, ∂π/∂X and ∂π/∂θ: columns 0, 1-3 and 4-15 of out (2, 16).

    False where the lens does not see the point; nothing of use is written then.
    """
    if kind == _BAL:
        return _bal(theta, q, X, Y, Z, slopes, out)
    if kind in (_PINHOLE, _RADTAN):
        seen = _pinhole(theta, q, kind == _RADTAN, reach, X, Y, Z, slopes, out)
    elif kind == _KANNALA_BRANDT:
        seen = _kannala_brandt(theta, q, reach, X, Y, Z, slopes, out)
    else:
        seen = _double_sphere(theta, q, reach, X, Y, Z, slopes, out)
    # Until here of the plane at focal length 1.
    if seen and slopes:
        for i in range(2):
            for j in range(1, _ENDS[kind]):
                out[i, j] *= theta[q, i]
            out[i, 4 + i], out[i, 5 - i] = out[i, 0], 0.0
            out[i, 6 + i], out[i, 7 - i] = 1.0, 0.0
    out[0, 0] = theta[q, 0] * out[0, 0] + theta[q, 2]
    out[1, 0] = theta[q, 1] * out[1, 0] + theta[q, 3]
    return seen


@kernel
def _bal(theta: Array, q: int, X: float, Y: float, Z: float, slopes: bool, out: Array) -> bool:
    """π = f (1 + k₁s + k₂s²) q, q = -(X, Y)/Z, s = |q|²; ∂q/∂(X, Y, Z) = -[I | q] / Z."""
    if not abs(Z) > 1e-12:
        return False
    w = -1.0 / Z
    x, y = w * X, w * Y
    s = x * x + y * y
    f, k1, k2 = theta[q, 0], theta[q, 1], theta[q, 2]
    g = 1.0 + s * (k1 + s * k2)
    out[0, 0], out[1, 0] = f * g * x, f * g * y
    if slopes:
        bend = 2.0 * f * (k1 + 2.0 * s * k2)
        a, b, c = f * g + bend * x * x, bend * x * y, f * g + bend * y * y
        out[0, 1], out[0, 2], out[0, 3] = w * a, w * b, w * (a * x + b * y)
        out[1, 1], out[1, 2], out[1, 3] = w * b, w * c, w * (b * x + c * y)
        out[0, 4], out[0, 5], out[0, 6] = g * x, f * s * x, f * s * s * x
        out[1, 4], out[1, 5], out[1, 6] = g * y, f * s * y, f * s * s * y
    return True


@kernel
def _pinhole(
    theta: Array,
    q: int,
    bends: bool,
    reach: float,
    X: float,
    Y: float,
    Z: float,
    slopes: bool,
    out: Array,
) -> bool:
    """x = X/Z, y = Y/Z, then `radtan_distort`; ∂(x, y)/∂(X, Y, Z) = [I | -(x, y)] / Z."""
    if not Z > 1e-12:
        return False
    w = 1.0 / Z
    x, y = w * X, w * Y
    a, b, c = 1.0, 0.0, 1.0
    out[0, 0], out[1, 0] = x, y
    if bends:
        s = x * x + y * y
        if not s < reach:
            return False
        d = theta[q, 4:]
        out[0, 0], out[1, 0], a, b, c = radtan_distort(x, y, d)
        if slopes:
            down = 1.0 + s * (d[5] + s * (d[6] + s * d[7]))
            g = (1.0 + s * (d[0] + s * (d[1] + s * d[4]))) / down
            for i in range(2):
                at = (x if i == 0 else y) * s / down
                out[i, 8], out[i, 9], out[i, 12] = at, s * at, s * s * at
                out[i, 13], out[i, 14], out[i, 15] = -g * at, -g * s * at, -g * s * s * at
            out[0, 10], out[0, 11] = 2.0 * x * y, s + 2.0 * x * x
            out[1, 10], out[1, 11] = s + 2.0 * y * y, 2.0 * x * y
    if slopes:
        out[0, 1], out[0, 2], out[0, 3] = w * a, w * b, -w * (a * x + b * y)
        out[1, 1], out[1, 2], out[1, 3] = w * b, w * c, -w * (b * x + c * y)
    return True


@kernel
def _kannala_brandt(
    theta: Array,
    q: int,
    reach: float,
    X: float,
    Y: float,
    Z: float,
    slopes: bool,
    out: Array,
) -> bool:
    """π = r(θ) n, n = (X, Y)/ρ; with S = r/ρ, T = r'/d²: S I + n nᵀ (T Z - S) and -n T ρ."""
    rho = np.sqrt(X * X + Y * Y)
    angle = np.arctan2(rho, Z)
    if not angle < reach or (rho == 0.0 and not Z > 0.0):
        return False
    s, k1, k2 = angle * angle, theta[q, 4], theta[q, 5]
    k3, k4 = theta[q, 6], theta[q, 7]
    radius = angle * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
    ratio = radius / rho if rho > 0.0 else 1.0 / Z
    out[0, 0], out[1, 0] = ratio * X, ratio * Y
    if slopes:
        slope = 1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4)))
        turn = slope / (rho * rho + Z * Z)
        x, y = (X / rho, Y / rho) if rho > 0.0 else (0.0, 0.0)
        bend = turn * Z - ratio
        out[0, 1], out[0, 2], out[0, 3] = ratio + bend * x * x, bend * x * y, -turn * rho * x
        out[1, 1], out[1, 2], out[1, 3] = bend * x * y, ratio + bend * y * y, -turn * rho * y
        power = angle
        for j in range(4, 8):
            power *= s
            out[0, 4 + j], out[1, 4 + j] = power * x, power * y
    return True


@kernel
def _double_sphere(
    theta: Array,
    q: int,
    reach: float,
    X: float,
    Y: float,
    Z: float,
    slopes: bool,
    out: Array,
) -> bool:
    """π = (X, Y)/D, D = α d₂ + (1 - α) w, w = ξ d₁ + Z; ∂π = ∂(X, Y)/D - (X, Y) ∂D/D²."""
    xi, alpha = theta[q, 4], theta[q, 5]
    d1 = np.sqrt(X * X + Y * Y + Z * Z)
    w = xi * d1 + Z
    d2 = np.sqrt(X * X + Y * Y + w * w)
    below = alpha * d2 + (1.0 - alpha) * w
    if not (w > -reach * d2 and d1 + xi * Z > 0.0 and below > 0.0):
        return False
    inverse = 1.0 / below
    x, y = X * inverse, Y * inverse
    out[0, 0], out[1, 0] = x, y
    if slopes:
        # ∂D/∂w with X and Y held, and ∂D/∂(X, Y) with w held.
        by_w, by_xy = alpha * w / d2 + 1.0 - alpha, alpha / d2
        bend = by_w * xi / d1
        g0, g1, g2 = (by_xy + bend) * X, (by_xy + bend) * Y, bend * Z + by_w
        x, y = inverse * x, inverse * y
        out[0, 1], out[0, 2], out[0, 3] = inverse - x * g0, -x * g1, -x * g2
        out[1, 1], out[1, 2], out[1, 3] = -y * g0, inverse - y * g1, -y * g2
        out[0, 8], out[1, 8] = -x * by_w * d1, -y * by_w * d1
        out[0, 9], out[1, 9] = -x * (d2 - w), -y * (d2 - w)
    return True


def warm_up() -> None:
    """Compile the kernels of this module."""
    out = np.zeros((2, 16))
    theta = np.array([[1.0, 1, 0, 0, 0, 0.5, 0, 0, 0, 0, 0, 0]])
    for kind in range(len(_KINDS)):
        project(kind, theta, 0, 1.0, 0.1, 0.1, 1.0, True, out)
