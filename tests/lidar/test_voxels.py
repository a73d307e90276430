"""Cells hold the points that lie in them, and their sums are those of the points."""

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.lidar.normals import cell_covariances, nearest_covariances, normals_of
from odomap.lidar.voxels import FURTHEST, axis_of_key, into_cells, key_of, mean_points


def covariance(row):
    C = np.zeros((3, 3))
    C[np.triu_indices(3)] = row[1:7]
    return C + np.triu(C, 1).T


@pytest.mark.parametrize("n", [1, 50, 40_000])
def test_points_share_a_cell_where_they_share_a_box(n):
    rng = np.random.default_rng(1)
    points = rng.uniform(-4, 4, (n, 3))
    cells = into_cells(points, 0.25)
    boxes, same = np.unique(np.floor(points / 0.25), axis=0, return_inverse=True)
    assert len(cells) == len(boxes)
    pairs = np.unique(np.column_stack([cells.cell_of, same.ravel()]), axis=0)
    assert len(pairs) == len(boxes)
    means = np.empty((len(cells), 3))
    mean_points(cells.keys, cells.sums, 0.25, means)
    for cell in range(0, len(cells), max(len(cells) // 20, 1)):
        inside = points[cells.cell_of == cell]
        np.testing.assert_allclose(means[cell], inside.mean(axis=0), atol=1e-12)
        assert cells.sums[cell, 0] == len(inside)
    assert np.array_equal(np.sort(np.unique(cells.cell_of, return_index=True)[1]),
                          np.unique(cells.cell_of, return_index=True)[1])  # fmt: skip


def test_a_place_survives_its_key():
    for place in ([0, 0, 0], [-1, 5, 1 - FURTHEST], [FURTHEST - 1, -FURTHEST, 7]):
        assert [axis_of_key(key_of(*place), axis) for axis in range(3)] == place


def test_cells_too_small_to_be_numbered():
    with pytest.raises(InputError, match="too small"):
        into_cells(np.array([[3e6, 0.0, 0.0]]), 1.0)


def test_covariance_around_a_cell_is_that_of_the_points_in_27():
    rng = np.random.default_rng(4)
    points = rng.uniform(-1, 1, (3000, 3)) * [1, 1, 0.3] + [7.0, -3.0, 2.0]
    cells = into_cells(points, 0.4)
    means = np.empty((len(cells), 3))
    mean_points(cells.keys, cells.sums, 0.4, means)
    spread = cell_covariances(cells, means, 10)
    boxes = np.floor(points / 0.4)
    for cell in range(0, len(cells), 7):
        mine = boxes[cells.cell_of == cell][0]
        around = points[np.all(np.abs(boxes - mine) <= 1, axis=1)]
        assert spread[cell, 0] == len(around)
        np.testing.assert_allclose(
            covariance(spread[cell]), np.cov(around.T, bias=True), atol=1e-12
        )


@pytest.mark.parametrize("far", [0.0, 1e3])
def test_normals_are_eigenvectors(far):
    rng = np.random.default_rng(5)
    points = rng.normal(size=(400, 3)) * [1.0, 0.4, 0.05] + far
    spread = nearest_covariances(points, 12)
    normals, spreads = normals_of(spread, False)
    for row, normal, known in zip(spread, normals, spreads, strict=True):
        values, vectors = np.linalg.eigh(covariance(row))
        np.testing.assert_allclose(known[1:4], values, atol=1e-9 * values[2])
        assert known[0] == 0 or abs(normal @ vectors[:, 0]) == pytest.approx(1.0, abs=1e-6)


def test_a_line_has_no_normal_in_space_but_one_in_the_plane():
    points = np.outer(np.linspace(0, 1, 30), [3.0, 4.0, 0.0])
    spread = nearest_covariances(points, 8)
    assert not normals_of(spread, False)[0].any()
    np.testing.assert_allclose(np.abs(normals_of(spread, True)[0] @ [0.8, -0.6, 0.0]), 1.0)
