"""Rectified pictures: the same wall, the same row, and its depth from the disparity."""

import numpy as np
import pytest

from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.sensors.rig import CameraMount, Rig
from odomap.vision.patches import align_patches
from odomap.vision.rectifier import Rectifier
from odomap.vision.stereo import StereoConfig, match_sparse

SIZE = (376, 240)
# The cameras of EuRoC at half their resolution.
LENSES = (
    ([229.327, 228.648, 183.6, 124.2], [-0.28340811, 0.07395907, 0.00019359, 1.76187e-05]),
    ([228.794, 228.067, 190.0, 127.6], [-0.28368365, 0.07451284, -0.00010473, -3.5559e-05]),
)
T_LEFT_RIGHT = SE3.from_parts(np.eye(3), [0.1100, -0.0002, 0.0009]) @ SE3.exp(
    [0, 0, 0, 0.0141, -0.0023, 0.0070]
)
T_BODY_LEFT = SE3.exp([-0.02, -0.06, 0.01, 0.02, -0.01, 1.55])
DEPTH = 3.0


@pytest.fixture(scope="module")
def rig():
    left, right = (Camera("pinhole", f, d, SIZE) for f, d in LENSES)
    return Rig(
        (
            CameraMount("left", left, T_BODY_LEFT),
            CameraMount("right", right, T_BODY_LEFT @ T_LEFT_RIGHT),
        )
    )


@pytest.fixture(scope="module")
def rectifier(rig):
    return Rectifier(rig)


def picture(camera, T_left_camera, texture):
    """Return the raw image of a wall z = DEPTH in left-camera axes."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    xy = camera.undistort(np.stack([x.ravel(), y.ravel()], axis=1).astype(float))
    rays = np.column_stack([xy, np.ones(len(xy))]) @ T_left_camera.R.T
    reach = (DEPTH - T_left_camera.t[2]) / rays[:, 2]
    wall = T_left_camera.t + reach[:, None] * rays
    grey = texture.at(230 * wall[:, 0] / DEPTH, 230 * wall[:, 1] / DEPTH)
    return np.round(grey).astype(np.uint8).reshape(SIZE[::-1])


@pytest.fixture(scope="module")
def pair(rig, rectifier, texture):
    left, right = (m.camera for m in rig.cameras)
    return (
        rectifier.rectify(picture(left, SE3.identity(), texture), "left"),
        rectifier.rectify(picture(right, T_LEFT_RIGHT, texture), "right"),
    )


@pytest.fixture(scope="module")
def points(rectifier):
    x, y = np.meshgrid(np.arange(60.0, 350, 11), np.arange(20.0, 225, 10))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    return points[rectifier.mask[points[:, 1].astype(int), points[:, 0].astype(int)]]


def test_rows_of_rectified_pictures_agree(rectifier, pair, points):
    rays = rectifier.camera.unproject(points) @ rectifier.geometry.R_left_rect.T
    depth = (rectifier.geometry.R_left_rect.T @ (DEPTH / rays[:, 2] * rays.T))[2]
    disparity = rectifier.camera.fx * rectifier.baseline / depth
    guess = points - np.stack([disparity, np.zeros(len(points))], axis=1)
    eye = np.tile(np.eye(2), (len(points), 1, 1))
    flow = align_patches(*pair, points, guess, eye, 5, 12)
    assert flow.found.mean() > 0.9
    off = (flow.points - guess)[flow.found]
    assert np.abs(np.median(off, axis=0)).max() < 0.03
    assert np.abs(off[:, 1]).max() < 0.35
    assert np.sqrt(np.mean(off[:, 1] ** 2)) < 0.1


def test_depth_follows_from_disparity(rectifier, pair, points):
    disparity = match_sparse(*pair, points, StereoConfig(max_disparity_px=32))
    good = np.isfinite(disparity)
    assert good.mean() > 0.8
    depth = rectifier.camera.fx * rectifier.baseline / disparity[good]
    rays = rectifier.camera.unproject(points[good])
    places = (depth / rays[:, 2])[:, None] * rays @ rectifier.geometry.R_left_rect.T
    assert np.median(places[:, 2]) == pytest.approx(DEPTH, rel=0.003)
    assert np.mean(np.abs(places[:, 2] - DEPTH) < 0.1) > 0.9


def test_the_mount_is_that_of_the_turned_camera(rig, rectifier, points):
    raw = rectifier.geometry.to_raw(points, "left")
    expected = T_BODY_LEFT.R @ rig.cameras[0].camera.unproject(raw).T
    found = rectifier.T_body_camera[:3, :3] @ rectifier.camera.unproject(points).T
    np.testing.assert_allclose(found, expected, atol=1e-8)
    np.testing.assert_allclose(rectifier.T_body_camera[:3, 3], T_BODY_LEFT.t, atol=1e-12)


def test_the_way_back_to_the_raw_image_is_good_to_a_tenth_of_a_pixel(rectifier):
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, [SIZE[0] - 1, SIZE[1] - 1], (2000, 2))
    x, y = np.round(pixels).astype(int).T
    pixels = pixels[rectifier.mask[y, x]]
    exact = rectifier.geometry.to_raw(pixels, "left")
    found = rectifier.to_raw(pixels)
    assert np.linalg.norm(found - exact, axis=1).max() < 0.1
    assert np.linalg.norm(exact - pixels, axis=1).max() > 5  # there is something to undo
    assert rectifier.to_raw(pixels[:0]).shape == (0, 2)
    assert np.isfinite(rectifier.to_raw(np.array([[-9.0, 900.0]]))).all()


def test_the_mask_keeps_to_what_the_camera_saw():
    left, right = (Camera("pinhole", f, d, SIZE) for f, d in LENSES)
    turned = SE3.from_parts(np.eye(3), [0.11, 0, 0]) @ SE3.exp([0, 0, 0, 0, -0.5, 0.1])
    rectifier = Rectifier(Rig((CameraMount("l", left), CameraMount("r", right, turned))))
    white = rectifier.rectify(np.full(SIZE[::-1], 255, np.uint8), "left")
    assert rectifier.mask.shape == white.shape
    assert (white[rectifier.mask] == 255).all()
    assert 0.6 < rectifier.mask.mean() < 0.97
    # A margin keeps patches away from the black rim, but not from the border of the image.
    rows, columns = np.nonzero(rectifier.mask)
    for dy, dx in ((7, 0), (-7, 0), (0, 7), (0, -7)):
        r, c = (rows + dy).clip(0, 239), (columns + dx).clip(0, 375)
        assert (white[r, c] == 255).all()
    assert (rectifier.mask & (np.indices(white.shape)[1] > 370)).any()


def test_a_rectified_pair_passes_untouched():
    camera = Camera("pinhole", [200, 200, 159.5, 99.5], [], (320, 200))
    mount = SE3.from_parts(np.eye(3), [0.54, 0, 0])
    rectifier = Rectifier(Rig((CameraMount("l", camera), CameraMount("r", camera, mount))))
    image = np.random.default_rng(1).integers(0, 256, (200, 320)).astype(np.uint8)
    assert rectifier.rectify(image, "left") is image
    assert rectifier.rectify(image, "right") is image
    assert rectifier.mask.all()
    assert rectifier.baseline == pytest.approx(0.54)
    pixels = np.array([[3.25, 7.5]])
    np.testing.assert_array_equal(rectifier.to_raw(pixels), pixels)
    np.testing.assert_array_equal(rectifier.T_body_camera, np.eye(4))
