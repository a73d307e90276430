"""The local map: what a frame should show, and on which level, and what lies around."""

import numpy as np
import pytest

from odomap.errors import ConfigError
from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_exp, se3_inverse
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.maps.views import LandmarkViews
from odomap.system.localmap import MARGIN_PX, LocalMap, LocalMapConfig, expect, local_map
from odomap.vision.features import Features

CAMERA = Camera(intrinsics=(300.0, 300.0, 159.5, 119.5), resolution=(320, 240))
SCALE, LEVELS = 1.2, 8


def local_of(points, normals=None, distance=None, level=None):
    """Return a local map of points (N, 3), seen along z at the distance they have, level 3."""
    n = len(points)
    views = LandmarkViews(
        np.arange(n),
        np.asarray(points, float),
        np.tile([0.0, 0, 1], (n, 1)) if normals is None else np.asarray(normals, float),
        np.zeros((n, 32), np.uint8),
        np.linalg.norm(points, axis=1) if distance is None else np.asarray(distance, float),
        np.full(n, 3, np.uint8) if level is None else np.asarray(level, np.uint8),
    )
    return LocalMap(0, views, np.full((n, 2), np.nan), np.zeros(n), np.ones(n, bool))


def expected(local, T_camera_world=None, rows=None):
    T = np.eye(4) if T_camera_world is None else T_camera_world
    rows = np.arange(len(local)) if rows is None else np.asarray(rows)
    return expect(local, rows, T, CAMERA, SCALE, LEVELS)


def test_what_lies_in_the_image_is_expected_where_it_projects():
    rng = np.random.default_rng(0)
    points = rng.uniform([-4, -3, 1], [4, 3, 8], (300, 3))
    T = se3_exp(np.array([0.1, -0.2, 0.3, 0.05, 0.1, -0.08]))
    local = local_of(points, normals=points / np.linalg.norm(points, axis=1, keepdims=True))
    there = expected(local, T)
    moved = points @ T[:3, :3].T + T[:3, 3]
    pixels = CAMERA.project(moved)
    inside = CAMERA.is_inside(pixels, MARGIN_PX) & (moved[:, 2] > 0.1)
    assert 50 < len(there.rows) < 300
    assert np.isin(there.rows, np.flatnonzero(inside)).all()
    assert len(there.rows) > 0.9 * inside.sum()
    np.testing.assert_allclose(there.pixels, pixels[there.rows], atol=1e-9)
    np.testing.assert_allclose(there.points_camera, moved[there.rows], atol=1e-12)


def test_what_is_behind_or_beside_is_not():
    points = [[0, 0, 3.0], [0, 0, -3], [0, 0, 0], [9, 0, 3], [0, -9, 3], [0, 0, 0.01]]
    local = local_of(np.array(points), distance=np.full(6, 3.0))
    np.testing.assert_array_equal(expected(local).rows, [0])
    # The rim of the image: two pixels wide.
    x = [(u - CAMERA.cx) / CAMERA.fx for u in (1.5, 2.5, 316.5, 317.5)]
    rim = np.array([[3 * value, 0, 3] for value in x])
    np.testing.assert_array_equal(expected(local_of(rim)).rows, [1, 2])


def test_a_place_that_is_not_known_is_nowhere():
    points = np.array([[0, 0, 3.0], [np.nan, np.nan, np.nan]])
    np.testing.assert_array_equal(expected(local_of(points)).rows, [0])


@pytest.mark.parametrize(("degrees", "shown"), [(0, 1), (55, 1), (-55, 1), (65, 0), (180, 0)])
def test_the_other_side_of_a_thing_looks_different(degrees, shown):
    """Seen from directions up to 60° from the mean of those it was seen from."""
    a = np.radians(degrees)
    local = local_of(np.array([[0, 0, 3.0]]), normals=[[np.sin(a), 0, np.cos(a)]])
    assert len(expected(local).rows) == shown
    # It is the direction of the ray that counts, not how the camera is turned.
    turned = se3_exp(np.array([0, 0, 0, 0, np.radians(15), 0]))
    assert len(expected(local, turned).rows) == shown


@pytest.mark.parametrize("level", [0, 3, 7])
@pytest.mark.parametrize("steps", [-2, -1, 0, 1, 2])
def test_the_level_follows_from_the_distance(level, steps):
    """Seen `steps` levels nearer than on level l, a thing is s^steps larger: on level l + steps."""
    local = local_of(np.array([[0, 0, 2.0]]), distance=[2.0 * SCALE**steps], level=[level])
    there = expected(local)
    wanted = level + steps
    if -1.5 < wanted < LEVELS + 0.5:
        assert there.level.tolist() == [min(max(wanted, 0), LEVELS - 1)]
        assert there.level.dtype == np.int64
    else:
        assert not len(there.rows)


def test_too_near_and_too_far_are_not_expected():
    points = np.tile([0, 0, 2.0], (6, 1))
    steps = np.array([-4.4, -4.6, -20, 5.4, 5.6, 20])
    there = expected(local_of(points, distance=2.0 * SCALE**steps))
    np.testing.assert_array_equal(there.rows, [0, 3])
    np.testing.assert_array_equal(there.level, [0, LEVELS - 1])


def test_rows_that_are_not_asked_about_are_left_out():
    points = np.random.default_rng(1).uniform([-0.5, -0.5, 2], [0.5, 0.5, 4], (40, 3))
    local = local_of(points)
    rows = np.array([3, 8, 30])
    np.testing.assert_array_equal(expected(local, rows=rows).rows, rows)
    assert not len(expected(local, rows=np.empty(0, np.int64)).rows)


# ---- gathering ----


def features(rng, count):
    keypoints = rng.uniform(5, 235, (count, 2)).astype(np.float32)
    return Features(
        keypoints,
        rng.integers(0, 256, (count, 32), np.uint8),
        CAMERA.unproject(keypoints),
        np.full(count, np.nan),
        rng.integers(0, LEVELS, count).astype(np.uint8),
    )


def at(x, turn_deg=0.0, z=0.0):
    T = se3_exp(np.array([0, 0, 0, 0, np.radians(turn_deg), 0]))
    T[:3, 3] = [x, 0, z]
    return T


def place(m, rng, T, seen=(), new=30, anchor_depth=4.0):
    """Add a keyframe that sees some landmarks and `new` ones in front of it; return both."""
    seen = np.asarray(seen, np.int64)
    k = m.new_keyframe_id()
    m.add_keyframe(Keyframe(k, 10**8 * k, features(rng, len(seen) + new)), T)
    points = rng.uniform([-1, -1, anchor_depth], [1, 1, anchor_depth + 0.1], (new, 3))
    ids = m.add_landmarks(k, points, rng.integers(0, 256, (new, 32), np.uint8))
    m.add_observations(k, np.r_[seen, ids], np.arange(len(seen) + new))
    return k, ids


@pytest.fixture
def street():
    """Return a map of keyframes in a row, each seeing half of what the one before has seen."""
    rng, m = np.random.default_rng(2), Map()
    ids = np.empty(0, np.int64)
    made = []
    for n in range(6):
        k, new = place(m, rng, at(3.0 * n), ids[:10])
        ids = new
        made.append((k, new))
    return m, made, rng


def gather(m, k, sigma=None, **how):
    T = m.T_world_body(k)
    return local_map(m, k, T, np.eye(4), sigma, LocalMapConfig(**how))


def test_what_covisible_keyframes_see_is_here(street):
    m, made, _ = street
    local = gather(m, made[2][0], near=1, near_distance=0.0)
    assert local.keyframe_id == made[2][0]
    expected = m.landmarks_of([made[1][0], made[2][0], made[3][0]])
    np.testing.assert_array_equal(local.landmark_ids, expected)
    assert (np.diff(local.landmark_ids) > 0).all()
    np.testing.assert_array_equal(local.views.points_world, m.points_world(expected))


def test_a_near_keyframe_that_shares_nothing_is_here(street):
    """What was mapped long ago is looked for again: the camera has come back with some drift."""
    m, made, rng = street
    near, ids = place(m, rng, at(0.5, 10))
    local = gather(m, made[0][0])
    assert np.isin(ids, local.landmark_ids).all()
    assert not np.isin(near, m.covisible(made[0][0])[0])
    # Not if it looks elsewhere, is further away, or is not wanted.
    _, turned = place(m, rng, at(0.5, 60))
    _, far = place(m, rng, at(0.0, 0, z=-2.0))
    local = gather(m, made[0][0])
    assert not np.isin(turned, local.landmark_ids).any()
    assert not np.isin(far, local.landmark_ids).any()
    local = gather(m, made[0][0], near_distance=0.0)
    assert not np.isin(ids, local.landmark_ids).any()


def test_how_much_is_gathered_is_bounded(street):
    m, made, rng = street
    seen = made[5][1]
    others = [place(m, rng, at(15.0 + 0.01 * n), seen[:5], new=4) for n in range(30)]
    near = [place(m, rng, at(15.0, 1, z=0.01 * n), new=4) for n in range(12)]
    local = gather(m, made[5][0], keyframes=10, near=3)
    assert sum(np.isin(ids, local.landmark_ids).all() for _, ids in others) <= 10 + 3
    nothing = gather(m, made[5][0], keyframes=50, near=3)
    assert sum(np.isin(ids, nothing.landmark_ids).all() for _, ids in near) == 3
    # The nearest ones.
    assert np.isin(near[0][1], nothing.landmark_ids).all()


def test_what_the_keyframe_itself_sees_is_always_here(street):
    m, made, rng = street
    for n in range(5):
        place(m, rng, at(6.0 + n), made[2][1], new=0)
    local = gather(m, made[2][0], keyframes=1)
    seen, rows = m.observations_of(made[2][0])
    assert np.isin(seen, local.landmark_ids).all()
    # And where it sees them is known; of the others it is not.
    at_rows = np.searchsorted(local.landmark_ids, seen)
    keypoints = m.keyframe(made[2][0]).features.keypoints
    np.testing.assert_array_equal(local.keypoints[at_rows], keypoints[rows])
    others = np.setdiff1d(np.arange(len(local)), at_rows)
    assert np.isnan(local.keypoints[others]).all()


def test_rows_are_found_by_id(street):
    m, made, _ = street
    local = gather(m, made[1][0])
    ids = local.landmark_ids[[7, 2, 11]]
    np.testing.assert_array_equal(local.rows_of(np.r_[ids, 10_000]), [2, 7, 11])


def test_depth_is_as_sure_as_it_was_measured(street):
    m, made, _ = street
    assert not gather(m, made[2][0]).relative.any()
    local = gather(m, made[2][0], sigma=0.01)
    count = m.count_observers(local.landmark_ids)
    assert set(count.tolist()) == {1, 2}
    expected = 0.01 * local.views.distance / np.sqrt(count)
    np.testing.assert_allclose(local.relative, expected)


def test_a_keyframe_without_landmarks_has_an_empty_local_map():
    m, rng = Map(), np.random.default_rng(0)
    k, _ = place(m, rng, np.eye(4), new=0)
    local = gather(m, k, sigma=0.01)
    assert len(local) == 0
    assert not len(expected(local, se3_inverse(np.eye(4))).rows)


def test_limits_are_checked():
    for name, value in (("keyframes", 0), ("near_distance", -1.0), ("radius_px", 0.0)):
        with pytest.raises(ConfigError, match=name):
            LocalMapConfig(**{name: value})
