"""Undistortion of images: what a lens has bent becomes the picture of an ideal pinhole.

The geometry (which pinhole) is `geometry.undistort`; this file resamples images with it. An image
of a pinhole passes through untouched. For two cameras there is `rectifier`.

Reference: R. Szeliski, "Computer Vision: Algorithms and Applications", 2nd ed., Springer 2022.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.camera import Camera
from odomap.geometry.undistort import Undistortion
from odomap.vision.remap import Remap

__all__ = ["Undistorter"]

Image = NDArray[np.uint8]


class Undistorter:
    """Resamples the images of one camera.

    Attributes:
        geometry: the camera and its ideal pinhole.
        camera: the ideal pinhole of the images made; the mount is that of the camera.
        mask: (H, W) bool, where the undistorted image holds what the camera saw, less a margin.
    """

    def __init__(self, camera: Camera) -> None:
        self.geometry = Undistortion.of(camera)
        self.camera = self.geometry.camera
        self._warp: Remap | None = None
        self.mask = np.ones((camera.height, camera.width), np.bool_)
        if not self.geometry.is_identity:
            self._warp = Remap(*self.geometry.maps(), camera.resolution)
            self.mask = self._warp.mask

    def undistort(self, image: Image) -> Image:
        """Return the undistorted image, black where the camera saw nothing."""
        return image if self._warp is None else self._warp.image(image)

    def to_raw(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where undistorted pixels (N, 2) lie in the raw image, to 0.1 px.

        For drawing: the exact way is `geometry.to_raw`.
        """
        return pixels if self._warp is None else self._warp.to_raw(pixels)
