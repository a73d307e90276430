"""The eye: the camera that is tracked, made ideal.

Whatever the rig carries, tracking sees the images of one pinhole camera without distortion: the
left one of a rectified pair, or a single camera whose lens has been undone. Points are in its
pixels; only what is drawn goes back to those of the raw image.

Reference: R. Hartley, A. Zisserman, "Multiple View Geometry in Computer Vision", 2nd ed.,
Cambridge University Press 2004, chapter 6.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig
from odomap.vision.rectifier import Rectifier
from odomap.vision.undistorter import Undistorter

__all__ = ["Eye"]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Eye:
    """An ideal camera on the body.

    Attributes:
        index: which of a frame's images is its.
        name: of that camera, for people.
        camera: the pinhole.
        T_body_camera: (4, 4) its mount.
        mask: (H, W) bool, where its image holds something.
        raw: width and height of the images as they come.
        ideal: makes a raw image that of the pinhole.
        to_raw: maps (N, 2) pixels of the pinhole to those of the raw image.
    """

    index: int
    name: str
    camera: Camera
    T_body_camera: Array
    mask: NDArray[np.bool_]
    raw: tuple[int, int]
    ideal: Callable[[Image], Image]
    to_raw: Callable[[Array], Array]

    @staticmethod
    def of_pair(rig: Rig, rectifier: Rectifier) -> "Eye":
        """Return the left one of a rectified pair."""
        left, _ = rig.stereo_pair()
        return Eye(
            rig.cameras.index(left),
            "left",
            rectifier.camera,
            rectifier.T_body_camera,
            rectifier.mask,
            left.camera.resolution,
            lambda image: rectifier.rectify(image, "left"),
            rectifier.to_raw,
        )

    @staticmethod
    def of_camera(camera: Camera, index: int = 0, T_body_camera: SE3 | None = None) -> "Eye":
        """Return a single camera without its lens; the body unless it is mounted on one."""
        lens = Undistorter(camera)
        mount = SE3.identity() if T_body_camera is None else T_body_camera
        return Eye(
            index,
            "camera",
            lens.camera,
            np.array(mount.matrix),
            lens.mask,
            camera.resolution,
            lens.undistort,
            lens.to_raw,
        )

    def image(self, frame: Frame) -> Image | None:
        """Return the ideal image of a frame; None if it is missing.

        Raises:
            CalibrationError: the image has another size than the calibration.
        """
        raw = frame.images[self.index] if self.index < len(frame.images) else None
        if raw is None:
            return None
        if raw.shape[::-1] != self.raw:
            (w, h), (width, height) = raw.shape[::-1], self.raw
            raise CalibrationError(
                f"frame {frame.id}: the image is {w}x{h}, the calibration is for {width}x{height}: "
                "give the calibration of this resolution"
            )
        return self.ideal(raw)
