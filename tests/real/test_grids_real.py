"""A grid of a real desk, from depth: the floor motion capture knows, desks where points lie."""

import numpy as np

from odomap.files.grids import load_grid
from odomap.files.trajectories import write_tum
from odomap.gridmap import export_grid
from odomap.sources.open import open as open_source


def test_a_desk(data_folder, tmp_path):
    data = data_folder / "rgbd_desk"
    source = open_source(data)
    inside = (source.stamps_ns >= source.truth.stamps_ns[0]) & (
        source.stamps_ns <= source.truth.stamps_ns[-1]
    )
    truth = source.truth.interpolate(source.stamps_ns[np.flatnonzero(inside)[::12]])
    write_tum(tmp_path / "keyframes.tum", truth)
    (tmp_path / "config.yaml").write_text(f"data: {data}\n", encoding="utf-8")
    made = export_grid(tmp_path, tmp_path / "desk.yaml").made
    # z of motion capture is up, and its floor at 0 to some centimetres.
    assert made.T_grid_world[2, 2] > np.cos(np.deg2rad(3.0))
    assert abs(made.T_grid_world[2, 3]) < 0.08
    np.testing.assert_allclose(made.path, truth.Ts_world_body[:, :2, 3], atol=1e-6)
    assert made.grid.probability(made.path).max() < 0.55
    occupied = made.grid.log_odds > 0.62
    assert 1500 < occupied.sum() < 8000
    loaded = load_grid(tmp_path / "desk.yaml")
    assert (loaded.log_odds > 0).sum() == occupied.sum()
