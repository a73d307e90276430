import numpy as np
import pytest

from odomap.errors import InputError
from odomap.geometry import p3p_kernels, pnp_kernels
from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_exp
from odomap.geometry.pnp import p3p, refine_pose, solve_pnp
from odomap.geometry.pose import SE3
from reference import numeric_jacobian, pixel_errors

CAMERA = Camera(
    "pinhole",
    [458.654, 457.296, 367.215, 248.375],
    [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05],
    (752, 480),
)


def scene(n, seed, noise_px=0.0, outliers=0.0):
    """A pose, points, where they are seen, and which of them are matched wrongly."""
    rng = np.random.default_rng(seed)
    T = SE3.exp([*rng.normal(size=3), *(0.5 * rng.normal(size=3))])
    pixels = rng.uniform([5, 5], [746, 474], (n, 2))
    rays = np.c_[CAMERA.undistort(pixels), np.ones(n)]
    points = T @ (rays * rng.uniform(2, 12, (n, 1)))
    pixels = pixels + noise_px * rng.normal(size=(n, 2))
    bad = rng.permutation(n) < outliers * n
    pixels[bad] = rng.uniform([0, 0], [751, 479], (bad.sum(), 2))
    return T, points, pixels, bad


def test_p3p_always_contains_the_truth():
    rng = np.random.default_rng(1)
    worst = []
    for _ in range(500):
        T = SE3.exp(rng.normal(size=6))
        local = rng.uniform([-2, -2, 1], [2, 2, 8], (3, 3))
        poses = p3p(T @ local, local / np.linalg.norm(local, axis=1, keepdims=True))
        assert 1 <= len(poses) <= 4
        worst.append(min(np.abs((pose.inverse() @ T).log()).max() for pose in poses))
        for pose in poses:
            seen = pose.inverse() @ (T @ local)
            np.testing.assert_allclose(np.cross(seen, local), 0.0, atol=1e-4)
            assert np.all(seen[:, 2] > 0)
    assert np.max(worst) < 1e-6
    assert np.median(worst) < 1e-13


def test_p3p_of_symmetric_triangles():
    # An equilateral triangle seen straight on: the textbook's hardest easy case.
    corners = np.array([[1.0, 0.0, 0.0], [-0.5, 0.75**0.5, 0.0], [-0.5, -(0.75**0.5), 0.0]])
    for height in (0.5, 1.0, 2.0**0.5, 5.0):
        local = corners + np.array([0.0, 0.0, height])
        poses = p3p(corners, local)
        assert min(np.abs(p.t - [0, 0, -height]).max() for p in poses) < 1e-6


def test_p3p_of_points_that_coincide_or_lie_on_a_line():
    rays = np.eye(3) + 1.0
    assert p3p(np.zeros((3, 3)), rays) == []
    assert p3p([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]], rays) == []


def kernel_problem(seed=1):
    T, points, pixels, _ = scene(12, seed, noise_px=2.0)
    plane = CAMERA.undistort(pixels)
    slopes = CAMERA.project_jacobian(np.c_[plane, np.ones(12)])[:, :, :2].copy()
    return T, points, plane, slopes


def test_gather_pose_is_its_plain_twin_and_its_jacobian_the_difference():
    T, points, plane, slopes = kernel_problem()
    weights = np.linspace(0.0, 2.0, 12)

    def residuals(xi):
        moved = T.matrix @ se3_exp(xi)
        return pixel_errors(moved[:3, :3], moved[:3, 3], points, plane, slopes)

    r, J = residuals(np.zeros(6)), numeric_jacobian(residuals, 6)
    for huber in (1e9, 1.0):
        s = weights * np.sum(r * r, axis=1)
        root = np.sqrt(np.maximum(s, huber**2))
        w = weights * huber / root
        H, g = np.zeros((6, 6)), np.zeros(6)
        cost = pnp_kernels.gather_pose(
            T.R.copy(), T.t.copy(), points, plane, slopes, weights, huber, H, g
        )
        expected = np.einsum("nki,n,nkj->ij", J, w, J)
        np.testing.assert_allclose(H, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
        np.testing.assert_allclose(g, np.einsum("nki,n,nk->i", J, w, r), rtol=1e-6, atol=1e-4)
        rho = np.where(s <= huber**2, s, 2 * huber * np.sqrt(s) - huber**2)
        assert cost == pytest.approx(np.sum(rho))


def test_score_pose_is_its_plain_twin():
    T, points, plane, slopes = kernel_problem()
    points[0] = T @ [0.0, 0.0, -1.0]
    inliers = np.zeros(12, dtype=np.bool_)
    back = T.inverse()
    cost = pnp_kernels.score_pose(back.R.copy(), back.t.copy(), points, plane, slopes, 4.0, inliers)
    r2 = np.sum(pixel_errors(T.R, T.t, points, plane, slopes) ** 2, axis=1)
    r2[0] = np.inf
    assert cost == pytest.approx(np.sum(np.minimum(r2, 4.0)))
    np.testing.assert_array_equal(inliers, r2 <= 4.0)
    assert 0 < inliers.sum() < 12


def test_cholesky_solve():
    A = np.random.default_rng(2).normal(size=(9, 6))
    A, x = A.T @ A, np.zeros(6)
    assert pnp_kernels.cholesky_solve(A.copy(), np.arange(6.0), x)
    np.testing.assert_allclose(A @ x, np.arange(6.0), atol=1e-10)
    assert not pnp_kernels.cholesky_solve(-A, np.arange(6.0), x)


@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.5, 0.7])
def test_exact_points_give_the_exact_pose_among_outliers(outliers):
    for seed in range(5):
        T, points, pixels, bad = scene(100, seed, outliers=outliers)
        found = solve_pnp(points, pixels, CAMERA, seed=seed, threshold_px=1.0)
        assert found.converged
        assert found.reason == ""
        np.testing.assert_allclose(found.T_world_camera.matrix, T.matrix, atol=1e-9)
        assert found.inliers[~bad].all()
        assert found.num_inliers <= (~bad).sum() + 3


@pytest.mark.parametrize(("n", "outliers"), [(40, 0.5), (150, 0.3)])
def test_the_covariance_is_honest(n, outliers):
    nees, rms = [], []
    for seed in range(200):
        T, points, pixels, _ = scene(n, seed, noise_px=1.0, outliers=outliers)
        found = solve_pnp(points, pixels, CAMERA, seed=seed, threshold_px=4.0)
        error = (T.inverse() @ found.T_world_camera).log()
        nees.append(error @ np.linalg.solve(found.covariance, error) / 6)
        rms.append(found.rms_px)
    assert 0.8 < np.mean(nees) < 1.25
    assert np.mean(rms) == pytest.approx(np.sqrt(2.0), rel=0.1)


def test_each_point_may_have_its_own_noise():
    nees = []
    for seed in range(150):
        sigma = np.random.default_rng(seed).uniform(0.3, 2.0, 60)
        T, points, pixels, _ = scene(60, seed)
        pixels = pixels + sigma[:, None] * np.random.default_rng(seed + 999).normal(size=(60, 2))
        found = solve_pnp(points, pixels, CAMERA, seed=seed, threshold_px=10.0, sigma_px=sigma)
        error = (T.inverse() @ found.T_world_camera).log()
        nees.append(error @ np.linalg.solve(found.covariance, error) / 6)
    assert 0.8 < np.mean(nees) < 1.25


def test_the_seed_decides_and_rows_with_nan_are_outliers():
    _, points, pixels, _ = scene(80, 3, noise_px=1.0, outliers=0.4)
    points[5], pixels[7] = np.nan, np.nan
    first = solve_pnp(points, pixels, CAMERA, seed=11)
    again = solve_pnp(points, pixels, CAMERA, seed=11)
    assert first.T_world_camera == again.T_world_camera
    assert first.iterations == again.iterations
    np.testing.assert_array_equal(first.covariance, again.covariance)
    assert first.inliers.shape == (80,)
    assert not first.inliers[[5, 7]].any()
    assert first.converged


def test_what_cannot_be_found_is_said():
    _, points, pixels, _ = scene(60, 4, outliers=1.0)
    lost = solve_pnp(points, pixels, CAMERA, min_inliers=15, max_iterations=50)
    assert not lost.converged
    assert "inliers of 15 needed" in lost.reason
    assert lost.num_inliers == 0
    assert np.all(np.isinf(lost.covariance))
    few = solve_pnp(points[:3], pixels[:3], CAMERA)
    assert few.reason == "3 usable points of 6 needed"
    none = solve_pnp(np.empty((0, 3)), np.empty((0, 2)), CAMERA)
    assert not none.converged


def test_points_on_a_line_do_not_determine_a_pose():
    line = np.c_[np.linspace(-1, 1, 20), np.zeros(20), np.full(20, 4.0)]
    found = refine_pose(line, CAMERA.project(line), CAMERA, SE3.identity())
    assert not found.converged
    assert "do not determine" in found.reason


def test_refining_agrees_with_the_search_and_resists_outliers():
    T, points, pixels, _ = scene(100, 6, noise_px=1.0)
    start = T @ SE3.exp([0.05, -0.05, 0.05, 0.02, 0.01, -0.02])
    plain = refine_pose(points, pixels, CAMERA, start)
    found = solve_pnp(points, pixels, CAMERA, threshold_px=20.0)
    np.testing.assert_allclose(plain.T_world_camera.matrix, found.T_world_camera.matrix, atol=1e-7)
    np.testing.assert_allclose(plain.covariance, found.covariance, rtol=1e-4, atol=1e-12)
    pixels[:10] += 60.0
    robust = refine_pose(points, pixels, CAMERA, start, huber=1.5, threshold_px=4.0)
    assert robust.converged
    assert not robust.inliers[:10].any()
    assert robust.inliers[10:].mean() > 0.95
    error = np.abs((T.inverse() @ robust.T_world_camera).log()).max()
    assert (
        error
        < 0.2
        * np.abs(
            (T.inverse() @ refine_pose(points, pixels, CAMERA, start).T_world_camera).log()
        ).max()
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"threshold_px": 0.0}, "threshold"),
        ({"confidence": 1.0}, "confidence"),
        ({"sigma_px": -1.0}, "sigma_px"),
        ({"sigma_px": np.ones(3)}, "sigma_px"),
        ({"pixels": np.zeros((9, 2))}, "shapes"),
        ({"points_world": np.zeros((10, 2))}, "points_world"),
    ],
)
def test_wrong_input_is_named(change, words):
    given = {"points_world": np.zeros((10, 3)), "pixels": np.zeros((10, 2)), "camera": CAMERA}
    with pytest.raises(InputError, match=words):
        solve_pnp(**{**given, **change})


def test_the_kernels_compile_once():
    p3p_kernels.warm_up()
    pnp_kernels.warm_up()
    before = len(pnp_kernels.search_pose.signatures), len(p3p_kernels.p3p_into.signatures)
    solve_pnp(*scene(30, 1)[1:3], CAMERA)
    p3p(np.eye(3), np.eye(3) + 1.0)
    after = len(pnp_kernels.search_pose.signatures), len(p3p_kernels.p3p_into.signatures)
    assert before == after == (1, 1)
