"""IMU: integrates back to the path, and is as noisy as it says."""

import numpy as np
import pytest

from odomap.geometry.lie import so3_exp
from odomap.sensors.rig import ImuMount
from odomap.simulation.imu import GRAVITY, imu_samples
from odomap.simulation.path import Harmonics, Path, closed_route
from odomap.simulation.world import World

EXACT = {"gyro_noise": 1e-12, "gyro_walk": 1e-14, "accel_noise": 1e-12, "accel_walk": 1e-13}


def ticks(rate_hz: float, seconds: float) -> np.ndarray:
    return np.rint(np.arange(int(rate_hz * seconds) + 1) * 1e9 / rate_hz).astype(np.int64)


def still_path() -> Path:
    angles = np.arange(8) * np.pi / 4
    ring = np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])
    zero = [Harmonics(np.zeros((d, 1)), np.ones((d, 1)), np.zeros((d, 1))) for d in (1, 3, 3)]
    return Path(closed_route(ring), 0.0, zero[0], zero[1], zero[2])


def test_at_rest_it_feels_the_floor() -> None:
    samples = imu_samples(still_path(), ticks(200, 1), ImuMount(200.0, **EXACT), 0, 0)
    np.testing.assert_allclose(samples.accel, np.tile([0, 0, 9.81], (201, 1)), atol=1e-9)
    np.testing.assert_allclose(samples.gyro, 0.0, atol=1e-9)


@pytest.mark.parametrize("kind", ["room", "street"])
def test_it_integrates_back_to_the_path(kind: str, request: pytest.FixtureRequest) -> None:
    world: World = request.getfixturevalue("ideal_room" if kind == "room" else "street")
    rate, seconds = 1000.0, 4.0
    samples = imu_samples(world.path, ticks(rate, seconds), ImuMount(rate, **EXACT), 0, 0)
    truth = world.path.at(samples.stamps_ns * 1e-9)
    R, p, v = (x[0].copy() for x in (
        truth.Ts_world_body[:, :3, :3], truth.Ts_world_body[:, :3, 3], truth.v_world_body,
    ))  # fmt: skip
    h = 1 / rate
    for k in range(len(samples) - 1):
        turned = R @ so3_exp((samples.gyro[k] + samples.gyro[k + 1]) / 2 * h)
        a0, a1 = R @ samples.accel[k] + GRAVITY, turned @ samples.accel[k + 1] + GRAVITY
        p = p + v * h + (2 * a0 + a1) * h * h / 6
        v = v + (a0 + a1) * h / 2
        R = turned
    assert np.linalg.norm(p - truth.Ts_world_body[-1, :3, 3]) < 1e-4
    assert np.linalg.norm(v - truth.v_world_body[-1]) < 1e-4
    assert np.abs(R.T @ truth.Ts_world_body[-1, :3, :3] - np.eye(3)).max() < 1e-5


def test_noise_has_the_densities_of_the_mount() -> None:
    mount = ImuMount(200.0, gyro_noise=2e-3, gyro_walk=1e-9, accel_noise=4e-2, accel_walk=1e-9)
    samples = imu_samples(still_path(), ticks(200, 60), mount, 3, 0)
    rate = np.sqrt(200.0)
    np.testing.assert_allclose(samples.gyro.std(0), 2e-3 * rate, rtol=0.03)
    np.testing.assert_allclose(samples.accel.std(0), 4e-2 * rate, rtol=0.03)
    walker = ImuMount(200.0, gyro_noise=1e-12, gyro_walk=1e-3, accel_noise=1e-12, accel_walk=2e-2)
    walks = [imu_samples(still_path(), ticks(200, 20), walker, s, 0) for s in range(60)]
    ends = np.array([[w.gyro[-1] - w.gyro[0], w.accel[-1] - w.accel[0]] for w in walks])
    spread = np.sqrt((ends**2).mean((0, 2)))
    np.testing.assert_allclose(spread, np.array([1e-3, 2e-2]) * np.sqrt(20), rtol=0.2)
