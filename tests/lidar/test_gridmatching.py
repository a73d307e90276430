"""Matching scans to grids: exactness, information against scatter, corridors, searches."""

import numpy as np
import pytest

from lidar.rooms import CORRIDOR, ROOM, cast
from odomap.lidar.branchbound import GridPyramid
from odomap.lidar.grid import OccupancyGrid
from odomap.lidar.gridmatching import match_to_grid
from odomap.lidar.scans import Beams
from odomap.sensors.rig import LidarMount

ANGLES = (-2.3, 2.3, 361)
BEAMS = Beams(LidarMount("laser", range_m=(0.1, 30.0), angles=ANGLES))
DIRECTIONS = np.linspace(*ANGLES)


def scan(walls, x, rng=None):
    return BEAMS.points(cast(walls, x, DIRECTIONS, rng))


def surface(walls, x, rng):
    seen = scan(walls, x, rng)
    return seen.hits, seen.normals


def moved(x, points):
    c, s = np.cos(x[2]), np.sin(x[2])
    return points @ np.array([[c, s], [-s, c]]) + x[:2]


def mapped(walls, poses, rng):
    """Return a grid of scans from known poses."""
    grid = OccupancyGrid(0.05)
    for x in poses:
        seen = scan(walls, x, rng)
        sensor = moved(x, seen.origin[None])[0]
        grid.insert(sensor, moved(x, seen.hits), between=moved(x, seen.between))
    return grid


@pytest.fixture(scope="module")
def room():
    rng = np.random.default_rng(0)
    poses = [(x, 0.3 * np.sin(5 * x), x) for x in np.linspace(-1.5, 1.5, 20)]
    return mapped(ROOM, poses, rng)


@pytest.fixture(scope="module")
def corridor():
    rng = np.random.default_rng(0)
    poses = [(x, 0.1 * np.sin(5 * x), 0.05 * np.cos(x)) for x in np.linspace(-3, 3, 25)]
    return mapped(CORRIDOR, poses, rng)


def off(found, true):
    d = np.asarray(found) - true
    return np.hypot(*d[:2]), abs((d[2] + np.pi) % (2 * np.pi) - np.pi)


@pytest.mark.parametrize("seed", range(8))
def test_a_scan_is_laid_where_it_was_taken(room, seed):
    rng = np.random.default_rng(seed)
    true = np.array([*rng.uniform(-1, 1, 2), rng.uniform(-3, 3)])
    guess = true + np.array([*rng.uniform(-0.08, 0.08, 2), rng.uniform(-0.05, 0.05)])
    found = match_to_grid(room, *surface(ROOM, true, rng), guess)
    metres, radians = off(found.x_grid_body, true)
    assert metres < 0.025  # half a cell: a wall may be anywhere in its cells
    assert radians < 0.005
    assert found.on_walls > 0.9
    assert 0.5 < found.score <= 1.1


def test_errors_are_as_large_as_the_information_says(room):
    rng, chi2 = np.random.default_rng(5), []
    for _ in range(150):
        true = np.array([*rng.uniform(-1, 1, 2), rng.uniform(-3, 3)])
        found = match_to_grid(room, *surface(ROOM, true, rng), true)
        c, s = np.cos(true[2]), np.sin(true[2])
        d = found.x_grid_body - true
        error = np.array([c * d[0] + s * d[1], -s * d[0] + c * d[1], d[2]])
        chi2.append(error @ found.information @ error / 3)
    assert 0.3 < np.mean(chi2) < 2.0


def test_a_corridor_says_nothing_of_its_length_and_the_prediction_decides(corridor):
    rng = np.random.default_rng(1)
    true = np.array([0.2, 0.1, 0.1])
    seen = surface(CORRIDOR, true, rng)
    guess = true + np.array([0.3, 0.05, 0.02])
    strong = np.diag([1 / 0.05**2, 1 / 0.1**2, 1 / 0.1**2])
    found = match_to_grid(corridor, *seen, guess, strong)
    assert abs(found.x_grid_body[1] - true[1]) < 0.025
    assert abs(found.x_grid_body[0] - guess[0]) < 0.1
    along, across = found.information[0, 0], found.information[1, 1]
    assert along < 0.1 * across


def test_turning_the_body_turns_its_information_with_it(room):
    rng = np.random.default_rng(2)
    true = np.array([0.3, -0.2, 0.4])
    points, normals = surface(ROOM, true, rng)
    found = match_to_grid(room, points, normals, true)
    turn = 0.9
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s], [s, c]])
    turned = match_to_grid(room, points @ R, normals @ R, true + np.array([0, 0, turn]))
    B = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    np.testing.assert_allclose(B @ turned.information @ B.T, found.information, rtol=0.02, atol=50)


def test_far_from_everything_nothing_is_said(room):
    found = match_to_grid(room, np.eye(2), np.zeros((2, 2)), np.array([100.0, 0, 0]))
    np.testing.assert_array_equal(found.x_grid_body, [100.0, 0, 0])
    assert not found.information.any()
    assert found.score == found.on_walls == 0.0


def everything(pyramid, points, middle, reach, turn):
    """Return the best total by trying all poses."""
    step = pyramid.resolution / np.linalg.norm(points, axis=1).max()
    count, cells = int(np.ceil(turn / step)), int(np.ceil(reach / pyramid.resolution))
    level, best = np.array([0, 128, 0, 255])[pyramid._cells & 3], -1
    for heading in middle[2] + step * np.arange(-count, count + 1):
        at = moved((*middle[:2], heading), points) - pyramid._origin
        column, row = np.floor(at / pyramid.resolution).astype(int).T
        for dy in range(-cells, cells + 1):
            for dx in range(-cells, cells + 1):
                x, y = column + dx, row + dy
                inside = (x >= 0) & (y >= 0) & (x < level.shape[1]) & (y < level.shape[0])
                best = max(best, int(level[y[inside], x[inside]].astype(int).sum()))
    return best / (255 * len(points))


def test_a_level_of_a_pyramid_has_the_best_of_squares_of_the_one_below(room):
    top = 7
    bits = GridPyramid(room, top)._cells
    below = bits & 3
    assert set(np.unique(below).tolist()) == {0, 1, 3}
    for h in range(top):
        padded = np.pad(below, (0, 1 << h))
        corners = padded[:, : below.shape[1]], padded[:, 1 << h :]
        expected = np.maximum(*corners)
        expected = np.maximum(expected[: below.shape[0]], expected[1 << h :])
        below = bits >> (2 * h + 2) & 3
        np.testing.assert_array_equal(below, expected)
    with pytest.raises(ValueError, match=r"squares of 2\^8 cells: 2\^7 at most"):
        GridPyramid(room, 8)


@pytest.mark.parametrize("seed", range(3))
def test_the_search_finds_what_trying_everything_finds(room, seed):
    rng = np.random.default_rng(seed)
    true = np.array([*rng.uniform(-1, 1, 2), rng.uniform(-3, 3)])
    points = scan(ROOM, true, rng).hits[::6]
    middle = true + np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(-0.1, 0.1)])
    pyramid = GridPyramid(room, levels=4)
    found = pyramid.search(points, middle, 0.4, 0.15, 0.1)
    assert found.score == pytest.approx(everything(pyramid, points, middle, 0.4, 0.15))


@pytest.mark.parametrize("seed", range(4))
def test_a_scan_is_found_from_metres_off_and_in_any_direction(room, seed):
    rng = np.random.default_rng(seed)
    true = np.array([*rng.uniform(-1, 1, 2), rng.uniform(-3, 3)])
    points, normals = surface(ROOM, true, rng)
    middle = true + np.array([*rng.uniform(-2, 2, 2), rng.uniform(-3, 3)])
    found = GridPyramid(room).search(points, middle, 3.0, np.pi, 0.4)
    exact = match_to_grid(room, points, normals, found.x_grid_body)
    metres, radians = off(exact.x_grid_body, true)
    assert metres < 0.025  # half a cell: a wall may be anywhere in its cells
    assert radians < 0.005


def test_nothing_is_found_where_nothing_is_good_enough(room):
    rng = np.random.default_rng(3)
    points = rng.uniform(-3, 3, (100, 2))
    assert GridPyramid(room).search(points, np.zeros(3), 1.0, 0.5, 0.5) is None
