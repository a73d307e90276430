"""Ground that rises and falls, seen by sweeps, with things on it and mirrored points below."""

import numpy as np
import pytest

from odomap.lidar.terrain import SLOPE, terrain_of


def ground(xy):
    return 0.08 * xy[:, 0] + 0.5 * np.sin(xy[:, 1] / 8.0)


def sweeps(rng, count=5):
    for _ in range(count):
        xy = rng.uniform(-20, 20, (8000, 2))
        yield np.column_stack([xy, ground(xy) + rng.normal(0, 0.02, len(xy))])


@pytest.mark.parametrize("seed", range(3))
def test_ground_is_found_to_some_centimetres(seed):
    rng = np.random.default_rng(seed)
    terrain = terrain_of(sweeps(rng))
    xy = rng.uniform(-18, 18, (500, 2))
    off = terrain.at(xy) - ground(xy)
    assert np.abs(off).max() < 0.1
    assert terrain.at(xy.reshape(50, 10, 2)).shape == (50, 10)


def test_it_goes_through_under_what_hides_it():
    rng = np.random.default_rng(1)
    clouds = list(sweeps(rng))
    for k, cloud in enumerate(clouds):  # a lorry's flat bed, 3 by 6 m, 1.2 m high
        on = (np.abs(cloud[:, 0]) < 1.5) & (np.abs(cloud[:, 1]) < 3.0)
        clouds[k][on, 2] += 1.2
    xy = np.column_stack([np.zeros(9), np.linspace(-2, 2, 9)])
    off = terrain_of(clouds).at(xy) - ground(xy)
    assert off.max() < 0.1 + 2 * SLOPE
    assert off.max() < 0.6 * 1.2


def test_mirrored_points_do_not_dig_holes():
    rng = np.random.default_rng(2)
    clouds = [
        np.concatenate([cloud, [[*rng.uniform(-18, 18, 2), -9.0]] * 2]) for cloud in sweeps(rng)
    ]
    clouds.append(np.array([[60.0, 0.0, -30.0]]))  # a point alone says nothing
    terrain = terrain_of(clouds)
    xy = rng.uniform(-18, 18, (500, 2))
    assert np.abs(terrain.at(xy) - ground(xy)).max() < 0.2


def test_where_nothing_is_known():
    assert terrain_of([]) is None
    assert terrain_of([np.zeros((0, 3))]) is None
    assert terrain_of([np.zeros((3, 3))]) is None
    two = np.array([[0.5, 0.5, 1.0]] * 4 + [[40.5, 0.5, 3.0]] * 4)
    terrain = terrain_of([two])
    np.testing.assert_allclose(terrain.at([[0.5, 0.5], [40.5, 0.5]]), [1.0, 3.0])
    assert np.isnan(terrain.at([20.5, 0.5]))
    assert terrain_of([two], wide=8000.0).square == 4.0
