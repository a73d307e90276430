"""Bundle adjustment: finds the truth, knows how well, and says when it cannot."""

from dataclasses import replace

import numpy as np
import pytest

import reference
from odomap.backend.bundle import Bundle, BundleConfig, solve_bundle
from odomap.errors import InputError
from odomap.geometry.lie import se3_exp, se3_inverse, se3_log

from .conftest import make_scene

THOROUGH = BundleConfig(iterations=40, tolerance=1e-12)


def off(solution, scene):
    """Return (K, 6) tangents from true to solved poses."""
    return se3_log(se3_inverse(scene.Ts_world_body) @ solution.Ts_world_body)


def rows(bundle, keep):
    """Return the bundle with some of its observations."""
    names = ("pose", "point", "camera", "xy", "disparity", "weights")
    return replace(bundle, **{name: getattr(bundle, name)[keep] for name in names})


@pytest.mark.parametrize("seed", range(4))
def test_truth_is_recovered(seed):
    scene = make_scene(seed=seed)
    bundle = scene.bundle(np.random.default_rng(seed), 0.0, (0.03, 0.15))
    solution = solve_bundle(bundle, THOROUGH)
    assert np.abs(off(solution, scene)).max() < 1e-7
    np.testing.assert_allclose(solution.points_world, scene.points_world, atol=1e-6)
    assert solution.cost_before > 1e3
    assert solution.cost_after < 1e-8
    assert solution.chi2.max() < 1e-8


def test_monocular_sights_suffice_where_two_poses_give_the_scale():
    scene = make_scene(seed=7)
    bundle = scene.bundle(np.random.default_rng(7), 0.0, (0.01, 0.05), fixed=2, mono=True)
    solution = solve_bundle(bundle, THOROUGH)
    assert np.abs(off(solution, scene)).max() < 1e-6


def test_poses_held_fixed_stay_to_the_bit(scene):
    bundle = scene.bundle(np.random.default_rng(1), 1.0, (0.02, 0.1))
    held = np.array([False, True, False, True, False])
    solution = solve_bundle(replace(bundle, is_fixed=held))
    np.testing.assert_array_equal(solution.Ts_world_body[held], bundle.Ts_world_body[held])
    assert (np.abs(off(solution, scene))[~held] > 0).all()
    assert not solution.covariances[held].any()
    assert (np.linalg.eigvalsh(solution.covariances[~held]) > 0).all()


def test_a_bundle_leaves_its_input_alone(scene):
    bundle = scene.bundle(np.random.default_rng(1), 1.0, (0.02, 0.1))
    before = {k: np.array(v) for k, v in vars(bundle).items()}
    solve_bundle(bundle)
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(bundle, name), value)


@pytest.mark.parametrize("seed", range(3))
def test_a_fifth_of_outliers_does_little_harm(seed):
    scene = make_scene(points=80, seed=seed)
    rng = np.random.default_rng(seed)
    bundle = scene.bundle(rng, 1.0, (0.01, 0.05))
    wrong = rng.random(len(bundle.pose)) < 0.2
    clean = solve_bundle(rows(bundle, ~wrong), THOROUGH)
    bundle.xy[wrong] += rng.uniform(-0.15, 0.15, (wrong.sum(), 2))
    bundle.disparity[wrong] += rng.uniform(0, 0.05, wrong.sum())
    robust = solve_bundle(bundle, THOROUGH)
    plain = solve_bundle(bundle, replace(THOROUGH, huber_width=1e9))
    error = {
        name: np.abs(off(s, scene)).max()
        for name, s in (("clean", clean), ("robust", robust), ("plain", plain))
    }
    assert error["robust"] < 12 * error["clean"]
    assert error["robust"] < 0.25 * error["plain"]
    # What is wrong stands out, what is right does not.
    assert np.mean(robust.chi2[wrong] > 3.5**2) > 0.85
    assert np.mean(robust.chi2[~wrong] > 3.5**2) < 0.2


def test_the_covariance_is_the_inverse_of_the_dense_system():
    scene = make_scene(poses=4, points=20, seed=3)
    bundle = scene.bundle(np.random.default_rng(3), 1.0, fixed=1)
    bundle.disparity[::4] = np.nan
    solution = solve_bundle(bundle, replace(THOROUGH, huber_width=1e6))
    solved = replace(
        bundle, Ts_world_body=solution.Ts_world_body, points_world=solution.points_world
    )
    H = normal_equations(solved)
    expected = np.linalg.inv(H)[:18, :18]
    np.testing.assert_allclose(
        solution.joint_covariance, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max()
    )
    for k in range(3):
        block = slice(6 * k, 6 * k + 6)
        np.testing.assert_array_equal(
            solution.covariances[k + 1], solution.joint_covariance[block, block]
        )


def normal_equations(bundle):
    """Return J^T J of free poses and points, J by differences."""
    free = np.flatnonzero(~bundle.is_fixed)
    size = 6 * len(free) + 3 * len(bundle.points_world)
    J = []
    for k, m, xy, d, w in zip(
        bundle.pose, bundle.point, bundle.xy, bundle.disparity, bundle.weights
    ):
        row = np.zeros((3, size))
        rest = bundle.Ts_camera_body[0], bundle.baselines[0]
        T, p = bundle.Ts_world_body[k], bundle.points_world[m]
        if k in free:
            f = 6 * int(np.flatnonzero(free == k)[0])
            row[:, f : f + 6] = reference.numeric_jacobian(
                lambda x, T=T, p=p, xy=xy, d=d, w=w, rest=rest: reference.residual(
                    T @ se3_exp(x), *rest, p, xy, d, w
                ),
                6,
            )
        at = 6 * len(free) + 3 * m
        row[:, at : at + 3] = reference.numeric_jacobian(
            lambda x, T=T, p=p, xy=xy, d=d, w=w, rest=rest: reference.residual(
                T, *rest, p + x, xy, d, w
            ),
            3,
        )
        J.append(row)
    J = np.concatenate(J)
    return J.T @ J


def test_covariances_are_calibrated():
    """Errors of 200 noisy problems, squared and normalised, have the mean they should."""
    scene = make_scene(poses=4, points=40, seed=5)
    rng = np.random.default_rng(5)
    each, joint, factors = [], [], []
    for _ in range(200):
        bundle = scene.bundle(rng, 1.0, (0.003, 0.01))
        solution = solve_bundle(bundle, BundleConfig(iterations=10, tolerance=1e-8))
        e = off(solution, scene)[1:]
        for x, S in zip(e, solution.covariances[1:]):
            each.append(x @ np.linalg.solve(S, x) / 6)
        joint.append(e.ravel() @ np.linalg.solve(solution.joint_covariance, e.ravel()) / 18)
        factors.append(solution.variance_factor)
    # Huber's loss and the gate of the factor cost a little.
    assert 0.88 < np.mean(each) < 1.12
    assert 0.88 < np.mean(joint) < 1.12
    assert 0.9 < np.mean(factors) < 1.05


def test_the_variance_factor_shows_wrong_weights():
    scene = make_scene(points=120, seed=6)
    rng = np.random.default_rng(6)
    bundle = scene.bundle(rng, 1.0)
    wide = BundleConfig(iterations=20, huber_width=50.0)
    assert solve_bundle(bundle, wide).variance_factor == pytest.approx(1.0, abs=0.12)
    optimistic = replace(bundle, weights=2 * bundle.weights)
    assert solve_bundle(optimistic, wide).variance_factor == pytest.approx(4.0, abs=0.5)
    few = rows(bundle, bundle.point < 2)
    assert solve_bundle(few).variance_factor == 1.0  # nothing to judge by


def test_the_response_to_errors_of_all_disparities_is_how_the_poses_move():
    """An offset and two slopes, solved anew with each, against the derivative."""
    scene = make_scene(poses=4, points=60, seed=12)
    bundle = scene.bundle()  # without residuals the normal equations are the whole curvature
    bundle.disparity[::5] = np.nan
    config = BundleConfig(iterations=60, tolerance=1e-14, huber_width=1e6)
    solution = solve_bundle(bundle, config)
    assert solution.disparity_responses.shape == (4, 3, 6)
    assert not solution.disparity_responses[0].any()  # held fixed
    step = 1e-4
    shapes = (np.ones(len(bundle.xy)), bundle.xy[:, 0], bundle.xy[:, 1])
    for e, shape in enumerate(shapes):
        moved = [
            solve_bundle(
                replace(bundle, disparity=bundle.disparity + sign * step * shape), config
            ).Ts_world_body
            for sign in (1, -1)
        ]
        difference = se3_log(se3_inverse(moved[1]) @ moved[0]) / (2 * step)
        np.testing.assert_allclose(
            solution.disparity_responses[:, e],
            difference,
            atol=0.003 * np.abs(difference).max(),
        )


def test_landmarks_seen_once_say_nothing_about_poses():
    """Without disparity their depth is free: the poses are as sure as without them, no surer."""
    scene = make_scene(poses=4, points=40, seed=8)
    bundle = scene.bundle(np.random.default_rng(8), 1.0)
    once = np.zeros(len(bundle.pose), bool)
    for m in range(15):
        seen = np.flatnonzero(bundle.point == m)
        once[seen[0]] = True
        bundle.disparity[seen[0]] = np.nan
    others = bundle.point >= 15
    without = solve_bundle(rows(bundle, others))
    with_them = solve_bundle(rows(bundle, others | once))
    assert with_them.reason != "the system is singular"
    np.testing.assert_allclose(
        with_them.joint_covariance,
        without.joint_covariance,
        rtol=1e-3,
        atol=1e-4 * np.abs(without.joint_covariance).max(),
    )


def test_a_landmark_straight_ahead_seen_once_says_nothing_either():
    scene = make_scene(poses=2, points=30, seed=9)
    move = se3_inverse(scene.Ts_world_body[1] @ se3_inverse(scene.T_camera_body))
    Ts = move @ scene.Ts_world_body
    points = scene.points_world @ move[:3, :3].T + move[:3, 3]
    bundle = replace(
        scene.bundle(), Ts_world_body=Ts, points_world=np.concatenate([points, [[0, 0, 4.0]]])
    )
    without = solve_bundle(bundle)
    ahead = replace(
        bundle,
        pose=np.append(bundle.pose, 1),
        point=np.append(bundle.point, 30),
        camera=np.append(bundle.camera, 0),
        xy=np.concatenate([bundle.xy, [[0.0, 0.0]]]),
        disparity=np.append(bundle.disparity, np.nan),
        weights=np.concatenate([bundle.weights, [[800.0, 500.0]]]),
    )
    np.testing.assert_allclose(
        solve_bundle(ahead).covariances[1], without.covariances[1], rtol=1e-3, atol=1e-10
    )


@pytest.mark.parametrize("seed", range(6))
def test_the_cost_never_rises(seed):
    """However wild the start and whatever the observations say."""
    rng = np.random.default_rng(seed)
    scene = make_scene(seed=seed)
    bundle = scene.bundle(rng, 2.0, (0.4, 2.0))
    bundle.xy[rng.random(len(bundle.xy)) < 0.3] += 0.3
    costs = []
    for iterations in (0, 1, 2, 4, 8, 25):
        solution = solve_bundle(bundle, BundleConfig(iterations=iterations))
        assert solution.iterations <= iterations
        costs.append(solution.cost_after)
        assert np.isfinite(solution.Ts_world_body).all()
        assert np.isfinite(solution.points_world).all()
    assert costs[0] == solution.cost_before
    assert (np.diff(costs) <= 1e-9 * costs[0]).all()
    assert costs[-1] < 0.5 * costs[0]
    R = solution.Ts_world_body[:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (5, 1, 1)), atol=1e-9)


def test_it_says_why_it_stopped(scene):
    noisy = scene.bundle(np.random.default_rng(2), 1.0, (0.01, 0.05))
    assert solve_bundle(noisy, BundleConfig(iterations=1)).reason == "iteration limit"
    done = solve_bundle(noisy, BundleConfig(iterations=30))
    assert done.reason == "converged"
    assert done.iterations < 30
    # Solved to the last digit, no step helps.
    again = scene.bundle()
    stuck = solve_bundle(again, BundleConfig(iterations=60, tolerance=0.0))
    assert stuck.reason in ("no step lowers the cost", "converged")
    assert stuck.cost_after <= stuck.cost_before


@pytest.mark.parametrize("case", ["mono", "unseen pose", "one landmark", "two landmarks", "none"])
def test_what_is_not_determined_is_said_and_has_no_covariance(case):
    scene = make_scene(share=1.0)
    bundle = scene.bundle(np.random.default_rng(4), 1.0, mono=case == "mono")
    keep = {
        "mono": bundle.pose >= 0,
        "unseen pose": bundle.pose != 2,
        "one landmark": bundle.point < 1,
        "two landmarks": bundle.point < 2,
        "none": bundle.point < 0,
    }[case]
    solution = solve_bundle(rows(bundle, keep), BundleConfig(iterations=15))
    assert solution.reason == "the system is singular"
    assert not solution.covariances.any()
    assert not solution.joint_covariance.any()
    assert np.isfinite(solution.Ts_world_body).all()
    assert solution.cost_after <= solution.cost_before
    assert len(solution.chi2) == keep.sum()


def test_an_unseen_pose_does_not_keep_the_others_from_moving(scene):
    bundle = rows(scene.bundle(np.random.default_rng(4), 0.0, (0.02, 0.1)), scene.pose != 2)
    solution = solve_bundle(bundle, THOROUGH)
    error = np.abs(off(solution, scene)).max(axis=1)
    assert error[[0, 1, 3, 4]].max() < 1e-6
    np.testing.assert_allclose(solution.Ts_world_body[2], bundle.Ts_world_body[2], atol=1e-9)


def test_a_landmark_behind_a_camera_does_not_stop_the_rest(scene):
    rng = np.random.default_rng(5)
    bundle = scene.bundle(rng, 0.5, (0.005, 0.02))
    bundle.points_world[3] = scene.Ts_world_body[2, :3, 3] - 50 * (
        scene.points_world[3] - scene.Ts_world_body[2, :3, 3]
    )
    solution = solve_bundle(bundle, THOROUGH)
    seen = bundle.point == 3
    assert np.isinf(solution.chi2[seen]).all()
    assert np.isfinite(solution.chi2[~seen]).all()
    assert np.abs(off(solution, scene)).max() < 0.02
    assert np.isfinite(solution.variance_factor)


def test_two_cameras_on_one_body():
    scene = make_scene(seed=10)
    rng = np.random.default_rng(10)
    second = se3_exp([0.3, 0.0, 0.1, 0.0, 0.2, 0.0]) @ scene.T_camera_body
    T = second @ se3_inverse(scene.Ts_world_body)[scene.pose]
    local = np.einsum("nij,nj->ni", T[:, :3, :3], scene.points_world[scene.point]) + T[:, :3, 3]
    good = local[:, 2] > 0.5
    one = scene.bundle(rng, 0.0, (0.02, 0.1))
    both = Bundle(
        one.Ts_world_body,
        one.is_fixed,
        one.points_world,
        np.stack([scene.T_camera_body, second]),
        np.array([0.12, 0.0]),
        np.concatenate([one.pose, one.pose[good]]),
        np.concatenate([one.point, one.point[good]]),
        np.concatenate([one.camera, np.ones(good.sum(), np.int64)]),
        np.concatenate([one.xy, local[good, :2] / local[good, 2:]]),
        np.concatenate([np.full(len(one.pose), np.nan), np.full(good.sum(), np.nan)]),
        np.concatenate([one.weights, one.weights[good]]),
    )
    solution = solve_bundle(both, THOROUGH)
    assert np.abs(off(solution, scene)).max() < 1e-6  # two lone eyes, but a known distance apart


def test_the_order_of_observations_does_not_matter(scene):
    bundle = scene.bundle(np.random.default_rng(3), 1.0, (0.01, 0.05))
    order = np.random.default_rng(0).permutation(len(bundle.pose))
    a, b = solve_bundle(bundle, THOROUGH), solve_bundle(rows(bundle, order), THOROUGH)
    np.testing.assert_allclose(a.Ts_world_body, b.Ts_world_body, atol=1e-8)
    np.testing.assert_allclose(a.chi2[order], b.chi2, rtol=1e-4, atol=1e-6)


def test_the_same_problem_has_the_same_bytes(scene):
    a, b = (
        solve_bundle(scene.bundle(np.random.default_rng(3), 1.0, (0.01, 0.05))) for _ in range(2)
    )
    for name in ("Ts_world_body", "points_world", "chi2", "covariances", "joint_covariance"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert a.cost_after == b.cost_after


def test_a_free_gauge_is_refused(scene):
    bundle = replace(scene.bundle(), is_fixed=np.zeros(5, bool))
    with pytest.raises(InputError, match="hold at least one pose fixed"):
        solve_bundle(bundle)


def test_all_poses_fixed_still_moves_the_points(scene):
    bundle = scene.bundle(np.random.default_rng(3), 0.0, (0.0, 0.1), fixed=5)
    solution = solve_bundle(bundle, THOROUGH)
    np.testing.assert_allclose(solution.points_world, scene.points_world, atol=1e-6)
    np.testing.assert_array_equal(solution.Ts_world_body, scene.Ts_world_body)
    assert solution.joint_covariance.shape == (0, 0)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("pose", lambda a: a + 5),
        ("pose", lambda a: a - 1),
        ("point", lambda a: a + 60),
        ("point", lambda a: a - 1),
        ("camera", lambda a: a + 1),
        ("camera", lambda a: a - 1),
        ("xy", lambda a: a[:-1]),
        ("xy", lambda a: a * np.nan),
        ("weights", lambda a: a * np.inf),
        ("disparity", lambda a: a * np.inf),
        ("points_world", lambda a: a * np.nan),
        ("Ts_world_body", lambda a: a * np.nan),
        ("Ts_camera_body", lambda a: a * np.nan),
        ("baselines", lambda a: a * np.nan),
        ("is_fixed", lambda a: a[:-1]),
    ],
)
def test_arrays_that_do_not_fit_are_refused(scene, name, change):
    bundle = scene.bundle()
    with pytest.raises(InputError, match="bundle: "):
        replace(bundle, **{name: change(getattr(bundle, name))})
