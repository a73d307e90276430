"""Lenses: what a camera's model must know, and the pinhole with radial-tangential distortion.

The problem: glass bends rays by a smooth function of their angle to the axis, and a lens that is
mounted askew adds a tangential part. With x = X/Z, y = Y/Z, r² = x² + y²,

    g  = (1 + k₁r² + k₂r⁴ + k₃r⁶) / (1 + k₄r² + k₅r⁴ + k₆r⁶)
    x' = g x + 2p₁xy + p₂(r² + 2x²),   y' = g y + p₁(r² + 2y²) + 2p₂xy

which has no inverse in closed form. `from_plane` finds it by Newton's method with the exact 2x2
Jacobian: quadratic, four steps for a wide lens. The polynomial is a lens only up to the radius
where r·g(r²) stops growing; beyond it far-off points would fold back into the image, so they map
to NaN, as do points behind the camera. Lenses that see there are in `fisheye`. O(N).

Reference: D. C. Brown, "Close-range camera calibration", Photogrammetric Engineering 37(8), 1971.
"""

from typing import Protocol

import numpy as np

from odomap.geometry.so3 import Array

__all__ = ["LensModel", "RadialTangential"]


class LensModel(Protocol):
    """What a lens must know: rays to the plane at focal length 1, and back.

    Methods take the coefficients and what `reach` made of them.
    """

    @property
    def names(self) -> str:
        """The coefficients by name, for messages."""
        ...

    @property
    def lengths(self) -> tuple[int, ...]:
        """Allowed numbers of distortion coefficients."""
        ...

    def reach(self, distortion: Array) -> float:
        """Return how far from the axis the model is one-to-one, in the lens's own measure.

        Raises:
            CalibrationError: these coefficients are those of no lens.
        """
        ...

    def to_plane(self, points: Array, distortion: Array, reach: float) -> Array:
        """Map points (N, 3) to the plane (N, 2); NaN where the lens cannot see them."""
        ...

    def to_plane_jacobian(self, points: Array, distortion: Array) -> Array:
        """Return the derivative of `to_plane` by the points, (N, 2, 3)."""
        ...

    def from_plane(self, plane: Array, distortion: Array, reach: float) -> Array:
        """Map the plane (N, 2) to rays (N, 3) of any length; NaN where no ray leads there."""
        ...


class RadialTangential:
    """The pinhole with radial-tangential distortion (k1 k2 p1 p2 [k3 [k4 k5 k6]])."""

    names: str = "k1 k2 p1 p2 [k3 [k4 k5 k6]]"
    lengths: tuple[int, ...] = (0, 4, 5, 8)

    def reach(self, distortion: Array) -> float:
        """Return the r² at which r·g(r²) stops growing, infinity if it never does."""
        k = np.pad(distortion, (0, 8 - len(distortion)))
        up = np.polynomial.Polynomial([1.0, k[0], k[1], k[4]])
        down = np.polynomial.Polynomial([1.0, k[5], k[6], k[7]])
        # d/dr [r g(r²)] = 0, times the denominator squared, as a polynomial in s = r².
        s = np.polynomial.Polynomial([0.0, 1.0])
        growth = up * down + 2.0 * s * (up.deriv() * down - up * down.deriv())
        roots = np.concatenate([growth.trim().roots(), down.trim().roots()])
        real = roots[np.abs(np.imag(roots)) < 1e-9].real
        return float(np.min(real[real > 0], initial=np.inf))

    def to_plane(self, points: Array, distortion: Array, reach: float) -> Array:
        """Map points (N, 3) to the plane (N, 2); NaN behind the camera or beyond the fold."""
        xy = points[:, :2] / np.where(points[:, 2:] > 0, points[:, 2:], np.nan)
        if len(distortion) == 0:
            return np.asarray(xy)
        x, y = xy[:, 0], xy[:, 1]
        p1, p2 = distortion[2:4]
        r2 = x * x + y * y
        g, _ = _radial(np.where(r2 < reach, r2, np.nan), distortion)
        out = np.empty_like(xy)
        out[:, 0] = g * x + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        out[:, 1] = g * y + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        return out

    def to_plane_jacobian(self, points: Array, distortion: Array) -> Array:
        """Return the derivative of `to_plane` by the points, (N, 2, 3)."""
        w = 1.0 / np.where(points[:, 2] > 0, points[:, 2], np.nan)
        xy = points[:, :2] * w[:, None]
        out = np.empty((len(points), 2, 3))
        out[:, :, :2] = self._slope(xy, distortion) * w[:, None, None]
        out[:, :, 2] = -(out[:, :, :2] @ xy[:, :, None])[:, :, 0]
        return out

    def from_plane(self, plane: Array, distortion: Array, reach: float) -> Array:
        """Map the plane (N, 2) to rays (x, y, 1)."""
        rays = np.ones((len(plane), 3))
        if len(distortion) == 0:
            rays[:, :2] = plane
            return rays
        from odomap.geometry.lens_kernels import radtan_undistort_rows

        padded = np.zeros(8)
        padded[: len(distortion)] = distortion
        xy = np.empty_like(plane)
        radtan_undistort_rows(np.ascontiguousarray(plane), padded, reach, xy)
        rays[:, :2] = xy
        return rays

    @staticmethod
    def _slope(xy: Array, distortion: Array) -> Array:
        """Return the derivative of the distortion by (x, y), (N, 2, 2); it is symmetric."""
        out = np.empty((len(xy), 2, 2))
        if len(distortion) == 0:
            out[:] = np.eye(2)
            return out
        x, y = xy[:, 0], xy[:, 1]
        p1, p2 = distortion[2:4]
        g, dg = _radial(x * x + y * y, distortion)
        out[:, 0, 0] = g + 2.0 * dg * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        out[:, 0, 1] = out[:, 1, 0] = 2.0 * (dg * x * y + p1 * x + p2 * y)
        out[:, 1, 1] = g + 2.0 * dg * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        return out


def _radial(r2: Array, distortion: Array) -> tuple[Array, Array]:
    """Return g(r²) and its derivative by r²."""
    k1, k2 = distortion[:2]
    k3 = distortion[4] if len(distortion) > 4 else 0.0
    up = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    d_up = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)
    if len(distortion) < 8:
        return np.asarray(up), np.asarray(d_up)
    k4, k5, k6 = distortion[5:]
    down = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    d_down = k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6)
    return np.asarray(up / down), np.asarray((d_up * down - up * d_down) / (down * down))
