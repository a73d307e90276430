"""Disturbed sources are sources: stamps increase, truth is that of the frames."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig
from odomap.sources.disturb import (
    blank,
    blur,
    cover,
    drop,
    duplicate,
    exposure_jumps,
    freeze,
    kill_right,
    moving_object,
    overexpose,
    pierce_depth,
    reverse,
    roughen_depth,
    there_and_back,
)
from odomap.sources.euroc import EurocSource
from odomap.sources.source import RandomAccess, Skipped, Source
from odomap.sources.tum import TumSource

START_NS = 1403636584763555584
STEP_NS = 50_000_000


@pytest.fixture
def source(euroc: Callable[..., Path]) -> EurocSource:
    return EurocSource(euroc(frames=7))


class Stream:
    """A source that can only be played forwards."""

    name = "camera"
    rig = Rig()
    truth = None

    def __init__(self) -> None:
        self.skipped: list[Skipped] = []

    def __len__(self) -> int:
        return 4

    def __iter__(self) -> Iterator[Frame]:
        for i in range(4):
            yield Frame(i, 10 * i, (np.full((8, 8), 10 + i, np.uint8), None))


def number(frame: Frame, camera: int = 0) -> int:
    """Return which picture a frame shows."""
    image = frame.images[camera]
    assert image is not None
    return int(image[0, 0])


def same(ours: Frame, theirs: Frame) -> bool:
    if (ours.id, ours.stamp_ns, ours.imu is None) != (
        theirs.id,
        theirs.stamp_ns,
        theirs.imu is None,
    ):
        return False
    if ours.imu is not None and theirs.imu is not None:
        assert np.array_equal(ours.imu.stamps_ns, theirs.imu.stamps_ns)
    return all(
        a is b if a is None or b is None else np.array_equal(a, b)
        for a, b in zip(ours.images, theirs.images, strict=True)
    )


ALL: dict[str, Callable[[Source], Source]] = {
    "blank": lambda s: blank(s, [2, 3]),
    "blur": lambda s: blur(s, [2, 3]),
    "drop": lambda s: drop(s, [2, 3]),
    "freeze": lambda s: freeze(s, [2, 3]),
    "overexpose": lambda s: overexpose(s, [2, 3]),
    "exposure_jumps": lambda s: exposure_jumps(s, 2, (1.0, 2.0), cameras=[1]),
    "cover": lambda s: cover(s, [2, 3]),
    "moving_object": lambda s: moving_object(s, [2, 3]),
    "kill_right": lambda s: kill_right(s, 3),
    "frozen right": lambda s: kill_right(s, 3, "frozen"),
    "pierce_depth": lambda s: pierce_depth(s, [2, 3], share=0.5),
    "roughen_depth": lambda s: roughen_depth(s, [2, 3]),
    "duplicate": lambda s: duplicate(s, [2, 3]),
    "reverse": reverse,
    "there_and_back": there_and_back,
    "nested": lambda s: there_and_back(drop(blank(drop(freeze(s, [1]), [2]), [3]), [4])),
}


@pytest.mark.parametrize("name", ALL)
def test_is_a_source(source: EurocSource, name: str) -> None:
    wrapped = ALL[name](source)
    assert isinstance(wrapped, Source)
    assert isinstance(wrapped, RandomAccess)
    frames = list(wrapped)
    assert len(frames) == len(wrapped)
    stamps = [frame.stamp_ns for frame in frames]
    assert np.all(np.diff(stamps) > 0)
    assert wrapped.stamps_ns.tolist() == stamps
    # What is iterated is what is read in any order, twice over.
    again = list(wrapped)
    for index in range(len(wrapped)):
        assert same(wrapped.frame(index), frames[index])
        assert same(again[index], frames[index])
    assert wrapped.name.startswith("MH_00 (")


@pytest.mark.parametrize("name", ALL)
def test_truth_is_that_of_the_frames(source: EurocSource, name: str) -> None:
    wrapped = ALL[name](source)
    assert wrapped.truth is not None
    # What a disturbed picture shows says nothing: blank, smeared, or of an earlier place.
    disturbed = {"reverse": (), "there_and_back": (), "nested": (1, 4)}.get(name, (2, 3))
    checked = 0
    for frame in wrapped:
        if frame.id not in disturbed:
            at = wrapped.truth.interpolate(np.array([frame.stamp_ns])).positions[0, 0]
            # The picture's number is where it was taken.
            assert at == pytest.approx(number(frame), abs=1e-9)
            checked += 1
    assert checked >= 3


def test_blank(source: EurocSource) -> None:
    frames = list(blank(source, range(2, 4)))
    dark = [all(not image.any() for image in f.images if image is not None) for f in frames]
    assert dark == [False, False, True, True, False, False, False]
    assert len(frames[2].imu or ()) == 10


def test_drop_keeps_ids_and_inertial_samples(source: EurocSource) -> None:
    wrapped = drop(source, [0, 3, 4, 99])
    frames = list(wrapped)
    assert [frame.id for frame in frames] == [1, 2, 5, 6]
    parts = [frame.imu for frame in frames if frame.imu is not None]
    assert [len(part) for part in parts] == [21, 10, 30, 10]
    assert np.concatenate([part.gyro[:, 0] for part in parts]).tolist() == list(range(71))
    assert [frame.id for frame in drop(wrapped, [5])] == [1, 2, 6]
    assert len(drop(wrapped, [5, 3])) == 3


def test_freeze_repeats_images_under_new_stamps(source: EurocSource) -> None:
    frames = list(freeze(source, [0, 2, 3, 6]))
    assert [number(frame) for frame in frames] == [0, 1, 1, 1, 4, 5, 5]
    assert [number(frame, 1) for frame in frames] == [0, 1, 1, 1, 4, 5, 5]
    assert [frame.stamp_ns for frame in frames] == source.stamps_ns.tolist()


@pytest.mark.parametrize(("angle", "axis"), [(0.0, 1), (90.0, 0)])
def test_blur_smears_along_its_direction(source: EurocSource, angle: float, axis: int) -> None:
    sharp = next(iter(source)).images[1]
    smeared = next(iter(blur(source, [0], 9.0, angle))).images[1]
    assert sharp is not None
    assert smeared is not None
    before = [np.abs(np.diff(sharp.astype(float), axis=a)).mean() for a in (0, 1)]
    after = [np.abs(np.diff(smeared.astype(float), axis=a)).mean() for a in (0, 1)]
    assert after[axis] < 0.2 * before[axis]
    assert after[1 - axis] > 1.5 * after[axis]
    assert smeared.mean() == pytest.approx(sharp.mean(), abs=2.0)
    with pytest.raises(InputError, match="length_px"):
        blur(source, [0], -1.0)


def test_reverse(source: EurocSource) -> None:
    wrapped = reverse(source)
    frames = list(wrapped)
    assert [number(frame) for frame in frames] == [6, 5, 4, 3, 2, 1, 0]
    assert [frame.id for frame in frames] == list(range(7))
    assert frames[0].stamp_ns == source.stamps_ns[0]
    assert frames[-1].stamp_ns == source.stamps_ns[-1]
    assert all(frame.imu is None for frame in frames)
    assert wrapped.rig.imu is None
    assert wrapped.rig.cameras == source.rig.cameras
    # Twice reversed is the recording again.
    twice = list(reverse(wrapped))
    assert [number(frame) for frame in twice] == list(range(7))
    assert [frame.stamp_ns for frame in twice] == source.stamps_ns.tolist()


def test_there_and_back(source: EurocSource) -> None:
    wrapped = there_and_back(source)
    frames = list(wrapped)
    assert [number(frame) for frame in frames] == [0, 2, 4, 6, 5, 3, 1]
    steps = [frame.stamp_ns - START_NS for frame in frames]
    assert steps == [2 * STEP_NS * i for i in range(7)]
    assert wrapped.truth is not None
    assert wrapped.truth.stamps_ns.tolist() == [frame.stamp_ns for frame in frames]
    np.testing.assert_allclose(wrapped.truth.positions[:, 0], [0, 2, 4, 6, 5, 3, 1], atol=1e-9)
    assert wrapped.rig.imu is None


def test_there_and_back_of_partly_covered_truth(euroc: Callable[..., Path]) -> None:
    mav0 = euroc(frames=5)
    file = mav0 / "state_groundtruth_estimate0" / "data.csv"
    lines = file.read_text().splitlines()
    # Truth from frame 2 on.
    file.write_text("\n".join([lines[0], *lines[7:]]) + "\n")
    wrapped = there_and_back(EurocSource(mav0))
    assert wrapped.truth is not None
    assert [round(x) for x in wrapped.truth.positions[:, 0]] == [2, 4, 3]
    assert wrapped.truth.stamps_ns.tolist() == [START_NS + 2 * STEP_NS * i for i in (1, 2, 3)]


def test_skipped_frames_show_through(euroc: Callable[..., Path]) -> None:
    mav0 = euroc(frames=7)
    broken = mav0 / "cam0" / "data" / f"{START_NS + 4 * STEP_NS}.png"
    source = EurocSource(mav0)
    broken.write_bytes(b"")
    for wrapped, numbers in (
        (blur(source, [99]), [0, 1, 2, 3, 5, 6]),
        (freeze(source, [99]), [0, 1, 2, 3, 5, 6]),
        (drop(source, [0]), [1, 2, 3, 5, 6]),
        (reverse(source), [6, 5, 3, 2, 1, 0]),
        (there_and_back(source), [0, 2, 6, 5, 3, 1]),
    ):
        for _ in range(2):
            assert [number(frame) for frame in wrapped] == numbers
            assert [s.file for s in wrapped.skipped] == [str(broken)]
    assert wrapped.skipped[0].stamp_ns == START_NS + 2 * 2 * STEP_NS


def test_streams_play_forwards_only() -> None:
    stream = Stream()
    assert [number(frame) for frame in freeze(stream, [1])] == [10, 10, 12, 13]
    assert [frame.id for frame in drop(stream, [1])] == [0, 2, 3]
    assert [number(frame) for frame in blank(stream, [1])] == [10, 0, 12, 13]
    for make in (reverse, there_and_back):
        for inside in (stream, blank(stream, [1]), drop(freeze(stream, [1]), [2])):
            with pytest.raises(InputError, match="can only be played forwards"):
                make(inside)


def test_there_and_back_needs_three_frames(source: EurocSource) -> None:
    with pytest.raises(InputError, match="three frames"):
        there_and_back(drop(source, range(2, 7)))


def test_blank_takes_depth_with_it_or_not(tum: Callable[..., Path]) -> None:
    source = TumSource(tum())
    hand, night = blank(source, [3]), blank(source, [3], depth=False)
    for wrapped, is_dark in ((hand, True), (night, False)):
        frames = list(wrapped)
        assert [frame.images[0].any() for frame in frames] == [i != 3 for i in range(8)]
        assert [bool(frame.depth.any()) for frame in frames] == [
            i != 3 or not is_dark for i in range(8)
        ]
    np.testing.assert_array_equal(night.frame(3).depth, source.frame(3).depth)


def test_frozen_dropped_and_reversed_depth(tum: Callable[..., Path]) -> None:
    source = TumSource(tum())
    number = [frame.depth[0, 0] for frame in source]
    assert len(set(number)) == 8
    frozen = [frame.depth[0, 0] for frame in freeze(source, [3, 4])]
    assert frozen == [*number[:3], number[2], number[2], *number[5:]]
    assert [f.depth[0, 0] for f in drop(source, [0, 6])] == [*number[1:6], number[7]]
    assert [f.depth[0, 0] for f in reverse(source)] == number[::-1]
    forth = [*range(0, 8, 2), *range(7, 0, -2)]
    assert [f.depth[0, 0] for f in there_and_back(source)] == [number[i] for i in forth]


def test_pierced_depth(tum: Callable[..., Path]) -> None:
    source = TumSource(tum())
    boxed = pierce_depth(source, [2], box=(30, 5, 20, 10))
    for frame, whole in zip(boxed, source, strict=True):
        lost = (frame.depth == 0) & (whole.depth > 0)
        assert np.count_nonzero(lost) == (200 if frame.id == 2 else 0)
        assert np.all(lost[5:15, 30:50]) == (frame.id == 2)
        np.testing.assert_array_equal(frame.depth[~lost], whole.depth[~lost])
        np.testing.assert_array_equal(frame.images[0], whole.images[0])
    patchy = pierce_depth(source, share=0.4, seed=1)
    lost = [(frame.depth == 0).reshape(6, 8, 8, 8).all((1, 3)) for frame in patchy]
    assert 0.3 < np.mean(lost) < 0.5
    # Each frame has its own holes, the same whenever it is read.
    assert not np.array_equal(lost[0], lost[1])
    np.testing.assert_array_equal(patchy.frame(5).depth, list(patchy)[5].depth)
    assert not np.any(pierce_depth(source, share=1.0).frame(0).depth)
    with pytest.raises(InputError, match=r"share 1\.5 must be from 0 to 1"):
        pierce_depth(source, share=1.5)


def test_rough_depth(tum: Callable[..., Path]) -> None:
    source = TumSource(tum())
    rough = roughen_depth(source, sigma_m=0.01)
    errors = np.array([r.depth - f.depth for r, f in zip(rough, source, strict=True)])
    depth = source.frame(0).depth
    assert rough.frame(3).depth.dtype == np.float32
    assert np.all((rough.frame(3).depth == 0) == (source.frame(3).depth == 0))
    # At z the noise is sigma_m z²: the near and the far end of the slope.
    for columns, z in ((slice(0, 8), 0.92), (slice(56, 64), 2.88)):
        part = errors[:, 24:, columns]
        assert np.std(part) == pytest.approx(0.01 * z**2, rel=0.12)
        assert abs(np.mean(part)) < 0.002 * z**2
    assert np.all(errors[:, depth == 0] == 0)
    np.testing.assert_array_equal(rough.frame(5).depth, list(rough)[5].depth)
    some = roughen_depth(source, [1])
    np.testing.assert_array_equal(some.frame(0).depth, depth)
    with pytest.raises(InputError, match="sigma_m -1 must be 0 or more"):
        roughen_depth(source, sigma_m=-1)


def test_sources_without_depth_stay_as_they_are(source: EurocSource) -> None:
    for wrapped in (pierce_depth(source, share=0.5), roughen_depth(source)):
        frames = list(wrapped)
        assert all(frame.depth is None for frame in frames)
        assert len(frames) == len(source)
