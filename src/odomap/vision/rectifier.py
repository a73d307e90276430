"""Rectification of images: a stereo pair becomes one with parallel axes and common rows.

The geometry (which rotations, which common camera) is `geometry.rectify`; this file resamples the
images with it. A pair that is rectified already passes through untouched.

Reference: Fusiello, Trucco, Verri, "A compact algorithm for rectification of stereo pairs", 2000.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.rectify import StereoRectification
from odomap.sensors.rig import Rig
from odomap.vision.remap import Remap

__all__ = ["Rectifier"]

Image = NDArray[np.uint8]


class Rectifier:
    """Resamples the images of a rig's stereo pair.

    Attributes:
        camera: the rectified camera both images have.
        baseline: metres between the two.
        T_body_camera: (4, 4) mount of the rectified left camera.
        mask: (H, W) bool, where the rectified left image holds what the camera saw, less a margin.
    """

    def __init__(self, rig: Rig) -> None:
        left, right = rig.stereo_pair()
        self.geometry = StereoRectification.of(
            left.camera, right.camera, left.T_body_camera.inverse() @ right.T_body_camera
        )
        self.camera = self.geometry.camera
        self.baseline = float(self.geometry.baseline)
        self.T_body_camera: NDArray[np.float64] = (
            left.T_body_camera @ self.geometry.T_left_rect
        ).matrix
        self._warps: dict[str, Remap] = {}
        self.mask = np.ones((self.camera.height, self.camera.width), np.bool_)
        if not self.geometry.is_identity:
            self._warps = {
                "left": Remap(*self.geometry.maps("left"), left.camera.resolution),
                "right": Remap(*self.geometry.maps("right"), right.camera.resolution),
            }
            self.mask = self._warps["left"].mask

    def rectify(self, image: Image, which: Literal["left", "right"]) -> Image:
        """Return the rectified image of one of the two cameras."""
        return self._warps[which].image(image) if which in self._warps else image

    def to_raw(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where rectified pixels (N, 2) of the left camera lie in its raw image, to 0.1 px.

        For drawing: the exact way is `geometry.to_raw`.
        """
        return self._warps["left"].to_raw(pixels) if "left" in self._warps else pixels
