"""One pose against landmarks held fixed: exact, robust, and as sure as it should be."""

from dataclasses import replace

import numpy as np
import pytest

import reference
from odomap.backend.motion import Sightings, solve_motion
from odomap.geometry.lie import se3_exp, se3_inverse, se3_log

FOCAL, BASELINE = 420.0, 0.12
T_CAMERA_BODY = se3_exp(np.array([0.05, -0.1, 0.02, 0.9, -0.7, 0.6]))


def scene(seed, points=80):
    """Return a pose and what is seen from it, without noise."""
    rng = np.random.default_rng(seed)
    T = se3_exp(rng.normal(0, 1.0, 6))
    z = rng.uniform(1.5, 9.0, points)
    local = np.column_stack([rng.uniform(-0.6, 0.6, (points, 2)) * z[:, None], z])
    T_world_camera = T @ se3_inverse(T_CAMERA_BODY)
    return T, Sightings(
        local @ T_world_camera[:3, :3].T + T_world_camera[:3, 3],
        local[:, :2] / z[:, None],
        BASELINE / z,
        np.tile(FOCAL / np.array([0.5, 0.8]), (points, 1)),
    )


def noisy(sightings, rng):
    s = sightings
    return replace(
        s,
        xy=s.xy + rng.normal(size=s.xy.shape) / s.weights[:, :1],
        disparity=s.disparity + rng.normal(size=len(s.xy)) / s.weights[:, 1],
    )


def rows(sightings, keep):
    return Sightings(*(np.array(v[keep]) for v in vars(sightings).values()))


def solve(T, sightings, **options):
    return solve_motion(T, T_CAMERA_BODY, BASELINE, sightings, **options)


def off(solution, T):
    return se3_log(se3_inverse(T) @ solution.T_world_body)


@pytest.mark.parametrize("disparity", [True, False])
@pytest.mark.parametrize("seed", range(6))
def test_truth_is_recovered_from_a_poor_start(seed, disparity):
    T, sightings = scene(seed)
    if not disparity:
        sightings.disparity[:] = np.nan
    start = T @ se3_exp(np.random.default_rng(seed).normal(0, [0.2] * 3 + [0.08] * 3))
    solution = solve(start, sightings)
    assert solution.converged
    assert np.abs(off(solution, T)).max() < 1e-8
    assert solution.inliers.all()
    assert solution.chi2.max() < 1e-8


@pytest.mark.parametrize("seed", range(4))
def test_two_fifths_of_outliers_are_told_from_the_rest(seed):
    T, sightings = scene(seed, 100)
    rng = np.random.default_rng(seed)
    sightings = noisy(sightings, rng)
    clean = solve(T, rows(sightings, slice(40, None)))
    sightings.xy[:40] += rng.uniform(0.03, 0.3, (40, 2)) * rng.choice([-1, 1], (40, 2))
    start = T @ se3_exp(rng.normal(0, 0.02, 6))
    solution = solve(start, sightings)
    assert solution.converged
    assert not solution.inliers[:40].any()
    assert solution.inliers[40:].mean() > 0.95
    assert np.abs(off(solution, T)).max() < 3 * np.abs(off(clean, T)).max() + 1e-4
    np.testing.assert_array_equal(solution.inliers, solution.chi2 <= 3.5**2)


def test_covariances_are_calibrated():
    """Of 400 noisy problems; with fewer rows weighing less, and depth of some unknown."""
    T, sightings = scene(11, 60)
    sightings.weights[::2] *= 0.3
    sightings.disparity[::3] = np.nan
    rng = np.random.default_rng(1)
    normalised = []
    for _ in range(400):
        solution = solve(T @ se3_exp(rng.normal(0, 0.01, 6)), noisy(sightings, rng))
        e = off(solution, T)
        normalised.append(e @ np.linalg.solve(solution.covariance, e) / 6)
    assert 0.9 < np.mean(normalised) < 1.1
    assert np.mean(np.array(normalised) < 1.773) == pytest.approx(0.9, abs=0.05)  # chi2_6: 90 %


def test_the_covariance_is_the_inverse_of_the_normal_equations():
    T, sightings = scene(2, 30)
    solution = solve(T, sightings)
    J = [
        reference.numeric_jacobian(
            lambda x, p=p, xy=xy, d=d, w=w: reference.residual(
                T @ se3_exp(x), T_CAMERA_BODY, BASELINE, p, xy, d, w
            ),
            6,
        )
        for p, xy, d, w in zip(*vars(sightings).values())
    ]
    expected = np.linalg.inv(sum(j.T @ j for j in J))
    np.testing.assert_allclose(solution.covariance, expected, rtol=1e-4, atol=1e-12)
    np.testing.assert_allclose(solution.covariance, solution.covariance.T, rtol=1e-9)


def test_what_is_behind_the_camera_is_left_out():
    T, sightings = scene(3, 50)
    T_world_camera = T @ se3_inverse(T_CAMERA_BODY)
    sightings.points_world[:10] = T_world_camera[:3, 3] - 2 * (
        sightings.points_world[:10] - T_world_camera[:3, 3]
    )
    solution = solve(T @ se3_exp(np.full(6, 0.01)), sightings)
    assert np.isinf(solution.chi2[:10]).all()
    assert not solution.inliers[:10].any()
    assert solution.inliers[10:].all()
    assert np.abs(off(solution, T)).max() < 1e-8


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_little_is_no_pose(count):
    """Without disparity two points leave directions free; with none everything is."""
    T, sightings = scene(4, count)
    sightings.disparity[:] = np.nan
    solution = solve(T, sightings)
    assert not solution.converged
    assert not solution.covariance.any()
    assert solution.chi2.shape == solution.inliers.shape == (count,)
    assert np.isfinite(solution.T_world_body).all()


def test_all_behind_is_no_pose():
    T, sightings = scene(5)
    about = se3_inverse(T_CAMERA_BODY) @ se3_exp(np.array([0, 0, 0, 0, np.pi, 0])) @ T_CAMERA_BODY
    solution = solve(T @ about, sightings)
    assert not solution.converged
    assert not solution.inliers.any()
    assert not solution.covariance.any()


def test_what_did_not_converge_has_no_covariance():
    T, sightings = scene(6)
    for iterations in (0, 1):
        solution = solve(T @ se3_exp(np.full(6, 0.15)), sightings, iterations=iterations)
        assert not solution.converged
        assert not solution.covariance.any()


def test_the_input_is_left_alone_and_the_same_bytes_come_out():
    T, sightings = scene(7)
    sightings = noisy(sightings, np.random.default_rng(7))
    start = T @ se3_exp(np.full(6, 0.02))
    before = start.copy(), *(v.copy() for v in vars(sightings).values())
    a, b = solve(start, sightings), solve(start, sightings)
    for x, y in zip(before, (start, *vars(sightings).values())):
        np.testing.assert_array_equal(x, y)
    for name in ("T_world_body", "covariance", "chi2"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_rotations_stay_rotations():
    T, sightings = scene(8)
    solution = solve(T @ se3_exp(np.full(6, 0.1)), sightings)
    R = solution.T_world_body[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(solution.T_world_body[3], [0, 0, 0, 1])
