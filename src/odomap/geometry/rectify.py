"""Stereo rectification: turn two cameras until their rows agree.

The problem: a point seen in the left image lies on a curve of the right one. If both cameras are
turned about their own centres to one common orientation whose x axis is the baseline, and are given
one common pinhole, the curve becomes the same row and only the disparity is unknown:

    x = c / |c|,   y ∝ (z_left + z_right) × x,   z = x × y,   Z = f · baseline / disparity

with c the right camera's centre and z the two viewing directions, all in left-camera axes. The
common focal length is the mean of the originals, so that a pixel keeps its detail, and the
principal point is chosen so that the two views lie centred in the image. Maps for image warping
follow a rectified pixel back through the rotation and the lens. O(pixels).

Reference: A. Fusiello, E. Trucco, A. Verri, "A compact algorithm for rectification of stereo
pairs", Machine Vision and Applications 12(1), 2000.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import CalibrationError, InputError
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.geometry.so3 import Array
from odomap.geometry.undistort import axis_focal, lowest_focal, view_middle, warp_maps

__all__ = ["Side", "StereoRectification"]

Side = Literal["left", "right"]

_SAME = 1e-6
"""Radians and relative focal lengths below this move no pixel by more than a hundredth."""


@dataclass(frozen=True, eq=False)
class StereoRectification:
    """Two cameras and the common pinhole they are turned into; made by `of`.

    Attributes:
        left: the left camera as it is.
        right: the right camera as it is.
        camera: the rectified pinhole both share, no distortion, the left camera's resolution.
        baseline: metres, above 0.
        R_left_rect: (3, 3) turns rectified axes into left-camera axes.
        R_right_rect: (3, 3) turns rectified axes into right-camera axes.
        is_identity: the pair is rectified already; its images need no warping.
    """

    left: Camera
    right: Camera
    camera: Camera
    baseline: float
    R_left_rect: Array
    R_right_rect: Array
    is_identity: bool

    @classmethod
    def of(
        cls, left: Camera, right: Camera, T_left_right: SE3, focal_px: float | None = None
    ) -> "StereoRectification":
        """Rectify a pair of cameras that look the same way.

        Args:
            left: left camera.
            right: right camera.
            T_left_right: maps right-camera to left-camera coordinates, metres.
            focal_px: focal length of the common pinhole; default the mean of the originals.

        Returns:
            The rectification.

        Raises:
            CalibrationError: the pair has no baseline, is swapped, is mounted one above the other,
                or looks in directions over 60° apart.
        """
        _check_pair(T_left_right)
        baseline = float(np.linalg.norm(T_left_right.t))
        if focal_px is None and _is_rectified(left, right, T_left_right):
            eye = _frozen(np.eye(3))
            return cls(left, right, left, baseline, eye, eye, True)
        x = T_left_right.t / baseline
        y = np.cross(T_left_right.R[:, 2] + np.array([0.0, 0.0, 1.0]), x)
        y /= np.linalg.norm(y)
        R_left_rect = np.stack([x, y, np.cross(x, y)], axis=1)
        R_right_rect = T_left_right.R.T @ R_left_rect
        camera = _common_pinhole(left, right, R_left_rect, R_right_rect, focal_px)
        frozen = _frozen(R_left_rect), _frozen(R_right_rect)
        return cls(left, right, camera, baseline, *frozen, False)

    @property
    def T_left_rect(self) -> SE3:
        """Pose of the rectified left camera in left-camera axes: a turn about the same centre."""
        return SE3.from_parts(self.R_left_rect, np.zeros(3))

    def maps(self, which: Side) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return where each rectified pixel lies in the raw image, for bilinear warping.

        Args:
            which: "left" or "right".

        Returns:
            map_x, map_y: (H, W) float32 pixels; -1 where the lens sees nothing.
        """
        camera, R_camera_rect = self._side(which)
        return warp_maps(self.camera, camera, R_camera_rect)

    def to_raw(self, pixels_rect: ArrayLike, which: Side) -> Array:
        """Map rectified pixels to pixels of the raw image.

        Args:
            pixels_rect: (N, 2).
            which: "left" or "right".

        Returns:
            (N, 2) pixels, NaN where the lens sees nothing.
        """
        camera, R_camera_rect = self._side(which)
        return camera.project(self.camera.unproject(pixels_rect) @ R_camera_rect.T)

    def from_raw(self, pixels_raw: ArrayLike, which: Side) -> Array:
        """Map pixels of the raw image to rectified pixels.

        Args:
            pixels_raw: (N, 2).
            which: "left" or "right".

        Returns:
            (N, 2) pixels.
        """
        camera, R_camera_rect = self._side(which)
        return self.camera.project(camera.unproject(pixels_raw) @ R_camera_rect)

    def _side(self, which: Side) -> tuple[Camera, Array]:
        if which == "left":
            return self.left, self.R_left_rect
        if which == "right":
            return self.right, self.R_right_rect
        raise InputError(f"which: is {which!r}, give 'left' or 'right'")


def _frozen(matrix: Array) -> Array:
    matrix.setflags(write=False)
    return matrix


def _check_pair(T_left_right: SE3) -> None:
    c = T_left_right.t
    if np.linalg.norm(c) < 1e-9:
        raise CalibrationError("T_left_right: the baseline is 0, give the distance in metres")
    if T_left_right.R[2, 2] < 0.5:
        raise CalibrationError("T_left_right: the cameras look over 60° apart, no stereo pair")
    if abs(c[0]) < max(abs(c[1]), abs(c[2])):
        raise CalibrationError(
            f"T_left_right: the right camera is at {c.tolist()}, not to the right; "
            "turn the cameras or check the axes (x right, y down, z forward)"
        )
    if c[0] < 0:
        raise CalibrationError(
            f"T_left_right: the right camera is {-c[0]:.3g} m to the left: swap the two cameras"
        )


def _is_rectified(left: Camera, right: Camera, T_left_right: SE3) -> bool:
    """Say whether rows agree already: the same pinhole twice, moved along x only."""
    direction = T_left_right.t / np.linalg.norm(T_left_right.t)
    tolerance = _SAME * np.array([left.fx, left.fy, left.fx, left.fx])
    return bool(
        left.model == right.model == "pinhole"
        and not np.any(left.distortion)
        and not np.any(right.distortion)
        and left.resolution == right.resolution
        and np.all(np.abs(left.intrinsics - right.intrinsics) <= tolerance)
        and np.max(np.abs(T_left_right.R - np.eye(3))) <= _SAME
        and np.max(np.abs(direction - np.array([1.0, 0.0, 0.0]))) <= _SAME
    )


def _common_pinhole(
    left: Camera, right: Camera, R_left_rect: Array, R_right_rect: Array, focal_px: float | None
) -> Camera:
    """Return the shared pinhole: the mean focal length, both views centred in the image."""
    sides = ((left, R_left_rect), (right, R_right_rect))
    if focal_px is None:
        focal = float(np.mean([axis_focal(camera) for camera, _ in sides]))
        focal = max(focal, float(np.mean([lowest_focal(camera) for camera, _ in sides])))
    else:
        focal = float(focal_px)
    middle = np.mean([view_middle(camera, R) for camera, R in sides], axis=0)
    principal = 0.5 * (np.array(left.resolution, dtype=np.float64) - 1.0) - focal * middle
    return Camera("pinhole", np.array([focal, focal, *principal]), np.array([]), left.resolution)
