"""The front-end "points": planes of voxels, sweeps laid onto them, and how sure that is."""

import numpy as np
import pytest

from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.lidar.cloudconfig import PointsConfig
from odomap.lidar.deskew import deskew
from odomap.lidar.planefrontend import PlaneFrontEnd, suitable_voxel
from odomap.lidar.planemap import PlaneMap
from odomap.lidar.sweeps import SweepPoints
from odomap.lidar.voxels import COARSER, first_in_voxels

SIDES = np.array([12.0, 8.0, 3.0])


def room(rng, n=6000, noise=0.01):
    """Return points of the six walls of a room about its middle."""
    which, p = rng.integers(0, 3, n), (rng.random((n, 3)) - 0.5) * SIDES
    p[np.arange(n), which] = np.where(rng.random(n) < 0.5, -0.5, 0.5) * SIDES[which]
    return p + rng.normal(0, noise, (n, 3))


def sweep(points, times=None):
    n = len(points)
    times = np.zeros(n) if times is None else times
    beams, none = np.full(n, -1, np.int16), np.zeros(n, np.float32)
    return SweepPoints(points, times, none, beams, np.arange(n), True, n)


def taken_from(T, points, twist=None, rng=None):
    """Return a sweep of the points from a body at T that moves by a twist, for 0.1 s."""
    seen = (points - T[:3, 3]) @ T[:3, :3]
    if twist is None:
        return sweep(seen)
    times = rng.uniform(-0.05, 0.05, len(points))
    return sweep(deskew(seen, -times, twist), times)  # exp(-ξ t) p, exact for a constant twist


def begun(config=None, seed=0):
    rng = np.random.default_rng(seed)
    front_end = PlaneFrontEnd(config)
    for _ in range(3):
        front_end.insert(front_end.prepare(sweep(room(rng))), np.eye(4), np.zeros(6))
    return front_end, rng


def test_the_first_point_of_each_voxel_is_kept():
    rng = np.random.default_rng(0)
    points = rng.normal(0, 5, (3000, 3))
    rows = first_in_voxels(points, 0.8)
    cells = np.floor(points / 0.8)
    wanted = sorted(np.unique(cells, axis=0, return_index=True)[1].tolist())
    assert rows.tolist() == wanted
    assert first_in_voxels(np.zeros((0, 3)), 1.0).tolist() == []
    far = np.array([[1e9, 0, 0], [1.0, 0, 0]])
    assert first_in_voxels(far, 0.1).tolist() == [1]


def test_sums_of_a_voxel_are_those_of_its_points_on_both_levels():
    rng = np.random.default_rng(1)
    points = rng.uniform(-3, 3, (2000, 3))
    surfaces = PlaneMap(0.5, 0.02)
    surfaces.insert(points)
    count = surfaces.sums[: len(surfaces), 0]
    assert count.sum() == 2 * len(points)
    fine = len(np.unique(np.floor(points / 0.5), axis=0))
    coarse = len(np.unique(np.floor(points / (0.5 * COARSER)), axis=0))
    assert len(surfaces) == fine + coarse
    gone = surfaces.evict(np.array([100.0, 0, 0]), 10.0)
    assert (gone, len(surfaces)) == (fine + coarse, 0)


@pytest.mark.parametrize("seed", range(4))
def test_a_sweep_is_found_where_it_was_taken(seed):
    front_end, rng = begun(seed=seed)
    xi = np.concatenate([rng.normal(0, 0.15, 3), rng.normal(0, 0.04, 3)])
    T = se3_exp(xi)
    match = front_end.match(front_end.prepare(taken_from(T, room(rng))), np.eye(4), np.zeros(6))
    assert match.converged
    assert match.share > 0.7
    off = se3_log(se3_inverse(T) @ match.T_map_body)
    assert np.linalg.norm(off[:3]) < 0.004
    assert np.linalg.norm(off[3:]) < 0.0015
    assert off @ match.information @ off < 30.0


def test_the_motion_over_a_sweep_is_taken_out():
    front_end, rng = begun()
    twist = np.array([6.0, 0.5, 0.0, 0.1, 0.0, 0.8])
    T = se3_exp(np.array([0.1, 0.05, 0.0, 0, 0, 0.03]))
    moving = front_end.prepare(taken_from(T, room(rng), twist, rng))
    with_it = front_end.match(moving, T, twist)
    without = front_end.match(moving, T, np.zeros(6))
    assert np.linalg.norm(se3_log(se3_inverse(T) @ with_it.T_map_body)) < 0.005
    assert with_it.error < 0.5 * without.error


def test_where_it_began_does_not_matter():
    """The map may lie anywhere: the same sweeps, all moved, are found moved, voxels cutting them
    up in other ways."""
    T, apart, errors = se3_exp(np.array([40.0, -7.0, 2.0, 0.3, 0.2, 1.0])), [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        clouds, found = [room(rng) for _ in range(3)], []
        for move in (np.eye(4), T):
            front_end = PlaneFrontEnd(PointsConfig(voxel=0.5))
            for cloud in clouds[:2]:
                front_end.insert(front_end.prepare(sweep(cloud)), move, np.zeros(6))
            guess = move @ se3_exp(np.array([0.05, 0.05, 0.02, 0.01, 0, 0.01]))
            match = front_end.match(front_end.prepare(sweep(clouds[2])), guess, np.zeros(6))
            found.append(se3_inverse(move) @ match.T_map_body)
        apart.append(se3_log(se3_inverse(found[0]) @ found[1]))
        errors += [se3_log(T_found) for T_found in found]
    each = np.mean(np.square(errors), axis=0).sum()
    assert np.sqrt(each) < 0.004
    assert np.mean(np.square(apart), axis=0).sum() < 2.5 * each  # as of two errors that are alike


def test_what_moves_by_itself_does_not_count():
    front_end, rng = begun()
    moved = room(rng, 1200) * 0.3 + np.array([1.5, 0.0, 0.0])  # a fifth of the points
    points = np.concatenate([room(rng), moved])
    match = front_end.match(front_end.prepare(sweep(points)), np.eye(4), np.zeros(6))
    assert np.linalg.norm(se3_log(match.T_map_body)[:3]) < 0.004


def test_along_a_tunnel_nothing_is_known_of_the_way():
    rng = np.random.default_rng(5)

    def tunnel():
        x, a = rng.uniform(-25, 25, 8000), rng.uniform(0, 2 * np.pi, 8000)
        wall = np.column_stack([x, 4.0 * np.cos(a), 3.0 * np.sin(a)])
        return wall + rng.normal(0, 0.01, wall.shape)

    front_end = PlaneFrontEnd()
    front_end.insert(front_end.prepare(sweep(tunnel())), np.eye(4), np.zeros(6))
    match = front_end.match(front_end.prepare(sweep(tunnel())), np.eye(4), np.zeros(6))
    along, across = match.information[0, 0], match.information[1, 1]
    assert along < 2e-3 * across
    assert 1.0 / np.sqrt(across) < 0.01


def test_a_sweep_of_nothing_is_found_nowhere():
    front_end, _ = begun()
    nothing = sweep(np.zeros((0, 3)))
    match = front_end.match(front_end.prepare(nothing), np.eye(4), np.zeros(6))
    assert (match.num_points, match.converged, match.share) == (0, False, 0.0)
    front_end.clear()
    some = sweep(np.ones((4, 3)))
    match = front_end.match(front_end.prepare(some), np.eye(4), np.zeros(6))
    assert match.reason == "no map"


def test_voxels_are_as_large_as_a_place_is_wide():
    config = PointsConfig()
    points = np.eye(3)
    assert suitable_voxel(5.0 * points, config) == pytest.approx(0.5)
    assert suitable_voxel(0.1 * points, config) == config.least_voxel
    assert suitable_voxel(99.0 * points, config) == config.most_voxel


@pytest.mark.parametrize("yaw", [-0.03, 0.02])
def test_before_a_wall_far_ahead_a_turn_is_no_step_to_the_side(yaw):
    rng = np.random.default_rng(3)

    def street_end(n=8000):
        wall = np.column_stack([np.full(n, 30.0), *rng.uniform((-14, 0), (14, 8), (n, 2)).T])
        ground = np.column_stack([*rng.uniform((4, -14), (30, 14), (n, 2)).T, np.zeros(n)])
        return np.concatenate([wall, ground]) + rng.normal(0, 0.01, (2 * n, 3))

    front_end = PlaneFrontEnd(PointsConfig(voxel=0.8))
    front_end.insert(front_end.prepare(sweep(street_end())), np.eye(4), np.zeros(6))
    T = se3_exp(np.array([0, 0, 0, 0, 0, yaw]))
    match = front_end.match(front_end.prepare(taken_from(T, street_end())), np.eye(4), np.zeros(6))
    off = se3_log(se3_inverse(T) @ match.T_map_body)
    assert "degenerate" in match.reason
    assert np.abs(off[:3]).max() < 0.1  # and not 30 m times the turn
    assert np.abs(off[3:]).max() < 0.005


@pytest.mark.parametrize("count", [1, 4, 9])
def test_of_an_error_of_a_sweep_the_map_keeps_as_much_as_it_is_young(count):
    rng = np.random.default_rng(count)
    front_end = PlaneFrontEnd()
    for _ in range(count):
        front_end.insert(front_end.prepare(sweep(room(rng))), np.eye(4), np.zeros(6))
    match = front_end.match(front_end.prepare(sweep(room(rng))), np.eye(4), np.zeros(6))
    assert match.stays is not None
    age = (count + 1) / 2.0  # in the mean, of surfaces that all sweeps saw alike
    assert np.allclose(np.diag(match.stays), 1.0 / age, rtol=0.1)
    # Once the map drifts as sweeps err, so do they: what stays is what each adds to all after it.
    assert np.abs(match.stays - np.eye(6) / age).max() < 0.3


def test_a_motion_that_changes_bends_a_sweep_by_what_is_said():
    rng = np.random.default_rng(5)
    front_end, _ = begun(seed=5)
    points, times = room(rng, 9000), rng.uniform(-0.05, 0.05, 9000)
    change = np.array([0.2, -0.1, 0.3, 0.02, -0.04, 0.03])
    lasts = float(np.ptp(times))
    # As long as it changes by that from sweep to sweep, with nothing known but the sweep before.
    shares = 0.5 * times * (1.0 + times / lasts)
    moved = np.array([deskew(p[None], np.ones(1), -change * s)[0] for p, s in zip(points, shares)])
    match = front_end.match(front_end.prepare(sweep(moved, times)), np.eye(4), np.zeros(6))
    assert match.bends is not None
    found = se3_log(match.T_map_body)
    assert np.linalg.norm(found - match.bends @ change) < 0.25 * np.linalg.norm(found) + 2e-3


@pytest.mark.parametrize("pitch", [-0.01, 0.008])
def test_traces_of_beams_through_leaves_do_not_hold_a_body(pitch):
    """Each beam draws a plane through leaves, which turns with the LiDAR and is no surface."""
    rng = np.random.default_rng(6)

    def leaves(n=500):
        up = np.radians(rng.choice([-1.0, 1.0, 3.0], n))
        away, around = rng.uniform(8, 30, n), rng.uniform(-0.5, 0.5, n)
        flat = np.column_stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around)])
        return away[:, None] * np.column_stack([flat, np.sin(up)])

    front_end, T = PlaneFrontEnd(PointsConfig(voxel=1.0)), se3_exp(np.array([0, 0, 0, 0, pitch, 0]))
    walls = room(rng, 4000)
    first = np.concatenate([walls, leaves()])
    front_end.insert(front_end.prepare(sweep(first)), np.eye(4), np.zeros(6))
    seen = (room(rng, 4000) - T[:3, 3]) @ T[:3, :3]
    match = front_end.match(
        front_end.prepare(sweep(np.concatenate([seen, leaves()]))), np.eye(4), np.zeros(6)
    )
    assert se3_log(match.T_map_body)[4] == pytest.approx(pitch, abs=0.15 * abs(pitch))


def test_between_upright_walls_alone_a_lidar_that_stands_stays_where_it_is():
    rng = np.random.default_rng(0)
    tilt, phi = np.meshgrid(np.radians(np.arange(-15, 16, 2.0)), np.linspace(-np.pi, np.pi, 1500))
    far = 8.0 / np.maximum(np.abs(np.cos(phi)), np.abs(np.sin(phi)))  # a room without a floor
    box = np.stack([far * np.cos(phi), far * np.sin(phi), far * np.tan(tilt)], axis=-1)
    front_end = PlaneFrontEnd()
    for k in range(8):
        ready = front_end.prepare(sweep(box.reshape(-1, 3)[rng.random(box.size // 3) < 0.9]))
        match = front_end.match(ready, np.eye(4), np.zeros(6))
        if k:
            assert match.share > 0.5
            assert "translation" in match.reason  # of height nothing is known
            assert np.linalg.norm(match.T_map_body[:3, 3]) < 0.01
        front_end.insert(ready, np.eye(4), np.zeros(6))
