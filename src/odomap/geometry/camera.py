"""Cameras: from a point to a pixel and back.

The problem: a lens maps a ray to the image plane at focal length 1, (x', y') = lens(X, Y, Z), and
the sensor counts pixels there,

    u  = fx x' + cx,   v = fy y' + cy.

What a lens does is one entry of `MODELS`:

    pinhole          radial-tangential distortion, k1 k2 p1 p2 [k3 [k4 k5 k6]]; up to 90° off axis
    kannala_brandt   fisheye, k1 k2 k3 k4: radius as a polynomial of the angle; up to 180°
    double_sphere    fisheye, xi alpha: through two unit spheres, inverse in closed form

A model is one-to-one up to its `reach` only: what lies beyond projects to NaN rather than to a
place in the image where it is not. Fisheyes see points beside and behind the camera, Z <= 0; their
rays have no x/z, and `undistort` answers NaN where `unproject` has a direction. O(N).

Reference: J. Heikkilä, O. Silvén, "A four-step camera calibration procedure", CVPR 1997.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import CalibrationError, InputError, nearest_name
from odomap.geometry.fisheye import DoubleSphere, KannalaBrandt
from odomap.geometry.lenses import LensModel, RadialTangential
from odomap.geometry.so3 import Array, tail_shape

__all__ = ["MODELS", "Camera"]

MODELS: Mapping[str, LensModel] = MappingProxyType(
    {
        "pinhole": RadialTangential(),
        "kannala_brandt": KannalaBrandt(),
        "double_sphere": DoubleSphere(),
    }
)
"""Lens models by the name they have in a rig file."""


@dataclass(frozen=True, eq=False, repr=False)
class Camera:
    """A calibrated camera: lens model, intrinsics, distortion, and image size.

    Attributes:
        model: name of the lens model, a key of `MODELS`.
        intrinsics: (4,) fx fy cx cy, pixels; pixel (0, 0) is the centre of the top-left pixel.
        distortion: coefficients of the model: (0 | 4 | 5 | 8,) k1 k2 p1 p2 [k3 [k4 k5 k6]] of a
            pinhole, (4,) k1 k2 k3 k4 of kannala_brandt, (2,) xi alpha of double_sphere.
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
        lens = MODELS[self.model]
        if distortion.ndim != 1 or len(distortion) not in lens.lengths:
            allowed = " or ".join(map(str, lens.lengths))
            raise CalibrationError(
                f"distortion: {distortion.size} numbers, a {self.model} camera has {allowed} "
                f"({lens.names})"
            )
        object.__setattr__(self, "intrinsics", intrinsics)
        object.__setattr__(self, "distortion", distortion)
        object.__setattr__(self, "resolution", _size(self.resolution))
        _ = self._reach  # refuses coefficients that are of no lens

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
        """(3, 3) intrinsic matrix, read-only: from the plane at focal length 1 to pixels."""
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
            (N, 2) pixels, NaN where the lens model cannot see: for a pinhole all that is behind
            the camera.
        """
        points = _rows(points_camera, 3, "points_camera")
        plane = MODELS[self.model].to_plane(points, self.distortion, self._reach)
        return np.asarray(plane * self.intrinsics[:2] + self.intrinsics[2:])

    def project_jacobian(self, points_camera: ArrayLike) -> Array:
        """Return the derivative of `project` by the points.

        Args:
            points_camera: (N, 3) metres.

        Returns:
            (N, 2, 3) pixels per metre, NaN behind a pinhole.
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
            (N, 2), NaN where no ray leads to the pixel, or one from beside or behind the camera.
        """
        rays = self._rays(pixels)
        depth = np.where(rays[:, 2:] > 0, rays[:, 2:], np.nan)
        return np.ascontiguousarray(rays[:, :2] / depth)

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
