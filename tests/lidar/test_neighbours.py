"""Nearest neighbours are the nearest, wherever points and queries lie."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from odomap.errors import InputError
from odomap.lidar import neighbours
from odomap.lidar.neighbours import Grid, k_nearest, nearest, nearest_kernel


def brute(queries, points, k):
    d = np.linalg.norm(queries[:, None] - points[None], axis=2)
    return np.sort(d, axis=1)[:, :k]


def cloud(kind, rng, n=300):
    if kind == "surface":
        return np.column_stack([rng.uniform(-5, 5, (n, 2)), 0.01 * rng.normal(size=n)])
    if kind == "clusters":
        return rng.normal(size=(n, 3)) * 0.01 + 100.0 * rng.integers(0, 3, (n, 3))
    if kind == "line":
        return np.outer(rng.uniform(-50, 50, n), [1.0, 0.2, 0.0])
    if kind == "one place":
        return np.tile([3.0, -2.0, 1.0], (n, 1))
    return rng.normal(size=(n, 3)) + np.array([5e6, -4e5, 100.0])


@pytest.mark.parametrize("kind", ["surface", "clusters", "line", "one place", "far away"])
@pytest.mark.parametrize("k", [1, 5, 10])
def test_k_nearest_are_those_of_brute_force(kind, k):
    rng = np.random.default_rng(3)
    points = cloud(kind, rng)
    queries = np.vstack([points[:50], points[:50] + rng.normal(size=(50, 3)), points[:5] + 1e4])
    rows, distances = k_nearest(queries, points, k)
    np.testing.assert_allclose(distances, brute(queries, points, k), rtol=1e-9, atol=1e-9)
    again = np.linalg.norm(points[rows] - queries[:, None], axis=2)
    np.testing.assert_allclose(again, distances, rtol=1e-9, atol=1e-9)
    assert all(len(set(row)) == k for row in rows.tolist())


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 1 << 20), size=st.floats(0.3, 20.0), limit=st.floats(0.01, 30.0))
def test_nearest_within_reach_whatever_the_cells(seed, size, limit):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-8, 8, (80, 3)) * [1, 1, rng.integers(0, 2)]
    grid = Grid.of(points, size)
    arrays = grid.points, grid.start, grid.stop, grid.table, size, limit**2
    for query in rng.uniform(-12, 12, (20, 3)):
        d = np.linalg.norm(points - query, axis=1)
        row, square = nearest_kernel(*query, *arrays)
        if d.min() < limit:
            assert square == pytest.approx(d.min() ** 2, rel=1e-12)
            assert np.array_equal(grid.points[row], points[grid.order[row]])
        else:
            assert row == -1


def test_fewer_points_than_asked_for():
    rows, distances = k_nearest(np.zeros((1, 3)), np.eye(3)[:2], 4)
    assert rows[0].tolist()[2:] == [-1, -1]
    assert np.isinf(distances[0, 2:]).all()
    assert k_nearest(np.zeros((2, 3)), np.empty((0, 3)), 2)[0].tolist() == [[-1, -1]] * 2


def test_farther_than_the_limit_is_none():
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    rows, distances = nearest([[0.1, 0, 0], [5.0, 0, 0]], points, 2.0)
    assert rows.tolist() == [0, -1]
    assert distances[0] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("queries", "points", "k", "says"),
    [
        (np.zeros((2, 2)), np.eye(3), 1, "shape"),
        (np.zeros((2, 3)), np.full((2, 3), np.nan), 1, "NaN"),
        (np.zeros((2, 3)), np.eye(3), 0, "more than 0"),
        (np.zeros((2, 3)), "points", 1, "numbers"),
    ],
)
def test_what_cannot_be_is_said(queries, points, k, says):
    with pytest.raises(InputError, match=says):
        k_nearest(queries, points, k)


def test_warm_up_compiles_all():
    neighbours.warm_up()
    assert neighbours.nearest_kernel.signatures
    assert neighbours.k_nearest_kernel.signatures
