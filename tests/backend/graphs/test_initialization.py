"""Starts: exact without noise, near the optimum with it, and whole in every gauge."""

from dataclasses import replace

import numpy as np
import pytest

from graphworlds import DIM, EXP, INVERSE, LOG, with_landmarks, world
from odomap.backend.graphs.chordal import chordal_cost
from odomap.backend.graphs.initialization import chordal, place_landmarks, spanning_tree
from odomap.backend.graphs.posegraph import PoseGraph, Priors, Sights
from odomap.backend.graphs.solve import solve
from odomap.backend.sparse.blockcholesky import BlockCholesky
from odomap.backend.sparse.blocks import BlockPattern
from odomap.errors import InputError

each_group = pytest.mark.parametrize("group", DIM)
each_rigid = pytest.mark.parametrize("group", ["SE2", "SE3"])
each_start = pytest.mark.parametrize("start", [spanning_tree, chordal])


def distances(group, Ts, truth, part=slice(None)):
    """Return how far poses are from the truth, as lengths of (a part of) tangents."""
    return np.linalg.norm(LOG[group](INVERSE[group](truth) @ Ts)[:, part], axis=1)


@each_group
@each_start
def test_without_noise_the_truth_is_found(group, start):
    graph, truth = world(group, noise=0.0)
    assert distances(group, start(graph), truth).max() < 1e-9


@each_group
@each_start
def test_edges_may_point_either_way_and_come_twice(group, start):
    graph, truth = world(group, noise=0.0)
    flip = np.arange(graph.num_edges) % 3 == 0
    Zs = graph.Ts_first_second.copy()
    Zs[flip] = INVERSE[group](Zs[flip])
    first, second = graph.first, graph.second
    graph = PoseGraph(
        group,
        graph.Ts_world_node,
        np.concatenate([np.where(flip, second, first), second]),
        np.concatenate([np.where(flip, first, second), first]),
        np.concatenate([Zs, INVERSE[group](graph.Ts_first_second)]),
        np.tile(graph.information, (2, 1, 1)),
    )
    assert distances(group, start(graph), truth).max() < 1e-9


@each_group
@each_start
def test_fixed_nodes_stay_and_all_hangs_from_them(group, start):
    graph, truth = world(group, noise=0.0)
    moved = EXP[group](np.linspace(-0.5, 0.9, graph.dim)) @ truth
    fixed = np.isin(np.arange(30), [4, 17])
    known = np.where(fixed[:, None, None], moved, np.nan)
    found = start(replace(graph, Ts_world_node=known, is_fixed=fixed))
    np.testing.assert_array_equal(found[fixed], moved[fixed])
    assert distances(group, found, moved).max() < 1e-9


@each_group
@each_start
def test_the_anchor_keeps_the_pose_it_has(group, start):
    graph, truth = world(group, noise=0.0)
    moved = EXP[group](np.linspace(-0.5, 0.9, graph.dim)) @ truth
    found = start(graph.placed(moved))
    assert distances(group, found, moved).max() < 1e-9


@each_group
@each_start
def test_priors_place_the_whole(group, start):
    graph, truth = world(group, noise=0.0)
    moved = EXP[group](np.linspace(-0.5, 0.9, graph.dim)) @ truth
    nodes = [3, 20]
    priors = Priors(nodes, moved[nodes], np.tile(np.eye(graph.dim), (2, 1, 1)))
    found = start(replace(graph, priors=priors))
    assert distances(group, found, moved).max() < 1e-9


@each_group
@each_start
def test_components_are_placed_one_by_one(group, start):
    graph, truth = world(group, noise=0.0, loops=0)
    found = start(graph.without(np.arange(29) == 11))
    assert np.isfinite(found).all()
    assert distances(group, found[:12], truth[:12]).max() < 1e-9
    np.testing.assert_allclose(found[12], np.eye(graph.space + 1), atol=1e-15)
    relative = INVERSE[group](truth[12])[None] @ truth[12:]
    assert distances(group, found[12:], relative).max() < 1e-9


@each_group
@each_start
def test_edges_of_no_weight_are_left_out(group, start):
    graph, truth = world(group, noise=0.0)
    Zs = graph.Ts_first_second.copy()
    is_false = np.arange(graph.num_edges) > 40
    Zs[is_false] = EXP[group](np.ones(graph.dim))
    found = start(replace(graph, Ts_first_second=Zs), weights=(~is_false).astype(float))
    assert distances(group, found, truth).max() < 1e-9


@each_rigid
def test_rotations_of_chordal_are_near_the_best_and_better_than_a_trees(group):
    graph, _ = world(group, count=200, loops=150, noise=0.05)
    best = solve(graph, cost="chordal").Ts_world_node
    d = graph.space
    relaxed, tree = (
        distances(group, start(graph), best, slice(d, graph.dim))
        for start in (chordal, spanning_tree)
    )
    assert relaxed.max() < 0.25
    assert tree.max() > 1.5 * relaxed.max()
    costs = [chordal_cost(graph.placed(start(graph))) for start in (chordal, spanning_tree)]
    assert costs[0] < 0.2 * costs[1]


@each_group
def test_chordal_does_not_depend_on_the_order_of_elimination(group):
    graph, _ = world(group, noise=0.05)
    pattern = BlockPattern.of(np.ones(30, int), graph.first, graph.second)
    factor = BlockCholesky(pattern, np.random.default_rng(0).permutation(30))
    np.testing.assert_allclose(chordal(graph, factor), chordal(graph), atol=1e-9)


@each_start
def test_all_is_whole_where_information_is_singular(start):
    graph, _ = world("SE3", noise=0.0)
    information = graph.information.copy()
    information[::2, 3:, 3:] = 0.0
    information[1::2, :3, :3] = 0.0
    information[5] = 0.0
    found = start(replace(graph, information=information))
    assert np.isfinite(found).all()
    R = found[:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (30, 1, 1)), atol=1e-12)


def test_the_tree_is_shallow_and_prefers_odometry_then_information():
    T = np.tile(np.eye(3), (5, 1, 1))
    T[:, 0, 2] = np.arange(1.0, 6.0)  # each edge has a length of its own
    graph = PoseGraph(
        "SE2",
        np.full((4, 3, 3), np.nan),
        [0, 0, 0, 1, 0],
        [1, 1, 3, 2, 2],
        T,
        np.array([1.0, 9.0, 1.0, 1.0, 1.0])[:, None, None] * np.eye(3),
    )
    x = spanning_tree(graph)[:, 0, 2]
    # 1 by the heavier of two edges, 3 and 2 straight from 0 although 1 → 2 is odometry.
    np.testing.assert_allclose(x, [0.0, 2.0, 5.0, 3.0])
    # From 0 and 2, both of depth 1, to 3: the odometry 2 → 3 goes before the heavier 1 → 3.
    graph = PoseGraph(
        "SE2",
        np.full((4, 3, 3), np.nan),
        [0, 0, 1, 2],
        [1, 2, 3, 3],
        T[:4],
        np.array([1.0, 1.0, 9.0, 1.0])[:, None, None] * np.eye(3),
    )
    np.testing.assert_allclose(spanning_tree(graph)[:, 0, 2], [0.0, 1.0, 2.0, 6.0])


def test_long_chains_stay_rotations():
    n = 5000
    step = EXP["SE3"](np.array([0.1, 0.0, 0.0, 0.01, 0.02, 0.03]))
    step[:3, :3] *= 1.0 + 1e-6  # as files round
    information = np.tile(np.eye(6), (n - 1, 1, 1))
    graph = PoseGraph(
        "SE3",
        np.full((n, 4, 4), np.nan),
        np.arange(n - 1),
        np.arange(1, n),
        np.tile(step, (n - 1, 1, 1)),
        information,
    )
    for Ts in (spanning_tree(graph), chordal(graph)):
        R = Ts[:, :3, :3]
        assert np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max() < 1e-12


@each_group
def test_landmarks_go_where_they_were_seen(group):
    graph, truth = world(group, noise=0.0)
    graph, points = with_landmarks(graph, truth, noise=0.0)
    np.testing.assert_allclose(place_landmarks(graph, truth), points, atol=1e-9)
    np.testing.assert_allclose(place_landmarks(graph, chordal(graph)), points, atol=1e-7)


def test_a_landmark_never_seen_stays_or_is_named():
    graph, Ts = world("SE2", count=3, loops=0)
    none = np.zeros(0, np.int64)
    lonely = Sights([[1.0, 2.0]], [77], none, none, np.zeros((0, 2)), np.zeros((0, 2, 2)))
    np.testing.assert_array_equal(place_landmarks(replace(graph, points=lonely), Ts), [[1.0, 2.0]])
    lonely = replace(lonely, points_world=[[np.nan, 2.0]])
    with pytest.raises(InputError, match="landmark 77"):
        place_landmarks(replace(graph, points=lonely), Ts)


@each_start
@pytest.mark.parametrize("weights", [[1.0], np.full(54, -1.0), np.full(54, np.nan)])
def test_weights_that_do_not_fit(start, weights):
    graph, _ = world("SE2")
    with pytest.raises(InputError, match="weights"):
        start(graph, weights=weights)


@each_start
def test_the_same_bytes_twice(start):
    graph, _ = world("SE3", noise=0.1)
    assert start(graph).tobytes() == start(graph).tobytes()


@each_start
def test_no_edges_leave_every_node_where_it_is(start):
    Ts = EXP["SE2"](np.arange(6.0).reshape(2, 3))
    none = np.zeros(0, np.int64)
    graph = PoseGraph("SE2", Ts, none, none, np.zeros((0, 3, 3)), np.zeros((0, 3, 3)))
    np.testing.assert_array_equal(start(graph), Ts)
