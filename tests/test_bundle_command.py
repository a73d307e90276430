"""`odomap bundle` as a person uses it: what it prints and writes, its exit codes, bad input."""

import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from odomap.cli import main
from odomap.cli.progress import Steps
from odomap.files.bal import read_bal, write_bal
from odomap.files.clouds import read_ply
from odomap.simulation.bundle import BundleWorld, bundle_world

SIGMA_PX = 0.5


@pytest.fixture(autouse=True)
def _quiet_environment(monkeypatch, tmp_path):
    monkeypatch.delenv("ODOMAP_DEBUG", raising=False)
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def world() -> BundleWorld:
    return bundle_world(60, 400, model="bal", sigma_px=SIGMA_PX)


@pytest.fixture
def problem(world) -> str:
    """A problem as a file in the folder; its weights are those of BAL."""
    write_bal("problem.txt", replace(world.problem, weights=1.0))
    return "problem.txt"


@pytest.fixture
def cli(capsys):
    """Run the command line; return exit code, stdout and stderr."""

    def call(*words: object) -> tuple[int, str, str]:
        code = main([*(str(word) for word in words), "--quiet"])
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        assert "internal error" not in err
        return code, out, err

    return call


def lines_of(out: str) -> dict[str, str]:
    return {line[:16].strip(): line[16:].strip() for line in out.splitlines()}


def test_a_problem_is_solved_and_written(cli, problem, world):
    code, out, err = cli("bundle", problem, "--out", "sub/best.txt.gz", "--cloud", "best.ply")
    assert (code, err) == (0, "")
    found = lines_of(out)
    before, best = read_bal(problem), read_bal("sub/best.txt.gz")
    assert found["problem"] == f"60 views, 400 points, {before.num_observations} observations"
    assert ": converged" in found["iterations"]
    assert not {"left out", "blind", "unseen", "parts"} & set(found)
    # the residual is the noise, less what the unknowns take up
    unknowns = 60 * 9 + 400 * 3 - 7
    expected = SIGMA_PX * np.sqrt(2 - unknowns / before.num_observations)
    assert float(found["residual"].split()[0]) == pytest.approx(expected, rel=0.05)
    np.testing.assert_array_equal(best.pixels, before.pixels)
    np.testing.assert_array_equal(best.view, before.view)
    assert not np.array_equal(best.intrinsics, before.intrinsics)
    cloud = read_ply("best.ply")
    assert len(cloud.points) == 460
    np.testing.assert_allclose(cloud.points[:400], best.points_world, rtol=1e-6, atol=1e-5)
    assert len(np.unique(cloud.colours, axis=0)) == 2
    again = lines_of(cli("bundle", "sub/best.txt.gz")[1])
    start, end = (float(word) for word in again["cost"].split(" → "))
    assert start == pytest.approx(end, rel=1e-6)


def test_what_is_held_stays(cli, problem):
    before = read_bal(problem)
    cli("bundle", problem, "--fix-intrinsics", "--fix-points", "--out", "a.txt")
    assert np.array_equal(read_bal("a.txt").intrinsics, before.intrinsics)
    assert np.array_equal(read_bal("a.txt").points_world, before.points_world)
    assert not np.array_equal(read_bal("a.txt").Ts_camera_world, before.Ts_camera_world)
    cli("bundle", problem, "--fix-intrinsics", "--fix-cameras", "--out", "b.txt")
    assert np.array_equal(read_bal("b.txt").Ts_camera_world, before.Ts_camera_world)
    assert not np.array_equal(read_bal("b.txt").points_world, before.points_world)


def test_gross_errors_are_left_out_or_made_light_of(cli, problem, world):
    wrong = world.problem.pixels.copy()
    wrong[::50] += 40.0
    count = len(wrong[::50])
    write_bal(problem, replace(world.problem, weights=1.0, pixels=wrong))
    plain = lines_of(cli("bundle", problem)[1])["residual"]
    words = ["--loss", "cauchy", "--width", "1"]
    found = lines_of(cli("bundle", problem, "--gate", "6", *words)[1])
    assert found["left out"] == f"{count} observations beyond the gate"
    assert float(found["residual"].split()[0]) < 0.3 * float(plain.split()[0])
    light = lines_of(cli("bundle", problem, *words)[1])["residual"]
    assert float(light.split()[3]) < float(plain.split()[3])


def test_nothing_in_sight_is_no_success(cli, problem):
    given = read_bal(problem)
    # a lens of BAL sees before and behind itself, but not in its own plane
    flat = given.points_world * [1.0, 1.0, 0.0]
    together = np.tile(np.eye(4), (given.num_views, 1, 1))
    write_bal("blind.txt", replace(given, points_world=flat, Ts_camera_world=together))
    code, out, err = cli("bundle", "blind.txt")
    assert code == 1
    assert err == "odomap: not converged: nothing is in sight\n"
    assert "nan" not in out
    assert lines_of(out)["residual"] == "none: nothing that is used is in sight"


def test_gross_errors_alone_are_no_reason_to_give_up(cli, problem, world):
    wrong = world.problem.pixels.copy()
    wrong[::50] += 200.0
    write_bal(problem, replace(world.problem, weights=1.0, pixels=wrong))
    code, out, _ = cli("bundle", problem, "--gate", "2.5")
    assert code == 0
    count, what = lines_of(out)["left out"].split(" ", 1)
    assert what == "observations beyond the gate"
    assert len(wrong[::50]) <= int(count) <= len(wrong[::50]) + 3
    code, _, err = cli("bundle", problem, "--gate", "0.001", "--out", "best.txt")
    assert code == 1
    assert err.startswith("odomap: not converged: too few are within the gate: ")
    assert np.isfinite(read_bal("best.txt").points_world).all()


def test_ctrl_c_keeps_the_best_so_far(cli, problem, monkeypatch):
    def interrupting(self: Steps, done: int, total: int, text: str) -> None:
        if done == 1 and text.startswith("cost"):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Steps, "show", interrupting)
    code, out, err = cli("bundle", problem, "--out", "best.txt")
    assert code == 130
    assert err == "odomap: interrupted: this is the best so far\n"
    assert lines_of(out)["iterations"].startswith("1: stopped on request")
    assert np.isfinite(read_bal("best.txt").points_world).all()


def test_one_that_does_not_converge_is_written_all_the_same(cli, problem):
    code, _, err = cli("bundle", problem, "--max-iterations", "1", "--out", "best.txt")
    assert code == 1
    assert err == "odomap: not converged: 1 iterations were spent\n"
    assert Path("best.txt").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["none.txt"], "none.txt: No such file"),
        (["cut.txt"], "is it cut off?"),
        (["problem.txt", "--width", "2"], "--width says where a loss sets in: give --loss, too"),
        (["problem.txt", "--gate", "-1"], "gate"),
        (["problem.txt", "--out", "problem.txt"], "problem.txt: is the input itself"),
        (
            ["problem.txt", "--fix-cameras", "--fix-points", "--fix-intrinsics"],
            "problem.txt: ",
        ),
        (["problem.txt", "--out", "a.txt", "--cloud", "b/../a.txt"], "b/../a.txt: two results"),
        (["problem.txt", "--out", "folder"], "folder: cannot be written: a folder of that name"),
        (["problem.txt", "--cloud", "pipe"], "pipe: cannot be written: it is a device, a pipe"),
        (["problem.txt", "--fix-intrinsic"], "(did you mean '--fix-intrinsics'?)"),
    ],
)
def test_bad_input_is_one_line(cli, problem, words, message):
    os.mkfifo("pipe")
    Path("folder").mkdir()
    Path("cut.txt").write_text(Path(problem).read_text()[:-400])
    code, out, err = cli("bundle", *words)
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert message in err
