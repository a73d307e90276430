"""The command line as a person uses it: help at once, one line per error, the right exit code."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from odomap.cli import main
from odomap.cli.demo import has_desktop
from odomap.files.trajectories import read_tum

FRAMES = 14


@pytest.fixture(autouse=True)
def _quiet_environment(monkeypatch, tmp_path):
    monkeypatch.delenv("ODOMAP_DEBUG", raising=False)
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="session")
def recording(tmp_path_factory) -> Path:
    """A simulated room as a EuRoC folder."""
    from odomap.simulation.export import export_euroc
    from odomap.simulation.world import World

    folder = tmp_path_factory.mktemp("euroc") / "room"
    world = World.make(kind="room", seed=3, frames=FRAMES, resolution=(400, 250))
    export_euroc(world, folder)
    return folder


@pytest.fixture
def euroc(recording, tmp_path) -> Path:
    """A copy of the recording to break."""
    return Path(shutil.copytree(recording, tmp_path / "room"))


@pytest.fixture
def cli(capsys):
    """Run the command line; return exit code, stdout and stderr."""

    def call(*words: object) -> tuple[int, str, str]:
        code = main([str(word) for word in words])
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        return code, out, err

    return call


@pytest.fixture
def refused(cli):
    """Run the command line and expect bad input: exit code 2 and one line, which is returned."""

    def call(*words: object, code: int = 2) -> str:
        found, _, err = cli(*words)
        lines = [line for line in err.splitlines() if not line.startswith("odomap: warning:")]
        assert found == code, err
        assert len(lines) == 1, err
        assert lines[0].startswith("odomap: ")
        assert "internal error" not in lines[0]
        return lines[0]

    return call


def metrics(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def rows(folder: Path, camera: str) -> list[list[str]]:
    lines = (folder / "mav0" / camera / "data.csv").read_text().splitlines()
    return [line.split(",") for line in lines if line and not line.startswith("#")]


def rewrite(folder: Path, camera: str, table: list[list[str]]) -> None:
    text = "#timestamp [ns],filename\n" + "".join(",".join(row) + "\n" for row in table)
    (folder / "mav0" / camera / "data.csv").write_text(text)


def images(folder: Path, camera: str) -> list[Path]:
    return sorted((folder / "mav0" / camera / "data").iterdir())


# ---- parsing ----


def test_help_answers_at_once_and_loads_nothing_heavy():
    code = (
        "import sys, odomap.cli\ntry:\n    odomap.cli.main(['--help'])\nfinally:\n"
        "    print('MODULES', *sys.modules)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "run" in result.stdout
    assert "doctor" in result.stdout
    modules = {name.split(".")[0] for name in result.stdout.split("MODULES")[1].split()}
    assert not modules & {"numpy", "numba", "cv2", "scipy", "matplotlib"}


@pytest.mark.parametrize(
    "verb",
    [
        "run",
        "demo",
        "calibrate",
        "eval",
        "optimize",
        "bundle",
        "export",
        "loops",
        "info",
        "config",
        "doctor",
    ],
)
def test_every_verb_has_help(cli, verb):
    code, out, _ = cli(verb, "--help")
    assert code == 0
    assert f"usage: odomap {verb}" in out


def test_version(cli):
    code, out, _ = cli("--version")
    assert code == 0
    assert re.fullmatch(r"odomap \d+\.\d+\.\d+\S*\n", out)


def test_no_words_prints_help_and_fails(cli):
    code, out, _ = cli()
    assert code == 2
    assert "usage: odomap" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["rnu", "x"], "unknown command 'rnu' (did you mean 'run'?)"),
        (
            ["frobnicate"],
            "one of run, localize, continue, merge, demo, calibrate, eval, optimize, bundle, "
            "register, export, vocabulary, loops, info, view, config, doctor expected",
        ),
        (["run"], "DATA is missing"),
        (["run", "x", "--prest", "y"], "unknown option '--prest' (did you mean '--preset'?)"),
        (["run", "x", "y"], "unexpected argument 'y'"),
        (["run", "x", "--max-frames", "many"], "INT expected, got 'many'"),
        (["run", "x", "--tracking.min_inliers"], "needs a value"),
        (["run", "x", "--tracking.min-inlier", "3"], "(did you mean 'min_inliers'?)"),
        (["run", "x", "--trackin.min_inliers", "3"], "(did you mean 'tracking'?)"),
        (["run", "x", "--rhythm", "fast"], "invalid choice 'fast'"),
        (["run", "x", "--preset", "stero"], "preset 'stero' is unknown (did you mean 'stereo'?)"),
        (["run", "x", "--config", "none.yaml"], "none.yaml: cannot be read"),
        (["config", "--candidates.views", "0"], "candidates.views: 0 must be above 0"),
        (["run", "sim:room?frames=3", "--max-frames", "0"], "max_frames is 0"),
        (["info", "x", "--tracking.min_inliers", "3"], "unknown option"),
        (["eval", "a"], "REFERENCE is missing"),
    ],
)
def test_what_cannot_be_parsed_is_one_line(refused, words, message):
    assert message in refused(*words)


def test_bug_is_one_line_too_and_debug_shows_where(cli, monkeypatch, capsys):
    def fail(*_):
        raise ZeroDivisionError("a\nb")

    monkeypatch.setattr("odomap.sources.open.open", fail)
    code, _, err = cli("info", "x")
    assert code == 1
    assert err.count("\n") == 1
    assert "internal error: ZeroDivisionError: a b" in err
    monkeypatch.setenv("ODOMAP_DEBUG", "1")
    assert main(["info", "x"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_a_reader_that_leaves_is_no_error():
    code = "import sys; from odomap.cli import main; sys.exit(main(['config']))"
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    process.stdout.close()
    with process.stderr as complaints:
        assert complaints.read() == b""
    assert process.wait(60) == 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_stdout_on_a_full_disk_is_one_line():
    code = "import sys; from odomap.cli import main; sys.exit(main(['config']))"
    with open("/dev/full", "w") as full:
        result = subprocess.run(
            [sys.executable, "-c", code], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert result.returncode == 1
    assert result.stderr.startswith("odomap: No space left on device\n")
    assert "Traceback" not in result.stderr


def test_progress_is_plain_lines_in_a_pipe(capsys, monkeypatch):
    from odomap.cli import progress

    monkeypatch.setattr(progress, "LINE_EVERY_S", 0.0)
    with progress.Steps("compiling") as steps:
        steps.show(1, 3, "odomap.a")
    with progress.Steps("compiling", quiet=True) as steps:
        steps.show(2, 3, "odomap.b")
    out, err = capsys.readouterr()
    assert out == ""
    assert err == "compiling 1/3  odomap.a\n"


def test_progress_of_a_run_says_rate_and_status(capsys, monkeypatch):
    from odomap.cli import progress
    from odomap.geometry.pose import SE3
    from odomap.maps.estimate import Estimate, Status
    from odomap.run import Progress

    monkeypatch.setattr(progress, "LINE_EVERY_S", 0.0)
    pose = SE3.identity()
    lost = Estimate(7, 0, Status.LOST, "too dark", 0, pose, pose, np.eye(6), 3)
    with progress.TrackingProgress() as shown:
        shown.show(Progress("tracking", 8, 20, lost, 31.26))
    line = capsys.readouterr().err
    assert line == "tracking 8/20   31.3 fps  lost  3 inliers  too dark\n"


# ---- config ----


def test_config_prints_what_config_reads(cli, tmp_path):
    code, text, _ = cli("config", "--tracking.min_inliers", "21")
    assert code == 0
    assert "# Observations that must agree" in text
    (tmp_path / "c.yaml").write_text(text)
    code, again, _ = cli("config", "--config", "c.yaml")
    assert code == 0
    assert again == text
    assert "min_inliers: 21" in text


def test_config_names_the_nearest_field(refused, tmp_path):
    (tmp_path / "c.yaml").write_text("tracking:\n  min_inlers: 4\n")
    line = refused("run", "x", "--config", "c.yaml")
    assert "c.yaml: unknown field 'tracking.min_inlers' (did you mean 'min_inliers'?)" in line


def test_config_lists_presets(cli):
    code, out, _ = cli("config", "--list")
    assert code == 0
    assert "stereo" in out.split()


# ---- run: a whole recording ----


def test_run_writes_everything_and_says_where(cli, recording, tmp_path):
    code, out, err = cli("run", recording, "--out", tmp_path / "a")
    assert code == 0, err
    names = {path.name for path in (tmp_path / "a").iterdir()}
    paths = {"trajectory.tum", "trajectory_live.tum", "keyframes.tum"}
    others = {"map.odomap", "config.yaml", "metrics.json", "loops.json", "report.html"}
    assert names == paths | others
    assert "ATE RMSE" in out
    assert str(tmp_path / "a" / "report.html") in out
    m = metrics(tmp_path / "a")
    assert (m["frames"], m["tracked"], m["lost"], m["skipped"]) == (FRAMES, FRAMES, 0, 0)
    assert m["ate_rmse_m"] < 0.02
    assert m["failure"] == ""
    assert m["interrupted"] is False
    for key in ("ms_per_frame", "real_time_factor", "keyframes", "landmarks", "loops"):
        assert key in m
    assert 0 < m["ms_per_frame"]["median"] <= m["ms_per_frame"]["p95"]
    assert m["peak_memory_mb"] > 20
    assert len(read_tum(tmp_path / "a" / "trajectory.tum")) == FRAMES

    # The config it wrote repeats the run, byte for byte.
    again = cli("run", recording, "--config", tmp_path / "a" / "config.yaml", "--out", "b")
    assert again[0] == 0
    for name in ("trajectory.tum", "trajectory_live.tum"):
        assert (tmp_path / "b" / name).read_bytes() == (tmp_path / "a" / name).read_bytes()


def test_run_of_a_single_camera_says_that_its_scale_is_its_own(cli, tmp_path):
    world = "sim:room?seed=3&frames=20&rate_hz=12&resolution=400x250&sensors=mono"
    code, out, err = cli("run", world, "--out", "a")
    assert code == 0, err
    assert "ATE RMSE" in out
    assert "one camera cannot tell the scale" in out + err
    m = metrics(tmp_path / "a")
    assert m["is_metric"] is False
    assert len(read_tum(tmp_path / "a" / "keyframes.tum")) == m["keyframes"]
    config = (tmp_path / "a" / "config.yaml").read_text()
    assert "sensors: mono" in config
    # A pair is asked for: there is none.
    code, _, err = cli("run", world, "--preset", "stereo")
    assert code == 2
    assert "stereo needs two cameras" in err


@pytest.mark.usefixtures("no_report")
def test_run_without_out_writes_below_runs(cli, recording, tmp_path):
    code, _, _ = cli("run", recording, "--max-frames", "3")
    assert code == 0
    assert (tmp_path / "runs" / "room" / "trajectory.tum").exists()
    assert metrics(tmp_path / "runs" / "room")["frames"] == 3


@pytest.mark.usefixtures("no_report")
def test_info_and_eval_of_a_run(cli, recording, tmp_path):
    code, out, _ = cli("info", recording, "--check")
    assert code == 0
    assert f"readable       {FRAMES}" in out
    assert "baseline" in out
    code, out, _ = cli("info", recording, "--json")
    assert json.loads(out)["frames"] == FRAMES
    cli("run", recording, "--out", "a")
    code, out, err = cli("eval", "a/trajectory.tum", recording, "--out", "e", "--json")
    assert code == 0, err
    rmse = json.loads(out)["estimates"]["trajectory.tum"]["ATE"]["rmse_m"]
    assert rmse == pytest.approx(metrics(tmp_path / "a")["ate_rmse_m"], abs=1e-6)
    assert {"eval.json", "path.png", "error.png"} <= {p.name for p in (tmp_path / "e").iterdir()}


@pytest.mark.usefixtures("no_report")
def test_a_path_without_scale_is_told_how_to_be_judged(cli, recording, tmp_path):
    cli("run", recording, "--out", "a")
    lines = (tmp_path / "a" / "trajectory.tum").read_text().splitlines()[1:]
    rows = [line.split() for line in lines]
    small = [[row[0], *(str(float(v) / 5) for v in row[1:4]), *row[4:]] for row in rows]
    Path("small.tum").write_text("".join(" ".join(row) + "\n" for row in small))
    code, _, err = cli("eval", "small.tum", recording)
    assert code == 0
    assert re.search(r"the reference is (4\.9|5)\S* times as large as the path.*--align sim3", err)
    code, _, err = cli("eval", "small.tum", recording, "--align", "sim3", "--out", "e")
    assert code == 0
    assert "give --align" not in err
    assert "give --align" not in cli("eval", "a/trajectory.tum", recording)[2]


# ---- bad input: what is there ----


def test_missing_folder(refused):
    assert "does not exist" in refused("run", "no/such/folder")


def test_empty_folder(refused, tmp_path):
    (tmp_path / "empty").mkdir()
    assert "empty" in refused("run", tmp_path / "empty")


def test_truncated_image_is_skipped_counted_and_reported(cli, euroc):
    broken = images(euroc, "cam0")[6]
    broken.write_bytes(broken.read_bytes()[:900])
    code, out, err = cli("run", euroc, "--out", "o")
    assert code == 0, err
    assert "1 skipped" in out
    assert broken.name in err
    m = metrics(Path("o"))
    assert m["frames"] == FRAMES - 1
    assert m["skipped"] == 1
    assert m["skipped_measurements"][0]["file"].endswith(broken.name)
    assert broken.name in Path("o/report.html").read_text()


def test_every_image_unreadable(refused, euroc):
    for camera in ("cam0", "cam1"):
        for image in images(euroc, camera):
            image.write_bytes(b"no image")
    assert "cam0" in refused("run", euroc)


def test_left_and_right_of_different_size(refused, euroc):
    import cv2

    for image in images(euroc, "cam1"):
        pixels = cv2.imread(str(image), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(image), pixels[: pixels.shape[0] // 2])
    line = refused("run", euroc)
    assert "cam1" in line


def test_left_and_right_swapped(refused, euroc):
    mav = euroc / "mav0"
    (mav / "cam0" / "data").rename(mav / "data")
    (mav / "cam1" / "data").rename(mav / "cam0" / "data")
    (mav / "data").rename(mav / "cam1" / "data")
    assert "swapped" in refused("run", euroc)


def test_right_camera_missing(refused, euroc):
    shutil.rmtree(euroc / "mav0" / "cam1")
    assert "stereo" in refused("run", euroc, "--preset", "stereo")


# ---- bad input: calibration ----


def test_calibration_with_a_missing_field(refused, euroc):
    path = euroc / "mav0" / "cam0" / "sensor.yaml"
    text = "\n".join(line for line in path.read_text().splitlines() if "intrinsics" not in line)
    path.write_text(text)
    line = refused("run", euroc)
    assert "cam0/sensor.yaml" in line
    assert "intrinsics" in line


def test_calibration_with_a_typo_names_the_nearest(refused, euroc):
    edit(euroc / "mav0" / "cam0" / "sensor.yaml", "intrinsics", "intrinsic")
    line = refused("run", euroc)
    assert "'intrinsics'" in line
    assert "'intrinsic'" in line


def test_calibration_for_another_resolution(refused, euroc):
    path = euroc / "mav0" / "cam0" / "sensor.yaml"
    path.write_text(
        re.sub(r"resolution: \[\d+, *\d+\]", "resolution: [1280, 1024]", path.read_text())
    )
    assert "1280" in refused("run", euroc)


def test_baseline_in_millimetres(refused, euroc):
    import yaml

    path = euroc / "mav0" / "cam1" / "sensor.yaml"
    content = yaml.safe_load(path.read_text())
    for k in (3, 7, 11):
        content["T_BS"]["data"][k] *= 1000.0
    path.write_text(yaml.safe_dump(content))
    line = refused("run", euroc)
    assert "baseline" in line
    assert "millimet" in line


# ---- bad input: stamps ----


@pytest.mark.usefixtures("no_report")
def test_stamps_out_of_order_and_repeated_are_mended_and_said(cli, euroc):
    table = rows(euroc, "cam0")
    table[4], table[7] = table[7], table[4]
    rewrite(euroc, "cam0", [*table, table[2]])
    code, _, err = cli("run", euroc, "--out", "o")
    assert code == 0, err
    assert "warning" in err
    assert metrics(Path("o"))["tracked"] == FRAMES


@pytest.mark.usefixtures("no_report")
def test_stamp_that_is_no_number(cli, euroc):
    table = rows(euroc, "cam0")
    table[5][0] = "NaN"
    rewrite(euroc, "cam0", table)
    code, _, err = cli("run", euroc, "--out", "o")
    assert code == 0, err
    assert metrics(Path("o"))["frames"] == FRAMES - 1
    assert metrics(Path("o"))["skipped"] >= 1


@pytest.mark.usefixtures("no_report")
@pytest.mark.parametrize(("per_second", "unit"), [(1, "s"), (1000, "ms")])
def test_stamps_in_another_unit_are_recognised(cli, euroc, per_second, unit):
    start = 1_403_636_579_000_000_000
    for camera in ("cam0", "cam1"):
        table = rows(euroc, camera)
        first = int(table[0][0])
        for row in table:
            ns = start + int(row[0]) - first
            row[0] = f"{ns * per_second / 1e9:.6f}"
        rewrite(euroc, camera, table)
    code, _, err = cli("run", euroc, "--out", "o")
    assert code == 0, err
    seconds = metrics(Path("o"))["duration_s"]
    assert 0.1 < seconds < 60
    assert re.search(rf"\b{unit}\b|second", err)


@pytest.mark.usefixtures("no_report")
def test_gap_of_two_seconds_is_said(cli, euroc):
    for camera in ("cam0", "cam1"):
        table = rows(euroc, camera)
        for row in table[8:]:
            row[0] = str(int(row[0]) + 2_000_000_000)
        rewrite(euroc, camera, table)
    code, _, err = cli("run", euroc, "--out", "o")
    assert code == 0, err
    assert re.search(r"a gap of 2\.\d+ s after frame 7", err)


# ---- bad input: pixels ----


@pytest.mark.usefixtures("no_report")
@pytest.mark.parametrize("kind", ["16-bit", "colour"])
def test_images_of_another_kind_are_taken(cli, euroc, kind):
    import cv2

    for camera in ("cam0", "cam1"):
        for image in images(euroc, camera):
            pixels = cv2.imread(str(image), cv2.IMREAD_GRAYSCALE)
            deep = pixels.astype(np.uint16) * 257
            cv2.imwrite(str(image), deep if kind == "16-bit" else np.dstack([pixels] * 3))
    code, _, err = cli("run", euroc, "--out", "o")
    assert code == 0, err
    assert metrics(Path("o"))["tracked"] == FRAMES


# ---- bad input: ground truth ----


def truth_file(folder: Path) -> Path:
    return folder / "mav0" / "state_groundtruth_estimate0" / "data.csv"


def test_ground_truth_that_is_garbage(cli, euroc):
    truth_file(euroc).write_text("garbage, everywhere\nthe dog ate it\n")
    code, _, err = cli("run", euroc, "--out", "o")
    assert "truth" in err
    assert code in (0, 2)
    if code == 0:
        assert metrics(Path("o"))["ate_rmse_m"] is None


@pytest.mark.usefixtures("no_report")
def test_ground_truth_of_another_time(cli, euroc):
    path = truth_file(euroc)
    lines = path.read_text().splitlines()
    moved = [
        line if line.startswith("#") else re.sub(r"^\d+", lambda m: str(int(m[0]) + 10**13), line)
        for line in lines
    ]
    path.write_text("\n".join(moved) + "\n")
    code, _, err = cli("run", euroc, "--out", "o")
    assert code == 0, err
    assert "overlap" in err
    assert metrics(Path("o"))["ate_rmse_m"] is None


def test_ground_truth_for_eval_that_does_not_overlap(refused, tmp_path):
    line = "{} 0 0 0 0 0 0 1\n"
    Path("a.tum").write_text("".join(line.format(k) for k in range(5)))
    Path("b.tum").write_text("".join(line.format(k + 900) for k in range(5)))
    assert "overlap" in refused("eval", "a.tum", "b.tum")


@pytest.mark.parametrize("text", ["", "1 2 3\n", "1 0 0 0 0 0 0 x\n", "nan 0 0 0 0 0 0 1\n"])
def test_broken_trajectories_for_eval(refused, text):
    Path("a.tum").write_text(text)
    assert "a.tum" in refused("eval", "a.tum", "a.tum")


# ---- outputs that cannot be ----


@pytest.mark.parametrize("out", ["file", "file/below", "/proc/odomap"])
def test_unwritable_output_is_told_before_tracking(refused, recording, monkeypatch, out):
    Path("file").write_text("in the way")

    def fail(*_):
        raise AssertionError("tracking must not begin")

    monkeypatch.setattr("odomap.run._track", fail)
    assert f"{out.split('/below')[0]}" in refused("run", recording, "--out", out, code=1)


@pytest.mark.usefixtures("no_report")
def test_full_disk_saves_what_fits_and_says_so(refused, recording, monkeypatch):
    # The disk fills up once the paths are written: everything later is refused by the system.
    import errno

    real, left = os.fsync, [2]

    def fsync(number):
        if left[0] <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        left[0] -= 1
        real(number)

    monkeypatch.setattr(os, "fsync", fsync)
    line = refused("run", recording, "--max-frames", "4", "--out", "o", code=1)
    assert "disk is full" in line
    assert "written: trajectory.tum, trajectory_live.tum" in line
    assert len(read_tum("o/trajectory.tum")) == 4
    left_over = {p.name for p in Path("o").iterdir()}
    assert left_over == {"trajectory.tum", "trajectory_live.tum"}


# ---- lost, interrupted ----


def test_lost_tracking_is_said_and_fails(cli, euroc):
    import cv2

    for camera in ("cam0", "cam1"):
        for image in images(euroc, camera)[3:]:
            pixels = cv2.imread(str(image), cv2.IMREAD_GRAYSCALE)
            cv2.imwrite(str(image), np.zeros_like(pixels))
    code, _, err = cli("run", euroc, "--out", "o")
    assert code == 1
    assert "lost" in err
    m = metrics(Path("o"))
    assert m["lost"] == FRAMES - 3
    assert m["failure"]
    assert len(read_tum("o/trajectory.tum")) == 3
    assert Path("o/report.html").exists()


@pytest.mark.skipif(os.name == "nt", reason="signals differ")
def test_ctrl_c_writes_what_was_tracked(tmp_path):
    world = "sim:room?seed=3&frames=2000&resolution=400x250"
    command = [sys.executable, "-m", "odomap", "run", world, "--out", "o"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    part = tmp_path / "o" / "trajectory_live.tum.part"
    deadline = time.monotonic() + 300
    while not (part.exists() and part.stat().st_size > 0):
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert "interrupted after" in err
    assert "Traceback" not in err
    m = metrics(tmp_path / "o")
    assert m["interrupted"] is True
    assert 0 < m["frames"] < 2000
    assert len(read_tum(tmp_path / "o" / "trajectory.tum")) == m["tracked"]
    assert (tmp_path / "o" / "report.html").exists()


# ---- demo, doctor ----


def test_demo_tracks_a_world_and_writes_its_report(cli, tmp_path):
    code, out, err = cli("demo", "--frames", "6", "--no-open")
    assert code == 0, err
    assert (tmp_path / "runs" / "demo" / "report.html").exists()
    assert "ATE RMSE" in out


def test_desktop_is_told_from_a_server(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    assert has_desktop({"DISPLAY": ":0"})
    assert has_desktop({"WAYLAND_DISPLAY": "wayland-0"})
    assert not has_desktop({})
    assert not has_desktop({"DISPLAY": ":0", "SSH_CONNECTION": "1 2 3 4"})
    assert not has_desktop({"DISPLAY": ":0", "CI": "true"})
    monkeypatch.setattr(sys, "platform", "darwin")
    assert has_desktop({})


def test_doctor_without_kernels(cli, monkeypatch):
    from odomap import doctor

    real = doctor.installed
    monkeypatch.setattr(doctor, "installed", lambda name: "" if name == "rosbags" else real(name))
    code, out, _ = cli("doctor", "--no-kernels")
    assert code == 0
    assert "numba" in out
    assert "pip install 'odomap[ros]'" in out


def test_doctor_fails_on_a_second_opencv(cli, monkeypatch):
    from odomap import doctor

    real = doctor.installed
    monkeypatch.setattr(
        doctor, "installed", lambda name: "4.9" if name == "opencv-python" else real(name)
    )
    code, out, err = cli("doctor", "--no-kernels")
    assert code == 1
    assert "pip uninstall -y opencv-python" in out
    assert "broken: opencv" in err
