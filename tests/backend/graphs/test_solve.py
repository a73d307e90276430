"""Pose graphs are solved: worlds with known truth, starts, robust losses, honest endings."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from graphworlds import DIM, EXP, INVERSE, LOG, with_landmarks, world
from odomap.backend.descent import IterationRecord, SolverConfig
from odomap.backend.graphs.chordal import chordal_cost
from odomap.backend.graphs.posegraph import PoseGraph, Priors
from odomap.backend.graphs.solve import solve
from odomap.errors import ConfigError, InputError

each_group = pytest.mark.parametrize("group", DIM)
each_rigid = pytest.mark.parametrize("group", ["SE2", "SE3"])
METHODS = ("gauss_newton", "levenberg_marquardt", "dogleg")


def distances(group, Ts, truth):
    """Return how far poses are from the truth, tangents of length k."""
    return np.linalg.norm(LOG[group](INVERSE[group](truth) @ Ts), axis=1)


@each_group
@pytest.mark.parametrize("initial", ["auto", "spanning_tree", "chordal"])
def test_without_noise_the_truth_is_found(group, initial):
    graph, truth = world(group, noise=0.0)
    solution = solve(graph, initial=initial)
    assert solution.converged
    assert solution.cost_after < 1e-12
    assert distances(group, solution.Ts_world_node, truth).max() < 1e-6


@each_group
@pytest.mark.parametrize("method", METHODS)
def test_all_methods_find_the_same_minimum(group, method):
    graph, truth = world(group, noise=0.05)
    start = graph.placed(
        truth @ EXP[group](0.1 * np.random.default_rng(0).normal(size=(30, graph.dim)))
    )
    config = SolverConfig(method=method, tolerance=1e-12)
    solution = solve(start, initial="given", config=config)
    reference = solve(graph, config=SolverConfig(tolerance=1e-13))
    assert solution.converged, solution.reason
    assert solution.cost_after == pytest.approx(reference.cost_after, rel=1e-8)
    assert solution.cost_after < solution.cost_before


@each_group
def test_no_other_pose_costs_less(group):
    graph, _ = world(group, seed=4, noise=0.1)
    solution = solve(graph, config=SolverConfig(tolerance=1e-13))
    rng = np.random.default_rng(0)
    for size in (1e-4, 1e-3, 1e-2):
        moved = solution.Ts_world_node @ EXP[group](size * rng.normal(size=(30, graph.dim)))
        other = solve(graph.placed(moved), initial="given", config=SolverConfig(iterations=0))
        assert other.cost_before > solution.cost_after


@each_rigid
def test_the_chordal_cost_is_minimised_too(group):
    graph, _ = world(group, noise=0.05)
    geodesic, chordal = solve(graph), solve(graph, cost="chordal")
    assert chordal.converged
    assert chordal.cost_after == pytest.approx(chordal_cost(chordal.graph), rel=1e-9)
    assert chordal.cost_after <= chordal_cost(geodesic.graph)
    assert distances(group, chordal.Ts_world_node, geodesic.Ts_world_node).mean() < 0.1


@each_group
def test_landmarks_are_found_beside_poses(group):
    graph, truth = world(group, noise=0.01)
    graph, points = with_landmarks(graph, truth, noise=0.01)
    solution = solve(graph)
    assert solution.converged
    error = np.linalg.norm(solution.graph.points.points_world - points, axis=1)
    # They hang from the nodes that saw them, whose own errors are larger.
    assert np.median(error) < 0.2
    exact, truth = world(group, noise=0.0)
    exact, points = with_landmarks(exact, truth, noise=0.0)
    np.testing.assert_allclose(solve(exact).graph.points.points_world, points, atol=1e-6)


@each_group
def test_fixed_nodes_stay_and_priors_pull(group):
    graph, truth = world(group, noise=0.02)
    move = EXP[group](np.linspace(0.2, 0.5, graph.dim))
    poses = np.full_like(truth, np.nan)
    poses[[3, 20]] = (move @ truth)[[3, 20]]
    held = np.isin(np.arange(30), [3, 20])
    fixed = solve(replace(graph, Ts_world_node=poses, is_fixed=held))
    np.testing.assert_array_equal(fixed.Ts_world_node[held], poses[held])
    assert distances(group, fixed.Ts_world_node, move @ truth).mean() < 0.2
    priors = Priors(np.array([7]), (move @ truth)[[7]], 1e4 * np.eye(graph.dim)[None])
    pulled = solve(replace(graph, priors=priors))
    assert distances(group, pulled.Ts_world_node, move @ truth)[7] < 1e-6
    free = solve(graph)
    assert pulled.cost_after == pytest.approx(free.cost_after, rel=1e-6)


@each_group
def test_each_component_is_solved(group):
    one, truth = world(group, seed=1, noise=0.02)
    n = one.num_nodes
    both = PoseGraph(
        group,
        np.full((2 * n + 1, *truth.shape[1:]), np.nan),
        np.concatenate([one.first, one.first + n]),
        np.concatenate([one.second, one.second + n]),
        np.tile(one.Ts_first_second, (2, 1, 1)),
        np.tile(one.information, (2, 1, 1)),
    )
    solution, alone = solve(both), solve(one)
    assert solution.num_components == 3  # the last node has no edge at all
    assert solution.cost_after == pytest.approx(2 * alone.cost_after, rel=1e-8)
    for part in (slice(0, n), slice(n, 2 * n)):
        np.testing.assert_allclose(solution.Ts_world_node[part], alone.Ts_world_node, atol=1e-5)
    np.testing.assert_array_equal(solution.Ts_world_node[-1], np.eye(len(truth[0])))


@each_group
def test_weight_zero_is_the_same_as_without(group):
    graph, _ = world(group, noise=0.05)
    drop = graph.is_loop & (np.arange(graph.num_edges) % 2 == 0)
    weighed = solve(graph, weights=np.where(drop, 0.0, 1.0))
    without = solve(graph.without(drop))
    assert weighed.cost_after == pytest.approx(without.cost_after, rel=1e-8)
    np.testing.assert_allclose(weighed.Ts_world_node, without.Ts_world_node, atol=1e-6)


def test_the_same_input_gives_the_same_bytes():
    graph, _ = world("SE3", noise=0.05)
    assert solve(graph).Ts_world_node.tobytes() == solve(graph).Ts_world_node.tobytes()


def test_it_stops_when_told_and_keeps_the_best():
    graph, _ = world("SE3", noise=0.1)
    flag, seen = threading.Event(), list[IterationRecord]()

    def watch(record):
        seen.append(record)
        if record.iteration == 1:
            flag.set()

    solution = solve(graph, initial="spanning_tree", stop=flag, progress=watch)
    assert solution.reason == "stopped on request"
    assert not solution.converged
    assert solution.iterations == 1
    assert [r.iteration for r in seen] == [0, 1]
    assert solution.cost_after == seen[1].cost < seen[0].cost


@pytest.mark.parametrize("method", METHODS)
@each_group
def test_a_wild_start_ends_honestly(group, method):
    """From random poses a minimum may be missed, but never by NaN, a rise or a false claim."""
    graph, _ = world(group, seed=2, noise=0.05)
    rng = np.random.default_rng(8)
    scale = np.array([20.0] * graph.space + [3.0] * (graph.dim - graph.space))
    wild = EXP[group](
        rng.normal(size=(30, graph.dim)) * np.minimum(scale, 1.0 if group == "Sim3" else 50)
    )
    config = SolverConfig(method=method, iterations=60)
    solution = solve(graph.placed(wild), initial="given", config=config)
    assert np.isfinite(solution.Ts_world_node).all()
    assert solution.cost_after <= solution.cost_before
    assert solution.converged == (solution.reason == "converged")


def test_directions_without_information_are_left_alone():
    """Edges that measure nothing along z: poses stay in their plane, and that is no failure."""
    graph, _ = world("SE3", noise=0.0)
    information = graph.information.copy()
    information[:, 2, :] = information[:, :, 2] = 0.0
    solution = solve(replace(graph, information=information))
    assert np.isfinite(solution.Ts_world_node).all()
    assert solution.cost_after < 1e-6


@each_rigid
def test_auto_begins_at_given_poses_that_landmarks_confirm(group):
    """Odometry that drifts, and landmarks that know better: what is given is the better start."""
    graph, truth = world(group, count=60, loops=0, noise=0.2)
    graph, _ = with_landmarks(graph, truth, count=40, noise=0.01)
    graph = graph.placed(
        truth, solve(graph.placed(truth), initial="given").graph.points.points_world
    )
    solution = solve(graph)
    assert solution.initial == "given"
    assert solution.cost_after <= solve(graph, initial="chordal").cost_after * (1.0 + 1e-9)


@pytest.mark.parametrize("name", ["tukey", "dcs", "geman_mcclure", "huber"])
def test_a_solved_graph_stays_solved_under_a_loss(name):
    graph, _ = world("SE2", count=80, loops=30, noise=0.05)
    solution = solve(graph)
    again = solve(solution.graph, loss=name)
    # No loop is false: hardly any is let go (constants are for one number, loops have three).
    assert again.is_rejected.sum() <= 2
    assert distances("SE2", again.Ts_world_node, solution.Ts_world_node).max() < 0.5


def test_an_edge_without_information_ties_nothing():
    graph, _ = world("SE3", count=6, loops=0)
    information = graph.information.copy()
    information[2] = 0.0
    solution = solve(replace(graph, information=information))
    assert solution.num_components == 2
    assert not solution.is_rejected.any()


def test_a_prior_without_information_holds_nothing():
    graph, truth = world("SE3", count=6, loops=2)
    prior = Priors(np.array([3]), truth[[3]] @ EXP["SE3"](np.ones(6)), np.zeros((1, 6, 6)))
    solution = solve(replace(graph, priors=prior))
    np.testing.assert_array_equal(solution.Ts_world_node[0], np.eye(4))
    assert solution.converged


def test_what_one_gives_a_low_weight_is_not_called_false():
    graph, _ = world("SE2")
    assert not solve(graph, weights=np.full(graph.num_edges, 0.3)).is_rejected.any()
    left_out = np.where(graph.is_loop, 0.0, 1.0)
    assert not solve(graph, weights=left_out).is_rejected.any()


def test_what_cannot_be_solved_is_refused():
    empty = PoseGraph("SE2", np.zeros((0, 3, 3)), [], [], np.zeros((0, 3, 3)), np.zeros((0, 3, 3)))
    with pytest.raises(InputError, match="nothing to solve"):
        solve(empty)
    graph, _ = world("SE2")
    with pytest.raises(InputError, match="some are not known"):
        solve(graph, initial="given")
    with pytest.raises(InputError, match="weights must be 54 numbers"):
        solve(graph, weights=[1.0])
    with pytest.raises(InputError, match="weights must be 54 numbers"):
        solve(graph, weights=np.full(54, np.nan))
    with pytest.raises(InputError, match="'geodetic' is unknown"):
        solve(graph, cost="geodetic")
    with pytest.raises(InputError, match="initial 'random' is unknown"):
        solve(graph, initial="random")
    with pytest.raises(ConfigError, match="'hubr' is unknown"):
        solve(graph, loss="hubr")
    with pytest.raises(InputError, match="use geodesic for Sim3"):
        solve(world("Sim3")[0], cost="chordal")


def test_a_scale_drift_is_closed():
    """A ring whose odometry shrinks by 2 % a step, closed by one Sim3 edge."""
    n = 40
    turn = np.array([1.0, 0, 0, 0, 0, 2 * np.pi / n, 0])
    truth = [np.eye(4)]
    for _ in range(n - 1):
        truth.append(truth[-1] @ EXP["Sim3"](turn))
    truth = np.stack(truth)
    drift = turn + np.log(0.98) * np.eye(7)[6]
    first, second = np.append(np.arange(n - 1), n - 1), np.append(np.arange(1, n), 0)
    Zs = np.stack([EXP["Sim3"](drift)] * (n - 1) + [EXP["Sim3"](turn)])
    information = np.tile(np.eye(7), (n, 1, 1))
    information[-1] *= 1e4
    graph = PoseGraph("Sim3", np.full((n, 4, 4), np.nan), first, second, Zs, information)
    odometry, closed = (
        solve(graph, initial="spanning_tree", config=SolverConfig(iterations=0)),
        solve(graph),
    )
    size = [np.cbrt(np.linalg.det(s.Ts_world_node[:, :3, :3])) for s in (odometry, closed)]
    assert size[0].min() < 0.7
    # The loop says that the scale returns to one: the ends meet, the middle shares the drift.
    assert np.abs(closed.chi2[-1]) < 1e-3
    assert size[1].min() > size[0].min()
