"""A bundle that nothing measures the size of: the size is held, and all else is as with it."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.backend.bundle import BundleConfig, solve_bundle
from odomap.geometry.lie import se3_exp, se3_inverse, se3_log

from .conftest import make_scene

THOROUGH = BundleConfig(iterations=40, tolerance=1e-12)


def camera_scene(**options):
    """Return a scene whose camera is the body, as a single camera's is."""
    scene = make_scene(**options)
    Ts = scene.Ts_world_body @ se3_inverse(scene.T_camera_body)
    return replace(scene, Ts_world_body=Ts, T_camera_body=np.eye(4))


def free(scene, seed=0, noise=1.0, start=(0.01, 0.05), **options):
    """Return the bundle without disparities, one pose held, its size free."""
    rng = np.random.default_rng(seed)
    bundle = scene.bundle(rng, noise, start, mono=True, **options)
    return replace(bundle, is_scale_free=True)


def directions(Ts, held=0):
    """Return the unit vector (6F,) by which poses move when all grows around the one held."""
    out = []
    for k, T in enumerate(Ts):
        if k != held:
            out += [*(T[:3, :3].T @ (T[:3, 3] - Ts[held, :3, 3])), 0, 0, 0]
    out = np.array(out)
    return out / np.linalg.norm(out)


def size(Ts, held=0):
    """Return the norm of the path around the pose held."""
    return np.linalg.norm(Ts[:, :3, 3] - Ts[held, :3, 3])


@pytest.mark.parametrize("seed", range(4))
def test_the_truth_is_recovered_in_another_scale(seed):
    scene = camera_scene(seed=seed)
    bundle = free(scene, seed, noise=0.0, start=(0.02, 0.1))
    solution = solve_bundle(bundle, THOROUGH)
    assert solution.cost_after < 1e-8
    Ts, true = solution.Ts_world_body, scene.Ts_world_body
    scale = size(Ts) / size(true)
    assert 0.8 < scale < 1.25
    origin = true[0, :3, 3]
    np.testing.assert_allclose(Ts[:, :3, :3], true[:, :3, :3], atol=1e-7)
    np.testing.assert_allclose(Ts[:, :3, 3], origin + scale * (true[:, :3, 3] - origin), atol=1e-7)
    expected = origin + scale * (scene.points_world - origin)
    often = np.bincount(scene.point, minlength=len(expected)) > 1  # one ray alone has no depth
    assert often.sum() > 50
    np.testing.assert_allclose(solution.points_world[often], expected[often], atol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_the_size_of_the_path_is_held_to_first_order(seed):
    """Steps of a hundredth change the size by their squares only."""
    scene = camera_scene(seed=seed, points=80)
    bundle = free(scene, seed, start=(0.004, 0.02))
    solution = solve_bundle(bundle, THOROUGH)
    moved = np.linalg.norm((solution.Ts_world_body - bundle.Ts_world_body)[:, :3, 3])
    assert moved > 0.002 * size(bundle.Ts_world_body)
    change = size(solution.Ts_world_body) / size(bundle.Ts_world_body) - 1
    assert abs(change) < 2 * (moved / size(bundle.Ts_world_body)) ** 2 + 1e-5
    assert abs(change) < 1e-3


@pytest.mark.parametrize("factor", [0.01, 100.0])
def test_the_size_that_is_held_is_that_which_comes(factor):
    scene = camera_scene(seed=2)
    bundle = free(scene, 2, noise=0.5)
    origin = bundle.Ts_world_body[0, :3, 3].copy()
    Ts = bundle.Ts_world_body.copy()
    Ts[:, :3, 3] = origin + factor * (Ts[:, :3, 3] - origin)
    scaled = replace(
        bundle, Ts_world_body=Ts, points_world=origin + factor * (bundle.points_world - origin)
    )
    one, other = solve_bundle(bundle, THOROUGH), solve_bundle(scaled, THOROUGH)
    assert size(other.Ts_world_body) == pytest.approx(factor * size(one.Ts_world_body), rel=2e-3)
    assert other.cost_after == pytest.approx(one.cost_after, rel=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_it_is_the_metric_solution_up_to_scale(seed):
    """Two poses held at their true places tell the scale: the same path, the same cost."""
    scene = camera_scene(seed=seed)
    bundle = free(scene, seed)
    found = solve_bundle(bundle, THOROUGH)
    # Hold the path at what was found for the last pose, and solve again without the flag.
    held = np.zeros(len(bundle.is_fixed), bool)
    held[[0, -1]] = True
    Ts = bundle.Ts_world_body.copy()
    Ts[-1] = found.Ts_world_body[-1]
    metric = solve_bundle(
        replace(bundle, Ts_world_body=Ts, is_fixed=held, is_scale_free=False), THOROUGH
    )
    assert metric.cost_after == pytest.approx(found.cost_after, rel=1e-6)
    apart = se3_log(se3_inverse(metric.Ts_world_body) @ found.Ts_world_body)
    assert np.abs(apart).max() < 2e-5


@pytest.mark.parametrize("seed", range(4))
def test_the_covariance_is_finite_and_knows_no_doubt_of_the_size(seed):
    scene = camera_scene(seed=seed)
    solution = solve_bundle(free(scene, seed), THOROUGH)
    joint = solution.joint_covariance
    assert np.isfinite(joint).all()
    np.testing.assert_allclose(joint, joint.T, atol=1e-12 * np.abs(joint).max())
    values = np.linalg.eigvalsh(joint)
    assert values[0] > -1e-12 * values[-1]
    assert (np.linalg.eigvalsh(solution.covariances[1:]) > 0).all()
    u = directions(solution.Ts_world_body)
    along = u @ joint @ u
    assert along < 1e-3 * values[-1]
    # It is not blind otherwise: with disparities, which tell the size, there is no more doubt
    # than some times this.
    metric = solve_bundle(scene.bundle(np.random.default_rng(seed), 1.0, (0.01, 0.05)), THOROUGH)
    assert values[-1] > 0.1 * np.linalg.eigvalsh(metric.joint_covariance)[-1]


def test_the_covariance_is_that_of_the_constrained_problem():
    """Compare with the pseudo-inverse of the dense system on the complement of the gauge."""
    scene = camera_scene(poses=4, points=40, seed=3)
    bundle = free(scene, 3)
    solution = solve_bundle(bundle, replace(THOROUGH, huber_width=1e6))
    draws = []
    for seed in range(200):
        rng = np.random.default_rng(1000 + seed)
        noisy = replace(
            bundle,
            Ts_world_body=solution.Ts_world_body,
            points_world=solution.points_world,
            xy=_exact(bundle, solution) + rng.normal(size=bundle.xy.shape) / bundle.weights[:, :1],
        )
        again = solve_bundle(noisy, replace(THOROUGH, huber_width=1e6))
        off = se3_log(se3_inverse(solution.Ts_world_body) @ again.Ts_world_body)
        draws.append(off[1:].ravel())
    sampled = np.cov(np.array(draws).T)
    claimed = solution.joint_covariance
    ratio = np.diag(sampled) / np.diag(claimed)
    assert (ratio > 0.7).all()
    assert (ratio < 1.4).all()


def _exact(bundle, solution):
    """Return (N, 2) where the solved points are seen from the solved poses."""
    T = se3_inverse(solution.Ts_world_body)[bundle.pose]
    local = np.einsum("nij,nj->ni", T[:, :3, :3], solution.points_world[bundle.point]) + T[:, :3, 3]
    return local[:, :2] / local[:, 2:]


def test_without_it_the_size_wanders_or_nothing_is_known():
    """What the flag is for: the same bundle without it has no covariance to speak of."""
    scene = camera_scene(seed=1)
    bundle = free(scene, 1)
    solution = solve_bundle(replace(bundle, is_scale_free=False), THOROUGH)
    joint = solution.joint_covariance
    u = directions(solution.Ts_world_body)
    held = solve_bundle(bundle, THOROUGH).joint_covariance
    assert solution.reason == "the system is singular" or u @ joint @ u > 1e4 * (u @ held @ u)


def test_any_pose_may_be_the_one_held():
    scene = camera_scene(seed=5)
    bundle = free(scene, 5, noise=0.0, start=None)
    held = np.arange(len(bundle.is_fixed)) == 2
    rng = np.random.default_rng(5)
    Ts = bundle.Ts_world_body @ np.where(
        held[:, None, None], np.eye(4), se3_exp(rng.normal(0, 0.01, (len(held), 6)))
    )
    solution = solve_bundle(replace(bundle, Ts_world_body=Ts, is_fixed=held), THOROUGH)
    assert solution.cost_after < 1e-8
    np.testing.assert_array_equal(solution.Ts_world_body[2], Ts[2])
    assert size(solution.Ts_world_body, 2) == pytest.approx(size(Ts, 2), rel=5e-3)
    u = directions(solution.Ts_world_body, 2)
    top = np.linalg.eigvalsh(solution.joint_covariance)[-1]
    assert u @ solution.joint_covariance @ u < 1e-3 * top


def test_two_poses_held_at_one_place_hold_no_size_either():
    """A camera that stood: of the size they say nothing, and it is held all the same."""
    scene = camera_scene(seed=3)
    Ts = scene.Ts_world_body.copy()
    Ts[1] = Ts[0]
    local = (scene.points_world - Ts[0, :3, 3]) @ Ts[0, :3, :3]
    xy = scene.xy.copy()
    second = scene.pose == 1
    xy[second] = (local[:, :2] / local[:, 2:])[scene.point[second]]
    scene = replace(scene, Ts_world_body=Ts, xy=xy)
    bundle = free(scene, 3, fixed=2)
    solution = solve_bundle(bundle, THOROUGH)
    assert solution.reason == "converged" or solution.reason == "no step lowers the cost"
    assert size(solution.Ts_world_body) == pytest.approx(size(bundle.Ts_world_body), rel=5e-3)
    joint = solution.joint_covariance
    assert np.isfinite(joint).all()
    assert (np.linalg.eigvalsh(joint) > 0).all()
    u = np.concatenate(
        [[*(T[:3, :3].T @ (T[:3, 3] - Ts[0, :3, 3])), 0, 0, 0] for T in solution.Ts_world_body[2:]]
    )
    u /= np.linalg.norm(u)
    assert u @ joint @ u < 1e-3 * np.linalg.eigvalsh(joint)[-1]


def test_all_poses_at_one_place_have_no_size():
    """A pure turn: nothing to hold, and the solver says so rather than dividing by zero."""
    scene = camera_scene(seed=1)
    bundle = free(scene, 1, noise=0.0, start=None)
    Ts = bundle.Ts_world_body.copy()
    Ts[:, :3, 3] = Ts[0, :3, 3]
    solution = solve_bundle(replace(bundle, Ts_world_body=Ts), BundleConfig(iterations=5))
    assert np.isfinite(solution.Ts_world_body).all()
    assert np.isfinite(solution.joint_covariance).all()


def test_the_same_bundle_gives_the_same_bytes():
    bundle = free(camera_scene(seed=4), 4)
    a, b = solve_bundle(bundle), solve_bundle(bundle)
    np.testing.assert_array_equal(a.Ts_world_body, b.Ts_world_body)
    np.testing.assert_array_equal(a.joint_covariance, b.joint_covariance)
