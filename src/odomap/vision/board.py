"""Finding a chessboard: where its inner corners are, to a few hundredths of a pixel.

The problem: a calibration is as good as its corners. A chessboard corner is a saddle of the image,
whose place blur and uneven light do not move. A fast detector thresholds and links dark squares;
where it fails, one that grows the board from saddles tries (it copes with blur, noise and strong
distortion). Each corner q is then moved to where all gradients around it are across the line to it,

    Σ g gᵀ (q - p) = 0    over the pixels p of a window about the corner.

A board of WxH is counted in INNER corners, where four squares meet: a board of 10x7 squares is 9x6.
A detector may return the same board upside down in the next picture. Corners are therefore ordered
again: rows run clockwise to columns as seen from the front, and the first inner square is a dark
one; where both ends are dark (W + H even) the more upright of the two orders is taken.

Cost: 10 ms for a picture of 640x480 with a board, 200 ms for one without; larger pictures are
searched small and measured large.

Reference: A. Duda, U. Frese, "Accurate detection and localization of checkerboard corners for
calibration", BMVC 2018.
"""

import re
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError

__all__ = ["Board", "choose_views", "find_board", "guess_size", "sharpness"]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

SEARCH_PX = 1000
"""Pictures are searched at most this wide or high; corners are then measured at full size."""
BLURRED = 0.6
"""A view is blurred that is less than this share as sharp as the usual one."""
NEW_PX = 4.0
"""A view is new whose corners are this far from those of any other, on average."""


@dataclass(frozen=True)
class Board:
    """A chessboard.

    Attributes:
        columns: inner corners along a row.
        rows: inner corners along a column.
        square: side of a square, metres.

    Raises:
        InputError: fewer than 3 x 3 corners, more than 100, or a square nobody prints.

    Example:
        >>> Board.parse("9x6", 0.025).points.shape
        (54, 3)
    """

    columns: int
    rows: int
    square: float

    def __post_init__(self) -> None:
        if not (3 <= self.columns <= 100 and 3 <= self.rows <= 100):
            raise InputError(
                f"board: {self.columns}x{self.rows} inner corners, 3x3 to 100x100 expected"
            )
        if not (np.isfinite(self.square) and self.square > 0):
            raise InputError(f"square: {self.square} m is not a length above 0")
        if not 0.001 <= self.square <= 1.0:
            mend = "is it in millimetres? Give metres" if self.square > 1 else "give metres"
            raise InputError(f"square: a side of {self.square:g} m is implausible: {mend}")

    @classmethod
    def parse(cls, size: str, square: float) -> "Board":
        """Read a board such as "9x6".

        Raises:
            InputError: it is not two numbers with an x between, or no board has that size.
        """
        match = re.fullmatch(r"\s*(\d{1,4})\s*[xX×*,]\s*(\d{1,4})\s*", size)
        if match is None:
            raise InputError(
                f"board: '{size}' is not a size: give inner corners along and across, such as 9x6"
            )
        return cls(int(match[1]), int(match[2]), square)

    def __str__(self) -> str:
        return f"{self.columns}x{self.rows}"

    @property
    def is_symmetric(self) -> bool:
        """Whether it looks the same upside down."""
        return (self.columns + self.rows) % 2 == 0

    @cached_property
    def points(self) -> Array:
        """(columns * rows, 3) corners on the plane z = 0, metres, row after row; read-only."""
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        grid = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]).astype(np.float64)
        points: Array = self.square * grid
        points.setflags(write=False)
        return points


def find_board(image: Image, board: Board) -> Array | None:
    """Find all inner corners of a chessboard.

    Args:
        image: (H, W) uint8 grey.
        board: the board.

    Returns:
        (columns * rows, 2) pixels in the order of `Board.points`, or None if the board, or a part
        of it, is not seen.
    """
    size = board.columns, board.rows
    small, factor = _reduced(image)
    how = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    found, corners = cv2.findChessboardCorners(small, size, flags=how)
    if not found:
        found, corners = cv2.findChessboardCornersSB(
            small, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE
        )
    if not found:
        return None
    pixels = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    # Pixel (0, 0) is the centre of the first pixel, in the small picture and in the large one.
    pixels = _measured(image, (pixels + 0.5) / factor - 0.5, board)
    inside = np.all((pixels >= 0) & (pixels <= np.array(image.shape[::-1]) - 1))
    return _ordered(image, pixels, board) if inside else None


def guess_size(image: Image) -> tuple[int, int] | None:
    """Return the inner corners along and across of whatever chessboard is seen, or None."""
    small, _ = _reduced(image)
    how = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_LARGER
    found, _, meta = cv2.findChessboardCornersSBWithMeta(small, (3, 3), how)
    if not found or meta is None:
        return None
    rows, columns = sorted(meta.shape)
    return columns, rows


def sharpness(image: Image, pixels: Array) -> float:
    """Say how sharp a board is: the largest slope of grey, per pixel, over its contrast.

    Args:
        image: (H, W) uint8.
        pixels: (N, 2) its corners.

    Returns:
        About 0.5 for a sharp picture, 0.1 for one blurred over 10 pixels.
    """
    low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 3, 0)
    high = np.ceil(pixels.max(axis=0)).astype(int) + 4
    part = image[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    dark, bright = np.percentile(part, [10, 90])
    dx, dy = cv2.Sobel(part, cv2.CV_32F, 1, 0), cv2.Sobel(part, cv2.CV_32F, 0, 1)
    slope = np.percentile(np.hypot(dx, dy) / 8.0, 97)
    return float(slope / max(bright - dark, 1.0))


def _reduced(image: Image) -> tuple[Image, float]:
    """Return an image no larger than SEARCH_PX, and its size over that of the original."""
    factor = min(1.0, SEARCH_PX / max(image.shape))
    if factor == 1.0:
        return image, 1.0
    small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8), factor


def _measured(image: Image, pixels: Array, board: Board) -> Array:
    """Move corners to where the gradients say they are, in windows that see no other corner."""
    grid = pixels.reshape(board.rows, board.columns, 2)
    steps = np.concatenate(
        [
            np.linalg.norm(np.diff(grid, axis=0), axis=2).ravel(),
            np.linalg.norm(np.diff(grid, axis=1), axis=2).ravel(),
        ]
    )
    half = int(np.clip(0.35 * steps.min(), 2, 15))
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    corners = np.ascontiguousarray(pixels, np.float32).reshape(-1, 1, 2)
    refined = cv2.cornerSubPix(image, corners, (half, half), (-1, -1), stop)
    return np.asarray(refined, dtype=np.float64).reshape(-1, 2)


def _ordered(image: Image, pixels: Array, board: Board) -> Array:
    """Order corners so that the same physical corner is the first in every picture."""
    grid = pixels.reshape(board.rows, board.columns, 2)
    along = (grid[:, -1] - grid[:, 0]).mean(axis=0)
    down = (grid[-1] - grid[0]).mean(axis=0)
    if along[0] * down[1] - along[1] * down[0] < 0:
        grid = grid[:, ::-1]
        along = -along
    if board.columns == board.rows:
        turns = [np.rot90(grid, k) for k in range(4)]
        grid = max(turns, key=lambda turned: float((turned[:, -1] - turned[:, 0])[:, 0].sum()))
    elif board.is_symmetric:
        grid = grid[::-1, ::-1] if along[0] + down[1] < 0 else grid
    elif _tone(image, grid[:2, :2]) > _tone(image, grid[-2:, -2:]):
        grid = grid[::-1, ::-1]
    return np.ascontiguousarray(grid.reshape(-1, 2))


def _tone(image: Image, square: Array) -> float:
    """Return the mean grey in the middle of a square given by its four corners (2, 2, 2)."""
    weights = np.array([0.35, 0.5, 0.65])
    a, b = np.meshgrid(weights, weights)
    a, b = a.ravel()[:, None], b.ravel()[:, None]
    top = (1 - a) * square[0, 0] + a * square[0, 1]
    low = (1 - a) * square[1, 0] + a * square[1, 1]
    place = np.rint((1 - b) * top + b * low).astype(int)
    height, width = image.shape
    x, y = np.clip(place[:, 0], 0, width - 1), np.clip(place[:, 1], 0, height - 1)
    return float(image[y, x].mean())


def choose_views(corners: Array, sharp: Array, most: int) -> NDArray[np.int64]:
    """Choose views of a board that are sharp and differ from each other.

    Args:
        corners: (V, K) numbers that say where the board is in each view, pixels.
        sharp: (V,) how sharp it is there.
        most: how many at most.

    Returns:
        Their indices in order: the sharpest one, then again and again the one that differs most
        from those chosen; none that is much blurred, or as good as one already there.
    """
    good = np.flatnonzero(sharp >= BLURRED * np.median(sharp)) if len(sharp) else np.zeros(0, int)
    if len(good) == 0:
        return np.zeros(0, np.int64)
    chosen = [int(good[np.argmax(sharp[good])])]
    gap = np.full(len(good), np.inf)
    while len(chosen) < most:
        step = np.abs(corners[good] - corners[chosen[-1]]).mean(axis=1)
        gap = np.minimum(gap, step)
        furthest = int(np.argmax(gap))
        if gap[furthest] < NEW_PX:
            break
        chosen.append(int(good[furthest]))
    return np.sort(np.array(chosen, dtype=np.int64))
