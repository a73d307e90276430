"""LOAM's and LeGO-LOAM's front-ends: motion found, honest where it is not, bounded, and exact."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from odomap.errors import ConfigError, InputError
from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.lidar.featureconfig import CurvatureConfig, FeatureMapConfig, GroundConfig, LoamConfig
from odomap.lidar.featuremap import AXIS, MEAN, SPREAD, VoxelShapes
from odomap.lidar.lego import LegoFrontEnd
from odomap.lidar.loam import LoamFrontEnd
from odomap.lidar.sweeps import points_of
from odomap.sensors.rig import LidarMount
from odomap.sensors.sweep import Sweep
from odomap.simulation.sweepworld import SweepSpec, SweepWorld

FRONT_ENDS = (LoamFrontEnd, LegoFrontEnd)


@cache
def drive(kind, seed=1, beams=16, frames=16, rate_hz=10.0):
    """Return sweeps about their middles, true poses there, and the time between them."""
    spec = SweepSpec(kind=kind, seed=seed, frames=frames, beams=beams, rate_hz=rate_hz)
    world, dt = SweepWorld(spec), 1.0 / rate_hz
    sweeps = [points_of(world.frame(k).cloud, world.rig.lidars[0]) for k in range(frames)]
    middle = [replace(s, times=s.times - 0.5 * dt) for s in sweeps]
    return middle, world.path.at((np.arange(frames) + 0.5) * dt).Ts_world_body, dt


def follow(front_end, sweeps, dt, twist=None):
    """Return poses and matches, each sweep matched from where the last motion would lead."""
    T, twist = np.eye(4), np.zeros(6) if twist is None else twist
    front_end.insert(front_end.prepare(sweeps[0]), T, twist)
    poses, matches = [T], []
    for sweep in sweeps[1:]:
        prepared, before, guess = front_end.prepare(sweep), T, T @ se3_exp(twist * dt)
        for _ in range(2):
            match = front_end.match(prepared, guess, twist)
            T = guess = match.T_map_body
            twist = se3_log(se3_inverse(before) @ T) / dt
        front_end.insert(prepared, T, twist)
        poses.append(T)
        matches.append(match)
    return np.array(poses), matches


def true_twist(Ts, dt):
    return se3_log(se3_inverse(Ts[0]) @ Ts[1]) / dt


def nothing():
    return points_of(Sweep(np.zeros((0, 3))), LidarMount("top"))


@pytest.mark.parametrize("make", FRONT_ENDS)
@pytest.mark.parametrize(("kind", "seed", "beams"), [("street", 1, 32), ("street", 3, 16)])
def test_a_drive_is_followed_from_a_standing_guess(make, kind, seed, beams):
    sweeps, Ts, dt = drive(kind, seed, beams)
    found, matches = follow(make(), sweeps, dt)
    length = np.linalg.norm(np.diff(Ts[:, :3, 3], axis=0), axis=1).sum()
    off = [se3_log(se3_inverse(se3_inverse(Ts[0]) @ T) @ F) for T, F in zip(Ts, found, strict=True)]
    assert length > 5.0
    assert np.linalg.norm(np.array(off)[:, :3], axis=1).max() < 0.015 * length
    assert np.linalg.norm(np.array(off)[:, 3:], axis=1).max() < 0.025
    assert all(m.share > 0.6 and not m.reason for m in matches)
    assert np.mean([m.converged for m in matches]) > 0.8


@pytest.mark.parametrize("make", FRONT_ENDS)
def test_a_walk_through_a_room_is_followed(make):
    sweeps, Ts, dt = drive("room", 2, 16)
    found, _ = follow(make(), sweeps, dt)
    last = se3_log(se3_inverse(se3_inverse(Ts[0]) @ Ts[-1]) @ found[-1])
    assert np.linalg.norm(last[:3]) < 0.05
    assert np.linalg.norm(last[3:]) < 0.02


@pytest.mark.parametrize("make", FRONT_ENDS)
def test_what_is_said_of_the_error_is_about_what_it_is(make):
    ratios = []
    for seed in (1, 2, 3):
        sweeps, Ts, dt = drive("street", seed, 32, frames=12)
        front_end, first = make(), true_twist(Ts, dt)
        front_end.insert(front_end.prepare(sweeps[0]), Ts[0], first)
        for k in range(1, len(Ts)):
            twist = se3_log(se3_inverse(Ts[k - 1]) @ Ts[k]) / dt
            prepared = front_end.prepare(sweeps[k])
            match = front_end.match(prepared, Ts[k], twist)
            error = se3_log(se3_inverse(Ts[k]) @ match.T_map_body)
            ratios.append(error @ match.information @ error / 6.0)
            front_end.insert(prepared, Ts[k], twist)
    assert 0.2 < np.mean(ratios) < 3.0


@pytest.mark.parametrize("make", FRONT_ENDS)
@pytest.mark.parametrize("kind", ["tunnel", "field"])
def test_what_nothing_fixes_is_said_and_left_as_guessed(make, kind):
    sweeps, Ts, dt = drive(kind, 1, 32, frames=8)
    front_end, twist = make(), true_twist(Ts, dt)
    for k in range(7):
        front_end.insert(front_end.prepare(sweeps[k]), Ts[k], twist)
    guess = Ts[7] @ se3_exp([0.3, 0.0, 0.02, 0.0, 0.002, 0.0])
    match = front_end.match(front_end.prepare(sweeps[7]), guess, twist)
    assert match.reason.startswith("degenerate: the clouds do not fix")
    assert "translation along" in match.reason
    sure = np.linalg.eigvalsh(match.information)
    assert sure[0] < 1e-3 * sure[-1]
    assert match.information[0, 0] < 1e4  # a centimetre along the way would be 1e4
    off = se3_log(se3_inverse(Ts[7]) @ match.T_map_body)
    assert 0.15 < off[0] < 0.45  # where nothing was seen of it the guess stays
    assert abs(off[2]) < 0.01  # the ground is seen
    assert abs(off[4]) < 0.001


@pytest.mark.parametrize("make", FRONT_ENDS)
def test_an_empty_sweep_and_an_empty_map_say_so(make):
    sweeps, Ts, dt = drive("street", 1, 16)
    front_end = make()
    prepared = front_end.prepare(sweeps[0])
    match = front_end.match(prepared, np.eye(4), np.zeros(6))
    assert not match.converged
    assert "seen before" in match.reason
    np.testing.assert_array_equal(match.information, 0.0)
    empty = front_end.prepare(nothing())
    front_end.insert(empty, np.eye(4), np.zeros(6))  # a first sweep of nothing does no harm
    front_end.insert(prepared, np.eye(4), true_twist(Ts, dt))
    match = front_end.match(empty, np.eye(4), np.zeros(6))
    assert match.num_inliers == 0
    assert match.reason
    np.testing.assert_array_equal(match.T_map_body, np.eye(4))
    again = front_end.match(prepared, np.eye(4), true_twist(Ts, dt))
    assert again.converged


@pytest.mark.parametrize("make", FRONT_ENDS)
def test_a_match_does_not_depend_on_where_the_map_begins(make):
    sweeps, Ts, dt = drive("street", 2, 16, frames=5)
    c, s = np.cos(0.7), np.sin(0.7)
    elsewhere = np.array([[c, -s, 0, 900.0], [s, c, 0, -70.0], [0, 0, 1, 8.0], [0, 0, 0, 1.0]])
    ends, twist = [], true_twist(Ts, dt)
    for T_new in (np.eye(4), elsewhere):
        front_end = make()
        for k in range(4):
            front_end.insert(front_end.prepare(sweeps[k]), T_new @ Ts[k], twist)
        match = front_end.match(front_end.prepare(sweeps[4]), T_new @ Ts[4], twist)
        ends.append(se3_log(se3_inverse(T_new @ Ts[4]) @ match.T_map_body))
    # Voxels are cut elsewhere.
    np.testing.assert_allclose(ends[0][:3], ends[1][:3], atol=0.02)
    np.testing.assert_allclose(ends[0][3:], ends[1][3:], atol=0.002)


@pytest.mark.parametrize("make", FRONT_ENDS)
def test_the_same_sweeps_give_the_same_bytes(make):
    sweeps, _, dt = drive("street", 2, 16, frames=5)
    first, second = (follow(make(), sweeps, dt)[0].tobytes() for _ in range(2))
    assert first == second
    front_end = make()
    follow(front_end, sweeps, dt)
    front_end.clear()
    assert follow(front_end, sweeps, dt)[0].tobytes() == first


@pytest.mark.parametrize("make", FRONT_ENDS)
def test_a_sweep_is_laid_onto_points_of_another_map(make):
    sweeps, Ts, dt = drive("street", 1, 32, frames=6)
    front_end, twist = make(), true_twist(Ts, dt)
    for k in range(5):
        front_end.seed(sweeps[k].points[::3] @ Ts[k][:3, :3].T + Ts[k][:3, 3])
    match = front_end.match(front_end.prepare(sweeps[5]), Ts[5] @ se3_exp([0.2] + 5 * [0]), twist)
    off = se3_log(se3_inverse(Ts[5]) @ match.T_map_body)
    assert match.share > 0.5
    assert np.linalg.norm(off[:3]) < 0.15  # its sweeps were not deskewed
    assert np.linalg.norm(off[3:]) < 0.01


def test_what_is_far_is_forgotten():
    config = LoamConfig(map=FeatureMapConfig(radius=40.0))
    sweeps, Ts, dt = drive("street", 1, 16, frames=3)
    front_end = LoamFrontEnd(config)
    prepared, sizes = front_end.prepare(sweeps[0]), []
    for k in range(12):
        T = Ts[0].copy()
        T[0, 3] += 30.0 * k
        front_end.insert(prepared, T, true_twist(Ts, dt))
        sizes.append(len(front_end._map.planes))
    assert max(sizes[6:]) < 1.3 * max(sizes[2:6])


def test_a_plane_and_an_edge_are_fitted_and_a_bush_is_neither():
    rng = np.random.default_rng(4)
    wall = np.column_stack([rng.uniform(0.1, 0.9, (300, 2)), 0.5 + 0.005 * rng.normal(size=300)])
    pole = np.column_stack([5.5 + 0.01 * rng.normal(size=(90, 2)), rng.uniform(0.1, 0.9, 90)])
    bush = rng.uniform(9.1, 9.9, (300, 3))
    planes, edges = VoxelShapes(1.0, False, 0.1, 1000), VoxelShapes(1.0, True, 0.1, 1000)
    for shapes in (planes, edges):
        for points in (wall, pole, bush):
            shapes.insert(points)
        assert shapes.num_shapes == 1
        assert len(shapes) == 3
    plane, edge = planes.shapes[0], edges.shapes[1]
    assert abs(plane[AXIS + 2]) > 0.999
    assert abs(edge[AXIS + 2]) > 0.999
    np.testing.assert_allclose(plane[MEAN : MEAN + 3], wall.mean(axis=0))
    np.testing.assert_allclose(plane[SPREAD + 1], np.linalg.eigvalsh(np.cov(wall.T, bias=True))[0])
    with pytest.raises(InputError, match="too far"):
        planes.insert(np.full((1, 3), 1e9))


@pytest.mark.parametrize(
    "make",
    [
        lambda: CurvatureConfig(baseline=0.0), lambda: CurvatureConfig(sharp=1.5),
        lambda: FeatureMapConfig(radius=-1.0), lambda: CurvatureConfig(fewest=0),
        lambda: GroundConfig(slope=float("nan")),
    ],
)  # fmt: skip
def test_settings_that_cannot_be_are_refused(make):
    with pytest.raises(ConfigError):
        make()
