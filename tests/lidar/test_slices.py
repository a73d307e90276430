"""Slices: what stands in the way, where the way is free, and where the floor is."""

import numpy as np
import pytest

from odomap.errors import ConfigError
from odomap.lidar.slices import SliceConfig, find_floor, level, slice_sweep

EYE = np.array([0.0, 0.0, 1.0])
BAND = SliceConfig(low=0.1, high=1.8, farthest=30.0)


def way(found, angle=0.0):
    """Return from and to where the way is free in a direction, or None."""
    for start, end in zip(found.free_from, found.free):
        if abs(np.arctan2(end[1], end[0]) - angle) < np.pi / BAND.sectors + 1e-9:
            return float(np.hypot(*start)), float(np.hypot(*end))
    return None


def sweep(*points, eye=EYE):
    return slice_sweep(np.array(points, float), eye, BAND)


def test_a_wall_is_a_hit_and_the_way_to_it_is_free():
    found = sweep([5.0, 0.01, 1.2])
    assert found.hits.tolist() == [[5.0, 0.01]]
    assert way(found) == pytest.approx((0.0, 5.0), abs=1e-4)


def test_the_floor_is_free_up_to_where_it_is_seen():
    found = sweep([5.0, 0.01, 0.02])
    assert not len(found.hits)
    assert way(found) == pytest.approx((0.0, 5.0), abs=1e-4)


def test_a_ceiling_says_free_up_to_where_the_beam_leaves_the_band():
    found = sweep([4.0, 0.01, 3.0])
    assert not len(found.hits)
    assert way(found) == pytest.approx((0.0, 4.0 * 0.8 / 2.0), abs=1e-4)


def test_from_above_the_way_begins_where_the_beam_comes_into_the_band():
    found = sweep([10.0, 0.01, 0.0], eye=np.array([0.0, 0.0, 5.0]))
    assert way(found) == pytest.approx((6.4, 10.0), abs=1e-4)
    over = sweep([10.0, 0.01, 3.0], eye=np.array([0.0, 0.0, 5.0]))
    assert way(over) is None


def test_behind_the_nearest_hit_nothing_is_free_but_walls_are_hits():
    found = sweep([2.0, 0.001, 0.4], [6.0, 0.003, 0.9], [8.0, 0.004, 0.0])
    assert found.hits[:, 0].tolist() == [2.0, 6.0]
    assert way(found)[1] == pytest.approx(2.0, abs=1e-4)


def test_a_hole_is_not_free():
    found = sweep([4.0, 0.01, -2.0])
    assert way(found) == pytest.approx((0.0, 4.0 * 0.9 / 3.0), abs=1e-4)


@pytest.mark.parametrize("z", [np.nan, np.inf])
def test_what_is_not_finite_too_near_or_too_far_says_nothing(z):
    found = sweep([4.0, 0.0, z], [0.05, 0.0, 1.0], [31.0, 0.0, 1.0])
    assert len(found.hits) == len(found.free) == 0
    assert not len(slice_sweep(np.zeros((0, 3)), EYE, BAND).free)


def test_all_directions_are_there():
    angles = np.linspace(-np.pi, np.pi, 5000)
    points = np.column_stack([3 * np.cos(angles), 3 * np.sin(angles), np.full(5000, 0.5)])
    aside = np.array([1.0, 2.0, 0.0])
    found = slice_sweep(points + aside, EYE + aside, BAND)
    assert len(found.hits) == 5000
    assert len(found.free) == BAND.sectors
    np.testing.assert_allclose(np.hypot(*(found.free - aside[:2]).T), 3.0)


@pytest.mark.parametrize("band", [(1.0, 0.5), (0.5, 0.5), (np.nan, 1.0), (0.0, np.inf)])
def test_a_band_that_is_none_is_refused(band):
    with pytest.raises(ConfigError, match="height"):
        SliceConfig(low=band[0], high=band[1])


def room(rng, floor_share=0.15):
    """Points of a room of 6 m by 4 m by 2.5 m with a table, z = 0 at its floor."""
    count = 6000
    floor = rng.uniform([-3, -2, 0], [3, 2, 0], (int(floor_share * count), 3))
    table = rng.uniform([0, 0, 0.75], [1.5, 1, 0.75], (800, 3))
    walls = rng.uniform([-3, -2, 0], [3, 2, 2.5], (count, 3))
    side = rng.integers(0, 4, count)
    walls[side == 0, 0], walls[side == 1, 0] = -3, 3
    walls[side == 2, 1], walls[side == 3, 1] = -2, 2
    ceiling = rng.uniform([-3, -2, 2.5], [3, 2, 2.5], (count // 4, 3))
    points = np.concatenate([floor, table, walls, ceiling])
    return points + 0.01 * rng.standard_normal(points.shape)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("tilt_deg", [17.0, 40.0])
def test_the_floor_is_found_however_the_world_is_turned(seed, tilt_deg):
    rng = np.random.default_rng(seed)
    points, eyes = room(rng), rng.uniform([-1, -1, 0.8], [1, 1, 1.6], (5, 3))
    axis, around = rng.standard_normal(3), rng.uniform(0, 2 * np.pi)
    up = axis / np.linalg.norm(axis)
    T = np.linalg.inv(level(up, 0.7))
    off = np.deg2rad(tilt_deg)
    tilted = [np.sin(off) * np.cos(around), np.sin(off) * np.sin(around), np.cos(off)]
    moved, seen_from = (p @ T[:3, :3].T + T[:3, 3] for p in (points, eyes))
    n, height = find_floor(moved, seen_from, T[:3, :3] @ tilted)
    assert np.degrees(np.arccos(min(n @ up, 1.0))) < 0.5
    assert height == pytest.approx(0.7, abs=0.02)


def test_a_floor_of_which_little_is_seen_is_found_below_a_table():
    rng = np.random.default_rng(1)
    table = rng.uniform([0, 0, 0.75], [1.5, 1, 0.75], (5000, 3))
    floor = rng.uniform([-1, -1, 0], [0, 1, 0], (200, 3))
    points = np.concatenate([table, floor]) + 0.005 * rng.standard_normal((5200, 3))
    n, height = find_floor(points, np.array([[0.5, -1, 1.4]]), np.array([0.0, 0.5, 0.75**0.5]))
    assert n[2] > np.cos(np.deg2rad(0.5))
    assert height == pytest.approx(0.0, abs=0.02)


def test_where_no_floor_is_seen_none_is_found():
    rng, z, eyes = np.random.default_rng(0), np.array([0, 0, 1.0]), np.array([[0, 0, 1.0]])
    wall = rng.uniform([3, -2, 0], [3, 2, 2.5], (3000, 3)) + 0.01 * rng.standard_normal((3000, 3))
    line = np.linspace([3, -1, 0], [3, 1, 2], 500)
    for points in (wall, wall[:2], line, np.zeros((100, 3))):
        n, height = find_floor(points, eyes, z)
        assert height is None
        np.testing.assert_array_equal(n, z)
    n, height = find_floor(room(rng, floor_share=0.0), eyes, z)
    assert height is None  # a table has much below it
    assert n[2] > 0.9999  # but it, and the ceiling, are level


@pytest.mark.parametrize("up", [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -0.6, 0.8]])
def test_level_turns_up_to_z(up):
    T = level(np.array(up, float), 2.0)
    np.testing.assert_allclose(T[:3, :3] @ up, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T) == pytest.approx(1.0)
    assert (T @ [*(2.0 * np.array(up)), 1])[2] == pytest.approx(0.0)
