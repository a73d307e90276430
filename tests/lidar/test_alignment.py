"""The sums of the loop against formulas written down plainly, slopes against differences."""

import numpy as np
import pytest

from odomap.geometry.align import umeyama
from odomap.geometry.lie import so3_exp
from odomap.geometry.robust import Loss
from odomap.lidar import alignment
from odomap.lidar.alignment import GICP, ICP, PLANE, Stage, align, sum_pairs
from odomap.lidar.gicp import EPSILON, disc_metric_into, discs, sure_normals
from odomap.lidar.icp import SLOTS, newton_step, pair_step
from odomap.lidar.neighbours import Grid


def unit(rng, n):
    v = rng.normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


@pytest.fixture
def pairs():
    rng = np.random.default_rng(0)
    p = rng.uniform(-5, 5, (40, 3))
    R, t = so3_exp(np.array([0.02, -0.03, 0.05])), np.array([0.05, 0.02, -0.04])
    q = p @ R.T + t + 0.02 * rng.normal(size=p.shape)
    return p, unit(rng, 40), q, unit(rng, 40)


def summed(method, p, m, q, n, R, t):
    grid = Grid.of(q, 1.0)
    out, rows, squares = np.empty(SLOTS), np.empty(len(p), np.int64), np.zeros(len(p))
    sum_pairs(
        0, len(p), 1, method, p, m, R, t, grid.points, n[grid.order], grid.start, grid.stop,
        grid.table, 1.0, 1.0, 0, 1.0, 0.0, rows, squares, out,
    )  # fmt: skip
    return out, grid.order[rows], squares


def metric(method, n, m):
    """M of one pair, by its definition."""
    if method == PLANE:
        return np.outer(n, n)
    disc = lambda v: np.eye(3) - np.outer(v, v)  # noqa: E731 (scaled normals: 1 - ε is in them)
    return np.linalg.inv(disc(n) + disc(m))


@pytest.mark.parametrize("method", [PLANE, GICP])
def test_sums_are_those_of_differences(pairs, method):
    p, m, q, n = pairs
    if method == GICP:
        m, n = m * np.sqrt(1 - EPSILON), n * np.sqrt(1 - EPSILON)
    R, t = so3_exp(np.array([0.01, 0.0, 0.02])), np.zeros(3)
    out, rows, squares = summed(method, p, m, q, n, R, t)
    assert np.array_equal(rows, np.arange(len(p)))
    H, g = np.zeros((6, 6)), np.zeros(6)
    for i in range(len(p)):
        M = metric(method, n[i], R @ m[i])

        def e(xi, i=i):
            return q[i] - so3_exp(xi[3:]) @ R @ p[i] - t - xi[:3]

        J = -np.stack([(e(d) - e(-d)) / 2e-6 for d in 1e-6 * np.eye(6)], axis=1)
        H, g = H + J.T @ M @ J, g + J.T @ M @ e(np.zeros(6))
        assert squares[i] == pytest.approx(e(np.zeros(6)) @ M @ e(np.zeros(6)), rel=1e-6)
    np.testing.assert_allclose(out[:21], H[np.triu_indices(6)], rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(out[21:27], g, rtol=1e-5, atol=1e-4)
    R_new, t_new, xi = R.copy(), t.copy(), np.empty(6)
    assert newton_step(out, False, R_new, t_new, np.empty((6, 6)), xi)
    np.testing.assert_allclose(xi, np.linalg.solve(H, g), rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(R_new, so3_exp(xi[3:]) @ R, atol=1e-9)


def test_the_closed_form_is_that_of_the_singular_value_decomposition(pairs):
    p, m, q, n = pairs
    out, _, _ = summed(ICP, p, m, q, n, np.eye(3), np.zeros(3))
    R, t = np.eye(3), np.zeros(3)
    assert pair_step(out, False, R, t, np.empty(6))
    expected = umeyama(p, q)
    np.testing.assert_allclose(R, expected.R, atol=1e-9)
    np.testing.assert_allclose(t, expected.t, atol=1e-9)


def test_discs_have_the_closed_inverse():
    rng = np.random.default_rng(1)
    for n, m in zip(unit(rng, 20), unit(rng, 20), strict=True):
        for a, b in ((n * 0.9995, m * 0.9995), (n * 0.5, m * 0.9), (n, 0 * m), (0 * n, 0 * m)):
            M = np.empty(6)
            disc_metric_into(*a, *b, M)
            expected = np.linalg.inv(2 * np.eye(3) - np.outer(a, a) - np.outer(b, b))
            np.testing.assert_allclose(M, expected[np.triu_indices(3)], atol=1e-9)


def test_discs_are_thick_where_points_are_scattered_or_few():
    spreads = np.array([[1e9, 0.0, 1, 1], [1e9, 0.04, 1, 1], [1e9, 50.0, 60, 70], [0, 0, 0, 0]])
    lengths = np.linalg.norm(discs(np.tile([0.0, 0, 1], (4, 1)), spreads, 0.4), axis=1)
    np.testing.assert_allclose(lengths[:3] ** 2, [1 - EPSILON, 0.75, 0.0], atol=1e-5)
    few = np.array([[5, 0.0, 1.0, 1.0], [500, 0.008, 1.0, 1.0]])  # flat by chance
    lengths = np.linalg.norm(discs(np.tile([0.0, 0, 1], (2, 1)), few, 0.4), axis=1)
    np.testing.assert_allclose(lengths**2, [1 - 0.05, 1 - 0.0505], atol=1e-9)


def test_normals_count_for_planes_as_their_discs_do():
    n = np.tile([0.0, 0.0, 1.0], (3, 1))
    lengths = np.linalg.norm(sure_normals(n, n * np.sqrt([[1 - EPSILON], [0.9], [0.0]])), axis=1)
    np.testing.assert_allclose(lengths**2, [1.0, EPSILON / 0.1, EPSILON])


def test_the_median_that_scales_a_loss():
    rng = np.random.default_rng(2)
    squares = rng.normal(size=999) ** 2
    rows = np.where(np.arange(999) % 7 == 0, -1, 0)
    found = alignment._median(1, rows, squares)
    assert found == pytest.approx(np.median(squares[rows >= 0]), rel=0.02)
    assert alignment._median(1, rows, np.zeros(999)) == 0.0


def test_two_threads_take_the_same_steps():
    rng = np.random.default_rng(3)
    p = rng.uniform(-5, 5, (5000, 3)) * [1, 1, 0]
    q = p + np.array([0.03, 0.01, 0.05])
    n = np.tile([0.0, 0.0, 0.9995], (5000, 1))
    grid = Grid.of(q, 0.3)
    found = [
        align(
            GICP, False, [Stage(1, 0.5, 20, 1e-6)], (p, n), (grid, n[grid.order]), np.eye(3),
            np.zeros(3), Loss("huber"), threads,
        )
        for threads in (1, 2, 3)
    ]  # fmt: skip
    assert len({a.R.tobytes() + a.t.tobytes() for a in found}) == 1
    assert found[0].t[2] == pytest.approx(0.05, abs=1e-6)


def test_warm_up_compiles_all():
    alignment.warm_up()
    assert sum_pairs.signatures
