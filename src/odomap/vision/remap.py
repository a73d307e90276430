"""Warping images: read a raw image where a map says, quickly, and find the way back.

Maps are kept twice: in fixed point for images (to 1/32 px as with floating ones, in half the time)
and as floats for points, where the exact way through the lens would cost more than tracking them.

Reference: OpenCV's `remap` and `convertMaps`.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["Remap"]

Image = NDArray[np.uint8]
Map = NDArray[np.float32]

_MARGIN = 17
"""Side of the square of the mask around a pixel that must have been seen, pixels."""


class Remap:
    """Resamples images of one camera by a pair of maps.

    Attributes:
        mask: (H, W) bool, where the made image holds what the camera saw, less a margin.
    """

    def __init__(self, map_x: Map, map_y: Map, raw_size: tuple[int, int]) -> None:
        """Prepare the maps.

        Args:
            map_x, map_y: (H, W) where each pixel lies in the raw image; -1 where nowhere.
            raw_size: width and height of the raw image.
        """
        fixed, fraction = cv2.convertMaps(map_x, map_y, cv2.CV_16SC2)
        self._fixed = np.asarray(fixed, np.int16), np.asarray(fraction, np.uint16)
        self._map = map_x, map_y
        inside = (map_x >= 1) & (map_x < raw_size[0] - 2)
        inside &= (map_y >= 1) & (map_y < raw_size[1] - 2)
        square = np.ones((_MARGIN, _MARGIN), np.uint8)
        self.mask = np.asarray(cv2.erode(inside.astype(np.uint8), square, borderValue=1) > 0)

    def image(self, image: Image) -> Image:
        """Return the resampled image, black where the raw one has nothing."""
        return np.asarray(cv2.remap(image, *self._fixed, cv2.INTER_LINEAR), np.uint8)

    def to_raw(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where pixels (N, 2) lie in the raw image, read between those of the map."""
        if not len(pixels):
            return pixels
        at = pixels.astype(np.float32)
        x, y = at[None, :, 0], at[None, :, 1]
        raw = [
            cv2.remap(way, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]
            for way in self._map
        ]
        return np.stack(raw, axis=1).astype(np.float64)
