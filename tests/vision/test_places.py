"""The database of places: the same as comparing with every keyframe, whatever came and went."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from odomap.errors import InputError
from odomap.vision import places as places_module
from odomap.vision.places import Places
from odomap.vision.vocabulary import BagOfWords

WORDS = 60


def random_bag(rng, most=30):
    words = np.sort(rng.choice(WORDS, rng.integers(0, most), replace=False))
    weights = rng.random(len(words)) + 0.01
    return BagOfWords(words, weights / max(weights.sum(), 1e-9), np.empty(0, np.int64))


def brute_force(bags, bow, most, excluded=(), least_score=0.0):
    """Return ids, scores and counts of common words, best first, by comparing with each."""
    rows = [
        (-bow.score(bag), k, len(np.intersect1d(bow.words, bag.words)))
        for k, bag in bags.items()
        if k not in excluded
    ]
    rows = sorted(row for row in rows if row[0] < 0 and -row[0] >= least_score)[:most]
    return [k for _, k, _ in rows], [-s for s, _, _ in rows], [n for _, _, n in rows]


def assert_same(found, expected):
    ids, scores, common = expected
    assert found.keyframe_ids.tolist() == ids
    assert found.scores == pytest.approx(scores, abs=1e-7)
    assert found.num_common.tolist() == common


@pytest.fixture
def small_segments(monkeypatch):
    monkeypatch.setattr(places_module, "SEGMENT", 7)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 12))
def test_a_query_is_brute_force_whatever_came_and_went(seed, most):
    rng = np.random.default_rng(seed)
    places, bags = Places(WORDS), {}
    for k in range(40):
        bags[k] = random_bag(rng)
        places.add(k, bags[k])
        if rng.random() < 0.4:
            gone = int(rng.choice(list(bags)))
            places.remove(gone)
            del bags[gone]
    excluded = rng.choice(40, 5).tolist()
    bow = random_bag(rng)
    assert_same(places.query(bow, most), brute_force(bags, bow, most))
    assert_same(places.query(bow, most, excluded), brute_force(bags, bow, most, excluded))
    least = float(rng.uniform(0, 0.4))
    assert_same(places.query(bow, most, (), least), brute_force(bags, bow, most, (), least))
    assert places.keyframe_ids.tolist() == sorted(bags)
    assert len(places) == len(bags)


def test_many_indices_are_as_one(small_segments):
    rng = np.random.default_rng(4)
    places, bags = Places(WORDS), {}
    for k in range(60):
        bags[k] = random_bag(rng)
        places.add(k, bags[k])
    for k in range(0, 60, 2):
        places.remove(k)
        del bags[k]
    before = places.nbytes
    for k in range(100, 120):  # rows that are free are used again
        bags[k] = random_bag(rng)
        places.add(k, bags[k])
    assert places.nbytes < 1.5 * before
    for _ in range(5):
        bow = random_bag(rng)
        assert_same(places.query(bow, 9), brute_force(bags, bow, 9))


def test_coming_and_going_leaves_no_trace():
    rng = np.random.default_rng(5)
    bags = [random_bag(rng) for _ in range(30)]
    straight, roundabout = Places(WORDS), Places(WORDS)
    for k, bag in enumerate(bags):
        straight.add(k, bag)
    for turn in range(3):
        for k in rng.permutation(30).tolist():
            roundabout.add(k + 100 * (turn < 2), bags[k])
        for k in range(30 * (turn < 2)):
            roundabout.remove(k + 100)
    for bag in bags:
        one, other = straight.query(bag, 30), roundabout.query(bag, 30)
        assert one.keyframe_ids.tolist() == other.keyframe_ids.tolist()
        assert one.scores.tobytes() == other.scores.tobytes()


def test_a_keyframe_is_most_like_itself_and_what_it_was_is_kept():
    rng = np.random.default_rng(6)
    places = Places(WORDS)
    bags = {k: random_bag(rng) for k in range(10, 40)}
    for k, bag in bags.items():
        places.add(k, bag)
    for k, bag in bags.items():
        if len(bag) == 0:
            assert len(places.query(bag)) == 0
            continue
        found = places.query(bag, 1)
        assert found.keyframe_ids.tolist() == [k]
        assert found.scores[0] == pytest.approx(1.0, abs=1e-7)
        assert found.num_common[0] == len(bag)
        kept = places.bag(k)
        assert kept.words.tolist() == bag.words.tolist()
        assert kept.weights == pytest.approx(bag.weights, abs=1e-9)


def test_scores_of_named_keyframes():
    rng = np.random.default_rng(8)
    places, first, second = Places(WORDS), random_bag(rng), random_bag(rng)
    places.add(3, first)
    scores = places.scores_of(second, [3, 4])
    assert scores[0] == pytest.approx(first.score(second), abs=1e-7)
    assert np.isnan(scores[1])


def test_equal_scores_come_oldest_first():
    places = Places(3)
    bow = BagOfWords(np.array([1]), np.ones(1), np.empty(0, np.int64))
    for k in (5, 2, 9, 4):
        places.add(k, bow)
    assert places.query(bow, 3).keyframe_ids.tolist() == [2, 4, 5]
    assert places.query(bow, 0).keyframe_ids.tolist() == []


def test_an_empty_database_answers_with_nothing():
    assert len(Places(5).query(BagOfWords(np.array([1]), np.ones(1), np.empty(0, np.int64)))) == 0


def test_what_cannot_be_added():
    places = Places(5)
    bow = BagOfWords(np.array([1, 4]), np.array([0.5, 0.5]), np.empty(0, np.int64))
    places.add(1, bow)
    with pytest.raises(InputError, match="keyframe 1 is in already"):
        places.add(1, bow)
    wrong = BagOfWords(np.array([1, 5]), np.array([0.5, 0.5]), np.empty(0, np.int64))
    for call in (lambda: places.add(2, wrong), lambda: places.query(wrong)):
        with pytest.raises(InputError, match="another vocabulary"):
            call()
    assert 2 not in places
    places.remove(7)  # what is not in need not be forgotten
    assert 1 in places
