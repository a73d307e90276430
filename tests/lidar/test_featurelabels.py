"""Edges, planes and ground of simulated sweeps are those of the world."""

from functools import cache

import numpy as np
import pytest

from odomap.lidar.curvature import curvatures
from odomap.lidar.featureconfig import CurvatureConfig
from odomap.lidar.featurematching import EDGES, GROUND
from odomap.lidar.featurepicking import EDGE, FLAT, PLANE, pick
from odomap.lidar.lego import LegoFrontEnd
from odomap.lidar.loam import LoamFrontEnd
from odomap.lidar.scanlines import scan_lines
from odomap.lidar.sweeps import SweepPoints, points_of
from odomap.sensors.rig import LidarMount
from odomap.sensors.sweep import Sweep
from odomap.simulation.solids import KINDS
from odomap.simulation.sweepworld import SweepSpec, SweepWorld

FRONT_ENDS = (LoamFrontEnd, LegoFrontEnd)
LEAVES = KINDS.index("leaves")


@cache
def seen(kind, seed, beams, pattern="rotating"):
    """Return a sweep of a world, and what its points truly show."""
    world = SweepWorld(SweepSpec(kind=kind, seed=seed, frames=21, beams=beams, pattern=pattern))
    sweep = points_of(world.frame(20).cloud, world.rig.lidars[0])
    return sweep, world.sweep_truth(20, reach=3)


def points(array, beams=None, times=None):
    """Return a sweep of bare points."""
    return points_of(Sweep(np.asarray(array, float), times, None, beams), LidarMount("top"))


def is_border(sweep, truth, reach=3):
    """Say of each point whether along its line another surface is beside it, in front of nothing.

    The truth's own edges leave out steps of a facade that are small for their range.
    """
    lines = scan_lines(sweep, np.eye(4))
    surfaces = truth.surfaces[sweep.rows][lines.order]
    ranges = np.linalg.norm(lines.points, axis=1)
    border = np.zeros(len(sweep), bool)
    for k in range(1, reach + 1):
        for way in (k, -k):
            other = np.roll(surfaces, way) != surfaces
            border |= other & (np.roll(ranges, way) > ranges - 0.15)
    out = np.empty(len(sweep), bool)
    out[lines.order] = border
    return out


@pytest.mark.parametrize("make", FRONT_ENDS)
@pytest.mark.parametrize(
    ("kind", "seed", "beams"),
    [("street", 1, 64), ("street", 2, 32), ("street", 4, 16), ("room", 3, 32), ("building", 5, 16)],
)
def test_labels_are_those_of_the_world(make, kind, seed, beams):
    sweep, truth = seen(kind, seed, beams)
    found = make().prepare(sweep)
    edges, planes = found.marks == EDGE, found.marks == PLANE
    assert edges.sum() > 3 * beams
    assert planes.sum() > 40 * beams
    is_leaf = truth.kinds[sweep.rows] == LEAVES  # edges of leaves are neither right nor wrong
    right = truth.is_edge[sweep.rows] | is_border(sweep, truth)
    assert right[edges & ~is_leaf].mean() >= 0.95
    normals, true = truth.normals[sweep.rows], truth.points[sweep.rows]
    off = np.abs(np.einsum("ni,ni->n", sweep.points - true, normals))
    ranges = np.linalg.norm(sweep.points, axis=1)
    in_plane = (off < 0.05 * (1 + ranges / 50)) & ~truth.is_edge[sweep.rows]
    assert in_plane[planes].mean() >= 0.98


@pytest.mark.parametrize(("seed", "beams"), [(1, 64), (2, 32), (3, 128)])
def test_ground_is_the_ground(seed, beams):
    sweep, truth = seen("street", seed, beams)
    found = LegoFrontEnd().prepare(sweep)
    is_ground = truth.is_ground[sweep.rows]
    assert is_ground[found.ground].mean() >= 0.97
    near = is_ground & (np.linalg.norm(sweep.points, axis=1) < 20.0)
    assert found.ground[near].mean() > 0.9
    assert np.count_nonzero(found.kinds == GROUND) > 100
    assert not np.any(found.ground & (found.marks == EDGE))


@pytest.mark.parametrize(("seed", "beams"), [(3, 16), (5, 16), (4, 32)])
def test_ground_of_few_beams_is_the_ground_too(seed, beams):
    sweep, truth = seen("street", seed, beams)
    found = LegoFrontEnd().prepare(sweep)
    assert found.ground.sum() > 200 * beams
    assert truth.is_ground[sweep.rows][found.ground].mean() >= 0.96


@pytest.mark.parametrize("make", FRONT_ENDS)
@pytest.mark.parametrize(("seed", "index"), [(2, 20), (4, 100), (5, 20), (8, 60), (9, 33)])
def test_a_solid_state_pattern_has_labels_too(make, seed, index):
    spec = SweepSpec(seed=seed, frames=index + 1, beams=16, pattern="solid_state")
    world = SweepWorld(spec)
    sweep = points_of(world.frame(index).cloud, world.rig.lidars[0])
    truth = world.sweep_truth(index, reach=3)
    assert not scan_lines(sweep, np.eye(4)).turns
    found = make().prepare(sweep)
    edges, planes = found.marks == EDGE, found.marks == PLANE
    is_leaf = truth.kinds[sweep.rows] == LEAVES
    right = truth.is_edge[sweep.rows] | is_border(sweep, truth)
    assert edges.sum() > 40
    assert right[edges & ~is_leaf].mean() >= 0.95
    off = np.einsum("ni,ni->n", sweep.points - truth.points[sweep.rows], truth.normals[sweep.rows])
    ranges = np.linalg.norm(sweep.points, axis=1)
    in_plane = (np.abs(off) < 0.05 * (1 + ranges / 50)) & ~truth.is_edge[sweep.rows]
    assert planes.sum() > 900
    assert in_plane[planes].mean() >= 0.92  # of one sweep; the benchmark has 0.95 of four


def test_a_corner_is_found_where_it_is_and_what_hides_it_is_not_an_edge():
    azimuth = np.radians(np.arange(-60.0, 60.0, 0.2))
    u = np.column_stack([np.cos(azimuth), np.sin(azimuth)])
    walls = np.minimum(6.0 / u[:, 0], 4.0 / np.maximum(np.abs(u[:, 1]), 1e-9))
    post = np.abs(u @ [np.sin(0.3), -np.cos(0.3)]) < 0.02
    hit = np.where(post & (azimuth > 0), 3.0, walls)
    many = np.vstack(
        [hit[:, None] * np.column_stack([u, np.full(len(u), 0.02 * k)]) for k in range(5)]
    )
    found = LoamFrontEnd().prepare(points(many, np.repeat(np.arange(5), len(u)).astype(np.int16)))
    edges = many[found.marks == EDGE]
    on_corner = np.abs(np.abs(edges[:, 1]) - 4.0) + np.abs(edges[:, 0] - 6.0) < 0.1
    on_post = np.hypot(edges[:, 0], edges[:, 1]) < 3.1
    assert on_corner.sum() == 10
    assert on_post.sum() >= 5
    assert np.all(on_corner | on_post)
    flat = many[(found.marks == FLAT) | (found.marks == PLANE)]
    assert np.min(np.abs(np.abs(flat[:, 1]) - 4.0) + np.abs(flat[:, 0] - 6.0)) > 0.02


def test_noise_of_a_flat_wall_is_no_edge():
    rng = np.random.default_rng(0)
    azimuth = np.radians(np.arange(-40.0, 40.0, 0.1))
    for distance in (1.0, 3.0, 30.0):
        r = distance / np.cos(azimuth) + 0.02 * rng.normal(size=len(azimuth))
        wall = np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), np.zeros(len(r))])
        found = LoamFrontEnd().prepare(points(wall, np.zeros(len(r), np.int16)))
        assert not np.any(found.marks == EDGE)
        assert np.any(found.marks == PLANE)


@pytest.mark.parametrize("make", FRONT_ENDS)
def test_labels_do_not_depend_on_the_order_of_the_rows(make):
    sweep, _ = seen("street", 2, 32)
    mixed = np.random.default_rng(1).permutation(len(sweep))
    other = SweepPoints(
        sweep.points[mixed], sweep.times[mixed], sweep.intensities[mixed], sweep.beams[mixed],
        sweep.rows[mixed], sweep.has_times, sweep.num_rows,
    )  # fmt: skip
    marks, again = make().prepare(sweep).marks, make().prepare(other).marks
    # Lines begin elsewhere, and with them their parts, from which as many are taken.
    assert np.mean((marks == EDGE)[mixed] == (again == EDGE)) > 0.995
    assert np.mean((marks > 0)[mixed] == (again > 0)) > 0.97


@pytest.mark.parametrize("make", FRONT_ENDS)
def test_labels_turn_with_the_world(make):
    sweep, _ = seen("street", 2, 32)
    c, s = np.cos(1.0), np.sin(1.0)
    turned = sweep.points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    other = SweepPoints(
        turned, sweep.times, sweep.intensities, sweep.beams, sweep.rows, True, sweep.num_rows
    )
    marks, again = make().prepare(sweep).marks, make().prepare(other).marks
    assert np.mean(marks == again) > 0.995


@pytest.mark.parametrize("make", FRONT_ENDS)
def test_a_lidar_that_is_mounted_askew_sees_the_same(make):
    sweep, _ = seen("street", 2, 32)
    c, s = np.cos(0.5), np.sin(0.5)
    T_body_lidar = np.array([[c, 0, s, 1.0], [0, 1, 0, 0.5], [-s, 0, c, -2.0], [0, 0, 0, 1.0]])
    level = np.eye(4)  # the mount says how it is turned; the body stays level
    level[:3, 3] = T_body_lidar[:3, 3]
    moved = SweepPoints(
        sweep.points + level[:3, 3], sweep.times, sweep.intensities, sweep.beams, sweep.rows,
        True, sweep.num_rows,
    )  # fmt: skip
    marks = make().prepare(sweep).marks
    found = make(T_body_lidar=level).prepare(moved)
    assert np.mean(marks == found.marks) > 0.999
    np.testing.assert_allclose(found.points.mean(), moved.points.mean(), atol=20.0)


@pytest.mark.parametrize("make", FRONT_ENDS)
@pytest.mark.parametrize("count", [0, 1, 7])
def test_hardly_any_points_have_hardly_any_features(make, count):
    found = make().prepare(points(np.random.default_rng(0).normal(5.0, 1.0, (count, 3))))
    assert np.count_nonzero(found.marks >= PLANE) <= len(found.points) <= count
    assert len(found.marks) == count


def test_more_of_the_sharpest_are_taken_where_more_are_asked_for():
    sweep, _ = seen("street", 1, 64)
    lines = scan_lines(sweep, np.eye(4))
    counts = []
    for edges in (1, 2, 6):
        config = CurvatureConfig(edges=edges)
        c, reach = curvatures(lines, config)
        marks = pick(lines, c, reach, np.full(len(c), 3, np.uint8), config)
        counts.append(int(np.count_nonzero(marks == EDGE)))
        assert counts[-1] <= edges * config.sectors * len(lines)
    assert counts == sorted(counts)
    assert counts[0] < counts[-1]


def test_edges_are_no_planes_and_all_features_are_points_of_the_sweep():
    sweep, _ = seen("street", 2, 32)
    found = LegoFrontEnd().prepare(sweep)
    assert np.count_nonzero(found.kinds == EDGES) == np.count_nonzero(found.marks == EDGE)
    rows = {p.tobytes() for p in sweep.points}
    assert all(p.tobytes() in rows for p in found.points)
