"""`odomap register` as a person uses it: what it prints and writes, its exit codes, bad input."""

import numpy as np
import pytest

from lidarworlds import CORRIDOR, ROOM
from odomap.cli import main
from odomap.files.clouds import read_ply, write_ply
from odomap.geometry.lie import se3_exp
from odomap.maps.surface import Surface

T = se3_exp(np.array([0.1, -0.05, 0.02, 0.0, 0.01, 0.03]))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.delenv("ODOMAP_DEBUG", raising=False)
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    clouds = {
        "target": ROOM.seen(rng),
        "source": (ROOM.seen(rng) - T[:3, 3]) @ T[:3, :3],
        "corridor": CORRIDOR.seen(rng),
        "corridor2": CORRIDOR.seen(rng),
        "few": np.eye(3),
        "far": ROOM.seen(rng) + 900.0,
    }
    for name, points in clouds.items():
        write_ply(f"{name}.ply", Surface(points.astype(np.float32)))
    return tmp_path


@pytest.fixture
def cli(capsys):
    def call(*words):
        code = main(["register", *map(str, words)])
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        assert "internal error" not in err
        return code, out, err

    return call


def test_it_prints_the_motion_and_writes_the_moved_source(folder, cli):
    code, out, err = cli("source.ply", "target.ply", "--out", "moved.ply")
    assert (code, err) == (0, "")
    rows = [line.replace("T_target_source", "").split() for line in out.splitlines()[:4]]
    np.testing.assert_allclose(np.array(rows, float), T, atol=3e-3)
    assert "converged" in out
    moved = read_ply("moved.ply").points
    expected = read_ply("source.ply").points @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(moved, expected, atol=0.02)


def test_it_says_what_is_not_fixed(folder, cli):
    code, out, _ = cli("corridor.ply", "corridor2.ply", "--method", "plane")
    assert code == 0
    assert "degenerate: the clouds do not fix translation along (1.00" in out


def test_a_first_guess_from_a_file(folder, cli):
    (folder / "T.txt").write_text("\n".join(" ".join(map(str, row)) for row in T))
    assert cli("source.ply", "target.ply", "--initial", "T.txt")[0] == 0
    (folder / "T.txt").write_text("1 2 3\n")
    code, _, err = cli("source.ply", "target.ply", "--initial", "T.txt")
    assert code == 2
    assert "4 rows of 4" in err


def test_without_a_first_guess(folder, cli):
    code, out, _ = cli("far.ply", "target.ply", "--initial", "global")
    assert code == 0
    assert "converged" in out


def test_what_does_not_meet_is_said(folder, cli):
    code, _, err = cli("far.ply", "target.ply")
    assert code == 1
    assert "better first guess" in err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("few.ply", "target.ply"), "has 3 points"),
        (("nothing.ply", "target.ply"), "nothing.ply"),
        (("source.ply", "target.ply", "--voxel", "-1"), "voxel"),
        (("source.ply",), "TARGET"),
        (("source.ply", "target.ply", "--initial", "none.txt"), "none.txt"),
    ],
)
def test_bad_input_is_one_line(folder, cli, words, says):
    code, out, err = cli(*words)
    assert code == 2
    assert says in err
    assert err.count("\n") == 1
    assert not out
