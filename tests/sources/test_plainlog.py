"""Logs of Odometry and Laser lines."""

from pathlib import Path

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.sources.open import open as open_source
from odomap.sources.plainlog import PlainLogSource


def test_pairs_of_lines(tmp_path: Path) -> None:
    path = tmp_path / "loop.log"
    scan = "Laser 3 1.0 0.0 2.5\n"
    path.write_text(
        "".join(f"Odometry {k} 0 0.5\n{scan}" for k in range(3))
        + scan
        + "Odometry 1 x 2\n"
        + scan
        + "Odometry 3 0 0\nLaser 3 1.0 2.0\n"
        + "Odometry 9 0 0\nLaser three\n"
        + "Motor on\nOdometry 4 0 0\nLaser 3 1.0 2."
    )
    source = open_source(path)
    assert isinstance(source, PlainLogSource)
    assert source.stamps_ns.tolist() == [0, 100_000_000, 200_000_000]
    frame = source.frame(2)
    np.testing.assert_array_equal(frame.scan, [1.0, np.nan, 2.5])
    assert frame.odometry is not None
    np.testing.assert_allclose(frame.odometry[:2, 3], [2, 0])
    assert frame.odometry[1, 0] == pytest.approx(np.sin(0.5))
    assert source.rig.lidars[0].angles == pytest.approx((-np.pi / 2, np.pi / 2, 3))
    reasons = [item.reason for item in source.skipped]
    assert sum("no Odometry line" in reason for reason in reasons) == 2
    assert sum("of 3 beams" in reason for reason in reasons) == 2
    assert sum("cannot be read" in reason for reason in reasons) == 2
    assert "1 lines begin with neither Odometry nor Laser: ignored" in source.notes
    assert next(iter(open_source(f"{path}?odometry=off"))).odometry is None


def test_nothing_to_read(tmp_path: Path) -> None:
    path = tmp_path / "loop.log"
    path.write_text("Odometry 1 2 3\n")
    with pytest.raises(InputError, match="no Laser line can be read"):
        open_source(path)
