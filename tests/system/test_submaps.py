"""Submaps drift as they grow, and what is found in them is as unsure as their walls."""

import numpy as np
import pytest

from laserworlds import RIG, around, frames
from odomap.geometry.planar import moved_covariance
from odomap.lidar.grid import OccupancyGrid
from odomap.lidar.scans import Beams
from odomap.system.scanclosing import _less_sure
from odomap.system.submaps import Submap

SINCE = np.diag([1e-4, 4e-4, 1e-6])


@pytest.fixture(scope="module")
def scan():
    return Beams(RIG.lidars[0]).points(frames(around(2))[0].scan)


def test_walls_are_as_unsure_as_the_way_to_where_they_were_seen(scan):
    submap = Submap(0, OccupancyGrid(0.05, keeps_hits=True))
    submap.insert(0, scan, np.zeros(3))
    for k in (1, 2):
        submap.x_anchor_body = np.array([float(k), 0.0, 0.1 * k])
        submap.insert(k, scan, submap.x_anchor_body)
        submap.extend(SINCE)
    assert not submap.drift_near(np.array([0.2, 0.1, 2.0])).any()
    np.testing.assert_allclose(
        submap.drift_near(submap.x_anchor_body),
        moved_covariance(submap.drift, submap.x_anchor_body),
    )
    first = submap.drift_near(np.array([1.0, 0.0, 0.1]))
    np.testing.assert_allclose(first, SINCE, atol=1e-12)


def test_two_uncertainties_add_up_where_something_is_said():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(3, 3))
    information = A @ A.T + np.eye(3)
    found = _less_sure(information, SINCE)
    np.testing.assert_allclose(np.linalg.inv(found), np.linalg.inv(information) + SINCE)
    np.testing.assert_allclose(_less_sure(information, np.zeros((3, 3))), information)


def test_along_a_corridor_nothing_is_said_with_walls_that_are_unsure_either():
    across = np.diag([0.0, 1e5, 1e6])
    found = _less_sure(across, SINCE)
    np.testing.assert_array_equal(found, found.T)
    assert found[0, 0] == pytest.approx(0.0, abs=1e-6)
    assert found[1, 1] == pytest.approx(1.0 / (1e-5 + 4e-4))
    assert not _less_sure(np.zeros((3, 3)), SINCE).any()
