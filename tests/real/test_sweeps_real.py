"""Real sweeps: KITTI's."""

from pathlib import Path

import numpy as np
import pytest

import odomap
from odomap.lidar.deskew import deskew
from odomap.sources.velodyne import VelodyneSource
from odomap.sources.velodynepcap import PcapSource


def test_kitti(data_folder: Path) -> None:
    source = odomap.open(data_folder / "kitti_velodyne")
    assert isinstance(source, VelodyneSource)
    assert (len(source), source.rig.lidars[0].beams, source.skipped) == (20, 64, [])
    assert source.truth is not None
    assert abs(source.truth.path_length - 22.68) < 0.01
    for frame in (source.frame(0), source.frame(19)):
        sweep = frame.cloud
        assert sweep is not None
        assert sweep.times is not None
        assert sweep.beams is not None
        assert abs(sweep.times.min() + 0.0518) < 1e-4
        assert abs(sweep.times.max() - 0.0518) < 1e-4
        counts = np.bincount(sweep.beams)
        assert len(counts) == 64
        assert counts.min() > 800
        # Beams are above each other.
        elevation = np.arcsin(sweep.points[:, 2] / np.linalg.norm(sweep.points, axis=1))
        means = [elevation[sweep.beams == beam].mean() for beam in range(64)]
        assert (np.diff(means) > 0).all()


def test_compensated_kitti_is_recognised(tmp_path: Path, data_folder: Path) -> None:
    """The same sweeps with the motion taken out must get no times."""
    source = odomap.open(data_folder / "kitti_velodyne")
    (tmp_path / "velodyne").mkdir()
    twist = np.array([11.4, 0.0, 0.0, 0.0, 0.0, 0.0])
    for k in range(0, 20, 4):
        sweep = source.frame(k).cloud
        assert sweep is not None
        assert sweep.times is not None
        points = deskew(sweep.points, sweep.times, twist)
        rows = np.c_[points, np.zeros(len(points))].astype("<f4")
        (tmp_path / "velodyne" / f"{k:06d}.bin").write_bytes(rows.tobytes())
    without = odomap.open(tmp_path)
    sweep = without.frame(0).cloud
    assert sweep is not None
    assert sweep.times is None
    assert without.rig.lidars[0].beams == 64
    assert any("the ground steps by 1.1" in note for note in without.notes)


def test_capture(data_folder: Path) -> None:
    pytest.importorskip("velodyne_decoder")
    source = odomap.open(data_folder / "containers" / "sample_velodyne_vlp16_gps.pcap")
    assert isinstance(source, PcapSource)
    assert (len(source), source.skipped) == (4, [])
    assert source.details == {"model": "VLP16", "packets": "293, 0 lost"}
    sweep = source.frame(1).cloud
    assert sweep is not None
    assert sweep.times is not None
    assert sweep.beams is not None
    assert 18000 < len(sweep) < 19000
    assert 0.098 < sweep.times.max() < 0.102
    assert (np.bincount(sweep.beams) > 200).sum() == 16
