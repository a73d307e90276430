"""SLAM on real recordings: features matched against the local map, as accurate as it must be."""

from dataclasses import dataclass

import numpy as np
import pytest

from odomap.evaluation.metrics import ate
from odomap.maps.estimate import Status
from odomap.sources.open import open as open_source
from odomap.system.config import preset
from odomap.system.slam import Slam


@dataclass(frozen=True)
class Bar:
    """A recording, how it is run, and how well it must go."""

    name: str
    preset: str
    frames: int
    limit_m: float
    starts_by: int = 0


BARS = (
    Bar("euroc_mh01", "stereo", 110, 0.0045),
    Bar("kitti_stereo", "stereo", 51, 0.056),
    Bar("kitti_mono", "mono", 100, 0.11, 10),
    Bar("rgbd_desk", "rgbd", 160, 0.03),
)


@pytest.mark.parametrize("bar", BARS, ids=lambda bar: bar.name)
def test_features_against_the_local_map(data_folder, bar):
    source = open_source(data_folder / bar.name)
    slam = Slam(source.rig, preset(bar.preset))
    estimates = [slam.track(frame) for frame in source]
    result = slam.finish()
    assert not source.skipped
    assert len(estimates) == bar.frames
    tracking = [e.status is Status.TRACKING for e in estimates]
    first = tracking.index(True)
    assert first <= bar.starts_by
    # Found again within the same frame, by looking it up in the map, is not lost.
    assert {e.status for e in estimates[first:]} <= {Status.TRACKING, Status.RECOVERED}
    assert sum(tracking[first:]) >= len(tracking) - first - 3
    assert all(e.status is Status.INITIALIZING and e.reason for e in estimates[:first])
    align = "se3" if result.is_metric else "sim3"
    found = ate(result.trajectory, source.truth, align)
    assert found.matched == len(result.trajectory) >= bar.frames - bar.starts_by
    assert found.rmse <= bar.limit_m
    # What is emitted at once may be a little worse, not another path.
    assert ate(result.trajectory_live, source.truth, align).rmse <= 2 * bar.limit_m
    covariances = result.trajectory.covariances[1:]
    assert np.isfinite(covariances).all()
    assert (np.linalg.eigvalsh(covariances) > -1e-15).all()
    # Uncertainty is about as large as the error: neither blind trust nor blanket doubt.
    sigma = np.sqrt(np.trace(covariances[-1][:3, :3])) * (found.scale if align == "sim3" else 1)
    assert 0.1 * found.rmse < sigma < 50 * found.rmse
