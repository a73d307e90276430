"""Trajectories survive the way through text, and broken text is named by its line."""

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.files.trajectories import (
    read_euroc,
    read_kitti_poses,
    read_times,
    read_trajectory,
    read_tum,
    write_euroc,
    write_kitti,
    write_tum,
)
from odomap.geometry.lie import se3_exp
from odomap.geometry.trajectory import Trajectory

START_NS = 1403636584763555584


def path(count: int = 20, start_ns: int = START_NS) -> Trajectory:
    rng = np.random.default_rng(1)
    stamps = start_ns + np.cumsum(rng.integers(1, 100_000_000, count))
    return Trajectory(stamps, se3_exp(rng.normal(size=(count, 6)) * 2))


@pytest.mark.parametrize(
    ("write", "read", "name"),
    [
        (write_tum, read_tum, "a.tum"),
        (write_tum, read_tum, "a.tum.gz"),
        (write_euroc, read_euroc, "a.csv"),
        (write_tum, read_trajectory, "a.txt"),
        (write_euroc, read_trajectory, "a.csv"),
    ],
)
def test_there_and_back(
    tmp_path: Path,
    write: Callable[[Path, Trajectory], None],
    read: Callable[[Path], Trajectory],
    name: str,
) -> None:
    before = path()
    write(tmp_path / name, before)
    after = read(tmp_path / name)
    assert np.array_equal(after.stamps_ns, before.stamps_ns)
    np.testing.assert_allclose(after.Ts_world_body, before.Ts_world_body, atol=5e-9)


@pytest.mark.parametrize("name", ["poses.txt", "poses.txt.gz"])
def test_kitti_there_and_back(tmp_path: Path, name: str) -> None:
    before = path()
    write_kitti(tmp_path / name, before)
    after = read_kitti_poses(tmp_path / name, before.stamps_ns)
    assert np.array_equal(after.stamps_ns, before.stamps_ns)
    np.testing.assert_allclose(after.Ts_world_body, before.Ts_world_body, atol=5e-9)
    assert read_kitti_poses(tmp_path / name).stamps_ns[:2].tolist() == [0, 100_000_000]


@pytest.mark.parametrize("name", ["a.tum", "a.tum.gz"])
def test_the_same_poses_give_the_same_bytes(tmp_path: Path, name: str) -> None:
    write_tum(tmp_path / name, path())
    (tmp_path / "other").mkdir()
    write_tum(tmp_path / "other" / name, path())
    assert (tmp_path / name).read_bytes() == (tmp_path / "other" / name).read_bytes()


def test_tum_text_is_plain(tmp_path: Path) -> None:
    T = np.eye(4)[None].copy()
    T[0, :3, 3] = 1.0, -1e-12, -0.25
    write_tum(tmp_path / "a.tum", Trajectory(np.array([1_000_000_001]), T))
    assert (tmp_path / "a.tum").read_text() == (
        "# time tx ty tz qx qy qz qw\n"
        "1.000000001 1.000000000 0.000000000 -0.250000000"
        " 0.000000000 0.000000000 0.000000000 1.000000000\n"
    )


def test_empty_trajectory_is_written_but_not_read(tmp_path: Path) -> None:
    write_tum(tmp_path / "a.tum", Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4))))
    with pytest.raises(InputError, match=r"a\.tum: no poses"):
        read_tum(tmp_path / "a.tum")
    with pytest.raises(InputError, match=r"a\.tum: no poses"):
        read_trajectory(tmp_path / "a.tum")


def test_order_of_the_quaternion(tmp_path: Path) -> None:
    half = np.sqrt(0.5)
    (tmp_path / "a.tum").write_text(f"0.5 1 2 3 0 0 {half} {half}\n")
    (tmp_path / "a.csv").write_text(f"#stamp\n500000000,1,2,3,{half},0,0,{half},9,9,9\n")
    expected = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    for read, name in ((read_tum, "a.tum"), (read_euroc, "a.csv")):
        trajectory = read(tmp_path / name)
        assert trajectory.stamps_ns.tolist() == [500_000_000]
        np.testing.assert_allclose(trajectory.Ts_world_body[0], expected, atol=1e-15)


def test_rows_are_sorted_and_none_is_lost(tmp_path: Path) -> None:
    rows = ["2 2 0 0 0 0 0 1", "1 1 0 0 0 0 0 1 # a comment", "", "# more", "2 9 0 0 0 0 0 1"]
    (tmp_path / "a.tum").write_text("\n".join(rows))
    trajectory = read_tum(tmp_path / "a.tum")
    assert trajectory.positions[:, 0].tolist() == [1.0, 2.0, 9.0]
    assert trajectory.stamps_ns.tolist() == [10**9, 2 * 10**9, 2 * 10**9 + 1]


def test_commas_and_byte_order_mark_are_fine(tmp_path: Path) -> None:
    (tmp_path / "a.tum").write_bytes(b"\xef\xbb\xbf1.5, 1, 0, 0, 0, 0, 0, 1\r\n")
    assert read_tum(tmp_path / "a.tum").stamps_ns.tolist() == [1_500_000_000]


def test_stamps_in_nanoseconds_are_recognised(tmp_path: Path) -> None:
    rows = [f"{START_NS + i * 50_000_000} {i} 0 0 0 0 0 1" for i in range(5)]
    (tmp_path / "a.tum").write_text("\n".join(rows))
    assert read_tum(tmp_path / "a.tum").stamps_ns[0] == START_NS


@pytest.mark.parametrize(
    ("second_line", "message"),
    [
        ("1 2 3 4 5", "a.tum:2: expected 8 numbers, got 5"),
        ("2 0 0 0 0 0 0 1 7", "a.tum:2: expected 8 numbers, got 9"),
        ("2 0 0 0 0 0 zero 1", "a.tum:2: 'zero' is not a number"),
        ("2 nan 0 0 0 0 0 1", "a.tum:2: NaN or infinite value"),
        ("nan 0 0 0 0 0 0 1", "a.tum:2: stamp 'nan' is not a number"),
        ("2 0 0 0 0 0 0 3", "a.tum:2: quaternion of length 3"),
        ("2 0 0 0 0 0 0 0", "a.tum:2: quaternion of length 0"),
        ("\x00\x01\xff garbage", "a.tum:2: expected 8 numbers, got 2"),
    ],
)
def test_broken_tum(tmp_path: Path, second_line: str, message: str) -> None:
    (tmp_path / "a.tum").write_text(f"1 0 0 0 0 0 0 1\n{second_line}\n", encoding="latin-1")
    with pytest.raises(InputError, match=message):
        read_tum(tmp_path / "a.tum")


def test_broken_kitti(tmp_path: Path) -> None:
    row = "1 0 0 0 0 1 0 0 0 0 1 0"
    file = tmp_path / "poses.txt"
    file.write_text(f"{row}\n{row} 5\n")
    with pytest.raises(InputError, match=r"poses\.txt:2: expected 12 numbers, got 13"):
        read_kitti_poses(file)
    file.write_text(f"{row}\n1 0 0 0 0 2 0 0 0 0 1 0\n")
    with pytest.raises(InputError, match=r"poses\.txt:2: the 3x3 block is no rotation"):
        read_kitti_poses(file)
    file.write_text(f"{row}\n{row}\n")
    with pytest.raises(InputError, match="2 poses but only 1 times"):
        read_kitti_poses(file, np.zeros(1, np.int64))


def test_times(tmp_path: Path) -> None:
    file = tmp_path / "times.txt"
    file.write_text("0.000000e+00\n1.037359e-01\n2.1\n")
    assert read_times(file).tolist() == [0, 103_735_900, 2_100_000_000]
    file.write_text("0.0\nnan\n")
    with pytest.raises(InputError, match=r"times\.txt:2: time 'nan'"):
        read_times(file)


def test_kitti_times_beside_are_used(tmp_path: Path) -> None:
    write_kitti(tmp_path / "poses.txt", path(3))
    (tmp_path / "times.txt").write_text("0.5\n0.6\n0.75\n")
    assert read_trajectory(tmp_path / "poses.txt").stamps_ns.tolist() == [
        500_000_000,
        600_000_000,
        750_000_000,
    ]


def test_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"missing\.tum: No such file"):
        read_tum(tmp_path / "missing.tum")
    with pytest.raises(InputError, match="Is a directory"):
        read_tum(tmp_path)
    packed = gzip.compress(b"0 0 0 0 0 0 0 1\n" * 100)
    (tmp_path / "cut.tum.gz").write_bytes(packed[:-10])
    with pytest.raises(InputError, match=r"cut\.tum\.gz: broken gzip"):
        read_tum(tmp_path / "cut.tum.gz")


def test_unknown_layout(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("# header\n1 2 3\n")
    with pytest.raises(InputError, match=r"a\.txt:2: 3 numbers in a row: expected 8 .* or 12"):
        read_trajectory(tmp_path / "a.txt")
