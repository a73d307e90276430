"""Images from everywhere, evenly spaced, each read for itself."""

import cv2
import numpy as np
import pytest

from odomap.errors import InputError
from odomap.sources.gathering import Gathering


@pytest.fixture
def folder(tmp_path):
    """Ten pictures of ten sizes whose grey is their number."""
    for k in range(10):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((20 + k, 30), 10 * k, np.uint8))
    return tmp_path


def greys(gathering):
    return [int(picture.image[0, 0]) // 10 for picture in gathering]


def test_all_of_a_folder_a_pattern_and_a_file(folder):
    assert greys(Gathering([folder], 100)) == list(range(10))
    assert greys(Gathering([folder / "[3-5].png"], 100)) == [3, 4, 5]
    both = Gathering([folder / "7.png", folder / "[12].png"], 100)
    assert greys(both) == [7, 1, 2]
    assert len(both) == both.total == 3


def test_too_many_are_evenly_spaced_over_all_of_them(folder):
    gathering = Gathering([folder / "[0-4].png", folder / "[5-9].png"], 4)
    assert greys(gathering) == [0, 3, 6, 9]
    assert (len(gathering), gathering.total) == (4, 10)


def test_every_image_is_read_by_its_own_kind(folder):
    colour = np.zeros((40, 40, 3), np.uint8)
    colour[:] = (30, 30, 30)
    cv2.imwrite(str(folder / "10.png"), colour)
    cv2.imwrite(str(folder / "11.png"), np.full((10, 10), 40 << 8, np.uint16))
    images = [picture.image for picture in Gathering([folder / "1[01].png"], 9)]
    assert [image.shape for image in images] == [(40, 40), (10, 10)]
    assert all(image.dtype == np.uint8 for image in images)


def test_what_cannot_be_read_says_why(folder):
    (folder / "3.png").write_bytes(b"nothing")
    (folder / "4.png").write_bytes((folder / "4.png").read_bytes()[:-9])
    pictures = list(Gathering([folder], 100))
    bad = [picture for picture in pictures if picture.image is None]
    assert [picture.name for picture in bad] == [str(folder / "3.png"), str(folder / "4.png")]
    assert "not an image" in bad[0].reason
    assert "truncated" in bad[1].reason or "broken" in bad[1].reason
    assert len(pictures) == 10


def test_frames_of_a_world_are_chosen_too(folder):
    world = "sim:room?seed=1&frames=3&resolution=64,48"
    pictures = list(Gathering([world, folder / "0.png"], 2))
    assert [picture.image.shape for picture in pictures] == [(48, 64), (20, 30)]
    assert "frame 0" in pictures[0].name


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        ([], "IMAGES is missing"),
        (["none/*.png"], "no picture has such a name"),
        (["none"], "none"),
        (["camera:0"], "camera:0"),
    ],
)
def test_where_nothing_is(tmp_path, monkeypatch, inputs, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=message.replace("*", r"\*")):
        Gathering(inputs, 5)
