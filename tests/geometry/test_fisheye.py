"""Lenses that see beside and behind themselves."""

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from odomap.errors import CalibrationError
from odomap.geometry.camera import Camera
from odomap.geometry.pnp import solve_pnp
from odomap.geometry.pose import SE3
from odomap.geometry.rectify import StereoRectification
from odomap.geometry.undistort import Undistortion
from reference import double_sphere, kannala_brandt, numeric_jacobian

# TUM-VI's cameras, as its authors publish them, at 195° across.
TUM_VI = Camera(
    "kannala_brandt",
    [190.97847715, 190.9733070, 254.93170606, 256.89744279],
    [0.0034823894, 0.0007150348, -0.0020532361, 0.0002029367],
    (512, 512),
)
# The same lens as a double sphere.
SPHERES = Camera("double_sphere", [157.2, 157.2, 254.9, 256.9], [-0.176, 0.590], (512, 512))
# One whose polynomial turns back within sight, at 104° from the axis.
FOLDED = Camera("kannala_brandt", [200, 200, 319.5, 239.5], [0, -0.02, 0, 0], (640, 480))
CAMERAS = {
    "tum_vi": TUM_VI,
    "equidistant": Camera("kannala_brandt", [150, 150, 319.5, 239.5], [0, 0, 0, 0], (640, 480)),
    "folded": FOLDED,
    "spheres": SPHERES,
    "flat": Camera("double_sphere", [300, 310, 319.5, 239.5], [0.2, 0.3], (640, 480)),
    "plain": Camera("double_sphere", [300, 310, 319.5, 239.5], [0.0, 0.0], (640, 480)),
    "far": Camera("double_sphere", [300, 310, 319.5, 239.5], [1.3, 0.6], (640, 480)),
}
each_camera = pytest.mark.parametrize("name", CAMERAS)
checked = settings(derandomize=True, deadline=None, max_examples=60, database=None)


def widest(camera):
    """Return the angle from the axis up to which points project, found by asking."""
    angles = np.linspace(0, np.pi, 20001)
    seen = np.isfinite(camera.project(np.stack([np.sin(angles), 0 * angles, np.cos(angles)], 1)))
    seen = seen.all(axis=1)
    assert seen[: seen.sum()].all()  # in one piece
    return float(angles[seen.sum() - 1])


def directions(camera, share=0.995, rings=40):
    theta = np.linspace(0, share * widest(camera), rings)[:, None]
    azimuth = np.linspace(0, 2 * np.pi, 13)[None, :-1]
    rays = np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)
    return np.stack([np.broadcast_to(x, (rings, 12)).ravel() for x in rays], axis=1)


@each_camera
def test_directions_survive_the_round_trip(name):
    camera = CAMERAS[name]
    rays = directions(camera)
    pixels = camera.project(3.7 * rays)
    assert np.isfinite(pixels).all()
    np.testing.assert_allclose(camera.unproject(pixels), rays, rtol=0, atol=1e-8)
    np.testing.assert_allclose(camera.project(camera.unproject(pixels)), pixels, atol=1e-7)


def test_how_far_they_see():
    assert widest(CAMERAS["equidistant"]) == pytest.approx(np.pi, abs=1e-3)
    assert widest(FOLDED) == pytest.approx((1 / 0.1) ** 0.25, abs=1e-3)
    assert widest(TUM_VI) > np.deg2rad(97.5)
    assert np.pi / 2 < widest(SPHERES) < np.pi
    assert widest(CAMERAS["plain"]) == pytest.approx(np.pi / 2, abs=1e-3)  # a pinhole
    # Where a double sphere ends the radius has its maximum or no bound at all.
    edge = widest(SPHERES)
    theta = np.array([edge - 0.02, edge - 0.01, edge])
    radius = SPHERES.project(np.stack([np.sin(theta), 0 * theta, np.cos(theta)], 1))[:, 0]
    assert (np.diff(radius) > 0).all()
    assert np.diff(radius, 2)[0] < 0


@each_camera
def test_a_pixel_has_one_ray_at_most(name):
    camera = CAMERAS[name]
    u, v = np.meshgrid(np.arange(-300, 1000, 25.0), np.arange(-300, 900, 25.0))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = camera.unproject(pixels)
    seen = np.isfinite(rays).all(axis=1)
    assert 0.1 < seen.mean() <= 1.0
    np.testing.assert_allclose(np.linalg.norm(rays[seen], axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(camera.project(rays[seen]), pixels[seen], rtol=0, atol=1e-7)


@each_camera
def test_jacobian_against_differences(name):
    camera = CAMERAS[name]
    points = 2.5 * directions(camera, 0.93, 25)
    expected = numeric_jacobian(lambda d: camera.project(points + d), 3)
    np.testing.assert_allclose(camera.project_jacobian(points), expected, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("name", ["tum_vi", "folded"])
def test_kannala_brandt_is_opencvs_fisheye(name):
    camera = CAMERAS[name]
    points = 2.0 * directions(camera, min(0.99, np.deg2rad(89) / widest(camera)))
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), camera.K, camera.distortion
    )
    np.testing.assert_allclose(camera.project(points), expected[:, 0], rtol=0, atol=1e-7)


def test_projection_is_the_formula():
    for camera, twin in ((TUM_VI, None), (SPHERES, double_sphere)):
        for x, y, z in directions(camera, 0.98, 12):
            if twin is None:
                plane = kannala_brandt(x, y, z, camera.distortion)
            else:
                plane = twin(x, y, z, *camera.distortion)
            pixel = camera.intrinsics[:2] * plane + camera.intrinsics[2:]
            np.testing.assert_allclose(camera.project([[x, y, z]])[0], pixel, rtol=0, atol=1e-4)


@checked
@given(
    k=st.lists(st.floats(-0.05, 0.05), min_size=4, max_size=4),
    share=st.floats(0.0, 1.0, exclude_max=True),
    azimuth=st.floats(-np.pi, np.pi),
    distance=st.floats(1e-3, 1e3),
)
def test_any_kannala_brandt_turns_back(k, share, azimuth, distance):
    camera = Camera("kannala_brandt", [200, 200, 0, 0], k, (400, 400))
    theta = share * widest(camera)
    ray = [np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)]
    pixel = camera.project([distance * np.array(ray)])
    assert np.isfinite(pixel).all()
    found = camera.unproject(pixel)
    # At the edge the radius has its maximum: angles 1e-7 apart have the same one, to rounding.
    np.testing.assert_allclose(found, [ray], rtol=0, atol=1e-6)
    np.testing.assert_allclose(camera.project(found), pixel, rtol=0, atol=1e-9)


@checked
@given(
    xi=st.floats(-0.9, 1.5),
    alpha=st.floats(0.0, 1.0),
    share=st.floats(0.0, 1.0, exclude_max=True),
    azimuth=st.floats(-np.pi, np.pi),
)
def test_any_double_sphere_turns_back(xi, alpha, share, azimuth):
    camera = Camera("double_sphere", [200, 200, 0, 0], [xi, alpha], (400, 400))
    theta = share * widest(camera)
    ray = np.array([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), 0])
    ray[2] = np.cos(theta)
    pixel = camera.project(ray[None])
    assert np.isfinite(pixel).all()
    # Towards 90° of a pinhole, or 180°, the image has no end.
    assume(np.abs(pixel).max() < 1e5)
    found = camera.unproject(pixel)
    assert np.isfinite(found).all() or share > 0.999
    if share < 0.999:
        np.testing.assert_allclose(found, [ray], rtol=0, atol=1e-6)


def test_coefficients_of_next_to_nothing():
    camera = Camera(
        "kannala_brandt", [150, 150, 319.5, 239.5], [1e-3, 0, 1e-30, 5e-324], (640, 480)
    )
    plain = Camera("kannala_brandt", [150, 150, 319.5, 239.5], [1e-3, 0, 0, 0], (640, 480))
    np.testing.assert_array_equal(camera.unproject([[9.0, 9.0]]), plain.unproject([[9.0, 9.0]]))
    assert widest(camera) == widest(plain)


def test_points_on_the_axis():
    for name, camera in CAMERAS.items():
        ahead, behind = camera.project([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0]])
        np.testing.assert_allclose(ahead, camera.intrinsics[2:], rtol=0, atol=1e-12)
        assert np.isnan(behind).all(), name
        J = camera.project_jacobian([[0.0, 0.0, 2.0]])[0]
        scale = 1.0 / (1.0 + camera.distortion[0]) if camera.model == "double_sphere" else 1.0
        np.testing.assert_allclose(J[0], [scale * camera.fx / 2, 0, 0], atol=1e-9)
        assert np.isfinite(camera.unproject([camera.intrinsics[2:]])).all()


def test_rays_from_behind_have_a_direction_but_no_slope():
    side = np.array([[1.0, 0.0, -0.05], [1.0, 0.0, 0.0], [1.0, 0.0, 0.05]])
    for camera in (TUM_VI, SPHERES):
        pixels = camera.project(side)
        assert np.isfinite(camera.unproject(pixels)).all()
        plane = camera.undistort(pixels)
        assert np.isnan(plane[0]).all()
        np.testing.assert_allclose(plane[2], [20.0, 0.0], rtol=1e-5)
        np.testing.assert_allclose(camera.distort(plane[2:]), pixels[2:], atol=1e-6)


def test_nan_and_nothing_disturb_nobody():
    for camera in (TUM_VI, SPHERES):
        pixels = np.array([[100.0, 50.0], [np.nan, 10.0]])
        rays = camera.unproject(pixels)
        np.testing.assert_array_equal(rays[0], camera.unproject(pixels[:1])[0])
        assert np.isnan(rays[1]).all()
        assert np.isnan(camera.project([[0.0, 0.0, 0.0], [np.nan, 0.0, 1.0]])).all()
        assert np.isnan(camera.project_jacobian([[0.0, 0.0, 0.0]])).all()
        assert np.isnan(camera.unproject([[1e9, 0.0]])).all()
        assert camera.project(np.empty((0, 3))).shape == (0, 2)
        assert camera.unproject(np.empty((0, 2))).shape == (0, 3)
        assert camera.project_jacobian(np.empty((0, 3))).shape == (0, 2, 3)


@pytest.mark.parametrize(
    ("model", "distortion", "words"),
    [
        ("kannala_brandt", [0.1, 0.2], r"2 numbers, a kannala_brandt camera has 4 \(k1 k2 k3 k4"),
        ("double_sphere", [0.1] * 4, r"4 numbers, a double_sphere camera has 2 \(xi alpha\)"),
        ("double_sphere", [0.1, 1.2], "alpha = 1.2 must be from 0 to 1"),
        ("double_sphere", [-1.0, 0.5], "xi = -1 must be above -1"),
        ("kanala_brandt", [0, 0, 0, 0], "did you mean 'kannala_brandt'"),
    ],
)
def test_impossible_fisheyes_are_refused(model, distortion, words):
    with pytest.raises(CalibrationError, match=words):
        Camera(model, [200, 200, 200, 200], distortion, (400, 400))


def test_fisheyes_are_values():
    assert eval(repr(SPHERES)) == SPHERES
    assert hash(TUM_VI) == hash(eval(repr(TUM_VI)))
    assert TUM_VI != SPHERES


def test_a_pose_is_found_from_fisheye_pixels():
    T_world_camera = SE3.exp([0.3, -0.2, 0.1, 0.2, -0.4, 0.1])
    rays = directions(TUM_VI, np.deg2rad(80) / widest(TUM_VI), 12)[12:]
    distances = np.random.default_rng(3).uniform(1, 5, len(rays))
    points = T_world_camera @ (distances[:, None] * rays)
    result = solve_pnp(points, TUM_VI.project(distances[:, None] * rays), TUM_VI)
    assert result.num_inliers == len(rays)
    np.testing.assert_allclose(result.T_world_camera.matrix, T_world_camera.matrix, atol=1e-8)


@pytest.mark.parametrize("camera", [TUM_VI, SPHERES, CAMERAS["equidistant"]])
def test_a_fisheye_is_cut_to_a_view_a_pinhole_can_hold(camera):
    undistortion = Undistortion.of(camera)
    ideal = undistortion.camera
    across = 2 * np.arctan(0.5 * camera.width / ideal.fx)
    assert np.deg2rad(100) < across < np.deg2rad(111)
    assert (ideal.model, ideal.resolution) == ("pinhole", camera.resolution)
    # The axis is in the middle, and everything there was seen.
    np.testing.assert_allclose([ideal.cx, ideal.cy], (np.array(camera.resolution) - 1) / 2)
    map_x, map_y = undistortion.maps()
    assert (map_x >= 0).mean() > 0.999
    np.testing.assert_allclose(
        undistortion.to_raw([[ideal.cx, ideal.cy]])[0], [camera.cx, camera.cy], atol=1e-9
    )
    assert map_y.dtype == np.float32


def test_a_narrow_fisheye_keeps_its_whole_view():
    camera = Camera("kannala_brandt", [500, 500, 330, 250], [-0.02, 0, 0, 0], (640, 480))
    ideal = Undistortion.of(camera).camera
    u, v = np.meshgrid(np.arange(0, 640, 8.0), np.arange(0, 480, 8.0))
    raw = np.stack([u.ravel(), v.ravel()], axis=1)
    assert ideal.is_inside(ideal.project(camera.unproject(raw))).mean() > 0.93
    assert 0.8 * 500 < ideal.fx <= 500


@pytest.mark.parametrize("lens", [TUM_VI, SPHERES])
def test_rows_of_a_fisheye_pair_agree(lens):
    right_lens = Camera(
        lens.model, lens.intrinsics * [1.004, 0.997, 0.99, 1.01], lens.distortion, (512, 512)
    )
    T_left_right = SE3.from_parts(np.eye(3), [0.101, 0.002, 0.001]) @ SE3.exp(
        [0, 0, 0, 0.02, -0.03, 0.01]
    )
    pair = StereoRectification.of(lens, right_lens, T_left_right)
    across = 2 * np.arctan(256 / pair.camera.fx)
    assert np.deg2rad(100) < across < np.deg2rad(111)
    points = np.random.default_rng(1).uniform([-6, -4, 0.3], [6, 4, 5], (3000, 3))
    left, right = lens.project(points), right_lens.project(T_left_right.inverse() @ points)
    a, b = pair.from_raw(left, "left"), pair.from_raw(right, "right")
    seen = pair.camera.is_inside(a) & pair.camera.is_inside(b)
    assert seen.sum() > 500
    np.testing.assert_allclose(a[seen, 1], b[seen, 1], rtol=0, atol=1e-6)
    depth = pair.camera.fx * pair.baseline / (a[seen, 0] - b[seen, 0])
    expected = (pair.T_left_rect.inverse() @ points[seen])[:, 2]
    np.testing.assert_allclose(depth, expected, rtol=1e-7)
    for which in ("left", "right"):
        map_x, _ = pair.maps(which)
        assert (map_x >= 0).mean() > 0.99
