"""Corners of chessboards: where the truth has them, in one order, and honest when there is none."""

import cv2
import numpy as np
import pytest

from odomap.errors import InputError
from odomap.geometry.camera import Camera
from odomap.simulation.board import BoardViews, board_pose, board_views, render_board
from odomap.vision.board import Board, choose_views, find_board, guess_size, sharpness

CAMERA = Camera("pinhole", (400.0, 398.0, 242.0, 178.0), (-0.2, 0.05, 0.001, -0.001), (480, 360))


@pytest.fixture(scope="module")
def views() -> BoardViews:
    return board_views(CAMERA, seed=5, count=8)


def test_corners_are_found_to_a_tenth_of_a_pixel(views: BoardViews) -> None:
    found = [find_board(image, views.board) for image in views.images]
    assert all(corners is not None for corners in found)
    errors = np.linalg.norm(np.array(found) - views.pixels, axis=2)
    assert np.sqrt(np.mean(errors**2)) < 0.1
    assert errors.max() < 0.5


def test_a_picture_turned_upside_down_names_the_same_corner_first(views: BoardViews) -> None:
    size = np.array(CAMERA.resolution)
    for image, truth in zip(views.images[:4], views.pixels):
        found = find_board(np.ascontiguousarray(image[::-1, ::-1]), views.board)
        assert found is not None
        assert np.abs(size - 1 - found - truth).max() < 0.5


def test_the_order_does_not_depend_on_which_number_comes_first(views: BoardViews) -> None:
    tall = Board(6, 9, views.board.square)
    found = find_board(views.images[0], tall)
    assert found is not None
    grid = found.reshape(9, 6, 2)
    along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    assert along[0] * down[1] - along[1] * down[0] > 0
    assert np.linalg.norm(down) > np.linalg.norm(along)


@pytest.mark.parametrize("size", [(8, 6), (7, 7)])
def test_a_symmetric_board_is_taken_upright(size: tuple[int, int]) -> None:
    board = Board(*size, 0.03)
    assert board.is_symmetric
    T = board_pose(CAMERA, board, (230.0, 180.0), 0.7, (0.3, -0.2), roll=0.2)
    image = render_board(CAMERA, T, board, seed=1)
    for picture in (image, np.ascontiguousarray(image[::-1, ::-1])):
        found = find_board(picture, board)
        assert found is not None
        grid = found.reshape(size[1], size[0], 2)
        assert (grid[:, -1] - grid[:, 0])[:, 0].min() > 0
        assert (grid[-1] - grid[0])[:, 1].min() > 0


def test_large_pictures_are_measured_at_full_size() -> None:
    large = Camera("pinhole", (1700.0, 1700.0, 1000.0, 750.0), (), (2000, 1500))
    board = Board(9, 6, 0.025)
    T = board_pose(large, board, (900.0, 700.0), 0.8, (0.3, 0.2))
    found = find_board(render_board(large, T, board), board)
    assert found is not None
    assert np.abs(found - large.project(T @ board.points)).max() < 0.3


def test_without_a_board_nothing_is_found() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (200, 300)).astype(np.uint8)
    assert find_board(cv2.GaussianBlur(noise, (0, 0), 3.0), Board(9, 6, 0.025)) is None
    assert guess_size(np.full((120, 160), 128, np.uint8)) is None


def test_half_a_board_is_no_board(views: BoardViews) -> None:
    image = views.images[0].copy()
    middle = views.pixels[0].mean(axis=0).astype(int)
    image[:, middle[0] :] = 90
    assert find_board(image, views.board) is None


def test_the_size_of_another_board_is_guessed(views: BoardViews) -> None:
    sizes = [guess_size(image) for image in views.images]
    assert sizes.count((9, 6)) >= 5


def test_sharpness_falls_with_blur(views: BoardViews) -> None:
    blurred = [cv2.GaussianBlur(views.images[0], (0, 0), s) for s in (1.0, 2.0, 4.0)]
    values = [sharpness(image, views.pixels[0]) for image in [views.images[0], *blurred]]
    assert values == sorted(values, reverse=True)
    assert values[0] > 2.5 * values[-1]


def test_views_chosen_are_sharp_and_differ() -> None:
    rng = np.random.default_rng(3)
    corners = np.concatenate([rng.uniform(0, 500, (6, 10)), np.zeros((20, 10))])
    corners[6:] = corners[0] + rng.normal(0, 0.5, (20, 10))
    sharp = np.full(26, 0.4)
    sharp[2] = 0.1
    chosen = choose_views(corners, sharp, 60)
    assert 2 not in chosen
    assert {1, 3, 4, 5} <= set(chosen.tolist())
    assert len(chosen) == 5  # the crowd about view 0 is one view
    assert len(choose_views(corners, sharp, 3)) == 3
    assert len(choose_views(np.zeros((0, 4)), np.zeros(0), 3)) == 0


@pytest.mark.parametrize(
    ("size", "square", "message"),
    [
        ("9by6", 0.025, "inner corners along and across, such as 9x6"),
        ("2x6", 0.025, "3x3 to 100x100"),
        ("9x6", 25.0, "millimetres"),
        ("9x6", 0.0, "above 0"),
        ("9x6", float("nan"), "above 0"),
    ],
)
def test_impossible_boards_are_refused(size: str, square: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Board.parse(size, square)


def test_points_run_along_the_rows() -> None:
    points = Board.parse("4x3", 0.1).points
    assert points.shape == (12, 3)
    assert points[:5].tolist() == [
        [0, 0, 0],
        [0.1, 0, 0],
        [0.2, 0, 0],
        [0.1 * 3, 0, 0],
        [0, 0.1, 0],
    ]
