"""Scans as points: beams on the body, surfaces between them, free ways."""

import numpy as np
import pytest

from odomap.geometry.pose import SE3
from odomap.lidar.scans import Beams, ScanConfig
from odomap.sensors.rig import LidarMount

ANGLES = (-np.pi / 2, np.pi / 2, 181)


def mount(T=None, angles=ANGLES, range_m=(0.1, 30.0)):
    return LidarMount("laser", SE3(np.eye(4)) if T is None else SE3(T), range_m, angles=angles)


def test_hits_are_where_beams_end():
    ranges = np.full(181, np.nan)
    ranges[[0, 90, 180]] = 1.0, 2.0, 3.0
    scan = Beams(mount()).points(ranges)
    np.testing.assert_allclose(scan.hits, [[0, -1], [2, 0], [0, 3]], atol=1e-12)
    assert len(scan.between) == len(scan.free) == 0
    assert (scan.num_beams, scan.num_invalid) == (181, 178)


def test_a_scanner_that_hangs_head_down_sees_left_what_its_beams_have_right():
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = 0.2, 0.1, 1.5
    ranges = np.full(181, np.nan)
    ranges[0] = 1.0  # to its right
    scan = Beams(mount(T)).points(ranges)
    np.testing.assert_allclose(scan.hits, [[0.2, 1.1]], atol=1e-12)
    np.testing.assert_allclose(scan.origin, [0.2, 0.1])


def test_a_wall_is_whole_and_a_door_stays_open():
    angles = np.linspace(*ANGLES)
    with np.errstate(divide="ignore"):
        ranges = np.abs(2.0 / np.cos(angles))  # a wall 2 m ahead
    ranges[ranges > 12] = np.nan
    wall = Beams(mount()).points(ranges)
    y = np.sort(np.concatenate([wall.hits, wall.between])[:, 1])
    middle = y[np.abs(y) < 5]
    assert np.diff(middle).max() < 0.036
    np.testing.assert_allclose(wall.between[:, 0], 2.0, atol=1e-9)
    ranges[88:94] = 6.0  # an open door, with the wall of the room behind
    door = Beams(mount()).points(ranges)
    behind = (door.between[:, 0] > 2.1) & (door.between[:, 0] < 5.9)
    assert not behind.any()


def test_what_is_too_near_or_too_far_is_no_hit_and_nothing_is_free_unless_asked():
    ranges = np.full(181, np.inf)
    ranges[10], ranges[20], ranges[30] = 0.05, 29.0, 31.0
    assert len(Beams(mount()).points(ranges)) == 0  # 20 m is the farthest by default
    beams = Beams(mount(), ScanConfig(farthest=30.0, free=4.0))
    scan = beams.points(ranges)
    assert len(scan) == 1
    assert len(scan.free) == 179  # all but the hit and what is too near
    np.testing.assert_allclose(np.linalg.norm(scan.free, axis=1), 4.0)


def test_a_scan_of_another_scanner_is_refused():
    with pytest.raises(ValueError, match="a scan of 100 beams, expected 181"):
        Beams(mount()).points(np.ones(100))


@pytest.mark.parametrize("ranges", [np.full(181, np.nan), np.full(181, np.inf), np.zeros(181)])
def test_an_empty_scan_has_no_points(ranges):
    scan = Beams(mount()).points(ranges)
    assert len(scan.hits) == len(scan.between) == 0


def test_a_wall_has_its_normal_to_where_it_ends_in_view():
    # One that is seen to the side ends where the view does, and that end moves with the scanner:
    # without a normal it would say how far along the wall it is.
    angles = np.linspace(*ANGLES)
    ranges = np.abs(1.0 / np.sin(np.minimum(angles, -1e-9)))  # a wall 1 m to the right
    ranges[angles > -0.2] = np.nan
    wall = Beams(mount()).points(ranges)
    np.testing.assert_allclose(np.abs(wall.normals[:-1]), [[0.0, 1.0]] * (len(wall) - 1), atol=1e-9)


def test_each_wall_has_its_normal_up_to_a_corner_which_has_none():
    angles = np.linspace(*ANGLES)
    with np.errstate(divide="ignore"):
        ahead = np.where(np.abs(angles) < 1.5, 2.0 / np.cos(angles), np.inf)
        right = np.where(angles < 0, -2.0 / np.sin(angles), np.inf)
    scan = Beams(mount(range_m=(0.1, 5.0))).points(np.minimum(ahead, right))
    apart = np.linalg.norm(scan.hits - [2.0, -2.0], axis=1)
    assert not scan.normals[apart < 1e-6].any()
    inside = (apart > 0.1) & (np.abs(scan.hits[:, 1]) < 4)
    is_ahead = np.isclose(scan.hits[:, 0], 2.0)
    along_x = np.where(is_ahead[:, None], [1.0, 0.0], [0.0, 1.0])
    np.testing.assert_allclose(np.abs(scan.normals[inside]), along_x[inside], atol=1e-6)
