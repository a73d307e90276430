"""Clouds in bags: any layout, times in any unit, the mount from tf, and faults."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import odomap
from bagworlds import SCANS, START_NS, STEP_NS, Robot, cloud_fields, write_bag
from odomap.cli import main
from odomap.errors import CalibrationError, InputError
from odomap.sensors.rig import LidarMount, Rig
from odomap.sources.bag import BagSource
from odomap.sources.cloudbag import CloudBagSource
from odomap.sources.source import RandomAccess
from sweepworlds import turning

Columns = dict[str, NDArray[np.generic]]
Change = Callable[[Columns, int], Columns]


def small(k: int) -> Columns:
    return turning(k, columns=90)


def robot(change: Change = lambda columns, k: columns, **layout: Any) -> Robot:
    """Return a robot with a 3D LiDAR where its laser was."""
    return Robot(
        scans={}, clouds={"/points": "laser"}, odometry="",
        cloud=lambda k: cloud_fields(change(small(k), k), **layout),
    )  # fmt: skip


def opened(path: Path, robot: Robot, kind: str = "mcap", query: str = "") -> CloudBagSource:
    name = "a.bag" if "ros1" in kind else "a"
    source = odomap.open(f"{write_bag(path / name, kind, robot)}{query}")
    assert isinstance(source, CloudBagSource)
    return source


@pytest.mark.parametrize("kind", ["ros1", "ros1-bz2", "sqlite3", "mcap", "mcap-zstd"])
def test_all_kinds_say_the_same(tmp_path: Path, kind: str) -> None:
    source = opened(tmp_path, robot(), kind)
    assert isinstance(source, RandomAccess)
    assert (len(source), source.notes, source.skipped) == (SCANS, [], [])
    mount = source.rig.lidars[0]
    assert (mount.name, mount.beams, mount.angles) == ("laser", 16, (0.0, 0.0, 0))
    assert mount.rate_hz == pytest.approx(10)
    np.testing.assert_allclose(mount.T_body_lidar.t, [0.3, 0, 0], atol=1e-9)
    np.testing.assert_allclose(mount.T_body_lidar.log()[5], np.pi / 2)
    for k, frame in enumerate(source):
        there = small(k)
        assert (frame.id, frame.stamp_ns) == (k, START_NS + k * STEP_NS)
        for sweep in (frame.cloud, source.frame(k).cloud):
            assert sweep is not None
            assert sweep.times is not None
            np.testing.assert_array_equal(sweep.points[:, 2], there["z"])
            np.testing.assert_array_equal(sweep.beams, there["ring"])
            np.testing.assert_array_equal(sweep.intensities, there["intensity"])
            np.testing.assert_allclose(sweep.times, there["t"] * 1e-9, atol=1e-9)
    with pytest.raises(IndexError):
        source.frame(SCANS)


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(("gap", "height", "line_gap"), [(0, 1, 0), (5, 1, 7), (1, 2, 9)])
def test_any_layout(tmp_path: Path, big: bool, gap: int, height: int, line_gap: int) -> None:
    def even(columns: Columns, k: int) -> Columns:
        count = len(columns["x"]) // 2 * 2
        return {name: column[:count] for name, column in columns.items()}

    source = opened(tmp_path, robot(even, big=big, gap=gap, height=height, line_gap=line_gap))
    sweep = source.frame(3).cloud
    assert sweep is not None
    there = even(small(3), 3)
    np.testing.assert_array_equal(sweep.points[:, 1], there["y"])
    np.testing.assert_array_equal(sweep.beams, there["ring"])


@pytest.mark.parametrize(
    ("name", "make", "how"),
    [
        ("t", lambda t, stamp: t.astype(np.uint32), "in nanoseconds, since the stamp"),
        ("offset_time", lambda t, stamp: (t / 1e3).astype(np.float32), "in microseconds, since"),
        ("time", lambda t, stamp: (t * 1e-9).astype(np.float32), "in seconds, since the stamp"),
        ("timestamp", lambda t, stamp: (t + stamp) * 1e-9, "in seconds, absolute"),
        ("timestamp", lambda t, stamp: (t + stamp).astype(np.float64), "in nanoseconds, absolute"),
        ("time_stamp", lambda t, stamp: (t / 1e3 + 9e8).astype(np.uint32), "of another clock"),
    ],
)  # fmt: skip
def test_times_in_every_unit(
    tmp_path: Path, name: str, make: Callable[..., NDArray[np.generic]], how: str,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    def change(columns: Columns, k: int) -> Columns:
        t = columns.pop("t").astype(np.float64)
        return {**columns, name: make(t, START_NS + k * STEP_NS)}

    source = opened(tmp_path, robot(change))
    for k in (0, 5):
        sweep = source.frame(k).cloud
        assert sweep is not None
        assert sweep.times is not None
        assert sweep.times.dtype == np.float64
        expected = small(k)["t"] * 1e-9
        expected -= expected.min() if "another" in how else 0.0
        np.testing.assert_allclose(sweep.times, expected, atol=2e-6)
    assert main(["info", str(tmp_path / "a")]) == 0
    out = capsys.readouterr().out
    assert f"from '{name}', " in out
    assert how in out


def test_times_in_no_unit_are_an_error_that_says_the_mend(tmp_path: Path) -> None:
    def change(columns: Columns, k: int) -> Columns:
        return {**columns, "t": (columns["t"] * 2e-13).astype(np.float32)}

    path = write_bag(tmp_path / "a", "mcap", robot(change))
    with pytest.raises(InputError, match=r"a: times of points in 't' .* in no unit .*\?time=off"):
        odomap.open(path)
    assert odomap.open(f"{path}?time=off").frame(0).cloud.times is None


def test_rows_that_did_not_return(tmp_path: Path) -> None:
    """NaN rows stay where they are; a sweep of nothing else is a frame, and so is an empty one."""

    def change(columns: Columns, k: int) -> Columns:
        if k == 4:
            return {name: column[:0] for name, column in columns.items()}
        if k == 5:
            return {n: np.zeros_like(c) for n, c in columns.items()}
        lost = np.s_[:] if k == 2 else np.s_[::5]
        for axis in "xyz":
            columns[axis][lost] = np.nan
        return columns

    source = opened(tmp_path, robot(change))
    frames = list(source)
    assert len(frames) == SCANS
    assert source.skipped == []
    assert [len(f.cloud) for f in frames if f.cloud is not None][4] == 0
    assert frames[2].cloud is not None
    assert np.isnan(frames[2].cloud.points).all()
    assert frames[3].cloud is not None
    assert np.isnan(frames[3].cloud.points[::5]).all()
    assert source.rig.lidars[0].beams == 16
    assert source.survey.share_lost > 0.15


def test_stamps_that_go_back_and_repeat(tmp_path: Path) -> None:
    bot = robot()
    bot.stamps[3], bot.stamps[4] = bot.stamps[4], bot.stamps[3]
    bot.stamps[6] = bot.stamps[5]
    path = write_bag(tmp_path / "a", "mcap", bot)
    source = odomap.open(path)
    assert isinstance(source, CloudBagSource)
    assert (np.diff(source.stamps_ns) > 0).all()
    assert len(source) == SCANS - 1
    assert "stamps go back" in source.notes[0]
    assert "is repeated" in source.skipped[0].reason
    order = [0, 1, 2, 4, 3, 5, 7]
    for frame, k in zip(source, order, strict=True):
        assert frame.cloud is not None
        np.testing.assert_array_equal(frame.cloud.points[:, 0], small(k)["x"])
        again = source.frame(frame.id).cloud
        assert again is not None
        np.testing.assert_array_equal(again.points, frame.cloud.points)
    logged = odomap.open(f"{path}?order=log")
    assert [frame.stamp_ns for frame in logged] == [s for k, s in enumerate(bot.stamps) if k != 6]


def test_topics(tmp_path: Path) -> None:
    bot = robot()
    bot.clouds = {"/front/points": "laser", "/rear/points": "rear"}
    path = write_bag(tmp_path / "a", "mcap", bot)
    source = odomap.open(path)
    assert "?cloud=/rear/points" in source.notes[0]
    rear = odomap.open(f"{path}?cloud=/rear/points")
    assert rear.rig.lidars[0].name == "rear"
    np.testing.assert_allclose(rear.rig.lidars[0].T_body_lidar.t, [-0.4, 0, 0], atol=1e-9)
    with pytest.raises(InputError, match=r"no PointCloud2 topic '/rear/point' \(did you mean"):
        odomap.open(f"{path}?cloud=/rear/point")
    with pytest.raises(InputError, match="no option 'clod'"):
        odomap.open(f"{path}?clod=/rear/points")


def test_a_bag_with_a_laser_too(tmp_path: Path) -> None:
    bot = robot()
    bot.scans = {"/scan": "laser"}
    path = write_bag(tmp_path / "a", "mcap", bot)
    flat = odomap.open(path)
    assert isinstance(flat, BagSource)
    assert any("?cloud=/points" in note for note in flat.notes)
    assert isinstance(odomap.open(f"{path}?cloud=/points"), CloudBagSource)
    plain = write_bag(tmp_path / "b", "mcap", Robot())
    with pytest.raises(InputError, match="no PointCloud2 topic '/points'; there are: none"):
        odomap.open(f"{plain}?cloud=/points")


def test_rigs(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a", "mcap", robot())
    given = Rig(lidars=(LidarMount("top", range_m=(1.0, 30.0)),))
    mount = odomap.open(path, given).rig.lidars[0]
    assert (mount.name, mount.range_m, mount.beams) == ("top", (1.0, 30.0), 16)
    assert mount.T_body_lidar.t.tolist() == [0, 0, 0]
    with pytest.raises(CalibrationError, match="16 beams, the rig says 64: mend 'beams'"):
        odomap.open(path, Rig(lidars=(LidarMount("top", beams=64),)))


def test_without_tf_the_lidar_is_the_body(tmp_path: Path) -> None:
    bot = robot()
    bot.tf = ""
    source = opened(tmp_path, bot)
    assert source.rig.body_sensor == "laser"


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
@pytest.mark.parametrize("share", [0.6, 0.9])
def test_cut_bags_give_what_comes_before(tmp_path: Path, kind: str, share: float) -> None:
    bot = robot()
    bot.cloud = lambda k: cloud_fields(turning(k, columns=720))  # several chunks
    path = write_bag(tmp_path / ("a.bag" if kind == "ros1" else "a"), kind, bot)
    file = path if path.is_file() else next(path.glob("*.mcap"))
    data = file.read_bytes()
    cut = tmp_path / f"cut{file.suffix}"
    cut.write_bytes(data[: int(share * len(data))])
    source = odomap.open(cut)
    frames = list(source)
    assert SCANS * share / 2 < len(frames) < SCANS
    for frame in frames:
        assert frame.cloud is not None
        np.testing.assert_array_equal(frame.cloud.points[:, 0], turning(frame.id, columns=720)["x"])
    again = source.frame(len(frames) - 1).cloud  # type: ignore[attr-defined]
    np.testing.assert_array_equal(again.points, frames[-1].cloud.points)
    assert any("no index" in note for note in source.notes)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"width": 10**6}, "bytes, but"),
        ({"row_step": 5, "height": 2}, "says rows of 5 bytes"),
        ({"point_step": 8}, "lies at byte"),
    ],
)
def test_messages_that_lie(tmp_path: Path, wrong: dict[str, Any], says: str) -> None:
    bot = robot()
    make = bot.cloud
    bot.cloud = lambda k: {**make(k), **(wrong if k == 3 else {})}
    source = opened(tmp_path, bot)
    assert [frame.id for frame in source] == [0, 1, 2, 4, 5, 6, 7]
    assert says in source.skipped[0].reason
    assert source.skipped[0].file == "/points:3"
    bot.cloud = lambda k: {**make(k), **wrong}
    with pytest.raises(InputError, match=r"no sweep of .* can be read"):
        list(odomap.open(write_bag(tmp_path / "b", "mcap", bot)))


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_bags_with_wrong_bytes_never_crash(tmp_path: Path, kind: str) -> None:
    path = write_bag(tmp_path / ("a.bag" if kind == "ros1" else "a"), kind, robot())
    file = path if path.is_file() else next(path.glob("a.*"))
    data, rng = file.read_bytes(), np.random.default_rng(3)
    read = 0
    for _ in range(25):
        broken = bytearray(data)
        for place in rng.integers(0, len(data), 40):
            broken[place] = int(rng.integers(0, 256))
        for place in rng.integers(0, min(4000, len(data)), 3):  # where topics and fields stand
            broken[place] = int(rng.integers(0, 256))
        file.write_bytes(broken)
        with suppress(InputError):
            read += len(list(odomap.open(path)))
    assert read > 0
