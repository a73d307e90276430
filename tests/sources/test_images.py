"""Images of every kind become grey, and broken ones say what is wrong with them."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from odomap.errors import InputError
from odomap.sources.images import (
    BadImage,
    ImageFormat,
    decode,
    find_mosaic,
    probe_format,
    read_image,
)

Save = Callable[[Path, NDArray[np.generic]], None]


def scene(seed: int = 0, size: tuple[int, int] = (160, 120)) -> NDArray[np.uint8]:
    """Return a smooth colour image with edges (BGR)."""
    rng = np.random.default_rng(seed)
    small = rng.uniform(30, 220, (12, 16, 3)).astype(np.float32)
    return np.clip(cv2.resize(small, size, interpolation=cv2.INTER_CUBIC), 0, 255).astype(np.uint8)


def mosaic(colour: NDArray[np.uint8], layout: str) -> NDArray[np.uint8]:
    """Sample a colour image (BGR) as a sensor with a Bayer layout such as RGGB does."""
    out = np.empty(colour.shape[:2], np.uint8)
    for place, letter in enumerate(layout):
        y, x = divmod(place, 2)
        out[y::2, x::2] = colour[y::2, x::2, "BGR".index(letter)]
    return out


def test_grey_is_read_as_it_is(tmp_path: Path, save_image: Save) -> None:
    image = cv2.cvtColor(scene(), cv2.COLOR_BGR2GRAY)
    save_image(tmp_path / "a.png", image)
    form = probe_format([tmp_path / "a.png"], "cam0")
    assert form == ImageFormat((160, 120))
    assert form.note == ""
    read = read_image(tmp_path / "a.png", form)
    assert read.dtype == np.uint8
    assert read.flags.c_contiguous
    assert np.array_equal(read, image)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif"])
def test_colour_becomes_grey(tmp_path: Path, save_image: Save, suffix: str) -> None:
    colour = scene()
    path = tmp_path / f"a{suffix}"
    save_image(path, colour)
    form = probe_format([path], "cam0")
    assert form.is_colour
    assert "colour images are converted to grey" in form.note
    grey = read_image(path, form)
    expected = cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY)
    assert np.abs(grey.astype(int) - expected).mean() < 2


def test_transparency_is_ignored(tmp_path: Path, save_image: Save) -> None:
    colour = scene()
    save_image(tmp_path / "a.png", cv2.cvtColor(colour, cv2.COLOR_BGR2BGRA))
    grey = read_image(tmp_path / "a.png", ImageFormat((160, 120)))
    assert np.array_equal(grey, cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY))


@pytest.mark.parametrize(("bits", "shift"), [(10, 2), (12, 4), (16, 8)])
def test_16_bits_are_scaled_alike_in_all_images(
    tmp_path: Path, save_image: Save, bits: int, shift: int
) -> None:
    grey = cv2.cvtColor(scene(), cv2.COLOR_BGR2GRAY).astype(np.uint16)
    bright, dark = grey << shift, (grey << shift) // 5
    bright[0, 0] = (1 << bits) - 1
    save_image(tmp_path / "a.png", bright)
    save_image(tmp_path / "b.png", dark)
    form = probe_format([tmp_path / "a.png", tmp_path / "b.png"], "cam0")
    assert form.bits == bits
    assert f"{bits} bits used" in form.note
    assert np.array_equal(read_image(tmp_path / "a.png", form)[1:], grey[1:])
    assert np.array_equal(read_image(tmp_path / "b.png", form), (dark >> shift).astype(np.uint8))


@pytest.mark.parametrize("layout", ["RGGB", "BGGR", "GRBG", "GBRG"])
@pytest.mark.parametrize("seed", range(3))
def test_mosaic_is_found_and_converted(
    tmp_path: Path, save_image: Save, layout: str, seed: int
) -> None:
    colour = scene(seed)
    # A sensor sees more green than red and blue.
    colour = (colour * [0.6, 1.0, 0.7]).astype(np.uint8)
    raw = mosaic(colour, layout)
    assert find_mosaic(raw) == ("main" if layout[0] == "G" else "anti")
    save_image(tmp_path / "a.png", raw)
    form = probe_format([tmp_path / "a.png"], "cam0")
    assert "Bayer" in form.note
    grey = read_image(tmp_path / "a.png", form)
    assert find_mosaic(grey) == ""
    # Red and blue may be exchanged, their weights differ; the pattern must be gone.
    expected = cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY).astype(int)
    assert np.abs(grey.astype(int) - expected)[2:-2, 2:-2].mean() < 12
    assert np.corrcoef(grey[2:-2, 2:-2].ravel(), expected[2:-2, 2:-2].ravel())[0, 1] > 0.95


@pytest.mark.parametrize("seed", range(5))
def test_grey_is_not_taken_for_a_mosaic(seed: int) -> None:
    rng = np.random.default_rng(seed)
    grey = cv2.cvtColor(scene(seed, (640, 480)), cv2.COLOR_BGR2GRAY)
    noisy = np.clip(grey + rng.normal(0, 8, grey.shape), 0, 255).astype(np.uint8)
    for image in (grey, noisy, rng.integers(0, 256, (480, 640), dtype=np.uint8)):
        assert find_mosaic(image) == ""
    assert find_mosaic(np.zeros((480, 640), np.uint8)) == ""
    assert find_mosaic(np.zeros((8, 8), np.uint8)) == ""
    # Stripes of the finest kind are no mosaic.
    stripes = np.tile(np.array([0, 200], np.uint8), (480, 320))
    assert find_mosaic(stripes) == ""


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("part", [0.0, 0.01, 0.3, 0.6, 0.9, 0.99])
def test_truncated_images_are_refused(
    tmp_path: Path, save_image: Save, suffix: str, part: float
) -> None:
    path = tmp_path / f"a{suffix}"
    save_image(path, scene())
    data = path.read_bytes()
    path.write_bytes(data[: int(part * len(data))])
    with pytest.raises(BadImage, match=r"truncated|empty|not an image"):
        decode(path)


def test_a_thumbnail_does_not_hide_that_a_jpeg_is_truncated(
    tmp_path: Path, save_image: Save
) -> None:
    path = tmp_path / "a.jpg"
    save_image(path, scene())
    data = path.read_bytes()
    thumbnail = b"\xff\xe1\x00\x0aExif\xff\xd8\xff\xd9"
    path.write_bytes(data[:2] + thumbnail + data[2:])
    assert decode(path).shape == (120, 160, 3)
    path.write_bytes(data[:2] + thumbnail + data[2 : len(data) * 3 // 4])
    with pytest.raises(BadImage, match="truncated"):
        decode(path)


def test_damaged_png_is_refused(tmp_path: Path, save_image: Save) -> None:
    path = tmp_path / "a.png"
    save_image(path, scene())
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)
    with pytest.raises(BadImage, match="damaged"):
        decode(path)


def test_other_files_are_refused(tmp_path: Path, save_image: Save) -> None:
    with pytest.raises(BadImage, match="missing"):
        decode(tmp_path / "none.png")
    with pytest.raises(BadImage, match="cannot be read"):
        decode(tmp_path)
    (tmp_path / "a.png").write_text("this is a text")
    with pytest.raises(BadImage, match="not an image"):
        decode(tmp_path / "a.png")
    save_image(tmp_path / "a.tiff", np.zeros((20, 20), np.float32))
    with pytest.raises(BadImage, match="float32 pixels"):
        decode(tmp_path / "a.tiff")


def test_another_size_is_refused(tmp_path: Path, save_image: Save) -> None:
    save_image(tmp_path / "a.png", scene()[:, :, 0])
    with pytest.raises(BadImage, match="image is 160x120, expected 320x240"):
        read_image(tmp_path / "a.png", ImageFormat((320, 240)))


def test_probe_passes_over_broken_images(tmp_path: Path, save_image: Save) -> None:
    paths = [tmp_path / f"{i}.png" for i in range(40)]
    for path in paths:
        path.write_bytes(b"")
    save_image(paths[20], scene()[:, :, 0])
    with pytest.raises(InputError, match=r"cam0: no image can be read \(.*file is empty"):
        probe_format(paths[:10], "cam0")
    save_image(paths[0], scene()[:, :, 0])
    assert probe_format(paths, "cam0").resolution == (160, 120)


def test_probe_takes_the_size_most_images_have(tmp_path: Path, save_image: Save) -> None:
    paths = [tmp_path / f"{i}.png" for i in range(5)]
    for path in paths:
        save_image(path, scene()[:, :, 0])
    save_image(paths[0], scene()[:60, :, 0])
    assert probe_format(paths, "cam0").resolution == (160, 120)
