"""Clouds of known shape: walls seen with noise, in space and in the plane."""

import numpy as np

X, Y, Z = np.eye(3)


class Walls:
    """Draws points of rectangles, centre and two half sides each, with noise."""

    def __init__(self, *walls, noise=0.01, each=4000):
        self.walls, self.noise, self.each = walls, noise, each

    def seen(self, rng, noise=None):
        parts = [
            centre + rng.uniform(-1, 1, (self.each, 1)) * u + rng.uniform(-1, 1, (self.each, 1)) * v
            for centre, u, v in self.walls
        ]
        points = np.vstack(parts)
        return points + (self.noise if noise is None else noise) * rng.normal(size=points.shape)


ROOM = Walls(
    (3 * Y, 4 * X, 1.5 * Z), (-3 * Y, 4 * X, 1.5 * Z), (-1.5 * Z, 4 * X, 3 * Y),
    (4 * X, 3 * Y, 1.5 * Z), (-4 * X, 3 * Y, 1.5 * Z),
)  # fmt: skip
CORRIDOR = Walls(
    (2 * Y, 20 * X, 1.5 * Z), (-2 * Y, 20 * X, 1.5 * Z), (1.5 * Z, 20 * X, 2 * Y),
    (-1.5 * Z, 20 * X, 2 * Y),
)  # fmt: skip
PLANE = Walls((0 * Z, 10 * X, 10 * Y), each=8000)


class Sphere:
    """A ball of 3 m: nothing holds its rotation."""

    def seen(self, rng):
        d = rng.normal(size=(8000, 3))
        return 3 * d / np.linalg.norm(d, axis=1, keepdims=True) + 0.01 * rng.normal(size=d.shape)


class Outline:
    """A world of 3D walls cut by the plane z = 0."""

    def __init__(self, world):
        self.world = world

    def seen(self, rng):
        return self.world.seen(rng)[:, :2]


ROOM_2D = Outline(
    Walls(
        (3 * Y, 4 * X, 0 * Z), (-3 * Y, 4 * X, 0 * Z), (4 * X, 3 * Y, 0 * Z),
        (-4 * X, 3 * Y, 0 * Z), each=600,
    )
)  # fmt: skip
CORRIDOR_2D = Outline(Walls((Y, 14 * X, 0 * Z), (-Y, 14 * X, 0 * Z), each=600))
