"""NPY, LAS and PLY as tables of points."""

import io
import struct
from pathlib import Path

import numpy as np
import pytest

from odomap.errors import InputError, MissingExtra
from odomap.files.clouds import read_ply_points
from odomap.files.pointtable import read_las, read_npy


def test_npy_rows(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(40, 6))
    rows[:, 4] = np.arange(40) % 16
    for kind in (np.float64, np.float32):
        for order in ("C", "F"):
            np.save(tmp_path / "a.npy", np.asarray(rows.astype(kind), order=order))
            table = read_npy(tmp_path / "a.npy")
            assert list(table.columns) == ["x", "y", "z", "intensity", "ring", "time"]
            for k, column in enumerate(table.columns.values()):
                np.testing.assert_array_equal(column, rows[:, k].astype(kind))
    np.save(tmp_path / "a.npy", rows[:, :3])
    assert list(read_npy(tmp_path / "a.npy").columns) == ["x", "y", "z"]
    np.save(tmp_path / "a.npy", rows[:0, :4])
    assert read_npy(tmp_path / "a.npy").count == 0


def test_npy_with_names(tmp_path: Path) -> None:
    rows = np.zeros((2, 5), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")])
    rows["t"] = 7
    np.save(tmp_path / "a.npy", rows)
    table = read_npy(tmp_path / "a.npy")
    assert (table.count, list(table.columns)) == (10, ["x", "y", "z", "t"])
    assert table.columns["t"].tolist() == [7] * 10


def test_npy_that_lies_or_holds_something_else(tmp_path: Path) -> None:
    file = tmp_path / "a.npy"
    np.save(file, np.array([{"x": 1}], object), allow_pickle=True)
    with pytest.raises(InputError, match=r"a\.npy: holds objects, which could run code"):
        read_npy(file)
    np.save(file, np.zeros(9))
    with pytest.raises(InputError, match=r"float64 of shape \(9,\): rows x y z"):
        read_npy(file)
    np.save(file, np.zeros((9, 3), complex))
    with pytest.raises(InputError, match="complex128"):
        read_npy(file)
    np.save(file, np.zeros((9, 4)))
    whole = file.read_bytes()
    file.write_bytes(whole[:-8])
    with pytest.raises(InputError, match="ends after 280 of 288 bytes: is it cut off"):
        read_npy(file)
    held = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        held, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 4)}
    )
    file.write_bytes(held.getvalue() + bytes(64))
    with pytest.raises(InputError, match="ends after 64 of 32000000000000 bytes"):
        read_npy(file)
    file.write_bytes(b"")
    with pytest.raises(InputError, match=r"a\.npy: "):
        read_npy(file)
    with pytest.raises(InputError, match="cannot be read: No such file"):
        read_npy(tmp_path / "b.npy")


def las(path: Path, count: int = 30) -> Path:
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=1, version="1.2")
    header.scales = np.full(3, 0.001)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = (np.arange(count) * scale for scale in (1.0, -0.5, 0.25))
    cloud.intensity = np.arange(count)
    cloud.gps_time = np.linspace(100.0, 100.1, count)
    cloud.write(path)
    return path


def test_las(tmp_path: Path) -> None:
    table = read_las(las(tmp_path / "a.las"))
    assert table.count == 30
    np.testing.assert_allclose(table.columns["y"], -0.5 * np.arange(30), atol=1e-9)
    np.testing.assert_array_equal(table.columns["intensity"], np.arange(30))
    np.testing.assert_allclose(table.columns["gps_time"], np.linspace(100.0, 100.1, 30))


def test_las_that_is_cut_or_packed(tmp_path: Path) -> None:
    whole = las(tmp_path / "a.las").read_bytes()
    file = tmp_path / "b.las"
    file.write_bytes(whole[:-40])
    with pytest.raises(InputError, match=r"b\.las: the header says 30 points of 28 bytes, but 800"):
        read_las(file)
    lying = bytearray(whole)
    struct.pack_into("<I", lying, 107, 2**31)
    file.write_bytes(lying)
    with pytest.raises(InputError, match="says 2147483648 points"):
        read_las(file)
    packed = bytearray(whole)
    packed[104] |= 0x80
    file.write_bytes(packed)
    with pytest.raises(InputError, match=r"compressed \(LAZ\): unpack it"):
        read_las(file)
    file.write_bytes(b"LASF and nothing else")
    with pytest.raises(InputError, match="is no LAS file"):
        read_las(file)


def test_las_without_its_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "laspy", None)
    (tmp_path / "a.las").write_bytes(bytes(400))
    with pytest.raises(MissingExtra, match=r"pip install 'odomap\[lidar\]'"):
        read_las(tmp_path / "a.las")


@pytest.mark.parametrize("text", [True, False])
def test_ply_with_all_its_columns(tmp_path: Path, text: bool) -> None:
    kind = "ascii" if text else "binary_little_endian"
    head = (
        f"ply\nformat {kind} 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
        "property float z\nproperty uchar ring\nproperty double time\nend_header\n"
    )
    rows = np.array(
        [(1, 2, 3, 4, 0.5), (5, 6, 7, 8, 0.25)],
        [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", "u1"), ("time", "<f8")],
    )
    body = b"1 2 3 4 0.5\n5 6 7 8 0.25\n" if text else rows.tobytes()
    (tmp_path / "a.ply").write_bytes(head.encode() + body)
    table = read_ply_points(tmp_path / "a.ply")
    assert table.count == 2
    assert table.columns["ring"].tolist() == [4, 8]
    assert table.columns["time"].tolist() == [0.5, 0.25]
    (tmp_path / "a.ply").write_bytes(head.replace(" z", " q").encode() + body)
    with pytest.raises(InputError, match="no vertices with x, y and z"):
        read_ply_points(tmp_path / "a.ply")


def test_rows_are_points_and_not_columns(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((3, 500)))
    with pytest.raises(InputError, match=r"a\.npy: is of shape \(3, 500\): .*transpose it"):
        read_npy(tmp_path / "a.npy")
