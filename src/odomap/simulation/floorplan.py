"""Floor plans: what a laser in a plane can meet, and ways to drive in it.

A plan is a set of walls (segments without thickness), of which furniture is made, too, and a closed
way. Four kinds:

    building    a corridor round a block of rooms, 60 m round, rooms on its outer side as well; some
                doors stand open, rooms have furniture, no two are alike
    hall        one large room with pillars and boxes
    corridor    two straight walls, 140 m long, ends farther away than any laser reaches in its
                middle: what is ahead and what is behind looks the same everywhere
    field       nothing within reach, from any place of the way

Distances to the walls are exact, d(x) = min over segments of |x − (a + clamp(s) e)|, so that a map
made from scans can be measured against the plan it should show.

Reference: A. Kümmerle et al., "On measuring the accuracy of SLAM algorithms", Autonomous Robots
27(4), 2009 (maps against plans).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from odomap.simulation.ring import Ring

__all__ = ["PLANS", "Plan", "make_plan"]

Array = NDArray[np.float64]

ROUND_M, HALF_WIDTH, DOOR_M, DEEP_M = 60.0, 1.25, 1.0, 4.0
"""Of a building: the corridor's middle once round, half its width, doors, depth of rooms."""
LONG_M = 140.0
"""Of the corridor."""


@dataclass(frozen=True)
class Plan:
    """Walls, and a way among them.

    Attributes:
        walls: (M, 4) x, y of both ends, metres.
        pillars: (K, 3) x, y, radius.
        way: (N, 3) way points of a closed route, z = 0.
    """

    walls: Array
    pillars: Array
    way: Array

    def distances(self, points: Array) -> Array:
        """Return (N,) distances of points (N, 2) from the nearest wall or pillar, metres."""
        nearest = np.full(len(points), np.inf)
        for ax, ay, bx, by in self.walls:
            a, e = np.array([ax, ay]), np.array([bx - ax, by - ay])
            s = np.clip((points - a) @ e / max(float(e @ e), 1e-18), 0.0, 1.0)
            away = points - a - s[:, None] * e
            nearest = np.minimum(nearest, np.hypot(away[:, 0], away[:, 1]))
        for x, y, radius in self.pillars:
            centre = np.hypot(points[:, 0] - x, points[:, 1] - y)
            nearest = np.minimum(nearest, np.abs(centre - radius))
        return nearest

    def occupied(self, cell_m: float, margin_m: float = 1.0) -> tuple[NDArray[np.bool_], Array]:
        """Return which cells of a grid a wall or the rim of a pillar goes through.

        Args:
            cell_m: side of a cell.
            margin_m: how far the grid goes beyond the walls.

        Returns:
            (rows, columns) bool, row 0 at the least y, and (2,) x, y of the corner of cell (0, 0),
            a whole number of cells from the origin.
        """
        points = self.outline(cell_m / 4)
        low = np.floor((points.min(axis=0) - margin_m) / cell_m)
        high = np.ceil((points.max(axis=0) + margin_m) / cell_m)
        columns, rows = (high - low).astype(int)
        grid = np.zeros((rows, columns), np.bool_)
        at = np.floor(points / cell_m - low).astype(int)
        grid[at[:, 1], at[:, 0]] = True
        return grid, low * cell_m

    def outline(self, step_m: float) -> Array:
        """Return (N, 2) points on all walls and rims, at most `step_m` apart."""
        parts = [np.zeros((0, 2))]
        for ax, ay, bx, by in self.walls:
            s = np.linspace(0, 1, int(np.ceil(np.hypot(bx - ax, by - ay) / step_m)) + 1)[:, None]
            parts.append((1 - s) * (ax, ay) + s * (bx, by))
        for x, y, radius in self.pillars:
            turn = np.linspace(0, 2 * np.pi, int(np.ceil(2 * np.pi * radius / step_m)) + 1)
            parts.append(np.column_stack([x + radius * np.cos(turn), y + radius * np.sin(turn)]))
        return np.concatenate(parts)


class _Drawing:
    """Walls and pillars while a plan is drawn."""

    def __init__(self) -> None:
        self.walls: list[tuple[float, float, float, float]] = []
        self.pillars: list[tuple[float, float, float]] = []

    def wall(self, a: Array, b: Array) -> None:
        self.walls.append((float(a[0]), float(a[1]), float(b[0]), float(b[1])))

    def box(self, centre: Array, size: Array, angle: float = 0.0) -> None:
        """Draw a box: a shelf, a desk, a carton."""
        c, s = np.cos(angle), np.sin(angle)
        half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size / 2
        corners = centre + half @ np.array([[c, s], [-s, c]])
        for k in range(4):
            self.wall(corners[k], corners[(k + 1) % 4])

    def plan(self, way: Array) -> Plan:
        return Plan(
            np.array(self.walls, np.float64).reshape(-1, 4),
            np.array(self.pillars, np.float64).reshape(-1, 3),
            way,
        )


def make_plan(kind: str, seed: int) -> Plan:
    """Draw a plan: "building", "hall", "corridor" or "field".

    Args:
        kind: one of `PLANS`.
        seed: which of its kind.

    Raises:
        KeyError: there is no such kind.
    """
    return PLANS[kind](np.random.default_rng([seed, 23]))


def _building(rng: np.random.Generator) -> Plan:
    """Draw the walls of a corridor that goes round, with rooms on both its sides."""
    length = float(rng.uniform(17.0, 20.0))
    width = ROUND_M / 2 - length + (4 - np.pi) * HALF_WIDTH
    ring = Ring(length, width, HALF_WIDTH)
    drawing = _Drawing()
    for outside in (True, False):
        sign = 1.0 if outside else -1.0
        x, y = length / 2 + sign * HALF_WIDTH, width / 2 + sign * HALF_WIDTH
        corners = np.array([[-x, -y], [x, -y], [x, y], [-x, y]])
        for k in range(4):
            a, b = corners[k], corners[(k + 1) % 4]
            deep = DEEP_M if outside else min(x, y) * 0.8
            _side(drawing, rng, a, b, deep if outside else -deep, corner_m=0.0 if outside else deep)
    if rng.random() < 0.5:
        return drawing.plan(ring.way(0.0, 0.0, 0.75)[::-1])
    return drawing.plan(ring.way(0.0, 0.0, 0.75))


def _side(
    drawing: _Drawing, rng: np.random.Generator, a: Array, b: Array, deep: float, corner_m: float
) -> None:
    """Draw one wall of the corridor, anticlockwise, and the rooms behind it (at its right)."""
    whole = float(np.linalg.norm(b - a))
    ahead = (b - a) / whole
    right = np.array([ahead[1], -ahead[0]])
    room = 0.0
    while room < whole - 1e-9:
        size = float(rng.uniform(2.6, 5.0))
        size = whole - room if whole - room - size < 2.6 else size
        corner = a + ahead * room
        # Behind the corners of the inner block the rooms of two sides would overlap.
        is_open = rng.random() < 0.6 and corner_m <= room and room + size <= whole - corner_m
        door = float(rng.uniform(0.3, size - 0.3 - DOOR_M))
        if is_open:
            drawing.wall(corner, corner + ahead * door)
            drawing.wall(corner + ahead * (door + DOOR_M), corner + ahead * size)
            _furnish(drawing, rng, corner, ahead, right * deep, size, door)
        else:
            drawing.wall(corner, corner + ahead * size)
            _niche(drawing, rng, corner, ahead, -right * np.sign(deep), size)
        room += size


def _furnish(
    drawing: _Drawing, rng: np.random.Generator, corner: Array, ahead: Array, back: Array,
    size: float, door: float,
) -> None:  # fmt: skip
    """Draw the walls of a room and what stands in it, out of the way of its door."""
    far = corner + back
    drawing.wall(corner, far)
    drawing.wall(far, far + ahead * size)
    drawing.wall(corner + ahead * size, far + ahead * size)
    turn = float(np.arctan2(ahead[1], ahead[0]))
    for _ in range(int(rng.integers(1, 5))):
        box = rng.uniform([0.4, 0.4], [1.4, 0.8])
        along = rng.uniform(0.8, size - 0.8) if size > 1.8 else size / 2
        at = corner + ahead * along + back * rng.uniform(0.5, 0.85)
        drawing.box(at, box, turn + float(rng.choice([0.0, rng.uniform(-0.5, 0.5)])))
    if rng.random() < 0.5:  # the leaf of the door stands in the room
        swing = float(rng.uniform(0.3, 1.4))
        hinge = corner + ahead * door
        leaf = ahead * np.cos(swing) + back / np.linalg.norm(back) * np.sin(swing)
        drawing.wall(hinge, hinge + 0.9 * DOOR_M * leaf)


def _niche(
    drawing: _Drawing, rng: np.random.Generator, corner: Array, ahead: Array, out: Array,
    size: float,
) -> None:  # fmt: skip
    """Draw what stands before a closed wall: cupboards, bins, door frames."""
    turn = float(np.arctan2(ahead[1], ahead[0]))
    for _ in range(int(rng.integers(0, 3))):
        along, deep = float(rng.uniform(0.5, size - 0.5)), float(rng.uniform(0.05, 0.4))
        box = np.array([float(rng.uniform(0.1, 0.9)), deep])
        drawing.box(corner + ahead * along + out * (deep / 2 + 0.002), box, turn)


def _hall(rng: np.random.Generator) -> Plan:
    drawing = _Drawing()
    size = rng.uniform([14.0, 9.0], [20.0, 13.0])
    drawing.box(np.zeros(2), size)
    ring = Ring(size[0] - 5.0, size[1] - 4.5, 1.5)
    for place in np.linspace(-0.2, 0.2, 3) * size[0]:
        drawing.pillars.append((float(place), float(rng.uniform(-0.6, 0.6)), 0.25))
    for _ in range(8):
        wall = int(rng.integers(4))
        box = rng.uniform([0.3, 0.3], [1.5, 0.9])
        side = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])[wall]
        along = np.array([-side[1], side[0]]) * rng.uniform(-0.4, 0.4) * size
        at = side * (size / 2 - 0.6) + along
        drawing.box(at, box, float(rng.uniform(0, np.pi / 2)))
    return drawing.plan(ring.way(0.0, 0.0, 0.75))


def _corridor(rng: np.random.Generator) -> Plan:
    drawing = _Drawing()
    half, wide = LONG_M / 2, float(rng.uniform(2.2, 3.0))
    drawing.box(np.zeros(2), np.array([2 * half, wide]))
    return drawing.plan(Ring(LONG_M - 20.0, 0.9, 0.44).way(0.0, 0.0, 0.4))


def _field(rng: np.random.Generator) -> Plan:
    side = float(rng.uniform(10.0, 16.0))
    return _Drawing().plan(Ring(side, side, 3.0).way(0.0, 0.0, 1.0))


PLANS: Mapping[str, Callable[[np.random.Generator], Plan]] = MappingProxyType(
    {"building": _building, "hall": _hall, "corridor": _corridor, "field": _field}
)
