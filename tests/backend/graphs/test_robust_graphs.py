"""Maps with false loops: a grid, a sphere and a ring, by graduated non-convexity and by losses."""

import threading

import numpy as np
import pytest

from graphworlds import DIM
from loopworlds import passed_again
from odomap.backend.graphs.gnc import GncConfig
from odomap.backend.graphs.solve import solve
from odomap.errors import InputError
from odomap.geometry.robust import Loss
from odomap.simulation.loops import with_false_loops

each_group = pytest.mark.parametrize("group", DIM)


def wide(name, group):
    """Return a loss that is to an edge of k numbers what its default is to one number."""
    return Loss(name, Loss(name).c * DIM[group] ** 0.5)


def off(solution, reference):
    """Return how far positions are from those of another solution at most."""
    return np.abs(solution.graph.positions - reference.graph.positions).max()


@each_group
@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_false_loops_are_named_and_the_map_is_as_without_them(group, share):
    graph, _ = passed_again(group)
    clean = solve(graph)
    count = round(share * graph.is_loop.sum())
    added, is_false = with_false_loops(clean.graph, count, seed=int(10 * share))
    solution = solve(added, robust="gnc")
    assert solution.converged
    assert solution.initial == "gnc"
    assert solution.is_rejected[is_false].all()
    # One true loop in a hundred is beyond the gate of 0.99.
    assert solution.is_rejected[~is_false].sum() <= 0.03 * graph.is_loop.sum()
    assert not solution.is_rejected[~added.is_loop].any()
    assert off(solution, clean) < 0.03
    assert (solution.chi2[is_false] > 100.0).all()


@pytest.mark.parametrize("group", ["SE2", "SE3"])
def test_the_chordal_cost_is_freed_of_them_too(group):
    graph, _ = passed_again(group)
    clean = solve(graph, cost="chordal")
    added, is_false = with_false_loops(clean.graph, 60, seed=0)
    solution = solve(added, cost="chordal", robust=GncConfig(quantile=0.9999))
    np.testing.assert_array_equal(solution.is_rejected, is_false)
    assert solution.cost_after == pytest.approx(clean.cost_after, rel=1e-9)


def test_a_graph_of_true_loops_is_solved_as_ever():
    graph, _ = passed_again("SE3")
    one, other = solve(graph), solve(graph, robust=GncConfig(quantile=0.999999))
    assert not other.is_rejected.any()
    assert off(one, other) < 1e-6


@each_group
@pytest.mark.parametrize("name", ["geman_mcclure", "tukey", "truncated", "dcs"])
def test_losses_that_let_go_bear_many_false_loops(group, name):
    graph, _ = passed_again(group)
    clean = solve(graph)
    added, is_false = with_false_loops(clean.graph, round(0.5 * graph.is_loop.sum()), seed=2)
    solution = solve(added, loss=wide(name, group))
    assert off(solution, clean) < 0.05
    assert solution.is_rejected[is_false].all()


@pytest.mark.parametrize("group", ["SE2", "SE3"])
@pytest.mark.parametrize("name", ["huber", "cauchy"])
def test_losses_that_hold_on_bear_a_few(group, name):
    graph, _ = passed_again(group)
    clean = solve(graph)
    added, is_false = with_false_loops(clean.graph, 3, seed=2)
    solution = solve(added, loss=wide(name, group))
    assert off(solution, clean) < 0.2 * off(solve(added), clean)
    assert (solution.weights[is_false] < 0.1).all()


def test_the_start_of_a_loss_follows_no_false_loops():
    graph, _ = passed_again("SE2")
    clean = solve(graph)
    added, _ = with_false_loops(clean.graph, 150, seed=0)
    loss = Loss("tukey")
    wrong = added.placed(np.full_like(added.Ts_world_node, np.nan))
    assert solve(wrong, loss=loss).initial == "chordal"
    assert off(solve(wrong, loss=loss), clean) < 0.1


def test_a_stop_flag_ends_it_early():
    graph, _ = passed_again("SE2")
    flag = threading.Event()
    flag.set()
    solution = solve(graph, robust="gnc", stop=flag)
    assert solution.reason == "stopped on request"
    assert np.isfinite(solution.Ts_world_node).all()


def test_what_cannot_be_asked_together():
    graph, _ = passed_again("SE2")
    with pytest.raises(InputError, match="robust 'ransac' is unknown"):
        solve(graph, robust="ransac")
    with pytest.raises(InputError, match="not both"):
        solve(graph, robust="gnc", loss=Loss("huber"))
