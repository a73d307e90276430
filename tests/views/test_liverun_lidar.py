"""Runs with a LiDAR that are watched: the same bytes, and what a page is shown."""

import numpy as np
import pytest

from livepages import Chromium, browser, page, until
from odomap.reviewing import PastRun, Review
from odomap.run import run
from odomap.views.livescene import LiveScene
from odomap.views.liveserver import close_server, open_server
from recordings import Rendered

STREET = "sim:street?sensors=lidar3d&beams=16&frames=14&seed=2"
HALL = "sim:hall?sensors=laser&seed=3&rounds=0.12"
FILES = ("trajectory.tum", "trajectory_live.tum", "keyframes.tum", "map.odomap", "config.yaml")

pytestmark = pytest.mark.usefixtures("no_report")


@pytest.fixture(scope="module", params=["LiDAR", "laser"])
def kind(request):
    return request.param


@pytest.fixture(scope="module")
def world(kind):
    return Rendered(STREET if kind == "LiDAR" else HALL)


@pytest.fixture(scope="module")
def plain(world, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("odomap.views.report.render_report", lambda _: "<!doctype html>\n")
        return run(world, tmp_path_factory.mktemp("plain"))


def returned(map):
    """Return how many points the keyframes of a map keep."""
    kept = [map.keyframe(k) for k in map.keyframe_ids.tolist()]
    clouds = sum(len(one.cloud) for one in kept if one.cloud is not None)
    return clouds + sum(np.isfinite(one.scan).sum() for one in kept if one.scan is not None)


def test_watched_or_not_the_files_are_the_same_bytes(plain, tmp_path, view, world):
    with page(view.url) as got:
        watched = run(world, tmp_path, view=view)
        assert until(lambda: sum(got) > 10_000)
    for name in FILES:
        assert (watched.out / name).read_bytes() == (plain.out / name).read_bytes(), name


def test_whoever_comes_late_sees_the_cloud_the_path_and_the_sensor(view, world, kind):
    found = run(world, view=view)
    scene, last = view._drawing._scene, found.estimates[-1]
    assert sum(len(node.points) for node in scene._points.values()) == 0
    with page(view.url) as got:
        assert until(lambda: len(scene._points[True].points))
        assert until(lambda: scene.figure.node.visible)
        assert until(lambda: sum(got) > 10_000)
    assert len(scene._keyframes.points) == 4 * found.map.num_keyframes
    assert sum(len(n.points) for n in scene._path.values()) == len(found.estimates) - 1
    mount = world.rig.lidars[0].T_body_lidar
    np.testing.assert_allclose(scene.figure.node.position, (last.T_world_body @ mount).t, atol=1e-9)
    assert len(scene.figure.sweep.points) > 100
    words = scene._words.content
    for word in (last.status.value, "points", "keyframes", str(last.frame_id)):
        assert word in words
    # A map that begins at rest looks ahead of the first body, from above.
    assert scene._server.initial_camera.position[2] > 0.8 * scene.reach
    shaded = scene._points[False].colors
    is_shaded = shaded.ndim == 2 and len(np.unique(shaded, axis=0)) > 10
    assert is_shaded == (kind == "LiDAR")
    newest = scene._points[True].points
    eye = found.map.T_world_body(int(found.map.keyframe_ids[-1]))[:3, 3]
    assert np.median(np.linalg.norm(newest - eye, axis=1)) == pytest.approx(scene.reach, rel=0.7)


def test_a_past_run_is_its_cloud_and_its_path(plain, viser, kind, world):
    for left in (plain.out, plain.out / "map.odomap"):
        past = PastRun.read(left)
        assert past.sensor.name == kind
        mount = world.rig.lidars[0].T_body_lidar
        np.testing.assert_array_equal(past.sensor.T_body_sensor.matrix, mount.matrix)
        server, _ = open_server(port=8950)
        try:
            scene = LiveScene(server, past.sensor, len(past.trajectory))
            Review(past, scene).go_on()
            assert len(scene._points[True].points) == 0
            shown = len(scene._points[False].points)
            assert shown == pytest.approx(returned(past.map), rel=0.02)
            assert scene.figure.node.visible
            assert "points" in scene._words.content
            Ts = past.trajectory.Ts_world_body @ mount.matrix
            np.testing.assert_allclose(scene.figure.node.position, Ts[-1, :3, 3], atol=1e-9)
            scene._slider.value = 1
            review = Review(past, scene)
            review.go_on()
            np.testing.assert_allclose(scene.figure.node.position, Ts[1, :3, 3], atol=1e-9)
        finally:
            close_server(server)


@pytest.mark.skipif(browser() is None, reason="no Chromium found (chromium, google-chrome)")
def test_a_browser_shows_it(view, world):
    """The real page: words in the panel; the map, the newest keyframe and the sweep as pixels."""
    run(world, view=view)
    with Chromium(view.url) as chromium:
        assert until(lambda: "points" in chromium.text, 120), chromium.text

        def colours():
            """Return which of the hues are drawn left of the panel."""
            left = chromium.screenshot()[190:, :800].astype(int)
            red, green, blue = left[..., 0], left[..., 1], left[..., 2]
            return {
                "path": ((blue > red + 40) & (blue > green + 15)).sum() > 20,
                "sweep": ((green > red + 40) & (green > blue + 15)).sum() > 30,
                "in sight": ((abs(red - green) < 40) & (green > blue + 60)).sum() > 30,
                "map": ((abs(red - green) < 25) & (blue > green) & (green > 60)).sum() > 30,
            }

        assert until(lambda: all(colours().values()), 60), colours()
