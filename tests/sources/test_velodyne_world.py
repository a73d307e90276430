"""Simulated sweeps written as KITTI's come back with the times and the beams they had."""

from pathlib import Path

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.simulation.export import export_velodyne
from odomap.simulation.sweepspec import SweepSpec
from odomap.simulation.sweepworld import SweepWorld
from odomap.sources.open import open as open_source


def test_sweeps_come_back_through_the_reader_of_kitti(tmp_path: Path) -> None:
    world = SweepWorld(SweepSpec("street", 4, 12, beams=64, columns=900))
    source = open_source(export_velodyne(world, tmp_path / "drive"))
    assert len(source) == 12
    assert source.truth is not None
    Ts = world.path.at(np.arange(12) / 10 + 0.05).Ts_world_body
    np.testing.assert_allclose(source.truth.Ts_world_body, Ts, atol=1e-9)
    for k, frame in enumerate(source):
        back, made = frame.cloud, world.frame(k).cloud
        assert back is not None
        assert back.times is not None
        assert back.beams is not None
        assert made is not None
        assert made.times is not None
        assert made.beams is not None
        azimuth = np.arctan2(made.points[:, 1], made.points[:, 0]) % (2 * np.pi)
        rows = np.lexsort([azimuth, -made.beams.astype(int)])
        np.testing.assert_allclose(back.points, made.points[rows], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(back.times, made.times[rows] - 0.05, atol=1e-6)
        np.testing.assert_array_equal(back.beams, made.beams[rows])


def test_what_has_no_azimuth_cannot_be_written_so(tmp_path: Path) -> None:
    world = SweepWorld(SweepSpec("room", 4, 1, pattern="solid_state", columns=50))
    with pytest.raises(InputError, match="take pattern=rotating"):
        export_velodyne(world, tmp_path)
