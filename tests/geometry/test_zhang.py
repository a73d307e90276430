"""First guesses of a camera from a plane: exact for a pinhole, humble where views are few."""

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.geometry.camera import Camera
from odomap.geometry.lie import so3_exp
from odomap.geometry.pose import SE3
from odomap.geometry.twoview import homography
from odomap.geometry.zhang import intrinsics_of_plane_views, pose_of_plane

GRID = np.stack(np.meshgrid(np.arange(7) * 0.03, np.arange(5) * 0.03, [0.0]), -1).reshape(-1, 3)
PINHOLE = Camera("pinhole", (510.0, 530.0, 333.0, 226.0), (), (640, 480))
LENSES = [
    PINHOLE,
    Camera("pinhole", (420.0, 420.0, 320.0, 240.0), (-0.3, 0.1, 0.001, 0.0), (640, 480)),
    Camera("kannala_brandt", (200.0, 200.0, 320.0, 240.0), (0.02, 0.0, 0.0, 0.0), (640, 480)),
    Camera("double_sphere", (190.0, 190.0, 320.0, 240.0), (-0.2, 0.6), (640, 480)),
]


def view(turn: tuple[float, float, float], at: tuple[float, float, float]) -> SE3:
    return SE3.from_parts(so3_exp(np.array(turn)), np.array(at))


VIEWS = [
    view((0.5, 0.1, 0.0), (-0.1, -0.1, 0.5)),
    view((-0.2, 0.6, 0.1), (0.0, -0.1, 0.6)),
    view((0.1, -0.5, -0.2), (-0.2, 0.0, 0.5)),
    view((-0.5, -0.2, 0.3), (-0.05, -0.05, 0.4)),
]


def homographies(camera: Camera, views: list[SE3]) -> np.ndarray:
    return np.stack([homography(GRID[:, :2], camera.project(T @ GRID)) for T in views])


def test_a_pinhole_is_found_exactly() -> None:
    guesses = intrinsics_of_plane_views(homographies(PINHOLE, VIEWS), (640, 480))
    assert np.allclose(guesses[0], PINHOLE.intrinsics, atol=1e-4)


def test_one_view_gives_square_pixels_about_the_middle() -> None:
    square = Camera("pinhole", (500.0, 500.0, 319.5, 239.5), (), (640, 480))
    guesses = intrinsics_of_plane_views(homographies(square, VIEWS[:1]), (640, 480))
    assert np.allclose(guesses[-1], square.intrinsics, atol=1e-3)


def test_parallel_views_never_raise() -> None:
    flat = [view((0.0, 0.0, 0.1 * k), (0.01 * k, 0.0, 0.4 + 0.1 * k)) for k in range(4)]
    for guess in intrinsics_of_plane_views(homographies(PINHOLE, flat), (640, 480)):
        assert np.isfinite(guess).all()


def test_a_stack_is_asked_for() -> None:
    with pytest.raises(InputError, match="give \\(V, 3, 3\\)"):
        intrinsics_of_plane_views(np.eye(3), (640, 480))


@pytest.mark.parametrize("camera", LENSES, ids=["pinhole", "radtan", "fisheye", "sphere"])
def test_a_plane_is_placed_through_any_lens(camera: Camera) -> None:
    for truth in VIEWS:
        T, rms = pose_of_plane(GRID, camera.project(truth @ GRID), camera)
        assert rms < 1e-6
        assert np.abs((T.inverse() @ truth).log()).max() < 1e-7


def test_a_plane_is_placed_at_the_edge_of_a_fisheye() -> None:
    fisheye = LENSES[2]
    truth = view((0.1, 1.35, 0.0), (0.62, -0.05, 0.12))
    pixels = fisheye.project(truth @ GRID)
    assert np.isfinite(pixels).all()
    T, rms = pose_of_plane(GRID, pixels, fisheye)
    assert rms < 1e-4
    assert np.abs((T.inverse() @ truth).log()).max() < 1e-4


def test_the_tilt_of_a_distant_plane_is_told_from_its_mirror_image() -> None:
    rng = np.random.default_rng(0)
    for sign in (1, -1):
        truth = view((0.5 * sign, 0.2, 0.0), (-0.1, -0.05, 1.6))
        pixels = PINHOLE.project(truth @ GRID) + rng.normal(0, 0.02, (len(GRID), 2))
        T, _ = pose_of_plane(GRID, pixels, PINHOLE)
        assert np.linalg.norm((T.inverse() @ truth).log()[3:]) < np.radians(5)


def test_nothing_seen_gives_no_pose() -> None:
    assert pose_of_plane(GRID, np.full((len(GRID), 2), np.nan), PINHOLE)[1] == np.inf
