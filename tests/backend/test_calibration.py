"""Calibration on arrays: derivatives, exact truths, honest covariances, contradictions, doubts."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from odomap.backend.calibration import Calibration, calibrate_camera, calibrate_pair
from odomap.backend.calibration_arrow import (
    ArrowProblem,
    ArrowState,
    _linearise,
    _moved,
    residuals,
    solve_arrow,
)
from odomap.backend.calibration_doubts import doubts, misfit, places
from odomap.errors import CalibrationError, InputError
from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_exp
from odomap.geometry.pose import SE3
from odomap.simulation.board import board_pose
from odomap.vision.board import Board
from reference import numeric_jacobian

SIZE = (640, 480)
BOARD = Board(8, 5, 0.03)
RADTAN = Camera("pinhole", (500.0, 498.0, 326.0, 235.0), (-0.25, 0.08, 0.001, -0.0005), SIZE)
FISHEYE = Camera("kannala_brandt", (215.0, 214.0, 322.0, 238.0), (0.02, -0.006, 0.002, 0.0), SIZE)
SPHERE = Camera("double_sphere", (190.0, 189.5, 322.0, 238.0), (-0.2, 0.58), SIZE)
LENSES = [RADTAN, FISHEYE, SPHERE]
NAMES = ["pinhole", "kannala_brandt", "double_sphere"]
T_LEFT_RIGHT = SE3.exp([0.11, 0.002, -0.003, 0.01, -0.02, 0.005])
PLACES = [(u, v) for v in (130, 240, 350) for u in (170, 280, 370, 480)]


def poses(camera: Camera, seed: int = 0, tilt: float = 0.6) -> np.ndarray:
    """Boards all over the image, each tilted another way."""
    rng = np.random.default_rng([seed, 5])
    out = []
    for k, at in enumerate(PLACES):
        turn = 2 * np.pi * k / 5 + rng.uniform(0, 0.5)
        tilts = (tilt * np.cos(turn), tilt * np.sin(turn))
        share = rng.uniform(0.35, 0.6)
        out.append(board_pose(camera, BOARD, at, share, tilts, rng.normal(0, 0.2)).matrix)
    return np.stack(out)


def look(
    camera: Camera, Ts: np.ndarray, noise: float = 0.0, seed: int = 0, mount: SE3 | None = None
) -> np.ndarray:
    """Return the corners (V, N, 2) a camera sees."""
    back = (mount or SE3.identity()).inverse()
    pixels = np.stack([camera.project(back @ SE3(T) @ BOARD.points) for T in Ts])
    assert np.isfinite(pixels).all()
    return pixels + np.random.default_rng([seed, 7]).normal(0, noise, pixels.shape)


def numbers(camera: Camera) -> np.ndarray:
    return np.concatenate([camera.intrinsics, camera.distortion])


# ---- the arrow ----


@pytest.mark.parametrize("lens", LENSES, ids=NAMES)
def test_the_arrow_is_the_derivative_of_the_residuals(lens: Camera) -> None:
    Ts = poses(lens)[:3]
    pixels = np.stack([look(lens, Ts, 0.5), look(lens, Ts, 0.5, 1, T_LEFT_RIGHT)])
    pixels[1, 2] = np.nan
    problem = ArrowProblem(BOARD.points, pixels, sigma_px=0.5, huber=1e6)
    mounts = np.stack([np.eye(4), T_LEFT_RIGHT.matrix])
    state = ArrowState((lens, lens), mounts, Ts)
    normal = _linearise(problem, state)
    shared, views = len(normal.a), len(Ts)

    def errors(step: np.ndarray) -> np.ndarray:
        moved = _moved(state, step[:shared], step[shared:].reshape(views, 6))
        assert moved is not None
        e = residuals(problem, moved).ravel() / problem.sigma_px
        return e[np.isfinite(e)]

    J = numeric_jacobian(errors, shared + 6 * views)
    H = J.T @ J
    C = np.zeros((6 * views, 6 * views))
    for v in range(views):
        C[6 * v : 6 * v + 6, 6 * v : 6 * v + 6] = normal.C[v]
    B = np.concatenate(list(normal.B), axis=1)
    arrow = np.block([[normal.A, B], [B.T, C]])
    scale = np.sqrt(np.outer(np.diag(H), np.diag(H)))
    assert np.abs((arrow - H) / scale).max() < 1e-5
    gradient = J.T @ errors(np.zeros(shared + 6 * views))
    ours = np.concatenate([normal.a, normal.c.ravel()])
    assert np.allclose(ours, gradient, rtol=1e-4, atol=1e-4 * np.abs(gradient).max())


def test_eliminating_the_poses_gives_the_covariance_of_the_whole() -> None:
    Ts = poses(RADTAN)[:6]
    problem = ArrowProblem(BOARD.points, look(RADTAN, Ts, 0.1)[None], 0.1, 1e6)
    found = solve_arrow(problem, ArrowState((RADTAN,), np.eye(4)[None], Ts))
    normal = _linearise(problem, found.state)
    C = np.zeros((36, 36))
    for v in range(6):
        C[6 * v : 6 * v + 6, 6 * v : 6 * v + 6] = normal.C[v]
    B = np.concatenate(list(normal.B), axis=1)
    whole = np.linalg.inv(np.block([[normal.A, B], [B.T, C]]))[:8, :8]
    assert found.converged
    assert np.allclose(found.covariance, whole, rtol=1e-5, atol=1e-12 * np.abs(whole).max())


def test_a_far_start_never_raises_the_cost_and_ends_at_the_truth() -> None:
    Ts = poses(RADTAN)
    problem = ArrowProblem(BOARD.points, look(RADTAN, Ts)[None], 1.0)
    far = replace(RADTAN, intrinsics=(600.0, 420.0, 300.0, 260.0), distortion=np.zeros(4))
    rng = np.random.default_rng(1)
    moved = Ts @ se3_exp(rng.normal(0, 0.03, (len(Ts), 6)))
    found = solve_arrow(problem, ArrowState((far,), np.eye(4)[None], moved))
    assert found.converged
    assert found.cost < 1e-8
    assert np.allclose(numbers(found.state.cameras[0]), numbers(RADTAN), atol=1e-4)


# ---- one camera ----


@pytest.mark.parametrize("lens", LENSES, ids=NAMES)
def test_any_lens_is_found_exactly_without_noise(lens: Camera) -> None:
    found = calibrate_camera(BOARD.points, look(lens, poses(lens)), SIZE, lens.model)
    assert found.converged
    assert np.allclose(numbers(found.cameras[0]), numbers(lens), rtol=1e-3, atol=1e-4)
    assert found.rms_px[0] < 1e-3


def test_a_third_coefficient_is_found() -> None:
    lens = replace(RADTAN, distortion=(-0.25, 0.08, 0.001, -0.0005, -0.02))
    pixels = look(lens, poses(lens))
    found = calibrate_camera(BOARD.points, pixels, SIZE, num_coefficients=5)
    assert np.allclose(found.cameras[0].distortion, lens.distortion, atol=1e-3)


@pytest.mark.parametrize("lens", LENSES[:2], ids=NAMES[:2])
def test_covariances_are_honest(lens: Camera) -> None:
    """Errors over their covariance are χ² of as many degrees as there are numbers."""
    scores = []
    for seed in range(8):
        pixels = look(lens, poses(lens, seed), 0.2, seed)
        found = calibrate_camera(BOARD.points, pixels, SIZE, lens.model)
        error = numbers(found.cameras[0]) - numbers(lens)
        scores.append(error @ np.linalg.solve(found.covariance, error))
        assert found.sigma_px == pytest.approx(0.2, rel=0.15)
    degrees = len(numbers(lens))
    assert 0.6 * degrees < np.mean(scores) < 1.6 * degrees


def test_opencv_finds_the_same_camera() -> None:
    pixels = look(RADTAN, poses(RADTAN, 3), 0.1, 3)
    found = calibrate_camera(BOARD.points, pixels, SIZE)
    points = [BOARD.points.astype(np.float32)] * len(pixels)
    seen = [view.astype(np.float32)[:, None] for view in pixels]
    rms, K, d, _, _ = cv2.calibrateCamera(
        points, seen, SIZE, None, None, flags=cv2.CALIB_FIX_K3
    )  # fmt: skip
    camera = found.cameras[0]
    # Huber's loss weighs a few corners less: far within the standard deviation.
    sigma = found.sigmas(0)
    theirs = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], d.ravel()[:4]])
    assert np.all(np.abs(numbers(camera) - theirs) < 0.5 * sigma)
    assert found.rms_px[0] == pytest.approx(rms, rel=0.01)


def test_pictures_that_contradict_the_others_are_left_out() -> None:
    pixels = look(RADTAN, poses(RADTAN, 1), 0.1)
    pixels[4] += np.random.default_rng(0).normal(0, 12, pixels[4].shape)
    pixels[7, :20] = pixels[7, :20][::-1]
    found = calibrate_camera(BOARD.points, pixels, SIZE)
    assert np.flatnonzero(~found.used[0]).tolist() == [4, 7]
    assert np.isnan(found.Ts_camera_board[4]).all()
    assert np.allclose(found.cameras[0].intrinsics[:2], RADTAN.intrinsics[:2], rtol=2e-3)


def test_views_without_a_board_are_passed_over() -> None:
    pixels = look(RADTAN, poses(RADTAN, 1), 0.05)
    holes = np.insert(pixels, [0, 5, 5], np.nan, axis=0)
    found = calibrate_camera(BOARD.points, holes, SIZE)
    assert found.used[0].sum() == len(pixels)
    assert not found.used[0, 0]
    assert np.isnan(found.view_rms[0, 0])
    same = calibrate_camera(BOARD.points, pixels, SIZE)
    assert np.allclose(numbers(found.cameras[0]), numbers(same.cameras[0]), rtol=1e-4)


def test_bad_arguments_are_refused() -> None:
    pixels = look(RADTAN, poses(RADTAN))
    with pytest.raises(InputError, match="2 views of the board, 3 or more"):
        calibrate_camera(BOARD.points, pixels[:2], SIZE)
    with pytest.raises(InputError, match="give \\(N, 3\\), \\(V, N, 2\\)"):
        calibrate_camera(BOARD.points, pixels[:, :-1], SIZE)
    with pytest.raises(InputError, match="plane z = 0"):
        calibrate_camera(BOARD.points + 1.0, pixels, SIZE)
    with pytest.raises(CalibrationError, match="'fisheye' is unknown"):
        calibrate_camera(BOARD.points, pixels, SIZE, "fisheye")


# ---- a pair ----


def pair(lens: Camera, noise: float = 0.1, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    Ts = poses(lens, seed)
    return look(lens, Ts, noise, seed), look(lens, Ts, noise, seed + 100, T_LEFT_RIGHT)


@pytest.mark.parametrize("lens", LENSES, ids=NAMES)
def test_a_pair_is_found_with_boards_only_one_camera_sees(lens: Camera) -> None:
    left, right = pair(lens)
    left[0], right[5] = np.nan, np.nan
    found = calibrate_pair(BOARD.points, left, right, (SIZE, SIZE), lens.model)
    assert found.used.sum(axis=1).tolist() == [len(left) - 1] * 2
    assert found.T_left_right is not None
    error = (T_LEFT_RIGHT.inverse() @ found.T_left_right).log()
    assert np.all(np.abs(error) < 5 * np.sqrt(np.diag(found.covariance)[-6:]))
    baseline = np.linalg.norm(found.T_left_right.t) / np.linalg.norm(T_LEFT_RIGHT.t)
    assert baseline == pytest.approx(1.0, abs=2e-3)
    assert 0 < found.baseline_sigma < 1e-3


def test_a_symmetric_board_may_be_counted_from_either_end() -> None:
    left, right = pair(RADTAN)
    upright = calibrate_pair(BOARD.points, left, right, (SIZE, SIZE))
    right[::3] = right[::3, ::-1]
    found = calibrate_pair(BOARD.points, left, right, (SIZE, SIZE), symmetric=True)
    assert found.T_left_right is not None
    assert upright.T_left_right is not None
    assert np.allclose(found.T_left_right.matrix, upright.T_left_right.matrix, atol=1e-6)


def test_a_wrong_pair_is_left_out_and_wrong_pairs_are_refused() -> None:
    left, right = pair(RADTAN)
    right[[2, 9]] = right[[9, 2]]
    found = calibrate_pair(BOARD.points, left, right, (SIZE, SIZE))
    assert not found.used[1, [2, 9]].any()
    assert found.T_left_right is not None
    assert np.abs((T_LEFT_RIGHT.inverse() @ found.T_left_right).log()).max() < 2e-3
    with pytest.raises(InputError, match="belong together"):
        calibrate_pair(BOARD.points, left, np.roll(right, 1, axis=0), (SIZE, SIZE))
    right[3:] = np.nan
    left[:1] = np.nan
    with pytest.raises(InputError, match="2 pairs in which both"):
        calibrate_pair(BOARD.points, left, right, (SIZE, SIZE))


# ---- doubts ----


def texts(found: Calibration) -> str:
    return " | ".join(doubt.text for doubt in doubts(found))


def is_fatal(found: Calibration) -> bool:
    return any(doubt.is_fatal for doubt in doubts(found))


def test_good_pictures_raise_no_doubt() -> None:
    found = calibrate_camera(BOARD.points, look(RADTAN, poses(RADTAN), 0.1), SIZE)
    assert texts(found) == ""


def test_boards_in_one_place_mean_nothing() -> None:
    T = board_pose(RADTAN, BOARD, (320, 240), 0.6, (0.4, 0.3)).matrix
    found = calibrate_camera(BOARD.points, look(RADTAN, np.stack([T] * 15), 0.1), SIZE)
    assert is_fatal(found)
    assert "all 15 boards are in one place" in texts(found)


def test_boards_that_are_never_tilted_mean_nothing() -> None:
    # Facing the camera from all over the image, boards would still turn: hold them parallel to it.
    flat = poses(RADTAN)
    flat[:, :3, :3] = np.eye(3)
    flat[:, :3, 3] -= flat[:, :3, :3] @ (BOARD.points.mean(axis=0))
    flat[:, 2, 3] += 0.3
    found = calibrate_camera(BOARD.points, look(RADTAN, flat, 0.1), SIZE)
    assert is_fatal(found)
    assert "do not determine the focal length" in texts(found)
    assert "parallel" in texts(found)


def test_an_unseen_part_of_the_picture_is_named() -> None:
    Ts = poses(RADTAN)
    kept = [k for k, (u, v) in enumerate(PLACES) if not (u > 300 and v > 200)]
    found = calibrate_camera(BOARD.points, look(RADTAN, Ts[kept], 0.1), SIZE)
    assert "lower right of the picture" in texts(found)
    assert not is_fatal(found)


def test_few_views_are_told() -> None:
    found = calibrate_camera(BOARD.points, look(RADTAN, poses(RADTAN)[::3], 0.1), SIZE)
    assert "only 4 different views" in texts(found)


def test_stretched_pictures_are_told() -> None:
    lens = replace(RADTAN, intrinsics=(500.0, 400.0, 326.0, 235.0))
    found = calibrate_camera(BOARD.points, look(lens, poses(lens), 0.1), SIZE)
    assert "fx / fy is 1.2" in texts(found)


def test_a_fisheye_taken_for_a_pinhole_is_told() -> None:
    found = calibrate_camera(BOARD.points, look(FISHEYE, poses(FISHEYE), 0.05), SIZE)
    assert "--model kannala_brandt" in texts(found)


def test_misfit_tells_pattern_from_noise() -> None:
    rng = np.random.default_rng(2)
    pixels = rng.uniform(0, (640, 480), (20, 54, 2))
    noise = rng.normal(0, 0.2, pixels.shape)
    assert misfit(pixels, noise, SIZE) < 0.1
    ring = 0.6 * np.sin(pixels[..., :1] / 60.0) * np.array([1.0, 0.3])
    assert misfit(pixels, noise + ring, SIZE) > 0.5


def test_places_are_counted_once() -> None:
    pixels = look(RADTAN, poses(RADTAN))
    assert places(pixels, SIZE) == len(pixels)
    assert places(np.repeat(pixels[:3], 4, axis=0) + 2.0, SIZE) == 3
