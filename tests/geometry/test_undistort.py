"""The pinhole a camera is warped into: exact, and with the view and the detail it promises."""

import cv2
import numpy as np
import pytest

from odomap.errors import CalibrationError
from odomap.geometry.camera import Camera
from odomap.geometry.undistort import Undistortion

SIZE = (752, 480)
EUROC = Camera(
    "pinhole",
    [458.654, 457.296, 367.215, 248.375],
    [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05],
    SIZE,
)
PINCUSHION = Camera("pinhole", [458.0, 458.0, 375.5, 239.5], [0.25, 0.02, 0.0, 0.0], SIZE)
FREIBURG1 = Camera(
    "pinhole", [517.3, 516.5, 318.6, 255.3], [0.2624, -0.9531, -0.0054, 0.0026, 1.1633], (640, 480)
)
LENSES = {"euroc": EUROC, "pincushion": PINCUSHION, "freiburg1": FREIBURG1}
each_lens = pytest.mark.parametrize("name", LENSES)


def raw_grid(camera, step=5.0):
    u, v = np.meshgrid(np.arange(0, camera.width, step), np.arange(0, camera.height, step))
    return np.stack([u.ravel(), v.ravel()], axis=1)


@each_lens
def test_the_view_and_the_detail_are_kept(name):
    raw = LENSES[name]
    ideal = Undistortion.of(raw).camera
    assert (ideal.model, ideal.resolution, len(ideal.distortion)) == ("pinhole", raw.resolution, 0)
    assert ideal.fx == ideal.fy
    assert 0.75 * raw.fx < ideal.fx <= 1.0001 * raw.fx
    kept = ideal.is_inside(ideal.project(raw.unproject(raw_grid(raw))), border=-0.5)
    assert kept.mean() > 0.93
    if name == "pincushion":
        assert ideal.fx == pytest.approx(458.0)


@each_lens
def test_the_way_back_is_exact(name):
    raw = LENSES[name]
    undistortion = Undistortion.of(raw)
    pixels = raw_grid(raw, 31.0)
    back = undistortion.to_raw(pixels)
    seen = np.isfinite(back).all(axis=1)
    assert seen.mean() > 0.9
    again = undistortion.camera.project(raw.unproject(back[seen]))
    np.testing.assert_allclose(again, pixels[seen], rtol=0, atol=1e-7)
    # The axes are those of the camera: the same ray, no turn.
    ray = raw.unproject(back[seen])
    np.testing.assert_allclose(undistortion.camera.unproject(pixels[seen]), ray, atol=1e-9)


def test_maps_are_to_raw_and_agree_with_opencv():
    undistortion = Undistortion.of(EUROC)
    map_x, map_y = undistortion.maps()
    assert map_x.dtype == map_y.dtype == np.float32
    assert map_x.shape == map_y.shape == SIZE[::-1]
    assert map_x.flags.c_contiguous
    ideal = undistortion.camera
    expected = cv2.initUndistortRectifyMap(
        EUROC.K, EUROC.distortion, np.eye(3), ideal.K, SIZE, cv2.CV_32FC1
    )
    seen = map_x >= 0
    assert seen.mean() > 0.85
    np.testing.assert_allclose(map_x[seen], expected[0][seen], atol=1e-3)
    np.testing.assert_allclose(map_y[seen], expected[1][seen], atol=1e-3)
    pixels = np.array([[100.0, 200.0], [375.0, 240.0]])
    got = [[map_x[int(v), int(u)], map_y[int(v), int(u)]] for u, v in pixels]
    np.testing.assert_allclose(got, undistortion.to_raw(pixels), atol=1e-4)


def test_a_pinhole_is_left_alone():
    camera = Camera("pinhole", [700.0, 710.0, 600.0, 180.0], [0, 0, 0, 0], (1240, 370))
    undistortion = Undistortion.of(camera)
    assert undistortion.is_identity
    assert undistortion.camera is camera
    pixels = raw_grid(camera, 100.0)
    np.testing.assert_allclose(undistortion.to_raw(pixels), pixels, rtol=0, atol=1e-9)


def test_a_focal_length_can_be_asked_for():
    undistortion = Undistortion.of(EUROC, focal_px=300.0)
    assert undistortion.camera.fx == 300.0
    assert not undistortion.is_identity
    assert Undistortion.of(Camera("pinhole", [300, 300, 9, 9], [], (20, 20)), 200).camera.fx == 200


def test_a_wide_pinhole_keeps_its_view():
    # 130° across with little distortion: its own image has the stretch in it already.
    raw = Camera("pinhole", [150.0, 150.0, 319.5, 199.5], [1e-3, 0, 0, 0], (640, 400))
    ideal = Undistortion.of(raw).camera
    assert ideal.fx == pytest.approx(150.0, rel=0.05)


def test_a_lens_without_inverse_is_refused():
    # The polynomial folds at r = 0.18, where there is no pixel of this image yet.
    raw = Camera("pinhole", [100.0, 100.0, 1e4, 1e4], [-10.0, 0, 0, 0], (640, 400))
    with pytest.raises(CalibrationError, match="cannot be inverted"):
        Undistortion.of(raw)
