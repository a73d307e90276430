import numpy as np
import pytest

from odomap.errors import InputError
from odomap.geometry import twoview
from odomap.geometry.fivepoint import essential_from_five
from odomap.geometry.pose import SE3
from reference import numeric_jacobian

FOCAL = 450.0


def scene(n, seed, noise_px=0.0, outliers=0.0, flat=False):
    """A motion of unit length, what both views see, and which matches are wrong."""
    rng = np.random.default_rng(seed)
    t = rng.normal(size=3)
    T = SE3.from_parts(SE3.exp([0, 0, 0, *(0.2 * rng.normal(size=3))]).R, t / np.linalg.norm(t))
    points = rng.uniform([-3, -2, 4], [3, 2, 12], (n, 3))
    if flat:
        points[:, 2] = 8 + 0.2 * points[:, 0] - 0.1 * points[:, 1]
    moved = T @ points
    a, b = points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:]
    a = a + noise_px / FOCAL * rng.normal(size=a.shape)
    b = b + noise_px / FOCAL * rng.normal(size=b.shape)
    bad = rng.permutation(n) < outliers * n
    b[bad] = rng.uniform(-0.6, 0.6, (bad.sum(), 2))
    return T, points, a, b, bad


def angle_deg(a, b):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def test_five_points_always_contain_the_truth():
    for seed in range(200):
        T, _, a, b, _ = scene(5, seed)
        E = twoview.essential_matrix(T)
        E /= np.linalg.norm(E)
        found = essential_from_five(a[None], b[None])
        assert 1 <= len(found) <= 10
        nearest = min(min(np.abs(f - E).max(), np.abs(f + E).max()) for f in found)
        assert nearest < 1e-6


def test_every_solution_is_an_essential_matrix_of_the_points():
    _, _, a, b, _ = scene(40, 1)
    rows = np.arange(40).reshape(8, 5)
    found = essential_from_five(a[rows], b[rows])
    values = np.linalg.svd(found, compute_uv=False)
    np.testing.assert_allclose(values[:, 2], 0.0, atol=1e-8)
    np.testing.assert_allclose(values[:, 0], values[:, 1], atol=1e-8)
    fits = [min(np.abs(twoview.sampson_distance(E, a[r], b[r])).max() for r in rows) for E in found]
    assert max(fits) < 1e-9


def test_degenerate_samples_do_no_harm():
    same = np.zeros((1, 5, 2))
    assert np.all(np.isfinite(essential_from_five(same, same)))
    good = scene(5, 3)[2:4]
    both = essential_from_five(np.stack([same[0], good[0]]), np.stack([same[0], good[1]]))
    assert len(both) >= 1


def test_sampson_distance_is_the_distance_to_the_nearest_true_match():
    T, _, a, b, _ = scene(50, 4)
    E = twoview.essential_matrix(T)
    assert np.abs(twoview.sampson_distance(E, a, b)).max() < 1e-14
    # Move each match across the constraint surface by a known small amount.
    ones = np.ones((50, 1))
    slope = np.hstack([(np.hstack([b, ones]) @ E)[:, :2], (np.hstack([a, ones]) @ E.T)[:, :2]])
    step = 1e-4 * slope / np.linalg.norm(slope, axis=1, keepdims=True)
    d = twoview.sampson_distance(E, a + step[:, :2], b + step[:, 2:])
    np.testing.assert_allclose(d, 1e-4, rtol=1e-2)


def test_sampson_jacobian_against_differences():
    T, _, a, b, _ = scene(20, 5, noise_px=3.0)

    def moved(step):
        E = twoview.essential_matrix(twoview._turned(T, step))
        return twoview.sampson_distance(E, a, b)

    expected = numeric_jacobian(moved, 5)
    np.testing.assert_allclose(twoview.sampson_jacobian(T, a, b), expected, rtol=0, atol=1e-9)


def test_recover_pose_picks_the_one_of_four():
    for seed in range(20):
        T, _, a, b, _ = scene(30, seed)
        four = twoview.motions_of_essential(-3.0 * twoview.essential_matrix(T))
        assert min(np.abs(m.matrix - T.matrix).max() for m in four) < 1e-9
        found, ahead = twoview.recover_pose(twoview.essential_matrix(T), a, b)
        np.testing.assert_allclose(found.matrix, T.matrix, atol=1e-9)
        assert ahead.all()
        some = np.arange(30) < 9
        assert np.array_equal(
            twoview.recover_pose(-twoview.essential_matrix(T), a, b, some)[1], some
        )


@pytest.mark.parametrize("outliers", [0.3, 0.5])
def test_a_motion_is_found_among_outliers(outliers):
    turns, directions = [], []
    for seed in range(8):
        T, points, a, b, bad = scene(300, seed, noise_px=0.5, outliers=outliers)
        found = twoview.relative_pose(a, b, 2.0 / FOCAL, seed=seed)
        assert found.converged
        assert np.linalg.norm(found.T_second_first.t) == pytest.approx(1.0)
        turns.append(np.degrees(np.linalg.norm((found.T_second_first.inverse() @ T).log()[3:])))
        directions.append(angle_deg(found.T_second_first.t, T.t))
        assert found.inliers[~bad].mean() > 0.97
        assert found.num_inliers == found.inliers.sum()
        good = found.inliers & ~bad & (found.parallax > 0.05)
        gap = np.linalg.norm(found.points_first[good] - points[good], axis=1)
        assert np.median(gap / points[good, 2]) < 0.08
        assert np.isnan(found.points_first[~found.inliers]).all()
    assert np.median(turns) < 0.25
    assert np.median(directions) < 1.0


def test_exact_matches_give_the_exact_motion_and_the_seed_decides():
    T, _, a, b, bad = scene(80, 9, outliers=0.4)
    first = twoview.relative_pose(a, b, 1e-6, seed=3)
    np.testing.assert_allclose(first.T_second_first.matrix, T.matrix, atol=1e-7)
    assert np.array_equal(first.inliers, ~bad)
    again = twoview.relative_pose(a, b, 1e-6, seed=3)
    assert first.T_second_first == again.T_second_first
    assert first.iterations == again.iterations


def test_noise_has_no_motion():
    rng = np.random.default_rng(1)
    a, b = rng.uniform(-0.6, 0.6, (2, 60, 2))
    found = twoview.relative_pose(a, b, 0.5 / FOCAL, max_iterations=100, min_inliers=20)
    assert not found.converged
    assert found.num_inliers == 0
    assert twoview.relative_pose(a[:4], b[:4], 0.01).converged is False


def test_homography_of_a_plane():
    T, _, a, b, _ = scene(60, 2, flat=True)
    plane = np.array([-0.2, 0.1, 1.0]) / 8.0
    truth = T.R + np.outer(T.t, plane)
    truth /= np.linalg.norm(truth)
    found = twoview.homography(a, b)
    np.testing.assert_allclose(found * np.sign(found[2, 2] * truth[2, 2]), truth, atol=1e-10)
    four = twoview.homography(a[:8].reshape(2, 4, 2), b[:8].reshape(2, 4, 2))
    assert four.shape == (2, 3, 3)


@pytest.mark.parametrize("outliers", [0.3, 0.5])
def test_a_homography_is_found_among_outliers(outliers):
    for seed in range(5):
        _, _, a, b, bad = scene(200, seed, noise_px=0.5, outliers=outliers, flat=True)
        found = twoview.homography_ransac(a, b, 3.0 / FOCAL, seed=seed)
        assert found.inliers[~bad].mean() > 0.97
        assert found.inliers[bad].mean() < 0.1
    rng = np.random.default_rng(1)
    noise = rng.uniform(-1, 1, (2, 60, 2))
    nothing = twoview.homography_ransac(*noise, 0.5 / FOCAL, max_iterations=50)
    assert nothing.model is None


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: twoview.relative_pose(np.zeros((9, 2)), np.zeros((8, 2)), 1.0), "shapes"),
        (lambda: twoview.relative_pose(np.zeros((9, 3)), np.zeros((9, 3)), 1.0), "first"),
        (lambda: twoview.relative_pose(*np.full((2, 9, 2), np.nan), 1.0), "NaN"),
        (lambda: twoview.relative_pose(*np.zeros((2, 9, 2)), -1.0), "threshold"),
        (lambda: twoview.homography(np.zeros((3, 2)), np.zeros((3, 2))), "N ≥ 4"),
        (lambda: essential_from_five(np.zeros((5, 2)), np.zeros((5, 2))), "shapes"),
    ],
)
def test_wrong_input_is_named(call, words):
    with pytest.raises(InputError, match=words):
        call()
