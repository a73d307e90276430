"""Dense 3D from a real depth camera: a frame that was not fused agrees with the mesh."""

import numpy as np
from scipy.spatial import cKDTree

from odomap.export import export
from odomap.files.trajectories import write_tum
from odomap.maps.depthviews import SensorViews
from odomap.sources.open import open as open_source


def test_a_desk(data_folder, tmp_path):
    data = data_folder / "rgbd_desk"
    source = open_source(data)
    inside = (source.stamps_ns >= source.truth.stamps_ns[0]) & (
        source.stamps_ns <= source.truth.stamps_ns[-1]
    )
    rows = np.flatnonzero(inside)
    write_tum(tmp_path / "keyframes.tum", source.truth.interpolate(source.stamps_ns[rows[::8]]))
    (tmp_path / "config.yaml").write_text(f"data: {data}\n", encoding="utf-8")
    result = export(tmp_path, voxel=0.02, max_depth=3.0)
    assert result.keyframes >= 0.9 * len(rows[::8])  # a few have no depth
    assert result.surface.colours.std(axis=1).max() > 30  # in colour
    views = SensorViews(source.rig)
    held_out = rows[60] if rows[60] not in rows[::8] else rows[61]
    depth = views.view(source.frame(int(held_out))).depth[::4, ::4]
    u, v = np.meshgrid(np.arange(0, 640, 4.0), np.arange(0, 480, 4.0))
    rays = views.camera.unproject(np.stack([u.ravel(), v.ravel()], 1))
    points = (rays / rays[:, 2:] * depth.reshape(-1, 1))[
        (depth.ravel() > 0.3) & (depth.ravel() < 2)
    ]
    T_world_camera = source.truth.interpolate(source.stamps_ns[[held_out]]).pose(0)
    gap, _ = cKDTree(result.surface.points).query(T_world_camera @ points)
    # The points of the mesh are a voxel apart, and motion capture and camera differ by centimetres.
    assert np.median(gap) < 0.015
    assert np.mean(gap < 0.05) > 0.9
