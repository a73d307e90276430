"""Export: the same world through files."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from odomap.errors import InputError, OutputError
from odomap.simulation.export import export_euroc
from odomap.simulation.world import World


@pytest.fixture(scope="module")
def small() -> World:
    return World.make(kind="room", seed=8, frames=3, resolution=(96, 64))


def test_files_hold_what_the_world_says(small: World, tmp_path: Path) -> None:
    root = export_euroc(small, tmp_path / "world") / "mav0"
    for camera in range(2):
        listing = (root / f"cam{camera}/data.csv").read_text().splitlines()[1:]
        assert len(listing) == 3
        for index, row in enumerate(listing):
            stamp, name = row.split(",")
            frame = small.frame(index)
            assert int(stamp) == frame.stamp_ns
            image = cv2.imread(str(root / f"cam{camera}/data" / name), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(image, frame.images[camera])
    imu = np.loadtxt(root / "imu0/data.csv", delimiter=",")
    samples = [small.frame(i).imu for i in range(3)]
    gyro = np.concatenate([s.gyro for s in samples if s is not None])
    np.testing.assert_array_equal(imu[:, 1:4], gyro)
    truth = np.loadtxt(root / "state_groundtruth_estimate0/data.csv", delimiter=",")
    np.testing.assert_array_equal(truth[:, 1:4], small.truth.positions)


def test_a_folder_that_cannot_be_written_is_named(small: World, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="file"):
        export_euroc(small, tmp_path / "file")


def test_a_fisheye_is_not_written_as_a_pinhole(tmp_path: Path) -> None:
    world = World.make(
        kind="room", seed=8, frames=1, resolution=(96, 64), sensors=("mono",), lens="kannala_brandt"
    )
    with pytest.raises(InputError, match="kannala_brandt cannot be written as EuRoC"):
        export_euroc(world, tmp_path / "world")
    assert not (tmp_path / "world").exists()
