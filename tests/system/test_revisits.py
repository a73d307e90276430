"""Revisits: what comes back and stays is pointed at, what merely looks alike is not."""

import numpy as np
import pytest

from odomap.errors import ConfigError
from odomap.system.revisits import RevisitConfig, Revisits, group_scores
from odomap.vision.places import Candidates, Places
from odomap.vision.vocabulary import BagOfWords

WORDS, STEP, SPAN = 4000, 10, 60


def view(at, extra=()):
    """Return the words of a stretch of a street: each place has words of its own."""
    words = np.union1d(np.arange(at * STEP, at * STEP + SPAN), np.asarray(extra, int))
    return BagOfWords(words, np.full(len(words), 1 / len(words)), np.empty(0, np.int64))


def neighbours(at):
    """Return keyframes that see some of the same, most first."""
    return np.array([at + s * d for d in range(1, 5) for s in (1, -1) if at + s * d >= 0])


class Drive:
    """A drive along a street: keyframe k of the outward way is at place k."""

    def __init__(self, outward, config=None):
        self.places = Places(WORDS)
        self.revisits = Revisits(self.places, config)
        self.place_of = {}
        self.found = []
        for k in range(outward):
            self.go(k, view(k))

    def go(self, at, bow):
        k = len(self.place_of)
        self.place_of[k] = at
        near = [i for i in range(k) if k - i <= 12]
        self.found = self.revisits.find(k, bow, near, self.covisible)
        self.places.add(k, bow)
        return self.found

    def covisible(self, keyframe_id):
        return np.array([i for i in neighbours(keyframe_id) if i in self.place_of], np.int64)


def test_a_drive_without_return_points_at_nothing():
    drive = Drive(0)
    for k in range(60):
        assert drive.go(k, view(k)) == []


def test_a_place_that_comes_back_is_a_candidate_after_three_in_a_row():
    drive = Drive(50)
    for turn, at in enumerate([200, 20, 21, 22, 23]):
        found = drive.go(at, view(at))
        if turn < 2:  # the first view after a leap looks like none before it: no reference
            assert found == []
            continue
        assert len(found) == 1
        revisit = found[0]
        assert revisit.matched_id == at
        assert revisit.group[0] == at
        assert len(revisit.group) == 9
        assert revisit.score == pytest.approx(1.0, abs=1e-6)
        assert revisit.similarity == pytest.approx(SPAN / (SPAN - STEP), rel=1e-6)
        assert revisit.total > revisit.similarity
        assert revisit.num_in_a_row == turn - 1
        assert revisit.is_candidate == (turn >= 4)
        if turn < 4:
            assert revisit.reason == f"seen {turn - 1} times in a row of 3 needed"


def test_what_looks_alike_once_does_not_last():
    drive = Drive(50)
    for k in range(100, 110):
        found = drive.go(k, view(k, np.arange(200, 240) if k == 105 else ()))
        assert [r.is_candidate for r in found] == ([False] if k == 105 else [])


def test_alike_places_apart_do_not_last_either():
    drive = Drive(60)
    lookalike = iter([5, 25, 45, 15, 35, 55])
    for k in range(100, 106):
        at = next(lookalike) * STEP
        found = drive.go(k, view(k, np.arange(at, at + 40)))
        assert not any(r.is_candidate for r in found)


def test_after_forgetting_it_begins_anew():
    drive = Drive(50)
    for at in (19, 20, 21):
        drive.go(at, view(at))
    assert any(r.num_in_a_row == 2 for r in drive.found)
    drive.revisits.forget()
    assert drive.go(22, view(22)) == []
    assert [r.num_in_a_row for r in drive.go(23, view(23))] == [1]


def test_what_is_excluded_is_no_revisit():
    places = Places(WORDS)
    revisits = Revisits(places, RevisitConfig(in_a_row=1))
    for k in range(30):
        places.add(k, view(k))

    def find(excluded):
        revisits.find(98, view(20), [], neighbours)
        return revisits.find(99, view(20), excluded, neighbours)

    assert [r.matched_id for r in find([])] == [20]
    assert 20 not in [r.matched_id for r in find([20])]
    assert find(range(30)) == []


def test_a_keyframe_unlike_the_one_before_is_compared_with_none():
    drive = Drive(50, RevisitConfig(least_reference=0.5, in_a_row=1))
    drive.go(20, view(300))
    assert drive.go(20, view(20)) == []
    assert [r.matched_id for r in drive.go(20, view(20))] == [20]


def test_empty_views_are_like_none():
    empty = BagOfWords(np.empty(0, np.int64), np.empty(0), np.empty(0, np.int64))
    drive = Drive(10)
    for _ in range(3):
        assert drive.go(10, empty) == []


def test_places_compete_by_the_sums_of_their_groups():
    # 1, 2, 3 are one place, 7 is most alike but alone, 9 is far below
    found = Candidates(
        np.array([7, 2, 1, 3, 9]), np.array([0.5, 0.4, 0.3, 0.2, 0.1]), np.ones(5, np.int64)
    )
    together = {1: [2, 3], 2: [1, 3, 4], 3: [2], 7: [6], 9: []}

    def covisible(k):
        return np.array(together[k], np.int64)

    groups = group_scores(found, covisible, 10, 0.5)
    assert [g[0] for g in groups] == [7, 2]
    assert groups[1][1].tolist() == [2, 1, 3, 4]
    assert [g[2] for g in groups] == [0.5, 0.4]
    assert [g[3] for g in groups] == pytest.approx([0.5, 0.9])
    assert [g[0] for g in group_scores(found, covisible, 10, 0.75)] == [2]
    assert [g[1].tolist() for g in group_scores(found, covisible, 2, 0.75)] == [[2, 1]]
    # 3 is the best of a group of its own, but sees what 2 sees
    together[1], together[3] = [], [8]
    assert [g[0] for g in group_scores(found, covisible, 10, 0.2)] == [7, 2]
    nothing = Candidates(np.empty(0, np.int64), np.empty(0), np.empty(0, np.int64))
    assert group_scores(nothing, covisible, 10, 0.75) == []


@pytest.mark.parametrize("wrong", [{"similarity": -1.0}, {"group": 0}, {"group_share": 2.0}])
def test_settings_that_cannot_be(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        RevisitConfig(**wrong)
