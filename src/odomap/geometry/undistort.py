"""Undistortion: the ideal pinhole that a real camera is warped into.

The problem: straight lines are bent by a lens, and front-ends want a pinhole, in which a step of
one pixel is the same step of x/z everywhere. Each pixel of the pinhole is followed back,

    u_raw = project(K⁻¹ u),    K = [[f, 0, cx], [0, f, cy], [0, 0, 1]],

through the lens, and the image is read there. What remains to choose is f. The lens's own
magnification on the axis keeps the detail in the middle; a smaller f keeps more of the rim, so f
is lowered until 95 % of the raw image's pixels are in view: what goes are the corners.

A pinhole stretches a ray at the angle θ from the axis by 1/cos²θ along the radius (3 at 55°, 8 at
70°, without end at 90°): the rim of a wide fisheye would fill the image with a smear, in which
nothing can be matched, and leave few pixels for the rest. The longer side of the image therefore
spans at most 110°, unless the lens is itself a pinhole that spans more. O(pixels).

Reference: R. Szeliski, "Computer Vision: Algorithms and Applications", 2nd ed., Springer 2022,
section 2.1.5.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import CalibrationError
from odomap.geometry.camera import Camera
from odomap.geometry.so3 import Array

__all__ = ["Undistortion", "axis_focal", "lowest_focal", "view_middle", "warp_maps"]

_KEPT = 0.95
"""Share of the raw image's pixels that stay in view."""
_WIDEST = np.deg2rad(110.0)
"""Widest view of the longer side of a pinhole image, where the lens is wider."""
_AHEAD = 0.05
"""Rays with a smaller z, of length 1, leave a pinhole at 87° and more."""


@dataclass(frozen=True, eq=False)
class Undistortion:
    """A camera and the ideal pinhole it is warped into; made by `of`.

    Attributes:
        raw: the camera as it is.
        camera: the pinhole, no distortion, the raw camera's resolution and axes.
        is_identity: the camera is a pinhole already; its images need no warping.

    Example:
        >>> lens = Camera("pinhole", (500, 500, 320, 240), (-0.3, 0.1, 0, 0), (640, 480))
        >>> ideal = Undistortion.of(lens)
        >>> ideal.to_raw([[ideal.camera.cx, ideal.camera.cy]])
        array([[320., 240.]])
    """

    raw: Camera
    camera: Camera
    is_identity: bool

    @classmethod
    def of(cls, camera: Camera, focal_px: float | None = None) -> "Undistortion":
        """Choose the pinhole for a camera.

        Args:
            camera: any camera.
            focal_px: focal length of the pinhole; default as the module's page says.

        Returns:
            The undistortion.

        Raises:
            CalibrationError: the lens model cannot be inverted anywhere near its axis.
        """
        if focal_px is None and camera.model == "pinhole" and not np.any(camera.distortion):
            return cls(camera, camera, True)
        size = np.array(camera.resolution, dtype=np.float64)
        middle = view_middle(camera, np.eye(3))
        focal = _focal(camera, middle) if focal_px is None else float(focal_px)
        principal = 0.5 * (size - 1.0) - focal * middle
        intrinsics = np.array([focal, focal, *principal])
        ideal = Camera("pinhole", intrinsics, np.array([]), camera.resolution)
        return cls(camera, ideal, False)

    def maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return where each pixel of the pinhole lies in the raw image, for bilinear warping.

        Returns:
            map_x, map_y: (H, W) float32 pixels; -1 where the lens sees nothing.
        """
        return warp_maps(self.camera, self.raw, np.eye(3))

    def to_raw(self, pixels: ArrayLike) -> Array:
        """Map pixels of the pinhole to pixels of the raw image.

        Args:
            pixels: (N, 2).

        Returns:
            (N, 2) pixels, NaN where the lens sees nothing.
        """
        return self.raw.project(self.camera.unproject(pixels))


def warp_maps(
    ideal: Camera, raw: Camera, R_raw_ideal: Array
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return where each pixel of one camera lies in the image of another with the same centre.

    Args:
        ideal: the camera whose image is made.
        raw: the camera whose image is read.
        R_raw_ideal: (3, 3) turns the first one's axes into the second one's.

    Returns:
        map_x, map_y: (H, W) float32 pixels; -1 where the second camera sees nothing.
    """
    w, h = ideal.resolution
    u, v = np.meshgrid(np.arange(w, dtype=np.float64), np.arange(h, dtype=np.float64))
    rays = ideal.unproject(np.stack([u.ravel(), v.ravel()], axis=1))
    pixels = raw.project(rays @ R_raw_ideal.T)
    pixels = np.where(np.isnan(pixels), -1.0, pixels).astype(np.float32)
    return (
        np.ascontiguousarray(pixels[:, 0].reshape(h, w)),
        np.ascontiguousarray(pixels[:, 1].reshape(h, w)),
    )


def axis_focal(camera: Camera) -> Array:
    """Return the magnification (2,) of a lens on its axis along x and y, pixels per radian."""
    return np.diag(camera.project_jacobian([[0.0, 0.0, 1.0]])[0, :, :2])


def lowest_focal(camera: Camera) -> float:
    """Return the focal length below which the pinhole's rim would be a smear, pixels."""
    limit = 0.5 * max(camera.resolution) / np.tan(0.5 * _WIDEST)
    if camera.model == "pinhole":
        # Its raw image has the stretch in it already: nothing is won by cutting it.
        return float(min(limit, np.mean(axis_focal(camera))))
    return float(limit)


def view_middle(camera: Camera, R_camera_ideal: Array) -> Array:
    """Return x/z, y/z of the middle of what a camera sees, in turned axes.

    The middle of a fisheye's view is its axis wherever the pinhole cannot hold the rim anyway.

    Args:
        camera: any camera.
        R_camera_ideal: (3, 3) turns the axes of the pinhole into those of the camera.

    Returns:
        (2,) the mean over the border of the image.
    """
    rays = camera.unproject(_border(camera)) @ R_camera_ideal
    ahead = np.all(np.isfinite(rays), axis=1) & (rays[:, 2] > _AHEAD)
    if camera.model != "pinhole" and not np.all(ahead & (rays[:, 2] > 0.5)):
        axis = R_camera_ideal[2]
        return np.asarray(axis[:2] / axis[2])
    plane = rays[ahead]
    if len(plane) < 4:
        raise CalibrationError("distortion: the lens model cannot be inverted at the border")
    return np.asarray(np.mean(plane[:, :2] / plane[:, 2:], axis=0))


def _focal(camera: Camera, middle: Array) -> float:
    """Return the focal length that keeps most of the view, within its limits."""
    w, h = camera.resolution
    u, v = np.meshgrid(np.linspace(0, w - 1, 48), np.linspace(0, h - 1, 48))
    rays = camera.unproject(np.stack([u.ravel(), v.ravel()], axis=1))
    seen = np.all(np.isfinite(rays), axis=1)
    if not np.any(seen):
        raise CalibrationError("distortion: the lens model cannot be inverted in the image")
    rays = rays[seen]
    far = rays[:, 2] <= _AHEAD
    plane = rays[:, :2] / np.where(far, 1.0, rays[:, 2])[:, None]
    # A pixel is in view up to this focal length.
    half = 0.5 * (np.array([w, h]) - 1.0)
    held = np.min(half / np.maximum(np.abs(plane - middle), 1e-12), axis=1)
    held[far] = 0.0
    kept = float(np.quantile(held, 1.0 - _KEPT))
    return max(min(kept, float(np.mean(axis_focal(camera)))), lowest_focal(camera))


def _border(camera: Camera) -> Array:
    """Return pixels all around the image, 32 per side."""
    s = np.linspace(0.0, 1.0, 32)
    low, high = np.zeros_like(s), np.ones_like(s)
    unit = np.concatenate([np.stack(p, 1) for p in ((s, low), (s, high), (low, s), (high, s))])
    return unit * (np.array(camera.resolution) - 1.0)
