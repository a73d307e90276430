"""Live cameras: a file played as one, and a device that is absent, busy, slow or pulled out."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from odomap.errors import CalibrationError, InputError
from odomap.sources import camera, devices
from odomap.sources.camera import CameraSource
from odomap.sources.describe import describe
from odomap.sources.disturb import drop, reverse
from odomap.sources.open import open as open_source
from odomap.sources.source import Coloured, RandomAccess, Source

Make = Callable[..., Path]
Number = Callable[[NDArray[np.uint8]], int]
PERIOD_NS = 1e9 / 30


class Clock:
    """A clock that stands still until it is told to go on: stands in for the module `time`."""

    START_NS = 1_700_000_000_000_000_000

    def __init__(self) -> None:
        self.now_ns = 5_000_000_000

    def monotonic(self) -> float:
        return self.now_ns * 1e-9

    def monotonic_ns(self) -> int:
        return self.now_ns

    def time_ns(self) -> int:
        return self.START_NS + self.now_ns

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0
        self.now_ns += round(seconds * 1e9)


class Capture:
    """Stands in for cv2.VideoCapture of a camera of 30 frames a second, with a driver's buffers."""

    clock: Clock
    size = (128, 96)
    backend = "V4L2"
    gives = 1000
    is_open = True
    pull_after = 1000
    released = 0

    def __init__(self, place: int | str, api: int) -> None:
        self.place = place
        self.asked: dict[int, float] = {}
        self.start_ns = self.clock.now_ns
        self.arrived = 0
        self.buffers: list[int] = []
        self.taken = 0
        self.grabs = 0

    def isOpened(self) -> bool:
        return self.is_open

    def set(self, what: int, value: float) -> bool:
        self.asked[what] = value
        return True

    def get(self, what: int) -> float:
        if what == cv2.CAP_PROP_FPS:
            return 30.0
        assert what == cv2.CAP_PROP_POS_MSEC
        return self.due(self.taken) * 1e-6

    def due(self, index: int) -> float:
        return self.start_ns + index * PERIOD_NS

    def getBackendName(self) -> str:
        return self.backend

    def grab(self) -> bool:
        self.grabs += 1
        while self.due(self.arrived) <= self.clock.now_ns and self.arrived < self.pull_after:
            if len(self.buffers) < 4:
                self.buffers.append(self.arrived)
            self.arrived += 1
        if self.gives <= 0 or (self.arrived >= self.pull_after and not self.buffers):
            return False
        if not self.buffers:
            self.clock.now_ns = int(np.ceil(self.due(self.arrived)))
            self.buffers.append(self.arrived)
            self.arrived += 1
        self.taken = self.buffers.pop(0)
        return True

    def retrieve(self) -> tuple[bool, NDArray[np.uint8]]:
        image = np.full((self.size[1], self.size[0], 3), self.taken % 256, np.uint8)
        return self.taken != 7, image

    def release(self) -> None:
        Capture.released += 1


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Return the clock that cameras go by."""
    clock = Clock()
    monkeypatch.setattr(camera, "time", clock)
    monkeypatch.setattr(devices, "time", clock)
    return clock


@pytest.fixture
def plugged(
    clock: Clock, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, calibrate: Make
) -> type[Capture]:
    """Return a camera that is plugged in; its calibration is in the folder one is in."""

    class Plugged(Capture):
        pass

    Plugged.clock = clock
    monkeypatch.setattr(cv2, "VideoCapture", Plugged)
    monkeypatch.chdir(tmp_path)
    calibrate(tmp_path / "rig.yaml", (128, 96))
    return Plugged


def test_file_played_like_a_camera(
    clip: Make, clock: Clock, number_of: Number, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = clip(frames=12)
    monkeypatch.chdir(file.parent)
    source = open_source(f"camera:{file}")
    assert isinstance(source, CameraSource)
    assert isinstance(source, Source)
    assert not isinstance(source, RandomAccess | Coloured)
    assert len(source) == 0
    start_ns = clock.time_ns()
    for _ in range(2):
        frames = list(source)
        assert [frame.id for frame in frames] == list(range(12))
        assert [number_of(frame.images[0]) for frame in frames] == list(range(12))
        stamps = np.array([frame.stamp_ns for frame in frames])
        # Stamps are of the clock on the wall.
        np.testing.assert_allclose(stamps - start_ns, np.arange(12) * PERIOD_NS, atol=2000)
        assert (source.notes, source.skipped) == ([], [])
        start_ns = clock.time_ns()


@pytest.mark.parametrize(
    ("work_periods", "expected"),
    [
        # Who is as fast as the camera sees all; who is slower sees the newest, never older ones.
        (0.9, list(range(40))),
        (1.5, [0, 1, 3, 4, 6, 7, 9, 10, 12]),
        (2.0, [0, 2, 4, 6, 8, 10, 12]),
        (3.5, [0, 3, 7, 10, 14]),
        (6.5, [0, 7, 14, 21]),
    ],
)
def test_slow_consumer_sees_the_newest(
    clip: Make, clock: Clock, number_of: Number, work_periods: float, expected: list[int]
) -> None:
    file = clip(frames=40)
    source = CameraSource(f"camera:{file}", open_source(file).rig)
    shown, ages = [], []
    for frame in source:
        shown.append(number_of(frame.images[0]))
        ages.append((clock.time_ns() - frame.stamp_ns) / PERIOD_NS)
        clock.sleep(work_periods * PERIOD_NS * 1e-9)
    assert shown[: len(expected)] == expected
    assert max(ages) <= 1.001
    assert (source.notes == []) == (work_periods < 1)


def test_frames_that_were_dropped_are_told(clip: Make, clock: Clock) -> None:
    file = clip(frames=40)
    source = CameraSource(f"camera:{file}", open_source(file).rig)
    for _ in source:
        clock.sleep(0.2)
    (note,) = source.notes
    assert note.endswith(" frames grew stale while those before them were worked on: dropped")
    assert int(note.split()[0]) > 10


def test_real_time(clip: Make, number_of: Number) -> None:
    import time

    file = clip(frames=6)
    source = CameraSource(f"camera:{file}", open_source(file).rig)
    start_ns = time.time_ns()
    frames = list(source)
    taken_ns = time.time_ns() - start_ns
    assert taken_ns >= 5 * PERIOD_NS - 2e6
    numbers = [number_of(frame.images[0]) for frame in frames]
    assert numbers == sorted(set(numbers))
    stamps = np.array([frame.stamp_ns for frame in frames])
    assert np.all(np.diff(stamps) > 0)
    assert start_ns <= stamps[0] <= start_ns + taken_ns


def test_device(plugged: type[Capture], clock: Clock) -> None:
    source = open_source("camera:0?fps=30")
    assert source.details == {"device": "0", "backend": "V4L2", "image": "128x96, 30 Hz"}
    facts = describe(source)
    assert (facts["frames"], facts["rate_hz"], facts["duration_s"]) == (None, None, None)
    frames = []
    for frame in source:
        frames.append(frame)
        if len(frames) == 12:
            break
    assert [int(frame.images[0][0, 0]) for frame in frames] == [*range(1, 7), *range(8, 14)]
    assert frames[0].images[0].shape == (96, 128)
    # The frame that could not be decoded.
    (skipped,) = source.skipped
    assert (skipped.file, skipped.reason) == ("camera:0?fps=30", "cannot be decoded")
    steps = np.diff([frame.stamp_ns for frame in frames])
    np.testing.assert_allclose(np.delete(steps, 5), PERIOD_NS, atol=2000)
    with pytest.raises(InputError, match="is a stream"):
        reverse(source)


def test_buffered_frames_are_stale_after_a_pause(plugged: type[Capture], clock: Clock) -> None:
    source = open_source("camera:0")
    # Compiling takes a while.
    clock.sleep(20.0)
    now_ns = clock.time_ns()
    frame = next(iter(source))
    assert now_ns <= frame.stamp_ns <= now_ns + PERIOD_NS + 1000


@pytest.mark.parametrize("work_periods", [0.5, 1.2, 2.5, 3.2, 9.0])
def test_device_without_a_clock(plugged: type[Capture], clock: Clock, work_periods: float) -> None:
    plugged.backend = "DSHOW"
    source = CameraSource("camera:0")
    ages = []
    for frame in source:
        shown_ns = 5_000_000_000 + frame.images[0][0, 0] * PERIOD_NS
        ages.append((clock.now_ns - shown_ns) / PERIOD_NS)
        if len(ages) == 20:
            break
        clock.sleep(work_periods * PERIOD_NS * 1e-9)
    assert max(ages) <= 1.001


def test_options_and_what_is_asked_for(
    plugged: type[Capture], monkeypatch: pytest.MonkeyPatch, calibrate: Make, tmp_path: Path
) -> None:
    made = []

    class Recorded(plugged):  # type: ignore[valid-type, misc]
        def __init__(self, place: int | str, api: int) -> None:
            super().__init__(place, api)
            made.append(self)

    monkeypatch.setattr(cv2, "VideoCapture", Recorded)
    CameraSource("camera:")
    CameraSource("camera:/dev/video7?width=320&height=240&fps=15")
    assert [capture.place for capture in made] == [0, "/dev/video7"]
    w, h, rate = cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FPS
    # What was calibrated is what is wanted, unless one says otherwise.
    assert (made[0].asked[w], made[0].asked[h], made[0].asked[rate]) == (128, 96, 30)
    assert (made[1].asked[w], made[1].asked[h], made[1].asked[rate]) == (320, 240, 15)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("camera:0?widht=640", r"unknown option 'widht' \(did you mean 'width'\?\)"),
        ("camera:0?colour=1", r"unknown option 'colour' \(known are width, height, fps\)"),
        ("camera:0?width=big", "width must be a number, not 'big'"),
        ("camera:0?fps=0", "fps must be positive, not 0"),
        ("camera:0?fps=nan", "fps must be positive, not nan"),
    ],
)
def test_options_that_are_wrong(spec: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        open_source(spec)


def test_absent_camera(tmp_path: Path, calibrate: Make, capfd: pytest.CaptureFixture[str]) -> None:
    rig = calibrate(tmp_path / "mine.yaml", (128, 96))
    with pytest.raises(InputError) as caught:
        open_source("camera:63", rig)
    text = str(caught.value)
    assert text.startswith("camera 63 cannot be opened: is it plugged in, and not used by another")
    assert "/dev/video" in text
    with pytest.raises(InputError, match=r"camera /dev/video63 cannot be opened: is it plugged"):
        open_source("camera:/dev/video63", rig)
    assert capfd.readouterr().err == ""


def test_camera_that_may_not_be_read(
    plugged: type[Capture], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plugged.is_open = False
    (tmp_path / "video0").mkdir()
    monkeypatch.setattr(devices.os, "access", lambda *_: False)
    with pytest.raises(InputError, match=r"video0 may not be read: add yourself to its group"):
        CameraSource(f"camera:{tmp_path / 'video0'}")


def test_busy_camera(plugged: type[Capture]) -> None:
    plugged.gives = 0
    with pytest.raises(InputError, match=r"camera 0 opens but gives no frame: is another program"):
        CameraSource("camera:0")
    assert Capture.released > 0


def test_unplugged_camera_ends_the_stream(plugged: type[Capture]) -> None:
    plugged.pull_after = 30
    source = CameraSource("camera:0")
    frames = list(source)
    assert len(frames) == 28
    (note,) = source.notes
    assert note == (
        "camera 0 gave no frame for 1 s after 28 frames: was it unplugged? What was computed "
        "until then stays"
    )


def test_calibration(plugged: type[Capture], clip: Make, tmp_path: Path, calibrate: Make) -> None:
    calibrate(tmp_path / "rig.yaml", (640, 480))
    with pytest.raises(CalibrationError) as caught:
        CameraSource("camera:0")
    text = str(caught.value)
    assert text.startswith(
        "camera 0: images are 128x96, but camera 'cam' is calibrated for 640x480"
    )
    assert "'camera:0?width=640&height=480' if the camera can, or calibrate it at 128x96" in text
    assert text.endswith("(intrinsics scale by 0.2)")
    (tmp_path / "rig.yaml").unlink()
    with pytest.raises(CalibrationError, match=r"camera:0: there is no calibration.*--rig FILE"):
        CameraSource("camera:0")


def test_disturbed_stream(plugged: type[Capture]) -> None:
    plugged.pull_after = 12
    dropped = drop(CameraSource("camera:0"), [3])
    assert len(dropped) == 0
    assert [frame.id for frame in dropped] == [0, 1, 2, *range(4, 10)]


def test_a_file_has_its_calibration_beside_it(clip: Make, calibrate: Make) -> None:
    path = clip()
    calibrate(path.with_suffix(".rig.yaml"), (128, 96))
    assert CameraSource(f"camera:{path}").rig.cameras[0].camera.width == 128
    with pytest.raises(InputError, match="there is no such file to play as a camera"):
        CameraSource(f"camera:{path.with_name('other.mp4')}", CameraSource(f"camera:{path}").rig)
