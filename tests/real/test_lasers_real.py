"""Real laser logs: as many scans as their authors say, stamps as text, what no return is."""

from pathlib import Path

import numpy as np
import pytest

from odomap.cli import main
from odomap.errors import InputError
from odomap.geometry.pose import SE3
from odomap.sensors.sync import format_stamp
from odomap.sources.bagfile import BagFile
from odomap.sources.describe import describe
from odomap.sources.open import open as open_source
from odomap.sources.transforms import FrameTree


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


def test_real_bags(data_folder: Path) -> None:
    folder = data_folder / "containers"
    for name, counts in {
        "tf_example.bag": {"/tf": 517, "/tf_static": 1},
        "nav2_turtlebot.mcap": {"/odom": 2639, "/tf": 5422, "/tf_static": 1, "/amcl_pose": 135},
        "ROS_example.bag": {"groundtruth": 12765, "S-PTAM": 5439, "ORB-SLAM": 8362},
    }.items():
        bag = BagFile(folder / name)
        assert bag.is_indexed
        assert {topic.name: topic.count for topic in bag.topics} == counts
        with pytest.raises(InputError, match=f"{name}: holds no LaserScan; it holds "):
            open_source(folder / name)


def test_real_tree_of_frames(data_folder: Path) -> None:
    bag, tree = BagFile(data_folder / "containers" / "nav2_turtlebot.mcap"), FrameTree()
    for topic, _, message in bag.messages(["/tf", "/tf_static"]):
        tree.add(message, topic == "/tf_static")
    # The laser of a TurtleBot 4 stands on its shell, turned by a right angle.
    T = tree.fixed("base_link", "rplidar_link")
    assert T is not None
    assert SE3(T).log()[5] == pytest.approx(np.pi / 2, abs=1e-3)
    assert tree.fixed("base_link", "left_wheel") is None
    wheels = tree.wheels()
    assert wheels is not None
    assert wheels[0] == "base_link"
    odometry = [m.pose.pose.position.x for _, _, m in bag.messages(["/odom"])]
    assert np.ptp(odometry) == pytest.approx(np.ptp([T[0, 3] for T in wheels[2]]), rel=0.02)
