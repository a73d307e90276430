"""Worlds for a laser: scans agree with plan and truth, wheels drift, and a seed decides it all."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.errors import ConfigError
from odomap.geometry.lie import se3_inverse
from odomap.simulation.laserworld import LaserSpec, LaserWorld
from odomap.simulation.wheels import WheelNoise, wheel_odometry


def test_scans_show_the_plan() -> None:
    world = LaserWorld(LaserSpec("building", seed=2, frames=400))
    mount = world.rig.lidars[0]
    angles = np.linspace(*mount.angles[:2], mount.angles[2])
    away = []
    for k in (0, 150, 399):
        frame = world.frame(k)
        assert frame.scan is not None
        met = np.isfinite(frame.scan)
        assert met.mean() > 0.95
        rays = np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])[met]
        T = world.truth.Ts_world_body[k] @ mount.T_body_lidar.matrix
        points = (rays * frame.scan[met, None]) @ T[:3, :3].T + T[:3, 3]
        away.append(world.plan.distances(points[:, :2]))
        assert world.plan.distances(world.hits(k)).max() < 1e-9
    # Ranges are off by 1 cm and more with distance; a few beams fall between two surfaces.
    assert np.median(np.concatenate(away)) < 0.01
    assert np.quantile(np.concatenate(away), 0.97) < 0.04


def test_the_body_stays_in_its_plane() -> None:
    world = LaserWorld(LaserSpec("hall", seed=1))
    Ts = world.truth.Ts_world_body
    np.testing.assert_allclose(Ts[:, 2], np.tile([0, 0, 1, 0], (len(Ts), 1)), atol=1e-12)
    assert world.truth.path_length == pytest.approx(0.5 * len(world) / 10, rel=0.05)
    # Rounds close, up to the uneven speed.
    assert np.linalg.norm(Ts[0, :2, 3] - Ts[-1, :2, 3]) < 0.6


def test_ideal_worlds_are_exact() -> None:
    world = LaserWorld(LaserSpec("building", seed=4, frames=50, noise=0.0))
    np.testing.assert_array_equal(world.frame(20).scan, world.exact(20))
    steps = se3_inverse(world.truth.Ts_world_body[0]) @ world.truth.Ts_world_body
    np.testing.assert_allclose(world.odometry, steps, atol=1e-9)


def test_wheels_drift_as_wheels_do() -> None:
    shares, turns = [], []
    for seed in range(12):
        world = LaserWorld(LaserSpec("building", seed=seed))
        true = se3_inverse(world.truth.Ts_world_body[0]) @ world.truth.Ts_world_body
        off = se3_inverse(true[-1]) @ world.odometry[-1]
        shares.append(np.linalg.norm(off[:2, 3]) / world.truth.path_length)
        turns.append(abs(np.degrees(np.arctan2(off[1, 0], off[0, 0]))))
        steps = np.linalg.norm(np.diff(world.odometry[:, :2, 3], axis=0), axis=1)
        assert steps.max() < 0.12
    assert 0.005 < np.median(shares) < 0.15
    assert 2 < np.median(turns) < 40


def test_slips_and_noise_are_those_asked_for() -> None:
    world = LaserWorld(LaserSpec("hall", seed=0))
    truth = world.truth.Ts_world_body
    scaled = WheelNoise(0, 0, 0, 0, 0, 0, 0)
    exact = wheel_odometry(truth, scaled, np.random.default_rng(0))
    np.testing.assert_allclose(exact, se3_inverse(truth[0]) @ truth, atol=1e-9)
    slipping = wheel_odometry(truth, replace(scaled, slips_per_m=1.0), np.random.default_rng(0))
    assert np.abs(slipping - exact).max() > 0.05


def test_corridors_and_fields_are_as_featureless_as_they_should_be() -> None:
    field = LaserWorld(LaserSpec("field", frames=20))
    assert all(np.isinf(field.frame(k).scan).all() for k in range(20))
    corridor = LaserWorld(LaserSpec("corridor", noise=0.0))
    middle = int(np.argmin(np.abs(corridor.truth.positions[:, 0])))
    scans = [corridor.exact(k) for k in (middle - 20, middle)]
    # Ahead and behind nothing returns, and the walls look the same a metre on.
    assert np.isinf(scans[0][270])
    moved = np.linalg.norm(corridor.truth.positions[middle] - corridor.truth.positions[middle - 20])
    assert moved > 0.8
    both = np.isfinite(scans[0]) & np.isfinite(scans[1]) & (scans[0] < 10)
    assert np.abs(scans[0][both] - scans[1][both]).max() < 0.1


def test_people_are_seen_and_walk() -> None:
    empty = LaserWorld(LaserSpec("hall", seed=3, frames=200))
    peopled = LaserWorld(LaserSpec("hall", seed=3, frames=200, moving_objects=4))
    nearer = [peopled.exact(k, people=True) < peopled.exact(k) - 0.05 for k in (0, 100, 199)]
    assert any(0.002 < rows.mean() < 0.5 for rows in nearer)
    assert not np.array_equal(nearer[0], nearer[1])
    np.testing.assert_array_equal(peopled.exact(7), empty.exact(7))


def test_a_seed_decides_it_all() -> None:
    spec = LaserSpec("building", seed=9, frames=30, moving_objects=2)
    one, two = LaserWorld(spec), LaserWorld(spec)
    two.frame(29)
    for k in (0, 17):
        assert one.frame(k).scan.tobytes() == two.frame(k).scan.tobytes()  # type: ignore[union-attr]
    np.testing.assert_array_equal(one.odometry, two.odometry)
    other = LaserWorld(replace(spec, seed=10))
    assert not np.array_equal(one.frame(0).scan, other.frame(0).scan)
    with pytest.raises(IndexError):
        one.frame(30)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"kind": "street"}, "kind: 'street' is none of building, hall"),
        ({"kind": "bulding"}, r"did you mean 'building'\?"),
        ({"sensors": ("laser", "imu")}, "'laser' stands alone"),
        ({"beams": 0}, "beams: 0 must be 1 or more"),
        ({"speed": 0.0}, "speed: 0.0 must be finite and above 0"),
        ({"rounds": float("nan")}, "rounds: nan must be"),
        ({"noise": -1.0}, "noise: -1.0 must be finite and not negative"),
        ({"fov_deg": 400.0}, "fov_deg: 400.0 must be above 0 and at most 360"),
    ],
)
def test_what_cannot_be_is_refused(wrong: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        LaserSpec(**wrong)  # type: ignore[arg-type]
