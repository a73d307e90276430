"""The bundle of a local window: it finds the truth, says what disagrees, and moves nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.backend.bundle import BundleConfig
from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.system.creating import CreateConfig, Created, create_landmarks
from odomap.system.localbundle import adjust_window
from odomap.system.localmap import median_distance
from odomap.vision.matching import MatchConfig
from windowworlds import CAMERA, circle, keep_observations, row, with_features, world

CONFIG = BundleConfig(iterations=20, tolerance=1e-6)
GATE = 3.5
NONE = np.empty(0, np.int64)
NOTHING = Created(np.empty((0, 3)), NONE, NONE, NONE, 0, {})
MOUNT = se3_exp(np.array([0.1, -0.2, 0.05, 0.3, -0.4, 0.2]))


def adjust(window, created=NOTHING, mount=None, config=CONFIG):
    return adjust_window(window, created, np.eye(4) if mount is None else mount, config, GATE)


def disturbed(window, metres=0.02, degrees=0.3, points_off=0.02, seed=1):
    """Return the window with free poses and all points off."""
    rng = np.random.default_rng(seed)
    xi = rng.normal(size=(len(window.keyframes), 6)) * np.repeat([metres, np.radians(degrees)], 3)
    xi[window.is_fixed] = 0.0
    points = window.points_world
    return replace(
        window,
        Ts_world_camera=window.Ts_world_camera @ se3_exp(xi),
        points_world=points + points_off * rng.normal(size=points.shape),
    )


def errors(adjusted, Ts):
    return se3_log(se3_inverse(Ts) @ adjusted.Ts_world_body)


def moved_keypoints(window, k, rows, by_px):
    """Return the window with some keypoints of a keyframe elsewhere."""
    keypoints = window.features(k).keypoints.copy()
    keypoints[rows] += by_px
    return with_features(window, k, keypoints=keypoints, bearings=CAMERA.unproject(keypoints))


@pytest.mark.parametrize(("fixed", "sigma_depth"), [(2, 0.0), (1, 0.003)])
def test_the_truth_is_found(fixed, sigma_depth):
    made = world(fixed=fixed, sigma_depth=sigma_depth, known=1.0)
    window = disturbed(made.window, points_off=0.2)
    adjusted = adjust(window)
    off = errors(adjusted, made.window.Ts_world_camera)
    # Each pose is known as well as its covariance says, and that is well.
    free = np.flatnonzero(~window.is_fixed)
    nees = [off[k] @ np.linalg.solve(adjusted.solution.covariances[k], off[k]) / 6 for k in free]
    assert 0.2 < np.mean(nees) < 3
    assert np.abs(off[:, :3]).max() < 0.02
    assert np.abs(off[:, 3:]).max() < 0.003
    # It counts only what fits, so it is a little low.
    assert 0.8 < adjusted.solution.variance_factor < 1.1
    before = np.linalg.norm(window.points_world - made.points[made.landmarks], axis=1)
    after = np.linalg.norm(adjusted.points_world - made.points[made.landmarks], axis=1)
    assert np.median(after) < 0.3 * np.median(before)
    assert adjusted.has_depth == (sigma_depth > 0)
    assert not adjusted.is_scale_free
    # Of noise, hardly anything lies beyond three and a half standard deviations.
    assert adjusted.is_wrong.mean() < 0.01


def test_without_noise_the_truth_is_exact():
    made = world(fixed=2, sigma_px=0.0, known=1.0)
    adjusted = adjust(disturbed(made.window), config=BundleConfig(iterations=50, tolerance=1e-12))
    # Keypoints are single precision numbers: 3e-5 px.
    assert np.abs(errors(adjusted, made.window.Ts_world_camera)).max() < 1e-5
    np.testing.assert_allclose(adjusted.points_world, made.points[made.landmarks], atol=1e-4)


def test_what_is_fixed_stays_to_the_last_bit():
    made = world(fixed=3)
    window = disturbed(made.window)
    adjusted = adjust(window)
    fixed = window.is_fixed
    np.testing.assert_array_equal(adjusted.Ts_world_body[fixed], window.Ts_world_camera[fixed])
    assert (adjusted.Ts_world_body[~fixed] != window.Ts_world_camera[~fixed]).any(axis=(1, 2)).all()
    seen = np.unique(window.obs_landmark[~fixed[window.obs_keyframe]])
    others = np.setdiff1d(np.arange(len(window.points_world)), seen)
    np.testing.assert_array_equal(adjusted.points_world[others], window.points_world[others])


def test_landmarks_that_only_fixed_keyframes_see_are_left_alone():
    window = world(fixed=2).window
    lonely = np.arange(0, len(window.points_world), 5)
    free = ~window.is_fixed[window.obs_keyframe]
    window = keep_observations(window, ~(free & np.isin(window.obs_landmark, lonely)))
    rng = np.random.default_rng(0)
    points = window.points_world.copy()
    points[lonely] += rng.normal(size=(len(lonely), 3))
    adjusted = adjust(replace(window, points_world=points))
    np.testing.assert_array_equal(adjusted.points_world[lonely], points[lonely])
    # They are a metre off: if they had been asked, they would have been called wrong.
    assert not adjusted.is_wrong[np.isin(window.obs_landmark, lonely)].any()
    others = np.setdiff1d(np.unique(window.obs_landmark), lonely)
    assert (adjusted.points_world[others] != points[others]).any()


def test_wrong_observations_are_told_from_right_ones():
    made = world(fixed=2, known=1.0)
    rng = np.random.default_rng(4)
    window, injected = made.window, np.zeros(len(made.window.obs_keyframe), bool)
    for k in range(len(window.keyframes)):
        of = np.flatnonzero(window.obs_keyframe == k)
        chosen = rng.choice(of, len(of) // 12, replace=False)
        angle = rng.uniform(0, 2 * np.pi, len(chosen))
        by = 25.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        level = window.features(k).level[window.obs_keypoint[chosen]]
        window = moved_keypoints(window, k, window.obs_keypoint[chosen], by * 1.2 ** level[:, None])
        injected[chosen] = True
    adjusted = adjust(disturbed(window))
    assert adjusted.is_wrong[injected].mean() > 0.95
    assert adjusted.is_wrong[~injected].mean() < 0.02
    off = errors(adjusted, made.window.Ts_world_camera)
    assert np.abs(off[:, :3]).max() < 0.03
    # Huber's loss bounds what they pull: a few millimetres, not the metres they claim.
    assert np.abs(off[:, 3:]).max() < 0.004


def test_created_points_take_part():
    made = world(row(6, 0.4), fixed=2, known=0.3)
    window = made.window
    created = create_landmarks(window, CreateConfig(), MatchConfig())
    assert len(created) > 50
    first = np.unique(created.obs_point, return_index=True)[1]
    truth = made.points[made.point_at[window.newest][created.obs_keypoint[first]]]
    rng = np.random.default_rng(2)
    pushed = replace(created, points_world=created.points_world + 0.05 * rng.normal(size=(1, 3)))
    adjusted = adjust(window, pushed)
    assert adjusted.created_world.shape == created.points_world.shape
    off = np.median(np.linalg.norm(adjusted.created_world - truth, axis=1))
    assert off < 0.5 * np.median(np.linalg.norm(pushed.points_world - truth, axis=1)) or off < 0.05
    assert adjusted.is_created_wrong.shape == created.obs_point.shape
    assert adjusted.is_created_wrong.mean() < 0.05
    # They help to place the keyframes: those are known better with them than without.
    newest = window.newest
    alone = adjust(window).solution.covariances[newest]
    assert np.trace(adjusted.solution.covariances[newest]) < 0.9 * np.trace(alone)


def test_a_wrong_sight_of_a_created_point_is_told():
    made = world(row(6, 0.4), fixed=2, known=0.5)
    created = create_landmarks(made.window, CreateConfig(), MatchConfig())
    many = np.flatnonzero(np.bincount(created.obs_point) >= 4)
    assert len(many) > 5
    last = np.array([np.flatnonzero(created.obs_point == p)[-1] for p in many])
    window = made.window
    for o in last.tolist():
        window = moved_keypoints(
            window, created.obs_keyframe[o], [created.obs_keypoint[o]], [0.0, 40.0]
        )
    adjusted = adjust(window, created)
    assert adjusted.is_created_wrong[last].mean() > 0.9
    assert np.delete(adjusted.is_created_wrong, last).mean() < 0.1


def test_a_camera_that_is_not_the_body():
    made = world(fixed=2)
    window = disturbed(made.window)
    config = BundleConfig(iterations=50, tolerance=1e-10)
    plain, mounted = adjust(window, config=config), adjust(window, mount=MOUNT, config=config)
    np.testing.assert_allclose(mounted.Ts_world_body @ MOUNT, plain.Ts_world_body, atol=1e-5)
    np.testing.assert_allclose(mounted.points_world, plain.points_world, atol=1e-3)
    np.testing.assert_array_equal(mounted.is_wrong, plain.is_wrong)


def test_the_size_is_held_where_nothing_measures_it():
    made = world(fixed=1)
    window = disturbed(made.window)
    alone = adjust(window)
    assert alone.is_scale_free
    assert not alone.has_depth
    # Two fixed keyframes tell the size, unless they are one.
    assert not adjust(disturbed(world(fixed=2).window)).is_scale_free
    twice = np.concatenate([row(6)[:1], row(6)])
    assert adjust(world(twice, fixed=2).window).is_scale_free
    apart = window.Ts_world_camera[:, :3, 3] - window.Ts_world_camera[0, :3, 3]
    after = alone.Ts_world_body[:, :3, 3] - alone.Ts_world_body[0, :3, 3]
    assert np.linalg.norm(after) == pytest.approx(np.linalg.norm(apart), rel=0.03)


def test_a_known_bias_of_depth_is_removed():
    made = world(circle(6), sigma_depth=0.002, known=1.0)
    bias = np.array([0.01, -0.008, 0.005])
    window = made.window
    for k in range(len(window.keyframes)):
        features = window.features(k)
        x, y = (features.bearings[:, :2] / features.bearings[:, 2:]).T
        depth = 1.0 / (1.0 / features.depth + bias[0] + bias[1] * x + bias[2] * y)
        window = with_features(window, k, depth=depth)
    right = adjust(made.window)
    known = adjust(replace(window, inverse_depth_bias=bias))
    np.testing.assert_allclose(known.Ts_world_body, right.Ts_world_body, atol=1e-9)
    unknown = adjust(window)
    truth = made.window.Ts_world_camera
    assert np.abs(errors(unknown, truth)).max() > 3 * np.abs(errors(right, truth)).max()


def test_the_same_window_gives_the_same_bytes():
    window = disturbed(world(fixed=2).window)
    first, second = adjust(window), adjust(window)
    np.testing.assert_array_equal(first.Ts_world_body, second.Ts_world_body)
    np.testing.assert_array_equal(first.points_world, second.points_world)
    np.testing.assert_array_equal(first.solution.chi2, second.solution.chi2)


def test_the_typical_distance():
    points = np.array([[0.0, 0, 3], [0, 0, 5], [0, 0, 100]])
    assert median_distance(points, np.zeros(3)) == 5.0
    assert median_distance(points[:0], np.zeros(3)) == 1.0
