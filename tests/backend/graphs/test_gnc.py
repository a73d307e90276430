"""Graduated non-convexity: the weights, the three stages, and what stops them."""

from dataclasses import replace

import numpy as np
import pytest

from graphworlds import DIM, EXP, INVERSE, with_landmarks, world
from loopworlds import passed_again
from odomap.backend.descent import SolverConfig
from odomap.backend.graphs.gnc import GncConfig, find_inliers, graduated_weights
from odomap.backend.graphs.posegraph import PoseGraph, Priors
from odomap.backend.graphs.solve import solve
from odomap.backend.graphs.subgraph import Subgraph
from odomap.errors import ConfigError
from odomap.simulation.loops import with_false_loops

each_group = pytest.mark.parametrize("group", DIM)


def test_weights_go_from_nearly_convex_to_truncated():
    gate, chi2 = 9.0, np.linspace(0.0, 100.0, 4000)
    truncated = graduated_weights(chi2, gate, 1e9)
    np.testing.assert_array_equal(truncated, chi2 <= gate)
    convex = graduated_weights(chi2, gate, gate / (2.0 * 100.0 - gate))
    assert convex.min() > 0.0  # the worst still has a vote
    for convexity in (0.01, 0.3, 2.0, 50.0):
        weights = graduated_weights(chi2, gate, convexity)
        assert weights[0] == 1.0
        assert (np.diff(weights) <= 0.0).all()
        assert np.abs(np.diff(weights)).max() < 0.1 * (1.0 + convexity)  # no jump
        # The minimiser of w r² + Φ(w), Φ = c² μ (1 - w) / (μ + w), by search.
        w = np.linspace(0.0, 1.0, 2001)
        for s in (0.5, 6.0, 9.5, 20.0):
            cost = w * s + gate * convexity * (1.0 - w) / (convexity + w)
            found = graduated_weights(np.array([s]), gate, convexity)[0]
            assert found == pytest.approx(w[np.argmin(cost)], abs=1e-3)


@each_group
@pytest.mark.parametrize("share", [0.1, 0.5])
def test_loops_that_nothing_else_confirms_are_judged_by_the_graph(group, share):
    """Loops between random nodes have no neighbours that agree."""
    graph, Ts = world(group, seed=2, count=60, loops=25)
    added, is_false = with_false_loops(graph.placed(Ts), round(share * 25), seed=5)
    found = find_inliers(added)
    np.testing.assert_array_equal(found.is_inlier, ~is_false)


@each_group
def test_without_noise_all_true_loops_stay(group):
    graph, Ts = world(group, noise=0.0, loops=12)
    added, is_false = with_false_loops(graph.placed(Ts), 6, seed=0)
    np.testing.assert_array_equal(find_inliers(added).is_inlier, ~is_false)


def test_a_false_loop_at_a_loose_end_is_found():
    """What hangs by odometry alone bends at little cost to each edge, at much to all together."""
    graph, Ts = passed_again("SE2", modest=50.0)
    loose = graph.without(graph.is_loop & (graph.second > 90))
    Z = INVERSE["SE2"](Ts[[10]]) @ Ts[[125]]
    Z[:, :2, 2] += 5.0
    added = replace(
        loose,
        first=np.append(loose.first, 10),
        second=np.append(loose.second, 125),
        Ts_first_second=np.concatenate([loose.Ts_first_second, Z]),
        information=np.concatenate([loose.information, loose.information[:1]]),
    )
    believed = solve(added)
    assert believed.chi2[-1] < 11.0  # its own residual would pass
    assert not find_inliers(added).is_inlier[-1]


def test_information_that_is_too_sure_throughout_is_no_reason_to_reject():
    graph, Ts = passed_again("SE2", modest=0.02)
    added, is_false = with_false_loops(graph.placed(Ts), 100, seed=1)
    found = find_inliers(added)
    assert not found.is_inlier[is_false].any()
    assert found.is_inlier[~is_false].mean() > 0.98
    assert found.variance == pytest.approx(50.0, rel=0.2)


def test_weights_scale_information_and_0_leaves_out():
    graph, Ts = passed_again("SE3")
    added, is_false = with_false_loops(graph.placed(Ts), 30, seed=1)
    rng = np.random.default_rng(0)
    factors = rng.uniform(0.5, 2.0, added.num_edges)
    scaled = replace(added, information=added.information / factors[:, None, None])
    np.testing.assert_array_equal(find_inliers(scaled, factors).is_inlier, ~is_false)
    factors[rng.choice(added.num_edges, 5, replace=False)] = 0.0
    assert not find_inliers(scaled, factors).is_inlier[factors == 0.0].any()


def test_priors_fixed_nodes_and_landmarks_are_trusted():
    graph, Ts = world("SE3", count=40, loops=20)
    graph, _ = with_landmarks(graph, Ts)
    nodes = np.array([0, 20])
    priors = Priors(nodes, Ts[nodes], graph.information[:2])
    graph = replace(graph, priors=priors, Ts_world_node=Ts, is_fixed=np.arange(40) == 7)
    added, is_false = with_false_loops(graph, 10, seed=4)
    found = find_inliers(added)
    np.testing.assert_array_equal(found.is_inlier, ~is_false)
    np.testing.assert_array_equal(found.Ts_world_node[7], Ts[7])


def test_two_drives_are_joined_by_true_loops_only():
    graph, Ts = passed_again("SE2")
    half = graph.num_nodes // 2
    ids = np.arange(graph.num_nodes) + 1000 * (np.arange(graph.num_nodes) >= half)
    graph = replace(graph, ids=ids)
    graph = graph.without((graph.first == half - 1) & (graph.second == half))
    added, is_false = with_false_loops(graph.placed(Ts), 100, seed=2)
    found = find_inliers(added)
    assert not found.is_inlier[is_false].any()
    assert found.is_inlier[~is_false].mean() > 0.98


def test_loops_between_parts_that_nothing_else_ties_stay():
    graph, _ = world("SE2", count=30, loops=1)
    ids = np.arange(30) + 100 * (np.arange(30) >= 15)
    graph = replace(graph, ids=ids)
    bridge = (graph.first == 14) & (graph.second == 15)
    assert graph.is_loop[bridge].all()
    assert find_inliers(graph).is_inlier.all()


def test_without_loops_or_without_odometry_there_is_an_answer():
    chain, _ = world("SE2", loops=0)
    assert find_inliers(chain).is_inlier.all()
    graph, _ = passed_again("SE2")
    loops_only = graph.without(~graph.is_loop)
    found = find_inliers(loops_only)
    assert np.isfinite(found.Ts_world_node).all()
    assert found.is_inlier.mean() > 0.9


def test_it_stops_when_asked_with_poses_that_are_finite():
    graph, Ts = passed_again("SE2")
    added, _ = with_false_loops(graph.placed(Ts), 100, seed=1)
    found = find_inliers(added, stop=lambda: True)
    assert found.rounds <= 2
    assert np.isfinite(found.Ts_world_node).all()


def test_few_rounds_and_a_fast_schedule_still_give_an_answer():
    graph, Ts = passed_again("SE2", noise=0.05)
    added, is_false = with_false_loops(graph.placed(Ts), 100, seed=1)
    for config in (GncConfig(rounds=1), GncConfig(growth=10.0)):
        found = find_inliers(added, config=config)
        assert not found.is_inlier[is_false].any()
        assert found.is_inlier[~is_false].mean() > 0.97


def test_the_same_graph_gives_the_same_bytes():
    graph, Ts = passed_again("SE3")
    added, _ = with_false_loops(graph.placed(Ts), 60, seed=1)
    one, other = find_inliers(added), find_inliers(added)
    assert one.Ts_world_node.tobytes() == other.Ts_world_node.tobytes()
    assert one.is_inlier.tobytes() == other.is_inlier.tobytes()


def streets(seed, num_false, poses=400, reach=10):
    """Return a random walk through streets whose odometry turns too unsurely to confirm a loop."""
    rng, at, ahead, seen = np.random.default_rng(seed), np.zeros(2), np.array([1.0, 0.0]), {}
    walk, pairs = [], []
    for pose in range(poses):
        place = tuple(at.tolist())
        pairs += [(seen[place], pose)] if place in seen else []
        seen[place] = pose
        turns = [ahead] * 3 + [ahead[::-1] * (-1, 1), ahead[::-1] * (1, -1)]
        turns = [way for way in turns if np.abs(at + way).max() <= reach]
        ahead = turns[rng.integers(len(turns))]
        walk.append((*at, np.arctan2(ahead[1], ahead[0])))
        at = at + ahead
    walk = np.array(walk)
    Ts = EXP["SE2"](walk * [0, 0, 1])
    Ts[:, :2, 2] = walk[:, :2]
    false = np.stack(
        [rng.integers(0, poses // 2, num_false), rng.integers(poses // 2, poses, num_false)]
    )
    steps = np.stack([np.arange(poses - 1), np.arange(1, poses)])
    first, second = np.concatenate([steps, np.array(pairs).T, false], axis=1)
    sigma = np.tile([0.05, 0.05, 0.03], (len(first), 1))
    sigma[: poses - 1, 2] = 0.1
    motion = INVERSE["SE2"](Ts[first]) @ Ts[second]
    is_false = np.arange(len(first)) >= len(first) - num_false
    motion[is_false] = np.eye(3)
    measured = motion @ EXP["SE2"](rng.normal(0.0, sigma))
    unknown = np.full_like(Ts, np.nan)
    return PoseGraph(
        "SE2", unknown, first, second, measured, np.eye(3) / sigma[:, None] ** 2
    ), is_false


@pytest.mark.parametrize(("seed", "num_false"), [(1, 20), (4, 40), (0, 80), (1, 80), (4, 80)])
def test_true_loops_left_out_at_first_come_in_when_the_graph_is_surer(seed, num_false):
    graph, is_false = streets(seed, num_false)
    is_true = graph.is_loop & ~is_false
    found = find_inliers(graph)
    assert found.is_inlier[is_true].mean() > 0.96
    assert found.is_inlier[is_false].sum() <= 1


def test_limits_of_the_config():
    with pytest.raises(ConfigError, match="quantile"):
        GncConfig(quantile=1.0)
    with pytest.raises(ConfigError, match="growth"):
        GncConfig(growth=1.0)
    with pytest.raises(ConfigError, match="least_variance"):
        GncConfig(least_variance=0.0)


@each_group
def test_covariances_of_edges_agree_with_each_other(group):
    """Of neighbours by selected inversion, of any by columns; bounds are above both."""
    graph, _ = world(group, count=20, loops=8, noise=0.05)
    subgraph, edges = Subgraph(graph), np.arange(graph.num_edges)
    now = subgraph.solve(np.ones(graph.num_edges), None, SolverConfig())
    one, other = subgraph.covariances(now, edges), subgraph.joint(now, edges)
    np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9 * np.abs(other).max())
    above = np.linalg.eigvalsh(subgraph.bounds(now, edges) - other)
    assert above.min() > -1e-9 * np.abs(other).max()


def test_the_cost_of_an_edge_is_what_its_removal_saves():
    from odomap.backend.graphs.gnc import _Search

    graph, _ = world("SE3", count=20, loops=8, noise=0.02)
    search = _Search(graph, GncConfig(), None)
    search._solve(np.ones(graph.num_edges), 50)
    loops = np.flatnonzero(graph.is_loop)[:4]
    config = SolverConfig(tolerance=1e-14)
    whole = solve(graph, config=config).cost_after
    for edge, cost in zip(loops, search._costs(loops), strict=True):
        rest = solve(graph.without(np.arange(graph.num_edges) == edge), config=config).cost_after
        assert cost == pytest.approx(2.0 * (whole - rest), rel=0.02)
