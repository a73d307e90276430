from pathlib import Path

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.evaluation.metrics import Relations, read_relations, relations
from odomap.geometry.lie import se3_exp
from odomap.geometry.trajectory import Trajectory


def circle(n: int = 60) -> Trajectory:
    xi = np.zeros((n, 6))
    xi[:, 5] = 2 * np.pi * np.arange(n) / n
    Ts = se3_exp(xi)
    Ts[:, :2, 3] = np.c_[np.cos(xi[:, 5]), np.sin(xi[:, 5])]
    return Trajectory(np.arange(n, dtype=np.int64) * 100_000_000 + 10**18, Ts)


def truth_of(trajectory: Trajectory, pairs: list[tuple[int, int]]) -> Relations:
    Ts = trajectory.Ts_world_body
    relative = [np.linalg.inv(Ts[i]) @ Ts[j] for i, j in pairs]
    increments = [(T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])) for T in relative]
    return Relations(trajectory.stamps_ns[np.array(pairs)], np.array(increments))


PAIRS = [(0, 1), (3, 40), (59, 0), (30, 31)]


def test_the_truth_repeats_its_own_relations() -> None:
    result = relations(circle(), truth_of(circle(), PAIRS))
    assert result.relations == 4
    assert result.trans_mean < 1e-12
    assert result.rot_mean_deg < 1e-9


def test_known_errors_are_found_and_angles_wrap() -> None:
    reference = truth_of(circle(), PAIRS)
    reference.increments[:, 0] += 0.3
    reference.increments[:, 1] -= 0.4
    reference.increments[:, 2] += 2 * np.pi - np.radians(1.0)
    result = relations(circle(), reference)
    assert result.trans_mean == pytest.approx(0.5)
    assert result.trans_std == pytest.approx(0.0, abs=1e-12)
    assert result.rot_mean_deg == pytest.approx(1.0)
    assert set(result.as_dict()) == {
        "relations", "trans_mean_m", "trans_std_m", "rot_mean_deg", "rot_std_deg",
    }  # fmt: skip


def test_relations_outside_the_time_do_not_count() -> None:
    reference = truth_of(circle(), PAIRS)
    reference.stamps_ns[1, 1] += 60_000_000_000
    assert relations(circle(), reference).relations == 3
    reference.stamps_ns[:] += 60_000_000_000
    with pytest.raises(InputError, match=r"no relation overlaps.*different clocks"):
        relations(circle(), reference)


def test_files_are_read_exactly(tmp_path: Path) -> None:
    path = tmp_path / "x.relations"
    path.write_text("# t1 t2 x y z r p y\n\n976052857.335880 976052858.4 0.1 -0.2 0 0 0 1.5\n")
    read = read_relations(path)
    assert len(read) == 1
    assert read.stamps_ns.tolist() == [[976052857335880000, 976052858400000000]]
    assert read.increments.tolist() == [[0.1, -0.2, 1.5]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n", "line 1: expected 8 numbers, got 3"),
        ("1 2 0 0 0 0 0 0\n1 2 x 0 0 0 0 0\n", "line 2: not a number"),
        ("abc 2 0 0 0 0 0 0\n", "line 1: not a number"),
        ("nan 2 0 0 0 0 0 0\n", "line 1: not a number"),
        ("1 2 0 0 0 0 0 nan\n", "line 1: NaN"),
        ("# nothing\n", "no relations"),
    ],
)
def test_bad_files_are_named(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.relations"
    path.write_text(text)
    with pytest.raises(InputError, match=rf"bad\.relations: .*{message}"):
        read_relations(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.relations"):
        read_relations(tmp_path / "none.relations")
