"""Stereo odometry on real recordings, to the accuracy it must reach."""

import numpy as np
import pytest

from odomap.evaluation.metrics import ate
from odomap.maps.estimate import Status
from odomap.sources.open import open as open_source
from odomap.system.odometry import StereoVO


@pytest.mark.parametrize(
    ("name", "frames", "limit_m"), [("euroc_mh01", 110, 0.0055), ("kitti_stereo", 51, 0.11)]
)
def test_stereo_odometry(data_folder, name, frames, limit_m):
    source = open_source(data_folder / name)
    vo = StereoVO(source.rig)
    estimates = [vo.track(frame) for frame in source]
    result = vo.finish()
    assert [e.status for e in estimates] == [Status.TRACKING] * frames
    assert len(result.trajectory) == len(result.trajectory_live) == frames
    assert not source.skipped
    found = ate(result.trajectory, source.truth)
    assert found.rmse <= limit_m
    assert found.matched == frames
    # What is emitted at once may be a little worse, not another path.
    assert ate(result.trajectory_live, source.truth).rmse <= 2 * limit_m
    covariances = result.trajectory.covariances[1:]
    assert np.isfinite(covariances).all()
    assert (np.linalg.eigvalsh(covariances) > 0).all()
    # Uncertainty is about as large as the error: neither blind trust nor blanket doubt.
    sigma = np.sqrt(np.trace(covariances[-1][:3, :3]))
    assert 0.1 * found.rmse < sigma < 30 * found.rmse
