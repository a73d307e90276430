"""Sweeps of KITTI, whole and broken."""

from pathlib import Path

import numpy as np
import pytest

import odomap
from odomap.errors import CalibrationError, InputError
from odomap.geometry.pose import SE3
from odomap.sensors.rig import LidarMount, Rig
from odomap.sources.source import RandomAccess, UnusableFrame
from odomap.sources.velodyne import VelodyneSource
from sweepworlds import compensated, road, write_velodyne


def rewrite(root: Path, change) -> None:
    """Change the points of every sweep."""
    for file in sorted((root / "velodyne").iterdir()):
        rows = np.frombuffer(file.read_bytes(), "<f4").reshape(-1, 4).copy()
        rows[:, :3] = change(rows[:, :3].astype(np.float64))
        file.write_bytes(rows.tobytes())


def test_whole(tmp_path: Path) -> None:
    source = odomap.open(write_velodyne(tmp_path / "drive"))
    assert isinstance(source, VelodyneSource)
    assert isinstance(source, RandomAccess)
    assert (source.name, len(source), source.skipped) == ("drive", 5, [])
    mount = source.rig.lidars[0]
    assert (mount.beams, mount.sweep, mount.angles) == (64, "clockwise", (0.0, 0.0, 0))
    assert mount.rate_hz == pytest.approx(10)
    assert source.rig.body_sensor == "velodyne"
    frames = list(source)
    assert [frame.stamp_ns for frame in frames] == [k * 100_000_000 for k in range(5)]
    points, beams = road(seed=3)
    sweep = frames[3].cloud
    assert sweep is not None
    assert sweep.times is not None
    assert sweep.beams is not None
    np.testing.assert_allclose(sweep.points, points, rtol=1e-6)
    assert (sweep.beams == beams).mean() > 0.999
    # Ahead is now, the left is before, the right afterwards.
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    np.testing.assert_allclose(sweep.times, -0.1 * azimuth / (2 * np.pi), atol=1e-6)
    assert sweep.intensities is not None
    assert (sweep.intensities[0], sweep.intensities[-1]) == (0, 1)
    assert source.truth is not None
    np.testing.assert_allclose(source.truth.positions[:, 0], np.arange(5.0))
    with pytest.raises(IndexError):
        source.frame(5)


def test_folder_of_the_files_alone(tmp_path: Path) -> None:
    source = odomap.open(write_velodyne(tmp_path) / "velodyne")
    assert len(source) == 5
    assert source.truth is not None


def test_raw_drive(tmp_path: Path) -> None:
    write_velodyne(tmp_path)
    folder = tmp_path / "drive" / "velodyne_points"
    folder.mkdir(parents=True)
    (tmp_path / "velodyne").rename(folder / "data")
    lines = [f"2011-09-26 13:02:25.{951199337 + k * 10**7:09d}\n" for k in range(4)]
    (folder / "timestamps.txt").write_text("".join(lines))
    source = odomap.open(tmp_path / "drive")
    assert isinstance(source, VelodyneSource)
    assert source.stamps_ns.tolist() == [1317042145951199337 + k * 10**7 for k in range(4)]
    assert [s.file for s in source.skipped] == ["000004.bin"]
    (folder / "timestamps.txt").write_text("yesterday noon\n")
    with pytest.raises(InputError, match=r"timestamps.txt:1: 'yesterday noon' is no date"):
        odomap.open(tmp_path / "drive")


def test_truth_of_a_raw_drive(tmp_path: Path) -> None:
    """A car goes north-east at 10 m/s, its GPS 1 m behind and 0.5 m below the LiDAR."""
    write_velodyne(tmp_path)
    drive = tmp_path / "day" / "drive"
    (drive / "velodyne_points").mkdir(parents=True)
    (tmp_path / "velodyne").rename(drive / "velodyne_points" / "data")
    lines = [f"2011-09-26 13:02:25.{100_000_000 * (k + 1):09d}\n" for k in range(5)]
    (drive / "velodyne_points" / "timestamps.txt").write_text("".join(lines))
    (drive / "oxts" / "data").mkdir(parents=True)
    (drive / "oxts" / "timestamps.txt").write_text("".join(lines))
    degree = np.degrees(1 / 6_378_137.0)
    for k in range(5):
        north = 49.0 + k * degree * np.sqrt(0.5)
        east = 8.0 + k * degree * np.sqrt(0.5) / np.cos(np.radians(49.0))
        text = f"{north:.12f} {east:.12f} 112.0 0.0 0.0 {np.pi / 4:.12f} 1 2 3\n"
        (drive / "oxts" / "data" / f"{k:010d}.txt").write_text(text)
    source = odomap.open(drive)
    assert source.truth is None
    assert any("calib_imu_to_velo.txt: missing" in note for note in source.notes)
    calibration = "calib_time: 25-May-2012\nR: 1 0 0 0 1 0 0 0 1\nT: -1 0 -0.5\n"
    (drive.parent / "calib_imu_to_velo.txt").write_text(calibration)
    truth = odomap.open(drive).truth
    assert truth is not None
    ahead = np.sqrt(0.5) * (1 + np.arange(5.0))
    expected = np.stack([ahead, ahead, np.full(5, 0.5)], axis=1)
    np.testing.assert_allclose(truth.positions, expected, atol=1e-5)
    forward = truth.Ts_world_body[2, :3, :3] @ [1, 0, 0]
    np.testing.assert_allclose(forward, [np.sqrt(0.5), np.sqrt(0.5), 0], atol=1e-9)
    (drive / "oxts" / "data" / "0000000003.txt").write_text("49.0 eight\n")
    source = odomap.open(drive)
    assert source.truth is None
    assert any("0000000003.txt:1: six numbers" in note for note in source.notes)


@pytest.mark.parametrize("speed", [10.0, -4.0])
def test_compensated_sweeps_get_no_times(tmp_path: Path, speed: float) -> None:
    root = write_velodyne(tmp_path)
    rewrite(root, lambda points: compensated(points, speed))
    source = odomap.open(root)
    frame = source.frame(0)
    assert frame.cloud.times is None
    assert frame.cloud.beams is not None
    assert source.rig.lidars[0].sweep == "none"
    assert any("the motion was taken out" in note for note in source.notes)
    believed = odomap.open(f"{root}?times=azimuth")
    assert believed.frame(0).cloud.times is not None
    off = odomap.open(f"{write_velodyne(tmp_path / 'raw')}?times=off")
    assert off.frame(0).cloud.times is None
    with pytest.raises(InputError, match="times: 'of' is none of auto, azimuth, off"):
        odomap.open(f"{root}?times=of")


def test_sweeps_of_other_sensors_get_times_from_their_rig(tmp_path: Path) -> None:
    root = write_velodyne(tmp_path, beams=32)
    source = odomap.open(root)
    assert source.rig.lidars[0].beams == 32
    assert source.frame(0).cloud.times is None
    assert any("sweeps of 32 beams are not KITTI's" in note for note in source.notes)
    (root / "rig.yaml").write_text(
        "odomap_rig: 1\nlidars:\n  - {name: roof, sweep: counter_clockwise}\n"
    )
    source = odomap.open(root)
    sweep = source.frame(0).cloud
    azimuth = np.arctan2(sweep.points[:, 1], sweep.points[:, 0])
    np.testing.assert_allclose(sweep.times, 0.1 * azimuth / (2 * np.pi), atol=1e-9)
    assert source.rig.lidars[0].sweep == "counter_clockwise"


def test_odometry_benchmark(tmp_path: Path) -> None:
    """Truth of the camera is brought over to the LiDAR."""
    root = write_velodyne(tmp_path / "sequences" / "04")
    (root / "poses_velodyne.txt").unlink()
    (tmp_path / "poses").mkdir()
    rows = [f"1 0 0 0 0 1 0 0 0 0 1 {k}\n" for k in range(5)]
    (tmp_path / "poses" / "04.txt").write_text("".join(rows))
    without = odomap.open(root)
    assert without.truth is None
    assert any("no Tr" in note for note in without.notes)
    (root / "calib.txt").write_text(
        "P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: 0 -1 0 .1 0 0 -1 .2 1 0 0 .3\n"
    )
    truth = odomap.open(root).truth
    assert truth is not None
    np.testing.assert_allclose(truth.positions, [[k, 0, 0] for k in range(5)], atol=1e-12)
    np.testing.assert_allclose(truth.Ts_world_body[4, :3, :3], np.eye(3), atol=1e-12)


def test_truncated_file_costs_its_frame(tmp_path: Path) -> None:
    root = write_velodyne(tmp_path)
    file = root / "velodyne" / "000002.bin"
    file.write_bytes(file.read_bytes()[:-5])
    source = odomap.open(root)
    assert [frame.id for frame in source] == [0, 1, 3, 4]
    assert source.skipped[0].file == str(file)
    assert "no multiple of 16" in source.skipped[0].reason
    with pytest.raises(UnusableFrame, match="is it cut off"):
        source.frame(2)
    for other in (root / "velodyne").iterdir():
        other.write_bytes(b"12345")
    with pytest.raises(InputError, match=r"no sweep of .* can be read"):
        list(odomap.open(root))


def test_sweeps_without_a_point_are_frames(tmp_path: Path) -> None:
    root = write_velodyne(tmp_path)
    (root / "velodyne" / "000001.bin").write_bytes(b"")
    zeros, nans = np.zeros((50, 4), "<f4"), np.full((50, 4), np.nan, "<f4")
    (root / "velodyne" / "000002.bin").write_bytes(zeros.tobytes())
    (root / "velodyne" / "000003.bin").write_bytes(nans.tobytes())
    source = odomap.open(root)
    assert [len(frame.cloud) for frame in source][1:4] == [0, 50, 50]
    assert source.skipped == []
    assert source.rig.lidars[0].beams == 64
    for file in (root / "velodyne").iterdir():
        file.write_bytes(b"")
    assert [len(frame.cloud) for frame in odomap.open(root)] == [0] * 5


def test_beams_of_a_rig_must_be_those_of_the_sweeps(tmp_path: Path) -> None:
    root = write_velodyne(tmp_path)
    T = SE3.from_parts(np.eye(3), np.array([1.0, 0.0, 2.0]))
    for beams in (0, 64, 66):
        rig = Rig(lidars=(LidarMount("top", T, (2.0, 50.0), beams=beams),))
        mount = odomap.open(root, rig).rig.lidars[0]
        assert (mount.name, mount.range_m, mount.beams) == ("top", (2.0, 50.0), beams or 64)
        assert mount.T_body_lidar.t.tolist() == [1, 0, 2]
    for beams in (16, 32, 128):
        rig = Rig(lidars=(LidarMount("top", beams=beams),))
        with pytest.raises(CalibrationError, match=f"64 beams, the rig says {beams}: mend 'beams'"):
            odomap.open(root, rig)
    with pytest.raises(CalibrationError, match="is a 2D laser"):
        odomap.open(root, Rig(lidars=(LidarMount("flat", angles=(-1.0, 1.0, 90)),)))
    (root / "rig.yaml").write_text("odomap_rig: 1\nlidars:\n  - {name: roof, beams: 16}\n")
    with pytest.raises(CalibrationError, match="the rig says 16"):
        odomap.open(root)


def test_times_missing_and_stamps_that_go_back(tmp_path: Path) -> None:
    root = write_velodyne(tmp_path)
    (root / "times.txt").write_text("0.0\n0.2\n0.1\n0.2\n0.4\n")
    source = odomap.open(root)
    assert source.stamps_ns.tolist() == [0, 100_000_000, 200_000_000, 400_000_000]
    assert len(source.skipped) == 1
    assert "repeated" in source.skipped[0].reason
    assert any("out of order" in note for note in source.notes)
    (root / "times.txt").unlink()
    source = odomap.open(root)
    assert source.stamps_ns.tolist() == [k * 100_000_000 for k in range(5)]
    assert any("neither times.txt" in note for note in source.notes)


def test_nothing_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no sweeps"):
        VelodyneSource(tmp_path)
    write_velodyne(tmp_path)
    with pytest.raises(InputError, match="no option 'tims'"):
        odomap.open(f"{tmp_path}?tims=off")


def test_bytes_that_were_damaged_are_no_points(tmp_path: Path, recwarn) -> None:
    root = write_velodyne(tmp_path)
    file = root / "velodyne" / "000002.bin"
    rows = np.frombuffer(file.read_bytes(), "<f4").reshape(-1, 4).copy()
    noise = np.random.default_rng(0).integers(0, 256, (4000, 16), np.uint8).view("<f4")
    rows[:4000] = noise
    rows[5000, :3] = 3e6
    file.write_bytes(rows.tobytes())
    source = odomap.open(root)
    assert source.rig.lidars[0].range_m[1] < 300.0  # garbage goes to 1e38
    sweep = source.frame(2).cloud
    assert sweep is not None
    seen = sweep.points[np.isfinite(sweep.points).all(axis=1)]
    assert len(rows) - 4000 <= len(seen) < len(rows)
    assert np.abs(seen).max() < 1e7
    assert not [w for w in recwarn if "invalid value" in str(w.message)]


def test_of_sweeps_without_points_nothing_is_claimed(tmp_path: Path) -> None:
    for k in range(3):
        (tmp_path / f"{k:06d}.bin").write_bytes(b"")
    source = odomap.open(tmp_path)
    assert "the sweeps that were looked at hold no points" in source.notes
    assert source.rig.lidars[0].sweep == "none"
