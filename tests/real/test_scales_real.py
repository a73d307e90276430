"""One camera on a road whose map gets a drift of scale in the middle: as a loop corrects one."""

from functools import partial
from pathlib import Path

import numpy as np

from odomap.evaluation.metrics import ate
from odomap.geometry.trajectory import Trajectory
from odomap.maps.estimate import Status
from odomap.sources.open import open as open_source
from odomap.system.config import preset
from system.test_scales import drift, run


def test_a_road_goes_on_as_before_after_a_correction_of_scale(data_folder: Path) -> None:
    """Keyframe i and its landmarks become larger by 1 + 0.03 i / n."""
    source = open_source(data_folder / "kitti_mono")
    half, errors = len(source) // 2, []
    for total in (0.0, 0.03):
        estimates, result = run(source, partial(drift, total=total), preset("mono"), half)
        assert all(e.status is not Status.LOST for e in estimates)
        path = result.trajectory
        late = path.stamps_ns >= source.stamps_ns[half]
        rest = Trajectory(path.stamps_ns[late], path.Ts_world_body[late])
        errors.append(ate(rest, result.truth(source.truth), "sim3").rmse)
    assert errors[1] < 1.25 * errors[0]
    scales = result.map.states.scales[result.map.keyframe_ids]
    assert 1.02 < scales.max() < 1.03
    assert np.count_nonzero(scales == 1.0) > 0.3 * len(scales)
