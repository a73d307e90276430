"""Cells say how their points are spread, and sums over them are slopes of the score."""

import numpy as np
import pytest

from odomap.geometry.lie import so3_exp
from odomap.lidar import ndt
from odomap.lidar.icp import SLOTS
from odomap.lidar.ndt import NEGLIGIBLE, THINNEST, add_cells, distributions, outlier_constant


@pytest.fixture(scope="module")
def cells():
    rng = np.random.default_rng(0)
    points = np.vstack([rng.uniform(-2, 2, (2000, 3)) * [1, 1, 0.02], [[3.5, 3.5, 0.0]] * 3])
    return points, distributions(points, 1.0, False)


def matrix(six):
    M = np.zeros((3, 3))
    M[np.triu_indices(3)] = six
    return M + np.triu(M, 1).T


def test_distributions_are_of_the_points_in_each_cell(cells):
    points, found = cells
    for mean, six in zip(found.means, found.metrics, strict=True):
        inside = points[np.all(np.floor(points) == np.floor(mean), axis=1)]
        np.testing.assert_allclose(mean, inside.mean(axis=0), atol=1e-12)
        if len(inside) < ndt.FEWEST:
            assert not six.any()
            continue
        values, axes = np.linalg.eigh(np.cov(inside.T, bias=True))
        values = np.maximum(values, THINNEST * values[2])
        np.testing.assert_allclose(matrix(six), axes / values @ axes.T, rtol=1e-6, atol=1e-6)


def test_sums_are_slopes_of_the_score(cells):
    points, found = cells
    p, t, d2 = points[7] * 0.9, np.array([0.05, -0.02, 0.03]), outlier_constant()

    def score(xi):
        x = so3_exp(xi[3:]) @ p + t + xi[:3]
        total, base = 0.0, np.floor(p + t)
        for mean, six in zip(found.means, found.metrics, strict=True):
            if six.any() and np.abs(np.floor(mean) - base).sum() <= 1:
                w = np.exp(-0.5 * d2 * (mean - x) @ matrix(six) @ (mean - x))
                total -= w if w >= NEGLIGIBLE else 0.0
        return total / d2

    out = np.zeros(SLOTS)
    row, square = add_cells(
        *p, *t, found.means, found.metrics, found.table, found.size, d2, out
    )  # fmt: skip
    slope = [(score(d) - score(-d)) / 2e-6 for d in 1e-6 * np.eye(6)]
    np.testing.assert_allclose(-out[21:27], slope, rtol=1e-4, atol=1e-4)
    e = found.means[row] - p - t
    assert square == pytest.approx(e @ matrix(found.metrics[row]) @ e)


def test_far_from_all_cells_nothing_is_added(cells):
    _, found = cells
    out = np.zeros(SLOTS)
    rest = found.means, found.metrics, found.table, found.size, outlier_constant(), out
    assert add_cells(50.0, 0.0, 0.0, 0.0, 0.0, 0.0, *rest)[0] == -1
    assert not out.any()


def test_warm_up_compiles_all():
    ndt.warm_up()
    assert add_cells.signatures
