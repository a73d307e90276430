"""Depth images: the depth of points from a sensor that measures it beside the image.

Structured light and time of flight know depth at whole pixels, with holes, and at the rim of an
object with a value that belongs to neither side. A feature lies between pixels, and it is where
objects end that corners are found. So depth is interpolated where the pixels around agree, taken
from the neighbourhood's median where some are missing, and left unknown where they differ by more
than a slanted surface would make them. What is interpolated is 1/z, which is linear in the image
on a plane:  1/z = (n · K⁻¹ (u, v, 1)) / d.  Rounding (u, v) to whole pixels instead is wrong by up
to half a pixel of slope: a centimetre on a floor three metres away.

Triangulating sensors err by σ_z = σ z², a constant error of 1/z, which is what is modelled here.

Cost: a window of 25 pixels per point.

Reference: Khoshelham, Elberink, "Accuracy and Resolution of Kinect Depth Data for Indoor Mapping
Applications", Sensors 2012.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.kernels import kernel
from odomap.vision.visionconfig import DepthConfig

__all__ = ["DepthConfig", "inverse_depth_at", "warm_up"]

Depth = NDArray[np.float32]


def inverse_depth_at(
    depth: Depth, pixels: NDArray[np.float64], config: DepthConfig
) -> NDArray[np.float64]:
    """Read the inverse depth of points between pixels.

    Args:
        depth: (H, W) float32 metres, 0 where unknown.
        pixels: (N, 2) in the depth image.
        config: what to believe.

    Returns:
        (N,) 1/m, NaN where the depth is not known.

    Raises:
        InputError: the depth image is not (H, W).
    """
    if depth.ndim != 2:
        raise InputError(f"depth: shape {depth.shape}, give (H, W) metres")
    inverse = np.full(len(pixels), np.nan)
    _read_kernel(
        np.ascontiguousarray(depth, np.float32),
        np.ascontiguousarray(pixels, np.float64),
        config.nearest,
        config.farthest,
        config.edge,
        inverse,
    )
    return inverse


@kernel
def _read_kernel(
    depth: Depth,
    pixels: NDArray[np.float64],
    nearest: float,
    farthest: float,
    edge: float,
    inverse: NDArray[np.float64],
) -> None:
    """Interpolate 1/z between four pixels that agree, else take the median of 5x5 that do."""
    height, width = depth.shape
    window = np.empty(25)
    for i in range(len(pixels)):
        x, y = pixels[i, 0], pixels[i, 1]
        if not (x >= 0.0 and y >= 0.0 and x <= width - 1.0 and y <= height - 1.0):
            continue
        column, row = min(int(x), width - 2), min(int(y), height - 2)
        low, high, total, count = np.inf, 0.0, 0.0, 0
        for v in range(2):
            for u in range(2):
                z = float(depth[row + v, column + u])
                if not nearest <= z <= farthest:
                    continue
                low, high, count = min(low, z), max(high, z), count + 1
                along = x - column if u == 1 else 1.0 - (x - column)
                down = y - row if v == 1 else 1.0 - (y - row)
                total += along * down / z
        if count == 4 and high - low <= edge * low:
            inverse[i] = total
            continue
        count = 0
        middle_row, middle_column = int(y + 0.5), int(x + 0.5)
        for v in range(max(middle_row - 2, 0), min(middle_row + 3, height)):
            for u in range(max(middle_column - 2, 0), min(middle_column + 3, width)):
                z = float(depth[v, u])
                if nearest <= z <= farthest:
                    window[count] = z
                    count += 1
        if count < 6:
            continue
        known = np.sort(window[:count])
        if known[count - 1] - known[0] <= edge * known[0]:
            inverse[i] = 1.0 / known[count // 2]


def warm_up() -> None:
    """Compile the kernels of this module."""
    depth = np.full((8, 8), 2.0, np.float32)
    depth[2, 2] = 0.0
    inverse_depth_at(depth, np.array([[5.2, 5.1], [2.0, 2.0]]), DepthConfig())
