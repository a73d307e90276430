"""Growing pose graphs: as good as solving all of it, at a cost that does not grow."""

import threading

import numpy as np
import pytest

from odomap.backend.descent import SolverConfig
from odomap.backend.graphs.incremental import IncrementalConfig, IncrementalPoseGraph
from odomap.backend.graphs.solve import solve
from odomap.errors import ConfigError, InputError
from odomap.geometry.lie import (
    se2_exp,
    se2_inverse,
    se3_exp,
    se3_inverse,
    sim3_exp,
    sim3_inverse,
)
from odomap.geometry.robust import Loss

LIE = {
    "SE2": (3, se2_exp, se2_inverse),
    "SE3": (6, se3_exp, se3_inverse),
    "Sim3": (7, sim3_exp, sim3_inverse),
}
STEP = se2_exp([1.0, 0.0, 0.1])


def walk(group, rng, nodes, reach=3.0, noise=0.02):
    """Return truth (N, m, m) of a walk that meets itself, and its edges (i, j, measured)."""
    k, exp, inverse = LIE[group]
    turn = {3: 2}.get(k, 5)
    truth = [np.eye(4 if k > 3 else 3)]
    for _ in range(nodes - 1):
        xi = np.zeros(k)
        xi[0], xi[turn] = 1.0, rng.choice([0.0, 0.0, np.pi / 2, -np.pi / 2])
        truth.append(truth[-1] @ exp(xi * [1.0] + 0.02 * rng.normal(size=k)))
        if np.linalg.norm(truth[-1][:-1, -1]) > 6.0:  # stay near: turn around
            xi[turn] = np.pi
            truth[-1] = truth[-1] @ exp(xi)
    truth = np.array(truth)
    edges = []
    for j in range(1, nodes):
        away = np.linalg.norm(truth[: max(j - 5, 0), :-1, -1] - truth[j, :-1, -1], axis=1)
        near = np.flatnonzero(away < reach)
        for i in [j - 1, *rng.permutation(near)[:1].tolist()]:
            error = exp(noise * rng.normal(size=k))
            edges.append((i, j, inverse(truth[i]) @ truth[j] @ error))
    return truth, edges


def grow(graph, edges, information, check=0):
    """Add nodes and edges one by one; return scopes, and cost over the batch's now and then."""
    scopes, ratios = [], []
    graph.add_node()
    at = 0
    while at < len(edges):
        j = graph.add_node()
        while at < len(edges) and edges[at][1] == j:
            graph.add_edge(*edges[at], information)
            at += 1
        scopes.append(graph.update().scope)
        if check and j % check == 0:
            now = graph.graph()
            least = min(solve(now).cost_after, solve(now, initial="given").cost_after)
            ratios.append(graph.cost / least)
    return scopes, ratios


@pytest.mark.parametrize("group", LIE)
def test_as_good_as_solving_all_of_it(group):
    rng = np.random.default_rng(1)
    k = LIE[group][0]
    _, edges = walk(group, rng, 240 if k < 7 else 80)
    graph = IncrementalPoseGraph(group)
    scopes, ratios = grow(graph, edges, np.eye(k) / 0.02**2, check=40)
    assert max(ratios) < 1.01
    assert min(ratios) > 1.0 - 1e-9
    assert scopes.count("window") > scopes.count("whole")
    assert graph.cost == pytest.approx(exact_cost(graph.graph(), k), rel=1e-9)


def exact_cost(graph, k):
    """Return the cost at a graph's poses."""
    return solve(graph, initial="given", config=SolverConfig(iterations=0)).cost_before


def test_what_is_not_news_costs_the_same_in_a_large_graph():
    graph = IncrementalPoseGraph("SE2")
    graph.add_node()
    for j in range(1, 400):
        assert graph.add_node() == j
        graph.add_edge(j - 1, j, STEP, np.eye(3))
        record = graph.update()
        assert (record.scope, record.moved.tolist(), record.cost) == ("placed", [j], 0.0)
    np.testing.assert_allclose(graph.T_world_node(10), np.linalg.matrix_power(STEP, 10), atol=1e-12)
    rng, scopes = np.random.default_rng(2), []
    for j in range(400, 500):
        graph.add_node()
        for back in (1, 2, 3):
            Z = np.linalg.matrix_power(STEP, back) @ se2_exp(1e-2 * rng.normal(size=3))
            graph.add_edge(j - back, j, Z, 1e4 * np.eye(3))
        record = graph.update()
        scopes.append(record.scope)
        if record.scope == "window":
            assert len(record.moved) <= 31
    assert (
        scopes[50:].count("whole") < 15
    )  # and ever fewer: each time the cost grew by some percent
    least = solve(graph.graph(), initial="given").cost_after
    assert graph.cost / least < 1.01


def test_the_same_again():
    _, edges = walk("SE3", np.random.default_rng(3), 60)
    twice = []
    for _ in range(2):
        graph = IncrementalPoseGraph("SE3")
        grow(graph, edges, np.eye(6))
        twice.append(graph.Ts_world_node.tobytes())
    assert twice[0] == twice[1]


def test_many_additions_at_once():
    _, edges = walk("SE2", np.random.default_rng(4), 150)
    graph = IncrementalPoseGraph("SE2")
    for _ in range(150):
        graph.add_node()
    for edge in reversed(edges):  # none of them can be placed before the last
        graph.add_edge(*edge, np.eye(3) / 0.02**2)
    record = graph.update()
    assert (record.scope, record.converged) == ("whole", True)
    assert len(record.moved) == 150
    assert graph.cost == pytest.approx(solve(graph.graph()).cost_after, rel=0.01)
    assert graph.update().scope == "none"


def test_a_false_loop_under_a_loss():
    truth, edges = walk("SE2", np.random.default_rng(5), 120)
    graph = IncrementalPoseGraph("SE2", loss=Loss("geman_mcclure", 3.0))
    edges.append((10, 119, np.eye(3)))
    edges.insert(0, edges.pop(0))
    grow(graph, sorted(edges, key=lambda edge: edge[1]), np.eye(3) / 0.02**2)
    away = np.linalg.norm(graph.Ts_world_node[:, :2, 2] - truth[:, :2, 2], axis=1)
    assert away.max() < 0.2


def ring_with_chords(nodes, rng):
    """Return steps of a ring, and loops across its gap, measured with noise."""
    xi = np.array([1.0, 0.0, 2 * np.pi / nodes])
    truth = np.array([se2_exp(i * xi) for i in range(nodes)])

    def measured(i, j):
        error = se2_exp(0.05 * np.array([1.0, 1.0, 0.3]) * rng.normal(size=3))
        return i, j, se2_inverse(truth[i]) @ truth[j] @ error

    return [measured(i - 1, i) for i in range(1, nodes)], [
        measured(nodes - 1 - i, i) for i in range(8)
    ]


@pytest.mark.parametrize("name", ["tukey", "truncated", "geman_mcclure", "dcs", "cauchy"])
def test_loops_that_a_loss_lets_go_of_are_won_back_when_others_confirm_them(name):
    rng = np.random.default_rng(0)
    steps, loops = ring_with_chords(60, rng)
    information = np.diag([100.0, 100.0, 400.0])
    graph = IncrementalPoseGraph("SE2", loss=Loss(name))
    for i in range(60):
        graph.add_node()
        if i:
            graph.add_edge(*steps[i - 1], information)
            graph.update()
    false = (30, 10, np.eye(3)), (45, 20, STEP), (50, 5, STEP)
    for loop in (false[0], *loops[:4], false[1], *loops[4:], false[2]):
        graph.add_edge(*loop, information)
        assert graph.update().converged
    batch = solve(graph.graph(), loss=Loss(name))
    assert graph.cost == pytest.approx(batch.cost_after, rel=0.01)
    now = graph.graph()
    residuals = solve(now, loss=Loss(name), initial="given", config=SolverConfig(iterations=0))
    is_false = np.isin(np.arange(now.num_edges), [59, 64, 69])
    np.testing.assert_array_equal(residuals.is_rejected, is_false)


def test_a_false_loop_alone_is_let_go():
    rng = np.random.default_rng(1)
    steps, _ = ring_with_chords(60, rng)
    graph = IncrementalPoseGraph("SE2", loss=Loss("tukey"))
    for i in range(60):
        graph.add_node()
        if i:
            graph.add_edge(*steps[i - 1], 100.0 * np.eye(3))
    graph.update()
    before = graph.Ts_world_node
    graph.add_edge(30, 10, np.eye(3), 100.0 * np.eye(3))
    assert graph.update().scope == "whole"  # a window alone cannot tell
    np.testing.assert_allclose(graph.Ts_world_node, before, atol=1e-6)


def test_parts_come_together_as_wholes():
    graph = IncrementalPoseGraph("SE2")
    for start in (0, 10):
        for i in range(start, start + 4):
            graph.add_node(None if i != 10 else se2_exp([50.0, 9.0, 1.0]), node=i)
            if i > start:
                graph.add_edge(i - 1, i, STEP, np.eye(3))
    assert graph.update().scope == "placed"
    np.testing.assert_allclose(graph.T_world_node(10), se2_exp([50.0, 9.0, 1.0]))
    graph.add_edge(12, 3, STEP, np.eye(3))
    record = graph.update()
    assert (record.scope, record.moved.tolist()) == ("placed", [10, 11, 12, 13])
    chain = [graph.T_world_node(i) for i in (2, 3, 12)]
    np.testing.assert_allclose(chain[2] @ STEP, chain[1], atol=1e-12)
    assert solve(graph.graph(), initial="given").cost_before == pytest.approx(0.0, abs=1e-20)


def test_a_prior_places_a_part_and_a_second_one_pulls():
    graph = IncrementalPoseGraph("SE2")
    for i in range(4):
        graph.add_node()
        if i:
            graph.add_edge(i - 1, i, STEP, np.eye(3))
    there = se2_exp([5.0, 6.0, 0.7])
    graph.add_prior(2, there, np.eye(3))
    record = graph.update()
    assert (record.scope, record.cost) == ("placed", 0.0)
    assert record.moved.tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(graph.T_world_node(3), there @ STEP, atol=1e-12)
    graph.add_prior(3, there @ STEP @ se2_exp([0.5, 0.0, 0.0]), np.eye(3))
    assert graph.update().converged
    assert graph.cost == pytest.approx(solve(graph.graph(), initial="given").cost_after, rel=0.01)
    assert 0.0 < graph.cost < 0.125  # 0.5 m, shared by three measurements
    assert len(graph.graph().priors.node) == 2


def test_fixed_nodes_stay():
    graph = IncrementalPoseGraph("SE2")
    ends = np.eye(3), se2_exp([2.2, 0.1, 0.0])
    graph.add_node(ends[0], is_fixed=True)
    graph.add_node()
    graph.add_node(ends[1], is_fixed=True)
    step = se2_exp([1.0, 0.0, 0.0])
    graph.add_edge(0, 1, step, np.eye(3))
    graph.add_edge(1, 2, step, np.eye(3))
    graph.add_edge(0, 2, step @ step, np.eye(3))
    record = graph.update()
    assert record.converged
    np.testing.assert_array_equal(graph.T_world_node(2), ends[1])
    assert graph.cost == pytest.approx(solve(graph.graph(), initial="given").cost_after, rel=0.01)


def test_measurements_between_fixed_nodes_cost_what_they_cost():
    graph = IncrementalPoseGraph("SE2")
    for i in range(2):
        graph.add_node(se2_exp([2.0 * i, 0.0, 0.0]), is_fixed=True)
    graph.add_edge(0, 1, np.eye(3), np.eye(3))
    assert graph.update().converged
    assert graph.cost == pytest.approx(2.0)
    graph.add_prior(1, np.eye(3), np.eye(3))
    assert graph.update().converged
    assert graph.cost == pytest.approx(4.0)


def test_a_stopped_update_goes_on_at_the_next():
    _, edges = walk("SE2", np.random.default_rng(6), 80)
    graph = IncrementalPoseGraph("SE2")
    for _ in range(80):
        graph.add_node()
    for edge in edges:
        graph.add_edge(*edge, np.eye(3) / 0.02**2)
    stop = threading.Event()
    stop.set()
    record = graph.update(stop)
    assert (record.converged, record.reason) == (False, "stopped on request")
    stop.clear()
    assert graph.update(stop).converged
    assert graph.cost == pytest.approx(solve(graph.graph()).cost_after, rel=0.01)


def nodes(count):
    graph = IncrementalPoseGraph("SE2")
    for i in range(count):
        graph.add_node()
        if i:
            graph.add_edge(i - 1, i, STEP, np.eye(3))
    graph.update()
    return graph


NAN, INDEFINITE = np.full((3, 3), np.nan), np.diag([1.0, 1.0, -1.0])


@pytest.mark.parametrize(
    ("add", "message"),
    [
        (lambda g: g.add_node(node=1), "node 1 is there already"),
        (lambda g: g.add_node(NAN), "node 3: a value is not finite"),
        (lambda g: g.add_node(np.diag([2.0, 2.0, 1.0])), "node 3: not a rotation"),
        (lambda g: g.add_node(np.eye(4)), "shape"),
        (lambda g: g.add_node(is_fixed=True), "node 3 is to be held"),
        (lambda g: g.add_node(node=1.5), "whole number"),
        (lambda g: g.add_node(node=2**63), "node 9223372036854775808: an id has 64 bits"),
        (lambda g: g.add_edge(0, 7, STEP, np.eye(3)), "node 7 is unknown"),
        (lambda g: g.add_edge(1, 1, STEP, np.eye(3)), "tied to itself"),
        (lambda g: g.add_edge(0, 2, NAN, np.eye(3)), "0 to 2.*not finite"),
        (lambda g: g.add_edge(0, 2, STEP, INDEFINITE), "0 to 2.*indefinite"),
        (lambda g: g.add_edge(0, 2, STEP, NAN), "0 to 2.*not finite"),
        (lambda g: g.add_edge(0, 2, np.eye(4), np.eye(3)), "shape"),
        (lambda g: g.add_prior(7, STEP, np.eye(3)), "node 7 is unknown"),
        (lambda g: g.add_prior(0, STEP, INDEFINITE), "indefinite"),
        (lambda g: g.T_world_node("x"), "node x is unknown"),
    ],
)
def test_bad_input_is_refused_and_changes_nothing(add, message):
    graph = nodes(3)
    before = graph.graph()
    with pytest.raises(InputError, match=message) as caught:
        add(graph)
    assert "\n" not in str(caught.value)
    after = graph.graph()
    for name in ("Ts_world_node", "first", "second", "Ts_first_second", "information", "ids"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    assert graph.update().scope == "none"
    graph.add_edge(2, graph.add_node(), STEP, np.eye(3))
    assert graph.update().scope == "placed"


def test_after_the_largest_id_the_next_one_must_be_given():
    graph = nodes(3)
    graph.add_edge(2, graph.add_node(node=2**63 - 1), STEP, np.eye(3))
    with pytest.raises(InputError, match="give a smaller one"):
        graph.add_node()
    assert graph.num_nodes == len(graph.ids) == len(graph.Ts_world_node) == 4
    graph.add_edge(2, graph.add_node(node=3), STEP, np.eye(3))
    assert graph.update().scope == "placed"
    assert solve(graph.graph()).num_components == 1


def test_a_node_without_a_place_is_named_and_can_be_mended():
    graph = nodes(3)
    graph.add_node(node=40)
    graph.add_node(node=41)
    graph.add_edge(40, 41, STEP, np.eye(3))
    with pytest.raises(InputError, match="node 40 is nowhere"):
        graph.update()
    graph.add_edge(2, 40, STEP, np.eye(3))
    assert graph.update().moved.tolist() == [40, 41]
    np.testing.assert_allclose(graph.T_world_node(41), np.linalg.matrix_power(STEP, 4), atol=1e-12)


def test_unknown_group_and_settings():
    with pytest.raises(InputError, match="group 'SO3' is unknown"):
        IncrementalPoseGraph("SO3")
    with pytest.raises(ConfigError, match="window"):
        IncrementalConfig(window=0)
