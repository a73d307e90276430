"""Heights above a ground that nobody has labelled."""

import numpy as np
import pytest

from odomap.views.ground import above_ground


def hill(rng, count, slope):
    """Return ground that rises, and poles on it of heights that are known."""
    xy = rng.uniform(-60, 60, (count, 2))
    heights = np.where(np.arange(count) % 4, 0.0, rng.uniform(0.5, 5.0, count))
    z = slope * xy[:, 0] + 30.0 + heights
    return np.c_[xy, z], heights


@pytest.mark.parametrize("slope", [0.0, 0.05])
def test_heights_are_those_above_the_ground_around(slope):
    points, heights = hill(np.random.default_rng(3), 20_000, slope)
    found = above_ground(points)
    assert np.abs(found - heights).max() < 8.0 * slope + 1e-9


def test_few_points_below_the_ground_do_not_lower_it():
    rng = np.random.default_rng(4)
    points, heights = hill(rng, 20_000, 0.0)
    below = rng.permutation(len(points))[:100]
    points[below, 2] -= 6.0
    found = above_ground(points)
    rest = np.setdiff1d(np.arange(len(points)), below)
    assert (np.abs(found - heights)[rest] < 1e-9).mean() > 0.99


def test_their_order_is_that_of_the_points():
    points, _ = hill(np.random.default_rng(5), 3000, 0.02)
    turn = np.random.default_rng(6).permutation(len(points))
    np.testing.assert_array_equal(above_ground(points[turn]), above_ground(points)[turn])


def test_no_points_have_no_heights():
    assert len(above_ground(np.zeros((0, 3)))) == 0
