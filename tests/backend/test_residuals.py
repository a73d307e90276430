"""Residuals against their definition, Jacobians against differences."""

import numpy as np
import pytest

import reference
from odomap.backend.residuals import (
    huber_cost,
    huber_weight,
    linearize,
    reproject,
)
from odomap.geometry.lie import se3_exp, se3_inverse


def case(seed, depth=None):
    """Return T_world_body, T_camera_body, baseline, point, xy, disparity, weights."""
    rng = np.random.default_rng(seed)
    T_world_body, T_camera_body = se3_exp(rng.normal(0, 0.8, (2, 6)))
    z = rng.uniform(0.5, 8.0) if depth is None else depth
    X = np.append(rng.uniform(-0.6, 0.6, 2) * z, z)
    p = (T_world_body @ se3_inverse(T_camera_body) @ np.append(X, 1.0))[:3]
    xy = X[:2] / z + rng.normal(0, 0.01, 2)
    return T_world_body, T_camera_body, 0.2, p, xy, 0.2 / z + 0.003, rng.uniform(100, 900, 2)


def kernel(T_world_body, T_camera_body, baseline, p, xy, disparity, weights):
    r, J, P = np.full((1, 3), 9.9), np.full((1, 3, 6), 9.9), np.full((1, 3, 3), 9.9)
    parts = [
        np.ascontiguousarray(a)
        for T in (T_world_body, T_camera_body)
        for a in (T[:3, :3], T[:3, 3])
    ]
    again = np.full(3, 9.9)
    seen = reproject(*parts, baseline, p, xy, disparity, weights, again)
    rows, one = np.zeros(1, np.int64), np.array([0, 1])
    many = [*(a[None] for a in parts), np.array([baseline]), p[None], one, rows, rows]
    linearize(*many, xy[None], np.array([disparity]), weights[None], r, J, P)
    np.testing.assert_allclose(again, r[0], rtol=1e-12, atol=1e-12)
    return seen, r[0], J[0], P[0]


@pytest.mark.parametrize("has_disparity", [True, False])
@pytest.mark.parametrize("seed", range(8))
def test_residuals_and_jacobians(seed, has_disparity):
    T, mount, baseline, p, xy, disparity, weights = case(seed)
    disparity = disparity if has_disparity else np.nan
    seen, r, J, P = kernel(T, mount, baseline, p, xy, disparity, weights)
    assert seen
    np.testing.assert_allclose(
        r, reference.residual(T, mount, baseline, p, xy, disparity, weights), rtol=1e-9, atol=1e-9
    )

    def moved(xi):
        return reference.residual(T @ se3_exp(xi), mount, baseline, p, xy, disparity, weights)

    def shifted(d):
        return reference.residual(T, mount, baseline, p + d, xy, disparity, weights)

    np.testing.assert_allclose(J, reference.numeric_jacobian(moved, 6), rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(P, reference.numeric_jacobian(shifted, 3), rtol=1e-5, atol=1e-4)
    if not has_disparity:
        assert not J[2].any()
        assert not P[2].any()
        assert r[2] == 0


@pytest.mark.parametrize("depth", [-3.0, -1e-6, 0.0, 5e-4])
def test_behind_the_camera_there_is_nothing_to_compare(depth):
    seen, r, J, P = kernel(*case(3, depth if depth else 1e-300))
    assert not seen
    assert not r.any()
    assert not J.any()
    assert not P.any()


def test_huber():
    chi2 = np.array([0.0, 1.0, 6.2, 6.3, 100.0, np.inf])
    width = 2.5
    for c in chi2:
        quadratic = c <= width * width
        cost = 0.5 * c if quadratic else width * np.sqrt(c) - width**2 / 2
        assert huber_cost(c, width) == pytest.approx(cost)
        assert huber_weight(c, width) == pytest.approx(1 if quadratic else width / np.sqrt(c))
    # The weight is the slope of twice the cost in chi2.
    for c in (0.5, 3.0, 20.0, 500.0):
        slope = (huber_cost(c + 1e-4, width) - huber_cost(c - 1e-4, width)) / 1e-4
        assert huber_weight(c, width) == pytest.approx(slope, rel=1e-6)
