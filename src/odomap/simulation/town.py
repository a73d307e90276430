"""Streets for a LiDAR: a loop of road that rises and falls, and what stands along it.

The road is a rounded rectangle of 500 to 650 m, placed as the street of the cameras is
(`simulation.street`): by distance along its middle line and distance to the left of it. Along it
are pavements with kerbs, houses with bays, ledges and doors, hedges, trees with round trunks and
leaves that let some beams through, lamps, signs, parked cars, bins. The ground rises and falls by a
metre or so over a hundred; all that stands, stands on it. Cars that move drive with the sensor,
before and behind it, and come the other way, one behind the other.

Reference: A. Geiger et al., "Vision meets robotics: the KITTI dataset", IJRR 32(11), 2013 (what
streets are like to a LiDAR).
"""

import numpy as np
from numpy.typing import NDArray

from odomap.simulation.path import Harmonics, Path, closed_route, vehicle
from odomap.simulation.ring import Ring
from odomap.simulation.solids import Ground, Solids, SolidsBuilder

__all__ = ["field", "town", "tunnel"]

Array = NDArray[np.float64]
LANE = 1.75
EYE_M = 1.75
"""Height of the LiDAR above the road."""
BEYOND_M = 120.0
"""How far the ground goes on beyond the road."""
WAVES_M = ((0.45, 80.0), (0.55, 120.0), (0.5, 190.0))
"""Greatest amplitude and least length of the waves of the ground."""
GAP_M = 7.5
"""From car to car in a queue."""


class _Street:
    """A builder, and the road that things are placed along."""

    def __init__(self, rng: np.random.Generator, road: Ring) -> None:
        half = np.array([road.length, road.width]) / 2 + BEYOND_M
        waves = []
        for most, length in WAVES_M:
            angle, number = rng.uniform(0, 2 * np.pi), 2 * np.pi / (length * rng.uniform(1, 1.3))
            wave = most * rng.uniform(0.5, 1), number * np.cos(angle), number * np.sin(angle)
            waves.append([*wave, rng.uniform(0, 2 * np.pi)])
        self.rng, self.road = rng, road
        self.ground = Ground.waves(-half, half, np.array(waves))
        self.builder = SolidsBuilder(rng, self.ground)

    def at(self, along: float, left: float, up: float = 0.0) -> tuple[Array, Array]:
        """Return a point above the ground, and upright axes (columns: ahead, left, up)."""
        point, axes = self.road.at(along, left)
        point[2] = self.ground.height(point[0], point[1]) + up
        return point, axes

    def way(self, left: float, up: float) -> Array:
        """Return way points beside the middle, above the ground."""
        way = self.road.way(left, up)
        way[:, 2] += [self.ground.height(x, y) for x, y in way[:, :2]]
        return way


def town(seed: int, moving_objects: int, speed: float) -> tuple[Solids, Path]:
    """Build a street for a LiDAR and drive round it.

    Args:
        seed: which street.
        moving_objects: how many cars move.
        speed: mean speed, m/s.

    Returns:
        What is there, and the path of the LiDAR.
    """
    rng = np.random.default_rng([seed, 53])
    road = Ring(
        float(rng.uniform(160, 200)), float(rng.uniform(90, 120)), float(rng.uniform(14, 19))
    )
    street = _Street(rng, road)
    for side in (-1.0, 1.0):
        _pavement(street, side)
        _houses(street, side)
        _parked(street, side)
        _furniture(street, side)
    backwards = bool(rng.random() < 0.5)
    way = street.way(LANE if backwards else -LANE, EYE_M)
    path = vehicle(way[::-1] if backwards else way, speed, rng, np.eye(3), climbs=True)
    _traffic(street, path, moving_objects, backwards)
    return street.builder.build(), path


def tunnel(seed: int, moving_objects: int, speed: float) -> tuple[Solids, Path]:
    """Build a tunnel that is the same everywhere, longer than any LiDAR sees; as `town`.

    Nothing in it tells how far one has come. No cars move in it.
    """
    rng = np.random.default_rng([seed, 59])
    long, wide, high = 1000.0, float(rng.uniform(9, 12)), float(rng.uniform(5, 6.5))
    builder = SolidsBuilder(rng, Ground.none())
    x, y, z = np.eye(3)
    for side in (-1.0, 1.0):
        corner = np.array([-long / 2, side * wide / 2, 0.0])
        builder.rectangle(corner, x, z, (long, high), "building")
    corner = np.array([-long / 2, -wide / 2, 0.0])
    builder.rectangle(corner, x, y, (long, wide), "ground", is_ground=True)
    builder.rectangle(corner + high * z, x, y, (long, wide), "building")
    ring = Ring(long - 40, 4.0, 1.9)
    path = vehicle(ring.way(0.0, EYE_M, 2.0), speed, rng, np.eye(3), start=0.1)
    return builder.build(), path


def field(seed: int, moving_objects: int, speed: float) -> tuple[Solids, Path]:
    """Make flat ground and nothing else; as `town`. No cars move on it."""
    rng = np.random.default_rng([seed, 61])
    half = np.full(2, 400.0)
    ground = Ground.waves(-half, half, np.zeros((0, 4)), 40.0)
    path = vehicle(Ring(90.0, 60.0, 14.0).way(0.0, EYE_M), speed, rng, np.eye(3))
    return SolidsBuilder(rng, ground).build(), path


def _pavement(street: _Street, side: float) -> None:
    """Raised slabs that follow the ground, with a kerb towards the road."""
    road, step = street.road, 4.0
    for along in np.arange(0.0, road.round_m - 1e-9, step):
        point, _ = street.at(along + step / 2, side * 6.6)
        ends = [street.at(along + share * step, side * 6.6)[0] for share in (0.0, 1.0)]
        sides = [street.at(along + step / 2, side * left)[0] for left in (5.0, 8.2)]
        ahead, left = ends[1] - ends[0], (sides[1] - sides[0]) * side
        left = left - ahead * (left @ ahead) / (ahead @ ahead)
        long = step * (1.0 if road.is_straight(along + step / 2, step) else 1.3)
        unit_a, unit_l = ahead / np.linalg.norm(ahead), left / np.linalg.norm(left)
        thing = street.builder.thing()
        corner = point + np.array([0, 0, 0.13]) - unit_a * long / 2 - unit_l * 1.6
        street.builder.rectangle(
            corner, unit_a, unit_l, (long, 3.2), "ground", thing=thing, albedo=0.3, is_ground=True
        )
        kerb = corner if side > 0 else corner + unit_l * 3.2
        down = np.cross(unit_a, unit_l)
        street.builder.rectangle(
            kerb - 0.16 * down, unit_a, down, (long, 0.16), "furniture", thing=thing, albedo=0.4,
            is_ground=True,
        )  # fmt: skip


def _houses(street: _Street, side: float) -> None:
    """House after house, here and there a garden behind a hedge or nothing at all."""
    rng, road, builder = street.rng, street.road, street.builder
    along = 0.0
    while along < road.round_m - 6:
        wide, setback = float(rng.uniform(8, 16)), float(rng.uniform(8.4, 11.5))
        middle = along + wide / 2
        along += wide * (1.0 if side < 0 or road.is_straight(middle, 2.0) else 1.6)
        if side > 0 and not road.is_straight(middle, 2.0):
            continue
        kind = rng.random()
        if kind < 0.07:
            continue
        if kind < 0.17:
            tall = float(rng.uniform(0.9, 1.5))
            point, axes = street.at(middle, side * setback, tall / 2 - 0.2)
            builder.box(point, (wide, 0.7, tall + 0.4), "furniture", axes=axes, albedo=0.35)
            continue
        _house(street, middle, side, wide - float(rng.choice([0.0, 0.0, 1.5, 3.0])), setback)


def _house(street: _Street, middle: float, side: float, wide: float, setback: float) -> None:
    """Walls and roof, and what stands out of the front: bays, ledges, porches, chimneys."""
    rng, builder = street.rng, street.builder
    tall, deep = float(rng.uniform(6, 13)), float(rng.uniform(8, 11))
    thing, albedo = builder.thing(), float(rng.uniform(0.25, 0.7))
    up = np.array([0.0, 0.0, 1.0])
    foot, axes = street.at(middle, side * (setback + deep / 2))
    # Into the ground by a metre: it slopes.
    builder.box(
        foot + up * (tall / 2 - 0.5), (wide, deep, tall + 1.0), "building",
        axes=axes, thing=thing, albedo=albedo,
    )  # fmt: skip
    front = foot - axes[:, 1] * side * deep / 2

    def add(right: float, low: float, size: tuple[float, float, float]) -> None:
        at = front + axes[:, 0] * right + up * (low + size[2] / 2)
        kind = "building"
        builder.box(at, size, kind, axes=axes, thing=thing, albedo=albedo, bottom=low > 0)

    reach = 0.5 * wide - 1.2
    for _ in range(int(rng.integers(1, 4))):
        size = (float(rng.uniform(0.8, 2.4)), float(rng.uniform(0.5, 1.6)))
        add(float(rng.uniform(-reach, reach)), float(rng.uniform(2.2, tall - 1)), (*size, 0.9))
    if rng.random() < 0.5:
        size = (float(rng.uniform(1.2, 3.0)), float(rng.uniform(0.8, 2.0)))
        add(float(rng.uniform(-reach, reach)), -0.8, (*size, float(rng.uniform(2.8, 5.5))))
    if rng.random() < 0.5:
        at = foot + axes[:, 0] * float(rng.uniform(-reach, reach)) + up * (tall + 0.5)
        builder.box(at, (0.6, 0.6, 1.2), "building", axes=axes, thing=thing, albedo=0.3)


def _car(
    builder: SolidsBuilder, point: Array, axes: Array, kind: str = "vehicle", mover: int = -1
) -> None:
    """Body and cabin; `point` is on the ground below the middle."""
    rng, up = builder.rng, axes[:, 2]
    long, wide, tall = rng.uniform(0.92, 1.1, 3) * [4.2, 1.75, 0.95]
    albedo, thing = float(rng.uniform(0.15, 0.8)), builder.thing()
    for centre, size in (
        (point + up * (0.2 + tall / 2), (long, wide, tall)),
        (point + up * (0.475 + tall) - axes[:, 0] * 0.2, (long * 0.5, wide * 0.88, 0.55)),
    ):
        builder.box(
            centre, size, kind, axes=axes, thing=thing, albedo=albedo, mover=mover, bottom=True
        )


def _parked(street: _Street, side: float) -> None:
    """Cars along the kerb with gaps."""
    rng = street.rng
    along = float(rng.uniform(0, 20))
    while along < street.road.round_m - 6:
        if rng.random() < 0.5:
            _car(street.builder, *street.at(along, side * 4.05))
        along += float(rng.uniform(5.6, 14))


def _furniture(street: _Street, side: float) -> None:
    """Trees, lamps, signs and bins on the pavement."""
    rng, builder = street.rng, street.builder
    up = np.array([0.0, 0.0, 1.0])
    along = float(rng.uniform(0, 8))
    while along < street.road.round_m - 3:
        kind, thing = rng.random(), builder.thing()
        point, axes = street.at(along, side * float(rng.uniform(5.2, 5.7)))
        if kind < 0.42:
            _tree(builder, point)
        elif kind < 0.65:
            builder.pole(point, 0.08, 6.4, thing=thing)
            at = point + up * 6.3 - axes[:, 1] * side * 0.8
            builder.box(at, (0.25, 1.7, 0.12), "pole", axes=axes, thing=thing, bottom=True)
        elif kind < 0.85:
            builder.pole(point, 0.04, 2.6, thing=thing)
            size = (0.04, float(rng.uniform(0.5, 0.9)), float(rng.uniform(0.5, 0.9)))
            at = point + up * 2.3
            builder.box(at, size, "pole", axes=axes, thing=thing, albedo=0.95, bottom=True)
        else:
            wide, deep, tall = (*rng.uniform(0.4, 1.0, 2), float(rng.uniform(0.8, 1.3)))
            size = (float(wide), float(deep), tall)
            builder.box(point + up * (tall / 2), size, "furniture", axes=axes, thing=thing)
        along += float(rng.uniform(4, 13))


def _tree(builder: SolidsBuilder, point: Array) -> None:
    """A trunk under a heap of balls of leaves."""
    rng, thing = builder.rng, builder.thing()
    tall, spread = float(rng.uniform(2.0, 3.0)), float(rng.uniform(0.8, 1.5))
    builder.pole(point, float(rng.uniform(0.1, 0.22)), tall + spread, thing=thing, albedo=0.3)
    for _ in range(5):
        at = point + [0, 0, tall + spread] + rng.normal(0, 0.5, 3) * spread
        builder.leaves(at, spread * float(rng.uniform(0.6, 0.9)), 0.5, thing)


def _traffic(street: _Street, path: Path, count: int, backwards: bool) -> None:
    """Cars: one in three drives along, before or behind the sensor, the others come in a queue."""
    rng, road = street.rng, street.road
    even, still = (Harmonics(np.zeros((d, 1)), np.ones((d, 1)), np.zeros((d, 1))) for d in (1, 3))
    with_us = closed_route(_lane(street, LANE if backwards else -LANE, backwards))
    against = closed_route(_lane(street, -LANE if backwards else LANE, not backwards))
    rate = float(rng.uniform(6, 10)) / road.round_m
    start, place = float(rng.uniform()), 0.0
    for k in range(count):
        if k % 3 == 0:
            ahead = (k // 6 + 1) * (1 if k % 6 == 0 else -1) * (GAP_M + 1.5) / road.round_m
            car = Path(
                with_us, path.rounds_per_s, path.unevenness, still, still,
                start=path.start + ahead, climbs=True,
            )  # fmt: skip
        else:
            place += float(rng.uniform(GAP_M, GAP_M + 3)) / road.round_m
            car = Path(against, rate, even, still, still, start=start - place, climbs=True)
        _car(street.builder, np.zeros(3), np.eye(3), "moving", street.builder.mover(car))


def _lane(street: _Street, left: float, backwards: bool) -> Array:
    """Return way points of a lane on the ground, in the order in which it is driven."""
    way = street.way(left, 0.0)
    return way[::-1] if backwards else way
