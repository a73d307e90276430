"""Chains: what is near along measured steps, and which part landmarks alone tie."""

import numpy as np
import pytest

from odomap.maps.edges import LOOP
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.system.chains import STEPS, Chains, older_part


def path(count, parents=None):
    """Return a map of keyframes in a row, or below the parents given by id."""
    m = Map()
    for k in range(count):
        parent = (parents or {}).get(k, k - 1)
        m.add_keyframe(Keyframe(m.new_keyframe_id(), k), np.eye(4), parent=parent)
    return m


def test_what_is_near_is_counted_in_steps_both_ways():
    chains = Chains(path(200))
    assert chains.near(100) == set(range(100 - STEPS, 101 + STEPS))
    assert chains.near(0) == set(range(STEPS + 1))


def test_neighbours_all_along_lead_on_and_those_beyond_do_not():
    chains = Chains(path(200))
    steadily = range(40, 200, 20)
    assert chains.near(199, steadily) == set(range(40 - STEPS, 200))
    assert chains.near(199, [3, *range(160, 199)]) == set(range(160 - STEPS, 200))


def test_a_branch_is_as_near_as_where_it_leaves():
    chains = Chains(path(130, {100: 10}))  # after 99 the camera is tracked against 10
    near = chains.near(102)
    assert {10, 13, 10 + STEPS - 3} <= near
    assert not near & set(range(10 + STEPS - 2, 100))


def test_a_loop_makes_its_ends_neighbours():
    m = path(200)
    m.add_edge(5, 190, np.eye(4), np.eye(6), LOOP)
    near = Chains(m).near(195)
    assert {0, 5, 5 + STEPS - 6} <= near
    assert 5 + STEPS - 5 not in near


def test_a_culled_keyframe_leaves_those_it_tied_as_near():
    m = path(60)
    m.add_edge(5, 50, np.eye(4), np.eye(6), LOOP)
    m.cull_keyframes([50, 5, *range(20, 30)])
    near = Chains(m).near(59)
    assert {0, 4, 6, 19, 30} <= near


def test_nothing_was_measured_across_a_gap():
    m = path(20)
    m.begin_piece(10)
    assert Chains(m).near(12) == set(range(10, 20))


@pytest.mark.parametrize(
    ("neighbours", "older"),
    [([98, 97, 96], set()), ([98, 97, 3, 2], {2, 3}), ([3, 2], {2, 3}), ([], set())],
)
def test_the_part_that_holds_is_the_older_one(neighbours, older):
    near = Chains(path(100)).near(99, neighbours)
    found = older_part(near, neighbours)
    assert found == older


def test_it_holds_also_where_the_new_keyframe_hangs_from_it():
    neighbours = [3, 2, 98, 97]
    near = Chains(path(100, {99: 3})).near(99, neighbours)
    assert 98 not in near
    assert older_part(near, neighbours) == {2, 3}
