"""Rooms: four walls, floor and ceiling, furniture along the walls and in the middle.

The walls are plain plaster with pictures, sockets and shelves on parts of them, as real walls are:
a corner detector finds little on the plaster and much on what hangs there. The way through the room
goes round between the furniture.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from odomap.simulation.light import Lights
from odomap.simulation.path import Harmonics, Path, closed_route, hand_held
from odomap.simulation.scene import Scene, SceneBuilder

__all__ = ["R_CARRIER_IMU", "furnished_room", "room", "walk_round"]

Array = NDArray[np.float64]
Builder = TypeVar("Builder", bound=SceneBuilder)

R_CARRIER_IMU = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
"""The IMU is mounted with x up, y right and z forward, as in many hand-held units."""


def room(seed: int, moving_objects: int, speed: float) -> tuple[Scene, Path]:
    """Furnish a room and walk round in it.

    Args:
        seed: which room.
        moving_objects: how many boxes wander through it.
        speed: mean speed of the walk, m/s.

    Returns:
        The scene, and the path of the body; the floor is z = 0, metres.
    """
    builder, radii = furnished_room(seed, moving_objects, SceneBuilder)
    scene = builder.build()  # draws numbers, too
    return scene, walk_round(builder.rng, radii, speed)


def furnished_room(seed: int, moving_objects: int, make: type[Builder]) -> tuple[Builder, Array]:
    """Return what a room is made of, in a builder of some type, and (2,) radii of the way in it."""
    rng = np.random.default_rng([seed, 1])
    half = np.array([rng.uniform(3.2, 4.6), rng.uniform(2.6, 3.6)])
    height = float(rng.uniform(2.6, 3.1))
    lamps = np.column_stack([rng.uniform(-0.6, 0.6, (3, 2)) * half, np.full(3, height - 0.25)])
    lamps[2] = [0.0, 0.0, height - 0.5]
    lights = Lights(0.75, 1.2, lamps, rng.uniform(1.6, 4.0, 3), grid_m=0.16)
    builder = make(rng, lights, (0.9, 0.9))
    _shell(builder, half, height)
    _hangings(builder, half, height)
    _furniture(builder, half)
    radii = half - 1.35
    for _ in range(moving_objects):
        _wanderer(builder, radii)
    return builder, radii


def _shell(builder: SceneBuilder, half: Array, height: float) -> None:
    """Walls, floor and ceiling, seen from inside."""
    x, y = half
    plaster = [builder.paint("plaster", 2048, 1024) for _ in range(2)]
    floor = builder.paint(str(builder.rng.choice(["wood", "tiles"])), 2048, 1024)
    wood = builder.paint("wood", 512, 64)
    z = np.array([0.0, 0.0, 1.0])
    for k, (normal, depth, width) in enumerate([((-1, 0), x, y), ((0, -1), y, x)] * 2):
        inward = np.array([*normal, 0.0]) * (1 if k < 2 else -1)
        right = np.cross(inward, -z)
        corner = -inward * depth - right * width + z * height
        builder.rectangle(
            corner, right, -z, (2 * width, height), plaster[k % 2], 230.0,
            gain=float(builder.rng.uniform(0.7, 1.1)),
        )  # fmt: skip
        skirting = corner + inward * 0.015 - z * (height - 0.1)
        builder.rectangle(skirting, right, -z, (2 * width, 0.1), wood, 300.0, gain=0.7)
    builder.rectangle(
        np.array([-x, y, 0.0]), np.array([1.0, 0, 0]), np.array([0, -1.0, 0]),
        (2 * x, 2 * y), floor, 220.0,
    )  # fmt: skip
    builder.rectangle(
        np.array([-x, -y, height]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]),
        (2 * x, 2 * y), plaster[0], 230.0, gain=1.15,
    )  # fmt: skip
    for _ in range(3):
        size = (1.2, 0.3, 0.06)
        at = np.array([*builder.rng.uniform(-0.6, 0.6, 2) * half, height - 0.03])
        builder.box(at, size, wood, 300.0, gain=1.9, bottom=True)


def _hangings(builder: SceneBuilder, half: Array, height: float) -> None:
    """Pictures, boards, sockets and a door or window on each wall."""
    rng, z = builder.rng, np.array([0.0, 0.0, 1.0])
    posters = [builder.paint("poster", 512, 256) for _ in range(5)]
    facade = builder.paint("facade", 512, 512)
    for k in range(4):
        inward = np.array([[-1, 0, 0], [0, -1, 0], [1, 0, 0], [0, 1, 0]][k], float)
        right = np.cross(inward, -z)
        depth, width = half[k % 2], half[1 - k % 2]
        slots = np.linspace(-width + 0.7, width - 0.7, 4)
        for slot in slots:
            if rng.random() < 0.25:
                continue
            w = float(rng.uniform(0.35, 1.1))
            h = float(rng.uniform(0.3, 0.9))
            top = min(float(rng.uniform(1.5, 2.3)), height - 0.2)
            middle = -inward * (depth - 0.02) + right * (slot + rng.uniform(-0.2, 0.2)) + z * top
            number = facade if rng.random() < 0.15 else posters[int(rng.integers(5))]
            corner = middle - right * w / 2
            builder.rectangle(corner, right, -z, (w, h), number, gain=float(rng.uniform(0.6, 1.1)))
        for _ in range(5):
            at = -inward * (depth - 0.02) + right * rng.uniform(-width, width) * 0.9
            at = at + z * rng.uniform(0.25, height - 0.3)
            size = (float(rng.uniform(0.05, 0.16)), float(rng.uniform(0.05, 0.16)))
            builder.rectangle(at, right, -z, size, posters[int(rng.integers(5))])


def _turned(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _furniture(builder: SceneBuilder, half: Array) -> None:
    """Shelves and chests along the walls, stacks of boxes, a table in the middle."""
    rng = builder.rng
    shelves = [builder.paint("shelf", 512, 512) for _ in range(2)]
    boards = [builder.paint(kind, 512, 256) for kind in ("wood", "cardboard", "fabric")]
    cartons = [builder.paint("cardboard", 256, 256) for _ in range(5)]
    for side in range(4):
        depth, width = half[side % 2], half[1 - side % 2]
        frame = _turned(-np.pi / 2 * side + np.pi)
        for slot in np.linspace(-width + 0.6, width - 0.6, int(width / 0.75)):
            if rng.random() < 0.3:
                continue
            deep = float(rng.uniform(0.3, 0.55))
            wide = float(rng.uniform(0.5, 1.2))
            tall = float(rng.choice([0.45, 0.75, 1.1, 1.9]) * rng.uniform(0.9, 1.1))
            place = frame @ np.array([-(depth - deep / 2 - 0.02), slot, tall / 2])
            front = shelves[int(rng.integers(2))] if tall > 1.0 else boards[int(rng.integers(3))]
            top = boards[int(rng.integers(3))]
            builder.box(
                place, (deep, wide, tall), [front, top, top], axes=frame,
                gain=float(rng.uniform(0.6, 1.1)),
            )  # fmt: skip
            _stack(builder, place + np.array([0, 0, tall / 2]), cartons, frame)
    table = rng.uniform(0.5, 0.7, 2)
    builder.box(np.array([0, 0, 0.72]), (*table, 0.05), boards[0], 300.0, bottom=True)
    for x in (-0.4, 0.4):
        for y in (-0.4, 0.4):
            builder.box(
                np.array([x * table[0], y * table[1], 0.35]), (0.05, 0.05, 0.7), boards[0], 300
            )
    for _ in range(3):
        _stack(builder, np.array([*rng.uniform(-0.25, 0.25, 2), 0.745]), cartons, np.eye(3))


def _stack(builder: SceneBuilder, on: Array, cartons: list[int], frame: Array) -> None:
    """Put up to three cartons on top of each other."""
    rng = builder.rng
    z = 0.0
    for _ in range(int(rng.integers(0, 4))):
        size = rng.uniform(0.1, 0.32, 3)
        at = on + frame @ np.array([*rng.uniform(-0.06, 0.06, 2), z + size[2] / 2])
        axes = frame @ _turned(float(rng.uniform(-0.6, 0.6)))
        number = cartons[int(rng.integers(5))]
        builder.box(at, tuple(size), number, axes=axes, gain=float(rng.uniform(0.4, 1.2)))
        z += size[2]


def _wanderer(builder: SceneBuilder, radii: Array) -> None:
    """A carton on a trolley going its own round."""
    rng = builder.rng
    angles = np.arange(8) * np.pi / 4 + rng.uniform(0, 7)
    ring = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(8)])
    points = ring * [*(radii * rng.uniform(0.55, 0.75, 2)), 0.0]
    still = [Harmonics(np.zeros((d, 1)), np.ones((d, 1)), np.zeros((d, 1))) for d in (1, 3, 3)]
    direction = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.03, 0.08))
    path = Path(closed_route(points), direction, still[0], still[1], still[2])
    number = builder.mover(path)
    size = (*rng.uniform(0.25, 0.45, 2), float(rng.uniform(0.5, 1.4)))
    poster = builder.paint("poster", 256, 256)
    builder.box(np.array([0, 0, size[2] / 2]), size, poster, mover=number)


def walk_round(rng: np.random.Generator, radii: Array, speed: float) -> Path:
    """Go round the middle of a room at eye level."""
    angles = np.arange(10) * (2 * np.pi / 10) + rng.uniform(0, 2 * np.pi)
    stretch = rng.uniform(0.92, 1.06, (10, 1))
    ring = np.column_stack([np.cos(angles), np.sin(angles)]) * radii * stretch
    points = np.column_stack([ring, rng.uniform(1.25, 1.6, 10)])
    return hand_held(points if rng.random() < 0.5 else points[::-1], speed, rng, R_CARRIER_IMU)
