"""Real laser logs: as many scans as their authors say, stamps as text, what no return is."""

from pathlib import Path

import numpy as np
import pytest

from odomap.cli import main
from odomap.sensors.sync import format_stamp
from odomap.sources.describe import describe
from odomap.sources.open import open as open_source


def test_intel(data_folder: Path) -> None:
    source = open_source(data_folder / "laser2d" / "intel.clf.bz2")
    facts = describe(source)
    assert facts["frames"] == 13631
    assert facts["lidars"][0]["angles_deg"] == [-90.0, 89.0]
    assert facts["scans"]["no_return_m"] == pytest.approx(81.83, abs=1e-4)
    assert facts["scans"]["share_no_return"] == pytest.approx(68313 / (13631 * 180), abs=1e-5)
    assert facts["scans"]["odometry_path_m"] == pytest.approx(508.35, abs=0.01)
    assert source.skipped == []
    # The clock jumps; in the order of the log the wheels do not.
    assert facts["notes"] == [
        "631 stamps go back, by 0.897 s at most: scans stay in the order of the log"
    ]
    names = (data_folder / "laser2d" / "intel.relations").read_text().split("\n")
    related = {text for line in names for text in line.split()[:2]}
    stamps = {format_stamp(frame.stamp_ns)[:-3] for frame in source}
    assert len(stamps) == 13631
    assert len(related) == 1791
    assert related <= stamps


def test_csail(data_folder: Path) -> None:
    source = open_source(data_folder / "laser2d" / "mit-csail.clf.bz2")
    facts = describe(source)
    assert facts["frames"] == 1988
    assert (facts["notes"], facts["skipped"], facts["gaps"]) == ([], [], [])
    assert facts["lidars"][0]["angles_deg"] == [-90.0, 90.0]
    assert facts["scans"]["no_return_m"] == pytest.approx(81.91, abs=1e-4)
    frame = next(iter(source))
    assert format_stamp(frame.stamp_ns) == "1134864629.895182000"
    assert frame.scan is not None
    assert frame.scan.shape == (361,)
    assert not (frame.scan[np.isfinite(frame.scan)] > 50).any()


def test_loop5(data_folder: Path) -> None:
    source = open_source(data_folder / "laser2d" / "loop5.log")
    facts = describe(source)
    assert (facts["frames"], facts["lidars"][0]["beams"]) == (551, 181)
    assert facts["scans"]["no_return_m"] == pytest.approx(8.19, abs=0.01)
    assert facts["scans"]["odometry_path_m"] == pytest.approx(56.08, abs=0.01)


def test_command(data_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = data_folder / "laser2d" / "mit-csail.clf.bz2"
    assert main(["info", str(path)]) == 0
    out = capsys.readouterr().out
    assert "361 beams from -90° to 90°, every 0.5°" in out
    assert "no return      3.30% of the beams, written as 81.91 m" in out
    assert "odometry       of the wheels, 373.62 m" in out
