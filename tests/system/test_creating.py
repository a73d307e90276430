"""Creating landmarks: true points come of true matches, and nothing comes of anything else."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.errors import ConfigError
from odomap.geometry.lie import se3_exp
from odomap.system.creating import CHECKS, CreateConfig, create_landmarks
from odomap.system.creating_kernels import judge
from odomap.vision.matching import MatchConfig
from windowworlds import circle, flipped, row, turning, with_features, world

CONFIG, MATCHING = CreateConfig(), MatchConfig()


def create(window, **how):
    return create_landmarks(window, replace(CONFIG, **how), MATCHING)


def truth_of(w, created):
    """Return the point of each observation, and of each created landmark."""
    seen = np.array(
        [w.point_at[k][i] for k, i in zip(created.obs_keyframe, created.obs_keypoint, strict=True)]
    )
    first = np.searchsorted(created.obs_point, np.arange(len(created)))
    assert np.all(created.obs_keyframe[first] == w.window.newest)
    return seen, seen[first]


def sightings(w):
    """Return (K, P) which points without landmark are seen where."""
    seen = np.zeros((len(w.point_at), len(w.points)), bool)
    for k, who in enumerate(w.point_at):
        seen[k, who[who >= 0]] = True
    seen[:, w.landmarks] = False
    return seen


WORLDS = {
    "row": {},
    "circle": {"Ts": circle(8)},
    "noisy": {"sigma_px": 1.0, "flips": 0.1},
    "crowded": {"count": 1200, "clutter": 300},
    "depth": {"sigma_depth": 0.002},
}


@pytest.mark.parametrize("name", WORLDS)
def test_true_points_are_made(name):
    w = world(**WORLDS[name])
    created = create(w.window)
    seen, point = truth_of(w, created)
    assert np.mean((seen == point[created.obs_point]) & (seen >= 0)) > 0.99
    assert len(set(point.tolist())) == len(point)
    everywhere = sightings(w)
    able = everywhere[-1] & everywhere[:-1].any(axis=0)
    assert np.mean(np.isin(np.flatnonzero(able), point)) > 0.9
    # nearly all who see one are told so, and not only the first neighbour
    assert len(seen) > 0.85 * everywhere[:, point].sum()
    off = np.linalg.norm(created.points_world - w.points[point], axis=1) / w.points[point, 2]
    assert np.median(off) < 0.03


def test_measured_depth_helps():
    errors = []
    for sigma in (0.0, 0.002):
        w = world(sigma_depth=sigma)
        created = create(w.window)
        _, point = truth_of(w, created)
        off = np.linalg.norm(created.points_world - w.points[point], axis=1)
        errors.append(np.sqrt(np.mean((off / w.points[point, 2]) ** 2)))
    assert errors[1] < 0.6 * errors[0]


def test_no_keypoint_is_used_twice():
    w = world(flips=0.15, count=800, sigma_px=1.0)
    created = create(w.window)
    used = list(zip(created.obs_keyframe.tolist(), created.obs_keypoint.tolist(), strict=True))
    assert len(set(used)) == len(used) > 300
    seen_by = list(zip(created.obs_point.tolist(), created.obs_keyframe.tolist(), strict=True))
    assert len(set(seen_by)) == len(seen_by)
    for k, i in used:
        assert w.window.landmark_at(k)[i] < 0
    assert np.all(np.diff(created.obs_point) >= 0)


def test_wrong_descriptors_make_nothing():
    w = world()
    rng = np.random.default_rng(1)
    other = rng.integers(0, 256, w.window.features(5).descriptors.shape, np.uint8)
    assert len(create(with_features(w.window, 5, descriptors=other))) == 0
    # each keypoint with the look of another: by chance one lies on the epipolar line of all
    shuffled = rng.permutation(w.window.features(5).descriptors)
    assert len(create(with_features(w.window, 5, descriptors=shuffled))) < 0.05 * len(
        create(w.window)
    )


def test_a_pure_turn_makes_nothing():
    window = world(turning(6)).window
    assert len(create(window)) == 0
    assert create(window).failed["baseline"] == 5
    assert len(create(window, min_baseline=0.0)) == 0
    # what little the camera sways makes epipolar lines, but tells no depth
    sway = turning(6)
    sway[:, 0, 3] = 0.01 * np.arange(6)
    swayed = create(world(sway).window, min_baseline=0.0)
    assert len(swayed) == 0
    assert swayed.failed["parallax"] > 100


def test_a_turn_with_measured_depth_makes_points():
    Ts = turning(6)
    Ts[:, 0, 3] = 0.005 * np.arange(6)
    w = world(Ts, sigma_depth=0.002)
    created = create(w.window, min_baseline=0.0)
    seen, point = truth_of(w, created)
    assert len(created) > 80
    assert np.mean(seen == point[created.obs_point]) > 0.99
    off = np.linalg.norm(created.points_world - w.points[point], axis=1) / w.points[point, 2]
    assert np.sqrt(np.mean(off**2)) < 0.02
    # a rig says in metres how near is too near
    assert len(create_landmarks(w.window, CONFIG, MATCHING, min_baseline=0.1)) == 0


def test_neighbours_too_near_are_passed_over():
    Ts = row(5)
    Ts[1:4] = Ts[4]
    Ts[1:4, 0, 3] -= [0.01, 0.02, 0.03]
    created = create(world(Ts, fixed=0).window)
    assert created.failed["baseline"] == 3
    assert set(created.obs_keyframe.tolist()) == {0, 4}
    metric = create_landmarks(world(row(5)).window, CONFIG, MATCHING, min_baseline=0.7)
    assert set(metric.obs_keyframe.tolist()) == {0, 1, 4}


def test_only_the_most_covisible_are_searched():
    window = world(row(8, 0.5)).window
    created = create(window, neighbours=2)
    assert set(created.obs_keyframe.tolist()) == {5, 6, 7}


def test_sizes_must_follow_distances():
    window = world().window
    coarse = with_features(window, 5, level=window.features(5).level + np.uint8(6))
    created = create(coarse)
    assert created.failed["scale"] > 0.9 * created.matched
    assert len(create(coarse, scale_tolerance=4.0)) > 100


def test_depth_that_contradicts_the_rays_makes_nothing():
    window = world(sigma_depth=0.001).window
    wrong = with_features(window, 5, depth=1.3 * window.features(5).depth)
    created = create(wrong)
    assert created.failed["reprojection"] > 0.9 * created.matched
    assert len(create(window)) > 150


def test_rays_that_meet_behind_make_nothing():
    # the poses of two views exchanged: rays of true matches part ahead and meet behind
    w = world(row(2, 1.0), fixed=0)
    back = replace(w.window, Ts_world_camera=w.window.Ts_world_camera[::-1].copy())
    created = create(back)
    assert len(created) == 0
    assert created.failed["behind"] > 0.9 * created.matched > 0


@pytest.mark.parametrize("seed", range(2))
def test_the_order_of_rows_does_not_matter(seed):
    w = world(seed=seed, flips=0.1)
    rng = np.random.default_rng(seed)
    window, rows = w.window, rng.permutation(6)
    where = np.argsort(rows)
    order = rng.permutation(len(window.obs_keyframe))
    shuffled = replace(
        window,
        keyframes=tuple(window.keyframes[k] for k in rows),
        is_fixed=window.is_fixed[rows],
        Ts_world_camera=window.Ts_world_camera[rows],
        obs_keyframe=where[window.obs_keyframe[order]],
        obs_landmark=window.obs_landmark[order],
        obs_keypoint=window.obs_keypoint[order],
        newest=int(where[5]),
    )
    one, other = create(window), create(shuffled)
    np.testing.assert_allclose(other.points_world, one.points_world, atol=1e-9)
    seen = set(zip(one.obs_point, one.obs_keyframe, one.obs_keypoint, strict=True))
    also = set(zip(other.obs_point, rows[other.obs_keyframe], other.obs_keypoint, strict=True))
    assert also == seen


def test_the_same_window_makes_the_same_bytes():
    one, other = create(world().window), create(world().window)
    assert one.points_world.tobytes() == other.points_world.tobytes()
    assert one.obs_keypoint.tobytes() == other.obs_keypoint.tobytes()


def test_a_keyframe_alone_makes_nothing():
    window = world(row(1), fixed=0).window
    assert len(create(window)) == 0
    # nor does one that shares no landmark with any other
    assert len(create(world(known=0.0).window)) == 0


def test_poses_a_little_off_make_the_same_points():
    w = world()
    xi = 0.001 * np.random.default_rng(0).normal(size=(6, 6))
    off = replace(w.window, Ts_world_camera=w.window.Ts_world_camera @ se3_exp(xi))
    created = create(off)
    seen, point = truth_of(w, created)
    assert len(created) > 0.95 * len(create(w.window))
    assert np.mean(seen == point[created.obs_point]) > 0.99


@pytest.mark.parametrize("with_depth", [False, True])
def test_a_point_is_the_least_squares_one(with_depth):
    rng = np.random.default_rng(3)
    n = 40
    truth = rng.uniform([-2, -2, 4], [2, 2, 8], (n, 3))
    t = np.array([[0.0, 0, 0], [-0.5, 0.1, 0.2]])
    Ts = np.concatenate([np.tile(np.eye(3), (2, 1, 1)), t[:, :, None]], axis=2)
    noise = np.array([1e-3, 2e-3, 1e-3, 9.0])
    seen = []
    for k in range(2):
        p = truth + t[k]
        inverse = (
            1.0 / p[:, 2] + noise[1] * rng.normal(size=n) if with_depth else np.full(n, np.nan)
        )
        xy = p[:, :2] / p[:, 2:] + noise[0] * rng.normal(size=(n, 2))
        seen.append(np.column_stack([xy, inverse, np.ones(n)]))

    def cost(points):
        total = np.zeros(n)
        for k in range(2):
            p = points + t[k]
            r = (p[:, :2] / p[:, 2:] - seen[k][:, :2]) / noise[0]
            d = (1.0 / p[:, 2] - seen[k][:, 2]) / noise[1]
            total += np.sum(r * r, axis=1) + np.nan_to_num(d) ** 2
        return total

    points, parallax, verdict = np.zeros((n, 3)), np.zeros(n), np.zeros(n, np.int64)
    judge(seen[0], seen[1], np.ones(n, np.int64), Ts, noise, 0, points, parallax, verdict)
    good = np.isin(verdict, (0, 1 + CHECKS.index("reprojection")))
    assert good.sum() > 35
    for axis in range(3):
        for step in (-0.02, 0.02):
            moved = points + step * np.eye(3)[axis]
            assert np.all(cost(points)[good] < cost(moved)[good])
    apart = truth + t[1]
    angle = np.arccos(
        np.sum(truth * apart, axis=1)
        / np.linalg.norm(truth, axis=1)
        / np.linalg.norm(apart, axis=1)
    )
    worth = np.hypot(1 / truth[:, 2], 1 / apart[:, 2]) * noise[0] / noise[1] if with_depth else 0.0
    np.testing.assert_allclose(parallax, np.hypot(angle, worth), rtol=0.1)


def test_limits():
    with pytest.raises(ConfigError, match="min_parallax_deg"):
        CreateConfig(min_parallax_deg=0.0)
    with pytest.raises(ConfigError, match="scale_tolerance"):
        CreateConfig(scale_tolerance=0.5)


def test_some_wrong_bits_are_borne():
    w = world()
    rng = np.random.default_rng(0)
    worse = flipped(w.window.features(5).descriptors, 0.1, rng)
    assert len(create(with_features(w.window, 5, descriptors=worse))) > 0.8 * len(create(w.window))
