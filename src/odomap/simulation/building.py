"""Buildings: a corridor that goes round a block of rooms, and one whose doors are all the same.

The corridor is a rectangle of 60 m with rounded turns. Its walls are made of bays of 3 m: a door, a
board with notices, posters, a shelf, or, on the outer side, a room that stands open. In `building`
no two bays are alike. In `corridor` all are: one door with one sign and one notice beside it, bay
after bay, on both sides; what tells places apart there are scratches in the plaster, and the floor.
Who looks for places seen before must find the first round again in the second of a building, and
nothing at all in the first round of such a corridor.

Reference: A. Angeli, D. Filliat, S. Doncieux, J.-A. Meyer, "Fast and incremental method for
loop-closure detection using bags of visual words", T-RO 24(5), 2008 (perceptual aliasing).
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from odomap.simulation.light import Lights
from odomap.simulation.path import Harmonics, Path, closed_route, hand_held
from odomap.simulation.ring import Ring
from odomap.simulation.room import R_CARRIER_IMU
from odomap.simulation.scene import Scene, SceneBuilder

__all__ = ["building", "corridor", "furnished_building"]

Array = NDArray[np.float64]
Builder = TypeVar("Builder", bound=SceneBuilder)
UP = np.array([0.0, 0.0, 1.0])
ROUND_M, BAY_M, HALF_WIDTH, HEIGHT, DEEP = 60.0, 3.0, 1.25, 2.7, 3.0
EYES_M = 1.5


@dataclass(frozen=True)
class _Bay:
    """A piece of wall: the middle of its foot, what it faces, and what is to its right."""

    foot: Array
    inward: Array
    right: Array
    length: float

    def at(self, right: float, up: float, out: float = 0.0) -> Array:
        """Return a point in front of the wall, by distances from its foot."""
        return self.foot + self.right * right + UP * up + self.inward * out

    @property
    def axes(self) -> Array:
        """Columns: towards the corridor, to the right, up (right-handed)."""
        return np.column_stack([self.inward, np.cross(UP, self.inward), UP])


class _Paints:
    """Numbers of textures, painted once."""

    def __init__(self, builder: SceneBuilder, posters: int) -> None:
        paint = builder.paint
        self.plaster = [paint("plaster", 2048, 1024) for _ in range(3)]
        self.floor = paint(str(builder.rng.choice(["wood", "tiles"])), 2048, 2048)
        self.wood = [paint("wood", 256, 512) for _ in range(2)]
        self.posters = [paint("poster", 512, 512) for _ in range(posters)]
        self.shelves = [paint("shelf", 512, 512) for _ in range(3)]
        self.cartons = [paint("cardboard", 256, 256) for _ in range(4)]


def building(seed: int, moving_objects: int, speed: float) -> tuple[Scene, Path]:
    """Furnish corridors and rooms in which no two places are alike, and walk round.

    Args:
        seed: which building.
        moving_objects: how many trolleys go round, too.
        speed: mean speed of the walk, m/s.

    Returns:
        The scene, and the path of the body; the floor is z = 0, metres.
    """
    builder, way = furnished_building(seed, moving_objects, SceneBuilder)
    scene = builder.build()  # draws numbers, too
    return scene, hand_held(way, speed, builder.rng, R_CARRIER_IMU)


def furnished_building(
    seed: int, moving_objects: int, make: type[Builder]
) -> tuple[Builder, Array]:
    """Return what a building is made of, in a builder of some type, and way points round it."""
    rng = np.random.default_rng([seed, 3])
    length = float(rng.uniform(17.0, 20.0))
    return _made(rng, length, 40, moving_objects, make, is_alike=False)


def corridor(seed: int, moving_objects: int, speed: float) -> tuple[Scene, Path]:
    """Make a long corridor of identical doors, and walk round; as `building`."""
    rng = np.random.default_rng([seed, 4])
    builder, way = _made(rng, 24.0, 2, moving_objects, SceneBuilder, is_alike=True)
    scene = builder.build()
    return scene, hand_held(way, speed, rng, R_CARRIER_IMU)


def _made(
    rng: np.random.Generator,
    length: float,
    posters: int,
    moving_objects: int,
    make: type[Builder],
    is_alike: bool,
) -> tuple[Builder, Array]:
    """Build walls round a ring `length` m long and 60 m round, and return the way along it."""
    radius = HALF_WIDTH
    width = ROUND_M / 2 - length + (4 - np.pi) * radius
    ring = Ring(length, width, radius)
    lamps = np.array([ring.at(a, 0.0, HEIGHT - 0.3)[0] for a in np.arange(1.0, ROUND_M, 4.0)])
    powers = np.full(len(lamps), 1.6) if is_alike else rng.uniform(1.0, 2.4, len(lamps))
    lights = Lights(0.6, 1.2, lamps, powers, grid_m=0.3, open_rays=4)
    builder = make(rng, lights, (0.9, 0.9))
    paints = _Paints(builder, posters)
    _floor_and_ceiling(builder, paints, ring, lamps)
    for bay in _bays(ring, outside=False):
        _bay(builder, paints, bay, is_alike, has_rooms=False)
    for bay in _bays(ring, outside=True):
        _bay(builder, paints, bay, is_alike, has_rooms=not is_alike)
    for _ in range(moving_objects):
        _trolley(builder, ring)
    way = ring.way(0.0, EYES_M, 0.75)
    way[:, 2] += rng.uniform(-0.05, 0.05)
    return builder, way if rng.random() < 0.5 else way[::-1]


def _bays(ring: Ring, outside: bool) -> list[_Bay]:
    """Return the pieces of the inner or the outer walls, those of one wall after the other."""
    sign = 1.0 if outside else -1.0
    half = np.array([ring.length, ring.width]) / 2 + sign * HALF_WIDTH
    bays = []
    for k in range(4):
        outward = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]][k], float)
        inward = -outward if outside else outward
        depth, reach = half[k % 2], half[1 - k % 2]
        count = max(1, round(2 * reach / BAY_M))
        right = np.cross(inward, -UP)
        for place in (np.arange(count) + 0.5) / count * 2 - 1:
            foot = outward * depth + right * place * reach
            bays.append(_Bay(foot, inward, right, 2 * reach / count))
    return bays


def _floor_and_ceiling(builder: SceneBuilder, paints: _Paints, ring: Ring, lamps: Array) -> None:
    """One of each over all, and lamps below the ceiling."""
    x, y = np.array([ring.length, ring.width]) / 2 + HALF_WIDTH + DEEP
    ahead, left = np.eye(3)[:2]
    floor = np.array([-x, y, 0.0])
    builder.rectangle(floor, ahead, -left, (2 * x, 2 * y), paints.floor, 220.0)
    ceiling = np.array([-x, -y, HEIGHT])
    builder.rectangle(ceiling, ahead, left, (2 * x, 2 * y), paints.plaster[0], 230.0, gain=1.1)
    for lamp in lamps:
        at = np.array([*lamp[:2], HEIGHT - 0.03])
        builder.box(at, (0.6, 0.6, 0.06), paints.wood[0], 300.0, gain=1.9, bottom=True)


def _bay(
    builder: SceneBuilder, paints: _Paints, bay: _Bay, is_alike: bool, has_rooms: bool
) -> None:
    """Make a piece of wall and what is on it."""
    rng = builder.rng
    if has_rooms and rng.random() < 0.25:
        _open_room(builder, paints, bay)
        return
    plaster = paints.plaster[int(rng.integers(3))]
    gain = 0.95 if is_alike else float(rng.uniform(0.75, 1.1))
    _panel(builder, bay, (bay.length, HEIGHT), plaster, 230.0, up=HEIGHT / 2, out=0.0, gain=gain)
    size = (bay.length, 0.1)
    _panel(builder, bay, size, paints.wood[0], 300.0, up=0.05, out=0.015, gain=0.7)
    if is_alike:
        _door(builder, paints, bay, 0.0, paints.posters[0])
        notice = paints.posters[1]
        _panel(builder, bay, (0.6, 0.85), notice, 0.0, right=1.0, up=1.55, out=0.02)
        return
    kind = rng.random()
    if kind < 0.35:
        _door(builder, paints, bay, float(rng.uniform(-0.4, 0.4)), _any(rng, paints.posters))
    elif kind < 0.6:
        _board(builder, paints, bay)
    elif kind < 0.8:
        _shelf(builder, paints, bay)
    for _ in range(int(rng.integers(2, 6))):
        size = (float(rng.uniform(0.1, 0.7)), float(rng.uniform(0.1, 0.6)))
        right, up = rng.uniform(-0.42, 0.42) * bay.length, float(rng.uniform(0.3, 2.3))
        out = 0.021 + 0.0005 * float(rng.uniform())
        gain = float(rng.uniform(0.6, 1.1))
        number = _any(rng, paints.posters)
        _panel(builder, bay, size, number, 0.0, right=right, up=up, out=out, gain=gain)


def _any(rng: np.random.Generator, numbers: list[int]) -> int:
    return numbers[int(rng.integers(len(numbers)))]


def _panel(
    builder: SceneBuilder,
    bay: _Bay,
    size: tuple[float, float],
    number: int,
    scale: float,
    *,
    right: float = 0.0,
    up: float,
    out: float,
    gain: float = 1.0,
) -> None:
    """Hang a rectangle in front of a bay, by its middle."""
    corner = bay.at(right - size[0] / 2, up + size[1] / 2, out)
    builder.rectangle(corner, bay.right, -UP, size, number, scale, gain=gain)


def _door(builder: SceneBuilder, paints: _Paints, bay: _Bay, right: float, sign: int) -> None:
    """A door in its frame, with a sign at eye level."""
    wood = paints.wood[0]
    for side in (-0.52, 0.52):
        at = bay.at(right + side, 1.07, 0.03)
        builder.box(at, (0.06, 0.08, 2.14), paints.wood[1], 0.0, axes=bay.axes, gain=0.5)
    lintel = (0.06, 1.12, 0.08)
    builder.box(bay.at(right, 2.14, 0.03), lintel, paints.wood[1], 0.0, axes=bay.axes, gain=0.5)
    _panel(builder, bay, (0.96, 2.1), wood, 0.0, right=right, up=1.05, out=0.02, gain=0.8)
    _panel(builder, bay, (0.36, 0.36), sign, 0.0, right=right, up=1.6, out=0.025)
    _panel(builder, bay, (0.14, 0.05), wood, 0.0, right=right + 0.4, up=1.05, out=0.03, gain=1.8)


def _board(builder: SceneBuilder, paints: _Paints, bay: _Bay) -> None:
    """A board with notices on it."""
    rng = builder.rng
    _panel(builder, bay, (1.8, 1.1), paints.cartons[0], 0.0, up=1.5, out=0.022, gain=0.7)
    for k in range(int(rng.integers(4, 9))):
        size = (float(rng.uniform(0.15, 0.4)), float(rng.uniform(0.15, 0.4)))
        right, up = float(rng.uniform(-0.7, 0.7)), float(rng.uniform(1.15, 1.85))
        number = _any(rng, paints.posters)
        _panel(builder, bay, size, number, 0.0, right=right, up=up, out=0.024 + 0.001 * k)


def _shelf(builder: SceneBuilder, paints: _Paints, bay: _Bay) -> None:
    """A shelf or a chest with cartons on it."""
    rng = builder.rng
    wide, tall = float(rng.uniform(0.7, 1.4)), float(rng.choice([0.8, 1.9]) * rng.uniform(0.9, 1.1))
    right, deep = float(rng.uniform(-0.6, 0.6)), 0.32
    front, top = _any(rng, paints.shelves), _any(rng, paints.wood)
    at, gain = bay.at(right, tall / 2, deep / 2), float(rng.uniform(0.7, 1.1))
    builder.box(at, (deep, wide, tall), [front, top, top], axes=bay.axes, gain=gain)
    for _ in range(int(rng.integers(1, 4))):
        size = tuple(rng.uniform(0.12, 0.3, 3))
        at = bay.at(right + rng.uniform(-0.4, 0.4) * wide, tall + size[2] / 2, deep / 2)
        builder.box(at, size, _any(rng, paints.cartons), axes=bay.axes)


def _open_room(builder: SceneBuilder, paints: _Paints, bay: _Bay) -> None:
    """A room of one bay behind the wall, open to the corridor, with a desk and what hangs there."""
    rng, half = builder.rng, bay.length / 2
    plaster = _any(rng, paints.plaster)
    back = _Bay(bay.at(0.0, 0.0, -DEEP), bay.inward, bay.right, bay.length)
    left = _Bay(bay.at(-half, 0.0, -DEEP / 2), bay.right, -bay.inward, DEEP)
    right = _Bay(bay.at(half, 0.0, -DEEP / 2), -bay.right, bay.inward, DEEP)
    for wall in (back, left, right):
        size, gain = (wall.length, HEIGHT), float(rng.uniform(0.75, 1.1))
        _panel(builder, wall, size, plaster, 230.0, up=HEIGHT / 2, out=0.0, gain=gain)
        _board(builder, paints, wall)
        _shelf(builder, paints, wall)
    table = bay.at(float(rng.uniform(-0.4, 0.4)), 0.72, -1.3)
    builder.box(table, (0.8, 1.3, 0.05), paints.wood[1], axes=bay.axes, bottom=True)
    for _ in range(3):
        carton = tuple(rng.uniform(0.1, 0.3, 3))
        at = table + bay.right * rng.uniform(-0.5, 0.5) + UP * (0.03 + carton[2] / 2)
        builder.box(at, carton, _any(rng, paints.cartons), axes=bay.axes)


def _trolley(builder: SceneBuilder, ring: Ring) -> None:
    """A carton on a trolley that goes round along the outer wall."""
    rng = builder.rng
    still = [Harmonics(np.zeros((d, 1)), np.ones((d, 1)), np.zeros((d, 1))) for d in (1, 3, 3)]
    rate = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 0.7)) / ring.round_m
    route = closed_route(ring.way(-0.8, 0.0, 0.75))
    start = float(rng.uniform())
    number = builder.mover(Path(route, rate, still[0], still[1], still[2], start=start))
    wide, deep, tall = (float(x) for x in rng.uniform([0.3, 0.3, 0.6], [0.5, 0.5, 1.3]))
    poster = builder.paint("poster", 256, 256)
    builder.box(UP * tall / 2, (wide, deep, tall), poster, mover=number)
