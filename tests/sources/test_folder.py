"""Folders of images: order, times, pairs, and what is missing."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from odomap.errors import CalibrationError, InputError
from odomap.files.calibrations import read_calibration
from odomap.sources.filenames import in_order
from odomap.sources.folder import FolderSource
from odomap.sources.open import open as open_source
from odomap.sources.source import Coloured, RandomAccess

Fill = Callable[..., Path]
SIZE = (64, 48)
NO_TIMES = "neither times.txt nor the names tell when images were taken: they are taken to be "
PAIR = """odomap_rig: 1
cameras:
  - {name: a, intrinsics: [60, 60, 32, 24], resolution: [64, 48], rate_hz: 20.0}
  - {name: b, intrinsics: [60, 60, 32, 24], resolution: [64, 48], rate_hz: 20.0,
     T_body_camera: [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
"""


@pytest.fixture
def fill(
    tmp_path: Path,
    save_image: Callable[..., None],
    draw: Callable[..., NDArray[np.uint8]],
    calibrate: Fill,
) -> Fill:
    """Return what fills a folder with images of these names, numbered as they are given."""

    def write(names: list[str], folder: str = "frames", camera: int = 0, rate: float = 0) -> Path:
        path = tmp_path / folder
        for index, name in enumerate(names):
            save_image(path / name, draw(index, camera))
        if "/" not in folder:
            calibrate(path / "rig.yaml", SIZE, rate)
        return path

    return write


def shown(source: FolderSource) -> list[tuple[int, ...]]:
    """Return which picture of which camera the images of each frame are."""
    return [
        tuple(int(v) for image in frame.images for v in (image[0, 0], image[0, 4])[:2])
        for frame in source
    ]


def test_natural_order() -> None:
    names = ["b2.png", "a10.png", "a9.png", "A1.png", "a09.png", "b.png", "7.png", "10.png"]
    expected = "7.png 10.png A1.png a09.png a9.png a10.png b2.png b.png"
    assert in_order(names) == expected.split()
    assert in_order(["f10.png", "f9.png", "f100.png"]) == ["f9.png", "f10.png", "f100.png"]


def test_counted_images_come_at_the_rate(fill: Fill) -> None:
    root = fill([f"frame{i}.png" for i in range(8, 13)])
    source = open_source(root)
    assert isinstance(source, FolderSource)
    assert isinstance(source, RandomAccess)
    assert isinstance(source, Coloured)
    assert source.name == "frames"
    # 8, 9, 10, 11, 12: not 10, 11, 12, 8, 9.
    assert shown(source) == [(i, 0) for i in range(5)]
    assert source.stamps_ns.tolist() == [round(i * 1e9 / 30) for i in range(5)]
    assert source.notes == [f"{NO_TIMES}33.33 ms apart (set rate_hz in rig.yaml if that is wrong)"]
    assert source.colour(2).shape == (48, 64, 3)
    fill([], rate=20.0)
    source = open_source(root)
    assert source.stamps_ns.tolist() == [i * 50_000_000 for i in range(5)]
    assert source.notes == [f"{NO_TIMES}50 ms apart (rate_hz of the calibration)"]


def test_missing_numbers_leave_gaps(fill: Fill) -> None:
    numbers = [3, 4, 5, 8, 9]
    source = FolderSource(fill([f"{i:06d}.png" for i in numbers], rate=10.0))
    assert (source.stamps_ns // 100_000_000).tolist() == [0, 1, 2, 5, 6]
    # Every tenth image of a video is a step of one.
    source = FolderSource(fill([f"{i:06d}.png" for i in (0, 10, 20, 40)], "tens", rate=10.0))
    assert (source.stamps_ns // 100_000_000).tolist() == [0, 1, 2, 4]


def test_numbers_without_sense_are_not_gaps(fill: Fill) -> None:
    names = [f"IMG_{n}.png" for n in (1, 2, 5000, 5001)]
    source = FolderSource(fill(names, rate=10.0))
    assert (source.stamps_ns // 100_000_000).tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("name", "first", "step"),
    [
        (lambda i: f"{1403636584763555584 + i * 50_000_000}.png", 1403636584763555584, 5e7),
        (lambda i: f"{1403636584763555 + i * 50_000}.png", 1403636584763555000, 5e7),
        (lambda i: f"{1403636584763 + i * 50}.png", 1403636584763000000, 5e7),
        (lambda i: f"{1305031229.25 + i / 8:.6f}.png", 1305031229250000000, 1.25e8),
        (lambda i: f"cam_{i * 33_333_333}.png", 0, 33_333_333),
        (lambda i: f"cam_{i * 33_333}.png", 0, 33_333_000),
        (lambda i: f"t{i * 0.04:.3f}.png", 0, 4e7),
    ],
)
def test_names_that_are_times(
    fill: Fill, name: Callable[[int], str], first: int, step: float
) -> None:
    source = FolderSource(fill([name(i) for i in range(6)]))
    assert source.stamps_ns.tolist() == [first + round(i * step) for i in range(6)]
    assert source.notes == []
    assert shown(source) == [(i, 0) for i in range(6)]


@pytest.mark.parametrize("file", ["times.txt", "timestamps.txt"])
def test_file_of_times(fill: Fill, file: str) -> None:
    root = fill([f"{i}.png" for i in range(4)])
    (root / file).write_text("# seconds\n0.5\n0.6\n0.8\n1.1\n")
    source = FolderSource(root)
    assert source.stamps_ns.tolist() == [500_000_000, 600_000_000, 800_000_000, 1_100_000_000]
    assert source.notes == []
    (root / file).write_text("1403636584763555584\n1403636584813555584\n1403636584863555584\n")
    source = FolderSource(root)
    assert source.stamps_ns.tolist() == [1403636584763555584 + i * 50_000_000 for i in range(3)]
    assert source.skipped[0].reason == f"{file} has no time for it"
    assert "stamps are in nanoseconds, not in seconds: converted" in source.notes[-1]


@pytest.mark.parametrize("row", ["{name} {time}", "{time} {name}", "{time} images/{name}"])
def test_times_with_names(fill: Fill, row: str) -> None:
    names = ["c.png", "a.png", "d.png", "b.png"]
    root = fill(names)
    lines = [row.format(name=name, time=f"{i / 10}") for i, name in enumerate(names) if i != 2]
    (root / "times.txt").write_text("\n".join(lines))
    source = FolderSource(root)
    # The order is that of the times, not of the names.
    assert shown(source) == [(0, 0), (1, 0), (3, 0)]
    assert source.stamps_ns.tolist() == [0, 100_000_000, 300_000_000]
    assert [item.file for item in source.skipped] == ["d.png"]


def test_times_of_numbered_images(fill: Fill) -> None:
    root = fill([f"{i:04d}.png" for i in (0, 1, 3)])
    (root / "times.txt").write_text("0\n.1\n.2\n.3\n")
    # One that is missing shifts nothing.
    assert FolderSource(root).stamps_ns.tolist() == [0, 100_000_000, 300_000_000]


def test_times_that_do_not_fit(fill: Fill) -> None:
    root = fill(["a.png", "b.png", "c.png"])
    (root / "times.txt").write_text("0\n.1\n")
    source = FolderSource(root)
    assert source.notes == ["times.txt has 2 times for 3 images"]
    assert len(list(source)) == 2
    (root / "times.txt").write_text("# none\n")
    with pytest.raises(InputError, match=r"times\.txt: 0 times for 3 images: none matches"):
        FolderSource(root)


def test_pair_by_name(fill: Fill, tmp_path: Path) -> None:
    fill(["1.png", "2.png", "10.png"], "rec/left")
    fill(["2.png", "10.png", "11.png"], "rec/right", camera=1)
    (tmp_path / "rec/rig.yaml").write_text(PAIR)
    source = open_source(tmp_path / "rec")
    assert isinstance(source, FolderSource)
    assert shown(source) == [(1, 0, 0, 1), (2, 0, 1, 1)]
    assert [(item.file, item.reason) for item in source.skipped] == [
        ("left/1.png", "has no partner in right"),
        ("right/11.png", "has no partner in left"),
    ]
    left, right = source.rig.stereo_pair()
    assert right.T_body_camera.t[0] - left.T_body_camera.t[0] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ([f"L{i}.png" for i in (7, 8, 12)], [f"R_{i:04d}.png" for i in (7, 8, 12)]),
        (
            [f"{1403636584763555584 + i * 50_000_000}.png" for i in range(3)],
            [f"{1403636584763555584 + i * 50_000_000 + 1_000_000}.png" for i in range(3)],
        ),
    ],
)
def test_pair_by_number_or_stamp(
    fill: Fill, tmp_path: Path, left: list[str], right: list[str]
) -> None:
    # The folders are named as the cameras of the rig.
    fill(left, "rec/a")
    fill(right, "rec/b", camera=1)
    (tmp_path / "rec/rig.yaml").write_text(PAIR)
    source = open_source(tmp_path / "rec")
    assert shown(source) == [(i, 0, i, 1) for i in range(3)]
    assert source.skipped == []


def test_pair_without_pairs(fill: Fill, tmp_path: Path) -> None:
    fill(["1.png", "2.png"], "rec/left")
    fill(["11.png", "12.png"], "rec/right")
    (tmp_path / "rec/rig.yaml").write_text(PAIR)
    with pytest.raises(InputError, match=r"right: no image has the name, number or stamp of one"):
        open_source(tmp_path / "rec")


def test_counts_of_cameras_that_differ(fill: Fill, tmp_path: Path, calibrate: Fill) -> None:
    fill(["1.png", "2.png"], "rec/left")
    (tmp_path / "rec/rig.yaml").write_text(PAIR)
    with pytest.raises(CalibrationError, match=r"rec/rig\.yaml: has 2 cameras, but .* of one"):
        open_source(tmp_path / "rec")
    fill(["1.png", "2.png"], "rec/right", camera=1)
    calibrate(tmp_path / "rec/rig.yaml", SIZE)
    source = open_source(tmp_path / "rec")
    assert shown(source) == [(0, 0), (1, 0)]
    assert source.notes[0] == "the calibration has one camera: only left is used"


def test_images_in_a_folder_inside(fill: Fill, tmp_path: Path, calibrate: Fill) -> None:
    fill(["1.png", "2.png"], "rec/images")
    calibrate(tmp_path / "rec/rig.yaml", SIZE)
    (tmp_path / "rec/times.txt").write_text("0\n.2\n.7\n")
    source = open_source(tmp_path / "rec")
    assert source.name == "rec"
    assert source.stamps_ns.tolist() == [200_000_000, 700_000_000]


def test_calibration(fill: Fill, tmp_path: Path, calibrate: Fill) -> None:
    root = fill(["1.png", "2.png"])
    (root / "rig.yaml").rename(tmp_path / "mine.yaml")
    with pytest.raises(CalibrationError, match=r"frames: there is no calibration.*odomap calibr"):
        open_source(root)
    assert len(open_source(root, tmp_path / "mine.yaml")) == 2
    rig = read_calibration(calibrate(tmp_path / "double.yaml", (128, 96)))
    with pytest.raises(CalibrationError, match=r"are 64x48, but .* for 128x96.*scale by 0\.5\)"):
        FolderSource(root, rig)


def test_truth(fill: Fill) -> None:
    root = fill([f"{i}.png" for i in range(4)], rate=10.0)
    (root / "groundtruth.txt").write_text("0 1 0 0 0 0 0 1\n0.5 2 0 0 0 0 0 1\n")
    assert FolderSource(root).truth.positions[:, 0].tolist() == [1, 2]
    (root / "groundtruth.txt").write_text("100 1 0 0 0 0 0 1\n101 2 0 0 0 0 0 1\n")
    source = FolderSource(root)
    assert source.truth is None
    assert "does not overlap" in source.notes[-1]


def test_broken_image_costs_its_frame(fill: Fill) -> None:
    root = fill([f"{i}.png" for i in range(5)])
    data = (root / "2.png").read_bytes()
    (root / "2.png").write_bytes(data[:200])
    source = FolderSource(root)
    assert [frame.id for frame in source] == [0, 1, 3, 4]
    assert [item.reason for item in source.skipped] == ["PNG is truncated"]


def test_folders_that_are_none(fill: Fill, tmp_path: Path, calibrate: Fill) -> None:
    for name in ("one", "two"):
        fill(["1.png"], f"rec/{name}")
    calibrate(tmp_path / "rec/rig.yaml", SIZE)
    with pytest.raises(InputError, match=r"holds folders of images \(one, two\): open one of"):
        open_source(tmp_path / "rec")
    with pytest.raises(InputError, match="holds no images, nor folders 'left' and 'right'"):
        FolderSource(tmp_path / "rec")


def test_part_of_a_recording_needs_a_calibration(euroc: Fill, calibrate: Fill) -> None:
    mav0 = euroc()
    with pytest.raises(InputError, match="is a part of a recording"):
        open_source(mav0 / "cam0/data")
    rig = calibrate(mav0.parent / "mine.yaml", SIZE)
    source = open_source(mav0 / "cam0/data", rig)
    assert isinstance(source, FolderSource)
    assert source.stamps_ns[0] == 1403636584763555584
