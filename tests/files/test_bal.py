"""Bundle adjustment problems survive the way through BAL text, and broken text is named."""

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from odomap.backend.adjustment.problem import Adjustment
from odomap.errors import InputError
from odomap.files.bal import read_bal, write_bal
from odomap.geometry.lie import se3_exp, so3_exp

SMALL = """2 1 2
0 0  -10.5 20.25
1 0   3e1  -4
0.1
0.2
0.3
1
2
3
500
-1e-7
1e-13
0
0
0
4
5
6
400
0
0
7
8
-9
"""


def problem(seed: int = 0) -> Adjustment:
    rng = np.random.default_rng(seed)
    k, m = 6, 20
    view, point = np.divmod(rng.permutation(k * m)[:70], m)
    lenses = np.column_stack([rng.uniform(400, 600, k), rng.normal(size=(k, 2)) * 1e-7])
    Ts = se3_exp(2.0 * rng.normal(size=(k, 6)))
    points = rng.normal(size=(m, 3))
    return Adjustment(Ts, points, view, point, rng.normal(size=(70, 2)) * 300, lenses, "bal")


def arrays(problem: Adjustment) -> dict[str, np.ndarray]:
    return {name: value for name, value in vars(problem).items() if isinstance(value, np.ndarray)}


@pytest.mark.parametrize("name", ["a.txt", "a.txt.gz"])
def test_there_and_back(tmp_path, name):
    before = problem()
    write_bal(tmp_path / name, before)
    once = read_bal(tmp_path / name)
    for field, value in arrays(before).items():
        np.testing.assert_allclose(arrays(once)[field], value, atol=3e-14)
    write_bal(tmp_path / f"b{name}", once)
    assert (tmp_path / name).read_bytes() == (tmp_path / f"b{name}").read_bytes()
    for field, value in arrays(read_bal(tmp_path / f"b{name}")).items():
        np.testing.assert_array_equal(value, arrays(once)[field])


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), size=st.sampled_from([0.0, 1e-9, 1e-3, 1.0, 2.0]))
def test_rotations_fall_on_their_grid(tmp_path_factory, seed, size):
    path = tmp_path_factory.mktemp("bal") / "a.txt"
    before = problem(seed)
    turns = size * np.random.default_rng(seed).normal(size=(6, 3))
    Ts = before.Ts_camera_world.copy()
    Ts[:, :3, :3] = so3_exp(turns)
    write_bal(path, replace(before, Ts_camera_world=Ts))
    once = read_bal(path)
    np.testing.assert_allclose(once.Ts_camera_world, Ts, atol=3e-14)
    write_bal(path, once)
    np.testing.assert_array_equal(read_bal(path).Ts_camera_world, once.Ts_camera_world)


def test_what_a_file_says(tmp_path):
    (tmp_path / "a.txt").write_text(SMALL)
    found = read_bal(tmp_path / "a.txt")
    assert found.models == ("bal", "bal")
    assert found.lens.tolist() == [0, 1]
    assert (found.view.tolist(), found.point.tolist()) == ([0, 1], [0, 0])
    assert found.pixels.tolist() == [[-10.5, 20.25], [30, -4]]
    assert found.intrinsics.tolist() == [[500, -1e-7, 1e-13], [400, 0, 0]]
    assert found.points_world.tolist() == [[7, 8, -9]]
    np.testing.assert_allclose(
        found.Ts_camera_world[0, :3, :3], so3_exp([0.1, 0.2, 0.3]), atol=1e-15
    )
    assert found.Ts_camera_world[1, :3].tolist() == [[1, 0, 0, 4], [0, 1, 0, 5], [0, 0, 1, 6]]
    assert not found.is_free_intrinsic.any()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("-9\n", "", r"a\.txt: 28 numbers follow the first line, which promises 29: is it cut off"),
        ("-9\n", "-9 1\n", r"a\.txt: 30 numbers follow the first line, which promises 29: do they"),
        ("2 1 2", "2 1 3", "28|29 numbers follow the first line, which promises 33"),
        ("2 1 2", "2 1", r"a\.txt:1: three whole numbers expected"),
        ("2 1 2", "2 -1 2", r"a\.txt:1: three whole numbers expected"),
        ("2 1 2", "2 1.0 2", r"a\.txt:1: three whole numbers expected"),
        ("2 1 2", f"2 1 {10**40}", "which promises 4000"),
        ("2 1 2", "0 1 2", r"a\.txt:1: no cameras, points or observations"),
        ("20.25", "much", r"a\.txt:2: 'much' is not a number"),
        ("20.25", "2_0", r"a\.txt:2: '2_0' is not a number"),
        ("20.25", "nan", r"a\.txt:2: 'nan' is not finite"),
        ("0.3", "inf", r"a\.txt:6: 'inf' is not finite"),
        ("1 0   3e1", "2 0   3e1", r"a\.txt:3: camera 2 is not there: the 2 are numbered from 0"),
        ("1 0   3e1", "1 1   3e1", r"a\.txt:3: point 1 is not there: the 1 are numbered from 0"),
        ("1 0   3e1", "1 -1  3e1", r"a\.txt:3: point -1 is not there"),
        ("1 0   3e1", "0.5 0 3e1", r"a\.txt:3: camera 0.5 is not there"),
    ],
)
def test_broken_files(tmp_path, old, new, message):
    assert old in SMALL
    (tmp_path / "a.txt").write_text(SMALL.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as error:
        read_bal(tmp_path / "a.txt")
    assert "\n" not in str(error.value)


def test_no_text_no_file(tmp_path: Path):
    (tmp_path / "a.txt").write_text("\n")
    with pytest.raises(InputError, match=r"a\.txt: is empty"):
        read_bal(tmp_path / "a.txt")
    with pytest.raises(InputError, match="No such file"):
        read_bal(tmp_path / "b.txt")
    (tmp_path / "c.txt").write_bytes(bytes(range(256)) * 4)
    with pytest.raises(InputError, match="is this a BAL problem"):
        read_bal(tmp_path / "c.txt")
    (tmp_path / "d.txt.gz").write_bytes(gzip.compress(SMALL.encode())[:-5])
    with pytest.raises(InputError, match="broken gzip"):
        read_bal(tmp_path / "d.txt.gz")


def test_what_bal_cannot_say(tmp_path):
    before = problem()
    lens = np.array([[500.0, 500, 320, 240]])
    with pytest.raises(InputError, match="lenses of model 'bal'"):
        write_bal(
            tmp_path / "a.txt",
            replace(
                before, intrinsics=lens, model="pinhole", lens=[0] * 6, is_free_intrinsic=False
            ),
        )
    with pytest.raises(InputError, match="hold no weights"):
        write_bal(tmp_path / "a.txt", replace(before, weights=2.0))
    assert not list(tmp_path.iterdir())
