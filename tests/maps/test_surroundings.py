"""What lies around: the local map, keyframes near by, and how landmarks look."""

import numpy as np
import pytest

from maps.test_map import chain, pose
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.vision.features import Features


def features(levels):
    n = len(levels)
    return Features(
        np.zeros((n, 2), np.float32),
        np.zeros((n, 32), np.uint8),
        np.tile([0.0, 0.0, 1.0], (n, 1)),
        np.full(n, np.nan),
        np.asarray(levels, np.uint8),
    )


def test_the_local_map_of_a_frame():
    m, ids = chain(10)
    keyframes, counts = m.observing([*ids[4], ids[5][0], ids[5][0]])
    assert keyframes.tolist() == [5, 6, 4, 7]  # 4 is seen by 4, 5, 6; 5 by 5, 6, 7
    assert counts.tolist() == [6, 6, 5, 1]
    np.testing.assert_array_equal(m.landmarks_of([5, 5]), np.sort(ids[3:6].ravel()))
    m.fuse_landmarks(ids[4][:1], ids[5][:1])
    assert m.observing(ids[5][:1])[0].tolist() == [4, 5, 6, 7]
    m.cull_keyframes([5])
    assert m.observing(ids[5][:1])[0].tolist() == [4, 6, 7]
    assert len(m.landmarks_of([5])) == 0
    for none in (m.observing([]), m.observing([-1, 10**6])):
        assert [len(part) for part in none] == [0, 0]
    with pytest.raises(KeyError, match="keyframe 99"):
        m.landmarks_of([99])


def test_keyframes_near_a_pose_come_nearest_first():
    m = Map()
    for k, (x, yaw) in enumerate([(0, 0), (3, 0), (1, 0), (-1, 0), (0.5, 2.0), (0, 0.9)]):
        m.add_keyframe(Keyframe(m.new_keyframe_id(), k), pose((x, 0, 0), yaw))
    assert m.near(np.eye(4), 2.0, 1.0).tolist() == [0, 5, 2, 3]
    assert m.near(np.eye(4), 2.0, 0.5).tolist() == [0, 2, 3]
    assert m.near(np.eye(4), 10.0, 4.0).tolist() == [0, 5, 4, 2, 3, 1]
    m.cull_keyframes([2])
    assert m.near(np.eye(4), 2.0, 0.5).tolist() == [0, 3]
    assert m.near(pose((100, 0, 0)), 2.0, 0.5).tolist() == []
    assert len(Map().near(np.eye(4), 1.0, 1.0)) == 0


def test_views_say_side_distance_and_level():
    m = Map()
    mount = pose((0.0, 1.0, 0.0))
    for k, x in enumerate((0.0, 4.0, 8.0)):
        keyframe = Keyframe(m.new_keyframe_id(), k, features=features([k, k + 3]))
        m.add_keyframe(keyframe, pose((x, -1.0, 0.0)))
    ids = m.add_landmarks([0, 2, 1, 1], np.array([[4, 1, 3], [-4, 1, 3], [0, 1, 3], [0, 1, 5.0]]))
    m.add_observations(0, ids[:2], [1, 0])
    m.add_observations(1, ids[:1], [0])
    m.add_observations(2, ids[:2], [0, 1])
    m.add_observations(0, ids[2:3], [-1])
    views = m.views_of([ids[2], ids[0], ids[1], -1, ids[0], ids[3], 99], mount)
    assert views.ids.tolist() == ids.tolist()
    assert len(views) == 4
    np.testing.assert_allclose(views.points_world, [[4, 0, 3], [4, 0, 3], [4, 0, 3], [4, 0, 5]])
    np.testing.assert_allclose(views.normals[0], [0, 0, 1], atol=1e-12)  # from three sides
    np.testing.assert_allclose(views.normals[2], [0.8, 0, 0.6])  # from keyframe 0 alone
    np.testing.assert_allclose(views.normals[3], [0, 0, 1])  # from nowhere: from the anchor
    # the anchor's observation; where the anchor does not see it, the oldest one's
    np.testing.assert_allclose(views.distance, [5, 5, 5, 5])
    assert views.level.tolist() == [3, 5, 0, 0]
    m.remove_observations([0], ids[:1])
    again = m.views_of(ids[:1], mount)
    np.testing.assert_allclose(again.distance, [3])
    assert again.level.tolist() == [1]
    assert len(m.views_of([], mount)) == 0


def test_descriptors_of_fused_landmarks_stay():
    m, ids = chain(2)
    look = np.full((2, 32), 7, np.uint8)
    m.fuse_landmarks(ids[0][:1], ids[0][1:2])
    m.set_descriptors([ids[0][1], ids[0][2]], look)
    assert m.descriptors([ids[0][0], ids[0][2]]).max(axis=1).tolist() == [0, 7]
    with pytest.raises(ValueError, match=r"2 landmarks need uint8 \(2, 32\)"):
        m.set_descriptors(ids[0][:2], look[:1])


def test_expected_and_seen_are_counted_apart_and_follow_a_survivor():
    m, ids = chain(2)
    a, b = ids[0][:2].tolist()
    m.count_expected([a, a, b, -1, 10**6])
    m.count_seen([b])
    m.fuse_landmarks([a], [b])
    m.count_expected([b])
    assert m.expected([a, b, ids[0][2]]).tolist() == [4, 4, 0]
    assert m.seen([a]).tolist() == [1]
