"""Coverage: how large a part of an image some points are spread over.

Many points on one small thing tell less of a pose than few all over the image, and they may be on
something that moves. The measure is the area of the ellipse with the points' covariance,

    4 π √det Σ  /  (width height),

which is 1.05 for points spread evenly over the whole image, and 0 for those on a line.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.camera import Camera

__all__ = ["coverage"]


def coverage(pixels: NDArray[np.float64], camera: Camera) -> float:
    """Return the part of an image that pixels (n, 2) are spread over; 0 for fewer than three.

    Example:
        >>> camera = Camera(intrinsics=(200.0, 200.0, 160.0, 100.0), resolution=(320, 200))
        >>> corners = np.array([[0.0, 0.0], [320.0, 0.0], [0.0, 200.0], [320.0, 200.0]])
        >>> round(coverage(corners, camera), 2), coverage(corners[:2], camera)
        (3.14, 0.0)
    """
    if len(pixels) < 3:
        return 0.0
    det = float(np.linalg.det(np.cov(pixels.T, bias=True)))
    return 4.0 * np.pi * float(np.sqrt(max(det, 0.0))) / (camera.width * camera.height)
