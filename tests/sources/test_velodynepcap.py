"""Captures of a Velodyne LiDAR, whole, with lost packets, and broken."""

from pathlib import Path

import numpy as np
import pytest

import odomap
from odomap.errors import CalibrationError, InputError, MissingExtra
from odomap.sensors.rig import LidarMount, Rig
from odomap.sources.packets import HOUR_US, read_capture, turns_of
from odomap.sources.source import RandomAccess
from pcapworlds import ANGLES, PACKET_US, ROOM, START_S, capture, frame_of, packets


@pytest.fixture
def sent() -> list[bytes]:
    """Return the frames of four turns, with what else goes over a network."""
    frames = [frame_of(data) for data in packets()]
    frames.insert(5, frame_of(b"\x00" * 512, port=8308))
    frames.insert(9, bytes(60))
    return frames


@pytest.mark.parametrize("order", ["<", ">"])
def test_packets_are_found_and_told_apart(tmp_path: Path, sent: list[bytes], order: str) -> None:
    found = read_capture(capture(tmp_path / "a.pcap", sent, order=order))
    assert len(found.places) == len(sent) - 2
    assert (found.lost, found.model, found.notes) == (0, 0x22, [])
    # The stamps are even, though the host saw two other packets between.
    assert set(np.diff(found.stamps_ns).tolist()) == {PACKET_US * 1000}
    assert abs(found.stamps_ns[0] - START_S * 10**9 - 4.7e6) < 1e6
    turns = turns_of(found)
    assert [len(turn) for turn in turns[1:-1]] == [76, 75, 75]
    assert np.concatenate(turns).tolist() == list(range(len(found.places)))
    assert found.packets(np.array([3]))[0] == list(packets())[3]


def test_lost_packets_are_counted(tmp_path: Path) -> None:
    frames = [frame_of(data) for k, data in enumerate(packets()) if k not in (40, 41, 42, 100, 190)]
    found = read_capture(capture(tmp_path / "a.pcap", frames))
    assert found.lost == 5
    assert "5 packets were lost (1.66%)" in found.notes[0]
    # A whole turn that is missing leaves a gap, and shifts no other.
    frames = [frame_of(data) for k, data in enumerate(packets(6)) if not 150 <= k < 250]
    found = read_capture(capture(tmp_path / "a.pcap", frames))
    assert found.lost == 100
    lengths_s = [np.ptp(found.stamps_ns[turn]) * 1e-9 for turn in turns_of(found)]
    assert max(lengths_s) < 0.101


def test_the_hour_ends(tmp_path: Path) -> None:
    frames = [frame_of(data) for data in packets(clock_us=HOUR_US - 150_000)]
    found = read_capture(capture(tmp_path / "a.pcap", frames))
    assert set(np.diff(found.stamps_ns).tolist()) == {PACKET_US * 1000}


def test_a_clock_that_stands_still(tmp_path: Path) -> None:
    frames = [frame_of(data[:1200] + bytes(4) + data[1204:]) for data in packets(2)]
    found = read_capture(capture(tmp_path / "a.pcap", frames))
    assert (found.stamps_ns == found.host_ns).all()
    assert "stands still" in found.notes[0]


def test_two_lidars(tmp_path: Path) -> None:
    frames = [frame_of(data) for data in packets(2)]
    other = [frame_of(data, host=b"\x0a\x00\x00\x07") for data in packets(1)]
    found = read_capture(capture(tmp_path / "a.pcap", frames + other))
    assert len(found.places) == len(frames)
    assert "of 2 LiDARs" in found.notes[0]
    assert "192.168.1.201 to port 2368" in found.notes[0]


def test_what_is_no_capture(tmp_path: Path, sent: list[bytes]) -> None:
    file = capture(tmp_path / "a.pcap", sent[:20])
    whole = file.read_bytes()
    file.write_bytes(whole[:-100])
    found = read_capture(file)
    assert len(found.places) == 17
    assert "is cut within its last packet" in found.notes[0]
    for data, says in (
        (b"", "is empty"),
        (b"\x0a\x0d\x0d\x0a" + bytes(40), "is pcapng: convert it by 'editcap"),
        (whole[:20], r"is no capture \(pcap\)"),
        (whole[:24], "holds no packets of a Velodyne"),
        (whole[:20] + b"\x69\x00\x00\x00" + whole[24:], "is of a network of kind 105"),
        (b"once upon a time there was", r"is no capture \(pcap\)"),
    ):
        file.write_bytes(data)
        with pytest.raises(InputError, match=rf"a\.pcap: {says}"):
            read_capture(file)


def test_any_bytes_are_no_crash(tmp_path: Path, sent: list[bytes]) -> None:
    file = capture(tmp_path / "a.pcap", sent[:40])
    whole, rng = file.read_bytes(), np.random.default_rng(2)
    for _ in range(60):
        broken = bytearray(whole)
        for place in rng.integers(24, len(whole), 30):
            broken[place] = int(rng.integers(0, 256))
        file.write_bytes(broken)
        try:
            assert 0 < len(read_capture(file).places) <= 38
        except InputError as error:
            assert "holds no packets" in str(error)  # noqa: PT017


def test_without_its_library_the_mend_is_said(
    tmp_path: Path, sent: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "velodyne_decoder", None)
    with pytest.raises(MissingExtra, match=r"pip install 'odomap\[lidar\]'"):
        odomap.open(capture(tmp_path / "a.pcap", sent))


def test_sweeps(tmp_path: Path, sent: list[bytes]) -> None:
    pytest.importorskip("velodyne_decoder")
    source = odomap.open(capture(tmp_path / "a.pcap", sent))
    assert isinstance(source, RandomAccess)
    assert len(source) == 4
    mount = source.rig.lidars[0]
    assert (mount.beams, mount.sweep) == (16, "clockwise")
    assert mount.rate_hz == pytest.approx(10, abs=0.15)
    assert source.details["packets"] == f"{len(sent) - 2}, 0 lost"  # type: ignore[attr-defined]
    for frame in list(source)[1:-1]:
        sweep = frame.cloud
        assert sweep is not None
        assert sweep.times is not None
        assert sweep.beams is not None
        # On the walls, by beams in the order of elevation, clockwise from behind.
        wall = np.abs(sweep.points[:, :2]).max(axis=1)
        assert np.abs(wall - ROOM).max() < 0.08
        elevation = np.arctan2(sweep.points[:, 2], np.hypot(*sweep.points[:, :2].T))
        means = [elevation[sweep.beams == beam].mean() for beam in range(16)]
        np.testing.assert_allclose(means, np.sort(ANGLES), atol=0.01)
        assert 0 <= sweep.times.min() < 1e-4
        assert 0.098 < sweep.times.max() < 0.102
        turned = np.degrees(np.arctan2(sweep.points[:, 1], sweep.points[:, 0]))
        ahead = np.abs(turned) < 1
        assert abs(sweep.times[ahead].mean() - 0.05) < 0.003
        again = source.frame(frame.id).cloud
        assert again is not None
        np.testing.assert_array_equal(again.points, sweep.points)


def test_lost_packets_cost_their_points(tmp_path: Path, sent: list[bytes]) -> None:
    pytest.importorskip("velodyne_decoder")
    whole = odomap.open(capture(tmp_path / "a.pcap", sent))
    cut = odomap.open(capture(tmp_path / "b.pcap", sent[:60] + sent[70:]))
    assert len(cut) == len(whole)
    counts = [[len(f.cloud) for f in source if f.cloud is not None] for source in (whole, cut)]
    assert sum(counts[0]) - sum(counts[1]) == 10 * 384
    assert "10 packets were lost" in " ".join(cut.notes)  # type: ignore[attr-defined]


def test_options_and_rigs(tmp_path: Path, sent: list[bytes]) -> None:
    pytest.importorskip("velodyne_decoder")
    path = capture(tmp_path / "a.pcap", sent)
    with pytest.raises(InputError, match=r"model: 'VLP61' is none of .*did you mean 'VLP16'"):
        odomap.open(f"{path}?model=VLP61")
    with pytest.raises(CalibrationError, match="16 beams, the rig says 64: mend 'beams'"):
        odomap.open(path, Rig(lidars=(LidarMount("top", beams=64),)))
    strange = [frame_of(data[:-1] + b"\x99") for data in packets(1)]
    with pytest.raises(InputError, match=r"b\.pcap: of a LiDAR of kind 153: .*; give \?model="):
        odomap.open(capture(tmp_path / "b.pcap", strange))
