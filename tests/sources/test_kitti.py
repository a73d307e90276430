"""KITTI sequences, whole and broken."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from odomap.errors import CalibrationError, InputError
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig
from odomap.sources.kitti import KittiSource
from odomap.sources.source import RandomAccess

Make = Callable[..., Path]


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def shown(frame: Frame) -> list[tuple[int, int]]:
    """Return which picture of which camera the images of a frame are."""
    return [(int(image[0, 0]), int(image[0, 4])) for image in frame.images if image is not None]


def test_whole_sequence(kitti: Make) -> None:
    source = KittiSource(kitti())
    assert isinstance(source, RandomAccess)
    assert (source.name, len(source), source.notes) == ("07", 6, [])
    frames = list(source)
    assert [frame.stamp_ns for frame in frames] == [i * 100_000_000 for i in range(6)]
    assert [shown(frame) for frame in frames] == [[(i, 0), (i, 1)] for i in range(6)]
    assert shown(source.frame(4)) == [(4, 0), (4, 1)]
    assert source.skipped == []
    with pytest.raises(IndexError):
        source.frame(6)


def test_calibration(kitti: Make) -> None:
    left, right = KittiSource(kitti()).rig.stereo_pair()
    assert left.camera == right.camera
    assert left.camera.intrinsics.tolist() == [50, 50, 32, 24]
    assert left.camera.resolution == (64, 48)
    np.testing.assert_allclose(right.T_body_camera.t, [0.5, 0, 0])
    assert KittiSource(kitti()).rig.body_sensor == "image_0"


def test_truth_is_that_of_the_left_camera(kitti: Make) -> None:
    truth = KittiSource(kitti()).truth
    assert truth is not None
    assert truth.stamps_ns.tolist() == [i * 100_000_000 for i in range(6)]
    np.testing.assert_allclose(truth.positions, [[0, 0, 1.5 * i] for i in range(6)])


def test_colour_pair_and_its_truth(kitti: Make) -> None:
    source = KittiSource(kitti(pair=(2, 3)))
    assert [shown(frame) for frame in source][1] == [(1, 2), (1, 3)]
    left, right = source.rig.stereo_pair()
    np.testing.assert_allclose(right.T_body_camera.t - left.T_body_camera.t, [0.5, 0, 0])
    # Camera 2 stands 1 m to the right of camera 0, whose poses the file holds.
    assert source.truth is not None
    np.testing.assert_allclose(source.truth.positions[2], [1.0, 0, 3.0])


def test_layout_of_the_full_data_set(tmp_path: Path, kitti: Make) -> None:
    root = kitti()
    full = tmp_path / "dataset" / "sequences" / "07"
    full.parent.mkdir(parents=True)
    root.rename(full)
    (tmp_path / "dataset" / "poses").mkdir()
    (full / "poses.txt").rename(tmp_path / "dataset" / "poses" / "07.txt")
    truth = KittiSource(full).truth
    assert truth is not None
    assert len(truth) == 6


def test_one_camera(kitti: Make) -> None:
    source = KittiSource(kitti(pair=(0,)))
    assert source.notes == ["image_1 is missing or empty: the recording is monocular"]
    assert [len(frame.images) for frame in source] == [1] * 6
    with pytest.raises(CalibrationError, match="this rig has 1"):
        source.rig.stereo_pair()


@pytest.mark.parametrize("camera", ["image_0", "image_1"])
def test_unequal_counts_use_the_pairs(kitti: Make, camera: str) -> None:
    root = kitti()
    (root / camera / "000002.png").unlink()
    source = KittiSource(root)
    frames = list(source)
    # One that is missing shifts nothing: images, times and poses stay together.
    assert [shown(frame) for frame in frames] == [[(i, 0), (i, 1)] for i in (0, 1, 3, 4, 5)]
    assert [frame.stamp_ns for frame in frames] == [i * 100_000_000 for i in (0, 1, 3, 4, 5)]
    (skipped,) = source.skipped
    assert skipped.reason == f"no image of that name in {camera}"
    assert skipped.file.endswith("000002.png")


def test_left_and_right_numbered_differently(kitti: Make) -> None:
    root = kitti()
    for file in (root / "image_1").iterdir():
        file.rename(file.with_name(f"r{file.name}"))
    with pytest.raises(InputError, match="left and right must be numbered alike"):
        KittiSource(root)


def test_excerpt_keeps_its_numbers(kitti: Make) -> None:
    root = kitti()
    for folder in ("image_0", "image_1"):
        for file in sorted((root / folder).iterdir(), reverse=True):
            file.rename(file.with_name(f"{int(file.stem) + 100:06d}.png"))
    source = KittiSource(root)
    assert [frame.stamp_ns for frame in source] == [i * 100_000_000 for i in range(6)]


@pytest.mark.parametrize("broken", [b"", b"text"])
def test_unusable_image_is_skipped_and_counted(kitti: Make, broken: bytes) -> None:
    root = kitti()
    (root / "image_1" / "000003.png").write_bytes(broken)
    source = KittiSource(root)
    assert [frame.id for frame in source] == [0, 1, 2, 4, 5]
    assert [s.file for s in source.skipped] == [str(root / "image_1" / "000003.png")]


def test_left_and_right_of_different_size(
    kitti: Make, save_image: Callable[..., None], draw: Callable[..., object]
) -> None:
    root = kitti()
    for index in range(6):
        save_image(root / "image_1" / f"{index:06d}.png", draw(index, 1, (32, 24)))
    with pytest.raises(CalibrationError, match=r"different sizes \(64x48 and 32x24\)"):
        KittiSource(root)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("P1:", "P_1:"), r"field 'P1' is missing \(did you mean 'P_1'"),
        (("-2.500000000000e+01", ""), "P1 must have 12 finite numbers, got 11"),
        (("-2.500000000000e+01", "x"), r"calib\.txt:2: P1 must hold numbers"),
        (("-2.500000000000e+01", "nan"), "P1 must have 12 finite numbers"),
        (("-2.500000000000e+01", "-2.5e4"), "baseline of 500 m is implausible: is it in mill"),
        (("-2.500000000000e+01", "2.5e1"), "swapped; list the left camera first"),
        (("3.200000000000e+01", "6.4e1"), "P0: .*another resolution"),
        (("5.000000000000e+01", "0"), "no projection"),
    ],
)
def test_broken_calibration(kitti: Make, change: tuple[str, str], message: str) -> None:
    root = kitti()
    edit(root / "calib.txt", *change)
    if "another" in message:
        edit(root / "calib.txt", "2.400000000000e+01", "4.8e1")
    with pytest.raises(CalibrationError, match=message) as caught:
        KittiSource(root)
    assert str(caught.value).startswith(str(root / "calib.txt"))


def test_missing_calibration(kitti: Make) -> None:
    root = kitti()
    rig = KittiSource(root).rig
    (root / "calib.txt").unlink()
    with pytest.raises(CalibrationError, match=r"calib\.txt: missing: .* or give --rig"):
        KittiSource(root)
    assert len(list(KittiSource(root, rig))) == 6
    assert [len(frame.images) for frame in KittiSource(root, Rig(rig.cameras[:1]))] == [1] * 6
    with pytest.raises(CalibrationError, match="the rig has 0 cameras"):
        KittiSource(root, Rig())


def test_rig_for_another_resolution(kitti: Make, save_image: Callable[..., None]) -> None:
    root = kitti()
    rig = KittiSource(root).rig
    for folder in ("image_0", "image_1"):
        for file in (root / folder).iterdir():
            save_image(file, np.zeros((24, 32), np.uint8))
    with pytest.raises(CalibrationError, match=r"images are 32x24, .* calibrated for 64x48"):
        KittiSource(root, rig)


def test_without_times(kitti: Make) -> None:
    root = kitti()
    (root / "times.txt").unlink()
    source = KittiSource(root)
    assert [frame.stamp_ns for frame in source] == [i * 100_000_000 for i in range(6)]
    assert source.notes == ["times.txt is missing: frames are taken to be 0.1 s apart"]
    assert source.truth is not None


def test_too_few_times(kitti: Make) -> None:
    root = kitti()
    (root / "times.txt").write_text("0\n0.1\n0.2\n0.3\n")
    source = KittiSource(root)
    assert len(list(source)) == 4
    assert [s.reason for s in source.skipped] == ["times.txt has only 4 rows"] * 2
    assert "6 poses but only 4 times" in source.notes[0]
    (root / "times.txt").write_text("")
    with pytest.raises(InputError, match="0 times for 6 images"):
        KittiSource(root)


@pytest.mark.parametrize(
    ("times", "stamps_ms", "note"),
    [
        ("0 100 200 300 400 500", [0, 100, 200, 300, 400, 500], "milliseconds"),
        ("0 1e8 2e8 3e8 4e8 5e8", [0, 100, 200, 300, 400, 500], "nanoseconds"),
        ("0 .1 .2 2.3 2.4 2.5", [0, 100, 200, 2300, 2400, 2500], ""),
        ("0 .1 .1 .3 .4 .5", [0, 100, 300, 400, 500], ""),
        ("0 .1 nan .3 .4 .5", [0, 100, 300, 400, 500], ""),
        (".1 0 .2 .3 .4 .5", [0, 100, 200, 300, 400, 500], "1 stamps out of order: sorted"),
    ],
)
def test_odd_times(kitti: Make, times: str, stamps_ms: list[int], note: str) -> None:
    root = kitti()
    (root / "times.txt").write_text("\n".join(times.split()))
    source = KittiSource(root)
    frames = list(source)
    assert [frame.stamp_ns // 1_000_000 for frame in frames] == stamps_ms
    assert len(source.skipped) == 6 - len(stamps_ms)
    if note:
        assert note in source.notes[0]
    if times.startswith(".1 0"):
        assert [shown(frame)[0][0] for frame in frames] == [1, 0, 2, 3, 4, 5]


@pytest.mark.parametrize(
    ("text", "message"),
    [("garbage\n", "expected 12 numbers, got 1"), ("", "no poses")],
)
def test_useless_truth_is_ignored_and_said(kitti: Make, text: str, message: str) -> None:
    root = kitti()
    (root / "poses.txt").write_text(text)
    source = KittiSource(root)
    assert source.truth is None
    assert message in source.notes[0]
    assert source.notes[0].endswith("ground truth ignored")
    (root / "poses.txt").unlink()
    (root / "groundtruth.txt").write_text("1000 0 0 0 0 0 0 1\n")
    source = KittiSource(root)
    assert source.truth is None
    assert "does not overlap the images" in source.notes[0]
