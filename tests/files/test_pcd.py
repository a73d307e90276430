"""PCD in every form, and headers that lie."""

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.files.cloudfiles import read_cloud, write_cloud
from odomap.files.pcd import read_pcd, write_pcd
from sweepworlds import lzf, pcd_bytes


def columns(count: int = 500, seed: int = 0) -> dict[str, NDArray[np.generic]]:
    rng = np.random.default_rng(seed)
    found: dict[str, NDArray[np.generic]] = {
        name: rng.normal(0, 20, count).astype(np.float32) for name in ("x", "y", "z", "intensity")
    }
    found["x"][3] = np.nan
    found["ring"] = rng.integers(0, 64, count).astype(np.uint16)
    found["t"] = np.sort(rng.integers(0, 10**8, count)).astype(np.uint32)
    found["stamp"] = (found["t"] * 1e-9).astype(np.float64) + 1.7e9
    return found


def damaged(path: Path, old: bytes, new: bytes) -> Path:
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new, 1))
    return path


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_all_forms_hold_the_same(tmp_path: Path, form: str) -> None:
    there = columns()
    file = tmp_path / "a.pcd"
    file.write_bytes(pcd_bytes(there, form))
    table = read_pcd(file)
    assert (table.count, table.height) == (500, 1)
    assert list(table.columns) == list(there)
    for name, column in there.items():
        np.testing.assert_array_equal(table.columns[name], column.astype(np.float64))
        assert form == "ascii" or table.columns[name].dtype == column.dtype


@pytest.mark.parametrize("count", [0, 1, 33])
def test_written_and_read_again(tmp_path: Path, count: int) -> None:
    there = columns(count) if count > 3 else {n: c[:count] for n, c in columns(9).items()}
    write_pcd(tmp_path / "a.pcd", there)
    table = read_pcd(tmp_path / "a.pcd")
    assert table.count == count
    np.testing.assert_array_equal(table.columns["ring"], there["ring"])
    np.testing.assert_array_equal(table.columns["y"], there["y"])


@pytest.mark.parametrize("seed", range(4))
def test_unpacking(tmp_path: Path, seed: int) -> None:
    """Repeated bytes, near and far, long and overlapping."""
    rng = np.random.default_rng(seed)
    values = np.concatenate(
        [np.zeros(900), np.tile(rng.normal(size=7), 90), rng.normal(size=200), np.ones(400)]
    ).astype(np.float32)
    there = {name: np.roll(values, k) for k, name in enumerate("xyz")}
    data = b"".join(column.tobytes() for column in there.values())
    assert len(lzf(data)) < 0.5 * len(data)
    (tmp_path / "a.pcd").write_bytes(pcd_bytes(there, "binary_compressed"))
    for name, column in read_pcd(tmp_path / "a.pcd").columns.items():
        np.testing.assert_array_equal(column, there[name])


def test_padding_and_fields_of_several_values(tmp_path: Path) -> None:
    row = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("pad", "u1", 4), ("h", "<f4", 3)])
    rows = np.zeros(6, row)
    rows["z"] = np.arange(6)
    head = (
        "VERSION .7\nFIELDS x y z _ histogram\nSIZE 4 4 4 1 4\nTYPE F F F U F\n"
        "COUNT 1 1 1 4 3\nWIDTH 3\nHEIGHT 2\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 6\nDATA binary\n"
    )
    (tmp_path / "a.pcd").write_bytes(head.encode() + rows.tobytes())
    table = read_pcd(tmp_path / "a.pcd")
    assert (list(table.columns), table.height) == (["x", "y", "z"], 2)
    assert table.columns["z"].tolist() == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_headers_that_lie(tmp_path: Path, form: str) -> None:
    """Nothing is allocated for what a header only announces."""
    file = tmp_path / "a.pcd"
    for said in (501, 10**9, 10**15):
        data = pcd_bytes(columns(), form).replace(b"WIDTH 500", b"WIDTH %d" % said)
        file.write_bytes(data.replace(b"POINTS 500", b"POINTS %d" % said))
        with pytest.raises(InputError, match=rf"a\.pcd: the header says {said} points"):
            read_pcd(file)
    file.write_bytes(pcd_bytes(columns(), form)[:-40])
    with pytest.raises(InputError, match=r"a\.pcd: .* cut off"):
        read_pcd(file)


def test_compressed_that_lie(tmp_path: Path) -> None:
    """A byte makes no more than 88: a bomb is seen before memory is asked for."""
    huge = 10**8
    head = (
        f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {huge}\nPOINTS {huge}\n"
        "DATA binary_compressed\n"
    )
    sizes = np.array([40, 12 * huge], "<u4").tobytes()
    (tmp_path / "a.pcd").write_bytes(head.encode() + sizes + bytes(40))
    with pytest.raises(InputError, match="but 40 compressed bytes"):
        read_pcd(tmp_path / "a.pcd")
    data = bytearray(pcd_bytes(columns(), "binary_compressed"))
    start = data.index(b"DATA binary_compressed\n") + 31
    for place in (start, start + 200):
        broken = data.copy()
        broken[place] ^= 0xFF
        (tmp_path / "a.pcd").write_bytes(bytes(broken))
        with suppress(InputError):  # literal bytes have no sum that could tell
            assert read_pcd(tmp_path / "a.pcd").count == 500


def test_any_bytes_behind_the_sizes_are_no_crash(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    head = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 100\nDATA binary_compressed\n"
    for _ in range(60):
        body = rng.integers(0, 256, 300).astype(np.uint8).tobytes()
        sizes = np.array([300, 1200], "<u4").tobytes()
        (tmp_path / "a.pcd").write_bytes(head + sizes + body)
        with pytest.raises(InputError, match="damaged"):
            read_pcd(tmp_path / "a.pcd")


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (b"FIELDS", b"FIELD", "no line 'FIELDS'"),
        (b"DATA binary", b"DATA zipped", r"a\.pcd:11: 'DATA zipped' cannot be read"),
        (b"SIZE 4", b"SIZE 5", "'TYPE F F F F U U F' cannot be read"),
        (b"SIZE 4 4", b"SIZE 4", "not equally long"),
        (b"WIDTH 500", b"WIDTH many", r"a\.pcd:7: 'WIDTH many' cannot be read"),
        (b"WIDTH 500", b"WIDTH -5", "'WIDTH -5' cannot be read"),
        (b"POINTS 500", b"POINTS 499", "POINTS 499 is not WIDTH times HEIGHT, 500 x 1"),
        (b"DATA binary", b"", "no line 'DATA'"),
    ],
)
def test_headers_that_cannot_be(tmp_path: Path, old: bytes, new: bytes, says: str) -> None:
    file = tmp_path / "a.pcd"
    file.write_bytes(pcd_bytes(columns(), "binary"))
    with pytest.raises(InputError, match=says):
        read_pcd(damaged(file, old, new))


def test_text_that_is_none(tmp_path: Path) -> None:
    file = tmp_path / "a.pcd"
    text = pcd_bytes(columns(), "ascii").rstrip()
    file.write_bytes(text[: text.rindex(b" ")] + b" none")
    with pytest.raises(InputError, match="rows must hold numbers"):
        read_pcd(file)
    with pytest.raises(InputError, match="cannot be read: No such file"):
        read_pcd(tmp_path / "b.pcd")


def test_a_cloud_is_read_by_its_name(tmp_path):
    points = np.array([[1.0, 2, 3], [np.nan, 0, 0], [4, 5, 6]], np.float32)
    write_pcd(tmp_path / "a.pcd", dict(zip("xyz", points.T, strict=True)))
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.pcd").points, points[[0, 2]])
    write_cloud(tmp_path / "a.ply", dict(zip("xyz", points.T, strict=True)))
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.ply").points, points)
    write_pcd(tmp_path / "b.pcd", {"x": points[:, 0], "y": points[:, 1]})
    with pytest.raises(InputError, match=r"b\.pcd: has no fields x, y and z"):
        read_cloud(tmp_path / "b.pcd")
