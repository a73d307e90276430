"""Places seen before: told by the keyframes passed since, and by what a view leaves unexplained."""

import numpy as np
import pytest

from odomap.maps.map import Map
from odomap.system.config import preset
from odomap.system.passed import FEW, LONG_AGO, NEW, Passed
from odomap.system.slam import Slam
from system.test_localmapping import small_loop, walk

WIDTH = 320


def spread(count, left=0.0, right=1.0, seed=0):
    """Return pixels (count, 2) all over a part of an image."""
    rng = np.random.default_rng(seed)
    return rng.uniform([left * WIDTH, 0], [right * WIDTH, 200], (count, 2))


def passed(*keyframe_ids):
    """Return what was passed."""
    way = Passed()
    for k in keyframe_ids:
        way.add(k)
    return way


def knows(way, anchors, found=None, features=None):
    """Say whether a view with landmarks of these anchors is known."""
    anchors = np.asarray(anchors)
    features = spread(800) if features is None else features
    found = spread(len(anchors), seed=1) if found is None else found
    return way.is_known(anchors, found, features, WIDTH)


def all_of(keyframe_id):
    """Return the anchors of many landmarks of a keyframe."""
    return np.full(1500, keyframe_id)


def test_only_what_was_passed_long_ago_is_old():
    way = passed(*range(LONG_AGO + 3))
    assert [knows(way, all_of(k)) for k in range(4)] == [True, True, True, False]


def test_a_new_map_knows_nothing():
    assert not knows(passed(), all_of(0))
    assert not knows(passed(*range(LONG_AGO)), all_of(0))


def test_coming_back_ages_keyframes_without_new_ones():
    """A round of ten keyframes, gone round again and again, is all old in the end."""
    once = list(range(10))
    rounds = LONG_AGO // len(once)
    assert not knows(passed(*once * rounds), all_of(9))
    assert knows(passed(*once * (rounds + 1)), all_of(9))


def test_there_and_back_between_a_few_passes_nothing():
    few = list(range(FEW))
    assert not knows(passed(*few * LONG_AGO), all_of(0))
    assert not knows(passed(*[0] * LONG_AGO * 2), all_of(0))


def test_a_map_that_was_there_before_is_old_as_a_whole():
    way = Passed(7)
    assert knows(way, all_of(7))
    assert not knows(way, all_of(8))
    way.add(8)
    assert not knows(way, all_of(8))


def test_only_what_is_old_speaks_for_a_place_seen_before():
    """New landmarks all over the view change nothing, neither for it nor against it."""
    way = passed(*range(LONG_AGO + 1))
    old, new = spread(1500, seed=1), spread(3000, seed=2)
    found = np.concatenate([old, new])
    assert not knows(way, np.full(len(found), LONG_AGO), found)
    assert knows(way, np.repeat([0, LONG_AGO], [len(old), len(new)]), found)


@pytest.mark.parametrize(("part", "expected"), [(NEW - 0.1, True), (NEW + 0.1, False)])
def test_a_view_of_which_a_part_is_unexplained_shows_something_new(part, expected):
    way = passed(*range(LONG_AGO + 1))
    found = spread(1500, right=1.0 - part, seed=1)
    assert knows(way, all_of(0), found) is expected


def test_a_view_where_little_is_found_is_not_known():
    way = passed(*range(LONG_AGO + 1))
    assert not knows(way, np.zeros(20, np.int64))
    assert not knows(way, np.empty(0, np.int64))


def test_pixels_at_the_rim_are_pixels():
    way = passed(*range(LONG_AGO + 1))
    corners = np.array([[0.0, 0.0], [WIDTH - 0.01, 0.0], [WIDTH, 199.0]], np.float32)
    assert way.is_known(np.zeros(3, np.int64), corners, corners, WIDTH)
    elsewhere = np.concatenate([corners, [[0, 100], [WIDTH / 2, 100]]])
    assert not way.is_known(np.zeros(3, np.int64), corners, elsewhere, WIDTH)
    assert not way.is_known(np.zeros(3, np.int64), corners, np.empty((0, 2)), WIDTH)


@pytest.mark.parametrize("name", ["stereo", "rgbd"])
def test_a_map_that_is_continued_in_the_same_place_does_not_grow(name):
    loop = walk(small_loop(24), rounds=2)
    before = Slam(loop.rig, preset(name))
    made = [before.track(frame).is_keyframe for frame in loop.part(0, 24)]
    after = Slam(loop.rig, preset(name), map=Map.restored(before.map.dump()))
    again = [after.track(frame).is_keyframe for frame in loop.part(24, 48)]
    assert sum(again) == 0 < sum(made)
