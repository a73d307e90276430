"""Occupancy grids: evidence of rays, growth, what is unknown."""

import numpy as np
import pytest

from odomap.lidar.grid import Evidence, OccupancyGrid


def cells_on_the_way(start, end, resolution):
    """Return the cells that a line passes, by many small steps."""
    t = np.linspace(0.0, 1.0, 20001)[:, None]
    cells = np.floor((start + t * (end - start)) / resolution).astype(int)
    return {tuple(c) for c in cells}


def known(grid):
    """Return cells and their log-odds, cells counted from where x and y are 0."""
    rows, columns = np.nonzero(grid.is_known)
    shift = np.round(grid.origin / grid.resolution).astype(int)
    return {
        (int(x + shift[0]), int(y + shift[1])): float(grid.log_odds[y, x])
        for y, x in zip(rows, columns)
    }


@pytest.mark.parametrize("seed", range(20))
def test_a_ray_speaks_against_the_cells_on_its_way_and_for_the_last(seed):
    rng = np.random.default_rng(seed)
    start, end = rng.uniform(-3, 3, 2), rng.uniform(-3, 3, 2)
    grid = OccupancyGrid(0.05)
    grid.insert(start, end[None])
    last = tuple(np.floor(end / 0.05).astype(int))
    found = known(grid)
    assert found.pop(last) == pytest.approx(0.9)
    wanted = cells_on_the_way(start, end, 0.05) - {last}
    assert all(value == pytest.approx(-0.3) for value in found.values())
    # Steps may miss a corner that is cut by less than they are long.
    assert wanted <= set(found)
    assert len(found) <= len(wanted) + 2


def test_evidence_adds_up_and_is_limited():
    grid = OccupancyGrid(0.1, Evidence(hit=1.0, miss=0.5, limit=2.5))
    point = np.array([[1.05, 0.05]])
    for count in range(1, 6):
        grid.insert(np.array([0.05, 0.05]), point)
        values = known(grid)
        assert values[10, 0] == pytest.approx(min(count, 2.5))
        assert values[5, 0] == pytest.approx(max(-0.5 * count, -2.5))
    p = grid.probability(np.array([[1.05, 0.05], [0.55, 0.05], [9.0, 9.0], [0.05, 0.15]]))
    np.testing.assert_allclose(p, [1 / (1 + np.exp(-2.5)), 1 / (1 + np.exp(2.5)), 0.5, 0.5])


def test_a_scan_speaks_once_of_a_cell_and_a_hit_outweighs_what_passes():
    grid = OccupancyGrid(0.1)
    # Five beams end in one cell, and two go through it to one behind.
    hits = np.array([[1.01, 0.05], [1.05, 0.05], [1.09, 0.05], [1.05, 0.01], [1.05, 0.09]])
    behind = np.array([[2.05, 0.05], [2.05, 0.06]])
    grid.insert(np.array([0.05, 0.05]), np.concatenate([behind, hits]))
    values = known(grid)
    assert values[10, 0] == pytest.approx(0.9)
    assert values[5, 0] == pytest.approx(-0.3)


def test_free_rays_and_points_between_say_one_half_each():
    grid = OccupancyGrid(0.1)
    grid.insert(
        np.array([0.05, 0.05]),
        np.zeros((0, 2)),
        between=np.array([[0.05, 3.05]]),
        free=np.array([[3.05, 0.05]]),
    )
    values = known(grid)
    assert values[0, 30] == pytest.approx(0.9)
    assert (0, 15) not in values  # no beam went there
    assert values[15, 0] == pytest.approx(-0.3)
    assert (30, 0) not in values


def test_a_cell_for_and_against_which_as_much_speaks_stays_known():
    grid = OccupancyGrid(0.1, Evidence(hit=0.5, miss=0.5))
    grid.insert(np.array([0.05, 0.05]), np.array([[1.05, 0.05]]))
    grid.insert(np.array([0.05, 0.05]), np.array([[2.05, 0.05]]))
    assert (10, 0) in known(grid)
    assert known(grid)[10, 0] == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_a_grid_that_grows_is_the_one_that_was_large_at_once(seed):
    rng = np.random.default_rng(seed)
    scans = [(rng.uniform(-20, 20, 2), rng.uniform(-30, 30, (40, 2))) for _ in range(6)]
    small, large = OccupancyGrid(0.1), OccupancyGrid(0.1)
    large.insert(np.zeros(2), np.array([[-40.0, -40.0], [40.0, 40.0]]))
    large = OccupancyGrid.of(np.zeros_like(large.log_odds), large.origin, 0.1)
    for sensor, hits in scans:
        small.insert(sensor, hits)
        large.insert(sensor, hits)
    assert known(small)
    assert known(small) == known(large)
    cropped = small.cropped()
    assert known(cropped) == known(small)
    assert cropped.is_known[0].any()
    assert cropped.is_known[:, -1].any()


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="must be positive"):
        OccupancyGrid(0.0)
    grid = OccupancyGrid(0.05)
    with pytest.raises(ValueError, match="not finite"):
        grid.insert(np.zeros(2), np.array([[np.nan, 0.0]]))
    with pytest.raises(ValueError, match="far from others"):
        grid.insert(np.zeros(2), np.array([[1e6, 1e6]]))
    assert not grid.is_known.any()


def test_an_empty_scan_changes_nothing():
    grid = OccupancyGrid(0.05)
    grid.insert(np.zeros(2), np.zeros((0, 2)))
    assert not grid.is_known.any()
    assert grid.cropped().log_odds.size == 0
