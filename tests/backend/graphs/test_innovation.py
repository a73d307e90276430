"""By how much a new edge raises the least cost: against solving with and without it."""

from dataclasses import replace

import numpy as np
import pytest

from odomap.backend.graphs.graphproblem import GraphProblem
from odomap.backend.graphs.innovation import least_rise
from odomap.backend.graphs.posegraph import PoseGraph
from odomap.backend.graphs.solve import solve
from odomap.geometry.lie import se2_exp, se2_inverse
from odomap.geometry.robust import Loss


def ladder(rng, nodes=12, noise=0.02):
    """Return a solved graph in the plane whose nodes see three others each."""
    truth = [np.eye(3)]
    for _ in range(nodes - 1):
        truth.append(truth[-1] @ se2_exp([1.0, 0.0, 0.3 * rng.normal()]))
    truth = np.array(truth)
    pairs = [(i, i + s) for s in (1, 2, 3) for i in range(nodes - s)]
    first, second = np.array(pairs).T
    errors = se2_exp(noise * rng.normal(size=(len(first), 3)))
    measured = se2_inverse(truth[first]) @ truth[second] @ errors
    information = np.tile(np.eye(3) / noise**2, (len(first), 1, 1))
    return solve(PoseGraph("SE2", truth, first, second, measured, information))


def with_edge(graph, i, j, shift):
    """Return the graph with an edge more, which says something else than its poses."""
    measured = se2_inverse(graph.Ts_world_node[i]) @ graph.Ts_world_node[j] @ se2_exp(shift)
    return replace(
        graph,
        first=np.append(graph.first, i),
        second=np.append(graph.second, j),
        Ts_first_second=np.concatenate([graph.Ts_first_second, measured[None]]),
        information=np.concatenate([graph.information, graph.information[:1]]),
    )


def rise(graph, keep=None):
    """Return the rise by the last edge, seen from the nodes that are kept."""
    if keep is not None:
        inside = np.isin(graph.first, keep) & np.isin(graph.second, keep)
        number = np.full(graph.num_nodes, -1)
        number[keep] = np.arange(len(keep))
        graph = replace(
            graph,
            Ts_world_node=graph.Ts_world_node[keep],
            ids=None,
            is_fixed=None,
            first=number[graph.first[inside]],
            second=number[graph.second[inside]],
            Ts_first_second=graph.Ts_first_second[inside],
            information=graph.information[inside],
        )
    held, e = np.arange(graph.num_nodes) == 0, graph.num_edges
    problem = GraphProblem(graph, held, False, Loss(), np.zeros(e, bool), np.ones(e))
    problem.analyse()
    return least_rise(problem, np.arange(e) == e - 1)


@pytest.mark.parametrize("seed", range(4))
def test_the_whole_graph_knows_it_exactly(seed):
    rng = np.random.default_rng(seed)
    solution = ladder(rng)
    graph = with_edge(solution.graph, 2, 9, 0.02 * rng.normal(size=3))
    want = solve(graph, initial="given").cost_after - solution.cost_after
    assert want > 0.01
    assert rise(graph) == pytest.approx(want, rel=0.03)


@pytest.mark.parametrize("seed", range(4))
def test_a_part_never_says_more(seed):
    rng = np.random.default_rng(10 + seed)
    graph = with_edge(ladder(rng).graph, 4, 6, 0.02 * rng.normal(size=3))
    said = [rise(graph, np.arange(4 - n, 7 + n)) for n in range(4)]
    assert said[0] > 0.0
    assert (np.diff([*said, rise(graph)]) > -1e-9).all()
    assert said[3] > 0.9 * rise(graph)  # what is near decides


def test_two_pieces_say_nothing():
    rng = np.random.default_rng(20)
    graph = with_edge(ladder(rng).graph, 1, 10, [0.3, 0.1, 0.02])
    assert rise(graph, np.array([0, 1, 2, 9, 10, 11])) == pytest.approx(0.0, abs=1e-6)
    assert rise(graph) > 0.1
