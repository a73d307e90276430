"""Videos: whole, of varying rate, turned, cut, of an unknown kind."""

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from odomap.errors import CalibrationError, InputError
from odomap.sources import capture, footage
from odomap.sources.container import inspect
from odomap.sources.describe import describe
from odomap.sources.disturb import reverse
from odomap.sources.open import open as open_source
from odomap.sources.source import Coloured, RandomAccess, UnusableFrame
from odomap.sources.video import VideoSource

Make = Callable[..., Path]
Number = Callable[[NDArray[np.uint8]], int]
ONE = 65536
"""1.0 in the fixed point of MP4."""
Box = tuple[tuple[bytes, ...], int, int]


def boxes(
    data: bytes, path: tuple[bytes, ...] = (), start: int = 0, stop: int = 0
) -> Iterator[Box]:
    """Yield path, place and size of all boxes of an MP4 file."""
    stop = stop or len(data)
    while start + 8 <= stop:
        size, kind = struct.unpack_from(">I4s", data, start)
        yield (*path, kind), start, size
        if kind in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):
            yield from boxes(data, (*path, kind), start + 8, start + size)
        start += size


def box(data: bytes, kind: bytes) -> Box:
    return next(found for found in boxes(data) if found[0][-1] == kind)


def vary(file: Path, steps: list[float]) -> None:
    """Give each frame of an MP4 its own duration, in units of the old one."""
    data = bytearray(file.read_bytes())
    # The edit list ends where the video did: it must not cut the longer one.
    at = box(data, b"edts")[1]
    data[at + 4 : at + 8] = b"free"
    path, at, size = box(data, b"stts")
    (old,) = struct.unpack_from(">I", data, at + 20)
    rows = b"".join(struct.pack(">II", 1, round(old * step)) for step in steps)
    body = struct.pack(">I4sII", 16 + len(rows), b"stts", 0, len(steps)) + rows
    for outer, place, length in list(boxes(data)):
        if outer == path[: len(outer)] and place < at < place + length:
            struct.pack_into(">I", data, place, length + len(body) - size)
    data[at : at + size] = body
    file.write_bytes(data)


def turn(file: Path, degrees: int) -> None:
    """Write into an MP4 that its images are to be turned clockwise."""
    c, s = {0: (1, 0), 90: (0, 1), 180: (-1, 0), 270: (0, -1)}[degrees]
    data = bytearray(file.read_bytes())
    matrix = (c * ONE, s * ONE, 0, -s * ONE, c * ONE, 0, 0, 0, 1 << 30)
    struct.pack_into(">9i", data, box(data, b"tkhd")[1] + 48, *matrix)
    file.write_bytes(data)


def contents_first(file: Path) -> None:
    """Move the table of contents of an MP4 to the front, as for streaming."""
    data = bytearray(file.read_bytes())
    _, at, size = box(data, b"moov")
    _, media, _ = box(data, b"mdat")
    table = box(data, b"stco")[1]
    (count,) = struct.unpack_from(">I", data, table + 12)
    for place in range(table + 16, table + 16 + 4 * count, 4):
        struct.pack_into(">I", data, place, struct.unpack_from(">I", data, place)[0] + size)
    moov = data[at : at + size]
    file.write_bytes(data[:media] + moov + data[media:at] + data[at + size :])


def cut(file: Path, share: float) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])


@pytest.mark.parametrize(
    ("name", "code", "kind", "codec"),
    [
        ("clip.mp4", "mp4v", "MP4", "mp4v"),
        ("clip.avi", "MJPG", "AVI", "MJPG"),
        ("CLIP.MKV", "FFV1", "Matroska", "V_FFV1"),
    ],
)
def test_whole_video(
    clip: Make, number_of: Number, name: str, code: str, kind: str, codec: str
) -> None:
    source = open_source(clip(name, frames=20, code=code))
    assert isinstance(source, VideoSource)
    assert isinstance(source, RandomAccess)
    assert isinstance(source, Coloured)
    assert (source.name, len(source), source.notes) == (name, 20, [])
    frames = list(source)
    assert [frame.id for frame in frames] == list(range(20))
    assert [number_of(frame.images[0]) for frame in frames] == list(range(20))
    # Matroska counts milliseconds.
    expected = np.round(np.arange(20) * (1e9 / 30)).astype(np.int64)
    np.testing.assert_allclose(source.stamps_ns, expected, atol=500_000)
    assert [frame.stamp_ns for frame in frames] == source.stamps_ns.tolist()
    assert source.skipped == []
    assert source.details == {"container": kind, "codec": codec, "rotation_deg": 0}
    assert describe(source)["rate_hz"] == pytest.approx(30, rel=0.02)


def test_any_frame_by_its_number(clip: Make, number_of: Number) -> None:
    source = VideoSource(clip(frames=150))
    order = np.random.default_rng(0).permutation(150)[:40].tolist()
    assert [number_of(source.frame(index).images[0]) for index in order] == order
    assert number_of(source.frame(7).images[0]) == number_of(source.frame(7).images[0]) == 7
    backwards = list(reverse(source))
    assert [number_of(frame.images[0]) for frame in backwards] == list(range(150))[::-1]
    with pytest.raises(IndexError):
        source.frame(150)


def test_colour_has_the_pixels_of_grey(clip: Make) -> None:
    source = VideoSource(clip(code="FFV1", name="clip.mkv"))
    colour, grey = source.colour(3), source.frame(3).images[0]
    assert colour.shape == (96, 128, 3)
    assert np.abs(colour @ np.array([0.299, 0.587, 0.114]) - grey).max() <= 1
    # Red is twice blue: (H, W, 3) is red, green, blue.
    np.testing.assert_allclose(colour[20:, :, 0] / 2, colour[20:, :, 2], atol=6)


def test_two_iterations_do_not_disturb_each_other(clip: Make, number_of: Number) -> None:
    source = VideoSource(clip())
    for first, second in zip(source, source, strict=True):
        assert number_of(first.images[0]) == number_of(second.images[0]) == first.id
        assert number_of(source.frame(11 - first.id).images[0]) == 11 - first.id


def test_rate_that_varies(clip: Make, number_of: Number) -> None:
    file = clip(frames=40)
    steps = np.random.default_rng(1).choice([0.5, 1, 2, 3], 40).tolist()
    vary(file, steps)
    source = VideoSource(file)
    expected = np.concatenate([[0], np.cumsum(steps)[:-1]]) / 30
    np.testing.assert_allclose(source.stamps_ns * 1e-9, expected, atol=2e-6)
    frames = list(source)
    assert [frame.id for frame in frames] == list(range(40))
    assert [number_of(frame.images[0]) for frame in frames] == list(range(40))
    for index in (33, 2, 17, 39, 18):
        assert number_of(source.frame(index).images[0]) == index
    low, high = describe(source)["steps_s"]
    assert (low, high) == (pytest.approx(0.5 / 30, abs=1e-5), pytest.approx(0.1, abs=1e-5))


def test_no_times_in_the_container(
    clip: Make, calibrate: Make, number_of: Number, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = clip(rate_hz=20.0)
    calibrate(file.with_name("rig.yaml"), (128, 96), rate_hz=0.0)
    monkeypatch.setattr(capture, "stamp_us", lambda _: 0)
    monkeypatch.setattr(footage, "stamp_us", lambda _: 0)
    source = VideoSource(file)
    (note,) = source.notes
    assert note == "the video has no times of its own: frames are taken to be 50 ms apart"
    frames = list(source)
    assert [frame.stamp_ns for frame in frames] == [i * 50_000_000 for i in range(12)]
    assert [number_of(frame.images[0]) for frame in frames] == list(range(12))
    # Nothing tells which frame is which but counting: it cannot be played backwards.
    assert not isinstance(source, RandomAccess)
    with pytest.raises(InputError, match="is a stream"):
        reverse(source)
    assert [number_of(source.frame(i).images[0]) for i in (9, 3, 4)] == [9, 3, 4]
    calibrate(file.with_name("rig.yaml"), (128, 96), rate_hz=10.0)
    assert "100 ms apart" in VideoSource(file).notes[0]


@pytest.mark.parametrize("degrees", [90, 270])
def test_turned_video(clip: Make, calibrate: Make, number_of: Number, degrees: int) -> None:
    file = clip()
    turn(file, degrees)
    lying = VideoSource(file)
    assert lying.frame(5).images[0].shape == (96, 128)
    assert number_of(lying.frame(5).images[0]) == 5
    assert lying.details["rotation_deg"] == 0
    (note,) = lying.notes
    assert f"turn its images by {degrees}°, the calibration is of 128x96: they are used as" in note
    calibrate(file.with_name("rig.yaml"), (96, 128))
    upright = VideoSource(file)
    assert upright.notes == [f"images are turned by {degrees}°, as the video says"]
    for index in (5, 2):
        image = upright.frame(index).images[0]
        assert image.shape == (128, 96)
        back = np.rot90(image, degrees // 90)
        np.testing.assert_array_equal(back, lying.frame(index).images[0])
    assert [frame.images[0].shape for frame in upright] == [(128, 96)] * 12
    assert upright.colour(2).shape == (128, 96, 3)
    calibrate(file.with_name("rig.yaml"), (640, 480))
    with pytest.raises(CalibrationError, match=r"images are 96x128, .*for 640x480.*128x96 before"):
        VideoSource(file)


def test_video_upside_down_is_turned_as_players_do(clip: Make, number_of: Number) -> None:
    file = clip()
    straight = VideoSource(file).frame(3).images[0]
    turn(file, 180)
    source = VideoSource(file)
    assert source.notes == ["images are turned by 180°, as the video says"]
    np.testing.assert_array_equal(source.frame(3).images[0][::-1, ::-1], straight)


@pytest.mark.parametrize("name", ["clip.avi", "clip.mkv", "clip.mp4"])
def test_video_that_is_cut(clip: Make, number_of: Number, name: str) -> None:
    file = clip(name, frames=60, code={"clip.avi": "MJPG"}.get(name, "mp4v"))
    if name == "clip.mp4":
        contents_first(file)
        assert len(list(VideoSource(file))) == 60
    cut(file, 0.6)
    source = VideoSource(file)
    (note,) = source.notes
    frames = list(source)
    assert 20 < len(frames) < 50
    assert note == (
        f"the file is cut: it ends after {frames[-1].stamp:.2f} s and {len(frames)} frames "
        "of 60 announced"
    )
    assert [number_of(frame.images[0]) for frame in frames] == list(range(len(frames)))
    assert source.skipped == []


def test_interrupted_recording_has_no_contents(clip: Make) -> None:
    file = clip()
    cut(file, 0.6)
    with pytest.raises(InputError, match=r"clip\.mp4: has no table of contents \('moov'\)"):
        VideoSource(file)


@pytest.mark.parametrize("name", ["clip.avi", "clip.mkv"])
def test_cut_within_the_first_frame(clip: Make, name: str) -> None:
    file = clip(name, code="FFV1", frames=3)
    whole = file.read_bytes()
    for share in (0.1, 0.3):
        file.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError, match=r"the file is cut (before|within) its first frame"):
            VideoSource(file)


def test_broken_frame_costs_that_frame(clip: Make, number_of: Number) -> None:
    file = clip("clip.avi", code="MJPG", frames=12)
    data = bytearray(file.read_bytes())
    starts = [at for at in range(len(data)) if data[at : at + 3] == b"\xff\xd8\xff"]
    assert len(starts) == 12
    data[starts[6] : starts[6] + 600] = bytes(600)
    file.write_bytes(data)
    source = VideoSource(file)
    frames = list(source)
    assert [frame.id for frame in frames] == [0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11]
    assert [number_of(frame.images[0]) for frame in frames] == [frame.id for frame in frames]
    (skipped,) = source.skipped
    assert (skipped.stamp_ns, skipped.reason) == (200_000_000, "cannot be decoded")
    assert skipped.file == f"{file}, frame 6"
    with pytest.raises(UnusableFrame, match="frame 6: cannot be decoded"):
        source.frame(6)
    assert number_of(source.frame(7).images[0]) == 7


def test_unsupported_codec_is_named(clip: Make) -> None:
    file = clip("clip.avi", code="MJPG")
    file.write_bytes(file.read_bytes().replace(b"MJPG", b"QQQQ"))
    with pytest.raises(InputError) as caught:
        open_source(file)
    text = str(caught.value)
    assert "codec 'QQQQ' cannot be decoded here: convert it: ffmpeg -i " in text
    assert "clip_h264.mp4" in text
    assert "\n" not in text


def test_files_that_are_no_videos(tmp_path: Path, clip: Make) -> None:
    clip()
    (tmp_path / "text.mp4").write_text("not a video\n" * 100)
    with pytest.raises(InputError, match=r"text\.mp4: is not a video that can be read"):
        open_source(tmp_path / "text.mp4")
    (tmp_path / "empty.mp4").write_bytes(b"")
    with pytest.raises(InputError, match=r"empty\.mp4: the file is empty"):
        open_source(tmp_path / "empty.mp4")
    with pytest.raises(InputError, match=r"clap\.mp4: does not exist \(did you mean 'clip.mp4'"):
        open_source(tmp_path / "clap.mp4")


@pytest.mark.parametrize(("name", "code"), [("clip.avi", "MJPG"), ("clip.mp4", "mp4v")])
def test_video_without_frames(clip: Make, name: str, code: str) -> None:
    with pytest.raises(InputError, match=r"(has no frames|holds no video): was the recording sto"):
        VideoSource(clip(name, code=code, frames=0))


def test_nothing_is_printed(clip: Make, capfd: pytest.CaptureFixture[str]) -> None:
    file = clip("clip.avi", code="MJPG")
    list(VideoSource(file))
    file.write_bytes(file.read_bytes().replace(b"MJPG", b"QQQQ"))
    with pytest.raises(InputError):
        VideoSource(file)
    cut(file, 0.5)
    with pytest.raises(InputError):
        VideoSource(file)
    assert capfd.readouterr() == ("", "")
    assert cv2.utils.logging.getLogLevel() != cv2.utils.logging.LOG_LEVEL_SILENT


def test_calibration_is_needed(clip: Make, calibrate: Make, tmp_path: Path) -> None:
    file = clip()
    file.with_name("rig.yaml").rename(tmp_path / "elsewhere.yaml")
    with pytest.raises(CalibrationError, match=r"there is no calibration.*odomap calibrate") as no:
        open_source(file)
    assert "--rig FILE" in str(no.value)
    assert len(open_source(file, tmp_path / "elsewhere.yaml")) == 12
    calibrate(tmp_path / "clip.rig.yaml", (128, 96))
    # That of the video's own name counts before that of the folder.
    calibrate(tmp_path / "rig.yaml", (64, 48))
    assert open_source(file).rig.cameras[0].camera.resolution == (128, 96)
    (tmp_path / "clip.rig.yaml").unlink()
    with pytest.raises(CalibrationError, match=r"128x96, but camera 'cam'.*64x48.*scale by 2\)"):
        open_source(file)


def test_folder_that_holds_videos(clip: Make, tmp_path: Path) -> None:
    clip()
    with pytest.raises(InputError, match=r"holds videos: open one of them: clip\.mp4"):
        open_source(tmp_path)


def test_calibration_of_two_cameras(clip: Make, euroc: Make) -> None:
    rig = open_source(euroc()).rig
    with pytest.raises(CalibrationError, match="of one camera, but its calibration has 2"):
        VideoSource(clip(), rig)


def test_container_facts(clip: Make, tmp_path: Path) -> None:
    (tmp_path / "none.mp4").write_bytes(b"anything")
    assert inspect(tmp_path / "none.mp4").kind == ""
    file = clip()
    assert not inspect(file).is_cut
    with file.open("r+b") as out:
        out.truncate(file.stat().st_size - 1)
    assert inspect(file).is_cut
    with pytest.raises(InputError, match="No such file"):
        inspect(tmp_path / "absent.mp4")
