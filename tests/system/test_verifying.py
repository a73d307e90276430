"""Verification: what is one place is measured exactly, what only looks like one is refused."""

import re
from dataclasses import dataclass, replace

import numpy as np
import pytest

from odomap.errors import ConfigError, InputError
from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_exp, se3_inverse, se3_log
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.system.loopsides import LoopSide, read_side
from odomap.system.verifying import VerifyConfig, verify
from odomap.vision.features import Features
from odomap.vision.matching import MatchConfig
from windowworlds import SCALE, flipped

CAMERA = Camera(intrinsics=(450.0, 450.0, 319.5, 239.5), resolution=(640, 480))
MOUNT = se3_exp(np.array([0.1, -0.05, 0.2, 0.2, -0.3, 0.1]))
SIGMA_PX = 0.45


@dataclass(frozen=True, eq=False)
class World:
    """Points with looks, and the distance at which each shows on the finest level."""

    points: np.ndarray
    looks: np.ndarray
    shows_at: np.ndarray

    @classmethod
    def of(cls, seed=0, count=700, flat=False):
        rng = np.random.default_rng(seed)
        z = np.full(count, 7.0) if flat else rng.uniform(4.0, 10.0, count)
        points = np.stack([*(rng.uniform([[-0.9], [-0.6]], [[0.9], [0.6]], (2, count)) * z), z], 1)
        looks = rng.integers(0, 256, (count, 32), np.uint8)
        return cls(points, looks, rng.uniform(5.0, 20.0, count))

    def at(self, rows):
        return World(self.points[rows], self.looks[rows], self.shows_at[rows])

    def with_other(self, other):
        return World(
            *(np.concatenate(pair) for pair in zip(vars(self).values(), vars(other).values()))
        )


def side(
    world,
    T_world_body,
    keyframe_id=0,
    seed=1,
    sigma_px=SIGMA_PX,
    unit=1.0,
    drift=None,
    own=0.5,
    group=0.3,
    clutter=200,
    first_id=1000,
):
    """Return what a keyframe shows of a world; landmark first_id + k is point k.

    Args:
        world: what there is, in metres.
        T_world_body: (4, 4) true pose.
        keyframe_id: its name.
        seed: of all that is random.
        sigma_px: noise of features on the finest level.
        unit: metres per unit of the keyframe's map.
        drift: (4, 4) by which that map is off, in its units.
        own: share of the visible points that are landmarks of the keyframe, where they are seen.
        group: share of all points that are landmarks of its group.
        clutter: features of nothing.
        first_id: of the landmarks.
    """
    rng = np.random.default_rng(seed)
    T = se3_inverse(T_world_body @ MOUNT)
    local = world.points @ T[:3, :3].T + T[:3, 3]
    distance = np.linalg.norm(local, axis=1)
    level = np.rint(np.log(world.shows_at / distance) / np.log(SCALE)).clip(0, 7).astype(int)
    pixels = CAMERA.project(local)
    pixels = pixels + sigma_px * SCALE ** level[:, None] * rng.normal(size=pixels.shape)
    seen = np.flatnonzero((local[:, 2] > 0.5) & CAMERA.is_inside(pixels, 3.0))
    is_own = rng.random(len(seen)) < own
    known = np.flatnonzero(rng.random(len(world.points)) < group)
    known = known[~np.isin(known, seen[is_own]) & (local[known, 2] > 0.5)]
    rows = np.concatenate([seen[is_own], known])
    # Landmarks of the keyframe itself are where its own pixels say; those of others are as unsure.
    noisy = pixels[rows].copy()
    noisy[is_own.sum() :] += (
        sigma_px * SCALE ** level[known][:, None] * rng.normal(size=(len(known), 2))
    )
    rays = CAMERA.unproject(noisy)
    points = rays / rays[:, 2:] * local[rows, 2:] / unit
    T_drift = np.eye(4) if drift is None else drift
    T_map = T_drift @ T_world_body @ MOUNT
    T_map[:3, 3] = T_drift[:3, 3] + T_drift[:3, :3] @ (T_world_body @ MOUNT)[:3, 3] / unit
    world_points = points @ T_map[:3, :3].T + T_map[:3, 3]
    number = len(seen) + clutter
    order = rng.permutation(number)
    keypoints = np.concatenate([pixels[seen], rng.uniform(3, 475, (clutter, 2))])
    descriptors = np.concatenate(
        [flipped(world.looks[seen], 0.05, rng), rng.integers(0, 256, (clutter, 32), np.uint8)]
    )
    levels = np.concatenate([level[seen], rng.integers(0, 8, clutter)]).astype(np.uint8)
    landmark_of = np.full(number, -1)
    landmark_of[: len(seen)][is_own] = np.arange(is_own.sum())
    away = world_points - T_map[:3, 3]
    distances = np.linalg.norm(away, axis=1)
    return LoopSide(
        keyframe_id=keyframe_id,
        T_world_camera=T_map,
        scale=1.0,
        camera=CAMERA,
        keypoints=keypoints[order],
        levels=levels[order],
        descriptors=descriptors[order],
        nodes=None,
        landmark_of=landmark_of[order],
        landmark_ids=first_id + rows,
        points_world=world_points,
        landmark_descriptors=flipped(world.looks[rows], 0.05, rng),
        is_own=np.arange(len(rows)) < is_own.sum(),
        normals=away / distances[:, None],
        distances=distances,
        landmark_levels=level[rows].astype(np.uint8),
    )


def pose(seed=3, metres=1.0, degrees=15.0):
    xi = np.random.default_rng(seed).normal(size=6)
    xi[:3] *= metres / np.linalg.norm(xi[:3])
    xi[3:] *= np.radians(degrees) / np.linalg.norm(xi[3:])
    return se3_exp(xi)


def check(newer, matched, with_scale=False, seed=0, sigma_px=SIGMA_PX, **settings):
    config = VerifyConfig(**{"shared_px": 0.0, **settings})
    return verify(newer, matched, MOUNT, sigma_px, SCALE, with_scale, config, MatchConfig(), seed)


DRIFT = se3_exp(np.array([3.0, -2.0, 0.5, 0.1, 0.6, -0.2]))
HERE = se3_inverse(MOUNT)


def relative_pose(T, unit=1.0):
    """Return T_matched_keyframe of a body at T seen from HERE.

    The newer map takes its mount to be in its own units: where they are not metres, it is longer.
    """
    mount = MOUNT.copy()
    mount[:3, 3] *= unit
    return MOUNT @ se3_inverse(HERE @ MOUNT) @ T @ MOUNT @ se3_inverse(mount)


@pytest.mark.parametrize("unit", [1.0, 0.4, 2.5])
@pytest.mark.parametrize("flat", [False, True])
def test_the_relative_pose_is_measured_exactly(unit, flat):
    """Whatever the drift of the newer side's map, and, of a single camera, its scale."""
    world, T = World.of(flat=flat), HERE @ pose()
    matched = side(world, HERE, 3, sigma_px=0.0)
    newer = side(world, T, 88, seed=2, sigma_px=0.0, unit=unit, drift=DRIFT, first_id=5000)
    found = check(newer, matched, unit != 1.0)
    assert found.is_accepted, found.reason
    expected = relative_pose(T, unit)
    assert found.scale == pytest.approx(unit, rel=1e-4)
    np.testing.assert_allclose(found.T_matched_keyframe, expected, atol=2e-4)
    assert found.num_inliers > 150


def test_metric_maps_know_their_mount():
    world, T = World.of(), HERE @ pose()
    found = check(side(world, T, 88, seed=2, drift=DRIFT), side(world, HERE, 3))
    e = se3_log(se3_inverse(se3_inverse(HERE) @ T) @ found.T_matched_keyframe)
    assert np.linalg.norm(e[:3]) < 0.02
    assert np.linalg.norm(e[3:]) < np.radians(0.2)


@pytest.mark.parametrize("unit", [1.0, 1.3])
def test_the_information_is_that_of_the_error(unit):
    nees = []
    for seed in range(30):
        world, T = World.of(seed), HERE @ pose(seed, 0.7, 10.0)
        newer = side(world, T, 88, 100 + seed, unit=unit, drift=DRIFT, first_id=5000)
        found = check(newer, side(world, HERE, 3, 200 + seed), unit != 1.0, seed)
        assert found.is_accepted, found.reason
        e = se3_log(se3_inverse(relative_pose(T, unit)) @ found.T_matched_keyframe)
        nees.append(e @ found.information @ e / 6)
    assert 0.5 < np.mean(nees) < 1.6
    assert np.max(nees) < 6.0


def test_what_is_shared_does_not_average_out():
    world = World.of()
    sides = side(world, HERE @ pose(), 88, seed=2), side(world, HERE, 3)
    alone, shared = check(*sides), check(*sides, shared_px=0.15)
    ratio = alone.information / shared.information
    expected = 1 + alone.num_inliers * 0.15**2 / (2 * SIGMA_PX**2)
    np.testing.assert_allclose(ratio, expected, rtol=1e-9)


def test_pairs_are_of_one_point_each():
    world = World.of()
    newer = side(world, HERE @ pose(), 88, seed=2, first_id=5000)
    matched = side(world, HERE, 3)
    found = check(newer, matched)
    assert len(found.pairs) > 50
    np.testing.assert_array_equal(found.pairs[:, 0] - 5000, found.pairs[:, 1] - 1000)
    for column in found.pairs.T:
        assert len(np.unique(column)) == len(column)
    # Features without a landmark show one of the other side.
    for seen, here, there in (
        (found.seen_by_newer, newer, 1000),
        (found.seen_by_matched, matched, 5000),
    ):
        assert len(seen) > 20
        assert (here.landmark_of[seen[:, 0]] == -1).all()
        T = se3_inverse((HERE @ pose() if there == 1000 else HERE) @ MOUNT)
        points = world.points[seen[:, 1] - there] @ T[:3, :3].T + T[:3, 3]
        off = np.linalg.norm(CAMERA.project(points) - here.keypoints[seen[:, 0]], axis=1)
        assert np.max(off / SCALE ** here.levels[seen[:, 0]]) < 6 * SIGMA_PX


@pytest.mark.parametrize("with_scale", [False, True])
def test_half_of_the_matches_may_be_wrong(with_scale):
    world, T = World.of(), HERE @ pose()
    matched, newer = side(world, HERE, 3), side(world, T, 88, seed=2, drift=DRIFT)
    rng = np.random.default_rng(0)
    rows = np.flatnonzero(newer.landmark_of >= 0)
    rows = rng.permutation(rows)[: len(rows) // 2]
    descriptors = newer.descriptors.copy()
    descriptors[rows] = newer.descriptors[np.roll(rows, 1)]
    found = check(replace(newer, descriptors=descriptors), matched, with_scale)
    assert found.is_accepted, found.reason
    e = se3_log(se3_inverse(se3_inverse(HERE) @ T) @ found.T_matched_keyframe)
    assert np.linalg.norm(e[:3]) < 0.05
    assert np.linalg.norm(e[3:]) < np.radians(0.3)


def test_words_do_as_well():
    world = World.of()
    sides = [side(world, HERE @ pose(), 88, seed=2), side(world, HERE, 3)]
    plain = check(*sides)
    # A word of the vocabulary: the nearest of eight looks.
    centres = np.random.default_rng(5).integers(0, 256, (8, 32), np.uint8)
    for k, one in enumerate(sides):
        bits = np.unpackbits(one.descriptors[:, None] ^ centres, axis=2).sum(axis=2)
        sides[k] = one.with_nodes(bits.argmin(axis=1))
    found = check(*sides)
    assert found.is_accepted, found.reason
    np.testing.assert_allclose(found.T_matched_keyframe, plain.T_matched_keyframe, atol=1e-3)


# ---- what is not one place ----


def test_other_places():
    newer = side(World.of(1), HERE @ pose(), 88, seed=2)
    found = check(newer, side(World.of(0), HERE, 3))
    assert not found.is_accepted
    assert found.reason.endswith("between keyframes 88 and 3")
    assert "matches of 12 needed" in found.reason
    assert not found.information.any()
    assert len(found.pairs) == 0


def test_too_few_points_agree():
    world = World.of()
    both = world.at(np.arange(60))
    newer = side(both.with_other(World.of(1)), HERE @ pose(), 88, seed=2)
    found = check(newer, side(both.with_other(World.of(2)), HERE, 3), min_inliers=200)
    assert found.reason == f"{found.num_inliers} inliers of 200 needed between keyframes 88 and 3"
    assert 10 < found.num_inliers < 200


def test_a_mirrored_room():
    """All looks are there, at the other hand's side."""
    world = World.of()
    mirrored = replace(world, points=world.points * [-1.0, 1.0, 1.0])
    for with_scale in (False, True):
        found = check(side(mirrored, HERE, 88, seed=2), side(world, HERE, 3), with_scale)
        assert not found.is_accepted


def test_the_same_poster_on_another_wall():
    """What is on it agrees to the last pixel; nothing around it does."""
    rng = np.random.default_rng(4)
    poster = World(
        np.array([0.3, 0.1, 5.0]) + rng.uniform([-0.6, -0.4, 0], [0.6, 0.4, 0.01], (80, 3)),
        rng.integers(0, 256, (80, 32), np.uint8),
        rng.uniform(5, 12, 80),
    )
    newer = side(poster.with_other(World.of(1)), HERE @ pose(metres=0.3), 88, seed=2)
    found = check(newer, side(poster.with_other(World.of(2)), HERE, 3))
    assert not found.is_accepted
    assert "cover" in found.reason or "expected to show" in found.reason
    assert found.num_inliers >= 30


def test_what_is_far_ahead_and_small_is_enough_where_nothing_else_must_show():
    rng = np.random.default_rng(8)
    far = World(
        rng.uniform([-4.0, -1.5, 30.0], [4.0, 1.5, 50.0], (300, 3)),
        rng.integers(0, 256, (300, 32), np.uint8),
        rng.uniform(35, 60, 300),
    )
    sides = side(far, HERE @ pose(metres=1.0, degrees=5.0), 88, seed=2), side(far, HERE, 3)
    found = check(*sides, spread=0.2)
    assert found.is_accepted, found.reason
    # If it had to be spread more than what there is to be seen, it would be refused.
    refused = check(*sides, spread=0.2, spread_share=1.0)
    assert "cover" in refused.reason


def test_what_only_keyframes_around_it_saw_is_told_apart():
    world = World.of(5, 900)
    aside = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 1.6, 0.0])) @ HERE
    found = check(side(world, HERE, 88, seed=2), side(world, aside, 3, own=0.0, group=0.9))
    n = found.num_inliers
    assert n >= 30
    told = re.fullmatch(
        r"of (\d+) inliers keyframes around 3 saw (\d+), and in its own image (\d+) show, "
        r"which cover (\S+) %, (\S+) % needed, between keyframes 88 and 3",
        found.reason,
    )
    assert told, found.reason
    assert [int(told[1]), int(told[2]) + int(told[3])] == [n, n]
    assert int(told[3]) < 0.1 * n
    assert float(told[4]) < float(told[5])


def test_identical_doors_all_over_the_image():
    """They are spread; but of what must show around them nothing does."""
    rng = np.random.default_rng(6)
    doors = World.of(7, 90)
    newer = side(doors.with_other(World.of(1)), HERE @ pose(metres=0.3), 88, seed=rng.integers(99))
    found = check(newer, side(doors.with_other(World.of(2)), HERE, 3))
    assert "expected to show" in found.reason
    assert found.num_inliers >= 30


def test_nothing_seen_or_known():
    world = World.of()
    matched = side(world, HERE, 3)
    blind = side(world, HERE, 88, own=0.0, group=0.0)
    assert "0 matches" in check(matched, blind).reason
    dark = side(world.at(np.arange(0)), HERE, 88, clutter=0)
    assert "0 matches" in check(dark, matched).reason
    assert "0 matches" in check(matched, dark, True).reason


# ---- the rest ----


def test_the_drifted_path_has_no_say():
    world, T = World.of(), HERE @ pose()
    matched = side(world, HERE, 3)
    here, there = (check(side(world, T, 88, seed=2, drift=d), matched) for d in (None, DRIFT))
    np.testing.assert_allclose(here.T_matched_keyframe, there.T_matched_keyframe, atol=1e-6)
    assert here.num_inliers == there.num_inliers


def test_the_same_seed_gives_the_same_bytes():
    world = World.of()
    sides = side(world, HERE @ pose(), 88, seed=2), side(world, HERE, 3)
    one, two = (check(*sides, seed=5) for _ in range(2))
    assert one.T_matched_keyframe.tobytes() == two.T_matched_keyframe.tobytes()
    assert one.information.tobytes() == two.information.tobytes()
    assert one.pairs.tobytes() == two.pairs.tobytes()


@pytest.mark.parametrize("wrong", [{"min_inliers": 0}, {"share": 1.5}, {"gate": -1.0}])
def test_settings_that_cannot_be(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        VerifyConfig(**wrong)


# ---- reading ----


def mapped(keyframes=4, scale=1.0):
    """Return a map of keyframes in a row that see some points in common."""
    rng, m = np.random.default_rng(0), Map()
    for k in range(keyframes):
        features = Features(
            rng.uniform(0, 480, (12, 2)).astype(np.float32),
            rng.integers(0, 256, (12, 32), np.uint8),
            np.tile([0.0, 0.0, 1.0], (12, 1)),
            np.full(12, np.nan),
            rng.integers(0, 8, 12).astype(np.uint8),
        )
        keyframe = Keyframe(m.new_keyframe_id(), 10**8 * k, features)
        m.add_keyframe(keyframe, pose(k), scale=scale)
        ids = m.add_landmarks(
            keyframe.id, rng.normal((0, 0, 5), 1.0, (4, 3)), features.descriptors[:4]
        )
        m.add_observations(keyframe.id, ids, np.arange(4))
        m.add_observations(
            keyframe.id, np.arange(4 * max(k - 2, 0), 4 * k), 4 + np.arange(min(4 * k, 8))
        )
    return m


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_a_side_is_what_the_map_says(scale):
    m = mapped(scale=scale)
    s = read_side(m, 2, CAMERA, MOUNT)
    own, keypoints = m.observations_of(2)
    assert s.is_own.sum() == len(own) == 12
    assert s.is_own[:12].all()
    np.testing.assert_array_equal(np.sort(s.landmark_ids[:12]), np.sort(own))
    np.testing.assert_array_equal(np.sort(s.landmark_ids), m.landmarks_of(m.keyframe_ids))
    np.testing.assert_array_equal(s.landmark_ids[s.landmark_of[keypoints]], own)
    np.testing.assert_array_equal(s.feature_of[s.landmark_of[keypoints]], keypoints)
    np.testing.assert_allclose(s.points_world, m.points_world(s.landmark_ids))
    np.testing.assert_array_equal(s.landmark_descriptors, m.descriptors(s.landmark_ids))
    body = s.points_camera @ MOUNT[:3, :3].T + MOUNT[:3, 3]
    T = m.T_world_body(2)
    np.testing.assert_allclose(scale * body @ T[:3, :3].T + T[:3, 3], s.points_world, atol=1e-12)
    alone = read_side(m, 2, CAMERA, MOUNT, group=0)
    np.testing.assert_array_equal(alone.landmark_ids, s.landmark_ids[:12])


def test_a_side_without_what_both_know():
    m = mapped()
    s = read_side(m, 3, CAMERA, MOUNT)
    gone = s.landmark_ids[[1, 5, 13]]
    rest = s.without(gone)
    assert not np.isin(rest.landmark_ids, gone).any()
    assert len(rest.landmark_ids) == len(s.landmark_ids) - 3
    for feature in range(12):
        before, after = s.landmark_of[feature], rest.landmark_of[feature]
        if s.landmark_ids[before] in gone:
            assert after == -1
        else:
            assert rest.landmark_ids[after] == s.landmark_ids[before]
    np.testing.assert_array_equal(
        rest.points_camera, s.points_camera[~np.isin(s.landmark_ids, gone)]
    )


def test_sides_that_cannot_be():
    m = mapped()
    with pytest.raises(InputError, match="nodes of shape"):
        read_side(m, 1, CAMERA, MOUNT).with_nodes(np.zeros(3))
    m.retire_keyframes([0])
    with pytest.raises(InputError, match="keyframe 0: has no features"):
        read_side(m, 0, CAMERA, MOUNT)
    with pytest.raises(KeyError):
        read_side(m, 77, CAMERA, MOUNT)
