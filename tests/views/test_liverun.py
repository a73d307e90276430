"""A run that is watched: the same bytes, whoever comes and goes, and what a page is shown."""

import subprocess
import sys
import threading
import time

import numpy as np
import pytest

import odomap.viewing
from livepages import Chromium, browser, page, until
from odomap.cli import main
from odomap.errors import InputError, MissingExtra
from odomap.files.mapfile import load_map, save_map
from odomap.geometry.pose import SE3
from odomap.maps.estimate import Estimate, Status
from odomap.maps.keyframes import Keyframe
from odomap.reviewing import PastRun, Review, pauses, review
from odomap.run import run
from odomap.sources.open import open as open_source
from odomap.system.config import preset
from odomap.system.odometry import make_odometry
from odomap.system.stages import Loop
from odomap.views.livescene import LiveScene
from odomap.views.liveserver import close_server, open_server
from recordings import Rendered

WORLD = "sim:room?seed=3&frames=12&resolution=400x250"
FILES = ("trajectory.tum", "trajectory_live.tum", "keyframes.tum", "map.odomap", "config.yaml")


@pytest.fixture(scope="module")
def world():
    return Rendered(WORLD)


@pytest.fixture(scope="module")
def plain(world, tmp_path_factory):
    return run(world, tmp_path_factory.mktemp("plain"))


def drawing(view):
    return view._drawing


def threads():
    return {t.name for t in threading.enumerate() if t.name.startswith("odomap")}


def test_a_run_is_told_of_what_is_missing_before_it_begins(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingExtra, match=r"odomap\[view\]"):
        run("no such recording", tmp_path / "out", view=True)
    assert not (tmp_path / "out").exists()
    assert main(["run", WORLD, "--view"]) == 2


@pytest.mark.usefixtures("no_report")
@pytest.mark.parametrize("rhythm", ["inline", "lockstep"])
def test_watched_or_not_the_files_are_the_same_bytes(viser, plain, tmp_path, view, rhythm, world):
    """With a page that stays, and others that come and go all the time."""
    over = threading.Event()
    came = []

    def come_and_go():
        while not over.is_set():
            with page(view.url) as got:
                until(lambda: got, 2.0)
                came.append(len(got))

    visitor = threading.Thread(target=come_and_go)
    with page(view.url):
        visitor.start()
        try:
            watched = run(world, tmp_path, view=view, rhythm=rhythm)
        finally:
            over.set()
            visitor.join()
    assert len(came) > 1
    if rhythm == "inline":
        plain = run(world, tmp_path / "plain", rhythm=rhythm)
    for name in FILES:
        if name != "config.yaml" or rhythm == "lockstep":  # which says the rhythm
            assert (watched.out / name).read_bytes() == (plain.out / name).read_bytes(), name


def test_whoever_comes_late_sees_the_whole_run(view, world):
    found = run(world, view=view)
    scene, last = drawing(view)._scene, found.estimates[-1]
    assert len(scene._path[False].points) == 0  # nobody looked, and nothing was drawn
    with page(view.url) as got:
        assert until(lambda: len(scene._path[False].points))
        assert until(lambda: sum(got) > 10_000)  # the picture is among it
    assert sum(len(n.points) for n in scene._path.values()) == len(found.estimates) - 1
    assert len(scene._keyframes.points) == 8 * found.map.num_keyframes
    assert sum(len(n.points) for n in scene._points.values()) == found.map.num_landmarks
    np.testing.assert_allclose(
        scene.figure.node.position,
        (last.T_world_body.matrix @ drawing(view)._T_body_sensor.matrix)[:3, 3],
    )
    words = scene._words.content
    for word in (last.status.value, str(last.frame_id), str(found.map.num_landmarks)):
        assert word in words
    with page(view.url) as again:  # the page is opened anew
        assert until(lambda: sum(again) > 10_000)


def test_a_loop_is_said_for_some_seconds_and_drawn_with_the_path_before_it(view, monkeypatch):
    """Without a run: a system whose tracker never tells anything again once the loop is closed."""
    system = make_odometry(open_source(WORLD).rig, preset("stereo"))
    view.watch(system, open_source(WORLD).rig, preset("stereo"))
    m, T = system.map, np.eye(4)
    for k in range(3):
        m.add_keyframe(Keyframe(k, k), T)
        T_now = SE3(T)
        view._on_estimate(Estimate(k, k, Status.TRACKING, "", k, SE3.identity(), T_now, np.eye(6)))
        T = T.copy()
        T[0, 3] += 1.0
    scene = drawing(view)._scene
    with page(view.url):
        assert until(lambda: len(scene._path[False].points) == 2)
        assert len(scene._told.points) == 0
        m.add_edge(0, 2, np.eye(4), np.eye(6), "loop")
        view._on_loop(Loop(2, 1, np.eye(4), 3, False, "3 inliers of 30 needed"))
        view._on_loop(Loop(2, 0, np.eye(4), 80, True, moved=0.83))
        view._on_map(None)
        news = "loop: keyframe 2 is back at 0, path moved by 0.83 m"
        assert until(lambda: news in scene._words.content)
        assert until(lambda: len(scene._loops.points) == 1)
        assert len(scene._told.points) == 2
        monkeypatch.setattr(odomap.viewing, "NEWS_FOR_S", 0.0)
        assert until(lambda: news not in scene._words.content)
        assert until(lambda: "loops" in scene._words.content)


def test_a_view_can_watch_one_run_after_the_other(view, world):
    for _ in range(2):
        run(world, view=view, max_frames=4)
        with page(view.url):
            assert until(lambda: drawing(view)._drawn is not None)
        assert len(drawing(view)._path) == 4
    assert threads() == {"odomap view"}


def test_a_view_of_a_runs_own_ends_with_it(viser, capfd, world):
    before = threads()
    result = run(world, max_frames=3, view=True)
    assert result.failure == ""
    assert threads() == before
    out, err = capfd.readouterr()
    assert out == ""
    assert err.count("odomap: view: http://127.0.0.1:") == 1


def test_what_a_view_costs_the_tracker_is_small(view, world):
    """The observers' time per frame: the least of many, since other programs take their share."""
    config = preset("stereo")
    system = make_odometry(world.rig, config)
    view.watch(system, world.rig, config)
    laps = []
    for frame in list(world)[:3]:
        view.see(frame)
        estimate = system.track(frame)
        for _ in range(200):
            start = time.perf_counter()
            view.see(frame)
            view._on_estimate(estimate)
            view._on_map(None)
            laps.append(time.perf_counter() - start)
    assert min(laps) < 1e-4
    assert len(drawing(view)._mailbox._items) <= odomap.viewing.MESSAGES


def test_a_view_that_breaks_says_so_once_and_the_run_goes_on(
    view, plain, monkeypatch, caplog, world
):
    def broken(*_):
        raise RuntimeError("no colours left")

    monkeypatch.setattr(odomap.viewing._Drawing, "go_on", broken)
    result = run(world, view=view, max_frames=4)
    assert until(lambda: caplog.records)
    assert result.metrics["frames"] == 4
    assert [r.message for r in caplog.records] == ["the view has stopped; the run goes on"]


# ---- the command line ----


def test_in_a_pipe_a_watched_run_ends_by_itself(viser, tmp_path, capfd):
    words = ["run", WORLD, "--out", str(tmp_path), "--max-frames", "3", "--view"]
    assert main([*words, "--view-port", "8700", "--quiet"]) == 0
    out, err = capfd.readouterr()
    assert "viser" not in out
    assert err.count("http://127.0.0.1:87") == 1


def test_on_a_terminal_the_page_stays_until_ctrl_c(view, monkeypatch, capsys):
    looked = []

    def sleep(_):
        looked.append(1)
        if len(looked) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(odomap.viewing.time, "sleep", sleep)
    view.wait()
    assert not looked
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    view.wait()
    assert len(looked) == 3
    assert capsys.readouterr().err.count("Ctrl-C ends it") == 1


# ---- a run that is over ----


def test_a_past_run_is_what_the_run_left(plain, tmp_path):
    past = PastRun.read(plain.out)
    assert len(past.trajectory) == len(plain.trajectory)
    assert past.map.num_landmarks == plain.map.num_landmarks
    assert past.sensor.camera is not None
    alone = PastRun.read(plain.out / "map.odomap")
    assert len(alone.trajectory) == plain.map.num_keyframes
    (tmp_path / "trajectory.tum").write_bytes((plain.out / "trajectory.tum").read_bytes())
    bare = PastRun.read(tmp_path)
    assert len(bare.trajectory) == len(plain.trajectory)
    assert bare.map.num_keyframes == 0


def test_a_past_run_with_loops_has_the_path_before_them(plain, tmp_path, viser):
    map = load_map(plain.out / "map.odomap")
    first, last = map.keyframe_ids[[0, -1]].tolist()
    map.add_edge(first, last, np.eye(4), np.eye(6), "loop")
    for name in ("trajectory.tum", "trajectory_live.tum"):
        (tmp_path / name).write_bytes((plain.out / name).read_bytes())
    save_map(tmp_path / "map.odomap", map, open_source(WORLD).rig)
    past = PastRun.read(tmp_path)
    assert len(past.told) == len(plain.trajectory_live)
    server, _ = open_server(port=8900)
    try:
        scene = LiveScene(server, past.sensor, len(past.trajectory))
        Review(past, scene).go_on()
        assert len(scene._loops.points) == 1
        assert len(scene._told.points) == len(past.told) - 1
        assert "loops" in scene._words.content
        Review(PastRun.read(plain.out), scene).go_on()
        assert len(scene._told.points) == 0
    finally:
        close_server(server)


def test_what_is_no_run_is_refused(tmp_path, capsys):
    for path, what in ((tmp_path / "none", "no such run"), (tmp_path, "neither map.odomap nor")):
        with pytest.raises(InputError, match=what):
            PastRun.read(path)
    (tmp_path / "map.odomap").write_bytes(b"not a map")
    assert main(["view", str(tmp_path)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_pauses_are_found():
    stamps = np.array([0, 10, 20, 120, 130]) * 10**7
    assert pauses(stamps).tolist() == [False, False, True, False, False]
    assert not pauses(stamps[:2]).any()


def test_a_past_run_is_shown_until_ctrl_c(viser, plain, monkeypatch, capsys):
    from odomap import reviewing

    looks = []

    def serve(go_on):
        go_on()
        looks.append(go_on.__self__)
        go_on.__self__._scene._slider.value = 5
        go_on()

    monkeypatch.setattr(reviewing, "serve", serve)
    review(plain.out, port=8800)
    (shown,) = looks
    assert shown._frame == 5
    T = plain.trajectory.Ts_world_body[5] @ shown._past.sensor.T_body_sensor.matrix
    np.testing.assert_allclose(shown._scene.figure.node.position, T[:3, 3], atol=1e-8)
    assert "6 of 12" in shown._scene._words.content
    assert "http://127.0.0.1:88" in capsys.readouterr().err


# ---- in a browser ----


@pytest.mark.skipif(browser() is None, reason="no Chromium found (chromium, google-chrome)")
def test_a_browser_shows_it(view, plain, world):
    """The real page: words in the panel, and path, landmarks, keyframes and camera as pixels."""
    run(world, view=view)
    with Chromium(view.url) as chromium:
        assert until(lambda: "landmarks" in chromium.text, 120), chromium.text
        assert "tracking" in chromium.text
        assert str(plain.map.num_landmarks) in chromium.text

        def colours():
            """Return which of the hues are drawn left of the panel."""
            left = chromium.screenshot()[150:, :800].astype(int)
            red, green, blue = left[..., 0], left[..., 1], left[..., 2]
            return {
                "path": ((blue > red + 40) & (blue > green + 15)).sum() > 20,
                "keyframes": ((red > green + 15) & (green > blue + 25)).sum() > 10,
                "camera": ((green > red + 40) & (green > blue + 15)).sum() > 30,
                "in sight": ((abs(red - green) < 25) & (green > blue + 60)).sum() > 30,
            }

        assert until(lambda: all(colours().values()), 60), colours()


def test_a_view_is_loaded_only_when_asked_for():
    code = "import sys, odomap.run, odomap.cli.parse; print('viser' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
