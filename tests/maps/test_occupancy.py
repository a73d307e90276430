"""Grids of maps: from 2D scans, from sweeps, and what of a map they follow."""

import numpy as np
import pytest

import gridworlds
import odomap
from gridworlds import LASER, SWEEPS, occupied, recorded, true_map
from odomap.errors import ConfigError, InputError
from odomap.geometry.pose import SE3
from odomap.lidar.scans import ScanConfig
from odomap.lidar.slices import SliceConfig
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.maps.occupancy import GridConfig, Sweep, grid_of_map, grid_of_sweeps, upwards
from odomap.maps.snapshot import Update
from odomap.sensors.rig import ImuMount, LidarMount, Rig


@pytest.fixture(scope="module")
def sweeps():
    return true_map(SWEEPS, 4)


def is_as(grid, other):
    a, b = grid.cropped(), other.cropped()
    np.testing.assert_array_equal(a.log_odds, b.log_odds)
    np.testing.assert_allclose(a.origin, b.origin, atol=1e-9)
    return True


def test_a_grid_of_scans_shows_the_plan_and_the_path_is_free():
    source = recorded(LASER)
    made = grid_of_map(true_map(LASER, 5), source.rig)
    assert made.made_of == "scans"
    assert not made.notes
    centres = occupied(made.grid)
    assert len(centres) > 500
    assert np.mean(source.world.plan.distances(centres) < 0.05) > 0.93
    np.testing.assert_array_equal(made.path, source.truth.Ts_world_body[::5, :2, 3])
    assert made.grid.probability(made.path).max() < 0.2


def test_the_same_map_gives_the_same_grid_through_the_face():
    m, rig = true_map(LASER, 10), recorded(LASER).rig
    grid = odomap.occupancy_grid(m, rig, 0.1)
    assert isinstance(grid, odomap.OccupancyGrid)
    assert grid.resolution == 0.1
    assert is_as(grid, odomap.occupancy_grid(m, rig, 0.1))


def test_a_grid_is_remade_where_a_loop_moved_the_keyframes():
    source = recorded(LASER)
    true = true_map(LASER, 10)
    ids = true.keyframe_ids
    Ts, m = true.Ts_world_body(ids), Map()
    for n, k in enumerate(ids.tolist()):
        drifted = Ts[n].copy()
        drifted[0, 3] += 0.1 * n
        m.add_keyframe(true.keyframe(k), drifted)
    bent = odomap.occupancy_grid(m, source.rig)
    assert np.mean(source.world.plan.distances(occupied(bent)) < 0.05) < 0.6
    nothing = np.zeros(0, np.int64), np.zeros((0, 3))
    m.apply(Update(int(ids[0]), Ts[0], ids, Ts, *nothing, m.version))
    remade, wanted = (odomap.occupancy_grid(each, source.rig) for each in (m, true))
    away = gridworlds.distances(occupied(remade), occupied(wanted))
    assert away.max() < 0.08  # poses are the same to rounding, cells at a border may not be
    assert np.mean(away == 0) > 0.99


def test_of_a_map_in_pieces_the_largest_is_shown():
    m, rig = true_map(LASER, 10), recorded(LASER).rig
    alone = grid_of_map(m, rig)
    k = m.new_keyframe_id()
    scan = m.keyframe(int(m.keyframe_ids[0])).scan
    far = np.eye(4)
    far[:2, 3] = 3.0, 2.0
    m.add_keyframe(Keyframe(k, 10**19 // 2, scan=scan), far)
    m.begin_piece(k)
    made = grid_of_map(m, rig)
    assert is_as(made.grid, alone.grid)
    assert "the map is in 2 pieces" in made.notes[0]


def test_no_return_is_free_only_where_that_is_asked_for():
    mount = LidarMount("laser", angles=(-1.0, 1.0, 5))
    m = Map()
    ranges = np.array([np.inf, np.nan, 2.0, np.nan, np.inf])
    m.add_keyframe(Keyframe(m.new_keyframe_id(), 0, scan=ranges), np.eye(4))
    ahead = np.array([np.cos(-1.0), np.sin(-1.0)])[None] * 1.5
    silent = odomap.occupancy_grid(m, Rig(lidars=(mount,)))
    assert silent.probability(ahead) == 0.5
    config = GridConfig(scan=ScanConfig(free=3.0))
    assert odomap.occupancy_grid(m, Rig(lidars=(mount,)), config=config).probability(ahead) < 0.5


def test_a_grid_of_sweeps_shows_what_stands_between_two_heights(sweeps):
    made = grid_of_map(sweeps, recorded(SWEEPS).rig)
    assert made.made_of == "clouds"
    assert made.notes == ("the floor is 1.37 m below the sensor, by what was seen",)
    true = gridworlds.surfaces(SWEEPS, 0.1, 1.8)
    centres = occupied(made.grid)
    away = gridworlds.distances(centres, true)
    assert len(centres) > 800
    assert np.mean(away < 0.075) > 0.95  # in the cells of walls and in those beside them
    p = made.grid.probability(made.path)
    assert p.max() < 0.5
    low = grid_of_map(
        sweeps, recorded(SWEEPS).rig, GridConfig(slice=SliceConfig(low=1.5, high=1.8))
    )
    assert len(occupied(low.grid)) < 0.8 * len(centres)  # furniture is lower


def test_heights_may_be_counted_along_the_body(sweeps):
    rig = recorded(SWEEPS).rig
    made = grid_of_map(sweeps, rig, GridConfig(up="body", floor=1.4))
    away = gridworlds.distances(occupied(made.grid), gridworlds.surfaces(SWEEPS, 0.0, 1.9))
    assert np.mean(away < 0.05) > 0.85  # the body sways, and its floor with it
    given = grid_of_map(sweeps, rig, GridConfig(floor=1.39))
    found = grid_of_map(sweeps, rig)
    assert not given.notes
    assert len(occupied(given.grid)) == pytest.approx(len(occupied(found.grid)), rel=0.05)


def test_a_world_that_lies_on_its_side_is_set_upright():
    camera_axes = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    T = SE3.from_parts(camera_axes, np.array([4.0, 1.0, -2.0])).matrix
    source = recorded(SWEEPS)
    upright = grid_of_map(true_map(SWEEPS, 10), source.rig)
    m = true_map(SWEEPS, 10, T)
    made = grid_of_map(m, source.rig)
    there = m.Ts_world_body(m.keyframe_ids)[:, :3, 3]
    seen = there @ made.T_grid_world[:3, :3].T + made.T_grid_world[:3, 3]
    np.testing.assert_allclose(seen[:, :2], made.path, atol=1e-9)
    assert 1.2 < seen[:, 2].mean() < 1.6  # above the floor
    steps = [np.linalg.norm(np.diff(path, axis=0), axis=1) for path in (made.path, upright.path)]
    np.testing.assert_allclose(*steps, atol=0.02)
    assert len(occupied(made.grid)) == pytest.approx(len(occupied(upright.grid)), rel=0.1)


def test_without_a_floor_heights_are_counted_from_the_lowest_points():
    wall = np.column_stack([np.full(500, 3.0), np.linspace(-1, 1, 500), np.linspace(0, 2, 500)])
    sweep = Sweep(np.eye(4), np.array([0, 0, 1.0]), wall)
    made = grid_of_sweeps(lambda: [sweep], np.array([0, 0, 1.0]))
    assert made.notes == ("no floor was seen: heights are counted from the lowest points",)
    assert made.grid.probability(np.array([[3.0, 0.02]])) > 0.6
    with pytest.raises(InputError, match="not one point"):
        grid_of_sweeps(lambda: [Sweep(np.eye(4), np.zeros(3), np.zeros((0, 3)))], np.eye(3)[2])


def test_what_is_missing_is_said():
    laser, top = LidarMount("laser", angles=(-1.0, 1.0, 5)), LidarMount("top")
    empty, scans, clouds = Map(), Map(), Map()
    scans.add_keyframe(Keyframe(scans.new_keyframe_id(), 0, scan=np.ones(4)), np.eye(4))
    clouds.add_keyframe(
        Keyframe(clouds.new_keyframe_id(), 0, cloud=np.ones((4, 3), np.float32)), np.eye(4)
    )
    for m, rig, said in (
        (empty, Rig(lidars=(laser,)), "neither scans nor clouds"),
        (scans, Rig(lidars=(top,)), "no 2D LiDAR"),
        (clouds, Rig(lidars=(laser,)), "no 3D LiDAR"),
        (scans, Rig(lidars=(laser,)), "has 4 beams, 'laser' of the rig has 5"),
    ):
        with pytest.raises(InputError, match=said):
            grid_of_map(m, rig)
    for wrong, said in (({"up": "north"}, "none of gravity"), ({"floor": np.nan}, "finite")):
        with pytest.raises(ConfigError, match=said):
            GridConfig(**wrong)


def test_which_way_is_up_follows_from_the_sensors():
    camera = recorded(gridworlds.DEPTH).rig
    np.testing.assert_allclose(upwards(camera), [0, -1, 0], atol=1e-9)
    turned = SE3.from_parts(np.diag([1.0, -1, -1]), np.zeros(3))
    with_imu = Rig(imu=ImuMount(), lidars=(LidarMount("top", turned),))
    np.testing.assert_allclose(upwards(with_imu), [0, 0, -1], atol=1e-9)
    np.testing.assert_allclose(upwards(Rig(lidars=(LidarMount("top", turned),))), [0, 0, 1])


def test_on_a_street_that_falls_the_ground_is_free_and_a_wall_is_not():
    m, rng = Map(), np.random.default_rng(0)
    rig = Rig(lidars=(LidarMount("top", range_m=(0.5, 60.0), beams=16),))
    for x in np.arange(0.0, 60.0, 3.0):
        xy = rng.uniform(-15, 15, (6000, 2)) + np.array([x, 0.0])
        ground = np.column_stack([xy, height(xy) + rng.normal(0, 0.02, len(xy))])
        wall = np.column_stack([rng.uniform(x - 15, x + 15, 2000), np.full(2000, 6.0)])
        wall = np.column_stack([wall, height(wall) + rng.uniform(0, 3, 2000)])
        there = np.concatenate([ground[np.hypot(*(ground[:, :2] - (x, 0)).T) > 3], wall])
        T = np.eye(4)
        T[:3, 3] = x, 0, height(np.array([[x, 0.0]]))[0] + 1.7
        cloud = (there - T[:3, 3]).astype(np.float32)
        k = m.new_keyframe_id()
        m.add_keyframe(Keyframe(k, int(x * 1e9), cloud=cloud), T)
    made = grid_of_map(m, rig, GridConfig(resolution=0.2))
    assert made.notes == (
        "the ground is not one plane: heights are counted from the lowest points around",
    )
    centres = occupied(made.grid)
    assert np.mean(np.abs(centres[:, 1] - 6.0) < 0.25) > 0.95
    x, y = np.meshgrid(np.arange(0, 57, 0.5), np.arange(-5, 5, 0.5))
    assert made.grid.probability(np.column_stack([x.ravel(), y.ravel()])).max() < 0.5
    asked = grid_of_map(m, rig, GridConfig(resolution=0.2, up="ground"))
    assert is_as(asked.grid, made.grid)


def height(xy):
    """Return the height of a street that falls by 6 m on its way, and bends."""
    return -0.1 * xy[:, 0] + 0.4 * np.sin(xy[:, 0] / 10.0)
