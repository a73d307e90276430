"""What `odomap info` says about a recording."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig
from odomap.sources.describe import describe
from odomap.sources.disturb import drop, reverse
from odomap.sources.euroc import EurocSource
from odomap.sources.kitti import KittiSource
from odomap.sources.source import Skipped


def test_euroc(euroc: Callable[..., Path]) -> None:
    facts = describe(EurocSource(euroc()))
    assert json.loads(json.dumps(facts)) == facts
    assert (facts["name"], facts["format"], facts["frames"]) == ("MH_00", "euroc", 6)
    assert facts["duration_s"] == pytest.approx(0.25)
    assert facts["rate_hz"] == 20.0
    assert facts["gaps"] == []
    assert [c["resolution"] for c in facts["cameras"]] == [[64, 48], [64, 48]]
    assert facts["stereo_baseline_m"] == pytest.approx(0.11)
    assert (facts["imu_rate_hz"], facts["body"]) == (200.0, "imu")
    assert facts["truth"]["frames_covered"] == 6
    assert facts["truth"]["path_m"] == pytest.approx(7.5)
    assert (facts["skipped"], facts["notes"]) == ([], [])


def test_a_gap_is_reported(kitti: Callable[..., Path]) -> None:
    root = kitti()
    (root / "times.txt").write_text("0\n.1\n.2\n2.2\n2.3\n2.4\n")
    (gap,) = describe(KittiSource(root))["gaps"]
    assert gap == {
        "after_frame": 2,
        "stamp_s": pytest.approx(0.2),
        "gap_s": pytest.approx(2.0),
    }


def test_one_camera_without_truth(kitti: Callable[..., Path]) -> None:
    root = kitti(pair=(0,))
    (root / "poses.txt").unlink()
    facts = describe(KittiSource(root))
    assert facts["stereo_baseline_m"] is None
    assert facts["truth"] is None
    assert facts["notes"] == ["image_1 is missing or empty: the recording is monocular"]


def test_disturbed_sources_and_streams(euroc: Callable[..., Path]) -> None:
    source = EurocSource(euroc())
    assert describe(reverse(drop(source, [1])))["frames"] == 5
    assert describe(drop(source, range(1, 6)))["rate_hz"] is None

    class Stream:
        name = "camera"
        rig = Rig()
        truth = None

        def __init__(self) -> None:
            self.skipped: list[Skipped] = []

        def __len__(self) -> int:
            return 4

        def __iter__(self) -> Iterator[Frame]:
            raise AssertionError("describing must not read frames")

    facts = describe(Stream())
    assert (facts["frames"], facts["duration_s"], facts["gaps"]) == (4, None, [])
    assert describe(drop(Stream(), [1]))["frames"] == 3
