"""A map taken into another: nothing of either changes but names."""

import numpy as np
import pytest

from maps.test_map_properties import random_pose
from mapworlds import Walk, rich_map
from odomap.files.mapfile import load_map, save_map
from odomap.maps.atlas import Atlas
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map


def walked(seed, steps=120):
    walk = Walk(seed)
    walk.go(steps)
    return walk.map


def same(a, b):
    """Assert that two arrays are the same to the last bit, NaN included."""
    np.testing.assert_array_equal(a, b)


def assert_is_in(small, large, keyframes=0, landmark_ids=None):
    """Assert that a map is in another to the last bit: ids k + keyframes, landmarks as named."""
    ids = small.landmark_ids
    there = ids if landmark_ids is None else landmark_ids
    new = dict(zip(ids.tolist(), there.tolist()))
    status = small.tree().status
    known = np.flatnonzero(status)
    same(status[known], large.tree().status[known + keyframes])
    same(small.Ts_world_body(known), large.Ts_world_body(known + keyframes))
    for k in known.tolist():
        assert small.scale(k) == large.scale(k + keyframes)
        same(small.covariance(k), large.covariance(k + keyframes))
        if small.parent(k) >= 0:
            assert small.parent(k) + keyframes == large.parent(k + keyframes)
    same(small.points_world(ids), large.points_world(there))
    same(small.descriptors(ids), large.descriptors(there))
    same(small.seen(ids), large.seen(there))
    same(small.expected(ids), large.expected(there))
    same(small.anchors(ids) + keyframes, large.anchors(there))
    for k in small.keyframe_ids.tolist():
        a, b = small.keyframe(k), large.keyframe(k + keyframes)
        assert (a.stamp_ns, b.id) == (b.stamp_ns, k + keyframes)
        assert all(getattr(a, n) is getattr(b, n) for n in ("features", "scan", "cloud", "imu"))
        (seen, at), (seen_there, at_there) = small.observations_of(k), large.observations_of(b.id)
        same([new[n] for n in seen.tolist()], seen_there)
        same(at, at_there)
        same(small.covisible(k)[0] + keyframes, large.covisible(b.id)[0])
    mine, theirs = small.observers_of(ids), large.observers_of(there)
    same(mine[0], theirs[0])
    same(mine[1] + keyframes, theirs[1])  # in the same order
    same(mine[2], theirs[2])


def copied(m):
    return Map.restored(m.dump())


@pytest.mark.parametrize("seed", range(6))
def test_absorbing_and_cutting_out_again_gives_the_same(seed):
    first, second = walked(seed), walked(100 + seed)
    before, other = copied(first), copied(second)
    absorbed = first.absorb(second)
    assert_is_in(before, first)
    assert_is_in(other, first, absorbed.offset, absorbed.landmark_ids)
    assert_is_in(other, second)
    assert first.num_keyframes == before.num_keyframes + other.num_keyframes
    assert first.num_landmarks == before.num_landmarks + other.num_landmarks
    assert first.num_observations == before.num_observations + other.num_observations
    same(first.landmark_ids, np.concatenate([before.landmark_ids, absorbed.landmark_ids]))
    edges, mine, theirs = first.edges(), before.edges(), other.edges()
    assert edges.kind == (*mine.kind, *theirs.kind, "gap")
    same(edges.i[:-1], np.concatenate([mine.i, theirs.i + absorbed.offset]))
    same(edges.Ts_i_j[:-1], np.concatenate([mine.Ts_i_j, theirs.Ts_i_j]))


def test_what_is_absorbed_is_a_piece_below_a_gap(tmp_path):
    first, second = rich_map(1), rich_map(2, keyframes=6)
    holder, epoch = int(first.keyframe_ids[-1]), first.epoch
    absorbed = first.absorb(second)
    _, new = Atlas(first).pieces
    assert (new.first_id, new.after_id) == (absorbed.root_id, holder)
    same(new.keyframe_ids, absorbed.keyframe_ids)
    same(absorbed.keyframe_ids, second.keyframe_ids + absorbed.offset)
    assert first.epoch == epoch
    save_map(tmp_path / "both.odomap", first)
    saved, mine = load_map(tmp_path / "both.odomap").dump(), first.dump()
    for name, column in mine.columns.items():
        same(saved.columns[name], column)
    assert saved.edges.kind == mine.edges.kind
    k = first.new_keyframe_id()
    assert k == absorbed.offset + 6 + 1  # one id of the second was reserved
    first.add_keyframe(Keyframe(k, 0), random_pose(np.random.default_rng(0)))
    assert first.parent(k) == holder
    assert k in Atlas(first).pieces[0].keyframe_ids


def test_nothing_is_absorbed_of_an_empty_map_and_an_empty_one_becomes_the_other():
    m = rich_map()
    before = copied(m)
    absorbed = m.absorb(Map())
    assert absorbed.root_id == -1
    assert not len(absorbed.keyframe_ids)
    assert_is_in(before, m)
    assert "gap" not in m.edges().kind
    empty = Map()
    absorbed = empty.absorb(m)
    assert_is_in(m, empty, absorbed.offset, absorbed.landmark_ids)
    assert len(Atlas(empty).pieces) == 1
    k = empty.new_keyframe_id()
    empty.add_keyframe(Keyframe(k, 0), np.eye(4))
    assert empty.parent(k) == absorbed.offset + m.dump().newest


def test_a_map_may_absorb_another_twice_and_itself():
    m = rich_map(3)
    other = copied(m)
    offsets = [m.absorb(other).offset, m.absorb(other).offset]
    itself = m.absorb(m)
    assert len(Atlas(m).pieces) == 6
    for n, offset in enumerate(offsets):
        ids = m.landmark_ids[(n + 1) * other.num_landmarks :][: other.num_landmarks]
        assert_is_in(other, m, offset, ids)
    assert m.num_keyframes == 6 * other.num_keyframes
    assert itself.root_id == itself.offset + int(other.keyframe_ids[0])


def test_what_comes_after_goes_on_as_in_a_map_alone():
    first, second = walked(7), walked(8)
    absorbed = first.absorb(second)
    gone = second.landmark_ids[:3]
    named = absorbed.landmark_ids[:3]
    first.fuse_landmarks(named[:1], named[1:2])
    second.fuse_landmarks(gone[:1], gone[1:2])
    ends = second.keyframe_ids
    first.cull_keyframes(ends[1:3] + absorbed.offset)
    second.cull_keyframes(ends[1:3])
    left = absorbed.landmark_ids[np.isin(absorbed.landmark_ids, first.landmark_ids)]
    assert_is_in(second, first, absorbed.offset, left)
