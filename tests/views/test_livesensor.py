"""Which sensor is followed, how it is looked at, and what it looks like."""

import numpy as np
import pytest

from odomap.errors import CalibrationError
from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_exp
from odomap.geometry.pose import SE3
from odomap.maps.estimate import Estimate, Status, Tracks
from odomap.sensors.frame import Frame
from odomap.sensors.rig import CameraMount, DepthMount, LidarMount, Rig
from odomap.sensors.sweep import Sweep
from odomap.views.livefigure import LOST, SENSOR, arrows
from odomap.views.livescene import LiveScene
from odomap.views.livesensor import CameraSensor, tracked_sensor, usual_sensors

LENS = Camera("pinhole", np.array([400.0, 400.0, 320.0, 240.0]), np.zeros(0), (640, 480))
ASKEW = SE3(se3_exp(np.array([0.5, 0.2, 1.7, 0.2, -0.3, 2.0])))
LEFT = CameraMount("left", LENS, ASKEW)
RIGHT = CameraMount("right", LENS, ASKEW @ SE3.from_parts(np.eye(3), np.array([0.1, 0.0, 0.0])))
TOP = LidarMount("top", ASKEW)
FLAT = LidarMount("laser", ASKEW, angles=(-2.0, 2.0, 9))


def rig(*cameras, lidars=(), depth=None):
    return Rig(cameras=cameras, lidars=lidars, depth=depth)


def estimate(status=Status.TRACKING, tracks=None):
    one = SE3.identity()
    return Estimate(0, 0, status, "", 0, one, one, np.eye(6), tracks=tracks)


@pytest.mark.parametrize(
    ("sensors", "there", "name", "mount"),
    [
        ("stereo", rig(LEFT, RIGHT), "camera", ASKEW),
        ("rgbd", rig(RIGHT, LEFT, depth=DepthMount("left")), "camera", ASKEW),
        ("mono", rig(LEFT, lidars=(TOP,)), "camera", SE3.identity()),
        ("lidar", rig(LEFT, lidars=(FLAT, TOP)), "LiDAR", ASKEW),
        ("lidar2d", rig(lidars=(TOP, FLAT)), "laser", ASKEW),
        ("stereo", rig(), "camera", SE3.identity()),
    ],
)
def test_who_is_followed_is_what_the_run_uses(sensors, there, name, mount):
    found = tracked_sensor(there, sensors)
    assert found.name == name
    assert np.array_equal(found.T_body_sensor.matrix, mount.matrix)
    assert found.remembers == ("landmarks" if name == "camera" else "points")


def test_cameras_that_are_no_pair_are_not_followed_as_one():
    with pytest.raises(CalibrationError):
        tracked_sensor(rig(RIGHT, LEFT), "stereo")


def test_what_is_usual_is_said_by_the_rig():
    assert usual_sensors(rig(LEFT)) == "mono"
    assert usual_sensors(rig(LEFT, RIGHT, lidars=(TOP,))) == "stereo"
    assert usual_sensors(rig(LEFT, depth=DepthMount("left"))) == "rgbd"
    assert usual_sensors(rig(lidars=(TOP, FLAT))) == "lidar"
    assert usual_sensors(rig(lidars=(FLAT,))) == "lidar2d"


@pytest.mark.parametrize(("sensors", "least"), [("lidar", 0.4), ("lidar2d", 0.99)])
def test_a_lidar_is_looked_at_from_above_its_body_however_it_is_mounted(server, sensors, least):
    sensor = tracked_sensor(rig(lidars=(TOP, FLAT)), sensors)
    scene = LiveScene(server, sensor)
    T_world_body = se3_exp(np.array([4.0, 5.0, 6.0, 0.0, 0.0, 0.9]))
    scene.face((SE3(T_world_body) @ sensor.T_body_sensor).matrix, 10.0)
    eye = T_world_body[:3, :3].T @ server.initial_camera.position  # on the body: x ahead, z up
    assert eye[0] < 0.0
    assert abs(eye[1]) < 1e-9
    assert eye[2] / np.linalg.norm(eye) > least
    assert 10.0 < np.linalg.norm(eye) < 40.0


def test_marks_of_a_lidar_are_heads_that_point_ahead_on_the_body():
    T = se3_exp(np.array([1.0, 2.0, 3.0, 0.1, -0.2, 0.3]))
    heads = arrows(np.stack([np.eye(4), T]), 2.0).reshape(2, 4, 2, 3)
    tip = heads[0].reshape(-1, 3)[:, 0].argmax()
    np.testing.assert_allclose(heads[0].reshape(-1, 3)[tip], (1.0, 0.0, 0.0))
    assert heads[0, ..., 0].min() == -1.0
    assert not heads[0, ..., 2].any()
    np.testing.assert_allclose(heads[1], heads[0] @ T[:3, :3].T + T[:3, 3], atol=1e-6)
    marks = tracked_sensor(rig(lidars=(TOP,)), "lidar").marks((SE3(T) @ ASKEW).matrix[None], 1.0)
    on_body = (marks.reshape(-1, 3) - (SE3(T) @ ASKEW).t) @ T[:3, :3]
    np.testing.assert_allclose(on_body[:, 2], 0.0, atol=1e-6)
    assert on_body[:, 0].max() == pytest.approx(0.025)


def test_a_lidar_shows_what_returned_around_it_red_when_it_is_lost(server):
    sensor = tracked_sensor(rig(lidars=(TOP,)), "lidar")
    scene = LiveScene(server, sensor)
    scene.face(np.eye(4), 20.0)
    points = np.array([(5.0, 0, 0), (np.nan, 0, 0), (0, 8.0, 0)])
    sight = sensor.sight(Frame(0, 0, cloud=Sweep(points)), estimate())
    pose = SE3(se3_exp(np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.5])))
    scene.show_sensor(pose.matrix, pose.quaternion, sight, False)
    figure = scene.figure
    assert figure.sweep.points.tolist() == [[5.0, 0.0, 0.0], [0.0, 8.0, 0.0]]
    assert figure.node.visible
    np.testing.assert_allclose(figure.node.position, pose.t)
    np.testing.assert_allclose(figure.node.wxyz, pose.quaternion)
    assert figure.node.axes_length == pytest.approx(2.4)
    assert figure.sweep.colors.tolist() == list(SENSOR)
    scene.show_sensor(pose.matrix, pose.quaternion, None, True)
    assert len(figure.sweep.points) == 2
    assert figure.sweep.colors.tolist() == list(figure.node.origin_color) == list(LOST)
    nothing = sensor.sight(Frame(1, 1), estimate(Status.LOST))
    scene.show_sensor(pose.matrix, pose.quaternion, nothing, True)
    assert len(figure.sweep.points) == 0


def test_the_size_of_points_is_that_of_the_sweep_too(server):
    scene = LiveScene(server, tracked_sensor(rig(lidars=(TOP,)), "lidar"))
    scene.face(np.eye(4), 10.0)
    scene.obey()
    before = scene.figure.sweep.point_size
    scene._point_size.value = 2.0
    scene.obey()
    assert scene.figure.sweep.point_size == pytest.approx(2.0 * before)
    assert scene._points[False].point_size == pytest.approx(2.0 * before)


def test_a_camera_shows_its_own_image_with_its_tracks():
    sensor = CameraSensor(LENS, SE3.identity(), 1)
    dark, grey = np.zeros((60, 80), np.uint8), np.full((60, 80), 90, np.uint8)
    one = np.array([(30.0, 20.0)], np.float32)
    told = estimate(tracks=Tracks(one, one, np.array([True])))
    shown = sensor.sight(Frame(0, 0, (dark, grey)), told)
    assert shown[50, 70].tolist() == [90, 90, 90]
    assert shown[20, 30].tolist() != [90, 90, 90]
    assert sensor.sight(Frame(0, 0, (dark,)), told) is None
    assert sensor.sight(Frame(0, 0, (dark, None)), told) is None
