"""The scene of the live view: what is drawn where, and what the panel says."""

import numpy as np
import pytest

from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_exp
from odomap.geometry.pose import SE3
from odomap.views.livefigure import frusta
from odomap.views.livemap import Shown
from odomap.views.livescene import (
    KEYFRAMES,
    PATH_POINTS,
    LiveScene,
    Panel,
    panel_html,
)
from odomap.views.livesensor import CameraSensor

CAMERA = Camera("pinhole", np.array([400.0, 400.0, 320.0, 240.0]), np.zeros(0), (640, 480))


@pytest.fixture
def scene(server):
    return LiveScene(server, CameraSensor(CAMERA))


def test_frusta_are_cameras_that_look_ahead():
    T = se3_exp(np.array([1.0, 2.0, 3.0, 0.1, -0.2, 0.3]))
    edges = frusta(np.stack([np.eye(4), T]), (0.8, 0.6), 2.0).reshape(2, 8, 2, 3)
    first = edges[0].reshape(-1, 3)
    assert first[:, 2].max() == 2.0  # z is ahead
    assert set(first[:, 0].round(6)) == {0.0, np.float32(1.6).round(6), np.float32(-1.6).round(6)}
    np.testing.assert_allclose(
        edges[1], edges[0] @ T[:3, :3].T.astype(np.float32) + T[:3, 3], atol=1e-5
    )


def test_a_path_is_parted_where_frames_are_lost(scene):
    positions = np.c_[np.arange(6.0), np.zeros(6), np.zeros(6)]
    is_lost = np.array([False, False, False, True, False, False])
    scene.show_path(positions, is_lost)
    known, lost = (scene._path[key].points for key in (False, True))
    assert known[:, 0, 0].tolist() == [0.0, 1.0, 4.0]
    assert lost[:, 0, 0].tolist() == [2.0, 3.0]
    assert (known[:, 1, 0] - known[:, 0, 0] == 1.0).all()


def test_a_long_path_is_thinned_and_keeps_what_is_lost(scene):
    n = 4 * PATH_POINTS + 3
    is_lost = np.zeros(n, np.bool_)
    is_lost[777] = True
    scene.show_path(np.c_[np.arange(n), np.zeros((n, 2))], is_lost)
    known, lost = (scene._path[key].points for key in (False, True))
    assert len(known) + len(lost) < PATH_POINTS
    assert len(lost) == 1
    assert lost[0, 0, 0] <= 777 <= lost[0, 1, 0]
    assert max(known[:, 1, 0].max(), lost[:, 1, 0].max()) == n - 1


@pytest.mark.parametrize("n", [0, 1])
def test_a_path_that_has_not_begun(scene, n):
    scene.show_path(np.zeros((n, 3)), np.zeros(n, np.bool_))
    assert len(scene._path[False].points) == 0


def test_landmarks_in_sight_stand_out_and_keyframes_are_limited(scene):
    points = np.arange(12.0).reshape(4, 3)
    Ts = np.tile(np.eye(4), (KEYFRAMES + 500, 1, 1))
    scene.show_map(Shown(points, np.array([False, True, False, True]), 4), Ts)
    assert np.array_equal(scene._points[True].points, points[[1, 3]].astype(np.float32))
    assert np.array_equal(scene._points[False].points, points[[0, 2]].astype(np.float32))
    assert len(scene._keyframes.points) == 8 * KEYFRAMES


def test_up_is_up_in_the_first_image_and_the_eye_is_behind(scene, server):
    T = se3_exp(np.array([4.0, 5.0, 6.0, 0.3, 0.2, -0.4]))
    scene.face(T, 10.0)
    seen = T[:3, :3].T @ server.initial_camera.position  # in the camera's axes
    assert seen[2] < 0  # behind
    assert seen[1] < 0  # above: y is down
    assert 3 < np.linalg.norm(seen) < 10


def test_following_moves_the_world_until_it_is_switched_off(scene):
    T = SE3.identity().matrix.copy()
    T[:3, 3] = 1.0, 2.0, 3.0
    scene.follow(T)
    assert np.allclose(scene._world.position, (-1.0, -2.0, -3.0))
    scene._follow.value = False
    scene.follow(np.eye(4))
    assert np.allclose(scene._world.position, (-1.0, -2.0, -3.0))


def test_the_camera_shows_the_newest_image(scene):
    image = np.zeros((480, 640, 3), np.uint8)
    scene.show_sensor(np.eye(4), np.array([1.0, 0, 0, 0]), image, False)
    assert scene.figure.node.visible
    assert scene.figure.node.image.shape == (240, 320, 3)
    assert scene.figure._picture.image.shape == (480, 640, 3)
    scene.show_sensor(np.eye(4), np.array([1.0, 0, 0, 0]), None, True)
    assert scene.figure.node.image.shape == (240, 320, 3)


def test_controls_are_obeyed(scene):
    scene.face(np.eye(4), 1.0)
    scene.obey()
    before = scene._points[False].point_size
    scene._point_size.value = 3.0
    scene._shows_keyframes.value = False
    scene.obey()
    assert scene._points[False].point_size == pytest.approx(3 * before)
    assert not scene._keyframes.visible


def test_a_slider_tells_the_frame(server):
    assert LiveScene(server, CameraSensor(CAMERA)).frame == 0
    scene = LiveScene(server, CameraSensor(), frames=7)
    assert scene.frame == 6
    scene._slider.value = 2
    assert scene.frame == 2
    assert LiveScene(server, CameraSensor(), frames=1).frame == 0


def test_the_panel_escapes_what_is_not_ours():
    text = panel_html(Panel("lost", "<script>1</script> & gone", (("a<b", "1 > 0"),)))
    assert "<script>" not in text
    assert "&lt;script&gt;1&lt;/script&gt; &amp; gone" in text
    assert "a&lt;b" in text


def test_the_panel_says_what_has_just_happened():
    text = panel_html(Panel("tracking", "", (), "loop: keyframe 120 is <back>"))
    assert "loop: keyframe 120 is &lt;back&gt;" in text
    assert "color:#ff69d2" in text


def test_loops_gaps_and_the_path_before_them_can_be_hidden(scene):
    loops, gaps = np.arange(12.0).reshape(2, 2, 3), np.array([[[0.0] * 3, [23.0, 0.0, 0.0]]])
    scene.show_loops(loops, gaps, np.arange(9.0).reshape(3, 3))
    assert np.array_equal(scene._loops.points, loops.astype(np.float32))
    assert len(scene._loop_ends.points) == 4
    assert len(scene._told.points) == 2
    dashed = scene._gaps.points
    assert dashed[0, 0, 0] == 0.0
    assert dashed[-1, 1, 0] == 23.0
    np.testing.assert_allclose(dashed[:, 1, 0] - dashed[:, 0, 0], 1.0, rtol=1e-5)
    scene.obey()
    assert scene._loops.visible
    assert scene._told.visible
    scene._shows_loops.value = scene._shows_told.value = False
    scene.obey()
    assert not any(n.visible for n in (scene._loops, scene._gaps, scene._told))
    scene.show_loops(loops[:0], gaps[:0], np.zeros((0, 3)))
    assert all(len(n.points) == 0 for n in (scene._loops, scene._gaps, scene._told))
