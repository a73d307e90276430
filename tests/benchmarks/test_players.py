"""Players: one system over one recording in its own process, and what is read of it."""

import ast
import json
import sys

import numpy as np
import pytest

from odomap.files.trajectories import write_tum
from odomap.geometry.lie import se3_exp
from odomap.geometry.trajectory import Trajectory
from odomap.simulation.export import export_euroc
from odomap.simulation.world import World


def some_path(count=20):
    Ts = np.array([se3_exp(np.array([0.1 * k, 0, 0.01 * k * k, 0, 0, 0])) for k in range(count)])
    return Trajectory(np.arange(count) * 50_000_000, Ts)


def test_times_count_after_warm_up_and_errors_against_truth(load, tmp_path):
    played = load("played")
    truth = some_path()
    write_tum(tmp_path / "a.tum", truth)
    ms = [1000.0] * played.SKIPPED + [10.0] * 18 + [30.0] * 2
    run = played.Played(20, 20, ms, 1.0, 100.0, 2, 1, tmp_path / "a.tum")
    numbers = run.numbers(truth)
    assert numbers["ms_median"] == 10.0
    assert 10.0 < numbers["ms_p95"] <= 30.0
    assert numbers["ate_m"] < 1e-6


def test_no_path_is_an_infinite_error(load, tmp_path):
    played = load("played")
    (tmp_path / "a.tum").touch()
    run = played.Played(1, 0, [1.0], 1.0, 100.0, 2, 1, tmp_path / "a.tum")
    assert run.numbers(some_path())["ate_m"] == float("inf")


def test_failing_player_ends_the_benchmark_and_stale_results_do_not_count(load, tmp_path):
    played = load("played")
    (tmp_path / "x.json").write_text("{}")
    silent = [sys.executable, "-c", "pass"]
    with pytest.raises(SystemExit, match="ORB-SLAM3 failed"):
        played.play(silent, tmp_path / "x", "ORB-SLAM3")
    loud = [sys.executable, "-c", "raise SystemExit('no such camera')"]
    with pytest.raises(SystemExit, match="no such camera"):
        played.play(loud, tmp_path / "x", "ORB-SLAM3")


def test_peer_is_measured_without_odomap(load, folder, tmp_path):
    """A stand-in for the peer's package and script; both run as the real ones do."""
    (tmp_path / "pyorbslam3.py").write_text(
        "class Slam:\n"
        "    def track_stereo(self, n):\n"
        "        state = 'State.OK' if n % 2 else 'State.LOST'\n"
        "        return type('Result', (), {'state': state})\n"
    )
    script = tmp_path / "script.py"
    script.write_text(
        "import sys, cv2, pyorbslam3\n"
        f"sys.path = [p for p in sys.path if p != {str(tmp_path)!r}]\n"
        "cv2.setNumThreads(1)\n"
        "slam = pyorbslam3.Slam()\n"
        "for n in range(4): slam.track_stereo(n)\n"
        f"open({str(tmp_path / 'x.tum')!r}, 'w').write(sys.argv[1])\n"
        "sys.exit()\n"
    )
    start = (
        f"import sys, runpy; sys.path[:0] = [{str(tmp_path)!r}, {str(folder)!r}]; "
        "del sys.argv[0]; runpy.run_path(sys.argv[0], run_name='__main__')"
    )
    launch = ["peer_launcher.py", f"{tmp_path / 'x'}.json", "0", str(script), "argument"]
    launch[0] = str(folder / launch[0])
    played = load("played").play(
        [sys.executable, "-c", start, *launch], tmp_path / "x", "a stand-in"
    )
    assert (played.frames, played.tracked, played.cv_threads) == (4, 2, 1)
    assert played.lost == 1  # the first one came before it had begun
    assert len(played.ms) == 4
    assert played.path.read_text() == "argument"
    assert played.peak_memory_mb > 1.0
    for name in ("meter.py", "peer_launcher.py"):
        tree = ast.parse((folder / name).read_text(encoding="utf-8"))
        imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
        assert "odomap" not in "".join(map(ast.unparse, imports))


def test_trajectories_of_the_same_bytes_share_a_number(load, tmp_path):
    played = load("played")
    runs = []
    for name, path in (("a", some_path()), ("b", some_path()), ("c", some_path(19))):
        write_tum(tmp_path / f"{name}.tum", path)
        runs.append(played.Played(20, 20, [1.0], 1.0, 1.0, 1, 1, tmp_path / f"{name}.tum"))
    a, b, c = (run.numbers(some_path())["digest"] for run in runs)
    assert a == b != c


def test_what_mapping_cost_the_tracker_is_a_percentile_after_warm_up(load, tmp_path):
    played = load("played")
    write_tum(tmp_path / "a.tum", some_path())
    stalls = [500.0] * played.SKIPPED + [0.0] * 14 + [30.0]
    run = played.Played(20, 20, [1.0], 1.0, 1.0, 1, 1, tmp_path / "a.tum", stall_ms=stalls)
    assert 20.0 < run.numbers(some_path())["stall_p99"] <= 30.0
    plain = played.Played(20, 20, [1.0], 1.0, 1.0, 1, 1, tmp_path / "a.tum")
    assert "stall_p99" not in plain.numbers(some_path())


def test_lost_frames_count_once_the_path_has_begun(load):
    from odomap.maps.estimate import Status

    begin, good, found, bad = Status
    lost = load("ours").lost
    assert lost([begin, begin, good, good]) == 0
    assert lost([begin, good, bad, found, bad, begin, good]) == 3
    assert lost([begin, begin]) == 0


@pytest.mark.parametrize("system", [[], ["--odometry-only"]], ids=["SLAM", "odometry"])
def test_ours_plays_a_recording(load, monkeypatch, tmp_path, system):
    world = World.make(kind="room", seed=1, frames=4, resolution=(320, 200))
    export_euroc(world, tmp_path / "room")
    arguments = [str(tmp_path / "room"), str(tmp_path / "x"), "--frames", "3", "--fast", *system]
    monkeypatch.setattr(sys, "argv", ["ours.py", *arguments])
    load("ours").main()
    content = json.loads((tmp_path / "x.json").read_text())
    played = load("played").Played(**content, path=tmp_path / "x.tum")
    assert (played.frames, played.tracked, len(played.trajectory())) == (3, 3, 3)
    assert played.numbers(world.truth)["ate_m"] < 0.05
