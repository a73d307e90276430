"""Rectification of images: a stereo pair becomes one with parallel axes and common rows.

The geometry (which rotations, which common camera) is `geometry.rectify`; this file resamples the
images with it. A pair that is rectified already passes through untouched.

Reference: Fusiello, Trucco, Verri, "A compact algorithm for rectification of stereo pairs", 2000.
"""

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.geometry.rectify import StereoRectification
from odomap.sensors.rig import Rig

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
        self._maps: dict[str, tuple[NDArray[np.int16], NDArray[np.uint16]]] = {}
        self.mask = np.ones((self.camera.height, self.camera.width), np.bool_)
        if not self.geometry.is_identity:
            for which in ("left", "right"):
                # Fixed-point maps: to 1/32 px as with floating ones, in half the time.
                map_x, map_y = self.geometry.maps(which)
                fixed, fraction = cv2.convertMaps(map_x, map_y, cv2.CV_16SC2)
                self._maps[which] = np.asarray(fixed, np.int16), np.asarray(fraction, np.uint16)
            self._map_left = self.geometry.maps("left")
            self.mask = self._seen(*self._map_left, left.camera.resolution)

    @staticmethod
    def _seen(
        map_x: NDArray[np.float32], map_y: NDArray[np.float32], size: tuple[int, int]
    ) -> NDArray[np.bool_]:
        inside = (map_x >= 1) & (map_x < size[0] - 2) & (map_y >= 1) & (map_y < size[1] - 2)
        eroded = cv2.erode(inside.astype(np.uint8), np.ones((17, 17), np.uint8), borderValue=1)
        return np.asarray(eroded > 0)

    def rectify(self, image: Image, which: Literal["left", "right"]) -> Image:
        """Return the rectified image of one of the two cameras."""
        if which not in self._maps:
            return image
        return np.asarray(cv2.remap(image, *self._maps[which], cv2.INTER_LINEAR), np.uint8)

    def to_raw(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where rectified pixels (N, 2) of the left camera lie in its raw image, to 0.1 px.

        The map is read between its pixels; for drawing, where the exact way back through the lens
        (`geometry.to_raw`) would cost more than tracking the points.
        """
        if self.geometry.is_identity or not len(pixels):
            return pixels
        at = pixels.astype(np.float32)
        x, y = at[None, :, 0], at[None, :, 1]
        raw = [
            cv2.remap(way, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]
            for way in self._map_left
        ]
        return np.stack(raw, axis=1).astype(np.float64)
