"""Rings: the middle line of what goes round, a rectangle with rounded corners, by distance.

Whatever stands along a street or a corridor is placed by (distance along its middle line, distance
to the left of it, height): `at` gives the point and the axes there, `way` what to travel on.

Cost: O(1) per point.
"""

import numpy as np
from numpy.typing import NDArray

__all__ = ["Ring"]

Array = NDArray[np.float64]


class Ring:
    """A rounded rectangle around the origin, anticlockwise, by distance.

    Args:
        length: of the rectangle along x, metres.
        width: along y.
        radius: of the corners.

    Attributes:
        round_m: once round, metres.
    """

    def __init__(self, length: float, width: float, radius: float) -> None:
        self.length, self.width, self.radius = length, width, radius
        self._straights = np.array([length, width] * 2) - 2 * radius
        arc = np.pi / 2 * radius
        self._starts = np.concatenate([[0.0], np.cumsum(self._straights + arc)[:-1]])
        self.round_m = float((self._straights + arc).sum())

    def at(self, along: float, left: float = 0.0, up: float = 0.0) -> tuple[Array, Array]:
        """Return a point beside the line and axes (columns: ahead, left, up)."""
        along %= self.round_m
        side = int(np.searchsorted(self._starts, along, "right")) - 1
        rest = along - self._starts[side]
        half = np.array([self.length, self.width]) / 2
        corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])[side] * half
        ahead = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]], float)[side]
        leftwards = np.array([-ahead[1], ahead[0]])
        straight = self._straights[side]
        point = corner + ahead * (self.radius + min(rest, straight))
        if rest > straight:
            angle = (rest - straight) / self.radius
            point = point + self.radius * (ahead * np.sin(angle) + leftwards * (1 - np.cos(angle)))
            ahead, leftwards = (
                ahead * np.cos(angle) + leftwards * np.sin(angle),
                leftwards * np.cos(angle) - ahead * np.sin(angle),
            )
        axes = np.eye(3)
        axes[:2, 0], axes[:2, 1] = ahead, leftwards
        return np.array([*(point + leftwards * left), up]), axes

    def is_straight(self, along: float, margin: float) -> bool:
        """Tell whether the line is straight from margin before to margin behind."""
        along %= self.round_m
        side = int(np.searchsorted(self._starts, along, "right")) - 1
        rest = along - self._starts[side]
        return bool(margin < rest < self._straights[side] - margin)

    def way(self, left: float, up: float, step: float = 6.0) -> Array:
        """Return way points every `step` metres or so, beside the middle."""
        alongs = np.linspace(0, self.round_m, int(self.round_m / step), endpoint=False)
        return np.array([self.at(float(a), left, up)[0] for a in alongs])
