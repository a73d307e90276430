"""`odomap vocabulary`: from images to words, what it says, and what it refuses in one line."""

import json

import cv2
import numpy as np
import pytest

from odomap.cli import main
from odomap.files.vocabulary import SUFFIX, Vocabulary
from odomap.vision.orb import OrbConfig, extract


@pytest.fixture
def cli(capsys, tmp_path, monkeypatch):
    """Run the command line in an empty folder; return exit code, stdout and stderr."""
    monkeypatch.delenv("ODOMAP_DEBUG", raising=False)
    monkeypatch.chdir(tmp_path)

    def call(*words):
        code = main(["vocabulary", *map(str, words)])
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        return code, out, err

    return call


@pytest.fixture
def refused(cli):
    def call(*words, message):
        code, out, err = cli(*words)
        assert code == 2
        assert out == ""
        assert message in err
        assert err.startswith("odomap: ")
        assert err.count("\n") == 1

    return call


@pytest.fixture(scope="session")
def pictures(tmp_path_factory):
    """Two folders of pictures of two sizes, all of them different."""
    rng = np.random.default_rng(2)
    folder = tmp_path_factory.mktemp("pictures")
    for k in range(6):
        size = (120, 160) if k % 2 else (100, 140)
        image = np.full(size, 100, np.uint8)
        for _ in range(90):
            y, x = rng.integers(0, size[0]), rng.integers(0, size[1])
            image[y : y + rng.integers(4, 14), x : x + rng.integers(4, 14)] = rng.integers(0, 255)
        (folder / str(k % 2)).mkdir(exist_ok=True)
        cv2.imwrite(str(folder / str(k % 2) / f"{k}.png"), image)
    return folder


def test_images_become_words(cli, pictures, tmp_path):
    out = tmp_path / f"mine{SUFFIX}"
    words = "train", pictures / "0", pictures / "1" / "*.png", "--out", out, "--depth", 2
    code, text, err = cli(*words, "--branching", 6, "--features", 200, "--quiet")
    assert code == 0
    assert "images         6 of 6, " in text
    assert "6 images: they tell those places apart" in err
    vocabulary = Vocabulary.load(out)
    assert vocabulary.num_images == 6
    assert 12 < vocabulary.num_words <= 36
    assert f"{vocabulary.num_words}, of 256 bits" in text
    files = [*sorted((pictures / "0").iterdir()), *sorted((pictures / "1").iterdir())]
    read = [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files]
    found = [extract(image, OrbConfig(count=200)).descriptors for image in read]
    same = Vocabulary.train(found, branching=6, depth=2)
    assert np.array_equal(same.centres, vocabulary.centres)
    first = out.read_bytes()
    assert cli(*words, "--branching", 6, "--features", 200, "--quiet")[0] == 0
    assert out.read_bytes() == first


def test_fewer_images_than_there_are(cli, pictures):
    _, text, _ = cli("train", pictures / "0", pictures / "1", "--most", 3, "--depth", 1)
    assert "images         3 of 6, " in text


def test_recordings_and_worlds_are_taken(cli, pictures):
    world = "sim:room?seed=3&frames=2&resolution=160,120"
    code, text, _ = cli("train", world, pictures / "0" / "0.png", "--depth", 1, "--quiet")
    assert code == 0
    assert "images         3 of 3, " in text


def test_an_image_that_cannot_be_read_costs_itself(cli, pictures, tmp_path):
    (tmp_path / "bad.png").write_bytes(b"\x89PNG\r\n\x1a\nxx")
    code, text, err = cli("train", pictures / "0", tmp_path / "bad.png", "--depth", 1, "--quiet")
    assert code == 0
    assert "warning:" in err
    assert "bad.png" in err
    assert "images         3 of 4, " in text


def test_what_cannot_be_trained_on(refused, pictures, tmp_path):
    refused("train", message="IMAGES is missing")
    refused("train", tmp_path / "none", message="none")
    refused("train", tmp_path, message=str(tmp_path))
    refused("train", "no*.png", message="no picture has such a name")
    refused("train", pictures / "0" / "0.png", "--quiet", message="1 images with features")
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((100, 100), np.uint8))
    refused("train", tmp_path / "black.png", "--quiet", message="0 images with features")
    refused("train", pictures / "0", "--branching", 1, "--quiet", message="branching 1 must be")
    refused("train", pictures / "0", "--depth", 0, "--quiet", message="depth 0 must be")
    refused("train", pictures / "0", "--most", 0, message="--most 0: must be 1 or more")
    refused("train", pictures / "0", "--seed", -1, message="--seed -1: must be 0 or more")


def test_no_place_to_write_is_said_before_training(cli, pictures):
    for out in ("none/w.odomap-vocabulary", "."):
        code, _, err = cli("train", pictures / "0", "--out", out)
        assert code == 1
        assert "cannot be written" in err


def test_info_of_the_one_that_comes_along(cli):
    code, text, _ = cli("info")
    assert code == 0
    assert "98730, of 256 bits" in text
    assert "on 1621 images" in text
    facts = json.loads(cli("info", "--json")[1])
    assert facts["words"] == 98730
    assert facts["fingerprint"] == Vocabulary.load().fingerprint


def test_info_of_what_is_none(refused, tmp_path):
    (tmp_path / "w").write_bytes(b"hello")
    refused("info", tmp_path / "w", message="is no vocabulary file")


def test_dbow2_text_is_converted_and_cut(cli, refused, tmp_path):
    rows = ["2 2 0 0"]
    for parent, leaf, byte in ((0, 0, 0), (0, 1, 255), (1, 1, 1), (1, 1, 16)):
        rows.append(f"{parent} {leaf} {' '.join([str(byte)] * 32)} {leaf * 0.5}")
    (tmp_path / "w.txt").write_text("\n".join(rows))
    assert cli("convert", "w.txt")[0] == 0
    assert Vocabulary.load(f"words{SUFFIX}").num_words == 3
    code, text, _ = cli("convert", f"words{SUFFIX}", "--depth", 1, "--out", "few")
    assert code == 0
    assert "not said on how many images" in text
    assert Vocabulary.load("few").num_words == 2
    refused("convert", "w.txt", "--depth", 0, message="depth 0 must be")
    refused("convert", "none.txt", message="none.txt")


def test_what_cannot_be_parsed(refused):
    refused("trian", message="{train, info, convert}")
    refused(message="{train, info, convert}")
    refused("train", "--ou", "x", message="unknown option '--ou'")
