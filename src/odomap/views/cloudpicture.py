"""A picture of a cloud from above: what stands up, the ground, the path, and a scale.

Each pixel shows the highest point that falls into it above the ground around there: the ground is
pale, and the higher something stands the darker it is, through one hue, so that walls are drawn
lines and trees are spots. What was never seen is the paper. Heights are those above the lowest
points within some metres, as ground is seldom flat.

Reference: C. Ware, "Information visualization: perception for design", 2004 (one hue, ordered by
lightness, for one quantity).
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from odomap.views.gridpicture import (
    FOOT_PX,
    LONGEST_PX,
    MARGIN_PX,
    draw_path,
    draw_scale,
)
from odomap.views.ground import above_ground

if TYPE_CHECKING:
    from odomap.maps.cloudmap import CloudMap

__all__ = ["cloud_picture", "cloud_png"]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

PAPER = 250
LOW, HIGH = (214, 221, 226), (24, 52, 84)
"""Colours of the ground and of what stands highest."""
TALL = 6.0
"""Height above the ground from which on it is all the same, metres."""
FINEST = 0.1
"""Least size of a pixel, metres."""
LONGEST = 1600
"""Longer side of the cloud, pixels."""
SHORTEST = 800
"""The same of a room: squares of the picture are drawn larger until there are so many."""


def cloud_picture(cloud: "CloudMap") -> Image:
    """Draw a cloud from above.

    Args:
        cloud: z is up.

    Returns:
        (H, W, 3) uint8 RGB, the greatest y at the top.
    """
    points = cloud.points
    low, high = np.quantile(points[:, :2], 0.002, axis=0), np.quantile(points[:, :2], 0.998, axis=0)
    low, high = (
        np.array([low, *cloud.path[:, :2]]).min(0),
        np.array([high, *cloud.path[:, :2]]).max(0),
    )
    metre = max(float((high - low).max()) / min(LONGEST, LONGEST_PX), FINEST)
    width, height = (np.ceil((high - low) / metre).astype(int) + 1).tolist()
    columns, rows = ((points[:, :2] - low) / metre).astype(np.int64).T
    is_in = (points[:, :2] >= low).all(1) & (columns < width) & (rows < height)
    columns, rows = columns[is_in], rows[is_in]
    above = above_ground(points[is_in])
    tall = np.full(height * width, -1.0)
    np.maximum.at(tall, rows * width + columns, np.clip(above / TALL, 0.0, 1.0))
    return _drawn(tall.reshape(height, width)[::-1], cloud.path, low, metre)


def _drawn(tall: Array, path: Array, low: Array, metre: float) -> Image:
    import cv2

    share = np.sqrt(np.clip(tall, 0.0, 1.0))[:, :, None]
    colours = (1.0 - share) * np.array(LOW) + share * np.array(HIGH)
    picture = np.where(tall[:, :, None] < 0.0, PAPER, colours).astype(np.uint8)
    times = max(1, SHORTEST // max(tall.shape))
    picture, metre = picture.repeat(times, axis=0).repeat(times, axis=1), metre / times
    frame = (MARGIN_PX, FOOT_PX, MARGIN_PX, MARGIN_PX)
    more = max(0, 160 - picture.shape[1])
    picture = np.pad(picture, ((0, 0), (0, more), (0, 0)), constant_values=PAPER)
    image = cv2.copyMakeBorder(picture, *frame, cv2.BORDER_CONSTANT, value=(PAPER,) * 3)
    drawn = np.ascontiguousarray(image, np.uint8)
    if len(path):
        top = low[1] + picture.shape[0] * metre
        pixels = (path[:, :2] - (low[0], top)) * (1.0 / metre, -1.0 / metre)
        draw_path(drawn, pixels + MARGIN_PX - 0.5)
    draw_scale(drawn, 1.0 / metre)
    return drawn


def cloud_png(cloud: "CloudMap") -> bytes:
    """Return the same as the bytes of a PNG file."""
    import cv2

    _, data = cv2.imencode(".png", np.ascontiguousarray(cloud_picture(cloud)[:, :, ::-1]))
    return bytes(data)
