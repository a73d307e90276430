"""Streets: a loop of road between house fronts, with what stands along it.

The road is a rounded rectangle of 500 to 650 m. Everything is placed by (distance along its middle
line, distance to the left of it): pavement, houses, gardens, trees, parked cars, lamps, signs,
markings. The sun throws shadows over it. One drives on the right, either way round.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.simulation.light import Lights
from odomap.simulation.path import Harmonics, Path, closed_route, vehicle
from odomap.simulation.ring import Ring
from odomap.simulation.scene import Scene, SceneBuilder

__all__ = ["street"]

Array = NDArray[np.float64]
LANE = 1.75
UP = np.array([0.0, 0.0, 1.0])


def _road(rng: np.random.Generator) -> Ring:
    """Return the middle line of a street."""
    length, width = rng.uniform(165, 200), rng.uniform(95, 120)
    return Ring(length, width, float(rng.uniform(15, 19)))


def street(seed: int, moving_objects: int, speed: float) -> tuple[Scene, Path]:
    """Build a street and drive round it.

    Args:
        seed: which street.
        moving_objects: how many cars come the other way.
        speed: mean speed, m/s.

    Returns:
        The scene, and the path of the body; the road is z = 0, metres.
    """
    rng = np.random.default_rng([seed, 2])
    road = _road(rng)
    angle = rng.uniform(0, 2 * np.pi)
    sun = np.array([np.cos(angle), np.sin(angle), rng.uniform(0.7, 1.2)])
    lights = Lights(
        0.75, 3.0, np.zeros((0, 3)), np.zeros(0),
        sun=sun / np.linalg.norm(sun), sun_power=0.95, grid_m=0.8, open_rays=4,
    )  # fmt: skip
    builder = SceneBuilder(rng, lights, (0.8, 0.6))
    _ground(builder, road)
    _markings(builder, road)
    for side in (-1.0, 1.0):
        _houses(builder, road, side)
        _pavement(builder, road, side)
        _cars(builder, road, side)
        _furniture(builder, road, side)
    backwards = rng.random() < 0.5
    for _ in range(moving_objects):
        _oncoming(builder, road, backwards)
    way = road.way(LANE if backwards else -LANE, 1.2)
    path = vehicle(way[::-1] if backwards else way, speed, rng, np.eye(3))
    return builder.build(), path


def _ground(builder: SceneBuilder, road: Ring) -> None:
    """Asphalt on the road and grass beyond, in squares of 8 m near the road."""
    asphalt = builder.paint("asphalt", 2048, 2048)
    grass = builder.paint("foliage", 1024, 1024)
    centres = np.array([road.at(float(a))[0] for a in np.arange(0, road.round_m, 3.0)])
    half = np.array([road.length, road.width]) / 2 + 48
    for x in np.arange(-half[0], half[0], 8.0):
        for y in np.arange(-half[1], half[1], 8.0):
            middle = np.array([x + 4, y + 4, 0.0])
            far = np.linalg.norm(centres - middle, axis=1).min()
            if far > 40:
                continue
            number, scale = (asphalt, 90.0) if far < 12 else (grass, 60.0)
            builder.rectangle(
                np.array([x, y + 8, 0.0]), np.array([1.0, 0, 0]), np.array([0, -1.0, 0]),
                (8.0, 8.0), number, scale, origin_texels=(x * scale, -y * scale),
            )  # fmt: skip


def _markings(builder: SceneBuilder, road: Ring) -> None:
    """Dashes, patches, covers and leaves, each a little above what lies below it."""
    rng = builder.rng
    paint = builder.paint("plaster", 256, 256)
    dark = builder.paint("asphalt", 1024, 1024)
    cover = builder.paint("tiles", 64, 64)
    down = np.array([0.0, -1.0, 0.0])

    def lay(
        along: float, left: float, up: float, size: tuple[float, float], number: int,
        scale: float, gain: float, turn: float = 0.0,
    ) -> None:  # fmt: skip
        point, axes = road.at(along, left, up)
        c, s = np.cos(turn), np.sin(turn)
        axes = axes @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        corner = point + axes @ np.array([-size[0] / 2, size[1] / 2, 0])
        builder.rectangle(corner, axes[:, 0], axes @ down, size, number, scale, gain=gain)

    for along in np.arange(0.0, road.round_m, 7.0):
        lay(along, 0.0, 0.012, (3.0, 0.12), paint, 200.0, float(rng.uniform(0.7, 1.15)))
    for k in range(int(road.round_m / 4)):
        size = tuple(rng.uniform(0.4, 2.5, 2))
        lay(
            float(rng.uniform(0, road.round_m)), float(rng.uniform(-3.2, 3.2)),
            0.004 + 0.0001 * (k % 50), size, dark, 90.0, float(rng.uniform(0.55, 1.5)),
            float(rng.uniform(-0.2, 0.2)),
        )  # fmt: skip
    for k in range(int(road.round_m / 10)):
        lay(
            float(rng.uniform(0, road.round_m)), float(rng.uniform(-3.0, 3.0)),
            0.010 + 0.0001 * (k % 20), (0.6, 0.6), cover, 100.0, 0.6,
        )  # fmt: skip


def _houses(builder: SceneBuilder, road: Ring, side: float) -> None:
    """House after house, here and there a garden behind a hedge."""
    rng = builder.rng
    fronts = [builder.paint("facade", 1024, 512) for _ in range(9)]
    roofs = builder.paint("tiles", 256, 256)
    hedge = builder.paint("foliage", 512, 256)
    along = 0.0
    while along < road.round_m - 6:
        wide = float(rng.uniform(8, 16))
        setback = float(rng.uniform(8.0, 11.0))
        middle = along + wide / 2
        along += wide * (1.0 if side < 0 or road.is_straight(middle, 2.0) else 1.6)
        if side > 0 and not road.is_straight(middle, 2.0):
            continue
        if rng.random() < 0.16:
            point, axes = road.at(middle, side * setback, 0.6)
            size = (wide, 0.7, float(rng.uniform(0.9, 1.5)))
            builder.box(point, size, hedge, 110.0, axes=axes, gain=1.1)
            continue
        tall, deep = float(rng.uniform(6, 13)), float(rng.uniform(8, 11))
        point, axes = road.at(middle, side * (setback + deep / 2), tall / 2)
        number = int(rng.choice(fronts))
        gap = float(rng.choice([0.0, 0.0, 1.5]))
        builder.box(
            point, (wide - gap, deep, tall), [number, number, roofs], axes=axes,
            gain=float(rng.uniform(0.65, 1.15)),
        )  # fmt: skip
        for _ in range(int(rng.integers(0, 4))):
            shift = rng.uniform(-0.45, 0.45) * wide
            up = float(rng.uniform(1.5, tall - 1))
            place, _ = road.at(middle, side * (setback - 0.35), up)
            size = (float(rng.uniform(0.8, 2.5)), 0.7, float(rng.uniform(0.2, 1.1)))
            builder.box(place + axes[:, 0] * shift, size, number, axes=axes, gain=0.9, bottom=True)


def _pavement(builder: SceneBuilder, road: Ring, side: float) -> None:
    """Raised slabs with a kerb, some stretches with grass between."""
    rng = builder.rng
    slabs = [builder.paint("tiles", 1024, 1024) for _ in range(2)]
    grass = builder.paint("foliage", 512, 512)
    step = 6.0
    for k, along in enumerate(np.arange(0.0, road.round_m, step)):
        stretch = step * (1.02 if road.is_straight(along + 3, 3.0) else 1.35)
        up = 0.13 + 0.003 * (k % 7)
        point, axes = road.at(float(along + step / 2), side * 6.6, up / 2)
        number = grass if rng.random() < 0.12 else slabs[(k // 9) % 2]
        gain = float(rng.uniform(0.85, 1.1))
        builder.box(point, (stretch, 3.4, up), number, 130.0, axes=axes, gain=gain)


def _car(
    builder: SceneBuilder, point: Array, axes: Array, textures: tuple[int, int], mover: int = -1
) -> None:
    """Body and cabin; `point` is on the ground below the middle."""
    rng = builder.rng
    size = rng.uniform(0.92, 1.1, 3) * [4.2, 1.75, 0.95]
    gain = float(rng.uniform(0.5, 1.3))
    builder.box(
        point + UP * (0.2 + size[2] / 2),
        tuple(size),
        textures[0],
        axes=axes,
        gain=gain,
        mover=mover,
    )
    cabin = (size[0] * 0.5, size[1] * 0.88, 0.55)
    at = point + UP * (0.2 + size[2] + 0.275) - axes[:, 0] * 0.2
    builder.box(at, cabin, textures[1], axes=axes, mover=mover)


def _car_paint(builder: SceneBuilder) -> tuple[int, int]:
    return builder.paint("car", 512, 128), builder.paint("cabin", 256, 64)


def _cars(builder: SceneBuilder, road: Ring, side: float) -> None:
    """Cars parked along the kerb with gaps."""
    rng = builder.rng
    paints = [_car_paint(builder) for _ in range(4)]
    along = float(rng.uniform(0, 20))
    while along < road.round_m - 6:
        if rng.random() < 0.55:
            point, axes = road.at(along, side * 4.05)
            _car(builder, point, axes, paints[int(rng.integers(4))])
        along += float(rng.uniform(5.6, 14))


def _furniture(builder: SceneBuilder, road: Ring, side: float) -> None:
    """Trees, lamps, signs and bins on the pavement."""
    rng = builder.rng
    bark, leaves = builder.paint("wood", 64, 256), builder.paint("foliage", 256, 256)
    signs = [builder.paint("poster", 128, 128) for _ in range(4)]
    along = float(rng.uniform(0, 8))
    while along < road.round_m - 3:
        kind = rng.random()
        left = side * float(rng.uniform(5.1, 5.6))
        point, axes = road.at(along, left)
        if kind < 0.42:
            _tree(builder, point, bark, leaves)
        elif kind < 0.65:
            builder.box(point + UP * 3.2, (0.13, 0.13, 6.4), bark, axes=axes, gain=0.7)
            builder.box(
                point + UP * 6.3 - axes[:, 1] * side * 0.8, (0.25, 1.7, 0.12), bark, axes=axes,
                bottom=True,
            )  # fmt: skip
        elif kind < 0.85:
            builder.box(point + UP * 1.3, (0.07, 0.07, 2.6), bark, axes=axes)
            size = (0.05, float(rng.uniform(0.5, 0.9)), float(rng.uniform(0.5, 0.9)))
            builder.box(point + UP * 2.3, size, int(rng.choice(signs)), axes=axes, bottom=True)
        else:
            size = (*rng.uniform(0.4, 1.0, 2), float(rng.uniform(0.8, 1.3)))
            builder.box(point + UP * size[2] / 2, size, int(rng.choice(signs)), axes=axes, gain=0.6)
        along += float(rng.uniform(4, 13))


def _tree(builder: SceneBuilder, point: Array, bark: int, leaves: int) -> None:
    """A trunk under a heap of turned clumps of leaves."""
    rng = builder.rng
    tall, thick = float(rng.uniform(1.9, 2.8)), float(rng.uniform(0.16, 0.35))
    builder.box(point + UP * tall / 2, (thick, thick, tall), bark, gain=0.5)
    spread = float(rng.uniform(0.7, 1.3))
    for _ in range(11):
        q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        axes = q * np.sign(np.linalg.det(q))
        at = point + UP * (tall + spread * 0.9) + rng.normal(0, 0.55, 3) * spread
        size = tuple(rng.uniform(0.5, 1.1, 3) * spread)
        builder.box(
            at, size, leaves, 220.0, axes=axes, gain=float(rng.uniform(0.6, 1.3)), bottom=True
        )


def _oncoming(builder: SceneBuilder, road: Ring, backwards: bool) -> None:
    """A car on the other lane, the other way round."""
    rng = builder.rng
    way = road.way(-LANE if backwards else LANE, 0.0)
    still = [Harmonics(np.zeros((d, 1)), np.ones((d, 1)), np.zeros((d, 1))) for d in (1, 3, 3)]
    rate = float(rng.uniform(6, 10)) / road.round_m
    route = closed_route(way if backwards else way[::-1])
    path = Path(route, rate, still[0], still[1], still[2], start=float(rng.uniform()))
    number = builder.mover(path)
    _car(builder, np.zeros(3), np.eye(3), _car_paint(builder), number)
