"""False loops are false, look like true ones, and come again with the seed."""

import numpy as np
import pytest

from graphworlds import DIM, world
from odomap.errors import InputError
from odomap.simulation.loops import with_false_loops


@pytest.mark.parametrize("group", DIM)
def test_false_loops_tie_what_does_not_follow_and_claim_what_true_ones_do(group):
    graph, Ts = world(group)
    added, is_false = with_false_loops(graph.placed(Ts), 40, seed=1)
    assert added.num_edges == graph.num_edges + 40
    np.testing.assert_array_equal(np.flatnonzero(is_false), graph.num_edges + np.arange(40))
    assert added.is_loop[is_false].all()
    size = np.ptp(Ts[:, : graph.space, -1], axis=0)
    moved = added.Ts_first_second[is_false][:, : graph.space, -1]
    assert (np.linalg.norm(moved, axis=1) <= np.linalg.norm(size)).all()
    np.testing.assert_array_equal(added.Ts_first_second[~is_false], graph.Ts_first_second)
    again, _ = with_false_loops(graph.placed(Ts), 40, seed=1)
    assert again.Ts_first_second.tobytes() == added.Ts_first_second.tobytes()
    other, _ = with_false_loops(graph.placed(Ts), 40, seed=2)
    assert not np.array_equal(other.first, added.first)


def test_none_may_be_asked_for():
    graph, Ts = world("SE2")
    assert with_false_loops(graph.placed(Ts), 0, seed=0)[0].num_edges == graph.num_edges


def test_a_graph_that_is_not_solved_or_has_no_loops_is_refused():
    graph, Ts = world("SE2")
    with pytest.raises(InputError, match="at its solution"):
        with_false_loops(graph, 1, seed=0)
    chain, Ts = world("SE2", loops=0)
    with pytest.raises(InputError, match="give a graph with loops"):
        with_false_loops(chain.placed(Ts), 1, seed=0)
