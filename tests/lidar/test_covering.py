"""What one cloud shows is covered where others have points nearby."""

import numpy as np
import pytest

from odomap.lidar.covering import covered_share


def plain(points, others, voxel):
    cells = {tuple(v) for v in np.floor(points / voxel).astype(int)}
    known = {tuple(v) for v in np.floor(others / voxel).astype(int)}
    around = [(a, b, c) for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1)]
    count = sum(any(tuple(np.add(v, d)) in known for d in around) for v in cells)
    return count / len(cells)


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_it_is_what_the_formula_says(seed):
    rng = np.random.default_rng(seed)
    points, others = rng.uniform(-6, 6, (400, 3)), rng.uniform(-6, 6, (120 * (seed + 1), 3))
    found = covered_share(points, others, 0.7)
    assert found == pytest.approx(plain(points, others, 0.7))
    assert 0.0 < found < 1.0


def test_a_cloud_covers_itself_and_nothing_covers_nothing():
    points = np.random.default_rng(5).normal(size=(200, 3))
    assert covered_share(points, points, 0.3) == 1.0
    assert covered_share(points, points + 50.0, 0.3) == 0.0
    assert covered_share(points, np.zeros((0, 3)), 0.3) == 0.0
    assert covered_share(np.zeros((0, 3)), points, 0.3) == 1.0
