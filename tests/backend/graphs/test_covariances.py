"""Covariances of pose graphs: against the dense inverse, and against what errors turn out to be."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from odomap.backend.graphs.covariances import (
    GraphCovariances,
    covariances,
    joint_covariance,
    relative_covariance,
)
from odomap.backend.graphs.posegraph import PoseGraph, Priors, Sights
from odomap.backend.graphs.solve import solve
from odomap.errors import InputError
from odomap.geometry.lie import (
    se2_exp,
    se2_inverse,
    se2_log,
    se3_exp,
    se3_inverse,
    se3_log,
    sim3_exp,
    sim3_inverse,
    sim3_log,
)
from odomap.geometry.robust import Loss

LIE = {
    "SE2": (3, se2_exp, se2_inverse, se2_log),
    "SE3": (6, se3_exp, se3_inverse, se3_log),
    "Sim3": (7, sim3_exp, sim3_inverse, sim3_log),
}


def ring(group, rng, nodes=12, noise=1.0):
    """Return truth (N, m, m) and a graph of it: a ring of odometry and a few chords, at truth."""
    k, exp, inverse, _ = LIE[group]
    step = np.zeros((nodes, k))
    step[:, 0], step[:, {3: 2}.get(k, 5)] = 1.0, 2 * np.pi / nodes
    step[:, 1:] += 0.1 * rng.normal(size=(nodes, k - 1))
    truth = [np.eye(4 if k > 3 else 3)]
    for xi in step[:-1]:
        truth.append(truth[-1] @ exp(xi))
    truth = np.array(truth)
    first = np.concatenate([np.arange(nodes - 1), [0, 2, 5]])
    second = np.concatenate([np.arange(1, nodes), [nodes - 1, 9, 10]])
    root = 0.02 * (np.eye(k) + 0.3 * rng.normal(size=(len(first), k, k)))
    covariance = root @ np.swapaxes(root, 1, 2)
    errors = noise * (root @ rng.normal(size=(len(first), k, 1)))[:, :, 0]
    measured = inverse(truth[first]) @ truth[second] @ exp(errors)
    information = np.linalg.inv(covariance)
    information = 0.5 * (information + np.swapaxes(information, 1, 2))
    return truth, PoseGraph(group, truth, first, second, measured, information)


def dense_covariance(graph, log, exp, inverse, held=0):
    """Return H⁻¹ (N, k, N, k) by differences of residuals, held nodes left out."""
    n, k, step = graph.num_nodes, graph.dim, 1e-6
    J = np.zeros((graph.num_edges, k, n, k))

    def residuals(Ts):
        return log(inverse(graph.Ts_first_second) @ inverse(Ts[graph.first]) @ Ts[graph.second])

    for i in range(n):
        for a in range(k):
            sides = []
            for sign in (1.0, -1.0):
                Ts = graph.Ts_world_node.copy()
                Ts[i] = Ts[i] @ exp(sign * step * np.eye(k)[a])
                sides.append(residuals(Ts))
            J[:, :, i, a] = (sides[0] - sides[1]) / (2 * step)
    H = np.einsum("epia,epq,eqjb->iajb", J, graph.information, J)
    free = np.delete(np.arange(n), held)
    inner = np.linalg.inv(H[free][:, :, free].reshape(k * (n - 1), -1))
    out = np.zeros((n, k, n, k))
    out[np.ix_(free, range(k), free, range(k))] = inner.reshape(n - 1, k, n - 1, k)
    return out


@pytest.mark.parametrize("group", LIE)
def test_blocks_are_those_of_the_dense_inverse(group):
    k, exp, inverse, log = LIE[group]
    graph = solve(ring(group, np.random.default_rng(1))[1]).graph
    want = dense_covariance(graph, log, exp, inverse)
    scale = np.abs(want).max()
    found = covariances(graph)
    assert found.shape == (12, k, k)
    np.testing.assert_allclose(found, want[range(12), :, range(12)], atol=1e-6 * scale)
    np.testing.assert_array_equal(found, np.swapaxes(found, 1, 2))
    pair = joint_covariance(graph, 7, 3)
    two = want[np.ix_([7, 3], range(k), [7, 3], range(k))].reshape(2 * k, 2 * k)
    np.testing.assert_allclose(pair, two, atol=1e-6 * scale)
    np.testing.assert_allclose(covariances(graph, [9, 2, 9]), found[[9, 2, 9]], rtol=1e-9)


def test_a_held_node_has_none():
    graph = ring("SE2", np.random.default_rng(2))[1]
    found = GraphCovariances(replace(graph, is_fixed=np.arange(12) == 4))
    assert (found.marginals([4]) == 0).all()
    assert (found.joint(4, 7)[:3] == 0).all()
    assert (found.joint(4, 7)[3:, 3:] != 0).all()
    np.testing.assert_allclose(found.joint(7, 4)[:3, :3], found.marginals(7)[0], rtol=1e-9)
    np.testing.assert_allclose(found.relative(4, 7), found.marginals([7])[0], rtol=1e-9)
    assert np.linalg.eigvalsh(found.joint(7, 7)).min() > -1e-12  # one pose twice: of rank k
    np.testing.assert_allclose(found.relative(7, 7), 0.0, atol=1e-12)


@pytest.mark.parametrize("group", LIE)
def test_a_relative_covariance_does_not_depend_on_where_the_graph_is_held(group):
    graph = solve(ring(group, np.random.default_rng(3))[1]).graph
    want = relative_covariance(graph, 3, 8)
    for held in (3, 8, 11):
        other = replace(graph, is_fixed=np.arange(12) == held)
        np.testing.assert_allclose(relative_covariance(other, 3, 8), want, rtol=1e-6, atol=1e-12)
        k = graph.dim
        back = relative_covariance(other, 8, 3)
        assert np.linalg.slogdet(back)[1] == pytest.approx(np.linalg.slogdet(want)[1], abs=k)


def test_a_chain_adds_up():
    steps = np.tile(np.eye(4), (4, 1, 1))
    steps[:, 0, 3] = 2.0
    Ts = np.tile(np.eye(4), (5, 1, 1))
    Ts[:, 0, 3] = 2.0 * np.arange(5)
    graph = PoseGraph("SE3", Ts, range(4), range(1, 5), steps, np.tile(np.eye(6), (4, 1, 1)))
    found = covariances(graph)
    np.testing.assert_allclose(found[:, 0, 0], np.arange(5), atol=1e-9)
    np.testing.assert_allclose(found[:, 5, 5], np.arange(5), atol=1e-9)
    lever = [sum((2.0 * (i - j)) ** 2 for j in range(1, i + 1)) for i in range(5)]
    np.testing.assert_allclose(found[:, 1, 1], np.arange(5) + lever, atol=1e-9)


def test_weights_of_a_robust_solution_count():
    graph = ring("SE2", np.random.default_rng(4))[1]
    weights = np.ones(graph.num_edges)
    weights[[12, 13]] = 0.25, 0.0
    solution = solve(graph, weights=weights)
    scaled = replace(
        solution.graph, information=graph.information * np.maximum(weights, 1e-12)[:, None, None]
    )
    np.testing.assert_allclose(covariances(solution), covariances(scaled), rtol=1e-6)
    assert np.trace(covariances(solution)[9]) > np.trace(covariances(solution.graph)[9])


@pytest.mark.parametrize("group", ["SE2", "SE3"])
def test_errors_are_as_large_as_predicted(group):
    k, _, inverse, log = LIE[group]
    runs, whole, one, pair, relative = 100, 0.0, 0.0, 0.0, 0.0
    for run in range(runs):
        truth, graph = ring(group, np.random.default_rng([5, run]), nodes=12)
        solution = solve(graph, initial="given")
        found, Ts = GraphCovariances(solution), solution.Ts_world_node
        errors = log(inverse(Ts) @ truth)
        one += normalised(errors[6], found.marginals([6])[0])
        pair += normalised(errors[[4, 11]].ravel(), found.joint(4, 11))
        D, D_true = inverse(Ts[2]) @ Ts[8], inverse(truth[2]) @ truth[8]
        relative += normalised(log(inverse(D) @ D_true), found.relative(2, 8))
        whole += 2.0 * solution.cost_after
    for total, size in ((one, k), (pair, 2 * k), (relative, k)):
        low, high = chi2.ppf([0.025, 0.975], runs * size) / (runs * size)
        assert low < total / (runs * size) < high
    redundant = runs * k * (graph.num_edges - 11)
    assert whole / redundant == pytest.approx(1.0, abs=0.2)  # the world is what it should be


def normalised(error, covariance):
    """Return eᵀ Σ⁻¹ e."""
    return float(error @ np.linalg.solve(covariance, error))


def test_separate_parts():
    graph = ring("SE2", np.random.default_rng(6))[1]
    two = PoseGraph(
        "SE2",
        np.concatenate([graph.Ts_world_node] * 2),
        np.concatenate([graph.first, graph.first + 12]),
        np.concatenate([graph.second, graph.second + 12]),
        np.concatenate([graph.Ts_first_second] * 2),
        np.concatenate([graph.information] * 2),
        ids=np.arange(24) + 100,
    )
    found = covariances(two)
    np.testing.assert_allclose(found[12:], found[:12], rtol=1e-9)
    with pytest.raises(InputError, match="nodes 103 and 115 are in parts"):
        relative_covariance(two, 3, 15)
    priors = Priors([1, 14], two.Ts_world_node[[1, 14]], np.tile(np.eye(3), (2, 1, 1)))
    tied = replace(two, priors=priors)
    apart = relative_covariance(tied, 3, 15)
    assert np.linalg.eigvalsh(apart - relative_covariance(tied, 3, 1)).max() > 1.0  # both priors


def test_landmarks_tie_poses():
    rng = np.random.default_rng(7)
    Ts = np.tile(np.eye(3), (2, 1, 1))
    points = rng.uniform(2, 5, (6, 2))
    sights = Sights(
        points,
        np.arange(6),
        np.repeat([0, 1], 6),
        np.tile(np.arange(6), 2),
        np.tile(points, (2, 1)),
        np.tile(np.eye(2), (12, 1, 1)),
    )
    none = np.zeros(0, int)
    graph = PoseGraph(
        "SE2", Ts, none, none, np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), points=sights
    )
    sigma = covariances(graph)[1]
    # Each landmark ties the poses by I/2: twice the covariance of a match of known points.
    J = np.stack([np.array([[-1, 0, p[1]], [0, -1, -p[0]]]) for p in points])
    np.testing.assert_allclose(
        sigma, 2.0 * np.linalg.inv(np.einsum("nai,naj->ij", J, J)), rtol=1e-9
    )


@pytest.mark.parametrize(
    ("nodes", "message"),
    [([12], "node 12 does not exist"), ([-1], "node -1 does not"), ([0.5], "whole numbers")],
)
def test_nodes_that_do_not_exist(nodes, message):
    with pytest.raises(InputError, match=message):
        covariances(ring("SE2", np.random.default_rng(8))[1], nodes)


def test_what_was_not_measured_is_refused():
    graph = ring("SE2", np.random.default_rng(9))[1]
    flat = graph.information.copy()
    flat[:, 2], flat[:, :, 2] = 0.0, 0.0
    flat[:, :2] = flat[:, :1]
    flat[:, :, 1] = flat[:, :, 0]
    with pytest.raises(InputError, match=r"node \d+ is not determined"):
        covariances(replace(graph, information=flat))
    with pytest.raises(InputError, match="a pose is not known"):
        covariances(graph.placed(np.full((12, 3, 3), np.nan)))
    assert covariances(graph, []).shape == (0, 3, 3)


def chain(group, sights, points, priors=None, nodes=8):
    """Return a chain at truth, whose nodes see landmarks: (node, landmark, error) each."""
    k, exp, inverse, _ = LIE[group]
    step = np.zeros(k)
    step[0], step[{3: 2}.get(k, 5)] = 1.0, 0.3
    Ts = np.array([exp(i * step) for i in range(nodes)])
    d = Ts.shape[1] - 1
    first, steps = np.arange(nodes - 1), np.tile(exp(step), (nodes - 1, 1, 1))
    seen = [
        (inverse(Ts[i])[:d, :d] @ points[m] + inverse(Ts[i])[:d, d] + error)
        for i, m, error in sights
    ]
    node, point = (np.array([sight[a] for sight in sights], np.int64) for a in (0, 1))
    landmarks = Sights(
        points,
        np.arange(len(points)) + 500,
        node,
        point,
        seen,
        np.tile(np.eye(d), (len(node), 1, 1)),
    )
    information = np.tile(np.eye(k), (nodes - 1, 1, 1))
    return PoseGraph(
        group, Ts, first, first + 1, steps, information, points=landmarks, priors=priors
    )


@pytest.mark.parametrize("name", ["tukey", "cauchy"])
def test_sights_count_as_they_did_in_the_end(name):
    points = np.array([[2.0, 1.0], [1.0, 3.0]])
    sights = [(0, 0, 0.0), (0, 1, 0.0), (7, 0, 30.0), (7, 1, 0.0)]
    solution = solve(chain("SE2", sights, points), loss=Loss(name), initial="given")
    weights = solution.sight_weights
    assert weights[2] < 0.02
    scaled = replace(
        solution.graph,
        points=replace(
            solution.graph.points, information=np.maximum(weights, 1e-12)[:, None, None] * np.eye(2)
        ),
    )
    found = covariances(solution)
    np.testing.assert_allclose(found, covariances(scaled), rtol=1e-6, atol=1e-12)
    if name == "tukey":  # one sight of it is left: it says nothing
        rest = covariances(chain("SE2", [(0, 0, 0.0), (7, 0, 0.0)], points[1:]))
        np.testing.assert_allclose(found, rest, rtol=1e-6, atol=1e-12)


def test_a_landmark_that_nothing_sees_is_left_out():
    points = np.array([[2.0, 1.0], [1.0, 3.0], [4.0, 4.0]])
    sights = [(0, 0, 0.0), (7, 0, 0.0), (3, 2, 0.0)]
    want = covariances(chain("SE2", [(0, 0, 0.0), (7, 0, 0.0)], points[:1]))
    np.testing.assert_allclose(covariances(solve(chain("SE2", sights, points))), want, rtol=1e-6)
    graph = chain("SE2", sights, points)
    graph.points.points_world[1] = np.nan
    np.testing.assert_allclose(covariances(graph), want, rtol=1e-6)
    graph.points.points_world[2] = np.nan
    with pytest.raises(InputError, match="a landmark is not known"):
        covariances(graph)


def priors_of(group, nodes, seen):
    """Return priors of nodes of `chain`, that tell the directions `seen` only."""
    k = LIE[group][0]
    Ts = chain(group, [], np.zeros((0, 2 if k == 3 else 3))).Ts_world_node[nodes]
    return Priors(nodes, Ts, np.tile(np.diag(seen).astype(float), (len(nodes), 1, 1)))


@pytest.mark.parametrize(
    ("group", "nodes", "seen", "free"),
    [
        ("SE2", [3], [0, 0, 0], 3),
        ("SE2", [3], [1, 1, 0], 1),
        ("SE2", [3, 3], [1, 1, 0], 1),
        ("SE2", [2, 5], [0, 0, 1], 2),
        ("SE3", [2], [1, 1, 1, 0, 0, 0], 3),
        ("SE3", [2, 5], [1, 1, 1, 0, 0, 0], 1),
        ("Sim3", [2, 5], [1, 1, 1, 0, 0, 0, 0], 1),
        ("Sim3", [2], [1, 1, 1, 1, 1, 1, 0], 1),
    ],
)
def test_a_part_whose_priors_do_not_hold_it_is_named(group, nodes, seen, free):
    none = np.zeros((0, 2 if group == "SE2" else 3))
    graph = chain(group, [], none, priors_of(group, nodes, seen))
    message = rf"part of node 0 \(8 nodes\).*leave {free} of .* fix a node or give a prior"
    with pytest.raises(InputError, match=message) as caught:
        covariances(graph)
    assert "\n" not in str(caught.value)
    fixed = replace(graph, is_fixed=np.arange(8) == 4)
    assert np.isfinite(covariances(fixed)).all()


def test_priors_that_hold_a_part_together():
    none = np.zeros((0, 3))
    for group, nodes in (("SE3", [0, 4, 7]), ("Sim3", [0, 4, 7])):
        seen = [1, 1, 1] + [0] * (LIE[group][0] - 3)
        found = covariances(chain(group, [], none, priors_of(group, nodes, seen)))
        assert np.linalg.eigvalsh(found).min() > 0.0
    graph = chain("SE2", [], np.zeros((0, 2)), priors_of("SE2", [2, 3], [1, 1, 0]))
    assert np.linalg.eigvalsh(covariances(graph)).min() > 0.0
