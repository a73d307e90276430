"""Fisheyes: lenses that see 180° and more.

The problem: x/z grows without end towards 90° off the axis, so no distortion of a pinhole reaches
there. Kannala and Brandt bend the angle θ instead, with ρ² = x² + y²,

    θ = atan2(ρ, z),   r = θ + k₁θ³ + k₂θ⁵ + k₃θ⁷ + k₄θ⁹,   (x', y') = r (x, y) / ρ,

inverted by Newton's method in one variable, up to the angle where r stops growing. The double
sphere of Usenko et al. sends a point to a unit sphere, then to a second one shifted by ξ, then
through a pinhole shifted by α / (1 - α):

    d₁ = |p|,  w = ξ d₁ + z,  d₂² = ρ² + w²,   (x', y') = (x, y) / (α d₂ + (1 - α) w)

It has six numbers in all, no trigonometry, and an inverse in closed form, with m² = x'² + y'²,

    m_z = (1 - α²m²) / (α √(1 - (2α - 1) m²) + 1 - α),
    p  ∝ (m_z ξ + √(m_z² + (1 - ξ²) m²)) / (m_z² + m²) · (x', y', m_z) - (0, 0, ξ).

Points are seen while w > -w₁ d₂, w₁ = α/(1 - α) or (1 - α)/α, whichever is below 1. O(N).

Reference: J. Kannala, S. Brandt, "A generic camera model and calibration method", TPAMI 28(8),
2006; V. Usenko, N. Demmel, D. Cremers, "The double sphere camera model", 3DV 2018.
"""

import numpy as np

from odomap.errors import CalibrationError
from odomap.geometry.so3 import Array

__all__ = ["DoubleSphere", "KannalaBrandt"]


class KannalaBrandt:
    """The fisheye whose radius is a polynomial of the angle (k1 k2 k3 k4); OpenCV's "fisheye"."""

    names: str = "k1 k2 k3 k4"
    lengths: tuple[int, ...] = (4,)

    def reach(self, distortion: Array) -> float:
        """Return the angle at which r(θ) stops growing, π at most."""
        slope = np.polynomial.Polynomial([1.0, *(np.array([3, 5, 7, 9]) * distortion)])
        # Coefficients that move nothing up to π would make the roots overflow.
        roots = slope.trim(1e-18).roots()
        real = roots[np.abs(np.imag(roots)) < 1e-9].real
        return float(np.sqrt(np.min(real[real > 0], initial=np.pi**2)))

    def to_plane(self, points: Array, distortion: Array, reach: float) -> Array:
        """Map points (N, 3) to the plane (N, 2); NaN beyond the angle of reach."""
        rho = np.hypot(points[:, 0], points[:, 1])
        theta = np.arctan2(rho, points[:, 2])
        radius, _ = _radius(np.where(theta < reach, theta, np.nan), distortion)
        scale = _ratio(radius, rho, points[:, 2])
        return np.asarray(points[:, :2] * scale[:, None])

    def to_plane_jacobian(self, points: Array, distortion: Array) -> Array:
        """Return the derivative of `to_plane` by the points, (N, 2, 3).

        With n = (x, y)/ρ and s = r/ρ: s I + n nᵀ (r' z/d² - s) by (x, y), -n r' ρ/d² by z.
        """
        z = points[:, 2]
        rho = np.hypot(points[:, 0], points[:, 1])
        radius, slope = _radius(np.arctan2(rho, z), distortion)
        scale = _ratio(radius, rho, z)
        n = points[:, :2] / np.where(rho > 0, rho, 1.0)[:, None]
        square = rho * rho + z * z
        turn = slope / np.where(square > 0, square, np.nan)
        out = np.empty((len(points), 2, 3))
        out[:, :, :2] = n[:, :, None] * n[:, None, :] * (turn * z - scale)[:, None, None]
        out[:, 0, 0] += scale
        out[:, 1, 1] += scale
        out[:, :, 2] = -n * (turn * rho)[:, None]
        return out

    def from_plane(self, plane: Array, distortion: Array, reach: float) -> Array:
        """Map the plane (N, 2) to rays of length 1; NaN where no angle has that radius."""
        from odomap.geometry.lens_kernels import kb_angles

        radius = np.hypot(plane[:, 0], plane[:, 1])
        theta = np.empty_like(radius)
        kb_angles(radius, distortion, reach, theta)
        rays = np.empty((len(plane), 3))
        bend = np.sin(theta) / np.where(radius > 0, radius, 1.0)
        rays[:, :2] = plane * np.where(radius > 0, bend, 1.0)[:, None]
        rays[:, 2] = np.cos(theta)
        return rays


def _radius(theta: Array, k: Array) -> tuple[Array, Array]:
    """Return r(θ) and its derivative."""
    s = theta * theta
    radius = theta * (1.0 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))))
    slope = 1.0 + s * (3.0 * k[0] + s * (5.0 * k[1] + s * (7.0 * k[2] + s * 9.0 * k[3])))
    return np.asarray(radius), np.asarray(slope)


def _ratio(radius: Array, rho: Array, z: Array) -> Array:
    """Return r/ρ; 1/z on the axis, NaN on its far side, where no direction is right."""
    axis = 1.0 / np.where(z > 0, z, np.nan)
    return np.asarray(np.where(rho == 0, axis, radius / np.where(rho == 0, 1.0, rho)))


class DoubleSphere:
    """The fisheye of two unit spheres (xi alpha)."""

    names: str = "xi alpha"
    lengths: tuple[int, ...] = (2,)

    def reach(self, distortion: Array) -> float:
        """Return w₁: points are seen while the angle at the second sphere has cos φ > -w₁."""
        xi, alpha = distortion.tolist()
        if not 0.0 <= alpha <= 1.0:
            raise CalibrationError(f"distortion: alpha = {alpha:g} must be from 0 to 1 (xi alpha)")
        if xi <= -1.0:
            raise CalibrationError(f"distortion: xi = {xi:g} must be above -1 (xi alpha)")
        return float(alpha / (1.0 - alpha) if alpha <= 0.5 else (1.0 - alpha) / alpha)

    def to_plane(self, points: Array, distortion: Array, reach: float) -> Array:
        """Map points (N, 3) to the plane (N, 2); NaN where they are not seen."""
        xi, alpha = distortion
        d1 = np.sqrt(np.sum(points * points, axis=1))
        w = xi * d1 + points[:, 2]
        d2 = np.sqrt(points[:, 0] ** 2 + points[:, 1] ** 2 + w * w)
        # The second condition is met by all points unless ξ > 1.
        seen = (w > -reach * d2) & (d1 + xi * points[:, 2] > 0)
        below = alpha * d2 + (1.0 - alpha) * w
        return np.asarray(points[:, :2] / np.where(seen, below, np.nan)[:, None])

    def to_plane_jacobian(self, points: Array, distortion: Array) -> Array:
        """Return the derivative of `to_plane` by the points, (N, 2, 3).

        With D = α d₂ + (1 - α) w: I/D - (x, y) ∇D / D².
        """
        xi, alpha = distortion
        d1 = np.sqrt(np.sum(points * points, axis=1))
        w = xi * d1 + points[:, 2]
        d2 = np.sqrt(points[:, 0] ** 2 + points[:, 1] ** 2 + w * w)
        below = alpha * d2 + (1.0 - alpha) * w
        below = np.where(below > 0, below, np.nan)
        d1, d2 = np.where(d1 > 0, d1, np.nan), np.where(d2 > 0, d2, np.nan)
        grad_w = xi * points / d1[:, None]
        grad_w[:, 2] += 1.0
        grad_d2 = grad_w * w[:, None]
        grad_d2[:, :2] += points[:, :2]
        grad = alpha * grad_d2 / d2[:, None] + (1.0 - alpha) * grad_w
        out = -points[:, :2, None] * grad[:, None, :] / (below * below)[:, None, None]
        out[:, 0, 0] += 1.0 / below
        out[:, 1, 1] += 1.0 / below
        return np.asarray(out)

    def from_plane(self, plane: Array, distortion: Array, reach: float) -> Array:
        """Map the plane (N, 2) to rays of length 1; NaN where no ray leads there."""
        xi, alpha = distortion
        m2 = np.sum(plane * plane, axis=1)
        inner = 1.0 - (2.0 * alpha - 1.0) * m2
        inner = np.sqrt(np.where(inner >= 0, inner, np.nan))
        mz = (1.0 - alpha * alpha * m2) / (alpha * inner + 1.0 - alpha)
        root = mz * mz + (1.0 - xi * xi) * m2
        root = np.sqrt(np.where(root >= 0, root, np.nan))
        scale = (mz * xi + root) / (mz * mz + m2)
        scale = np.where(scale > 0, scale, np.nan)  # as it is unless ξ > 1
        rays = np.empty((len(plane), 3))
        rays[:, :2] = plane * scale[:, None]
        rays[:, 2] = mz * scale - xi
        return rays
