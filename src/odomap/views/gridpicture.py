"""A picture of an occupancy grid for people: walls, free floor, the path, and a scale.

Free is white, walls are dark, what was never seen is grey, and what is between shows how much is
believed of it. A small grid is drawn several pixels to a cell, so that path and scale are sharp;
of one too large for a screen each pixel shows the most occupied of its cells, since walls are one
cell thick and would fade. The scale is 1, 2 or 5 times a power of ten, a sixth of the width or so.

Reference: E. Tufte, "The visual display of quantitative information", 1983 (no more ink than data).
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.files.atomic import write_bytes
from odomap.files.grids import save_grid
from odomap.lidar.grid import OccupancyGrid
from odomap.views.style import PALETTE

if TYPE_CHECKING:
    from odomap.maps.occupancy import GridMap

__all__ = [
    "FOOT_PX",
    "LONGEST_PX",
    "MARGIN_PX",
    "draw_path",
    "draw_scale",
    "grid_picture",
    "grid_png",
    "write_grid",
]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

LONGEST_PX, SHORTEST_PX = 2400, 900
"""Longer side of the picture: at most; and cells are enlarged up to this."""
LARGEST_CELL_PX = 8
MARGIN_PX, FOOT_PX = 16, 44
"""Around the grid, and below it for the scale."""
UNSEEN, FREE, WALL = 214, 253, 34
"""Greys."""
FINE = 4
"""Bits of a pixel that lines are placed by."""


def grid_picture(grid: OccupancyGrid, path: ArrayLike | None = None) -> Image:
    """Draw what is known of a grid.

    Args:
        grid: the cells.
        path: (K, 2) metres in the grid, drawn from a ring to a square.

    Returns:
        (H, W, 3) uint8 RGB, the greatest y at the top.
    """
    import cv2

    known = grid.cropped()
    grey, cells_per_px = _shrunk(_greys(known))
    longer = max(*grey.shape, 1)
    px = int(np.clip(SHORTEST_PX // longer, 1, LARGEST_CELL_PX))
    large = np.repeat(np.repeat(grey, px, axis=0), px, axis=1)
    frame = (MARGIN_PX, FOOT_PX, MARGIN_PX, MARGIN_PX)
    width = max(large.shape[1], 160)
    large = np.pad(large, ((0, 0), (0, width - large.shape[1])), constant_values=UNSEEN)
    image = cv2.copyMakeBorder(large, *frame, cv2.BORDER_CONSTANT, value=UNSEEN)
    picture = np.ascontiguousarray(np.dstack([image] * 3), np.uint8)
    metre_px = px / (cells_per_px * grid.resolution)
    top = known.origin[1] + len(grey) * px / metre_px
    if path is not None and len(points := np.reshape(np.asarray(path, float), (-1, 2))):
        offset = (points - (known.origin[0], top)) * (metre_px, -metre_px)
        draw_path(picture, offset + MARGIN_PX - 0.5)
    draw_scale(picture, metre_px)
    return picture


def grid_png(grid: OccupancyGrid, path: ArrayLike | None = None) -> bytes:
    """Return the same as the bytes of a PNG file."""
    import cv2

    picture = grid_picture(grid, path)
    _, data = cv2.imencode(".png", np.ascontiguousarray(picture[:, :, ::-1]))
    return bytes(data)


def write_grid(file: str | Path, made: "GridMap", picture: bool = True) -> tuple[Path, ...]:
    """Write a grid as YAML and PGM, and as a picture with the path.

    Args:
        file: ends in `.yaml`.
        made: the grid.
        picture: whether to write the PNG.

    Returns:
        The files.

    Raises:
        OutputError: one cannot be written.
    """
    written = list(save_grid(file, made.grid))
    if picture:
        written.append(Path(file).with_suffix(".png"))
        write_bytes(written[-1], grid_png(made.grid, made.path))
    return tuple(written)


def _greys(grid: OccupancyGrid) -> Image:
    """Return each cell's grey, the greatest y at the top."""
    p = 1.0 / (1.0 + np.exp(-grid.log_odds))
    grey = np.where(grid.is_known, FREE + (WALL - FREE) * p**3, UNSEEN)
    return np.ascontiguousarray(grey[::-1], np.uint8)


def _shrunk(grey: Image) -> tuple[Image, int]:
    """Return the darkest of each n by n cells that are seen, and n."""
    n = -(-max(grey.shape) // LONGEST_PX) if grey.size else 1
    if n <= 1:
        return grey, 1
    height, width = (-(-side // n) * n for side in grey.shape)
    # Rows are added at the top, so that the lower left corner stays where it is.
    more = ((height - grey.shape[0], 0), (0, width - grey.shape[1]))
    blocks = np.pad(grey, more, constant_values=UNSEEN).reshape(height // n, n, width // n, n)
    darkest, lightest = blocks.min(axis=(1, 3)), blocks.max(axis=(1, 3))
    return np.where(darkest < UNSEEN, darkest, lightest).astype(np.uint8), n


def _rgb(name: str) -> tuple[int, int, int]:
    red, green, blue = bytes.fromhex(PALETTE[name][1:])
    return red, green, blue


def draw_path(picture: Image, pixels: Array) -> None:
    """Draw a path (K, 2), in pixels, from a ring to a square."""
    import cv2

    far = np.clip(pixels, -(2.0**20), 2.0**20)
    fixed = np.round(far * (1 << FINE)).astype(np.int32)
    line = fixed.reshape(-1, 1, 2)
    cv2.polylines(picture, [line], False, _rgb("estimate"), 2, cv2.LINE_AA, FINE)
    (x, y), (u, v) = np.round(far[[0, -1]]).astype(int).tolist()
    cv2.circle(picture, (x, y), 6, _rgb("good"), 2, cv2.LINE_AA)
    cv2.rectangle(picture, (u - 5, v - 5), (u + 5, v + 5), _rgb("lost"), 2, cv2.LINE_AA)


def draw_scale(picture: Image, metre_px: float) -> None:
    """Draw a scale at the foot of a picture, metre_px pixels being a metre."""
    import cv2

    height, width = picture.shape[:2]
    wanted = width / 6.0 / metre_px
    power = 10.0 ** np.floor(np.log10(wanted))
    length = power * max(k for k in (1.0, 2.0, 5.0) if k * power <= wanted)
    left, foot, ink = MARGIN_PX, height - FOOT_PX // 2 + 4, _rgb("ink")
    right = left + round(length * metre_px)
    cv2.line(picture, (left, foot), (right, foot), ink, 2)
    for x in (left, right):
        cv2.line(picture, (x, foot - 5), (x, foot + 5), ink, 2)
    text = f"{length:g} m" if length >= 1.0 else f"{100.0 * length:g} cm"
    at = (right + 10, foot + 5)
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, ink, 1, cv2.LINE_AA)
