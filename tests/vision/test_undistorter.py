"""Undistorted pictures: a wall looks as an ideal pinhole sees it."""

import numpy as np
import pytest

from odomap.geometry.camera import Camera
from odomap.vision.undistorter import Undistorter

SIZE = (376, 240)
LENS = Camera(
    "pinhole",
    [229.327, 228.648, 183.6, 124.2],
    [-0.28340811, 0.07395907, 0.00019359, 1.76187e-05],
    SIZE,
)


@pytest.fixture(scope="module")
def undistorter():
    return Undistorter(LENS)


def picture(camera, texture):
    """Return the image of a wall in front of the camera."""
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    xy = camera.undistort(np.stack([x.ravel(), y.ravel()], axis=1).astype(float))
    grey = texture.at(230 * xy[:, 0], 230 * xy[:, 1])
    return np.round(np.nan_to_num(grey)).astype(np.uint8).reshape(camera.height, camera.width)


def test_the_picture_is_that_of_a_pinhole(undistorter, texture):
    got = undistorter.undistort(picture(LENS, texture))
    assert got.dtype == np.uint8
    off = got.astype(float) - picture(undistorter.camera, texture)
    seen = undistorter.mask
    # Bilinear interpolation and rounding, no more.
    assert np.sqrt(np.mean(off[seen] ** 2)) < 1.5
    assert np.abs(np.median(off[seen])) < 0.5


def test_the_mask_keeps_to_what_the_camera_saw(undistorter):
    white = undistorter.undistort(np.full(SIZE[::-1], 255, np.uint8))
    assert (white[undistorter.mask] == 255).all()
    assert 0.7 < undistorter.mask.mean() < 1.0


def test_the_way_back_is_good_to_a_tenth_of_a_pixel(undistorter):
    pixels = np.random.default_rng(0).uniform(0, [SIZE[0] - 1, SIZE[1] - 1], (2000, 2))
    x, y = np.round(pixels).astype(int).T
    pixels = pixels[undistorter.mask[y, x]]
    exact = undistorter.geometry.to_raw(pixels)
    assert np.linalg.norm(undistorter.to_raw(pixels) - exact, axis=1).max() < 0.1
    assert np.linalg.norm(exact - pixels, axis=1).max() > 5
    assert undistorter.to_raw(pixels[:0]).shape == (0, 2)
    assert np.isfinite(undistorter.to_raw(np.array([[-9.0, 900.0]]))).all()


def test_colour_is_undistorted_as_well(undistorter, texture):
    grey = picture(LENS, texture)
    colour = undistorter.undistort(np.dstack([grey, 255 - grey, grey]))
    np.testing.assert_array_equal(colour[..., 0], undistorter.undistort(grey))


def test_a_pinhole_passes_untouched():
    camera = Camera("pinhole", [200, 200, 159.5, 99.5], [], (320, 200))
    undistorter = Undistorter(camera)
    image = np.random.default_rng(1).integers(0, 256, (200, 320)).astype(np.uint8)
    assert undistorter.undistort(image) is image
    assert undistorter.camera is camera
    assert undistorter.mask.all()
    pixels = np.array([[1.5, 2.5]])
    assert undistorter.to_raw(pixels) is pixels
