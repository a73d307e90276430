"""Terrain: how high the ground is, where it is no plane.

A street falls and rises by metres within a block, so that heights above one plane say nothing of
what is in the way. But ground is low: of each square the height is that of its lowest points. And
it is not steep: under a car that hides it, or where a wall is all that is seen, it is not above

    g(a) = min over b of  low(b) + slope · |a - b|

what the squares around admit. Between the middles of squares heights are interpolated.

What lies below the ground (mirrored points, noise) is kept out twice: of a square in one sweep the
lowest tenth is passed over, and of the sweeps that saw it the lowest quarter.

Cost: O(points log points) to learn, O(squares · steps) for the slope, O(1) for a height.

Reference: M. Himmelsbach et al., "Fast segmentation of 3D point clouds for ground vehicles", IV
2010 (ground as the lowest points of cells).
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Terrain", "terrain_of"]

Array = NDArray[np.float64]

SQUARE, MOST = 1.0, 2000
"""Side of the squares, metres, and how many there are along a side at most; they grow then."""
FEWEST = 4
"""Points of a square that say how high it is."""
SLOPE = 0.15
"""Ground is not steeper than so much, rise over way."""
STEPS = 8
"""How many squares away ground still says something."""
BELOW_IN_SWEEP, BELOW_OF_SWEEPS = 0.1, 0.25
"""Shares of what is low that are passed over."""


@dataclass(frozen=True, eq=False)
class Terrain:
    """Heights of the ground.

    Attributes:
        square: side of the squares, metres.
        corner: (2,) x and y where they begin, metres.
        heights: (rows of y, columns of x) of the ground in the middle of each square, metres; NaN
            where nothing is known.
    """

    square: float
    corner: Array
    heights: Array

    def at(self, xy: Array) -> Array:
        """Return the height of the ground (...) at places (..., 2); NaN where it is not known."""
        place = (np.asarray(xy, np.float64) - self.corner) / self.square - 0.5
        first = np.floor(place).astype(np.int64)
        share = place - first
        total, weights = np.zeros(place.shape[:-1]), np.zeros(place.shape[:-1])
        most = np.array(self.heights.shape[::-1]) - 1
        for dx in (0, 1):
            for dy in (0, 1):
                column, row = np.moveaxis(np.clip(first + np.array([dx, dy]), 0, most), -1, 0)
                height = self.heights[row, column]
                weight = np.abs(1 - dx - share[..., 0]) * np.abs(1 - dy - share[..., 1])
                weight = np.where(np.isfinite(height), weight, 0.0)
                total += weight * np.nan_to_num(height)
                weights += weight
        known = weights > 1e-6
        return np.where(known, total / np.where(known, weights, 1.0), np.nan)


def terrain_of(clouds: Iterable[Array], wide: float = 0.0) -> Terrain | None:
    """Learn how high the ground is.

    Args:
        clouds: (N, 3) finite points of each sweep, z up, metres, in one frame.
        wide: how far they go, metres, by and large: squares are larger where that is far.

    Returns:
        The terrain, or None where there are hardly any points.
    """
    square = max(SQUARE, wide / MOST)
    parts = [_low(*_squares(points, square), BELOW_IN_SWEEP) for points in clouds if len(points)]
    if not parts:
        return None
    places, low, counts = (np.concatenate(column) for column in zip(*parts, strict=True))
    places, low, counts = _low(places, low, counts, BELOW_OF_SWEEPS)
    many = counts >= FEWEST
    if not many.any():
        return None
    places, low = places[many], low[many]
    first = places.min(axis=0)
    width, height = (np.ptp(places, axis=0) + 1).tolist()
    heights = np.full((height, width), np.inf)
    heights[places[:, 1] - first[1], places[:, 0] - first[0]] = low
    _flatten(heights, SLOPE * square)
    heights[~np.isfinite(heights)] = np.nan
    return Terrain(square, first * square, heights)


def _squares(points: Array, square: float) -> tuple[NDArray[np.int64], Array, NDArray[np.int64]]:
    """Return of each point its square (N, 2), its height, and that it is one."""
    places = np.floor(points[:, :2] / square).astype(np.int64)
    return places, points[:, 2], np.ones(len(points), np.int64)


def _low(
    places: NDArray[np.int64], z: Array, weights: NDArray[np.int64], share: float
) -> tuple[NDArray[np.int64], Array, NDArray[np.int64]]:
    """Return each square (M, 2) once, which height a share of its rows are below, its weight."""
    span = np.ptp(places[:, 0]) + 1
    number = (places[:, 1] - places[:, 1].min()) * span + places[:, 0] - places[:, 0].min()
    order = np.lexsort((z, number))
    starts = np.flatnonzero(np.diff(number[order], prepend=-1))
    counts = np.diff(starts, append=len(order))
    rows = order[starts + (counts * share).astype(np.int64)]
    return places[rows], z[rows], np.add.reduceat(weights[order], starts)


def _flatten(heights: Array, rise: float) -> None:
    """Lower what is steeper than a rise per square; unknown (inf) becomes what others admit."""
    rows, columns = heights.shape
    for _ in range(STEPS):
        before = np.pad(heights, 1, constant_values=np.inf)
        for dy in (0, 1, 2):
            for dx in (0, 1, 2):
                shifted = before[dy : dy + rows, dx : dx + columns]
                np.minimum(heights, shifted + rise * np.hypot(dx - 1, dy - 1), out=heights)
