"""The bias of depth: learnt with the right sign and size, and only where the rig admits one."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.backend.bundle import Bundle, BundleConfig, solve_bundle
from odomap.geometry.lie import se3_exp
from odomap.system.creating import Created
from odomap.system.depthbias import DepthBias, bias_at
from odomap.system.localbundle import adjust_window
from windowworlds import row, with_features, world

CONFIG = BundleConfig(iterations=20, tolerance=1e-7)
NONE = np.empty(0, np.int64)
NOTHING = Created(np.empty((0, 3)), NONE, NONE, NONE, 0, {})
SIGMAS = np.array([0.01, 0.01, 0.01])
SIGMA_DEPTH = 0.003


def biased(window, bias):
    """Return the window with a bias of all inverse depths measured."""
    for k in range(len(window.keyframes)):
        features = window.features(k)
        inverse = 1.0 / features.depth + bias_at(bias, features.bearings)
        window = with_features(window, k, depth=1.0 / inverse)
    return window


def seen(bias, known, seed=0):
    """Return what the bundle of a window says whose depths are off, a part of it known."""
    window = biased(world(row(6, 0.4), sigma_depth=SIGMA_DEPTH, known=1.0, seed=seed).window, bias)
    window = replace(window, inverse_depth_bias=known)
    return adjust_window(window, NOTHING, np.eye(4), CONFIG, 3.5).solution


def learnt(bias, windows=1, sigmas=SIGMAS, seed=0):
    """Return the bias learnt from some windows, and the information of it (3, 3)."""
    known, information = DepthBias(sigmas), np.diag(1.0 / np.where(sigmas > 0, sigmas, 1.0) ** 2)
    for w in range(windows):
        solution = seen(bias, known.value, seed + w)
        known.learn(solution, 1.0)
        information = information + solution.disparity_curvature / max(
            solution.variance_factor, 1.0
        )
    return known.value, information


def test_a_bias_is_an_offset_and_two_slopes():
    rays = np.array([[0.0, 0, 1], [2, 0, 4], [0, 3, 3]])
    np.testing.assert_allclose(bias_at(np.array([1.0, 10, 100]), rays), [1, 6, 101])


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1, 1])
def test_each_part_is_learnt_with_its_sign(axis, sign):
    bias = np.zeros(3)
    bias[axis] = sign * 0.02
    sigmas = np.full(3, 0.05)
    value, information = learnt(bias, windows=4, sigmas=sigmas, seed=10 * axis)
    sigma = np.sqrt(np.diag(np.linalg.inv(information)))
    # The windows say more than the rig did, and what they say is true.
    assert sigma[axis] < 0.5 * sigmas[axis]
    assert sign * value[axis] > 0
    assert (np.abs(value - bias) < 4 * sigma).all()
    assert abs(value[axis] - bias[axis]) < 0.5 * abs(bias[axis])


def test_what_is_learnt_is_as_wrong_as_it_says():
    rng = np.random.default_rng(5)
    nees, sigmas = [], np.full(3, SIGMA_DEPTH)
    for n in range(16):
        bias = sigmas * rng.normal(size=3)
        value, information = learnt(bias, sigmas=sigmas, seed=100 + n)
        nees.append((value - bias) @ information @ (value - bias) / 3)
    # The mean of 16 draws of χ²/3 with three degrees of freedom has a deviation of 0.2.
    assert 0.4 < np.mean(nees) < 1.8


def test_more_windows_teach_more():
    bias = np.array([0.015, -0.01, 0.01])
    off = [np.abs(learnt(bias, windows)[0] - bias).max() for windows in (1, 10)]
    assert off[1] < 0.7 * off[0]
    assert off[1] < 0.004


def test_no_bias_is_no_bias():
    value, information = learnt(np.zeros(3), windows=3)
    assert (np.abs(value) < 3.5 * np.sqrt(np.diag(np.linalg.inv(information)))).all()


def test_what_the_rig_is_certain_of_is_never_learnt():
    bias = np.array([0.02, 0.02, -0.02])
    none = DepthBias(np.zeros(3))
    offset = DepthBias(np.array([0.05, 0.0, 0.0]))
    for w in range(3):
        for known in (none, offset):
            known.learn(seen(bias, known.value, w), 1.0)
    np.testing.assert_array_equal(none.value, np.zeros(3))
    np.testing.assert_array_equal(offset.value[1:], np.zeros(2))
    assert offset.value[0] > 0.005


def test_a_share_counts_for_its_share():
    """Four quarters of a window say what the window says, to first order; none says nothing."""
    bias = np.array([0.01, 0.0, 0.0])
    whole, none = DepthBias(SIGMAS), DepthBias(SIGMAS)
    solution = seen(bias, np.zeros(3))
    whole.learn(solution, 1.0)
    none.learn(solution, 0.0)
    np.testing.assert_array_equal(none.value, np.zeros(3))
    quarters = DepthBias(SIGMAS)
    for _ in range(4):
        quarters.learn(seen(bias, quarters.value), 0.25)
    # The gradient is that of the cost without its prior, so counting a window twice is no news.
    np.testing.assert_allclose(quarters.value, whole.value, atol=3e-4)


def test_images_that_fit_badly_count_less():
    solution = seen(np.array([0.02, 0.0, 0.0]), np.zeros(3))
    bad = replace(solution, variance_factor=25.0)
    good, doubtful = DepthBias(SIGMAS), DepthBias(SIGMAS)
    good.learn(solution, 1.0)
    doubtful.learn(bad, 1.0)
    assert 0 < doubtful.value[0] < good.value[0]


def bundle(seed=0, poses=4, count=60, sigma_px=0.3):
    """Return a bundle of cameras in a row whose observations measure disparity, not all of them."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(3.0, 9.0, count)
    points = np.stack([*(rng.uniform(-0.5, 0.5, (2, count)) * z), z], axis=1)
    Ts = np.tile(np.eye(4), (poses, 1, 1))
    Ts[:, 0, 3] = 0.3 * np.arange(poses)
    Ts = Ts @ se3_exp(0.05 * rng.normal(size=(poses, 6)))
    pose, point = (a.ravel() for a in np.meshgrid(range(poses), range(count), indexing="ij"))
    local = np.einsum("nji,nj->ni", Ts[pose, :3, :3], points[point] - Ts[pose, :3, 3])
    xy = local[:, :2] / local[:, 2:] + rng.normal(size=(len(pose), 2)) * sigma_px / 400
    disparity = 0.2 / local[:, 2] + rng.normal(size=len(pose)) * sigma_px / 400
    disparity[rng.random(len(pose)) < 0.3] = np.nan
    return Bundle(
        Ts,
        np.arange(poses) == 0,
        points + 0.01 * rng.normal(size=points.shape),
        np.eye(4)[None],
        np.array([0.2]),
        pose,
        point,
        np.zeros(len(pose), np.int64),
        xy,
        disparity,
        np.full((len(pose), 2), 400 / sigma_px),
    )


def test_the_evidence_of_a_bundle_is_that_of_its_cost():
    """Gradient and curvature against differences, poses and points solved anew each time."""
    exact = BundleConfig(iterations=60, tolerance=1e-14, huber_width=1e3)
    made = bundle()
    solution = solve_bundle(made, exact)
    basis = np.stack([np.ones(len(made.xy)), made.xy[:, 0], made.xy[:, 1]])

    def cost(errors):
        shifted = replace(made, disparity=made.disparity + errors @ basis)
        return solve_bundle(shifted, exact).cost_after

    step, e = 2e-4, np.eye(3)
    gradient = [(cost(step * e[i]) - cost(-step * e[i])) / (2 * step) for i in range(3)]
    np.testing.assert_allclose(
        solution.disparity_gradient,
        gradient,
        rtol=0.02,
        atol=0.01 * np.abs(gradient).max(),
    )
    curvature = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            corners = [a * b * cost(step * (a * e[i] + b * e[j])) for a in (-1, 1) for b in (-1, 1)]
            curvature[i, j] = sum(corners) / (4 * step**2)
    scale = np.abs(curvature).max()
    np.testing.assert_allclose(
        solution.disparity_curvature, curvature, rtol=0.02, atol=0.02 * scale
    )
    assert (np.linalg.eigvalsh(solution.disparity_curvature) > 0).all()
