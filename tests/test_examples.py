"""The examples and the README's code run as they are printed, and print what the lesson says."""

import re
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from printed import assert_same_output

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("[0-9]*.py"))


def main_of(name: str) -> Callable[..., Any]:
    return runpy.run_path(str(ROOT / "examples" / name))["main"]


def shown_output(name: str) -> list[str]:
    """Return what the lesson prints under `$ python examples/NAME`."""
    found = []
    for chapter in sorted((ROOT / "docs" / "lesson").glob("*.md")):
        for block in chapter.read_text().split("```")[1::2]:
            lines = block.splitlines()
            if lines[0] == "console" and lines[1] == f"$ python examples/{name}":
                found.append(lines[2:])
    assert len(found) == 1, f"the lesson shows the output of {name} {len(found)} times"
    return found[0]


def test_there_are_examples():
    assert len(EXAMPLES) >= 11


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short(path):
    assert len(path.read_text().splitlines()) < 60


def test_first_run(tmp_path):
    picture = tmp_path / "path.png"
    assert main_of("01_first_run.py")(str(picture), "sim:room?seed=3&frames=10") < 0.02
    assert picture.read_bytes().startswith(b"\x89PNG")


def run_as_shown(name: str, capsys: pytest.CaptureFixture[str]) -> Any:
    results = main_of(name)()
    assert_same_output(capsys.readouterr().out, shown_output(name))
    return results


def test_two_views(capsys):
    results = run_as_shown("02_two_views.py", capsys)
    assert results["turn_deg"] < 0.2
    assert results["aim_deg"] < 1.0


def test_points_and_pnp(capsys):
    results = run_as_shown("03_points_and_pnp.py", capsys)
    assert 0.9 < results["depth_ratio"] < 1.1
    assert 0.7 < results["nees"] < 1.4


def test_scale_and_window(capsys):
    results = run_as_shown("04_scale_and_window.py", capsys)
    assert results["spread"] < 0.2
    assert results["after_mm"] < 3.0


def test_stereo_depth(capsys):
    results = run_as_shown("05_stereo_depth.py", capsys)
    assert results["sigma_d_px"] < 0.2
    assert 0.6 < results["far_ratio"] < 1.5


def test_pitfalls_of_paths(capsys):
    results = run_as_shown("06_pitfalls_path.py", capsys)
    assert results["T_world_prev @ T_cur_prev.inverse()"] < 1e-6
    assert results["T_world_prev @ T_cur_prev"] > 1.0
    assert results["the same, each step 1 long"] > 3.0


def test_pitfalls_of_the_mask(capsys):
    results = run_as_shown("07_pitfalls_mask.py", capsys)
    assert results["with the mask"] < 0.05
    assert results["without the mask"] > 0.2


def test_pitfalls_of_depth(capsys):
    results = run_as_shown("08_pitfalls_depth.py", capsys)
    assert results["1/z, on one surface"] < 0.7 * results["depth[int(v), int(u)]"]


def test_pitfalls_of_tracks(capsys):
    results = run_as_shown("09_pitfalls_tracks.py", capsys)
    length, doubles, cover = results["look elsewhere"]
    assert length > 2.5 * results["start anew"][0]
    assert doubles < 2 < 50 < results["add anywhere"][1]
    assert cover > results["add anywhere"][2]


def test_every_camera(capsys):
    results = run_as_shown("10_every_camera.py", capsys)
    assert max(results.values()) < 0.5


def test_own_camera(capsys):
    results = run_as_shown("11_own_camera.py", capsys)
    assert abs(results["focal"] / 400.0 - 1.0) < 0.002
    assert results["percent"] < 0.5


def test_solution_of_exercise_1(tmp_path):
    picture = tmp_path / "path.png"
    percent = main_of("exercise_1_solution.py")(
        "sim:room?seed=4&frames=60&sensors=mono&resolution=400x250", str(picture)
    )
    assert percent < 1.0
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_solution_of_exercise_2(tmp_path):
    picture = tmp_path / "places.png"
    recording = "sim:room?seed=4&frames=74&sensors=mono&speed=8&resolution=480x300"
    training = "sim:room?seed=11&frames=20&sensors=mono&speed=16&resolution=480x300"
    recalls = main_of("exercise_2_solution.py")(recording, training, str(picture))
    assert recalls["10^2"] < 0.5 < recalls["10^4"]
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_solution_of_exercise_3(tmp_path):
    picture = tmp_path / "odometry.png"
    recording = "sim:hall?sensors=laser&seed=4&rate_hz=4&beams=271&frames=70"
    errors = main_of("exercise_3_solution.py")(recording, str(picture))
    for step in ("points", "lines"):
        assert 2.0 * errors[f"map, {step}"] < errors[f"last scan, {step}"]
        assert 2.0 * errors["map, lines"] < errors["map, points"] < 0.05
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_solution_of_exercise_4(tmp_path):
    recording = "sim:hall?sensors=laser&seed=4&rate_hz=1&beams=241&range_m=8&moving_objects=3"
    found = main_of("exercise_4_solution.py")(
        recording, str(tmp_path / "grid.yaml"), str(tmp_path / "grid.png")
    )
    assert found["same"] == 1.0
    assert min(found["true"], found["found"]) > 0.95
    assert found["free_false"] < 0.005
    assert (tmp_path / "grid.png").read_bytes().startswith(b"\x89PNG")


def test_solution_of_exercise_5(tmp_path):
    picture = tmp_path / "loop.png"
    recording = "sim:room?seed=4&frames=52&sensors=mono,depth&speed=6&resolution=400x250"
    errors = main_of("exercise_5_solution.py")(recording, str(picture))
    assert errors["loops"] < 0.5 * errors["odometry"]
    assert errors["and a false one"] > 10 * errors["odometry"]
    assert errors["the same, GNC"] < 0.5 * errors["odometry"]
    assert picture.read_bytes().startswith(b"\x89PNG")


def readme_block(language: str, containing: str) -> str:
    blocks = (ROOT / "README.md").read_text().split("```")[1::2]
    found = [b for b in blocks if b.startswith(language) and containing in b]
    assert len(found) == 1
    return found[0].removeprefix(language)


def test_readme_code_runs(tmp_path):
    code = readme_block("python", "import odomap").replace("frames=60", "frames=8")
    lines = [line for line in code.splitlines() if line.strip()]
    assert len(lines) == 5
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True, timeout=300)
    assert len((tmp_path / "poses.tum").read_text().splitlines()) == 9


def test_readme_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)#]+)\)", (ROOT / "README.md").read_text()):
        if "://" not in target:
            assert (ROOT / target).exists(), target
