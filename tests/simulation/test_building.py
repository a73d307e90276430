"""Buildings: 60 m round, clear of the walls; bays alike where they are to be, and only there."""

import numpy as np
import pytest

from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_inverse
from odomap.simulation.exposure import ImageNoise, expose
from odomap.simulation.render import render
from odomap.simulation.ring import Ring
from odomap.simulation.world import World
from odomap.vision.matching import nearest
from odomap.vision.orb import OrbConfig, extract


@pytest.fixture(scope="module")
def worlds() -> dict[str, World]:
    fields = {"seed": 3, "frames": 76, "rate_hz": 1.0, "resolution": (160, 100)}
    sensors = ("stereo", "depth")
    return {k: World.make(kind=k, sensors=sensors, **fields) for k in ("building", "corridor")}


@pytest.mark.parametrize("kind", ["building", "corridor"])
def test_it_is_sixty_metres_round_and_comes_back(worlds: dict[str, World], kind: str) -> None:
    world = worlds[kind]
    once = 1.0 / world.path.rounds_per_s
    length = np.diff(world.path.at(np.linspace(0, once, 2000)).Ts_world_body[:, :3, 3], axis=0)
    assert 59.0 < np.linalg.norm(length, axis=1).sum() < 66.0
    T = world.path.at(np.array([0.0, once])).Ts_world_body
    assert np.linalg.norm((se3_inverse(T[0]) @ T[1])[:3, 3]) < 1.0


@pytest.mark.parametrize("kind", ["building", "corridor"])
def test_walls_are_all_round_and_nowhere_in_the_way(worlds: dict[str, World], kind: str) -> None:
    world = worlds[kind]
    for index in range(0, len(world), 5):
        depth = world.frame(index).depth
        assert depth is not None
        picture = render(
            world.scene,
            world.rig.cameras[0].camera,
            world.truth.Ts_world_body[[index, index]],
            np.zeros(2),
        )
        assert (picture.depth > 0.3).all(), index  # no gap in the walls, and no camera in them
        assert np.median(picture.depth) < 8.0


def looks(world: World, along: float) -> np.ndarray:
    """Return what a camera at the outer wall sees of it, straight ahead, as descriptors."""
    point, axes = Ring(24.0, 6.0 + (4 - np.pi) * 1.25, 1.25).at(along, 0.5, 1.5)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([-axes[:, 0], [0.0, 0.0, -1.0], -axes[:, 1]])
    T[:3, 3] = point
    camera = Camera(intrinsics=(400.0, 400.0, 319.5, 199.5), resolution=(640, 400))
    picture = render(world.scene, camera, np.stack([T, T]), np.zeros(2))
    image = expose(picture, ImageNoise().scaled(0.0), camera.intrinsics, (0, 0, 0), 1.0)
    return np.asarray(extract(image, OrbConfig()).descriptors)


def test_one_bay_of_a_corridor_looks_like_the_next_and_one_of_a_building_does_not(
    worlds: dict[str, World],
) -> None:
    bay = 26.5 / 9  # of the long outer wall
    share = {}
    for kind, world in worlds.items():
        here, there = (looks(world, 8.0 + k * bay) for k in (0, 1))
        share[kind] = float((nearest(here, there)[1] < 40).mean())
    assert share["corridor"] > 0.25, share
    assert share["building"] < 0.12, share


def test_trolleys_go_round() -> None:
    world = World.make(kind="corridor", frames=2, moving_objects=2, resolution=(64, 48))
    assert len(world.scene.movers) == 2
    rows, speeds = world.scene.moving(0.5)
    assert len(rows) == 10
    assert (np.linalg.norm(speeds, axis=1) > 0.2).all()
