"""A map of voxels keeps what is new, forgets what is far, and serves as a target."""

import numpy as np
import pytest

import odomap
from lidarworlds import ROOM
from odomap.errors import ConfigError, InputError
from odomap.geometry.lie import se3_exp, se3_inverse
from odomap.lidar import voxelmap
from odomap.lidar.voxelmap import VoxelMap


def test_points_are_bounded_and_apart():
    rng = np.random.default_rng(0)
    grid = VoxelMap(1.0, points_per_voxel=5, gap=0.2)
    for _ in range(20):
        grid.insert(rng.uniform(0, 3, (2000, 3)))
    assert len(grid) == 27
    assert grid.num_points <= 5 * 27
    for box in np.unique(np.floor(grid.points), axis=0):
        inside = grid.points[np.all(np.floor(grid.points) == box, axis=1)]
        d = np.linalg.norm(inside[:, None] - inside, axis=2)
        assert len(inside) <= 5
        assert d[np.triu_indices(len(inside), 1)].min() >= 0.2


def test_standing_still_adds_nothing():
    rng = np.random.default_rng(1)
    points = rng.uniform(-5, 5, (3000, 3))
    grid = VoxelMap(1.0, gap=0.05)
    grid.insert(points)
    before = grid.points
    grid.insert(points)
    assert np.array_equal(grid.points, before)


def test_many_voxels_grow_the_room_and_order_is_kept():
    rng = np.random.default_rng(2)
    points = rng.uniform(-50, 50, (20_000, 3))
    at_once, in_parts = VoxelMap(1.0), VoxelMap(1.0)
    for grid in (at_once, in_parts):
        grid.insert(points[:100])
    at_once.insert(points[100:])
    for k in range(100, len(points), 700):
        in_parts.insert(points[k : k + 700])
    assert len(at_once) > 15_000
    assert np.array_equal(at_once.points, in_parts.points)


def test_what_is_far_is_forgotten_and_can_come_back():
    rng = np.random.default_rng(3)
    grid = VoxelMap(1.0)
    grid.insert(rng.uniform(-20, 20, (5000, 3)))
    count = len(grid)
    gone = grid.evict([0, 0, 0], 10.0)
    assert 0 < gone < count
    assert len(grid) == count - gone
    assert np.linalg.norm(grid.points, axis=1).max() <= 10.0 + np.sqrt(3)
    before = grid.num_points
    grid.insert([[15.0, 15.0, 15.0], [15.5, 15.5, 15.5]])
    assert before < grid.num_points <= before + 2
    assert grid.evict([0, 0, 0], 1e9) == 0


def test_memory_is_bounded_on_a_long_way():
    rng = np.random.default_rng(4)
    grid = VoxelMap(1.0)
    sizes = []
    for k in range(60):
        middle = np.array([3.0 * k, 0.0, 0.0])
        grid.insert(middle + rng.uniform(-15, 15, (3000, 3)))
        grid.evict(middle, 20.0)
        sizes.append(grid._kept.nbytes)
    assert max(sizes[30:]) <= max(sizes[:30])


def test_scans_are_laid_onto_the_map():
    rng = np.random.default_rng(5)
    grid = VoxelMap(0.5)
    for _ in range(3):
        grid.insert(ROOM.seen(rng))
    T = se3_exp(np.array([0.1, -0.1, 0.05, 0.01, 0.02, 0.06]))
    scan = (ROOM.seen(rng) - T[:3, 3]) @ T[:3, :3]
    for method in ("plane", "gicp", "icp"):
        found = odomap.register(scan, grid.target(1.0), method)
        off = se3_inverse(T) @ found.T_target_source
        assert found.converged
        assert np.abs(off[:3, 3]).max() < (0.05 if method == "icp" else 0.02)
        assert np.abs(off[:3, :3] - np.eye(3)).max() < (0.02 if method == "icp" else 0.003)


def test_far_from_the_origin_of_a_projection():
    rng = np.random.default_rng(6)
    shift = np.array([4.5e5, 5.4e6, 100.0])
    grid = VoxelMap(0.5)
    grid.insert(ROOM.seen(rng) + shift)
    assert np.abs(grid.points - shift).max() < 5.0
    found = odomap.register(ROOM.seen(rng) + shift, grid.target())
    moved = found.T_target_source[:3, :3] @ shift + found.T_target_source[:3, 3] - shift
    assert np.abs(moved).max() < 0.01


def test_what_cannot_be_is_said():
    for settings in (
        {"voxel": 0.0},
        {"voxel": 1.0, "gap": -1.0},
        {"voxel": 1, "points_per_voxel": 0},
    ):
        with pytest.raises(ConfigError, match="voxel map"):
            VoxelMap(**settings)
    grid = VoxelMap(0.01)
    with pytest.raises(InputError, match="is empty"):
        grid.target()
    grid.insert(np.empty((0, 3)))
    with pytest.raises(InputError, match="NaN"):
        grid.insert([[np.nan, 0, 0]])
    grid.insert([[0.0, 0.0, 0.0]])
    with pytest.raises(InputError, match="too far"):
        grid.insert([[1e6, 0.0, 0.0]])
    with pytest.raises(InputError, match="evict"):
        grid.evict([0, 0], 1.0)


def test_warm_up_compiles_all():
    voxelmap.warm_up()
    assert voxelmap.insert_kernel.signatures
