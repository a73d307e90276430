"""Bags of ROS 1 and 2: scans, the wheels, the mount from tf, and bags that are broken."""

import builtins
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bagworlds import BEAMS, SCANS, START_NS, STEP_NS, Robot, write_bag
from odomap.cli import main
from odomap.errors import CalibrationError, InputError, MissingExtra
from odomap.geometry.pose import SE3
from odomap.sensors.rig import LidarMount, Rig
from odomap.sources.bag import BagSource
from odomap.sources.describe import describe
from odomap.sources.open import open as open_source
from odomap.sources.source import RandomAccess

KINDS = ("ros1", "ros1-bz2", "ros1-lz4", "sqlite3", "mcap", "mcap-zstd")


def opened(path: Path, kind: str, robot: Robot | None = None, query: str = "") -> BagSource:
    source = open_source(
        f"{write_bag(path / ('a.bag' if 'ros1' in kind else 'a'), kind, robot)}{query}"
    )
    assert isinstance(source, BagSource)
    return source


@pytest.mark.parametrize("kind", KINDS)
def test_all_kinds_say_the_same(tmp_path: Path, kind: str) -> None:
    source = opened(tmp_path, kind)
    assert isinstance(source, RandomAccess)
    assert len(source) == SCANS
    mount = source.rig.lidars[0]
    assert mount.name == "laser"
    assert mount.angles == pytest.approx((-0.9, 0.9, BEAMS), abs=1e-6)
    assert mount.range_m == pytest.approx((0.1, 10.0))
    assert (mount.rate_hz, mount.sweep) == (pytest.approx(10.0), "counter_clockwise")
    np.testing.assert_allclose(mount.T_body_lidar.t, [0.3, 0, 0], atol=1e-9)
    np.testing.assert_allclose(mount.T_body_lidar.log()[5], np.pi / 2)
    assert source.rig.body_sensor == ""
    frames = list(source)
    for k, frame in enumerate(frames):
        assert (frame.id, frame.stamp_ns) == (k, START_NS + k * STEP_NS)
        assert frame.scan is not None
        lost = [np.nan, np.nan, np.nan, np.nan, np.inf, np.inf]
        np.testing.assert_array_equal(frame.scan[:6], lost)
        expected = np.linspace(1.0, 9.0, BEAMS)[6:] + 0.01 * k
        np.testing.assert_allclose(frame.scan[6:], expected, atol=1e-5)
        # The wheels speak 7 ms before and 43 ms after a scan: 0.1 m each 100 ms.
        assert frame.odometry is not None
        np.testing.assert_allclose(frame.odometry[:3, 3], [0.1 * k + 0.007, 0, 0], atol=1e-6)
        again = source.frame(k)
        np.testing.assert_array_equal(again.scan, frame.scan)
        assert again.stamp_ns == frame.stamp_ns
    assert source.notes == []
    facts = describe(source)
    assert facts["rate_hz"] == 10.0
    assert facts["scans"]["share_invalid"] == pytest.approx(4 / BEAMS, abs=1e-5)
    assert facts["scans"]["share_no_return"] == pytest.approx(2 / BEAMS, abs=1e-5)
    assert facts["details"]["time_increment_s"] == pytest.approx(0.0004)
    with pytest.raises(IndexError):
        source.frame(SCANS)


@pytest.mark.parametrize(("folder", "file"), [("sqlite3", "a/a.db3"), ("mcap", "a/a.mcap")])
def test_files_of_a_folder_alone(tmp_path: Path, folder: str, file: str) -> None:
    whole = opened(tmp_path, folder)
    alone = open_source(tmp_path / file)
    assert len(alone) == SCANS
    assert alone.rig == whole.rig
    (tmp_path / "a" / "metadata.yaml").unlink()
    left = open_source(tmp_path / "a")
    assert len(left) == SCANS
    assert "metadata.yaml is missing" in left.notes[0]  # type: ignore[attr-defined]


def test_the_wheels_by_tf(tmp_path: Path) -> None:
    robot = Robot(odometry="", tf="sent", moves=True)
    source = opened(tmp_path, "ros1", robot)
    np.testing.assert_allclose(source.rig.lidars[0].T_body_lidar.t, [0.3, 0, 0], atol=1e-9)
    assert source.notes == ["no Odometry: the motion of base_link in odom (tf) is taken"]
    odometry = source.frame(3).odometry
    assert odometry is not None
    np.testing.assert_allclose(odometry[:3, 3], [0.307, 0, 0], atol=1e-6)


def test_without_tf_and_without_wheels(tmp_path: Path) -> None:
    lost = opened(tmp_path, "mcap", Robot(tf=""))
    assert lost.rig.lidars[0].T_body_lidar == SE3.identity()
    assert lost.notes == [
        "tf from base_link to laser is missing: the laser is taken to be where base_link is"
    ]
    alone = open_source(write_bag(tmp_path / "b.bag", "ros1", Robot(tf="", odometry="")))
    assert alone.rig.body_sensor == "laser"
    assert (alone.notes, alone.frame(0).odometry) == ([], None)  # type: ignore[attr-defined]
    off = open_source(f"{tmp_path / 'a'}?odometry=off")
    assert off.frame(0).odometry is None  # type: ignore[attr-defined]


def test_several_topics(tmp_path: Path) -> None:
    robot = Robot(scans={"/back/scan": "rear", "/scan": "laser"})
    source = opened(tmp_path, "mcap", robot)
    assert source.rig.lidars[0].name == "laser"
    assert source.notes == ["of 2 LaserScan topics /scan is read; others: ?scan=/back/scan"]
    back = open_source(f"{tmp_path / 'a'}?scan=/back/scan")
    np.testing.assert_allclose(back.rig.lidars[0].T_body_lidar.t, [-0.4, 0, 0], atol=1e-9)
    with pytest.raises(InputError, match=r"no LaserScan topic '/bck/scan' \(did you mean '/back"):
        open_source(f"{tmp_path / 'a'}?scan=/bck/scan")
    with pytest.raises(InputError, match="no Odometry topic '/wheels'; there are: /odom"):
        open_source(f"{tmp_path / 'a'}?odometry=/wheels")
    with pytest.raises(InputError, match="no option 'speed'"):
        open_source(f"{tmp_path / 'a'}?speed=2")


@pytest.mark.parametrize("kind", ["ros1", "mcap", "sqlite3"])
def test_unknown_types_cost_nothing(tmp_path: Path, kind: str) -> None:
    source = opened(tmp_path, kind, Robot(strange=True))
    assert len(list(source)) == SCANS
    assert "acme_msgs/msg/Warp" in source.details["topics"]


def test_scans_that_differ_are_left_out(tmp_path: Path) -> None:
    changes = {2: {"ranges": np.ones(7, np.float32)}, 4: {"angle_min": -0.5}}
    stamps = [START_NS + k * STEP_NS for k in (0, 1, 2, 3, 4, 6, 5, 5)]
    source = opened(tmp_path, "ros1", Robot(changes=changes, stamps=stamps))
    assert len(source) == 5
    assert [f.stamp_ns for f in source] == [START_NS + k * STEP_NS for k in (0, 1, 3, 6, 5)]
    assert [item.reason for item in source.skipped] == [
        "has other beams or angles than most",
        "has other beams or angles than most",
        "stamp 1700000000.623456789 is repeated",
    ]
    assert source.notes == [
        "1 stamps go back, by 0.100 s at most: scans stay in the order of the log"
    ]
    for k, frame in enumerate(source):
        np.testing.assert_array_equal(source.frame(k).scan, frame.scan)
    by_stamp = open_source(f"{tmp_path / 'a.bag'}?order=stamps")
    assert [f.stamp_ns for f in by_stamp] == [START_NS + k * STEP_NS for k in (0, 1, 3, 5, 6)]


def test_scans_outside_the_time_of_the_wheels(tmp_path: Path) -> None:
    stamps = [START_NS + k * STEP_NS for k in range(SCANS - 1)] + [START_NS + 100 * STEP_NS]
    source = opened(tmp_path, "mcap", Robot(stamps=stamps))
    assert source.notes == ["1 scans are outside the time of the odometry"]
    assert source.frame(SCANS - 1).odometry is None
    assert source.frame(SCANS - 2).odometry is not None


@pytest.mark.parametrize("kind", ["ros1", "ros1-lz4", "mcap", "mcap-zstd"])
@pytest.mark.parametrize("share", [0.98, 0.6])
def test_cut_bags_give_what_comes_before(tmp_path: Path, kind: str, share: float) -> None:
    stamps = [START_NS + k * STEP_NS for k in range(1500)]
    path = write_bag(tmp_path / ("a.bag" if "ros1" in kind else "a"), kind, Robot(stamps=stamps))
    file = path / "a.mcap" if path.is_dir() else path
    whole = open_source(path)
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    cut = open_source(path)
    assert share / 3 * len(whole) < len(cut) <= len(whole)
    assert "has no index that can be used" in " ".join(cut.notes)  # type: ignore[attr-defined]
    frames = list(cut)
    assert len(frames) == len(cut)
    for k in (0, len(cut) - 1):
        ours, theirs = cut.frame(k), whole.frame(k)  # type: ignore[attr-defined]
        assert ours.stamp_ns == theirs.stamp_ns == frames[k].stamp_ns
        np.testing.assert_array_equal(ours.scan, frames[k].scan)
    np.testing.assert_allclose(cut.rig.lidars[0].T_body_lidar.t, [0.3, 0, 0], atol=1e-9)


def test_a_bag_without_an_index(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.bag.active", "ros1")
    data = path.read_bytes()
    at = data.index(b"index_pos=") + len(b"index_pos=")
    path.write_bytes(data[:at] + bytes(8) + data[at + 8 :])
    source = open_source(path)
    assert [f.stamp_ns for f in source] == [START_NS + k * STEP_NS for k in range(SCANS)]
    assert "Bag is not indexed" in source.notes[0]  # type: ignore[attr-defined]


def test_a_damaged_database(tmp_path: Path) -> None:
    stamps = [START_NS + k * STEP_NS for k in range(1500)]
    path = write_bag(tmp_path / "a", "sqlite3", Robot(stamps=stamps)) / "a.db3"
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 20000] = b"\xff" * 20000
    path.write_bytes(data)
    source = open_source(tmp_path / "a")
    assert 100 < len(list(source)) < 1500
    assert "has no index that can be used" in " ".join(source.notes)  # type: ignore[attr-defined]


@pytest.mark.parametrize("kind", KINDS)
def test_bags_with_wrong_bytes_never_crash(tmp_path: Path, kind: str) -> None:
    path = write_bag(tmp_path / ("a.bag" if "ros1" in kind else "a"), kind)
    file = next(path.glob("a.*")) if path.is_dir() else path
    data = file.read_bytes()
    rng = np.random.default_rng(5)
    read = 0
    for _ in range(25):
        broken = bytearray(data)
        for at in rng.integers(len(data), size=3).tolist():
            broken[at] = int(rng.integers(256))
        file.write_bytes(broken[: int(rng.uniform(0.2, 1.5) * len(data))])
        try:
            read += len(list(open_source(path)))
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017
    assert read > 0


def test_what_is_no_bag_says_so(tmp_path: Path) -> None:
    cases: dict[str, bytes] = {
        "empty.bag": b"",
        "text.bag": b"hello\n",
        "noise.mcap": b"\x89MCAP0\r\n" + b"\xff" * 400,
        "start.bag": b"#ROSBAG V2.0\n" + b"\xff" * 400,
        "bad.db3": b"SQLite format 3\0" + b"\xff" * 400,
    }
    for name, data in cases.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match=f"{name}: cannot be read: "):
            open_source(tmp_path / name)
    sqlite3.connect(tmp_path / "other.db3").close()
    with pytest.raises(InputError, match=r"other\.db3: cannot be read"):
        open_source(tmp_path / "other.db3")
    no_scans = write_bag(tmp_path / "b.bag", "ros1", Robot(scans={}))
    with pytest.raises(InputError, match=r"holds no LaserScan; it holds /odom \(nav_msgs/msg"):
        open_source(no_scans)
    rig = Rig(lidars=(LidarMount("x", angles=(0, 1, 10)),))
    path = write_bag(tmp_path / "c.bag", "ros1")
    with pytest.raises(CalibrationError, match="scans have 91 beams, the rig says 10"):
        open_source(path, rig)


def test_angles_in_degrees_are_told(tmp_path: Path) -> None:
    changes = {k: {"angle_min": -90.0, "angle_increment": 2.0} for k in range(SCANS)}
    with pytest.raises(CalibrationError, match=r"a\.bag: lidar 'laser': angles .* in radians"):
        opened(tmp_path, "ros1", Robot(changes=changes))


def test_without_rosbags_the_mend_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_bag(tmp_path / "a.bag", "ros1")
    real = builtins.__import__

    def without(name: str, *rest: Any, **named: Any) -> Any:
        if name.startswith("rosbags"):
            raise ImportError(name)
        return real(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingExtra, match=r"pip install 'odomap\[ros\]'"):
        open_source(path)


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_bag(tmp_path / "a.bag", "ros1", Robot(tf=""))
    assert main(["info", str(tmp_path / "a.bag"), "--check"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("a.bag (bag)\n")
    assert "lidar laser    91 beams from -51.566° to 51.566°" in out
    assert "readable       8" in out
    assert "note           tf from base_link to laser is missing" in out
