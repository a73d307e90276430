"""Place index: it follows a map, some keyframes at a time, and says which look like a view."""

import numpy as np
import pytest

from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.system.placeindex import PlaceIndex, described
from odomap.vision.features import Features
from odomap.vision.vocabulary import VocabularyTree


@pytest.fixture(scope="module")
def tree():
    """Return a small vocabulary of random words."""
    looks = np.random.default_rng(0).integers(0, 256, (40, 60, 32)).astype(np.uint8)
    return VocabularyTree.train(list(looks), branching=6, depth=3)


def features(descriptors):
    n = len(descriptors)
    pixels = np.random.default_rng(n).uniform(0, 400, (n, 2)).astype(np.float32)
    rays = np.concatenate([pixels / 400, np.ones((n, 1))], axis=1)
    return Features(pixels, descriptors, rays, np.full(n, np.nan), np.zeros(n, np.uint8))


def add(m, descriptors, shared=()):
    """Add a keyframe that sees landmarks of its own, and some that are there."""
    k = Keyframe(m.new_keyframe_id(), 10**8 * m.num_keyframes, features=features(descriptors))
    m.add_keyframe(k, np.eye(4))
    own = m.add_landmarks(k.id, np.ones((20, 3)), descriptors[:20])
    m.add_observations(k.id, own, np.arange(20))
    m.add_observations(k.id, np.asarray(shared, np.int64), 20 + np.arange(len(shared)))
    return own


def looks(seed, n=60):
    return np.random.default_rng(seed).integers(0, 256, (n, 32)).astype(np.uint8)


def known(index):
    return sorted(k for k in range(100) if index.nodes(k) is not None)


def test_what_a_map_holds_is_indexed_at_once_and_the_rest_by_and_by(tree):
    m = Map()
    for k in range(5):
        add(m, looks(k))
    index = PlaceIndex(m, tree)
    assert known(index) == [0, 1, 2, 3, 4]
    for k in range(5, 11):
        add(m, looks(k))
    assert index.keep_up(2) == 4
    assert known(index) == [0, 1, 2, 3, 4, 9, 10]  # the newest first
    m.cull_keyframes([0, 9, 7])
    assert index.keep_up(0) == 3
    assert known(index) == [1, 2, 3, 4, 10]
    assert index.keep_up(10) == 0
    assert known(index) == m.keyframe_ids.tolist()
    assert len(index) == m.num_keyframes
    for k in m.keyframe_ids.tolist():
        np.testing.assert_array_equal(index.nodes(k), tree.transform(looks(k)).nodes)
        assert index.find(index.words(looks(k)), 3)[0] == k


def test_an_index_that_followed_is_the_same_as_a_new_one(tree):
    m, rng = Map(), np.random.default_rng(1)
    add(m, looks(100))
    index = PlaceIndex(m, tree)
    for step in range(40):
        add(m, looks(step))
        if step % 3 == 2:
            m.cull_keyframes(rng.choice(m.keyframe_ids[1:], 1))
        index.keep_up(2)
    again = PlaceIndex(m, tree)
    assert known(index) == known(again)
    for seed in range(40):
        bow = index.words(np.concatenate([looks(seed)[:30], looks(seed + 1)[30:]]))
        assert index.find(bow, 5) == again.find(bow, 5)


def test_keyframes_that_see_the_same_are_one_place(tree):
    """Of neighbours only the best is named, and another place beside it."""
    m, base = Map(), looks(0)
    shared = add(m, base)
    for k in range(1, 3):
        add(m, np.concatenate([base[: 60 - 5 * k], looks(k, 5 * k)]), shared)
    add(m, np.concatenate([base[:50], looks(9, 10)]))
    add(m, looks(10))
    index = PlaceIndex(m, tree)
    assert index.find(index.words(base), 3) == [0, 3]
    assert index.find(index.words(base), 1) == [0]


def test_keyframes_without_words_are_left_out(tree):
    m = Map()
    m.add_keyframe(Keyframe(m.new_keyframe_id(), 0), np.eye(4))
    sift = features(np.zeros((30, 128), np.float32))
    m.add_keyframe(Keyframe(m.new_keyframe_id(), 1, features=sift), np.eye(4))
    add(m, looks(0))
    index = PlaceIndex(m, tree)
    assert known(index) == [2]
    assert len(index) == 1
    assert index.keep_up(5) == 0
    assert [described(m.keyframe(k)) is None for k in range(3)] == [True, True, False]
    assert index.find(index.words(looks(0)), 3) == [2]
    assert index.find(index.words(looks(0)[:0]), 3) == []
