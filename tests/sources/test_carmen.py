"""CARMEN logs: angles, stamps as text, mounts, what no return means, and logs that are broken."""

import bz2
import gzip
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from odomap.errors import CalibrationError, InputError
from odomap.geometry.pose import SE3
from odomap.sensors.rig import LidarMount, Rig
from odomap.sources.carmen import CarmenSource
from odomap.sources.describe import describe
from odomap.sources.open import open as open_source
from odomap.sources.scans import no_return

HEAD = "# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp\n"


def flaser(
    k: int, ranges: Sequence[object], stamp: str = "", lead: float = 0.0, kind: str = "FLASER"
) -> str:
    """Return the line of scan k, on a body that drives along x, 0.5 m a scan."""
    cells = [kind, len(ranges), *ranges, 0.5 * k + lead, 0, 0, 0.5 * k, 0, 0]
    cells += [stamp or f"976052857.{337530 + k}", "nohost", 0.2 * k]
    return " ".join(map(str, cells)) + "\n"


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    def make(*lines: str, name: str = "a.clf") -> Path:
        path = tmp_path / name
        path.write_text(HEAD + "".join(lines))
        return path

    return make


Write = Callable[..., Path]


def test_scans_stamps_and_odometry(write: Write) -> None:
    path = write(
        "PARAM robot_frontlaser_offset 0.0 nohost 0\n",
        *(flaser(k, [1.5, 2.25, 0.0, -1.0, "nan", *np.linspace(2, 8, 175)]) for k in range(3)),
        "ODOM 0 0 0 0 0 0 976052857.337284 nohost 0.0\n",
    )
    source = open_source(path)
    assert isinstance(source, CarmenSource)
    frames = list(source)
    assert [f.stamp_ns for f in frames] == [976052857337530000 + 1000 * k for k in range(3)]
    for k, frame in enumerate(frames):
        assert frame.scan is not None
        assert frame.scan.dtype == np.float64
        np.testing.assert_array_equal(frame.scan[:5], [1.5, 2.25, np.nan, np.nan, np.nan])
        assert frame.odometry is not None
        np.testing.assert_allclose(SE3(frame.odometry).t, [0.5 * k, 0, 0])
        assert any(frame.odometry is a for a in frame.arrays())
    assert source.rig.body_sensor == "laser"
    facts = describe(source)
    assert facts["scans"]["share_invalid"] == pytest.approx(1 / 60, abs=1e-5)
    assert facts["scans"]["no_return_m"] is None
    assert facts["scans"]["odometry_path_m"] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("count", "first", "last"),
    [(180, -90, 89), (181, -90, 90), (361, -90, 90), (360, -90, 89.5), (720, -90, 89.75)],
)
def test_angles_of_the_half_plane(write: Write, count: int, first: float, last: float) -> None:
    source = CarmenSource(write(flaser(0, [1.0] * count), flaser(1, [1.0] * count)))
    angles = source.rig.lidars[0].angles
    np.testing.assert_allclose(np.degrees(angles[:2]), [first, last])
    assert angles[2] == count
    assert source.notes == []


def test_an_unusual_number_of_beams_is_doubted_and_can_be_told(write: Write) -> None:
    path = write(flaser(0, [1.0] * 1081), flaser(1, [1.0] * 1081))
    assert "1081 beams are taken to go over 180 degrees" in CarmenSource(path).notes[0]
    told = open_source(f"{path}?fov_deg=270")
    np.testing.assert_allclose(np.degrees(told.rig.lidars[0].angles[:2]), [-135, 135])
    for wrong in ("wide", "400"):
        with pytest.raises(InputError, match="fov_deg"):
            open_source(f"{path}?fov_deg={wrong}")


def test_a_rig_says_mount_and_angles(write: Write) -> None:
    path = write(flaser(0, [1.0] * 9), flaser(1, [1.0] * 9))
    turned = SE3.exp([0, 0, 0, np.pi, 0, 0])
    rig = Rig(lidars=(LidarMount("upside", turned, angles=(-0.4, 0.4, 9)),))
    source = open_source(path, rig)
    assert source.rig.lidars == rig.lidars
    with pytest.raises(CalibrationError, match="scans have 9 beams, the rig says 10"):
        open_source(path, Rig(lidars=(LidarMount("x", angles=(0, 1, 10)),)))
    with pytest.raises(CalibrationError, match="the rig has 0 LiDARs"):
        open_source(path, Rig())


def test_no_return_is_what_repeats_as_the_largest() -> None:
    rng = np.random.default_rng(0)
    room = rng.exponential(4.0, (100, 180)).clip(0.1, 30.0)
    assert no_return(room[room < 29.0]) == np.inf
    coded = np.where(rng.random(room.shape) < 0.02, 81.83, room)
    assert no_return(coded) == pytest.approx(81.83)
    assert no_return(rng.uniform(0.5, 10.0, (100, 180))) == np.inf
    assert no_return(np.full((2, 3), np.nan)) == np.inf


def test_no_return_becomes_infinite(write: Write) -> None:
    ranges = [*np.linspace(0.5, 20, 170).tolist(), *[81.83] * 8, 81.91, 81.87]
    source = CarmenSource(write(*(flaser(k, ranges) for k in range(3))))
    scan = source.frame(1).scan
    assert scan is not None
    assert np.isinf(scan[170:]).all()
    assert np.isfinite(scan[:170]).all()
    assert source.rig.lidars[0].range_m[1] == pytest.approx(81.91)


def test_mounts(write: Write) -> None:
    ahead = CarmenSource(write(*(flaser(k, [1.0] * 4, lead=0.3) for k in range(3))))
    np.testing.assert_allclose(ahead.rig.lidars[0].T_body_lidar.t, [0.3, 0, 0], atol=1e-9)
    assert ahead.rig.body_sensor == ""
    param = "PARAM robot_front_laser_offset 0.2 nohost 0\n"
    said = CarmenSource(write(param, *(flaser(k, [1.0] * 4) for k in range(3))))
    np.testing.assert_allclose(said.rig.lidars[0].T_body_lidar.t, [0.2, 0, 0], atol=1e-9)
    moved = CarmenSource(write(param, *(flaser(k, [1.0] * 4, lead=0.1 * k) for k in range(3))))
    np.testing.assert_allclose(moved.rig.lidars[0].T_body_lidar.t, [0.2, 0, 0], atol=1e-9)
    assert any("corrected log" in note for note in moved.notes)


def test_the_new_kind_of_message(write: Write) -> None:
    def robot(k: int) -> str:
        cells = ["ROBOTLASER1", 0, -1.0, 2.0, 0.5, 8.0, 0.01, 0, 5, 1, 2, 3, 8.0, 9.0, 2, 7, 7]
        cells += [0.5 * k + 0.1, 0, 0, 0.5 * k, 0, 0, 0, 0, 0.2, 0.2, 1e6, f"12.{k}", "pc", 0.1 * k]
        return " ".join(map(str, cells)) + "\n"

    source = CarmenSource(write(*(robot(k) for k in range(4)), flaser(0, [1.0] * 5, kind="RLASER")))
    mount = source.rig.lidars[0]
    assert mount.angles == pytest.approx((-1.0, 1.0, 5))
    assert mount.range_m == (0.0, 8.0)
    np.testing.assert_allclose(mount.T_body_lidar.t, [0.1, 0, 0], atol=1e-9)
    np.testing.assert_array_equal(source.frame(2).scan, [1, 2, 3, np.inf, np.inf])
    assert source.frame(2).stamp_ns == 12_200_000_000
    assert "1 RLASER scans are of another laser: ?scan=RLASER" in source.notes


@pytest.mark.parametrize(("suffix", "pack"), [(".bz2", bz2.compress), (".gz", gzip.compress)])
def test_packed_and_cut(
    write: Write, tmp_path: Path, suffix: str, pack: Callable[[bytes], bytes]
) -> None:
    rng = np.random.default_rng(1)
    plain = write(*(flaser(k, rng.uniform(1, 9, 90).round(4).tolist()) for k in range(4000)))
    packed = tmp_path / f"a.clf{suffix}"
    packed.write_bytes(pack(plain.read_bytes()))
    whole = open_source(packed)
    assert len(whole) == 4000
    packed.write_bytes(packed.read_bytes()[: packed.stat().st_size * 3 // 4])
    cut = open_source(packed)
    assert 0 < len(cut) < 4000
    assert any("copied in part" in note for note in cut.notes)  # type: ignore[attr-defined]
    for k in (0, len(cut) - 1):
        a, b = cut.frame(k), whole.frame(k)  # type: ignore[attr-defined]
        assert a.stamp_ns == b.stamp_ns
        np.testing.assert_array_equal(a.scan, b.scan)


def test_stamps_that_go_back_keep_the_order_of_the_log(write: Write) -> None:
    stamps = ["5.0", "5.4", "5.2", "5.2", "5.6"]
    path = write(*(flaser(k, [1.0 + k] * 4, stamp) for k, stamp in enumerate(stamps)))
    source = open_source(path)
    assert [f.stamp for f in source] == pytest.approx([5.0, 5.4, 5.2, 5.6])
    assert [s.reason for s in source.skipped] == ["stamp 5.200000000 is repeated"]
    facts = describe(source)
    assert facts["notes"][0] == (
        "1 stamps go back, by 0.200 s at most: scans stay in the order of the log"
    )
    assert facts["rate_hz"] == 5.0
    by_stamp = open_source(f"{path}?order=stamps")
    assert [f.scan[0] for f in by_stamp if f.scan is not None] == [1, 3, 2, 5]
    with pytest.raises(InputError, match="order 'time' is none of log, stamps"):
        open_source(f"{path}?order=time")


def test_logs_whose_messages_have_no_stamps(write: Write) -> None:
    logged = CarmenSource(write(*(flaser(k, [1.0] * 4, "0.0") for k in range(4))))
    assert logged.stamps_ns.tolist() == [0, 200_000_000, 400_000_000, 600_000_000]
    assert "times of logging" in logged.notes[0]
    lines = [flaser(k, [1.0] * 4).split()[:-3] for k in range(4)]
    bare = CarmenSource(write(*(" ".join([*line, "0", "pc", "0"]) + "\n" for line in lines)))
    assert bare.stamps_ns.tolist() == [0, 100_000_000, 200_000_000, 300_000_000]


def test_bad_lines_cost_themselves(write: Write) -> None:
    good = [flaser(k, [1.0] * 180) for k in range(6)]
    source = open_source(
        write(
            *good[:2],
            "FLASER\n",
            "FLASER many 1 2\n",
            "FLASER -3 1 2 3 4 5 6 7 8 9\n",
            "FLASER 180 1.0 2.0\n",
            flaser(9, [1.0] * 90),
            flaser(10, [1.0, "x"] * 90),
            flaser(11, [1.0] * 180, stamp="noon"),
            flaser(12, [1.0] * 180, lead=float("nan")),
            "WARP 9\n",
            "\x00\x01\x02\xff\n",
            *good[2:5],
            good[5][: len(good[5]) // 2],
        )
    )
    assert len(source) == 5
    reasons = " | ".join(item.reason for item in source.skipped)
    for words in ("90 beams where", "cannot be read", "stamp 'noon'", "not finite", "ends after"):
        assert words in reasons
    assert len(source.skipped) == 9
    assert "2 lines are no messages of CARMEN: ignored" in source.notes  # type: ignore[attr-defined]


def test_a_log_cut_in_its_last_stamp(write: Write) -> None:
    lines = [flaser(k, [1.0] * 20) for k in range(3)]
    cut = lines[-1].split(" nohost")[0][:-4]
    source = open_source(write(*lines[:-1], cut))
    assert len(source) == 2
    assert source.skipped[0].reason == "FLASER: is cut in its stamp"


def test_what_is_no_log_says_so(write: Write, tmp_path: Path) -> None:
    cases = {
        "PARAM a b nohost 0\n": "holds no scans",
        "FLASER 4 1 2\n": "no scan can be read: 2: FLASER: ends after",
        flaser(0, [1.0] * 4, kind="RLASER"): r"but RLASER: open it with \?scan=RLASER",
        "hello\n": r"is no laser log: no line begins with FLASER \(found",
    }
    for text, words in cases.items():
        with pytest.raises(InputError, match=words):
            open_source(write(text))
    assert len(open_source(f"{write(flaser(0, [1.0] * 4, kind='RLASER'))}?scan=RLASER")) == 1
    for name, data, words in (
        ("empty.clf", b"", r"is no laser log: no line begins with FLASER \(found nothing\)"),
        ("b.clf", b"\0" * 5000, "is no laser log"),
        ("noise.log.bz2", b"BZh9 no", "cannot be unpacked to its end"),
        ("noise.log.gz", b"\x1f\x8b no", "cannot be unpacked to its end"),
    ):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match=words):
            open_source(tmp_path / name)
    path = write(flaser(0, [1.0] * 4))
    for query, words in (
        ("scn=FLASER", r"no option 'scn' \(did you mean 'scan'\?\)"),
        ("scan=FLAZER", "scan: 'FLAZER' is none of"),
        ("odometry=yes", "odometry 'yes' is none of on, off"),
        ("order", "not of the form option=value"),
    ):
        with pytest.raises(InputError, match=words):
            open_source(f"{path}?{query}")
    assert open_source(f"{path}?odometry=off").frame(0).odometry is None  # type: ignore[attr-defined]
    (tmp_path / "pictures").mkdir()
    with pytest.raises(InputError, match=r"no option 'fast': it has none"):
        open_source(f"{tmp_path / 'pictures'}?fast=1")


def test_what_no_return_is_can_be_told(write: Write) -> None:
    path = write(*(flaser(k, [1.0, 5.0, 9.0, 9.0] * 9) for k in range(3)))
    for query, infinite in (("", 2), ("?no_return_m=inf", 0), ("?no_return_m=5", 3)):
        scan = next(iter(open_source(f"{path}{query}"))).scan
        assert scan is not None
        assert int(np.isinf(scan[:4]).sum()) == infinite
    with pytest.raises(InputError, match="no_return_m: '-1' is no positive number"):
        open_source(f"{path}?no_return_m=-1")
