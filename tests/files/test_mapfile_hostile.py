"""Broken and hostile map files are refused in one line, in bounded memory."""

import copy
import io
import json
import pickle
import struct
import tracemalloc
import zlib

import numpy as np
import pytest

from mapworlds import rich_map
from odomap.errors import InputError, OdomapError
from odomap.files.mapfile import MapFile, load_map, save_map
from odomap.files.mapschema import ARRAYS
from odomap.files.ziplayout import CENTRAL, END, LOCAL
from odomap.files.zipreader import ZipReader
from odomap.files.zipwriter import ZipWriter

MEMORY = 100 << 20
"""More than a file of some kilobytes may take while it is refused."""


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """Bytes of a file, and its manifest and arrays."""
    path = tmp_path_factory.mktemp("map") / "good.odomap"
    save_map(path, rich_map(), settings={"preset": "x"})
    with MapFile(path) as file, ZipReader(path) as archive:
        arrays = {name: file.array(name) for name in file.arrays}
        return path.read_bytes(), archive.manifest, arrays


def rewritten(path, manifest, arrays, members=(), packs=False):
    """Write a file whose checksums are right, whatever it says."""
    manifest = copy.deepcopy(manifest)
    with open(path, "wb") as file:
        writer = ZipWriter(file)
        for name, array in arrays.items():
            writer.add(name, array, packs=packs and name in ARRAYS)
        for name, content in members:
            writer._write(name, [content], False)
        for name, entry in writer.arrays.items():
            manifest["arrays"].setdefault(name, {}).update(entry)
        writer.close(manifest)
    return path


def refused(path, message=""):
    """Assert that a file is refused in one line that names it, without much memory."""
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as caught:
            load_map(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    text = str(caught.value)
    assert text.startswith(f"{path}: "), text
    assert "\n" not in text
    assert message in text
    assert len(text) < 400
    assert peak < MEMORY, f"{peak / 2**20:.0f} MB"


def test_what_was_rewritten_unchanged_is_read(tmp_path, good):
    data, manifest, arrays = good
    path = rewritten(tmp_path / "m.odomap", manifest, arrays, packs=True)
    assert path.read_bytes() == data
    load_map(path)


@pytest.mark.parametrize(
    ("version", "lacks"), [(1, ("landmarks/expected", "states/growths")), (2, ("states/growths",))]
)
def test_a_file_of_an_older_version_is_read_and_held_to_it(tmp_path, good, version, lacks):
    _, manifest, arrays = good
    first = {name: array for name, array in arrays.items() if name not in lacks}
    older = {**manifest, "odomap_map": version}
    older["arrays"] = {name: manifest["arrays"][name] for name in first}
    m = load_map(rewritten(tmp_path / "m.odomap", older, first))
    ids = m.landmark_ids
    assert m.seen(ids).max() > 0
    if version == 1:
        assert m.expected(ids).tolist() == m.seen(ids).tolist()
    assert all(np.isnan(m.growth(k)).all() for k in m.keyframe_ids.tolist())
    with MapFile(tmp_path / "m.odomap") as file:
        assert file.version == version
    save_map(tmp_path / "n.odomap", m)
    with MapFile(tmp_path / "n.odomap") as file:
        assert file.version == 3
    older["arrays"] = manifest["arrays"]
    path = rewritten(tmp_path / "m.odomap", older, arrays)
    refused(path, f"{lacks[0]!r}: is no part of a map of version {version}")
    newer = {**manifest, "arrays": {name: manifest["arrays"][name] for name in first}}
    refused(rewritten(path, newer, first), f"{lacks[-1]} is not declared")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "is empty"),
        (b"ply\nformat ascii 1.0\n", "is no map file (no zip)"),
        (b"PK\x03\x04", "its end is missing"),
        (END.pack(b"PK\x05\x06", 0, 0, 0, 0, 0, 0, 0), "is no map file"),
        (pickle.dumps({"a": np.zeros(3)}), "is no map file"),
    ],
)
def test_what_is_no_map(tmp_path, data, message):
    (tmp_path / "m.odomap").write_bytes(data)
    refused(tmp_path / "m.odomap", message)


def test_what_cannot_be_opened(tmp_path):
    refused(tmp_path / "none.odomap", "No such file")
    refused(tmp_path, "Is a directory")


def test_every_truncation_is_refused(tmp_path, good):
    data, path = good[0], tmp_path / "m.odomap"
    for length in [*range(1, 200, 7), *range(200, len(data), 997), len(data) - 1]:
        path.write_bytes(data[:length])
        with pytest.raises(InputError):
            load_map(path)
    path.write_bytes(data + b"x")
    refused(path, "its end is missing")


def test_a_flipped_bit_is_found_wherever_it_matters(tmp_path, good):
    data, path = bytearray(good[0]), tmp_path / "m.odomap"
    with ZipReader(_written(path, data)) as archive:
        members = list(archive.members.values())
    for member in members:
        at = member.offset + LOCAL.size + len(member.name) + member.packed // 2
        data[at] ^= 0x10
        refused(_written(path, data), f"{member.name}: ")
        data[at] ^= 0x10


def _written(path, data):
    path.write_bytes(data)
    return path


def test_one_keyframe_that_is_broken_is_found_when_it_is_read_alone(tmp_path, good):
    data, path = bytearray(good[0]), tmp_path / "m.odomap"
    with ZipReader(_written(path, data)) as archive:
        member = archive.members["features/depth.npy"]
    data[member.offset + LOCAL.size + len(member.name) + member.packed - 1] ^= 1
    with MapFile(_written(path, data)) as file:
        assert file.features(4) is not None
        with pytest.raises(InputError, match="keyframe 7: the checksum of its features is wrong"):
            file.features(7)


def bomb(path, size):
    """A member of zeros, deflated a thousandfold, declared with its true size."""
    zeros = zlib.compressobj(9, zlib.DEFLATED, -15)
    chunk, packed, crc = bytes(1 << 20), bytearray(), 0
    for _ in range(size >> 20):
        packed += zeros.compress(chunk)
        crc = zlib.crc32(chunk, crc)
    packed += zeros.flush()
    name = b"states/scales.npy"
    sizes = crc, len(packed), size
    head = LOCAL.pack(b"PK\x03\x04", 20, 0, 8, 0, 33, *sizes, len(name), 0) + name
    entry = CENTRAL.pack(b"PK\x01\x02", 20, 20, 0, 8, 0, 33, *sizes, len(name), 0, 0, 0, 0, 0, 0)
    body = head + packed
    end = END.pack(b"PK\x05\x06", 0, 0, 1, 1, len(entry + name), len(body), 0)
    path.write_bytes(body + entry + name + end)


def test_a_zip_bomb_is_not_unpacked(tmp_path):
    bomb(tmp_path / "m.odomap", 256 << 20)
    refused(tmp_path / "m.odomap", "would take 256 MB unpacked: refused")


def test_a_bomb_that_lies_about_its_size(tmp_path):
    path = tmp_path / "m.odomap"
    bomb(path, 128 << 20)
    data = path.read_bytes().replace(struct.pack("<L", 128 << 20), struct.pack("<L", 1000))
    start = data.rindex(b"PK\x01\x02")
    manifest = data[start:].replace(b"states/scales.npy", b"manifest.json    ")
    path.write_bytes(data[:start] + manifest)
    refused(path)
    lying = data.replace(b"states/scales.npy", b"manifest.json\x00\x00\x00\x00")
    lying = lying.replace(struct.pack("<HH", 17, 0), struct.pack("<HH", 13, 4))
    path.write_bytes(lying)
    refused(path)


def test_a_limit_can_be_given(tmp_path, good):
    (tmp_path / "m.odomap").write_bytes(good[0])
    with pytest.raises(InputError, match=r"would take 0 MB unpacked: refused .*0 MB"):
        load_map(tmp_path / "m.odomap", limit_mb=0.01)


@pytest.mark.parametrize("name", ["../../etc/passwd", "/etc/passwd", "states/extra", "C:\\x", "é"])
def test_members_that_are_no_part_of_a_map(tmp_path, good, name):
    _, manifest, arrays = good
    content = b"x"
    path = tmp_path / "m.odomap"
    encoded = name if name.isascii() else "e"
    rewritten(path, manifest, arrays, [(f"{encoded}.npy", content)])
    if not name.isascii():
        path.write_bytes(path.read_bytes().replace(b"e.npy\x78", b"\xe9.npy\x78"))
        data = path.read_bytes()
        at = data.rindex(b"e.npy", 0, data.rindex(b"manifest.json"))
        path.write_bytes(data[:at] + b"\xe9" + data[at + 1 :])
    refused(path, "is no part of a map")
    assert list(tmp_path.iterdir()) == [path]


def test_a_member_twice(tmp_path, good):
    _, manifest, arrays = good
    path = tmp_path / "m.odomap"
    rewritten(path, manifest, arrays, [("states/scales.npy", b"x")])
    refused(path, "'states/scales.npy': is there twice")


def test_a_member_over_another(tmp_path, good):
    data = bytearray(good[0])
    start = END.unpack(data[-END.size :])[6]
    first = CENTRAL.unpack_from(data, start)
    second = start + CENTRAL.size + first[10]
    struct.pack_into("<L", data, second + 42, 0)
    refused(_written(tmp_path / "m.odomap", data), "reaches into what comes after it")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"odomap_map": 4}, "is of version 4, this odomap reads 3: it was written by a newer"),
        ({"odomap_map": 0}, "has no version"),
        ({"odomap_map": True}, "has no version"),
        ({"odomap_map": "1"}, "has no version"),
        ({"arrays": []}, "arrays must be a mapping"),
        ({"counts": {"keyframes": 1}}, "counts must have the whole numbers"),
        ({"edge_kinds": [["a"]]}, "edge_kinds must be names"),
        ({"edge_kinds": ["a", "a"]}, "edge_kinds names a kind twice"),
        ({"edge_kinds": ["odometry"]}, "edges/kind: is none of those named"),
        ({"edge_kinds": ["a"] * 1000}, "edge_kinds must be a list"),
        ({"settings": [1]}, "settings must be a mapping"),
    ],
)
def test_manifests_that_cannot_be(tmp_path, good, change, message):
    _, manifest, arrays = good
    changed = {**manifest, **change}
    if "arrays" in change:
        path = tmp_path / "m.odomap"
        with open(path, "wb") as file:
            writer = ZipWriter(file)
            for name, array in arrays.items():
                writer.add(name, array)
            writer.close(changed)
    else:
        path = rewritten(tmp_path / "m.odomap", changed, arrays)
    refused(path, message)


@pytest.mark.parametrize(
    "text", [b"", b"[1]", b"{", b"[" * 900_000, b'{"a": NaN}', b'{"a": 1' + b"0" * 9000, b"\xff"]
)
def test_manifests_that_are_no_json(tmp_path, text):
    path = tmp_path / "m.odomap"
    with open(path, "wb") as file:
        writer = ZipWriter(file)
        writer._write("manifest.json", [text], False)
        writer.close({})
    data = path.read_bytes()  # take the second manifest out again, directory and all
    end = END.unpack(data[-END.size :])
    first = data[end[6] : end[6] + CENTRAL.size + 13]
    size = LOCAL.size + 13 + len(text)
    tail = END.pack(b"PK\x05\x06", 0, 0, 1, 1, len(first), size, 0)
    path.write_bytes(data[:size] + first + tail)
    refused(path, "manifest.json")


def test_numbers_of_the_map_that_cannot_be(tmp_path, good):
    _, manifest, arrays = good
    for name, value in (
        ("newest", 0),  # culled
        ("newest", 10**9),
        ("newest", -1),
        ("next_keyframe", 3),
        ("next_keyframe", 2**31),
        ("next_landmark", 5),
        ("next_landmark", 2**40),
        ("next_landmark", 2**100),
        ("version", 1),
        ("epoch", -(2**70)),
    ):
        numbers = {**manifest["numbers"], name: value}
        path = rewritten(tmp_path / "m.odomap", {**manifest, "numbers": numbers}, arrays)
        refused(path)
    counts = {**manifest["counts"], "landmarks": 7}
    path = rewritten(tmp_path / "m.odomap", {**manifest, "counts": counts}, arrays)
    refused(path, "counts are not")


def with_entry(name, index, value):
    def change(arrays):
        arrays[name][index] = value

    return change


def with_array(name, make):
    def change(arrays):
        arrays[name] = make(arrays[name])

    return change


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (with_entry("states/Ts_world_body", (4, 0, 3), NAN), "the pose 4 is not finite"),
        (with_entry("states/Ts_world_body", (4, 0, 0), 3.0), "the pose 4 is not finite or not"),
        (with_entry("states/scales", 4, 0.0), "the scale 4 is not finite and positive"),
        (with_entry("states/scales", 4, INF), "the scale 4 is not finite and positive"),
        (with_entry("states/v_world_body", 4, INF), "states/v_world_body"),
        (with_entry("tree/status", 4, 3), "tree/status"),
        (with_entry("tree/status", 0, 0), "of an id not in use"),
        (with_entry("tree/parent", 4, 5), "older than its parent: a cycle?"),
        (with_entry("tree/parent", 4, 4), "older than its parent: a cycle?"),
        (with_entry("tree/parent", 5, 0), "tree/parent: is not in the map"),
        (with_entry("tree/parent", 5, 10**12), "tree/parent: is not in the map"),
        (with_entry("tree/parent", 5, -1), "there are 2 roots"),
        (with_entry("tree/created", 5, 10**9), "tree/created"),
        (with_entry("tree/Ts_parent_self", (0, 1, 3), NAN), "tree: the pose 0"),
        (with_entry("landmarks/slot", 0, 7), "landmarks/slot"),
        (with_entry("landmarks/free", 0, 0), "landmarks/free"),
        (with_entry("landmarks/id", 1, 0), "landmarks/id"),
        (with_entry("landmarks/id", 1, -5), "landmarks/id"),
        (with_entry("landmarks/anchor", 1, 0), "landmarks/anchor"),
        (with_entry("landmarks/anchor", 1, 10**6), "landmarks/anchor"),
        (with_entry("landmarks/p_anchor", (1, 1), INF), "landmarks/p_anchor"),
        (with_entry("landmarks/seen", 1, -1), "landmarks/seen"),
        (with_entry("landmarks/expected", 1, -1), "landmarks/expected"),
        (with_entry("landmarks/fused", 0, 0), "landmarks/fused"),
        (with_entry("landmarks/survivor", 0, 1), "landmarks/survivor"),
        (with_entry("observations/keyframe", 0, 0), "observations/keyframe"),
        (with_entry("observations/keyframe", -1, 10**6), "observations/keyframe"),
        (with_entry("observations/landmark", 0, 10**15), "observations/landmark"),
        (with_entry("observations/keypoint", -1, 10**6), "observations/keypoint"),
        (with_entry("observations/keypoint", 0, -2), "observations/keypoint"),
        (with_entry("observations/by_landmark", 0, 1), "observations/by_landmark"),
        (with_array("observations/by_landmark", lambda a: a[::-1]), "observations/by_landmark"),
        (with_entry("edges/i", 0, 99), "edges/i"),
        (with_entry("edges/j", 0, -1), "edges/j"),
        (with_entry("edges/Ts_i_j", (0, 0, 0), NAN), "the pose of edge 0"),
        (with_entry("edges/scales_i_j", 0, -1.0), "the scale of edge 0"),
        (with_entry("edges/information", (0, 0, 0), INF), "edges/information"),
        (with_entry("edges/kind", 0, 9), "edges/kind"),
        (with_entry("features/keyframe", 0, 0), "features/keyframe"),
        (with_entry("features/rows", 0, 10**12), "features/rows"),
        (with_entry("features/rows", 0, -1), "features/rows"),
        (with_entry("features/rows", 0, 5), "features/"),
        (with_entry("features/width", 0, 10**9), "features/width"),
        (with_entry("imu/stamps_ns", 1, 0), "must increase"),
        (with_array("states/scales", lambda a: a[:-1]), "lengths do not match"),
        (with_array("states/Ts_world_body", lambda a: a.reshape(-1, 2, 8)), "do not match"),
        (with_array("states/scales", lambda a: a.astype("<f4")), "must be of type <f8"),
        (with_array("states/scales", lambda a: a.astype(">f8")), "must be of type <f8"),
        (with_array("states/scales", lambda a: a.reshape(-1, 1)), "do not match"),
        (lambda arrays: arrays.pop("edges/kind"), "edges/kind"),
        (lambda arrays: arrays.pop("features/level"), "features/level"),
    ],
)
def test_tables_that_do_not_fit(tmp_path, good, change, message):
    _, manifest, arrays = good
    arrays = {name: array.copy() for name, array in arrays.items()}
    change(arrays)
    manifest = {**manifest, "arrays": {n: manifest["arrays"][n] for n in arrays}}
    refused(rewritten(tmp_path / "m.odomap", manifest, arrays), message)


def test_object_arrays_are_never_unpickled(tmp_path, good):
    _, manifest, arrays = good

    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "trapped"), "w"))

    content = io.BytesIO()
    np.save(content, np.array([Trap()], object), allow_pickle=True)
    rest = {name: array for name, array in arrays.items() if name != "states/scales"}
    for kind, shape in (("|O", [1]), ("<f8", manifest["arrays"]["states/scales"]["shape"])):
        data = content.getvalue()
        if kind == "<f8":  # of the size that is declared, but an object array by its own header
            data = data[:128] + bytes(8 * shape[0])
        changed = copy.deepcopy(manifest)
        changed["arrays"]["states/scales"] = {
            "dtype": kind, "shape": shape, "crc32": zlib.crc32(data)
        }  # fmt: skip
        refused(
            rewritten(tmp_path / "m.odomap", changed, rest, [("states/scales.npy", data)]),
            "must be of type <f8" if kind == "|O" else "states/scales.npy: ",
        )
    assert not (tmp_path / "trapped").exists()


def use(m):
    """Do with a map what its users do; nothing may fail that was let in."""
    ids = m.landmark_ids
    assert np.isfinite(m.points_world(ids)).all()
    for k in m.keyframe_ids.tolist():
        m.covisible(k)
        m.observations_of(k)
    if m.num_keyframes > 1:
        snapshot = m.snapshot(m.keyframe_ids)
        m.apply(snapshot.solved(snapshot.Ts_world_body, snapshot.points_world))
        m.cull_keyframes(m.keyframe_ids[:1])
    if m.num_keyframes:
        m.add_landmarks(m.keyframe_ids[-1], np.zeros((3, 3)))
        m.fuse_landmarks(ids[:2], ids[1:3])


def read_or_refused(path):
    """Return whether a file is read; it is used then, and else refused with a line."""
    tracemalloc.start()
    line = "one line"
    try:
        m = load_map(path)
    except OdomapError as error:
        m, line = None, str(error)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < MEMORY
    assert "\n" not in line
    if m is not None:
        use(m)
    return m is not None


def test_fuzzed_bytes(tmp_path, good):
    rng = np.random.default_rng(0)
    data, path = good[0], tmp_path / "m.odomap"
    start = END.unpack(data[-END.size :])[6]
    read = 0
    for n in range(200):
        changed = bytearray(data)
        low = start if n % 2 else 0  # half of them in the directory
        for _ in range(int(rng.integers(1, 4))):
            at = int(rng.integers(low, len(data)))
            changed[at] = int(rng.integers(256))
        if n % 10 == 0:
            cut = int(rng.integers(len(data)))
            del changed[cut : cut + int(rng.integers(1, 100))]
        path.write_bytes(changed)
        read += read_or_refused(path)
    assert read < 60  # those that hit a date or a version, which say nothing


WILD = (0, 1, -1, 2, 7, 255, 2**15, 2**31 - 1, -(2**31), 2**40, 2**62, -(2**62))


def test_fuzzed_contents_with_true_checksums(tmp_path, good):
    rng = np.random.default_rng(1)
    _, manifest, arrays = good
    names, read = list(arrays), 0
    for _ in range(200):
        changed = dict(arrays)
        name = names[rng.integers(len(names))]
        array = changed[name] = arrays[name].copy()
        flat = array.reshape(-1)
        if len(flat) and rng.random() < 0.8:
            index = rng.integers(0, len(flat), 1 if rng.random() < 0.7 else 5)
            if array.dtype.kind == "f":
                wild = rng.choice([NAN, INF, -1.0, 0.0, 1e300, 1e-300, 0.5], len(index))
                with np.errstate(over="ignore"):
                    flat[index] = wild.astype(array.dtype)
            else:
                wild = np.array([WILD[i] for i in rng.integers(0, len(WILD), len(index))])
                flat[index] = wild.astype(array.dtype)
        elif len(array) > 1:
            changed[name] = array[rng.permutation(len(array))[: rng.integers(len(array) + 1)]]
        read += read_or_refused(rewritten(tmp_path / "m.odomap", manifest, changed))
    assert read > 5  # covariances, descriptors and the like may be anything


def test_fuzzed_manifests(tmp_path, good):
    rng = np.random.default_rng(2)
    _, manifest, arrays = good
    path = tmp_path / "m.odomap"
    values = [None, True, -1, 0, 10**30, 1.5, "x", [], {}, [1, 2], {"a": 1}, "../x", 2**31]
    for _ in range(100):
        with open(path, "wb") as file:
            writer = ZipWriter(file)
            for name, array in arrays.items():
                writer.add(name, array, packs=False)
            changed = json.loads(json.dumps({**manifest, "arrays": writer.arrays}))
            node = changed
            while True:
                keys = list(node) if isinstance(node, dict) else list(range(len(node)))
                if not keys:
                    break
                key = keys[rng.integers(len(keys))]
                if isinstance(node[key], dict | list) and rng.random() < 0.7:
                    node = node[key]
                    continue
                node[key] = values[rng.integers(len(values))]
                break
            writer.close(changed)
        read_or_refused(path)
