"""Vocabulary files: read back exactly, DBoW2's text too; broken and hostile ones are refused."""

import copy
import gzip
import json
import lzma
import pickle
import tracemalloc
import zlib

import numpy as np
import pytest

from odomap.errors import InputError, OutputError
from odomap.files.vocabulary import Vocabulary, default_vocabulary_path
from odomap.files.ziplayout import LOCAL
from odomap.files.zipreader import ZipReader
from odomap.files.zipwriter import ZipWriter

MEMORY = 40 << 20


@pytest.fixture(scope="module")
def images():
    rng = np.random.default_rng(3)
    return [rng.integers(0, 256, (40, 32), dtype=np.uint8) for _ in range(20)]


@pytest.fixture(scope="module")
def vocabulary(images):
    return Vocabulary.train(images, branching=6, depth=3)


@pytest.fixture(scope="module")
def good(tmp_path_factory, vocabulary):
    """Bytes of a file, its manifest and its arrays."""
    path = tmp_path_factory.mktemp("words") / "good.odomap-vocabulary"
    vocabulary.save(path)
    arrays = {
        "nodes/centres": vocabulary.centres,
        "nodes/num_children": vocabulary.num_children.astype(np.uint8),
        "words/weights": vocabulary.weights.astype(np.float32),
    }
    with ZipReader(path) as archive:
        return path.read_bytes(), archive.manifest, arrays


def rewritten(path, manifest, arrays, packs=True, **changes):
    """Write a file whose checksums are right, whatever it says."""
    manifest = {**copy.deepcopy(manifest), **changes}
    with open(path, "wb") as file:
        writer = ZipWriter(file)
        for name, array in arrays.items():
            writer.add(name, array, packs=packs)
        for name, entry in writer.arrays.items():
            manifest["arrays"].setdefault(name, entry)
            manifest["arrays"][name]["crc32"] = entry["crc32"]
        writer.close(manifest)
    return path


def refused(path, message, read=Vocabulary.load):
    """Assert that a file is refused in one line that names it, without much memory."""
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as caught:
            read(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    text = str(caught.value)
    assert text.startswith(f"{path}"), text
    assert "\n" not in text
    assert message in text
    assert "map file" not in text
    assert len(text) < 400
    assert peak < MEMORY, f"{peak / 2**20:.0f} MB"


def test_what_is_saved_is_loaded_to_the_last_bit(tmp_path, vocabulary, images):
    path = tmp_path / "words.odomap-vocabulary"
    vocabulary.save(path)
    again = Vocabulary.load(path)
    assert np.array_equal(again.centres, vocabulary.centres)
    assert np.array_equal(again.num_children, vocabulary.num_children)
    assert np.array_equal(again.weights, vocabulary.weights.astype(np.float32))
    for name in ("branching", "depth", "num_images", "num_words", "fingerprint"):
        assert getattr(again, name) == getattr(vocabulary, name)
    before, after = vocabulary.transform(images[0]), again.transform(images[0])
    assert before.words.tolist() == after.words.tolist()
    assert before.weights == pytest.approx(after.weights, rel=1e-6)
    again.save(tmp_path / "again.odomap-vocabulary")
    assert (tmp_path / "again.odomap-vocabulary").read_bytes() == path.read_bytes()


def test_the_vocabulary_that_comes_along():
    vocabulary = Vocabulary.load()
    assert default_vocabulary_path().stat().st_size < 5_000_000
    assert vocabulary.num_words > 90_000
    assert (vocabulary.branching, vocabulary.depth) == (10, 5)
    assert vocabulary.weights.max() == pytest.approx(np.log(vocabulary.num_images), abs=1e-3)


def test_fingerprints_tell_vocabularies_apart(vocabulary, images):
    other = Vocabulary.train(images, branching=6, depth=3, seed=1)
    assert other.fingerprint != vocabulary.fingerprint
    assert Vocabulary.train(images, branching=6, depth=3).fingerprint == vocabulary.fingerprint


def test_a_file_that_cannot_be_written(tmp_path, vocabulary):
    with pytest.raises(OutputError, match="create it first"):
        vocabulary.save(tmp_path / "none" / "w.odomap-vocabulary")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "is empty"),
        (b"10 6 0 0\n", "is no vocabulary file (no zip)"),
        (b"PK\x03\x04", "its end is missing"),
        (pickle.dumps({"a": np.zeros(3)}), "is no vocabulary file"),
    ],
)
def test_what_is_no_vocabulary(tmp_path, data, message):
    (tmp_path / "w").write_bytes(data)
    refused(tmp_path / "w", message)


def test_what_cannot_be_opened(tmp_path):
    refused(tmp_path / "none", "No such file")
    refused(tmp_path, "Is a directory")


def test_every_truncation_is_refused(tmp_path, good):
    data, path = good[0], tmp_path / "w"
    for length in [*range(1, 200, 7), *range(200, len(data), 997), len(data) - 1]:
        path.write_bytes(data[:length])
        with pytest.raises(InputError):
            Vocabulary.load(path)


def test_a_flipped_bit_is_found(tmp_path, good):
    data, path = bytearray(good[0]), tmp_path / "w"
    path.write_bytes(data)
    with ZipReader(path) as archive:
        members = list(archive.members.values())
    assert len(members) == 3
    for member in members:
        at = member.offset + LOCAL.size + len(member.name) + member.packed // 2
        data[at] ^= 0x10
        path.write_bytes(data)
        refused(path, f"{member.name}: ")
        data[at] ^= 0x10


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"odomap_vocabulary": 2}, "written by a newer odomap"),
        ({"odomap_vocabulary": "1"}, "no version"),
        ({"odomap_vocabulary": True}, "no version"),
        ({"descriptor_bits": 512}, "for descriptors of 512 bits"),
        ({"descriptor_bits": None}, "for descriptors of None bits"),
        ({"branching": 1}, "branching 1 must be"),
        ({"branching": 5}, "0 to 5 children"),
        ({"branching": 1e300}, "branching must be a whole number"),
        ({"depth": 2}, "more than 2 levels"),
        ({"depth": 10**9}, "depth must be a whole number"),
        ({"num_images": -1}, "num_images must be"),
        ({"arrays": []}, "nodes/centres is not declared"),
    ],
)
def test_a_manifest_that_cannot_be(tmp_path, good, changes, message):
    _, manifest, arrays = good
    path = tmp_path / "w"
    with open(path, "wb") as file:
        writer = ZipWriter(file)
        for name, array in arrays.items():
            writer.add(name, array)
        writer.close({**manifest, **changes})
    refused(path, message)


def test_another_map_of_numbers_is_no_tree(tmp_path, good):
    _, manifest, arrays = good
    path = tmp_path / "w"
    for at, value, message in ((0, 5, "no tree"), (-1, 1, "no tree"), (3, 200, "children")):
        children = arrays["nodes/num_children"].copy()
        children[at] = value
        refused(rewritten(path, manifest, {**arrays, "nodes/num_children": children}), message)
    for value in (np.nan, -1.0, np.inf):
        weights = arrays["words/weights"].copy()
        weights[7] = value
        refused(rewritten(path, manifest, {**arrays, "words/weights": weights}), "a weight is")
    refused(rewritten(path, manifest, {**arrays, "more": np.zeros(3)}), "is no part")
    few = {k: v for k, v in arrays.items() if k != "words/weights"}
    refused(rewritten(path, manifest, few), "words/weights.npy: is missing")


@pytest.mark.parametrize("shape", [[1 << 40, 32], [10**9, 32], [100, 64], [100], "x", [-1, 32]])
def test_an_absurd_shape_is_refused_unread(tmp_path, good, shape):
    _, manifest, arrays = good
    manifest = copy.deepcopy(manifest)
    manifest["arrays"]["nodes/centres"]["shape"] = shape
    refused(rewritten(tmp_path / "w", manifest, arrays), "nodes/centres")


def test_a_bomb_is_refused_unread(tmp_path, good):
    _, manifest, arrays = good
    bomb = {**arrays, "nodes/centres": np.zeros((3_000_000, 32), np.uint8)}
    manifest = copy.deepcopy(manifest)
    manifest["arrays"]["nodes/centres"]["shape"] = [3_000_000, 32]
    path = rewritten(tmp_path / "w", manifest, bomb)
    assert path.stat().st_size < 1_000_000
    del bomb
    refused(path, "MB unpacked: refused")


def test_a_pickled_array_is_not_read(tmp_path, good):
    _, manifest, arrays = good
    manifest = copy.deepcopy(manifest)
    path = tmp_path / "w"
    with open(path, "wb") as file:
        writer = ZipWriter(file)
        content = b"\x93NUMPY\x01\x00" + pickle.dumps(arrays["nodes/centres"])
        size = len(arrays["nodes/centres"]) * 32 + 128  # the size is right, the content is not
        content = content[:size].ljust(size, b"\0")
        writer._write("nodes/centres.npy", [content], False)
        manifest["arrays"]["nodes/centres"]["crc32"] = zlib.crc32(content)
        for name in ("nodes/num_children", "words/weights"):
            writer.add(name, arrays[name])
        writer.close(manifest)
    refused(path, "nodes/centres.npy")


# DBoW2's text


def rows(tree):
    """Return a tree as DBoW2 writes it, level by level: lines of text."""
    lines = [f"{tree.branching} {tree.depth} 0 0"]
    parents = np.repeat(np.arange(len(tree.num_children)), tree.num_children)
    words = tree.word_of_node
    for node, parent in enumerate(parents.tolist(), 1):
        leaf = tree.num_children[node] == 0
        weight = tree.weights[words[node]] if leaf else 0
        centre = " ".join(map(str, tree.centres[node].tolist()))
        lines.append(f"{parent} {int(leaf)} {centre}  {float(weight)!r}")
    return lines


def test_dbow2_text_is_the_same_tree(tmp_path, vocabulary):
    text = "\n".join(rows(vocabulary)) + "\n"
    packed = {"w.txt": text.encode(), "w.gz": gzip.compress(text.encode())}
    packed["w.xz"] = lzma.compress(text.encode())
    packed["blank.txt"] = text.encode() + b"\n"
    for name, data in packed.items():
        (tmp_path / name).write_bytes(data)
        read = Vocabulary.read_dbow2(tmp_path / name)
        assert np.array_equal(read.centres, vocabulary.centres)
        assert np.array_equal(read.num_children, vocabulary.num_children)
        assert np.array_equal(read.weights, vocabulary.weights)
        assert (read.branching, read.depth) == (6, 3)


def test_nodes_in_another_order_are_the_same_tree(tmp_path):
    # two nodes below the root; the first has leaves of bytes 1 and 2, the second is a leaf of 255;
    # written depth first, as recursive writers do
    def line(parent, leaf, byte, weight):
        return f"{parent} {leaf} {' '.join([str(byte)] * 32)} {weight}"

    lines = ["2 2 0 0", line(0, 0, 3, 0), line(1, 1, 1, 0.5), line(1, 1, 2, 1.5)]
    lines += [line(0, 1, 255, 2.5)]
    (tmp_path / "w.txt").write_text("\n".join(lines))
    tree = Vocabulary.read_dbow2(tmp_path / "w.txt")
    assert tree.centres[:, 0].tolist() == [0, 3, 255, 1, 2]
    assert tree.num_children.tolist() == [2, 2, 0, 0, 0]
    assert tree.weights.tolist() == [2.5, 0.5, 1.5]
    of = np.array([[1], [2], [254]], np.uint8).repeat(32, axis=1)
    assert tree.words_of(of).tolist() == [1, 2, 0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: ["hello"], ":1: is no vocabulary"),
        (lambda r: [""], ":1: is no vocabulary"),
        (lambda r: r[:1], "has no nodes"),
        (lambda r: ["999999 6 0 0", *r[1:]], ":1: branching 999999 must be"),
        (lambda r: ["6 99 0 0", *r[1:]], "depth 99 1 to 16"),
        (lambda r: ["6 3 0 2", *r[1:]], ":1: weighting 2 is not read"),
        (lambda r: ["3 3 0 0", *r[1:]], "its first line says 3"),
        (lambda r: ["6 2 0 0", *r[1:]], "more than 2 levels"),
        (lambda r: r[: len(r) // 2], "the file was cut off"),
        (lambda r: [*r[:9], r[9][:40], *r[10:]], ":10: has "),
        (lambda r: [*r[:9], r[9] + " 1 2 3", *r[10:]], ":10: has 38 numbers"),
        (lambda r: [*r[:9], r[9].replace(r[9].split()[5], "x", 1), *r[10:]], ":10: "),
        (lambda r: [*r[:9], "0 0 " + "256 " * 32 + "0", *r[10:]], ":10: must be a parent"),
        (lambda r: [*r[:9], "0 0 " + "1.5 " * 32 + "0", *r[10:]], ":10: must be a parent"),
        (lambda r: [*r[:9], "0 0 " + "1 " * 32 + "nan", *r[10:]], ":10: must be a parent"),
        (lambda r: [*r[:9], "500 0 " + "1 " * 32 + "0", *r[10:]], ":10: must be a parent"),
        (lambda r: [*r[:9], "9" * 5000, *r[10:]], ":10: has 1 numbers"),
    ],
)
def test_broken_dbow2_text(tmp_path, vocabulary, change, message):
    path = tmp_path / "w.txt"
    path.write_text("\n".join(change(rows(vocabulary))))
    refused(path, message, Vocabulary.read_dbow2)


def test_packed_dbow2_text_that_is_cut_off(tmp_path, vocabulary):
    data = "\n".join(rows(vocabulary)).encode()
    for name, pack in (("w.gz", gzip.compress), ("w.xz", lzma.compress)):
        path = tmp_path / name
        path.write_bytes(pack(data)[:-200])
        refused(path, "copy it again", Vocabulary.read_dbow2)
    refused(tmp_path / "none.txt", "No such file", Vocabulary.read_dbow2)


def test_a_long_line_that_was_packed_well_takes_no_memory(tmp_path):
    path = tmp_path / "w.gz"
    path.write_bytes(gzip.compress(b"10 6 0 0\n" + b"1" * (60 << 20), 1))
    assert path.stat().st_size < 2 << 20
    refused(path, ":2: has 1 numbers", Vocabulary.read_dbow2)


def test_the_manifest_is_plain_json(good):
    assert json.loads(json.dumps(good[1])) == good[1]
    assert good[1]["descriptor_bits"] == 256
