"""What returned of a sweep, and the sweep as of one instant."""

import numpy as np

from odomap.geometry.pose import SE3
from odomap.lidar.deskew import deskew
from odomap.lidar.sweeps import points_of
from odomap.sensors.rig import LidarMount
from odomap.sensors.sweep import Sweep


def test_what_did_not_return_is_left_out() -> None:
    rows = np.array(
        [[1.0, 0, 0], [0, 0, 0], [np.nan, 1, 1], [0.1, 0, 0], [60.0, 0, 0], [0, 3.0, 4.0]]
    )
    T = SE3.exp(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))
    mount = LidarMount("top", T, (0.5, 50.0))
    sweep = Sweep(rows, np.arange(6.0), None, np.arange(6, dtype=np.int16))
    got = points_of(sweep, mount)
    assert got.rows.tolist() == got.times.tolist() == got.beams.tolist() == [0, 5]
    np.testing.assert_allclose(got.points, T @ rows[[0, 5]], atol=1e-12)
    assert len(points_of(sweep, mount, 2.0)) == 1
    assert (len(got), got.num_rows, got.has_times) == (2, 6, True)


def test_a_sweep_that_says_less_has_neither_times_nor_beams() -> None:
    got = points_of(Sweep(np.ones((2, 3))), LidarMount("top"))
    assert not got.has_times
    assert got.times.tolist() == [0.0, 0.0]
    assert got.beams.tolist() == [-1, -1]
    assert len(points_of(Sweep(np.zeros((0, 3))), LidarMount("top"))) == 0


def test_deskewing_is_the_exponential_of_the_motion() -> None:
    rng = np.random.default_rng(0)
    points, times = rng.normal(0, 20, (50, 3)), rng.uniform(-0.1, 0.1, 50)
    for twist in (rng.normal(0, 3, 6), np.array([9.0, 1, 0, 0, 0, 1e-11]), np.zeros(6)):
        wanted = [SE3.exp(t * twist) @ p[None] for p, t in zip(points, times, strict=True)]
        np.testing.assert_allclose(deskew(points, times, twist), np.concatenate(wanted), atol=1e-9)
