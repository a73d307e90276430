import pickle

import cv2
import numpy as np
import pytest

from odomap.errors import CalibrationError, InputError
from odomap.geometry.camera import Camera
from odomap.geometry.lens_kernels import radtan_distort
from reference import numeric_jacobian, radtan

EUROC = [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
LENSES = {
    "none": [],
    "euroc": EUROC,
    "five": [-0.21, 0.09, 0.001, -0.0007, -0.01],
    "rational": [0.1, -0.05, 0.001, -0.002, 0.01, 0.05, -0.02, 0.003],
}
each_lens = pytest.mark.parametrize("lens", LENSES)


def camera(lens):
    return Camera("pinhole", [458.654, 457.296, 367.215, 248.375], LENSES[lens], (752, 480))


def grid(step=7.0, margin=20.0):
    u, v = np.meshgrid(np.arange(-margin, 752 + margin, step), np.arange(-margin, 480, step))
    return np.stack([u.ravel(), v.ravel()], axis=1)


@each_lens
def test_round_trip_over_the_whole_image(lens):
    cam, pixels = camera(lens), grid()
    np.testing.assert_allclose(cam.distort(cam.undistort(pixels)), pixels, rtol=0, atol=1e-9)
    rays = cam.unproject(pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(cam.project(4.2 * rays), pixels, rtol=0, atol=1e-9)


@each_lens
def test_projection_agrees_with_opencv(lens):
    cam = camera(lens)
    points = 3.0 * cam.unproject(grid(31.0))
    d = cam.distortion if len(cam.distortion) else np.zeros(4)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), cam.K, d)
    np.testing.assert_allclose(cam.project(points), expected[:, 0], rtol=0, atol=1e-9)


@each_lens
def test_undistortion_agrees_with_opencv(lens):
    cam, pixels = camera(lens), grid(31.0, 0.0)
    d = cam.distortion if len(cam.distortion) else np.zeros(4)
    precise = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-15)
    expected = cv2.undistortPoints(pixels[:, None], cam.K, d, None, None, None, precise)[:, 0]
    np.testing.assert_allclose(cam.undistort(pixels), expected, rtol=0, atol=1e-9)


@each_lens
def test_projection_is_the_formula(lens):
    cam = camera(lens)
    for x, y in np.random.default_rng(1).uniform(-0.6, 0.6, (20, 2)):
        expected = np.array(radtan(x, y, cam.distortion))
        got = (cam.distort([[x, y]])[0] - [cam.cx, cam.cy]) / [cam.fx, cam.fy]
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-13)


@each_lens
def test_jacobian_against_differences(lens):
    cam = camera(lens)
    points = 2.5 * cam.unproject(grid(53.0))
    expected = numeric_jacobian(lambda d: cam.project(points + d), 3)
    np.testing.assert_allclose(cam.project_jacobian(points), expected, rtol=0, atol=1e-6)


def test_slope_of_the_kernel_against_differences():
    d = np.array(LENSES["rational"])
    for x, y in np.random.default_rng(2).uniform(-0.6, 0.6, (20, 2)):
        expected = numeric_jacobian(lambda e, x=x, y=y: radtan(x + e[0], y + e[1], d), 2)
        xd, yd, a, b, c = radtan_distort(x, y, d)
        np.testing.assert_allclose([xd, yd], radtan(x, y, d), atol=1e-14)
        np.testing.assert_allclose([[a, b], [b, c]], expected, rtol=0, atol=1e-9)


def test_nothing_behind_the_camera_is_seen():
    cam = camera("euroc")
    pixels = cam.project([[0.1, 0.1, 1.0], [0.1, 0.1, -1.0], [0.1, 0.1, 0.0]])
    assert np.isfinite(pixels[0]).all()
    assert np.isnan(pixels[1:]).all()
    assert np.isnan(cam.project_jacobian([[0.1, 0.1, -1.0]])).all()


def test_far_off_points_do_not_fold_back_into_the_image():
    # r (1 - 0.3 r²) grows up to r = 1.054 only; beyond, the polynomial comes back to the centre.
    cam = Camera("pinhole", [400.0, 400.0, 320.0, 240.0], [-0.3, 0.0, 0.0, 0.0], (640, 480))
    folded = np.array([[1.7, 0.0, 1.0]])
    raw, _ = cv2.projectPoints(folded, np.zeros(3), np.zeros(3), cam.K, cam.distortion)
    assert 0 < raw[0, 0, 0] < 640
    assert np.isnan(cam.project(folded)).all()
    assert np.isfinite(cam.project([[1.05, 0.0, 1.0]])).all()
    # Nor does a ray lead to pixels beyond the fold.
    edge = cam.cx + cam.fx * 1.0540925 * (1 - 0.3 * 1.0540925**2)
    rays = cam.undistort([[edge - 0.5, cam.cy], [edge + 0.5, cam.cy]])
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1]).all()


def test_is_inside():
    cam = camera("none")
    pixels = [[0, 0], [751, 479], [751.01, 10], [-0.01, 10], [5, 5], [np.nan, 5]]
    np.testing.assert_array_equal(cam.is_inside(pixels), [1, 1, 0, 0, 1, 0])
    np.testing.assert_array_equal(cam.is_inside(pixels, border=5), [0, 0, 0, 0, 1, 0])


def test_nan_pixels_stay_nan_and_disturb_nobody():
    cam = camera("euroc")
    pixels = np.array([[100.0, 50.0], [np.nan, 10.0]])
    normalised = cam.undistort(pixels)
    np.testing.assert_array_equal(normalised[0], cam.undistort(pixels[:1])[0])
    assert np.isnan(normalised[1]).all()


def test_empty_arrays():
    cam = camera("euroc")
    assert cam.project(np.empty((0, 3))).shape == (0, 2)
    assert cam.undistort(np.empty((0, 2))).shape == (0, 2)
    assert cam.project_jacobian(np.empty((0, 3))).shape == (0, 2, 3)


def test_cameras_are_values():
    cam = camera("euroc")
    assert cam == camera("euroc")
    assert hash(cam) == hash(camera("euroc"))
    assert cam != camera("none")
    again = pickle.loads(pickle.dumps(cam))
    assert again == cam
    assert not again.intrinsics.flags.writeable
    assert eval(repr(cam)) == cam
    assert (cam.fx, cam.cy, cam.width, cam.height) == (458.654, 248.375, 752, 480)
    with pytest.raises(ValueError, match="read-only"):
        cam.intrinsics[0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        cam.K[0, 0] = 1.0


GOOD = {
    "model": "pinhole",
    "intrinsics": [500.0, 500.0, 320.0, 240.0],
    "distortion": [],
    "resolution": (640, 480),
}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"model": "pinhol"}, "'pinhol' is unknown .did you mean 'pinhole'"),
        ({"intrinsics": [500.0, 500.0, 320.0]}, "3 numbers, give fx fy cx cy"),
        ({"intrinsics": [500.0, -500.0, 320.0, 240.0]}, "must be above 0"),
        ({"intrinsics": [500.0, np.nan, 320.0, 240.0]}, "NaN"),
        ({"intrinsics": "f"}, "not a list of numbers"),
        ({"distortion": [0.1, 0.2, 0.3]}, "3 numbers, a pinhole camera has 0 or 4 or 5 or 8"),
        ({"distortion": [0.1, np.inf, 0.0, 0.0]}, "NaN or infinite"),
        ({"resolution": (0, 480)}, "whole pixels above 0"),
        ({"resolution": (640.5, 480)}, "whole pixels"),
        ({"resolution": 640}, "give width and height"),
    ],
)
def test_impossible_cameras_are_refused(change, words):
    with pytest.raises(CalibrationError, match=words):
        Camera(**{**GOOD, **change})


def test_wrong_shapes_are_named():
    cam = camera("none")
    with pytest.raises(InputError, match="points_camera"):
        cam.project([1.0, 2.0, 3.0])
    with pytest.raises(InputError, match="pixels"):
        cam.undistort(np.zeros((4, 3)))
