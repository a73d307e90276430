"""Alignment of two cameras: exact without noise, honest with it, and not misled by wrong pairs."""

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.geometry import alignransac_kernels as kernels
from odomap.geometry import horn_kernels
from odomap.geometry.align import umeyama
from odomap.geometry.alignransac import PairSights, refine_alignment, solve_alignment
from odomap.geometry.horn_kernels import horn_into
from odomap.geometry.lie import sim3_exp, sim3_inverse, sim3_log

GATE = 2 * 9.21


def scene(
    seed=0, n=120, scale=1.0, sigma=1 / 450, wrong=0.0, depth=0.0, told_twice=True, flat=False
):
    """Return the similarity, what two cameras know and see, and which pairs are wrong.

    With `told_twice` points are where the pixels say they are, so that errors are shared; else they
    are known exactly.
    """
    rng = np.random.default_rng(seed)
    S = sim3_exp([*(0.3 * rng.normal(size=3)), *(0.1 * rng.normal(size=3)), np.log(scale)])
    z = np.full(n, 6.0) if flat else rng.uniform(4, 10, n)
    q = np.c_[rng.uniform(-0.6, 0.6, (n, 2)) * z[:, None], z]
    inverse = sim3_inverse(S)
    p = q @ inverse[:3, :3].T + inverse[:3, 3]
    x = p[:, :2] / p[:, 2:] + sigma * rng.normal(size=(n, 2))
    y = q[:, :2] / q[:, 2:] + sigma * rng.normal(size=(n, 2))
    if told_twice:
        p = np.c_[x, np.ones(n)] * p[:, 2:] * (1 + depth * rng.normal(size=(n, 1)))
        q = np.c_[y, np.ones(n)] * q[:, 2:] * (1 + depth * rng.normal(size=(n, 1)))
    bad = rng.permutation(n) < wrong * n
    row = np.arange(n)
    row[bad] = np.roll(row[bad], 1)
    w = np.full(n, max(sigma, 1e-6) ** -2)
    return S, PairSights(p[row], np.ascontiguousarray(x[row]), w, q, y, w), bad


def error(S, found):
    T = np.array(found.T_second_first)
    T[:3, :3] *= found.scale
    return sim3_log(sim3_inverse(S) @ T)


def aligned(sights, with_scale, seed=0):
    start = solve_alignment(sights, with_scale, seed, 4 * GATE)
    return refine_alignment(sights, start, with_scale, GATE)


@pytest.mark.parametrize("scale", [1.0, 0.4, 3.0])
@pytest.mark.parametrize("flat", [False, True])
def test_exact_without_noise_and_half_the_pairs_wrong(scale, flat):
    for seed in range(5):
        S, sights, bad = scene(seed, scale=scale, sigma=0.0, wrong=0.5, flat=flat)
        found = aligned(sights, scale != 1.0, seed)
        assert found.converged
        np.testing.assert_allclose(error(S, found), 0.0, atol=1e-9)
        np.testing.assert_array_equal(found.inliers, ~bad)


@pytest.mark.parametrize("told_twice", [True, False])
@pytest.mark.parametrize("scale", [1.0, 1.3])
@pytest.mark.parametrize("depth", [0.0, 0.02])
def test_the_covariance_is_that_of_the_error(told_twice, scale, depth):
    d = 6 if scale == 1.0 else 7
    nees = []
    for seed in range(60):
        S, sights, _ = scene(seed, scale=scale, wrong=0.3, depth=depth, told_twice=told_twice)
        found = aligned(sights, scale != 1.0, seed)
        e = error(S, found)[:d]
        nees.append(e @ np.linalg.solve(found.covariance[:d, :d], e) / d)
    # 60 · 6 squares of unit variance have a mean of 1 ± 0.075; doubts may be larger, not smaller.
    assert 0.4 < np.mean(nees) < 1.45


def test_it_is_never_surer_than_the_pixels_allow():
    _, sights, _ = scene(told_twice=False, sigma=1e-9)
    w = np.full(len(sights), 450.0**2)
    sights = PairSights(sights.p, sights.x, w, sights.q, sights.y, w)
    found = aligned(sights, False)
    H, M, g = np.zeros((7, 7)), np.zeros((7, 7)), np.zeros(7)
    R, t = np.array(found.T_second_first[:3, :3], order="C"), found.T_second_first[:3, 3].copy()
    columns = sights.p, sights.x, w, sights.q, sights.y, w, np.zeros(len(w))
    kernels.gather_alignment(R, t, 1.0, *columns, 1e9, False, H, g, M)
    np.testing.assert_allclose(np.linalg.inv(H[:6, :6]), found.covariance[:6, :6], rtol=1e-6)


def test_two_cameras_in_one_place_have_a_scale_all_the_same():
    rng = np.random.default_rng(3)
    n = 150
    z = rng.uniform(4, 10, n)
    q = np.c_[rng.uniform(-0.6, 0.6, (n, 2)) * z[:, None], z]
    S = sim3_exp([0, 0, 0, 0, 0.1, 0, np.log(1.25)])
    inverse = sim3_inverse(S)
    p = (q @ inverse[:3, :3].T) * (1 + 0.03 * rng.normal(size=(n, 1)))
    x = p[:, :2] / p[:, 2:] + rng.normal(size=(n, 2)) / 450
    y = q[:, :2] / q[:, 2:] + rng.normal(size=(n, 2)) / 450
    w = np.full(n, 450.0**2)
    found = aligned(PairSights(p, x, w, q, y, w), True)
    assert found.converged
    assert abs(np.log(found.scale / 1.25)) < 0.01
    assert 0.001 < np.sqrt(found.covariance[6, 6]) < 0.01


def test_what_one_side_alone_knows_counts_too():
    S, sights, _ = scene(sigma=1 / 450, told_twice=False)
    half = np.arange(len(sights)) % 2 == 0
    nowhere = np.full_like(sights.p, np.nan)
    one_way = PairSights(
        *(np.where(half[:, None], sights.p, nowhere), sights.x, np.where(half, 0.0, sights.wx)),
        *(np.where(half[:, None], nowhere, sights.q), sights.y, np.where(half, sights.wy, 0.0)),
    )
    start = solve_alignment(sights, False, 0, GATE)
    both, alone = (refine_alignment(s, start, False, GATE) for s in (sights, one_way))
    assert alone.num_inliers > 0.9 * len(sights)
    assert np.linalg.norm(error(S, alone)[:3]) < 0.02
    assert np.trace(alone.covariance) > np.trace(both.covariance)


@pytest.mark.parametrize("with_scale", [False, True])
def test_derivatives(with_scale):
    S, sights, _ = scene(scale=1.2, sigma=0.01, told_twice=False)
    T = S @ sim3_exp(0.02 * np.random.default_rng(5).normal(size=7))
    scale = np.cbrt(np.linalg.det(T[:3, :3]))
    R, t, d = T[:3, :3] / scale, T[:3, 3].copy(), 7 if with_scale else 6
    wd = np.full(len(sights), 30.0 if with_scale else 0.0)
    columns = sights.p, sights.x, sights.wx, sights.q, sights.y, sights.wy, wd
    H, M, g = np.zeros((7, 7)), np.zeros((7, 7)), np.zeros(7)

    def cost(xi):
        moved = np.zeros(7)
        moved[3:6] = xi[3:6]
        E = sim3_exp(moved)[:3, :3]
        new = np.ascontiguousarray(R @ E), t + R @ xi[:3], scale * np.exp(xi[6])
        return kernels.gather_alignment(*new, *columns, 2.0, with_scale, *three())

    def three():
        return np.zeros((7, 7)), np.zeros(7), np.zeros((7, 7))

    kernels.gather_alignment(np.ascontiguousarray(R), t, scale, *columns, 2.0, with_scale, H, g, M)
    h = 1e-6
    slope = [(cost(h * e) - cost(-h * e)) / (4 * h) for e in np.eye(7)[:d]]
    np.testing.assert_allclose(g[:d], slope, rtol=1e-5, atol=1e-5 * np.abs(g).max())
    np.testing.assert_allclose(H, H.T)
    np.testing.assert_allclose(M[:d, :d], np.asarray(M[:d, :d]).T, rtol=1e-12)


def test_horn_agrees_with_umeyama():
    rng = np.random.default_rng(2)
    for n in (3, 4, 50):
        p, q = rng.normal(size=(2, n, 3))
        R, t, A, V = np.empty((3, 3)), np.empty(3), np.empty((4, 4)), np.empty((4, 4))
        assert horn_into(p, q, np.arange(n), False, R, t, A, V) == 1.0
        expected = umeyama(p, q)
        np.testing.assert_allclose(R, expected.matrix[:3, :3], atol=1e-9)
        np.testing.assert_allclose(t, expected.matrix[:3, 3], atol=1e-9)


def test_points_on_a_line_or_in_one_place_give_nothing():
    R, t, A, V = np.empty((3, 3)), np.empty(3), np.empty((4, 4)), np.empty((4, 4))
    line = np.array([0, 0, 5.0]) + np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    for points in (line, np.ones((5, 3))):
        assert horn_into(points, points, np.arange(5), True, R, t, A, V) == 0.0
    x, w = line[:, :2] / line[:, 2:], np.ones(5)
    found = solve_alignment(PairSights(line, x, w, line, x, w), True, 0)
    assert not found.converged
    assert found.num_inliers == 0
    assert np.isinf(found.covariance).all()


@pytest.mark.parametrize("n", [0, 2, 3])
def test_too_few(n):
    _, sights, _ = scene()
    few = sights.at(np.arange(n))
    start = solve_alignment(few, False, 0)
    assert not start.converged
    refined = refine_alignment(few, start, False)
    assert not refined.converged
    assert np.isfinite(refined.T_second_first).all()


def test_the_same_seed_gives_the_same_bytes():
    _, sights, _ = scene(wrong=0.5)
    one, two = (aligned(sights, True, 7) for _ in range(2))
    assert one.T_second_first.tobytes() == two.T_second_first.tobytes()
    assert one.covariance.tobytes() == two.covariance.tobytes()


def test_what_cannot_be_is_refused():
    _, s, _ = scene()
    with pytest.raises(InputError, match="shapes"):
        solve_alignment(PairSights(s.p[:-1], s.x, s.wx, s.q, s.y, s.wy), False, 0)
    with pytest.raises(InputError, match="wx"):
        solve_alignment(PairSights(s.p, s.x, s.wx, s.q * np.nan, s.y, s.wy), False, 0)
    with pytest.raises(InputError, match="confidence"):
        solve_alignment(s, False, 0, confidence=1.0)


def test_warm_up_calls_every_kernel():
    for module in (horn_kernels, kernels):
        module.warm_up()
        for name in module.__all__:
            kernel = getattr(module, name)
            if hasattr(kernel, "signatures"):
                assert len(kernel.signatures) >= 1, f"{name} is not called"
