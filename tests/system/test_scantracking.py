"""Tracking with a laser: accuracy, honesty where scans say little, faults."""

from dataclasses import replace

import numpy as np
import pytest

from laserworlds import RIG, around, frames, in_first
from lidar.rooms import CORRIDOR
from odomap.errors import CalibrationError, ConfigError
from odomap.geometry.planar import IN_PLANE, to_plane
from odomap.maps.estimate import Status
from odomap.sensors.rig import Rig
from odomap.system.config import preset
from odomap.system.laserslam import LaserSlam
from odomap.system.slam import Slam
from odomap.system.submaps import SUBMAP


def played(made, system=None):
    system = Slam(RIG) if system is None else system
    return system, [system.track(frame) for frame in made]


def off(estimates, path):
    found = np.array([to_plane(e.T_world_body.matrix) for e in estimates])
    return np.linalg.norm(found[:, :2] - in_first(path)[: len(found), :2], axis=1)


def test_a_rig_with_a_laser_alone_is_tracked_by_it():
    system = Slam(RIG)
    assert isinstance(system, LaserSlam)
    with pytest.raises(CalibrationError, match="no 2D laser"):
        Slam(Rig(), preset("lidar2d"))
    with pytest.raises(ConfigError, match="knows no words"):
        Slam(RIG, vocabulary=object())


@pytest.mark.parametrize("odometry", [True, False])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_round_of_a_room_ends_where_it_began(seed, odometry):
    path = around(150)
    system, estimates = played(frames(path, seed, odometry=odometry))
    assert all(e.status == Status.TRACKING for e in estimates)
    assert off(estimates, path).max() < 0.05
    result = system.finish()
    assert len(result.trajectory) == 150
    assert result.is_metric
    assert (np.diff(result.trajectory.stamps_ns) > 0).all()
    assert 20 < result.map.num_keyframes < 90
    assert set(result.map.edges().kind) >= {SUBMAP}
    assert result.map.keyframe(0).scan is not None


@pytest.mark.parametrize("late", [4, 8])
def test_odometry_of_another_instant_is_noticed(late):
    # Standing, as odometry has it, while the body sets off, and then too fast.
    path = around(100)
    made = frames(path, seed=late)
    wheels = [frame.odometry for frame in made]
    wheels[30 : 30 + late] = [wheels[30]] * late
    _, estimates = played([replace(f, odometry=w) for f, w in zip(made, wheels, strict=True)])
    assert off(estimates, path).max() < 0.05


def test_along_a_corridor_the_covariance_grows_and_holds_the_error():
    path = np.column_stack([np.linspace(0, 10, 101), np.zeros(101), np.zeros(101)])
    _, estimates = played(frames(path, walls=CORRIDOR))
    sigma = np.sqrt(estimates[-1].covariance[[0, 1], [0, 1]])
    assert sigma[0] > 5 * sigma[1]
    error = to_plane(estimates[-1].T_world_body.matrix) - in_first(path)[-1]
    assert abs(error[0]) < 4 * sigma[0]
    assert abs(error[1]) < 0.1


@pytest.mark.parametrize(
    ("scan", "words"),
    [
        (np.full(271, np.nan), "0 of 271 beams came back"),
        (np.full(271, np.inf), "0 of 271 beams came back"),
        (np.zeros(271), "0 of 271 beams came back"),
        (None, "no scan"),
    ],
)
def test_scans_that_say_nothing_are_passed_over_by_odometry(scan, words):
    path = around(60)
    made = frames(path)
    for n in range(30, 35):
        made[n] = replace(made[n], scan=scan)
    system, estimates = played(made)
    assert all(words in e.reason and "odometry alone" in e.reason for e in estimates[30:35])
    assert all(e.status == Status.TRACKING for e in estimates)
    assert not any(e.is_keyframe for e in estimates[30:35])
    assert np.trace(estimates[34].covariance) > np.trace(estimates[29].covariance)
    assert off(estimates, path).max() < 0.06
    assert len(system.finish().trajectory) == 60


def test_without_odometry_a_body_that_sees_nothing_is_lost_and_found_again():
    path = around(60)
    made = frames(path, odometry=False)
    for n in range(30, 34):
        made[n] = replace(made[n], scan=np.full(271, np.nan))
    _, estimates = played(made)
    assert [e.status for e in estimates[30:34]] == [Status.LOST] * 4
    assert estimates[34].status == Status.RECOVERED
    assert all(e.status == Status.TRACKING for e in estimates[35:])
    found = to_plane(estimates[-1].T_world_body.matrix)
    assert np.linalg.norm(found[:2] - in_first(path)[-1, :2]) < 0.06


def test_a_run_that_begins_blind_begins_with_the_first_scan_that_shows_something():
    path = around(40)
    made = frames(path)
    made[0] = replace(made[0], scan=np.full(271, np.nan))
    _, estimates = played(made)
    assert estimates[0].status == Status.INITIALIZING
    assert "0 of 271 beams" in estimates[0].reason
    assert estimates[1].is_keyframe
    assert estimates[-1].status == Status.TRACKING


def test_stamps_that_go_back_and_scans_that_come_twice_do_no_harm():
    path = around(60)
    made = frames(path)
    made[20] = replace(made[20], stamp_ns=made[20].stamp_ns - 250_000_000)
    made[40] = replace(made[39], id=40, stamp_ns=made[40].stamp_ns)
    system, estimates = played(made)
    assert all(e.status == Status.TRACKING for e in estimates)
    found = to_plane(estimates[-1].T_world_body.matrix)
    assert np.linalg.norm(found[:2] - in_first(path)[-1, :2]) < 0.06
    trajectory = system.finish().trajectory
    assert (np.diff(trajectory.stamps_ns) > 0).all()
    assert len(trajectory) == 60


def test_a_strange_place_does_not_become_part_of_the_submap():
    path = around(60)
    made = frames(path)
    for n in range(30, 33):
        made[n] = replace(made[n], scan=np.full(271, 0.5 + 1e-3 * n))  # a box around the robot
    system, estimates = played(made)
    assert all("meet walls that are known" in e.reason for e in estimates[30:33])
    assert off(estimates, path).max() < 0.06
    assert system.finish().map.num_keyframes > 5


def test_errors_are_as_large_as_covariances_say():
    chi2 = []
    for seed in range(4):
        path = around(80)
        _, estimates = played(frames(path, seed))
        for e, x in zip(estimates[10:], in_first(path)[10:]):
            found = to_plane(e.T_world_body.matrix)
            c, s = np.cos(found[2]), np.sin(found[2])
            d = x - found
            d = np.array([c * d[0] + s * d[1], -s * d[0] + c * d[1], d[2]])
            d[2] = (d[2] + np.pi) % (2 * np.pi) - np.pi
            chi2.append(d @ np.linalg.solve(e.covariance[np.ix_(IN_PLANE, IN_PLANE)], d) / 3)
    assert 0.05 < np.mean(chi2) < 3.0
