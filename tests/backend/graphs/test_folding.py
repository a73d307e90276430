"""Folding nodes out of a graph: what is left says what they said, and not more."""

import numpy as np
import pytest

from odomap.backend.graphs.covariances import GraphCovariances
from odomap.backend.graphs.folding import fold
from odomap.backend.graphs.posegraph import PoseGraph
from odomap.backend.graphs.solve import solve
from odomap.geometry.planar import planar_matrix
from odomap.geometry.se2 import se2_exp, se2_inverse


def walked(count, loops, seed=0):
    """Return a graph of a walk with loops, solved, whose measurements are off as they say."""
    rng = np.random.default_rng(seed)
    x = np.cumsum(rng.normal(0.0, [0.6, 0.6, 0.5], (count, 3)), axis=0)
    pairs = [(k, k + 1) for k in range(count - 1)] + list(loops)
    first, second = np.array(pairs).T
    sigma = rng.uniform(0.5, 2.0, (len(pairs), 3)) * [0.02, 0.03, 0.01]
    Ts = planar_matrix(x)
    measured = se2_inverse(Ts[first]) @ Ts[second] @ se2_exp(sigma * rng.normal(size=sigma.shape))
    information = np.array([np.diag(s**-2.0) for s in sigma])
    graph = PoseGraph("SE2", Ts, first, second, measured, information)
    return graph.placed(solve(graph, initial="given").Ts_world_node)


def as_graph(graph, folded, stay):
    """Return the graph of the nodes that stay."""
    row = np.full(graph.num_nodes, -1)
    row[stay] = np.arange(len(stay))
    ends = row[folded.first], row[folded.second]
    parts = folded.Ts_first_second, folded.information
    return PoseGraph("SE2", graph.Ts_world_node[stay], *ends, *parts)


def test_of_a_chain_the_ends_are_as_sure_as_they_were():
    graph = walked(9, [])
    is_gone = np.ones(9, bool)
    is_gone[[0, 8]] = False
    folded = fold(graph, is_gone)
    assert (folded.first.tolist(), folded.second.tolist()) == ([0], [8])
    whole = GraphCovariances(graph).relative(0, 8)
    np.testing.assert_allclose(np.linalg.inv(folded.information[0]), whole, rtol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_edges_are_the_marginals_and_poses_stay(seed):
    graph = walked(30, [(0, 12), (3, 20), (8, 29), (5, 25), (14, 28)], seed)
    stay = np.array([0, 3, 8, 17, 25, 29])
    is_gone = ~np.isin(np.arange(30), stay)
    folded = fold(graph, is_gone)
    assert len(folded.first) == len(stay) - 1
    assert not is_gone[np.r_[folded.first, folded.second]].any()
    whole = GraphCovariances(graph)
    for i, j, information in zip(folded.first, folded.second, folded.information):
        np.testing.assert_allclose(np.linalg.inv(information), whole.relative(i, j), rtol=1e-5)
    left = as_graph(graph, folded, stay)
    solved = solve(left, initial="given").Ts_world_node
    np.testing.assert_allclose(solved, left.Ts_world_node, atol=1e-7)


def test_what_is_far_apart_is_not_surer_than_it_was():
    for seed in range(5):
        graph = walked(40, [(0, 20), (10, 30), (5, 35), (15, 39)], seed)
        stay = np.arange(0, 40, 4)
        left = as_graph(graph, fold(graph, ~np.isin(np.arange(40), stay)), stay)
        before, after = GraphCovariances(graph), GraphCovariances(left)
        volumes = [
            np.linalg.slogdet(after.relative(i, j))[1]
            - np.linalg.slogdet(before.relative(4 * i, 4 * j))[1]
            for i in range(10)
            for j in range(i)
        ]
        assert np.mean(volumes) > -1e-6
        assert min(volumes) > -1.0


def test_what_others_measured_is_no_part_of_it():
    """Nodes where others pulled them: the edge says what was measured, not where they are."""
    graph = walked(5, [])
    pulled = graph.Ts_world_node.copy()
    pulled[4, 0, 2] += 0.5
    is_gone = np.array([False, True, True, True, False])
    one, other = fold(graph, is_gone), fold(graph.placed(pulled), is_gone)
    np.testing.assert_allclose(one.Ts_first_second, other.Ts_first_second, atol=1e-7)


def test_parts_stay_apart_and_of_one_node_nothing_is_left():
    steps = np.tile(np.eye(3), (4, 1, 1))
    information = np.tile(np.eye(3), (4, 1, 1))
    graph = PoseGraph(
        "SE2", np.tile(np.eye(3), (7, 1, 1)), [0, 1, 3, 5], [1, 2, 4, 6], steps, information
    )
    folded = fold(graph, np.array([False, True, False, True, True, False, True]))
    assert (folded.first.tolist(), folded.second.tolist()) == ([0], [2])
