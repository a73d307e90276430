"""Plans: what rays meet is where the walls are, and grids and distances agree with them."""

import numpy as np
import pytest

from odomap.simulation.floorplan import PLANS, Plan, make_plan
from odomap.simulation.plancast import cast_plan


def square() -> Plan:
    walls = np.array([[-2, -1, 2, -1], [2, -1, 2, 1], [2, 1, -2, 1], [-2, 1, -2, -1]], float)
    return Plan(walls, np.array([[1.0, 0.0, 0.25]]), np.zeros((0, 3)))


def test_rays_meet_walls_and_pillars() -> None:
    plan = square()
    angles = np.radians([0, 90, 180, 225, -90])
    rays = np.column_stack([np.cos(angles), np.sin(angles)])
    ranges, cosines = cast_plan(plan.walls, plan.pillars, np.zeros(2), rays, 30.0)
    np.testing.assert_allclose(ranges, [0.75, 1, 2, np.sqrt(2), 1], atol=1e-12)
    np.testing.assert_allclose(cosines, [1, 1, 1, np.sqrt(0.5), 1], atol=1e-12)
    short, _ = cast_plan(plan.walls, plan.pillars, np.zeros(2), rays, 1.2)
    assert np.isinf(short).tolist() == [False, False, True, True, False]
    nothing, _ = cast_plan(np.zeros((0, 4)), np.zeros((0, 3)), np.zeros(2), rays, 30.0)
    assert np.isinf(nothing).all()


@pytest.mark.parametrize("kind", ["building", "hall", "corridor"])
def test_hits_lie_on_the_plan_and_in_its_grid(kind: str) -> None:
    plan = make_plan(kind, 3)
    angles = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    rays = np.column_stack([np.cos(angles), np.sin(angles)])
    grid, corner = plan.occupied(0.05)
    for place in plan.way[::20, :2]:
        ranges, cosines = cast_plan(plan.walls, plan.pillars, place, rays, 200.0)
        assert np.isfinite(ranges).all()
        assert ((cosines >= 0) & (cosines <= 1 + 1e-12)).all()
        hits = place + ranges[:, None] * rays
        assert plan.distances(hits).max() < 1e-9
        # A hit is in an occupied cell, or its rounding in the next one.
        column, row = np.floor((hits - corner) / 0.05).astype(int).T
        near = [grid[row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]
        assert np.any(near, axis=0).all()
    rows, columns = np.nonzero(grid)
    centres = corner + 0.05 * (np.column_stack([columns, rows]) + 0.5)
    assert plan.distances(centres).max() <= 0.05 * np.sqrt(0.5) + 1e-9


@pytest.mark.parametrize("kind", list(PLANS))
@pytest.mark.parametrize("seed", range(5))
def test_ways_are_free_and_plans_differ(kind: str, seed: int) -> None:
    plan = make_plan(kind, seed)
    assert plan.distances(plan.way[:, :2]).min() > 0.5
    other = make_plan(kind, seed + 5)
    assert not np.array_equal(plan.way, other.way) or not np.array_equal(plan.walls, other.walls)
    again = make_plan(kind, seed)
    np.testing.assert_array_equal(plan.walls, again.walls)
