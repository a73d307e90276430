"""Rendered chessboards: the same bytes, and corners where the lens puts them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from odomap.errors import InputError
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.simulation.board import (
    NOISE,
    board_pose,
    board_views,
    render_board,
    write_board_views,
)
from odomap.simulation.exposure import ImageNoise
from odomap.vision.board import Board

PINHOLE = Camera("pinhole", (250.0, 249.0, 161.0, 118.0), (-0.25, 0.08, 0.0, 0.0), (320, 240))
FISHEYE = Camera("kannala_brandt", (110.0, 110.0, 160.0, 120.0), (0.02, 0.0, 0.0, 0.0), (320, 240))
BOARD = Board(9, 6, 0.025)


def test_the_same_seed_gives_the_same_bytes() -> None:
    first, second = (board_views(PINHOLE, seed=4, count=2) for _ in range(2))
    other = board_views(PINHOLE, seed=5, count=2)
    for a, b, c in zip(first.images, second.images, other.images):
        assert a.tobytes() == b.tobytes()
        assert a.tobytes() != c.tobytes()
    assert np.array_equal(first.Ts_camera_board, second.Ts_camera_board)


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE])
def test_corners_are_saddles_of_the_picture(camera: Camera) -> None:
    """The mean over each of the four squares about a corner tells dark from light."""
    views = board_views(camera, seed=2, count=4, noise=ImageNoise.none())
    for image, pixels, T in zip(views.images, views.pixels, views.Ts_camera_board):
        assert camera.is_inside(pixels, 5.0).all()
        assert np.allclose(pixels, camera.project(SE3(T) @ views.board.points))
        quarter = views.board.square * 0.25
        for sx in (-1, 1):
            for sy in (-1, 1):
                at = views.board.points + quarter * np.array([sx, sy, 0.0])
                u, v = np.rint(camera.project(SE3(T) @ at)).astype(int).T
                i, j = np.meshgrid(np.arange(9), np.arange(6))
                dark = (i.ravel() + j.ravel() + (sx < 0) + (sy < 0)) % 2 == 0
                assert image[v[dark], u[dark]].max() < image[v[~dark], u[~dark]].min()


def test_edges_are_averaged_not_jagged() -> None:
    """Rendered at three times the size and averaged, the picture is the same."""
    fine = Camera("pinhole", (750.0, 750.0, 481.0, 361.0), (), (960, 720))
    coarse = Camera("pinhole", (250.0, 250.0, 160.0, 120.0), (), (320, 240))
    T = board_pose(coarse, BOARD, (150.0, 120.0), 0.8, (0.4, 0.3), roll=0.3)
    large = render_board(fine, T, BOARD, noise=ImageNoise.none()).astype(float)
    small = render_board(coarse, T, BOARD, noise=ImageNoise.none()).astype(float)
    mean = large.reshape(240, 3, 320, 3).mean(axis=(1, 3))
    low, high = coarse.project(T @ BOARD.points[[0, -1]]).astype(int)
    part = np.s_[low[1] : high[1], low[0] : high[0]]
    # The clutter and the light differ, the board and its edges do not.
    assert np.corrcoef(mean[part].ravel(), small[part].ravel())[0, 1] > 0.995


def test_a_pair_sees_the_same_boards() -> None:
    T_left_right = SE3.exp([0.1, 0.0, 0.0, 0.0, 0.01, 0.0])
    views = board_views(PINHOLE, 1, 3, right=PINHOLE, T_left_right=T_left_right)
    assert len(views.right_images) == 3
    for T, pixels in zip(views.Ts_camera_board, views.right_pixels):
        seen = PINHOLE.project(T_left_right.inverse() @ SE3(T) @ views.board.points)
        assert np.allclose(pixels, seen)
        assert PINHOLE.is_inside(pixels).all()


def test_noise_is_what_was_asked_for() -> None:
    T = board_pose(PINHOLE, BOARD, (160.0, 120.0), 0.7, (0.0, 0.0))
    soft, clean = (
        render_board(PINHOLE, T, BOARD, noise=noise)
        for noise in (replace(NOISE, shot=0.0, read=0.05), ImageNoise.none())
    )
    middle = np.s_[5:40, 5:40]
    difference = soft[middle].astype(float) - clean[middle]
    assert difference.std() == pytest.approx(0.05 * 255, rel=0.35)


def test_pictures_are_written_losslessly(tmp_path) -> None:
    T_left_right = SE3.exp([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    views = board_views(PINHOLE, 1, 2, right=PINHOLE, T_left_right=T_left_right)
    write_board_views(views, tmp_path)
    for side, images in (("left", views.images), ("right", views.right_images)):
        files = sorted((tmp_path / side).iterdir())
        assert [f.name for f in files] == ["board_000.png", "board_001.png"]
        for file, image in zip(files, images):
            assert np.array_equal(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), image)


def test_cameras_that_share_no_view_are_refused() -> None:
    back = SE3.exp([0.0, 0.0, 0.0, 0.0, np.pi, 0.0])
    with pytest.raises(InputError, match="seen whole"):
        board_views(PINHOLE, 0, 1, right=PINHOLE, T_left_right=back)
    with pytest.raises(InputError, match="no ray"):
        board_pose(Camera("double_sphere", (50.0, 50.0, 160.0, 120.0), (0.5, 0.9), (320, 240)),
                   BOARD, (0.0, 0.0), 0.5, (0.0, 0.0))  # fmt: skip
