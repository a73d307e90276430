"""LiDAR: exact without noise, honest with it, and every point at its own time."""

import numpy as np
import pytest

from odomap.sensors.rig import LidarMount
from odomap.simulation.lidar import LidarNoise, scan, sweep
from odomap.simulation.world import World

FAN = LidarMount("laser", range_m=(0.05, 30.0), angles=(-2.0, 2.0, 721))
TOP = LidarMount("top", range_m=(0.4, 60.0), rate_hz=10.0, sweep="clockwise")


def fan(world: World, noise: LidarNoise, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return scan(world.scene, world.path, FAN, 1.0, noise, rng)


def distance_to_surfaces(world: World, points: np.ndarray) -> np.ndarray:
    """Return the distance of each point (N, 3) to the nearest rectangle."""
    f, faces = world.scene.rectangles.frames, world.scene.rectangles.faces
    apart = points[:, None] - f[None, :, :3]
    out = apart.copy()
    for axis, part in ((0, f[:, 3:6]), (1, f[:, 6:9])):
        along = np.clip((apart * part).sum(-1), 0, faces[:, axis])
        out -= along[..., None] * part
    return np.linalg.norm(out, axis=2).min(1)


def test_ranges_end_on_surfaces(ideal_room: World) -> None:
    ranges = fan(ideal_room, LidarNoise.none())
    assert np.isfinite(ranges).all()
    angles = np.linspace(-2, 2, 721)
    local = np.column_stack([np.cos(angles), np.sin(angles), 0 * angles]) * ranges[:, None]
    T = ideal_room.path.at(np.array([1.0])).Ts_world_body[0]
    points = local @ T[:3, :3].T + T[:3, 3]
    assert distance_to_surfaces(ideal_room, points).max() < 1e-9


def test_noise_grows_with_range_and_has_no_bias(ideal_room: World) -> None:
    exact = fan(ideal_room, LidarNoise.none())
    noise = LidarNoise(range_m=0.02, dropout=0.05, mixed=0.0, divergence=0.0)
    measured = np.array([fan(ideal_room, noise, seed) for seed in range(60)])
    error = (measured - exact) / (0.02 * (1 + exact / 50))
    kept = np.isfinite(error)
    assert abs(np.mean(error[kept])) < 0.03
    assert np.std(error[kept]) == pytest.approx(1.0, abs=0.02)
    assert 1 - kept.mean() == pytest.approx(0.05, abs=0.02)
    assert np.isnan(measured[~kept]).all()


def test_edges_mix_two_ranges(ideal_room: World) -> None:
    exact = fan(ideal_room, LidarNoise.none())
    mixed = np.array([fan(ideal_room, LidarNoise(0.0, 0.0, 1.0, 0.004), s) for s in range(20)])
    odd = np.abs(mixed - exact).max(0) > 0.15
    jump = np.abs(np.diff(exact)) > 0.1
    near_jump = np.convolve(np.r_[jump, False] | np.r_[False, jump], np.ones(9), "same") > 0
    assert odd.any()
    assert near_jump[odd].mean() > 0.95


def test_nothing_returns_from_the_sky(street: World) -> None:
    up = LidarMount("top", range_m=(0.4, 40.0), rate_hz=10.0, sweep="clockwise")
    rng = np.random.default_rng(0)
    points = sweep(
        street.scene, street.path, up, 0.0, LidarNoise(), rng, elevations_deg=(5.0, 60.0)
    )
    assert 0 < len(points) < 0.7 * 32 * 900
    first = street.frame(0).scan
    assert first is not None
    assert np.isinf(first).any()


@pytest.mark.parametrize("turn", ["clockwise", "counter_clockwise"])
def test_each_point_of_a_sweep_is_measured_at_its_own_time(ideal_room: World, turn: str) -> None:
    mount = LidarMount("top", range_m=(0.4, 60.0), rate_hz=10.0, sweep=turn)
    cloud = sweep(
        ideal_room.scene, ideal_room.path, mount, 2.0, LidarNoise.none(), np.random.default_rng(0),
        rings=4, columns=200,
    )  # fmt: skip
    assert 0.0 <= cloud.times.min() < 0.002
    assert 0.09 < cloud.times.max() < 0.1
    azimuth = np.unwrap(np.arctan2(cloud.points[::4, 1], cloud.points[::4, 0]))
    assert np.sign(azimuth[-1] - azimuth[0]) == (-1 if turn == "clockwise" else 1)
    Ts = ideal_room.path.at(2.0 + cloud.times).Ts_world_body
    points = np.einsum("nij,nj->ni", Ts[:, :3, :3], cloud.points) + Ts[:, :3, 3]
    assert distance_to_surfaces(ideal_room, points).max() < 1e-9
    frozen = cloud.points @ Ts[0, :3, :3].T + Ts[0, :3, 3]
    assert distance_to_surfaces(ideal_room, frozen).max() > 0.005
