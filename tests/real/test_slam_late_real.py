"""One camera when the mapper is late: landmarks come frames after they are needed."""

from dataclasses import replace
from pathlib import Path

import pytest

from odomap.evaluation.metrics import ate
from odomap.maps.estimate import Status
from odomap.sources.open import open as open_source
from odomap.system.background import ThreadConfig
from odomap.system.config import preset
from odomap.system.slam import Slam

FRAMES = 45


@pytest.mark.parametrize("delay", [2, 3])
def test_a_late_mapper_loses_no_frame(data_folder: Path, delay: int) -> None:
    """Two metres every other frame: what few landmarks are left ask for a keyframe in time."""
    source = open_source(data_folder / "kitti_mono")
    config = replace(preset("mono"), threads=ThreadConfig(mapping_delay=delay))
    slam = Slam(source.rig, config, "lockstep")
    estimates = [slam.track(frame) for _, frame in zip(range(FRAMES), source, strict=False)]
    result = slam.finish()
    assert all(e.status is not Status.LOST for e in estimates)
    assert ate(result.trajectory, result.truth(source.truth), "sim3").rmse < 0.2
