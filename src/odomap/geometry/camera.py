"""Cameras: from a point to a pixel and back.

The problem: a lens maps a ray to the image plane with a distortion that has no inverse in closed
form. For the pinhole model with radial-tangential distortion, with x = X/Z, y = Y/Z, r² = x² + y²,

    g  = (1 + k₁r² + k₂r⁴ + k₃r⁶) / (1 + k₄r² + k₅r⁴ + k₆r⁶)
    x' = g x + 2p₁xy + p₂(r² + 2x²),   y' = g y + p₁(r² + 2y²) + 2p₂xy
    u  = fx x' + cx,   v = fy y' + cy

`undistort` inverts it by Newton's method with the exact 2x2 Jacobian: quadratic, four steps for a
wide lens. The polynomial is a lens only up to the radius where r·g(r²) stops growing; beyond it
far-off points would fold back into the image, so they project to NaN, as do points behind the
camera. Other lenses are one entry in `MODELS`. O(N).

Reference: D. C. Brown, "Close-range camera calibration", Photogrammetric Engineering 37(8), 1971;
J. Heikkilä, O. Silvén, "A four-step camera calibration procedure", CVPR 1997.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import CalibrationError, InputError, nearest_name
from odomap.geometry.so3 import Array, tail_shape

__all__ = ["MODELS", "Camera", "LensModel", "RadialTangential"]


class LensModel(Protocol):
    """What a lens must know: rays to the plane at focal length 1, and back.

    Methods take the coefficients and what `reach` made of them.
    """

    @property
    def lengths(self) -> tuple[int, ...]:
        """Allowed numbers of distortion coefficients."""
        ...

    def reach(self, distortion: Array) -> float:
        """Return how far from the axis the model is one-to-one, in the lens's own measure."""
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


MODELS: Mapping[str, LensModel] = MappingProxyType({"pinhole": RadialTangential()})
"""Lens models by the name they have in a rig file."""


@dataclass(frozen=True, eq=False, repr=False)
class Camera:
    """A calibrated camera: lens model, intrinsics, distortion, and image size.

    Attributes:
        model: name of the lens model, a key of `MODELS`.
        intrinsics: (4,) fx fy cx cy, pixels; pixel (0, 0) is the centre of the top-left pixel.
        distortion: (0 | 4 | 5 | 8,) k1 k2 p1 p2 [k3 [k4 k5 k6]].
        resolution: width and height, pixels.

    Raises:
        CalibrationError: unknown model, or numbers that no camera has.

    Example:
        >>> camera = Camera(intrinsics=(500.0, 500.0, 320.0, 240.0), resolution=(640, 480))
        >>> camera.project(np.array([[0.0, 0.0, 2.0]]))
        array([[320., 240.]])
    """

    model: str = "pinhole"
    intrinsics: Array = field(default_factory=lambda: np.array([]))
    distortion: Array = field(default_factory=lambda: np.array([]))
    resolution: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            known = ", ".join(MODELS)
            hint = nearest_name(str(self.model), MODELS)
            raise CalibrationError(f"model: '{self.model}' is unknown{hint}; known are {known}")
        intrinsics = _numbers(self.intrinsics, "intrinsics")
        if intrinsics.shape != (4,):
            raise CalibrationError(f"intrinsics: {intrinsics.size} numbers, give fx fy cx cy")
        if np.any(intrinsics[:2] <= 0):
            raise CalibrationError(
                f"intrinsics: focal lengths {intrinsics[:2].tolist()} must be above 0 pixels"
            )
        distortion = _numbers(self.distortion, "distortion")
        lengths = MODELS[self.model].lengths
        if distortion.ndim != 1 or len(distortion) not in lengths:
            allowed = ", ".join(map(str, lengths))
            raise CalibrationError(
                f"distortion: {distortion.size} numbers, give {allowed} (k1 k2 p1 p2 [k3 …])"
            )
        object.__setattr__(self, "intrinsics", intrinsics)
        object.__setattr__(self, "distortion", distortion)
        object.__setattr__(self, "resolution", _size(self.resolution))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Camera):
            return NotImplemented
        return (
            (self.model, self.resolution) == (other.model, other.resolution)
            and np.array_equal(self.intrinsics, other.intrinsics)
            and np.array_equal(self.distortion, other.distortion)
        )

    def __hash__(self) -> int:
        numbers = (*self.intrinsics.tolist(), *self.distortion.tolist())
        return hash((self.model, self.resolution, numbers))

    def __reduce__(self) -> tuple[object, ...]:
        return Camera, (self.model, self.intrinsics, self.distortion, self.resolution)

    def __repr__(self) -> str:
        intrinsics, distortion = self.intrinsics.tolist(), self.distortion.tolist()
        return f"Camera('{self.model}', {intrinsics}, {distortion}, {self.resolution})"

    @property
    def fx(self) -> float:
        """Focal length along x, pixels."""
        return float(self.intrinsics[0])

    @property
    def fy(self) -> float:
        """Focal length along y, pixels."""
        return float(self.intrinsics[1])

    @property
    def cx(self) -> float:
        """Principal point x, pixels."""
        return float(self.intrinsics[2])

    @property
    def cy(self) -> float:
        """Principal point y, pixels."""
        return float(self.intrinsics[3])

    @property
    def width(self) -> int:
        """Image width, pixels."""
        return self.resolution[0]

    @property
    def height(self) -> int:
        """Image height, pixels."""
        return self.resolution[1]

    @cached_property
    def K(self) -> Array:
        """(3, 3) intrinsic matrix, read-only."""
        K = np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])
        K.setflags(write=False)
        return K

    @cached_property
    def _reach(self) -> float:
        return MODELS[self.model].reach(self.distortion)

    def project(self, points_camera: ArrayLike) -> Array:
        """Project points to pixels.

        Args:
            points_camera: (N, 3) metres, camera axes (x right, y down, z forward).

        Returns:
            (N, 2) pixels, NaN behind the camera or beyond what the lens model can see.
        """
        points = _rows(points_camera, 3, "points_camera")
        plane = MODELS[self.model].to_plane(points, self.distortion, self._reach)
        return np.asarray(plane * self.intrinsics[:2] + self.intrinsics[2:])

    def project_jacobian(self, points_camera: ArrayLike) -> Array:
        """Return the derivative of `project` by the points.

        Args:
            points_camera: (N, 3) metres.

        Returns:
            (N, 2, 3) pixels per metre, NaN behind the camera.
        """
        points = _rows(points_camera, 3, "points_camera")
        jacobian = MODELS[self.model].to_plane_jacobian(points, self.distortion)
        return np.asarray(jacobian * self.intrinsics[:2, None])

    def unproject(self, pixels: ArrayLike) -> Array:
        """Return the rays that end in pixels.

        Args:
            pixels: (N, 2).

        Returns:
            (N, 3) unit vectors, camera axes; NaN where no ray leads to the pixel.
        """
        rays = self._rays(pixels)
        return np.asarray(rays / np.sqrt(np.sum(rays * rays, axis=1, keepdims=True)))

    def undistort(self, pixels: ArrayLike) -> Array:
        """Return the normalised image coordinates x/z, y/z of pixels.

        Args:
            pixels: (N, 2).

        Returns:
            (N, 2), NaN where no ray leads to the pixel.
        """
        rays = self._rays(pixels)
        return np.ascontiguousarray(rays[:, :2] / rays[:, 2:])

    def distort(self, normalised: ArrayLike) -> Array:
        """Return the pixels of normalised image coordinates, the inverse of `undistort`.

        Args:
            normalised: (N, 2) x/z, y/z.

        Returns:
            (N, 2) pixels.
        """
        xy = _rows(normalised, 2, "normalised")
        return self.project(np.concatenate([xy, np.ones((len(xy), 1))], axis=1))

    def is_inside(self, pixels: ArrayLike, border: float = 0.0) -> NDArray[np.bool_]:
        """Say which pixels lie in the image, at least `border` pixels from its edge.

        Args:
            pixels: (N, 2); NaN is outside.
            border: distance to keep, pixels.

        Returns:
            (N,) bool.
        """
        uv = _rows(pixels, 2, "pixels")
        last = np.array(self.resolution) - 1 - border
        return np.asarray(np.all((uv >= border) & (uv <= last), axis=1))

    def _rays(self, pixels: ArrayLike) -> Array:
        uv = _rows(pixels, 2, "pixels")
        plane = (uv - self.intrinsics[2:]) / self.intrinsics[:2]
        return MODELS[self.model].from_plane(plane, self.distortion, self._reach)


def _numbers(values: ArrayLike, name: str) -> Array:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise CalibrationError(f"{name}: {values!r} is not a list of numbers") from None
    if not np.all(np.isfinite(array)):
        raise CalibrationError(f"{name}: {array.tolist()} has NaN or infinite entries")
    array.setflags(write=False)
    return array


def _size(resolution: tuple[int, int]) -> tuple[int, int]:
    try:
        width, height = (int(n) for n in resolution)
    except (TypeError, ValueError):
        raise CalibrationError(f"resolution: {resolution!r}, give width and height") from None
    if width <= 0 or height <= 0 or (width, height) != tuple(resolution):
        raise CalibrationError(f"resolution: {resolution!r}, give whole pixels above 0")
    return width, height


def _rows(values: ArrayLike, width: int, name: str) -> Array:
    array = tail_shape(values, (width,), name)
    if array.ndim != 2:
        raise InputError(f"{name}: has shape {array.shape}, give (N, {width})")
    return array
