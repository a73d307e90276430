"""Paths: every derivative is that of the pose."""

import numpy as np
import pytest

from odomap.geometry.lie import so3_log
from odomap.simulation.path import Path, closed_route, hand_held, vehicle
from odomap.simulation.room import R_CARRIER_IMU


def ring(radius: float, count: int = 12) -> np.ndarray:
    angles = np.arange(count) * 2 * np.pi / count
    return np.column_stack([radius * np.cos(angles), radius * np.sin(angles), 1.4 + 0 * angles])


def make(kind: str, seed: int) -> Path:
    rng = np.random.default_rng(seed)
    if kind == "hand":
        return hand_held(ring(2.0), 0.6, rng, R_CARRIER_IMU)
    way = ring(60.0, 60)
    if kind == "hills":
        way[:, 2] += 2.0 * np.sin(np.arange(60) * 2 * np.pi / 15)
    return vehicle(way, 7.5, rng, np.eye(3), climbs=kind == "hills")


@pytest.mark.parametrize("kind", ["hand", "wheels", "hills"])
@pytest.mark.parametrize("seed", [0, 1])
def test_velocity_acceleration_and_rate_are_derivatives(kind: str, seed: int) -> None:
    path = make(kind, seed)
    times, h = np.linspace(0.0, 45.0, 400), 1e-4
    before, here, after = path.at(times - h), path.at(times), path.at(times + h)
    p = [m.Ts_world_body[:, :3, 3] for m in (before, here, after)]
    np.testing.assert_allclose((p[2] - p[0]) / (2 * h), here.v_world_body, atol=2e-6)
    v = (after.v_world_body - before.v_world_body) / (2 * h)
    np.testing.assert_allclose(v, here.a_world_body, atol=2e-5)
    R0, R2 = before.Ts_world_body[:, :3, :3], after.Ts_world_body[:, :3, :3]
    omega = so3_log(np.swapaxes(R0, 1, 2) @ R2) / (2 * h)
    np.testing.assert_allclose(omega, here.omega_body, atol=2e-6)


def test_rotations_are_rotations() -> None:
    R = make("hand", 3).at(np.linspace(-5, 50, 300)).Ts_world_body[:, :3, :3]
    np.testing.assert_allclose(
        R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (300, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-12)


@pytest.mark.parametrize(("kind", "low", "high"), [("hand", 0.2, 1.1), ("wheels", 5.0, 10.0)])
def test_speed_is_that_of_a_walker_or_a_car(kind: str, low: float, high: float) -> None:
    for seed in range(4):
        motion = make(kind, seed).at(np.linspace(0, 60, 2000))
        speed = np.linalg.norm(motion.v_world_body, axis=1)
        assert low < np.percentile(speed, 2)
        assert np.percentile(speed, 98) < high


def test_what_climbs_looks_along_the_road() -> None:
    motion = make("hills", 2).at(np.linspace(0.0, 50.0, 500))
    ahead, speed = motion.Ts_world_body[:, :3, 0], motion.v_world_body
    slopes = [np.arctan2(x[:, 2], np.hypot(x[:, 0], x[:, 1])) for x in (ahead, speed)]
    assert np.ptp(slopes[1]) > 0.2
    assert np.corrcoef(*slopes)[0, 1] > 0.98
    assert np.abs(slopes[0] - slopes[1]).max() < 0.05


def test_the_route_closes_and_comes_back() -> None:
    route = closed_route(ring(2.0))
    for nu in range(4):
        np.testing.assert_allclose(route(0.0, nu), route(1.0 - 1e-13, nu), atol=1e-6)
    path = make("hand", 0)
    round_s = 1.0 / path.rounds_per_s
    p = path.at(np.array([0.0, round_s, 0.5 * round_s])).Ts_world_body[:, :3, 3]
    assert np.linalg.norm(p[1] - p[0]) < 0.8
    assert np.linalg.norm(p[2] - p[0]) > 2.5
