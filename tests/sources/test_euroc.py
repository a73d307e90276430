"""EuRoC recordings, whole and broken in every way users' recordings are."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from odomap.errors import CalibrationError, InputError
from odomap.files.rig import read_rig, write_rig
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig
from odomap.sources.euroc import EurocSource
from odomap.sources.source import RandomAccess, Source, UnusableFrame

START_NS = 1403636584763555584
STEP_NS = 50_000_000
Make = Callable[..., Path]


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def rows(file: Path, change: Callable[[list[str]], list[str]]) -> None:
    """Change the rows of a csv file, below its header."""
    header, *lines = file.read_text().splitlines()
    file.write_text("\n".join([header, *change(lines)]) + "\n")


def both(mav0: Path, change: Callable[[list[str]], list[str]]) -> None:
    for camera in ("cam0", "cam1"):
        rows(mav0 / camera / "data.csv", change)


def shown(frame: Frame) -> list[tuple[int, int]]:
    """Return which picture of which camera the images of a frame are."""
    return [(int(image[0, 0]), int(image[0, 4])) for image in frame.images if image is not None]


def test_whole_recording(euroc: Make) -> None:
    source = EurocSource(euroc().parent)
    assert isinstance(source, Source)
    assert isinstance(source, RandomAccess)
    assert (source.name, len(source), source.notes) == ("MH_00", 6, [])
    frames = list(source)
    assert [frame.id for frame in frames] == list(range(6))
    assert [frame.stamp_ns for frame in frames] == [START_NS + i * STEP_NS for i in range(6)]
    assert [shown(frame) for frame in frames] == [[(i, 0), (i, 1)] for i in range(6)]
    assert source.skipped == []
    assert [frame.id for frame in source] == list(range(6))


def test_calibration(euroc: Make) -> None:
    rig = EurocSource(euroc()).rig
    left, right = rig.stereo_pair()
    assert (left.name, right.name, rig.body_sensor) == ("cam0", "cam1", "imu")
    assert left.camera.intrinsics.tolist() == [50, 50, 32, 24]
    assert left.camera.distortion.tolist() == [-0.1, 0.01, 0.0001, 0.0002]
    assert left.camera.resolution == (64, 48)
    np.testing.assert_allclose(right.T_body_camera.t, [0.11, 0.02, 0.03])
    assert rig.imu is not None
    assert (rig.imu.rate_hz, rig.imu.gyro_walk) == (200.0, 1.9393e-05)


def test_imu_belongs_to_the_interval_the_frame_closes(euroc: Make) -> None:
    source = EurocSource(euroc())
    frames = list(source)
    parts = [frame.imu for frame in frames if frame.imu is not None]
    assert [len(part) for part in parts] == [11, 10, 10, 10, 10, 10]
    # The first value of each row counts the rows.
    counted = np.concatenate([part.gyro[:, 0] for part in parts])
    assert counted.tolist() == list(range(61))
    assert np.all(np.concatenate([part.accel[:, 0] for part in parts]) == 9.8)
    single = source.frame(3).imu
    assert single is not None
    assert single.stamps_ns.tolist() == parts[3].stamps_ns.tolist()


def test_truth(euroc: Make) -> None:
    mav0 = euroc()
    source = EurocSource(mav0)
    assert source.truth is not None
    at = source.truth.interpolate(np.array([START_NS + 3 * STEP_NS]))
    np.testing.assert_allclose(at.positions, [[3.0, 0, 0]], atol=1e-12)
    # Without the ASL truth, a TUM file beside mav0 counts.
    (mav0 / "state_groundtruth_estimate0" / "data.csv").unlink()
    assert EurocSource(mav0).truth is None
    seconds = f"{START_NS // 10**9}.{START_NS % 10**9:09d}"
    (mav0.parent / "groundtruth.txt").write_text(f"{seconds} 5 0 0 0 0 0 1\n")
    truth = EurocSource(mav0).truth
    assert truth is not None
    assert truth.stamps_ns.tolist() == [START_NS]


def test_one_camera(euroc: Make) -> None:
    source = EurocSource(euroc(cameras=1))
    assert source.notes == ["cam1 is missing: the recording is monocular"]
    assert [shown(frame) for frame in source][:2] == [[(0, 0)], [(1, 0)]]
    with pytest.raises(CalibrationError, match="this rig has 1"):
        source.rig.stereo_pair()


@pytest.mark.parametrize("broken", ["missing", "empty", "text", "truncated", "size"])
@pytest.mark.parametrize("camera", ["cam0", "cam1"])
def test_unusable_image_is_skipped_and_counted(
    euroc: Make,
    save_image: Callable[..., None],
    draw: Callable[..., object],
    broken: str,
    camera: str,
) -> None:
    mav0 = euroc()
    file = mav0 / camera / "data" / f"{START_NS + 2 * STEP_NS}.png"
    data = file.read_bytes()
    if broken == "missing":
        file.unlink()
    elif broken == "size":
        save_image(file, draw(2, 0, (32, 24)))
    else:
        file.write_bytes({"empty": b"", "text": b"hello", "truncated": data[:-200]}[broken])
    source = EurocSource(mav0)
    for _ in range(2):
        frames = list(source)
        assert [frame.id for frame in frames] == [0, 1, 3, 4, 5]
        (skipped,) = source.skipped
        assert skipped.stamp_ns == START_NS + 2 * STEP_NS
        assert skipped.file == str(file)
    reasons = {
        "missing": "missing",
        "empty": "empty",
        "text": "not an image",
        "truncated": "truncated",
        "size": "image is 32x24, expected 64x48",
    }
    assert reasons[broken] in skipped.reason
    # No inertial sample is lost with it.
    assert [len(frame.imu or ()) for frame in frames] == [11, 10, 20, 10, 10]
    with pytest.raises(UnusableFrame, match=reasons[broken]):
        source.frame(2)


def test_no_usable_image_is_an_error(euroc: Make) -> None:
    mav0 = euroc()
    source = EurocSource(mav0)
    for file in (mav0 / "cam1" / "data").iterdir():
        file.write_bytes(b"")
    with pytest.raises(InputError, match="no frame of MH_00 can be read"):
        list(source)
    with pytest.raises(InputError, match="no image can be read"):
        EurocSource(mav0)


def test_left_without_right_is_skipped(euroc: Make) -> None:
    mav0 = euroc()
    rows(mav0 / "cam0" / "data.csv", lambda lines: lines[:2] + lines[3:])
    rows(mav0 / "cam1" / "data.csv", lambda lines: lines[:4] + lines[5:])
    source = EurocSource(mav0)
    assert [shown(frame) for frame in source] == [[(i, 0), (i, 1)] for i in (0, 1, 3, 5)]
    assert [s.reason for s in source.skipped] == [
        "no image of cam1 within 5 ms",
        "no image of cam0 within 5 ms",
    ]


def test_right_camera_with_other_stamps(euroc: Make, tmp_path: Path) -> None:
    mav0 = euroc()

    def late(lines: list[str]) -> list[str]:
        pairs = [line.split(",") for line in lines]
        return [f"{int(stamp) + 20_000_000},{name}" for stamp, name in pairs]

    rows(mav0 / "cam1" / "data.csv", late)
    with pytest.raises(InputError, match=r"nearest differs by 20 ms: set 'time_offset_s'"):
        EurocSource(mav0)
    # The mend works.
    rows(mav0 / "cam1" / "data.csv", lambda lines: lines[:0] + [late_back(line) for line in lines])
    rig = EurocSource(mav0).rig
    rows(mav0 / "cam1" / "data.csv", late)
    write_rig(tmp_path / "rig.yaml", rig)
    text = (tmp_path / "rig.yaml").read_text()
    at = text.rindex("time_offset_s: 0.0")
    (tmp_path / "rig.yaml").write_text(text[:at] + "time_offset_s: -0.02" + text[at + 18 :])
    assert len(list(EurocSource(mav0, read_rig(tmp_path)))) == 6


def late_back(line: str) -> str:
    stamp, name = line.split(",")
    return f"{int(stamp) - 20_000_000},{name}"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("intrinsics", "intrinsic"), "'intrinsics' is missing .found 'intrinsic': rename it"),
        (("resolution: [64, 48]\n", ""), "field 'resolution' is missing"),
        (("T_BS:", "T_SB:"), "field 'T_BS' is missing"),
        (("[64, 48]", "[128, 96]"), "another resolution"),
        (("[50.0, 50.0, 32.0, 24.0]", "[50.0, 50.0]"), "must have 4 numbers, not 2"),
        (("[50.0, 50.0", "[fifty, 50.0"), "must hold numbers, not 'fifty'"),
        (("pinhole", "omni"), "'omni' is not supported"),
        (("radial-tangential", "equidistant"), "'equidistant' is not supported"),
        (("data: [1.0", "data: [2.0"), "no rotation"),
        (("data: [1.0, ", "data: ["), "16 numbers"),
        (("T_BS:", "T_BS: ["), "not valid YAML"),
        (("0.11", "110.0"), "baseline of 110 m is implausible: is it in millimetres"),
        (("0.11", "-0.11"), "swapped; list the left camera first"),
    ],
)
def test_broken_calibration(euroc: Make, change: tuple[str, str], message: str) -> None:
    mav0 = euroc()
    file = mav0 / "cam1" / "sensor.yaml"
    edit(file, *change)
    with pytest.raises(CalibrationError, match=message) as caught:
        EurocSource(mav0)
    assert str(caught.value).startswith(str(file))
    assert "\n" not in str(caught.value)


def test_missing_calibration(euroc: Make) -> None:
    mav0 = euroc()
    (mav0 / "cam1" / "sensor.yaml").unlink()
    with pytest.raises(InputError, match=r"cam1/sensor\.yaml: No such file"):
        EurocSource(mav0)


def test_images_of_another_size_than_calibrated(
    euroc: Make, save_image: Callable[..., None], draw: Callable[..., object]
) -> None:
    mav0 = euroc()
    for index, file in enumerate(sorted((mav0 / "cam1" / "data").iterdir())):
        save_image(file, draw(index, 1, (32, 24)))
    with pytest.raises(
        CalibrationError,
        match=r"images are 32x24, but camera 'cam1' is calibrated for 64x48: correct",
    ):
        EurocSource(mav0)


def test_left_and_right_of_different_size(
    euroc: Make, save_image: Callable[..., None], draw: Callable[..., object]
) -> None:
    mav0 = euroc()
    for index, file in enumerate(sorted((mav0 / "cam1" / "data").iterdir())):
        save_image(file, draw(index, 1, (32, 24)))
    edit(mav0 / "cam1" / "sensor.yaml", "[64, 48]", "[32, 24]")
    edit(mav0 / "cam1" / "sensor.yaml", "[50.0, 50.0, 32.0, 24.0]", "[25.0, 25.0, 16.0, 12.0]")
    with pytest.raises(CalibrationError, match="resolutions 64x48 and 32x24 differ"):
        EurocSource(mav0)


def test_stamps_out_of_order(euroc: Make) -> None:
    mav0 = euroc()
    both(mav0, lambda lines: [lines[i] for i in (3, 0, 1, 2, 5, 4)])
    source = EurocSource(mav0)
    assert [shown(frame)[0][0] for frame in source] == list(range(6))
    assert source.notes == [
        "cam0/data.csv: 2 stamps out of order: sorted",
        "cam1/data.csv: 2 stamps out of order: sorted",
    ]


def test_repeated_stamps(euroc: Make) -> None:
    mav0 = euroc()
    rows(mav0 / "cam0" / "data.csv", lambda lines: [*lines[:3], lines[2], *lines[3:]])
    source = EurocSource(mav0)
    assert len(list(source)) == 6
    (skipped,) = source.skipped
    assert re.search(r"line 5: stamp \d+ is repeated", skipped.reason)


def test_stamps_that_lost_their_digits(euroc: Make) -> None:
    mav0 = euroc()
    both(mav0, lambda lines: ["1.40364E+18," + line.split(",")[1] for line in lines])
    with pytest.raises(InputError, match=r"5 of 6 stamps are repeated .* spreadsheet"):
        EurocSource(mav0)


def test_stamps_that_are_no_number(euroc: Make) -> None:
    mav0 = euroc()
    both(mav0, lambda lines: [*lines[:2], "NaN," + lines[2].split(",")[1], *lines[3:]])
    source = EurocSource(mav0)
    assert [shown(frame)[0][0] for frame in source] == [0, 1, 3, 4, 5]
    assert [s.reason for s in source.skipped] == ["line 4: stamp 'NaN' is not a number"] * 2
    both(mav0, lambda lines: ["NaN," + line.split(",")[1] for line in lines])
    with pytest.raises(InputError, match=r"data\.csv:2: stamp 'NaN' is not a number, nor is any"):
        EurocSource(mav0)


@pytest.mark.parametrize(
    ("digits", "word"), [(9, "seconds"), (6, "milliseconds"), (3, "microseconds")]
)
def test_stamps_in_another_unit(euroc: Make, digits: int, word: str) -> None:
    mav0 = euroc()

    def convert(lines: list[str]) -> list[str]:
        pairs = [line.split(",") for line in lines]
        return [f"{stamp[:-digits]}.{stamp[-digits:]},{name}" for stamp, name in pairs]

    both(mav0, convert)
    source = EurocSource(mav0)
    assert [frame.stamp_ns for frame in source] == [START_NS + i * STEP_NS for i in range(6)]
    assert source.notes == [
        f"{camera}/data.csv: stamps are in {word}, not in nanoseconds: converted"
        for camera in ("cam0", "cam1")
    ]
    assert source.truth is not None


def test_a_gap_is_no_error(euroc: Make) -> None:
    mav0 = euroc()

    def gap(lines: list[str]) -> list[str]:
        pairs = [line.split(",") for line in lines[3:]]
        return lines[:3] + [f"{int(stamp) + 2_000_000_000},{name}" for stamp, name in pairs]

    both(mav0, gap)
    source = EurocSource(mav0)
    assert (len(list(source)), source.skipped, source.notes) == (6, [], [])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("garbage\n", "data.csv:1: expected 8 numbers, got 1: ground truth ignored"),
        ("", "no poses: the file is empty: ground truth ignored"),
        ("1,nan,0,0,1,0,0,0\n", "NaN or infinite value"),
        ("1000000000,0,0,0,1,0,0,0\n", "does not overlap the images"),
    ],
)
def test_useless_truth_is_ignored_and_said(euroc: Make, text: str, message: str) -> None:
    mav0 = euroc()
    (mav0 / "state_groundtruth_estimate0" / "data.csv").write_text(text)
    source = EurocSource(mav0)
    assert source.truth is None
    assert message in source.notes[0]
    assert len(list(source)) == 6


def test_useless_imu_is_ignored_and_said(euroc: Make) -> None:
    mav0 = euroc()
    file = mav0 / "imu0" / "data.csv"
    text = file.read_text()
    file.write_text(text.replace("9.8,0,0", "9.8,0", 1))
    source = EurocSource(mav0)
    assert "data.csv:2: expected 7 numbers, got 6: the IMU is not used" in source.notes[0]
    assert source.rig.imu is None
    assert next(iter(source)).imu is None
    lines = text.splitlines()
    file.write_text("\n".join([lines[0], lines[2], lines[1], lines[2], *lines[3:]]))
    source = EurocSource(mav0)
    assert source.notes == [
        "imu0/data.csv: 1 rows with a repeated or unreadable stamp are left out",
        "imu0/data.csv: 1 stamps out of order: sorted",
    ]


def test_without_listing_the_names_are_the_stamps(euroc: Make) -> None:
    mav0 = euroc()
    for camera in ("cam0", "cam1"):
        (mav0 / camera / "data.csv").unlink()
    source = EurocSource(mav0)
    assert [frame.stamp_ns for frame in source] == [START_NS + i * STEP_NS for i in range(6)]
    assert "cam0/data.csv is missing: stamps are taken from the names" in source.notes[0]


def test_listing_without_images(euroc: Make) -> None:
    mav0 = euroc()
    (mav0 / "cam0" / "data.csv").write_text("#timestamp [ns],filename\n")
    with pytest.raises(InputError, match=r"cam0/data\.csv: no rows"):
        EurocSource(mav0)


def test_colour_and_16_bit_images_are_converted_and_said(
    euroc: Make, save_image: Callable[..., None]
) -> None:
    mav0 = euroc()
    for file in (mav0 / "cam0" / "data").iterdir():
        save_image(file, np.full((48, 64), 0xFFF, np.uint16))
    for file in (mav0 / "cam1" / "data").iterdir():
        save_image(file, np.full((48, 64, 3), 7, np.uint8))
    source = EurocSource(mav0)
    assert source.notes == [
        "cam0: 16-bit images (12 bits used) are scaled to 8 bits",
        "cam1: colour images are converted to grey",
    ]
    left, right = next(iter(source)).images
    assert left is not None
    assert right is not None
    assert (left.max(), right.max(), left.shape) == (255, 7, right.shape)


def test_another_rig(euroc: Make) -> None:
    mav0 = euroc()
    rig = EurocSource(mav0).rig
    mono = EurocSource(mav0, Rig(rig.cameras[:1]))
    assert [len(frame.images) for frame in mono] == [1] * 6
    assert next(iter(mono)).imu is None
    (mav0 / "cam1" / "sensor.yaml").unlink()
    (mav0 / "cam0" / "sensor.yaml").unlink()
    assert len(list(EurocSource(mav0, rig))) == 6
    with pytest.raises(CalibrationError, match="the rig has 0 cameras"):
        EurocSource(mav0, Rig())
