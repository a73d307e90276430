import cv2
import numpy as np
import pytest

from odomap.errors import CalibrationError, InputError
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.geometry.rectify import StereoRectification

LEFT = Camera(
    "pinhole",
    [458.654, 457.296, 367.215, 248.375],
    [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05],
    (752, 480),
)
RIGHT = Camera(
    "pinhole",
    [457.587, 456.134, 379.999, 255.238],
    [-0.28368365, 0.07451284, -0.00010473, -3.55590700e-05],
    (752, 480),
)
# EuRoC MH_01, sensor.yaml of cam0 and cam1.
T_BODY_LEFT = SE3(
    [
        [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
        [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
        [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
T_BODY_RIGHT = SE3(
    [
        [0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556],
        [0.999598781151, 0.0130119051815, 0.0251588363115, 0.0453689425024],
        [-0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
T_LEFT_RIGHT = T_BODY_LEFT.inverse() @ T_BODY_RIGHT
KITTI = Camera("pinhole", [707.0912, 707.0912, 601.8873, 183.1104], [], (1226, 370))


@pytest.fixture(scope="module")
def pair():
    return StereoRectification.of(LEFT, RIGHT, T_LEFT_RIGHT)


def test_rows_agree_and_depth_follows_from_disparity(pair):
    points = np.random.default_rng(1).uniform([-3, -2, 1], [3, 2, 15], (2000, 3))
    left, right = LEFT.project(points), RIGHT.project(T_LEFT_RIGHT.inverse() @ points)
    seen = LEFT.is_inside(left) & RIGHT.is_inside(right)
    assert seen.sum() > 500
    a, b = pair.from_raw(left[seen], "left"), pair.from_raw(right[seen], "right")
    np.testing.assert_allclose(a[:, 1], b[:, 1], rtol=0, atol=1e-6)
    depth = pair.camera.fx * pair.baseline / (a[:, 0] - b[:, 0])
    expected = (pair.T_left_rect.inverse() @ points[seen])[:, 2]
    np.testing.assert_allclose(depth, expected, rtol=1e-9)
    # The rectified left camera is a turn of the left one: the same point, the same pixel.
    np.testing.assert_allclose(
        pair.camera.project(pair.T_left_rect.inverse() @ points[seen]), a, rtol=0, atol=1e-8
    )


def test_the_common_camera_keeps_detail_and_view(pair):
    cam = pair.camera
    assert cam.resolution == LEFT.resolution
    assert len(cam.distortion) == 0
    assert cam.fx == cam.fy
    assert cam.fx == pytest.approx(457.4, abs=0.5)
    assert pair.baseline == pytest.approx(0.11007784, abs=1e-8)
    assert not pair.is_identity
    u, v = np.meshgrid(np.arange(0, 752.0, 8), np.arange(0, 480.0, 8))
    raw = np.stack([u.ravel(), v.ravel()], axis=1)
    kept = cam.is_inside(pair.from_raw(raw, "left")), cam.is_inside(pair.from_raw(raw, "right"))
    assert min(np.mean(kept[0]), np.mean(kept[1])) > 0.7
    wide = StereoRectification.of(LEFT, RIGHT, T_LEFT_RIGHT, focal_px=380.0)
    assert np.mean(wide.camera.is_inside(wide.from_raw(raw, "left"))) > 0.85


@pytest.mark.parametrize("which", ["left", "right"])
def test_maps_are_to_raw_and_agree_with_opencv(pair, which):
    map_x, map_y = pair.maps(which)
    assert map_x.dtype == map_y.dtype == np.float32
    assert map_x.shape == map_y.shape == (480, 752)
    assert map_x.flags.c_contiguous
    pixels = np.array([[0.0, 0.0], [100.0, 200.0], [751.0, 479.0]])
    raw = pair.to_raw(pixels, which)
    got = [[map_x[int(v), int(u)], map_y[int(v), int(u)]] for u, v in pixels]
    np.testing.assert_allclose(got, raw, atol=1e-4)
    np.testing.assert_allclose(pair.from_raw(raw, which), pixels, rtol=0, atol=1e-8)
    camera = LEFT if which == "left" else RIGHT
    R = pair.R_left_rect if which == "left" else pair.R_right_rect
    expected = cv2.initUndistortRectifyMap(
        camera.K, camera.distortion, R.T, pair.camera.K, (752, 480), cv2.CV_32FC1
    )
    np.testing.assert_allclose(map_x, expected[0], atol=1e-3)
    np.testing.assert_allclose(map_y, expected[1], atol=1e-3)


def test_a_rectified_pair_is_left_alone():
    pair = StereoRectification.of(KITTI, KITTI, SE3.exp([0.537, 0, 0, 0, 0, 0]))
    assert pair.is_identity
    assert pair.camera == KITTI
    assert pair.baseline == pytest.approx(0.537)
    map_x, map_y = pair.maps("left")
    v, u = np.mgrid[:370, :1226]
    np.testing.assert_allclose(map_x, u, atol=1e-3)
    np.testing.assert_allclose(map_y, v, atol=1e-3)


@pytest.mark.parametrize(
    "xi", [[0.5, 0.01, 0, 0, 0, 0], [0.5, 0, 0, 0.001, 0, 0], [0.5, 0, 0.01, 0, 0, 0]]
)
def test_a_pair_that_is_slightly_off_is_not_called_rectified(xi):
    T = SE3.exp(xi)
    pair = StereoRectification.of(KITTI, KITTI, T)
    assert not pair.is_identity
    points = np.random.default_rng(2).uniform([-3, -1, 5], [3, 1, 15], (100, 3))
    a = pair.from_raw(KITTI.project(points), "left")
    b = pair.from_raw(KITTI.project(T.inverse() @ points), "right")
    np.testing.assert_allclose(a[:, 1], b[:, 1], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("T", "words"),
    [
        (SE3.exp([-0.5, 0, 0, 0, 0, 0]), "swap the two cameras"),
        (SE3.identity(), "baseline is 0"),
        (SE3.exp([0.0, 0.5, 0, 0, 0, 0]), "not to the right"),
        (SE3.exp([0.1, 0, 0.5, 0, 0, 0]), "not to the right"),
        (SE3.from_parts(np.diag([-1.0, 1.0, -1.0]), [0.5, 0, 0]), "over 60° apart"),
    ],
)
def test_impossible_pairs_are_refused(T, words):
    with pytest.raises(CalibrationError, match=words):
        StereoRectification.of(KITTI, KITTI, T)


def test_an_unknown_side_is_refused(pair):
    with pytest.raises(InputError, match="give 'left' or 'right'"):
        pair.maps("middle")
