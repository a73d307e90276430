"""The front-ends "loam" and "lego" in the whole system, chosen by a setting."""

from dataclasses import replace

import numpy as np
import pytest

import odomap
from odomap.errors import ConfigError
from odomap.evaluation.metrics import ate


@pytest.mark.parametrize("front_end", ["loam", "lego"])
def test_a_drive_is_mapped_with_a_chosen_front_end(front_end):
    source = odomap.open("sim:street?sensors=lidar3d&beams=16&frames=20&seed=2")
    config = odomap.preset("lidar")
    tracking = replace(config.cloud_tracking, front_end=front_end)
    system = odomap.Slam(source.rig, replace(config, cloud_tracking=tracking))
    estimates = [system.track(frame) for frame in source]
    result = system.finish()
    assert all(e.status.name == "TRACKING" for e in estimates[1:])
    assert ate(result.trajectory, source.truth).rmse < 0.1
    covariances = np.array([e.covariance for e in estimates[2:]])
    assert np.all(np.linalg.eigvalsh(covariances) > 0)


def test_a_front_end_that_is_none_is_refused():
    with pytest.raises(ConfigError, match="lgeo"):
        replace(odomap.preset("lidar").cloud_tracking, front_end="lgeo")
