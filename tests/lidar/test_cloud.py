"""Clouds drop what is no number, count it, and move with what they know."""

import numpy as np
import pytest

import odomap
from odomap.errors import InputError
from odomap.geometry.lie import se3_exp
from odomap.lidar.cloud import Cloud, cloud_of


def test_rows_that_are_no_numbers_are_dropped_with_their_times():
    points = np.arange(15.0).reshape(5, 3)
    points[1, 2], points[3, 0] = np.nan, np.inf
    cloud = Cloud.of(points, [0.0, 1.0, 2.0, 3.0, 4.0])
    assert (len(cloud), cloud.num_dropped, cloud.times.tolist()) == (3, 2, [0.0, 2.0, 4.0])
    assert not cloud.points.flags.writeable
    assert "2 dropped" in repr(cloud)


def test_a_scan_of_the_plane_knows_it_is_one():
    cloud = odomap.Cloud.of(np.ones((4, 2), np.float32))
    assert cloud.is_planar
    assert cloud.points.tolist() == [[1.0, 1.0, 0.0]] * 4
    assert cloud_of(cloud) is cloud


def test_everything_known_moves_along():
    T = se3_exp(np.array([1.0, 2.0, 3.0, 0.1, -0.4, 0.2]))
    n = np.array([[0.0, 0.6, 0.8]])
    cloud = Cloud(np.ones((1, 3)), normals=n, covariances=n[:, :, None] * n[:, None])
    moved = cloud.moved(T)
    np.testing.assert_allclose(moved.points[0], T[:3, :3] @ np.ones(3) + T[:3, 3])
    np.testing.assert_allclose(moved.normals[0], T[:3, :3] @ n[0])
    np.testing.assert_allclose(moved.covariances[0], np.outer(moved.normals, moved.normals))


@pytest.mark.parametrize(
    "make",
    [
        lambda: Cloud.of(np.zeros((3, 4))),
        lambda: Cloud.of("points"),
        lambda: Cloud.of(np.zeros((3, 3)), times=[1.0]),
        lambda: Cloud(np.full((1, 3), np.nan)),
        lambda: Cloud(np.zeros((2, 3)), normals=np.zeros((1, 3))),
        lambda: Cloud.of(np.zeros((3, 3))).moved(np.eye(3)),
    ],
)
def test_what_does_not_fit_is_said(make):
    with pytest.raises(InputError, match="cloud: "):
        make()
