"""PLY files: what is written comes back, others' files are read, broken ones say what is broken."""

import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from odomap.errors import InputError, OutputError
from odomap.files.clouds import read_ply, write_ply
from odomap.maps.surface import Surface


def a_surface(count=20, faces=8, normals=True, colours=True, seed=0):
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return Surface(
        rng.normal(0, 3, (count, 3)).astype(np.float32),
        directions.astype(np.float32) if normals else None,
        rng.integers(0, 256, (count, 3)).astype(np.uint8) if colours else None,
        rng.integers(0, max(count, 1), (faces, 3)).astype(np.int32),
    )


def same(a, b):
    pairs = [(a.points, b.points), (a.normals, b.normals), (a.colours, b.colours)]
    for x, y in [*pairs, (a.faces, b.faces)]:
        assert (x is None) == (y is None)
        if x is not None:
            assert x.dtype == y.dtype
            np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(("normals", "colours", "faces"), [(True, True, 8), (False, False, 0)])
def test_what_is_written_comes_back(tmp_path, text, normals, colours, faces):
    surface = a_surface(normals=normals, colours=colours, faces=faces)
    write_ply(tmp_path / "a.ply", surface, text)
    same(read_ply(tmp_path / "a.ply"), surface)


def test_nothing_is_written_and_read_too(tmp_path):
    empty = Surface(np.zeros((0, 3), np.float32))
    write_ply(tmp_path / "a.ply", empty)
    same(read_ply(tmp_path / "a.ply"), empty)


def test_the_layout_is_what_viewers_expect(tmp_path):
    write_ply(tmp_path / "a.ply", a_surface(5, 2))
    data = (tmp_path / "a.ply").read_bytes()
    header, body = data.split(b"end_header\n", 1)
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\n")
    assert b"element vertex 5\nproperty float x\n" in header
    assert b"property uchar red\n" in header
    assert b"element face 2\nproperty list uchar int vertex_indices\n" in header
    assert len(body) == 5 * (6 * 4 + 3) + 2 * (1 + 3 * 4)


def test_the_same_surface_gives_the_same_bytes(tmp_path):
    for name in "ab":
        write_ply(tmp_path / f"{name}.ply", a_surface())
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_other_types_orders_elements_and_polygons_are_read(tmp_path):
    header = (
        "ply\r\nformat binary_big_endian 1.0\r\nobj_info x\r\nelement camera 1\r\n"
        "property list uchar short junk\r\nproperty double focal\r\nelement vertex 4\r\n"
        "property double z\r\nproperty float32 intensity\r\nproperty double x\r\n"
        "property double y\r\nelement face 2\r\nproperty list uchar uint vertex_index\r\n"
        "end_header\r\n"
    )
    vertices = np.zeros(4, [("z", ">f8"), ("i", ">f4"), ("x", ">f8"), ("y", ">f8")])
    vertices["x"], vertices["z"] = [0, 1, 1, 0], 7.0
    body = bytes([2]) + np.array([5, 6], ">i2").tobytes() + np.array([500.0], ">f8").tobytes()
    body += vertices.tobytes()
    body += bytes([4]) + np.array([0, 1, 2, 3], ">u4").tobytes()
    body += bytes([3]) + np.array([0, 1, 2], ">u4").tobytes()
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    surface = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(surface.points[:, 0], [0, 1, 1, 0])
    np.testing.assert_array_equal(surface.points[:, 2], 7.0)
    np.testing.assert_array_equal(surface.faces, [[0, 1, 2], [0, 2, 3], [0, 1, 2]])


def test_colours_as_shares_become_bytes(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 2\n"
    names = [*"xyz", "red", "green", "blue"]
    for kind, row, wanted in (
        ("float", "1 0 0.5", [255, 0, 128]),
        ("uchar", "1 0 1", [1, 0, 1]),
    ):
        kinds = ["float"] * 3 + [kind] * 3
        properties = "".join(f"property {k} {n}\n" for k, n in zip(kinds, names, strict=True))
        text = f"{head}{properties}end_header\n" + f"1 2 3 {row}\n" * 2
        (tmp_path / "a.ply").write_text(text, "ascii")
        np.testing.assert_array_equal(read_ply(tmp_path / "a.ply").colours, [wanted] * 2)


HEAD = "ply\nformat ascii 1.0\n"
VERTEX = "element vertex 1\nproperty float x\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "is no PLY file"),
        ("plywood\n", "is no PLY file"),
        (HEAD + VERTEX, "no line 'end_header'"),
        ("ply\nelement vertex 0\nproperty float x\nend_header\n", "names no format"),
        ("ply\nformat rot13 1.0\nend_header\n", ":2: 'format rot13 1.0' cannot be read"),
        (HEAD + "element vertex many\nend_header\n", ":3: 'element vertex many'"),
        (HEAD + "element vertex -1\nend_header\n", ":3: 'element vertex -1'"),
        (HEAD + "property float x\nend_header\n", ":3: 'property float x'"),
        (HEAD + "element vertex 1\nproperty half x\nend_header\n", ":4: 'property half x'"),
        (HEAD + "element vertex 1\nend_header\n0\n", "'vertex' has no properties"),
        (HEAD + VERTEX + "property float x\nend_header\n", "two properties of one name"),
        (HEAD + VERTEX + "end_header\n", "ends after 0 of 1 rows of 'vertex'"),
        (HEAD + VERTEX + "end_header\n1 2\n", "'1 2' is no vertex"),
        (HEAD + VERTEX + "end_header\n1 2 tree\n", "'1 2 tree' is no vertex"),
        (HEAD + "element point 0\nproperty float x\nend_header\n", "no vertices with x, y and z"),
        (
            HEAD + VERTEX + "element face 1\nproperty list uchar int vertex_indices\n"
            "end_header\n1 2 3\n3 0 0 1\n",
            "a face names a vertex that is not among the 1",
        ),
        (
            "ply\nformat binary_little_endian 1.0\nelement vertex 999999999999\n"
            "property double x\nend_header\n12345678",
            "ends after 1 of 999999999999 rows",
        ),
        (
            "ply\nformat binary_little_endian 1.0\nelement face 999999999999\n"
            "property list int int vertex_indices\nend_header\n1234abcd",
            "ends after 0 of 999999999999 rows of 'face'",
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said(tmp_path, content, message):
    path = tmp_path / "a.ply"
    path.write_bytes(content.encode())
    with pytest.raises(InputError) as error:
        read_ply(path)
    assert message in str(error.value)
    assert str(path) in str(error.value)


def test_a_missing_file_and_a_missing_folder(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_ply(tmp_path / "a.ply")
    with pytest.raises(OutputError, match="folder does not exist"):
        write_ply(tmp_path / "none" / "a.ply", a_surface())


@given(st.binary(max_size=300), st.integers(0, 700))
def test_a_damaged_file_is_read_or_refused(tmp_path_factory, junk, cut):
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    write_ply(path, a_surface(4, 3))
    data = path.read_bytes()
    path.write_bytes(data[:cut] + junk)
    with contextlib.suppress(InputError):  # any other error fails
        assert read_ply(path).points.shape[1] == 3


def test_surfaces_must_fit_together():
    points = np.zeros((3, 3), np.float32)
    with pytest.raises(InputError, match="colours: have shape"):
        Surface(points, colours=np.zeros((2, 3), np.uint8))
    with pytest.raises(InputError, match="not among the 3"):
        Surface(points, faces=np.array([[0, 1, 3]], np.int32))
