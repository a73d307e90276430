"""How sure an adjustment is of its views: against differences, dense inverses and repetition."""

from dataclasses import replace

import numpy as np
import pytest

from bundleworlds import world
from odomap.backend.adjustment.adjust import AdjustmentConfig, adjust, view_covariance
from odomap.backend.adjustment.gauge import find_gauge
from odomap.errors import InputError
from odomap.geometry.lie import se3_inverse, se3_log

RUNS = 100


def tangent(found, true):
    """Return log(T_world_camera⁻¹ of the truth · found), (K, 6)."""
    return se3_log(true @ se3_inverse(found))


def hold_two(problem, Ts):
    """Hold the first two views at the truth: nothing is left of the gauge."""
    fixed = np.arange(len(Ts)) < 2
    start = np.where(fixed[:, None, None], Ts, problem.Ts_camera_world)
    return replace(problem, Ts_camera_world=start, is_fixed_view=fixed)


def test_repetition_scatters_as_the_covariance_says():
    views, errors, covariance = [2, 4], [], None
    for seed in range(RUNS):
        problem, Ts, *_ = world(views=6, points=40, off=0.005, seed=0)
        noise = np.random.default_rng(seed).normal(0.0, 0.5, problem.pixels.shape)
        exact, *_ = world(views=6, points=40, off=0.005, seed=0, sigma_px=0.0)
        problem = hold_two(replace(problem, pixels=exact.pixels + noise), Ts)
        solution = adjust(problem, AdjustmentConfig(tolerance=1e-9))
        errors.append(tangent(solution.Ts_camera_world, Ts)[views].ravel())
        if seed == 0:
            covariance = view_covariance(solution.problem, views)
    errors = np.array(errors)
    nees = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(covariance.joint), errors).mean() / 12
    assert abs(nees - 1.0) < 1.96 * np.sqrt(2.0 / (12 * RUNS))
    np.testing.assert_array_equal(covariance.covariances[1], covariance.joint[6:, 6:])


def test_a_fixed_view_is_certain_and_the_rest_is_positive_definite():
    problem, Ts, *_ = world()
    solution = adjust(hold_two(problem, Ts))
    found = view_covariance(solution.problem, range(6))
    np.testing.assert_array_equal(found.joint[:12], 0.0)
    assert np.linalg.eigvalsh(found.joint[12:, 12:]).min() > 0.0
    np.testing.assert_allclose(found.joint, found.joint.T)
    alone = view_covariance(solution.problem, [3])
    np.testing.assert_allclose(alone.joint, found.covariances[3], rtol=1e-6, atol=1e-18)


def test_a_free_gauge_is_held_by_the_first_view_and_the_farthest():
    problem, *_ = world(is_free_intrinsic=True)
    solution = adjust(problem, AdjustmentConfig(gauge="hold"))
    found = view_covariance(solution.problem, [0, 5])
    assert np.count_nonzero(found.is_held) == 7
    assert found.is_held[0].all()
    np.testing.assert_array_equal(found.covariances[0], 0.0)
    at = int(np.argmax(found.is_held[5]))
    assert found.covariances[1][at, at] == 0.0
    assert np.count_nonzero(np.diag(found.covariances[1])) == 5
    assert (np.linalg.eigvalsh(found.intrinsics[0]) > 0.0).all()


def test_information_adds_up():
    problem, Ts, *_ = world()
    held = hold_two(problem, Ts)
    half = view_covariance(held, [2, 3, 4]).joint
    double = {
        name: np.concatenate([getattr(held, name)] * 2)
        for name in ("view", "point", "pixels", "weights")
    }
    np.testing.assert_allclose(view_covariance(replace(held, **double), [2, 3, 4]).joint, half / 2)


def test_what_holds_a_part():
    problem, Ts, X, _ = world()
    free = find_gauge(problem)
    assert (free.num_parts, np.count_nonzero(free.is_held)) == (1, 7)
    one = find_gauge(replace(problem, is_fixed_view=np.arange(6) == 3))
    assert np.count_nonzero(one.is_held) == 1
    assert one.anchor[0] == 3
    assert not find_gauge(hold_two(problem, Ts)).is_held.any()
    assert not find_gauge(replace(problem, is_fixed_point=np.arange(len(X)) < 3)).is_held.any()


def test_what_is_not_determined_is_told():
    problem, *_ = world()
    few = (problem.view != 4) | (problem.point < 2)
    short = replace(
        problem,
        **{name: getattr(problem, name)[few] for name in ("view", "point", "pixels", "weights")},
    )
    with pytest.raises(InputError, match="the system is singular"):
        view_covariance(short, [2])
    with pytest.raises(InputError, match=r"\[9\] of 6"):
        view_covariance(problem, [9])
    for views in ("a", [0.7], [[0]], [True]):
        with pytest.raises(InputError, match=r"views: an array .*, give \(Q,\) indices"):
            view_covariance(problem, views)
    with pytest.raises(InputError, match="loss: 'huber' is none"):
        view_covariance(problem, [1], "huber")
    assert view_covariance(problem, []).joint.shape == (0, 0)
    blind = replace(
        problem,
        **{
            name: getattr(problem, name)[problem.view != 4]
            for name in ("view", "point", "pixels", "weights")
        },
    )
    with pytest.raises(InputError, match="view 4 sees nothing"):
        view_covariance(blind, [4])
