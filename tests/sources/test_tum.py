"""TUM RGB-D recordings, whole and broken."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from odomap.errors import CalibrationError, InputError
from odomap.files.calibrations import read_calibration
from odomap.geometry.pose import SE3
from odomap.sensors.rig import DepthMount, Rig
from odomap.sources.depth import check_factor, to_metres
from odomap.sources.describe import describe
from odomap.sources.open import open as open_source
from odomap.sources.source import Coloured, RandomAccess, UnusableFrame
from odomap.sources.tum import TumSource

Draw = Callable[..., NDArray[np.uint16]]
Save = Callable[[Path, NDArray[np.generic]], None]
Write = Callable[..., Path]
START_NS = 1305031229_500_000_000


def stamp(index: float, offset_ns: int = 0) -> str:
    ns = START_NS + round(index * 1e9 / 30) + offset_ns
    return f"{ns // 10**9}.{ns % 10**9 // 1000:06d}"


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def test_whole_recording(tum: Write) -> None:
    source = open_source(tum())
    assert isinstance(source, TumSource)
    assert isinstance(source, RandomAccess)
    assert isinstance(source, Coloured)
    assert (source.name, len(source), source.notes) == ("desk", 8, [])
    frames = list(source)
    assert source.skipped == []
    assert [frame.id for frame in frames] == list(range(8))
    # To the microsecond of the text, not to that of a float.
    assert frames[0].stamp_ns == START_NS
    assert [int(frame.images[0][0, 0]) for frame in frames] == list(range(8))
    for index in (7, 0, 3):
        frame = source.frame(index)
        assert frame.stamp_ns == frames[index].stamp_ns
        assert frame.depth[0, 0] == np.float32((5000 + index) / 5000)
        np.testing.assert_array_equal(frame.depth, frames[index].depth)
    with pytest.raises(IndexError):
        source.frame(8)


def test_depth_in_metres(tum: Write) -> None:
    depth = TumSource(tum()).frame(2).depth
    assert depth.dtype == np.float32
    assert depth.shape == (48, 64)
    assert depth.flags.c_contiguous
    assert np.all(depth[10:14, 10:14] == 0)
    # The rig says that 65535 is no depth, either.
    assert np.all(depth[20:22, 20:22] == 0)
    np.testing.assert_allclose(depth[30], np.linspace(0.8, 3, 64), atol=1.1e-4)
    raw = np.array([[0, 1000, 65535]], np.uint16)
    assert to_metres(raw, DepthMount("c", 1000.0)).tolist() == [[0.0, 1.0, pytest.approx(65.535)]]


def test_colour(tum: Write) -> None:
    source = TumSource(tum())
    colour, grey = source.colour(3), source.frame(3).images[0]
    assert colour.shape == (48, 64, 3)
    assert colour.dtype == np.uint8
    # The file has blue at half of red; colour is red, green, blue.
    np.testing.assert_array_equal(colour[:, :, 0] // 2, colour[:, :, 2])
    assert np.abs(colour @ np.array([0.299, 0.587, 0.114]) - grey).max() <= 1
    with pytest.raises(IndexError):
        source.colour(-1)


def test_truth_is_that_of_the_body(tum: Write) -> None:
    root = tum()
    truth = TumSource(root).truth
    assert len(truth) == 9
    np.testing.assert_allclose(truth.positions[:, 0], np.arange(9) / 10, atol=1e-12)
    rig = read_calibration(root)
    mounted = replace(rig.cameras[0], T_body_camera=SE3.from_parts(np.eye(3), np.array([0, 0, 1])))
    truth = TumSource(root, replace(rig, cameras=(mounted,))).truth
    np.testing.assert_allclose(truth.positions[3], [0.3, 0, -1], atol=1e-12)


def test_facts(tum: Write) -> None:
    facts = describe(TumSource(tum()))
    assert facts["format"] == "tum"
    assert facts["depth"] == {
        "camera": "rgb",
        "factor": 5000.0,
        "frames": 8,
        "offset_median_ms": 3.0,
        "offset_largest_ms": 3.0,
    }


@pytest.mark.parametrize(
    ("name", "focal", "distorted"),
    [
        ("rgbd_dataset_freiburg1_xyz", 517.3, True),
        ("rgbd_dataset_Freiburg2_desk", 520.9, True),
        ("fr3_office", 535.4, False),
    ],
)
def test_known_cameras_by_the_name(
    tum: Write, save_image: Save, name: str, focal: float, distorted: bool
) -> None:
    root = tum(name)
    (root / "rig.yaml").unlink()
    for folder, shape in (("rgb", (480, 640, 3)), ("depth", (480, 640))):
        for file in (root / folder).iterdir():
            kind = np.uint8 if folder == "rgb" else np.uint16
            save_image(file, np.full(shape, 200 if folder == "rgb" else 6000, kind))
    source = open_source(root)
    camera = source.rig.cameras[0].camera
    assert camera.fx == focal
    assert bool(np.any(camera.distortion)) == distorted
    assert source.rig.depth.factor == 5000.0
    assert source.frame(0).depth[5, 5] == np.float32(1.2)
    assert source.notes == [
        f"there is no rig.yaml: the published calibration of freiburg{camera_number(focal)} is used"
    ]
    # A folder that was renamed still says it in its listing.
    (root / "rgb.txt").write_text(
        f"# color images\n# file: '{name}.bag'\n" + (root / "rgb.txt").read_text()
    )
    assert TumSource(root.rename(root.parent / "mine")).rig == source.rig


def camera_number(focal: float) -> int:
    return {517.3: 1, 520.9: 2, 535.4: 3}[focal]


def test_no_calibration(tum: Write) -> None:
    root = tum()
    (root / "rig.yaml").rename(root.parent / "mine.yaml")
    with pytest.raises(CalibrationError, match=r"desk: there is no calibration.*odomap calibrate"):
        open_source(root)
    assert len(open_source(root, root.parent / "mine.yaml")) == 8
    assert len(TumSource(root, read_calibration(root.parent / "mine.yaml"))) == 8


def test_calibration_for_another_resolution(tum: Write) -> None:
    root = tum()
    edit(root / "rig.yaml", "[64, 48]", "[640, 480]")
    edit(root / "rig.yaml", "60, 60, 32, 24", "600, 600, 320, 240")
    with pytest.raises(CalibrationError) as caught:
        TumSource(root)
    text = str(caught.value)
    assert "images are 64x48, but camera 'rgb' is calibrated for 640x480" in text
    assert "(intrinsics scale by 0.1)" in text


def test_calibration_without_depth(tum: Write) -> None:
    root = tum()
    rig = replace(read_calibration(root), depth=None)
    source = TumSource(root, rig)
    assert source.rig.depth == DepthMount("rgb", 5000.0)
    assert source.notes == [
        "the given rig: says nothing of depth: the factor of TUM (5000) is used"
    ]


def test_calibration_of_two_cameras(tum: Write) -> None:
    root = tum()
    one = read_calibration(root).cameras[0]
    with pytest.raises(CalibrationError, match=r"the given rig: has 2 cameras, but .* has one"):
        TumSource(root, Rig((one, replace(one, name="other"))))


def test_depth_of_another_size(tum: Write, save_image: Save, draw_depth: Draw) -> None:
    root = tum()
    for file in (root / "depth").iterdir():
        save_image(file, draw_depth(0)[::2, ::2])
    with pytest.raises(CalibrationError) as caught:
        TumSource(root)
    text = str(caught.value)
    assert text.startswith(f"{root}/depth/{stamp(0, 3_000_000)}.png: depth is 32x24, but colour")
    assert "64x48: depth must be registered to the colour camera; export it aligned" in text


def test_one_depth_of_another_size_costs_that_depth(
    tum: Write, save_image: Save, draw_depth: Draw
) -> None:
    root = tum()
    save_image(root / f"depth/{stamp(2, 3_000_000)}.png", draw_depth(2)[::2, ::2])
    source = TumSource(root)
    frames = list(source)
    assert [frame.id for frame in frames if frame.depth is None] == [2]
    assert len(frames) == 8
    (skipped,) = source.skipped
    assert skipped.reason == "depth is 32x24, expected 64x48: the frame has no depth"


@pytest.mark.parametrize(
    ("channels", "message"),
    [(1, "has 8 bits: depth is stored with 16"), (3, "has 3 channels: depth is stored as one")],
)
def test_depth_that_is_none(tum: Write, save_image: Save, channels: int, message: str) -> None:
    root = tum()
    shape = (48, 64) if channels == 1 else (48, 64, 3)
    for file in (root / "depth").iterdir():
        save_image(file, np.full(shape, 90, np.uint8))
    with pytest.raises(InputError, match=rf"\.png: {message}.*no depth image can be used"):
        TumSource(root)


def test_broken_images(tum: Write) -> None:
    root = tum()
    for name in (f"rgb/{stamp(1)}.png", f"depth/{stamp(4, 3_000_000)}.png"):
        data = (root / name).read_bytes()
        (root / name).write_bytes(data[: len(data) // 2])
    (root / f"depth/{stamp(5, 3_000_000)}.png").unlink()
    source = TumSource(root)
    for _ in range(2):
        frames = list(source)
        assert [frame.id for frame in frames] == [0, 2, 3, 4, 5, 6, 7]
        assert [frame.id for frame in frames if frame.depth is None] == [4, 5]
        assert [item.reason for item in source.skipped] == [
            "PNG is truncated",
            "PNG is truncated: the frame has no depth",
            "file is missing: the frame has no depth",
        ]
    with pytest.raises(UnusableFrame, match="PNG is truncated"):
        source.frame(1)
    with pytest.raises(UnusableFrame, match="PNG is truncated"):
        source.colour(1)
    assert source.frame(4).depth is None
    assert len(source.skipped) == 3


def test_no_image_can_be_read(tum: Write) -> None:
    root = tum()
    for file in (root / "rgb").iterdir():
        file.write_bytes(b"")
    with pytest.raises(InputError, match="no image can be read"):
        TumSource(root)


def test_depth_of_another_clock(tum: Write) -> None:
    root = tum(lag_ns=3600_000_000_000)
    with pytest.raises(InputError) as caught:
        TumSource(root)
    text = str(caught.value)
    assert text.startswith(f"{root}/depth.txt: no depth within 16.7 ms of a colour image: depth ")
    assert "begins 3600 s after colour: if their clocks differ by that" in text


def test_depth_that_is_shifted_by_whole_frames(tum: Write) -> None:
    root = tum(lag_ns=5 * 33_333_333)  # each depth pairs well, with the colour of another time
    notes = TumSource(root).notes
    assert notes[0].startswith("depth.txt: depth begins 0.167 s after colour, and ends 0.167 s")
    assert "clocks differ" in notes[0]
    assert "5 of 8 colour images have no depth" in notes[1]


def test_a_bad_row_names_its_file(tum: Write) -> None:
    root = tum()
    (root / "rgb.txt").write_text((root / "rgb.txt").read_text() + "hello world\n")
    (skipped,) = TumSource(root).skipped
    assert skipped.file == str(root / "rgb.txt")
    assert skipped.reason.endswith("stamp 'hello' is not a number")


def test_depth_that_lags(tum: Write) -> None:
    root = tum(lag_ns=12_000_000)
    (note,) = TumSource(root).notes
    assert note.startswith("depth.txt: depth is 12 ms behind colour in most frames (33.3 ms apart)")
    assert "'time_offset_s: 0.0120'" in note
    edit(root / "rig.yaml", "name: rgb,", "name: rgb, time_offset_s: 0.0120,")
    source = TumSource(root)
    assert source.notes == []
    assert source.stamps_ns[0] == START_NS + 12_000_000
    (note,) = TumSource(tum("other", lag_ns=-12_000_000)).notes
    assert "depth is 12 ms ahead of colour" in note


def test_missing_depths(tum: Write) -> None:
    root = tum()
    lines = (root / "depth.txt").read_text().splitlines()
    (root / "depth.txt").write_text("\n".join(lines[:3] + lines[6:]) + "\n")
    source = TumSource(root)
    assert [frame.depth is None for frame in source] == [False] * 2 + [True] * 3 + [False] * 3
    assert source.notes == [
        "3 of 8 colour images have no depth within 16.7 ms: those frames have none"
    ]
    assert source.frame(5).depth[0, 0] == np.float32(5005 / 5000)
    assert describe(source)["depth"]["frames"] == 5


def test_no_depth_at_all(tum: Write) -> None:
    root = tum()
    (root / "depth.txt").unlink()
    (root / "depth").rename(root / "away")
    source = open_source(root)
    assert source.notes == ["depth.txt and depth/ are missing: the recording is monocular"]
    assert source.rig.depth is None
    assert all(frame.depth is None for frame in source)


def test_missing_listings(tum: Write) -> None:
    root = tum()
    (root / "rgb.txt").unlink()
    (root / "depth.txt").unlink()
    source = open_source(root)
    assert isinstance(source, TumSource)
    assert source.notes == [
        f"{kind}.txt is missing: stamps are taken from the names of the images"
        for kind in ("rgb", "depth")
    ]
    assert source.stamps_ns[0] == START_NS
    assert [frame.depth[0, 0] for frame in source] == [
        np.float32((5000 + i) / 5e3) for i in range(8)
    ]


@pytest.mark.parametrize(
    ("stored", "said", "words"),
    [
        (
            5000.0,
            1000.0,
            r"depths are 4 to 15 m with factor 1000: is it 5000 \(then 0.8 to 3 m\)\?$",
        ),
        (
            1000.0,
            5000.0,
            r"depths are 0.16 to 0.6 m with factor 5000: is it 1000 \(then 0.8 to 3 m\)\?$",
        ),
        (2000.0, 10.0, r"depths are 160 to 600 m with factor 10, which cannot be: is it 1000"),
        (1000.0, 60000.0, r"0.0\d* to 0.0\d* m with factor 60000, which cannot be: is it 1000"),
    ],
)
def test_factor_that_cannot_be(tum: Write, stored: float, said: float, words: str) -> None:
    root = tum(factor=stored)
    edit(root / "rig.yaml", "factor: 5000.0", f"factor: {said}")
    if "cannot be" in words:
        with pytest.raises(CalibrationError, match=words) as caught:
            TumSource(root)
        assert str(caught.value).startswith(f"{root}/rig.yaml: depth: ")
    else:
        (note,) = TumSource(root).notes
        assert re.match(words, note)


def test_factors_that_can_be() -> None:
    rng = np.random.default_rng(0)
    for nearest, farthest in ((0.3, 4.0), (0.5, 1.5), (1.0, 10.0)):
        metres = rng.uniform(nearest, farthest, 5000)
        for factor in (1000.0, 5000.0):
            assert check_factor(np.round(metres * factor).astype(np.uint16), factor, "rig") == ""
    assert "nothing is measured" in check_factor(np.zeros(0, np.uint16), 5000.0, "rig")


def test_grey_and_jpeg_colour(tum: Write, save_image: Save) -> None:
    root = tum()
    for i in range(8):
        image = cv2.imread(str(root / f"rgb/{stamp(i)}.png"), cv2.IMREAD_GRAYSCALE)
        save_image(root / f"rgb/{stamp(i)}.jpg", image)
    edit(root / "rgb.txt", ".png", ".jpg")
    source = TumSource(root)
    colour = source.colour(0)
    assert colour.shape == (48, 64, 3)
    assert np.all(colour == source.frame(0).images[0][:, :, None])


def test_truth_of_another_time(tum: Write) -> None:
    root = tum()
    (root / "groundtruth.txt").write_text("1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n")
    source = TumSource(root)
    assert source.truth is None
    assert "does not overlap the images" in source.notes[0]
    (root / "groundtruth.txt").write_text("1.0 0 0\n")
    source = TumSource(root)
    assert source.truth is None
    assert "ground truth ignored" in source.notes[0]
