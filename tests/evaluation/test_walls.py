"""Grids against true plans: the measure itself, and a grid made from the true path."""

import numpy as np
import pytest

from odomap.evaluation.walls import compare_walls
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.maps.occupancy import GridConfig, grid_of_map
from odomap.simulation.laserworld import LaserSpec, LaserWorld

WALL = np.column_stack([np.linspace(0, 10, 1001), np.zeros(1001)])


def cells_along(x, y):
    return np.column_stack([x, np.full(len(x), y)])


def test_a_grid_of_all_walls_and_none_else_is_perfect():
    centres = cells_along(np.arange(0.05, 10.1, 0.1), 0.05)
    found = compare_walls(centres, np.abs(centres[:, 1]), WALL, 0.1)
    assert (found.true, found.found) == (1.0, 1.0)
    assert found.cells == found.parts == 101
    assert (found.mean_m, found.worst_m) == pytest.approx((0.05, 0.05))


def test_walls_that_are_none_and_walls_that_are_missed_are_told_apart():
    half = cells_along(np.arange(0.05, 5.0, 0.1), 0.05)
    false = cells_along(np.arange(0.05, 5.0, 0.1), 0.35)
    centres = np.concatenate([half, false])
    found = compare_walls(centres, np.abs(centres[:, 1]), WALL, 0.1)
    assert found.true == 0.5
    assert found.found == pytest.approx(0.5, abs=0.02)
    assert found.worst_m == pytest.approx(0.35)
    assert compare_walls(centres, np.abs(centres[:, 1]), WALL, 0.1, within_cells=4).true == 1.0
    nothing = compare_walls(np.zeros((0, 2)), np.zeros(0), WALL, 0.1)
    assert nothing.found == 0.0
    assert np.isnan(nothing.true)


def test_a_wall_looked_at_for_long_counts_no_more():
    centres = cells_along(np.arange(0.05, 5.0, 0.1), 0.05)
    seen = np.concatenate([WALL, *[WALL[:300]] * 50])
    assert compare_walls(centres, centres[:, 1], seen, 0.1).found == pytest.approx(0.5, abs=0.02)


def test_what_does_not_fit_is_refused():
    one = np.zeros((1, 2))
    for centres, distances, seen in (
        (one, np.zeros(2), one),
        (one, np.zeros(1), np.zeros((0, 2))),
        (one, np.zeros(1), np.zeros((3, 3))),
        (one, np.array([np.nan]), one),
    ):
        with pytest.raises(ValueError, match="cell"):
            compare_walls(centres, distances, seen, 0.1)


def grid_of_truth(world, every, shift=0.0):
    m = Map()
    for index in range(0, len(world), every):
        frame, T = world.frame(index), world.truth.Ts_world_body[index].copy()
        T[0, 3] += shift * (index / len(world))
        m.add_keyframe(Keyframe(m.new_keyframe_id(), frame.stamp_ns, scan=frame.scan), T)
    return grid_of_map(m, world.rig, GridConfig()).grid


def judged(world, grid, every):
    centres = grid.centres(np.argwhere(grid.log_odds > np.log(0.65 / 0.35)))
    near = world.rig.lidars[0].range_m[1]
    seen = [world.hits(k) for k in range(0, len(world), every)]
    places = world.truth.Ts_world_body[::every, :2, 3]
    reach = min(near, 19.0)
    kept = [p[np.linalg.norm(p - at, axis=1) < reach] for p, at in zip(seen, places)]
    return compare_walls(
        centres, world.plan.distances(centres), np.concatenate(kept), grid.resolution
    )


@pytest.mark.parametrize("kind", ["building", "hall"])
@pytest.mark.parametrize("seed", range(5))
def test_a_grid_made_from_the_true_path_shows_the_plan(kind, seed):
    world = LaserWorld(LaserSpec(kind, seed))
    found = judged(world, grid_of_truth(world, 5), 5)
    # Noise of 1 cm marks cells behind a wall that lies near a border; a hall has few other cells.
    assert found.true > (0.97 if kind == "building" else 0.92)
    assert found.found > 0.95
    assert found.mean_m < 0.03


def test_a_path_that_drifts_makes_a_grid_that_does_not():
    world = LaserWorld(LaserSpec("building", 0))
    assert judged(world, grid_of_truth(world, 10, shift=1.0), 10).true < 0.8
