"""Breaks: sides that go past one another end there, and sides that meet make a corner."""

import numpy as np
import pytest

from odomap.lidar.breaks import BEFORE, BEHIND, JOINED, UNKNOWN, find_breaks
from odomap.lidar.featurepicking import EDGE
from odomap.lidar.loam import LoamFrontEnd
from odomap.lidar.sweeps import points_of
from odomap.sensors.rig import LidarMount
from odomap.sensors.sweep import Sweep

HEIGHT = 1.8
"""Of the sensor above the ground, metres."""


def line(*faces, step_deg=1.2, noise=0.0, seed=0, low=-25.0, high=4.0):
    """Return points of a line of beams straight up past upright faces, and what each is on.

    Args:
        faces: of each how far it is, its lowest and its highest z; nearer ones first.
        step_deg: from beam to beam.
        noise: standard deviation of ranges.
        seed: of the noise.
        low: elevation of the first beam, degrees.
        high: of the last.
    """
    rng = np.random.default_rng(seed)
    elevation = np.radians(np.arange(low, high, step_deg)) + 1e-4
    u = np.column_stack([np.cos(elevation), np.zeros(len(elevation)), np.sin(elevation)])
    ranges = np.where(u[:, 2] < 0, -HEIGHT / u[:, 2], np.inf)
    on = np.full(len(u), -1)
    for k, (away, lowest, highest) in enumerate(faces):
        met = away / u[:, 0]
        hit = (met < ranges) & (met * u[:, 2] > lowest) & (met * u[:, 2] < highest)
        ranges[hit], on[hit] = met[hit], k
    kept = ranges < 80.0
    ranges = ranges + noise * rng.standard_normal(len(u))
    return u[kept] * ranges[kept, None], on[kept]


def breaks_of(points, step_deg=1.2):
    """Return what is between points of a line."""
    found = np.empty(len(points), np.uint8)
    ranges = np.linalg.norm(points, axis=1)
    find_breaks(points, ranges, np.radians(step_deg), 0.15, 4.0, 0.02, found)
    return found[:-1]


@pytest.mark.parametrize("backwards", [False, True])
def test_a_car_that_stands_above_the_ground_hides_it_though_neighbours_are_near(backwards):
    points, on = line((8.0, 0.3 - HEIGHT, 2.0))
    points, on = (points[::-1], on[::-1]) if backwards else (points, on)
    found = breaks_of(points)
    border = int(np.flatnonzero(np.diff(on))[0])
    ground, car = np.linalg.norm(points[border : border + 2], axis=1)[:: -1 if backwards else 1]
    assert 0.2 < ground - car < 1.2
    gap = np.linalg.norm(points[border + 1] - points[border])
    along = np.linalg.norm(np.diff(points[on < 0], axis=0), axis=1).max()
    assert gap < along  # farther along the ground than across the step
    assert found[border] == (BEHIND if backwards else BEFORE)
    assert np.all(np.delete(found, border) == JOINED)


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("away", [5.0, 6.5, 8.0])
def test_a_wall_meets_the_ground_however_coarse_the_beams_are(away, noise):
    for seed in range(5 if noise else 1):
        points, on = line((away, -HEIGHT - 1.0, 5.0), noise=noise, seed=seed)
        assert {-1, 0} == set(on.tolist())
        assert np.all(breaks_of(points) == JOINED)


@pytest.mark.parametrize("turn", [0.0, 0.05, 0.1])
def test_the_corner_of_a_house_is_no_break_from_within_or_without(turn):
    azimuth = np.radians(np.arange(-25.0, 25.0, 1.2))
    for sign in (-1.0, 1.0):
        ranges = np.empty(len(azimuth))
        for n, phi in enumerate(azimuth):
            walls = [10.0 / np.cos(phi - turn - side * np.pi / 4) for side in (-1.0, 1.0)]
            walls = [w for w in walls if w > 0]
            ranges[n] = (max if sign > 0 else min)(walls)
        points = ranges[:, None] * np.column_stack(
            [np.cos(azimuth), np.sin(azimuth), np.zeros(len(azimuth))]
        )
        assert np.all(breaks_of(points) == JOINED)


def test_points_astray_and_noise_hardly_ever_part_a_surface():
    rng, parted = np.random.default_rng(3), 0
    for trial in range(30):
        points, _ = line((float(rng.uniform(4, 8)), -HEIGHT - 1.0, 6.0), noise=0.02, seed=trial)
        n = int(rng.integers(4, len(points) - 4))
        r = np.linalg.norm(points[n])
        points[n] *= 1.0 + float(rng.choice([-0.25, 0.25])) / r
        parted += bool(np.any(breaks_of(points) != JOINED))
    assert parted <= 2


def test_what_is_far_behind_breaks_a_line_and_what_nobody_saw_does_too():
    points, on = line((6.0, -HEIGHT - 1.0, 0.0), (30.0, 0.0, 9.0), high=12.0)
    found = breaks_of(points)
    assert found[np.flatnonzero(np.diff(on) == 1)[-1]] == BEHIND
    gone = np.r_[points[:8], points[16:]]
    assert breaks_of(gone)[7] == UNKNOWN


def test_ground_that_a_car_hides_has_no_edge_and_where_a_wall_stands_on_it_there_is_one():
    for faces, edges in ((((8.0, 0.3 - HEIGHT, 2.0),), 0), (((8.0, -HEIGHT - 1.0, 2.0),), 1)):
        lines = [line(*faces, noise=0.005, seed=k) for k in range(6)]
        points = np.vstack([p for p, _ in lines])
        beams = np.repeat(np.arange(6), [len(p) for p, _ in lines]).astype(np.int16)
        on = np.concatenate([o for _, o in lines])
        sweep = points_of(
            Sweep(points, np.arange(len(points)) * 1e-5, None, beams), LidarMount("s")
        )
        is_edge = LoamFrontEnd().prepare(sweep).marks == EDGE
        on_ground = is_edge & (on < 0)
        corner = np.abs(points[:, 0] - 8.0) + np.abs(points[:, 2] + HEIGHT) < 1.0
        assert not np.any(on_ground & ~corner)
        assert np.count_nonzero(is_edge & corner) >= 4 * edges
        assert edges or not np.any(on_ground)
