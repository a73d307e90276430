"""Disturbances of lasers do what they say, nest, and leave the rest alone."""

import numpy as np
import pytest

from odomap.errors import ConfigError, InputError
from odomap.geometry.lie import se3_inverse
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig
from odomap.sources import disturb
from odomap.sources.describe import describe
from odomap.sources.open import open as open_source
from odomap.sources.simulated import SimulatedSource
from odomap.sources.source import Source

NAME = "sim:hall?sensors=laser&seed=2&frames=12&beams=181"


@pytest.fixture
def hall() -> SimulatedSource:
    return SimulatedSource(NAME)


def points_of(rig: Rig, frame: Frame) -> np.ndarray:
    """Return the points of a scan in the body, by increasing x and y."""
    mount = rig.lidars[0]
    assert frame.scan is not None
    angles = np.linspace(*mount.angles[:2], mount.angles[2])
    points = np.column_stack([np.cos(angles), np.sin(angles), 0 * angles]) * frame.scan[:, None]
    points = mount.T_body_lidar @ points[np.isfinite(frame.scan)]
    return points[np.lexsort(points.T.round(6))]


def test_the_name_of_a_world(hall: SimulatedSource) -> None:
    source = open_source(NAME)
    assert source.name == "sim:hall?sensors=laser&seed=2&frames=12"
    facts = describe(source)
    assert facts["lidars"][0]["beams"] == 181
    assert facts["truth"]["poses"] == 12
    assert facts["rate_hz"] == 10.0
    assert facts["scans"]["odometry_path_m"] == pytest.approx(facts["truth"]["path_m"], rel=0.1)
    assert source.rig.body_sensor == ""
    for frame in source:
        assert frame.images == ()
        assert frame.odometry is not None
    with pytest.raises(ConfigError, match=r"no field 'beam' \(did you mean 'beams'\?\)"):
        open_source("sim:hall?sensors=laser&beam=3")
    with pytest.raises(ConfigError, match="beams: 'many' is not a whole number"):
        open_source("sim:hall?sensors=laser&beams=many")
    with pytest.raises(ConfigError, match="there is no field 'rounds'"):
        open_source("sim:room?rounds=2")
    assert len(open_source("sim:building?sensors=laser&rounds=2")) > 2000


def test_people_hide_a_share_of_the_scan(hall: SimulatedSource) -> None:
    peopled = disturb.walkers(hall, range(4, 8), share=0.2, seed=1)
    shapes = []
    for frame, plain in zip(peopled, hall, strict=True):
        assert frame.scan is not None
        assert plain.scan is not None
        changed = ~((frame.scan == plain.scan) | (np.isnan(frame.scan) & np.isnan(plain.scan)))
        if frame.id not in range(4, 8):
            assert not changed.any()
            continue
        assert 0.15 < changed.mean() <= 0.2
        assert frame.scan[changed].max() < 3.0
        assert not (frame.scan > plain.scan).any()
        shapes.append(changed)
    assert not np.array_equal(shapes[0], shapes[-1])
    again = disturb.walkers(hall, range(4, 8), share=0.2, seed=1)
    np.testing.assert_array_equal(again.frame(5).scan, peopled.frame(5).scan)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("how", "count", "finite"), [("nan", 181, 0), ("inf", 181, 0), ("empty", 0, 0), ("one", 181, 1)]
)
def test_scans_that_say_nothing(hall: SimulatedSource, how: str, count: int, finite: int) -> None:
    lost = disturb.lose_scans(hall, [3], how)  # type: ignore[arg-type]
    for frame in lost:
        assert frame.scan is not None
        if frame.id == 3:
            assert len(frame.scan) == count
            assert np.isfinite(frame.scan).sum() == finite
            assert np.isinf(frame.scan).all() == (how in ("inf", "empty"))
        else:
            assert np.isfinite(frame.scan).mean() > 0.9


@pytest.mark.parametrize("kind", ["mirror", "turn"])
def test_mounts_the_rig_knows_of_change_nothing(hall: SimulatedSource, kind: str) -> None:
    def made(told: bool) -> Source:
        if kind == "mirror":
            return disturb.mirror_laser(hall, told=told)
        return disturb.turn_laser(hall, 0.7, told=told)

    plain = points_of(hall.rig, hall.frame(5))
    told, untold = made(True), made(False)
    assert told.rig != hall.rig
    known = points_of(told.rig, told.frame(5))  # type: ignore[attr-defined]
    np.testing.assert_allclose(known, plain, atol=1e-9)
    wrong = points_of(untold.rig, untold.frame(5))  # type: ignore[attr-defined]
    assert np.abs(wrong - plain).max() > 0.5


def test_a_wrong_field_of_view(hall: SimulatedSource) -> None:
    wide = disturb.widen(hall, 1.1)
    assert wide.rig.lidars[0].angles[1] == pytest.approx(1.1 * hall.rig.lidars[0].angles[1])
    assert hall.rig.lidars[0].angles[1] == pytest.approx(np.radians(135))


@pytest.mark.parametrize("factor", [0.0, 3.0])
def test_wheels_slip_and_go_on(hall: SimulatedSource, factor: float) -> None:
    slipped = disturb.slip(hall, [4, 5], factor=factor)
    wheels = [frame.odometry for frame in slipped]
    assert hall.odometry is not None
    for k in range(1, len(wheels)):
        before, now = wheels[k - 1], wheels[k]
        assert before is not None
        assert now is not None
        step = (se3_inverse(before) @ now)[:2, 3]
        plain = (se3_inverse(hall.odometry[k - 1]) @ hall.odometry[k])[:2, 3]
        np.testing.assert_allclose(step, (factor if k in (4, 5) else 1.0) * plain, atol=1e-9)


def test_stamps_that_go_back(hall: SimulatedSource) -> None:
    late = disturb.set_back(hall, [6], by_s=0.25)
    stamps = [frame.stamp_ns for frame in late]
    assert stamps == late.stamps_ns.tolist()  # type: ignore[attr-defined]
    assert stamps[6] == int(hall.stamps_ns[6]) - 250_000_000
    assert np.argmin(np.diff(stamps)) == 5


def test_the_general_ones_keep_scans_and_wheels(hall: SimulatedSource) -> None:
    dropped = disturb.drop(disturb.duplicate(hall, [2]), [5, 6])
    frames = list(dropped)
    assert [f.id for f in frames] == [0, 1, 2, 2, 3, 4, 7, 8, 9, 10, 11]
    np.testing.assert_array_equal(frames[2].scan, frames[3].scan)
    assert hall.odometry is not None
    np.testing.assert_array_equal(frames[6].odometry, hall.odometry[7])


def test_what_cannot_be_disturbed_says_so(hall: SimulatedSource) -> None:
    cameras = SimulatedSource("sim:room?frames=1&resolution=64x48")
    for call, words in (
        (lambda: disturb.walkers(hall, [1], share=2), "share 2 must be from 0 to 1"),
        (lambda: disturb.walkers(cameras, [0]), "walkers needs a rig with a 2D laser"),
        (lambda: disturb.lose_scans(hall, [1], "some"), "how 'some' is none of"),  # type: ignore[arg-type]
        (lambda: disturb.widen(hall, 0.0), "factor 0.0 must be finite and above 0"),
        (lambda: disturb.slip(cameras, [0]), "slip needs a source with odometry"),
        (lambda: disturb.slip(hall, [0], factor=np.nan), "factor nan must be finite"),
        (lambda: disturb.set_back(hall, [0], by_s=np.inf), "by_s inf must be finite"),
    ):
        with pytest.raises(InputError, match=words):
            call()
