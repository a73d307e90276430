"""The cloud of a map for the eye: a little of each keyframe, hung from it."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from odomap.geometry.lie import se3_exp
from odomap.geometry.pose import SE3
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.sensors.rig import LidarMount
from odomap.sensors.sweep import Sweep
from odomap.views.livecloud import (
    AT_ONCE,
    FEWEST,
    HIGH,
    LOW,
    MOST,
    CloudSample,
    ScanReturns,
    SweepReturns,
    shades,
)
from odomap.views.livemap import sketch

MOUNT = LidarMount("top", SE3(se3_exp(np.array([0.3, -0.1, 1.8, 0.1, -0.2, 0.7]))), (0.5, 80.0))


def pose(seed):
    return se3_exp(np.random.default_rng(seed).normal(size=6))


def cloud(seed, count):
    rng = np.random.default_rng([seed, 5])
    return rng.uniform(-20, 20, (count, 4)).astype(np.float32)


def make_map(keyframes=4, count=500):
    map = Map()
    for k in range(keyframes):
        map.add_keyframe(Keyframe(map.new_keyframe_id(), 100 * k, cloud=cloud(k, count)), pose(k))
    return map


def sample_of(**limits):
    return CloudSample(SweepReturns(MOUNT), MOUNT.T_body_lidar.matrix, **limits)


def expected(map, k):
    T = map.T_world_body(k) @ MOUNT.T_body_lidar.matrix
    return map.keyframe(k).cloud[:, :3] @ T[:3, :3].T + T[:3, 3]


def is_among(points, others):
    """Say of each of the points (N, 3) whether it is one of others."""
    return cKDTree(others).query(points)[0] < 1e-5


def rows_by_keyframe(map, shown):
    return [is_among(shown.points, expected(map, k)).sum() for k in map.keyframe_ids.tolist()]


def test_a_small_map_is_shown_whole_where_its_keyframes_are():
    map = make_map()
    shown = sketch(map, sample_of()).shown
    assert len(shown.points) == shown.count == 2000
    assert rows_by_keyframe(map, shown) == [500] * 4
    assert is_among(shown.points[shown.is_seen], expected(map, 3)).all()
    assert shown.is_seen.sum() == 500


def test_points_move_with_their_keyframes():
    map, sample = make_map(), sample_of()
    before = sketch(map, sample).shown.points
    snapshot = map.snapshot([0, 1, 2, 3], landmarks=False)
    moved = np.array([pose(30 + k) for k in range(4)])
    map.apply(snapshot.solved(moved, np.zeros((0, 3))))
    shown = sketch(map, sample).shown
    assert np.abs(shown.points - before).max() > 1.0
    assert rows_by_keyframe(map, shown) == [500] * 4


def test_what_is_shown_is_limited_spread_evenly_and_steady():
    map, sample, before = Map(), sample_of(limit=1000), None
    for k in range(60):
        map.add_keyframe(Keyframe(map.new_keyframe_id(), k, cloud=cloud(k, 600)), np.eye(4))
        shown = sketch(map, sample).shown
        assert shown.count == 600 * (k + 1)
        assert shown.is_seen.sum() == 600  # the newest shows all of them
        old = shown.points[~shown.is_seen]
        assert len(old) <= 1000
        if k > 3:
            assert len(old) > 400
            each = np.diff(np.flatnonzero(np.r_[True, np.abs(np.diff(old[:, 0])) > 0, True]))
            assert each.max() <= 600
        if before is not None:  # none is new but those of the keyframe that was the newest
            assert is_among(old, before).all()
        before = shown.points
    counts = rows_by_keyframe(map, shown)[:-1]
    assert set(counts) == {16}


def test_where_there_are_very_many_keyframes_some_show_none():
    map, sample = make_map(100, 20), sample_of(limit=200, is_hasty=True)
    shown = sketch(map, sample).shown
    counts = np.array(rows_by_keyframe(map, shown))
    assert shown.count == 2000
    assert set(counts[:-1]) == {0, FEWEST}
    showing = np.flatnonzero(counts[:-1])
    assert len(set(np.diff(showing))) == 1  # as dense everywhere
    assert counts[-1] == 20
    assert counts[:-1].sum() <= 200


class Watchful(Map):
    """A map that notes how many keyframes it is asked for."""

    asked = 0

    def keyframe(self, keyframe_id):
        self.asked += 1
        return super().keyframe(keyframe_id)


def test_a_large_map_is_read_bit_by_bit_the_newest_first_and_once():
    map = Watchful()
    for k in range(AT_ONCE + 30):
        map.add_keyframe(Keyframe(map.new_keyframe_id(), k, cloud=cloud(k, 10)), pose(k))
    sample = sample_of()
    shown = sketch(map, sample).shown
    assert (map.asked, sample.is_whole, len(shown.points)) == (AT_ONCE, False, 10 * AT_ONCE)
    assert shown.is_seen.sum() == 10
    shown = sketch(map, sample).shown
    assert (map.asked, sample.is_whole, shown.count) == (AT_ONCE + 30, True, 10 * AT_ONCE + 300)
    sketch(map, sample)
    assert map.asked == AT_ONCE + 30


def test_who_is_hasty_reads_all_of_it_at_once_and_holds_no_more_than_is_shown():
    map = make_map(AT_ONCE + 30, 100)
    sample = sample_of(limit=1000, most=100, is_hasty=True)
    assert sketch(map, sample).shown.count == 100 * (AT_ONCE + 30)
    assert sample.is_whole
    assert sum(len(kept.points) for kept in sample._kept.values()) <= 1100
    assert all(kept.points.base is None for kept in sample._kept.values())


def test_the_newest_keyframe_is_bounded_too():
    map = make_map(1, 3 * MOST)
    shown = sketch(map, sample_of()).shown
    assert len(shown.points) == MOST
    assert shown.count == 3 * MOST


def test_keyframes_that_go_take_their_points_along_and_some_have_none():
    map, sample = make_map(), sample_of()
    map.add_keyframe(Keyframe(map.new_keyframe_id(), 999), pose(9))
    shown = sketch(map, sample).shown
    assert len(shown.points) == 2000
    assert not shown.is_seen.any()
    map.cull_keyframes([1])
    shown = sketch(map, sample).shown
    assert len(shown.points) == shown.count == 1500
    assert is_among(shown.points, np.concatenate([expected(map, k) for k in (0, 2, 3)])).all()


def test_an_empty_map_shows_nothing():
    shown = sketch(Map(), sample_of()).shown
    assert shown.points.shape == shown.colours.shape == (0, 3)
    assert shown.count == 0


def test_reading_changes_nothing():
    map = make_map()
    clouds = [map.keyframe(k).cloud.copy() for k in range(4)]
    before = map.dump()
    sketch(map, sample_of(limit=100))
    after = map.dump()
    for name, column in before.columns.items():
        np.testing.assert_array_equal(after.columns[name], column)
    assert before.version == after.version
    assert all(np.array_equal(map.keyframe(k).cloud, clouds[k]) for k in range(4))


def test_walls_are_brighter_than_the_ground_however_the_lidar_is_mounted():
    rng = np.random.default_rng(1)
    ground = np.c_[rng.uniform(-30, 30, (3000, 2)), rng.normal(0, 0.02, 3000)]
    wall = np.c_[rng.uniform(-30, 30, 800), np.full(800, 12.0), rng.uniform(2, 7, 800)]
    T = se3_exp(np.array([3.0, 4.0, 0.0, 0.0, 0.0, 1.0]))
    seen = np.linalg.inv(T @ MOUNT.T_body_lidar.matrix)
    points = np.r_[ground, wall] @ seen[:3, :3].T + seen[:3, 3]
    map = Map()
    map.add_keyframe(Keyframe(0, 0, cloud=points.astype(np.float32)), T)
    shown = sketch(map, sample_of()).shown
    is_wall = shown.points[:, 2] > 1.0
    bright = shown.colours.astype(int).sum(axis=1)
    assert bright[is_wall].min() > bright[~is_wall].max()


def test_shades_go_from_low_to_high():
    found = shades(np.array([-5.0, 0.0, 3.0, 6.0, 90.0]))
    assert found[0].tolist() == found[1].tolist() == list(LOW)
    assert found[3].tolist() == found[4].tolist() == list(HIGH)
    assert (found[1] < found[2]).all()
    assert (found[2] < found[3]).all()


# ---- what a frame shows ----


def test_of_a_sweep_all_beams_are_shown_and_what_did_not_return_is_not():
    rng, beams = np.random.default_rng(2), 64
    points = rng.normal(size=(beams * 1000, 3))
    points *= 10.0 / np.linalg.norm(points, axis=1, keepdims=True)
    beam = np.tile(np.arange(beams), 1000)
    points[beam == 5], points[beam == 6], points[beam == 7] = np.nan, 0.0, 100.0
    found = SweepReturns(MOUNT).of_frame(Frame(0, 0, cloud=Sweep(points)))
    assert 4000 < len(found) <= 6500
    rows = {tuple(p): n for n, p in enumerate(points)}
    seen = np.bincount(beam[[rows[tuple(p)] for p in found]], minlength=beams)
    assert (seen[5:8] == 0).all()
    rest = np.delete(seen, [5, 6, 7])
    assert rest.min() > 0.8 * rest.max()


@pytest.mark.parametrize("rows", [np.zeros((0, 3)), np.full((40, 3), np.nan)])
def test_a_sweep_of_nothing_shows_nothing(rows):
    returns = SweepReturns(MOUNT)
    assert returns.of_frame(Frame(0, 0, cloud=Sweep(rows))).shape == (0, 3)
    assert returns.of_frame(Frame(0, 0)).shape == (0, 3)


@pytest.mark.parametrize("is_head_down", [False, True])
def test_a_scan_is_shown_where_it_hit(is_head_down):
    turn = np.diag([1.0, -1.0, -1.0]) if is_head_down else np.eye(3)
    T = SE3.from_parts(turn, np.array([0.2, 0.1, 0.4]))
    mount = LidarMount("laser", T, (0.1, 30.0), angles=(-1.0, 1.0, 5))
    ranges = np.array([2.0, np.nan, 3.0, np.inf, 4.0])
    keyframe, returns = Keyframe(0, 0, scan=ranges), ScanReturns(mount)
    angles = np.array([-1.0, 0.0, 1.0])
    away = np.array([2.0, 3.0, 4.0])
    expected = np.c_[away * np.cos(angles), away * np.sin(angles), np.zeros(3)]
    np.testing.assert_allclose(returns.of_keyframe(keyframe), expected, atol=1e-12)
    np.testing.assert_allclose(returns.of_frame(Frame(0, 0, scan=ranges)), expected, atol=1e-12)
    map = Map()
    map.add_keyframe(keyframe, np.eye(4))
    shown = sketch(map, CloudSample(returns, T.matrix)).shown
    np.testing.assert_allclose(shown.points[:, 2], 0.4, atol=1e-6)
    assert shown.colours is None
    assert returns.of_frame(Frame(0, 0, scan=np.ones(4))).shape == (0, 3)
    assert returns.of_frame(Frame(0, 0)).shape == (0, 3)
