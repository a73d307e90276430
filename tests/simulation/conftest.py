"""Worlds are slow to build: each is built once and never changed."""

import pytest

from odomap.simulation.world import World


@pytest.fixture(scope="session")
def ideal_room() -> World:
    return World.make(kind="room", seed=4, frames=60, noise=0.0, sensors=("stereo", "depth", "imu"))


@pytest.fixture(scope="session")
def noisy_room() -> World:
    return World.make(
        calibration_px=0.0,
        kind="room",
        seed=5,
        frames=6,
        resolution=(160, 100),
        moving_objects=2,
        sensors=("stereo", "depth", "imu", "lidar3d"),
    )


@pytest.fixture(scope="session")
def street() -> World:
    return World.make(
        kind="street", seed=2, frames=30, sensors=("mono", "lidar2d"), resolution=(320, 120)
    )
