"""Certificates against dense eigenvalues; what is wound, moved or unfinished gets none."""

from dataclasses import replace

import numpy as np
import pytest

from graphworlds import DIM, EXP, with_landmarks, world
from odomap.backend.descent import SolverConfig
from odomap.backend.graphs.certificate import _Matrix, certify, check_certifiable
from odomap.backend.graphs.chordal import chordal_cost, isotropic_weights
from odomap.backend.graphs.posegraph import PoseGraph, Priors
from odomap.backend.graphs.solve import solve
from odomap.errors import InputError
from odomap.geometry.lie import se2_exp

each_group = pytest.mark.parametrize("group", ["SE2", "SE3"])


def solved(group, seed=0, noise=0.05, **more):
    graph, _ = world(group, seed=seed, noise=noise, **more)
    return solve(graph, cost="chordal", config=SolverConfig(tolerance=1e-14)).graph


def dense(graph):
    """Return M of f = tr(X M Xᵀ), X = [R_1 t_1 …], and X, edge by edge as in the paper."""
    n, d = graph.num_nodes, graph.space
    m = d + 1
    M, X = np.zeros((n * m, n * m)), np.hstack(list(graph.Ts_world_node[:, :d]))
    for i, j, Z, kappa, tau in zip(
        graph.first,
        graph.second,
        graph.Ts_first_second,
        *isotropic_weights(graph.information, d),
        strict=True,
    ):
        V = np.zeros((n * m, m))
        V[j * m : j * m + m] = np.eye(m)
        V[i * m : i * m + m] -= Z
        M += V @ np.diag([kappa] * d + [tau]) @ V.T
    return M, X


def dense_certificate(graph):
    """Return S̃ (dN, dN), positions eliminated by the pseudo-inverse, and the rows of all R."""
    M, X = dense(graph)
    n, d = graph.num_nodes, graph.space
    G, R = X @ M, graph.Ts_world_node[:, :d, :d]
    S = M.copy()
    for i in range(n):
        at = slice(i * (d + 1), i * (d + 1) + d)
        block = R[i].T @ G[:, at]
        S[at, at] -= 0.5 * (block + block.T)
    is_rotation = np.arange(n * (d + 1)) % (d + 1) < d
    RR, RT, TT = (
        S[np.ix_(is_rotation, is_rotation)],
        S[np.ix_(is_rotation, ~is_rotation)],
        S[np.ix_(~is_rotation, ~is_rotation)],
    )
    return RR - RT @ np.linalg.pinv(TT, rcond=1e-12) @ RT.T


def ring(n, turns, noise=0.0):
    """Return a ring of identical poses in the plane, wound `turns` times around."""
    angle = 2.0 * np.pi * turns * np.arange(n) / n
    Ts = se2_exp(np.stack([0.0 * angle, 0.0 * angle, angle], axis=1))
    node = np.arange(n)
    Zs = se2_exp(noise * np.random.default_rng(0).normal(size=(n, 3)))
    return PoseGraph("SE2", Ts, node, (node + 1) % n, Zs, np.tile(np.eye(3), (n, 1, 1)))


@each_group
def test_the_matrix_and_the_cost_belong_together(group):
    graph, Ts = world(group, noise=0.1)
    M, X = dense(graph.placed(Ts))
    assert np.trace(X @ M @ X.T) == pytest.approx(chordal_cost(graph.placed(Ts)), rel=1e-10)


@each_group
def test_the_eigenvalue_is_that_of_the_full_matrix(group):
    graph, truth = world(group, noise=0.1)
    rng = np.random.default_rng(0)
    for size in (0.0, 0.1, 1.0):
        Ts = truth @ EXP[group](size * rng.normal(size=(30, graph.dim)))
        eigenvalues = np.linalg.eigvalsh(dense_certificate(graph.placed(Ts)))
        certificate = certify(graph.placed(Ts))
        assert certificate.smallest_eigenvalue == pytest.approx(eigenvalues[0], rel=1e-6)
        assert eigenvalues[-1] * 0.9 < certificate.norm < eigenvalues[-1] * 100.0
        assert not certificate.certified


@each_group
@pytest.mark.parametrize("seed", range(3))
def test_the_best_poses_are_certified(group, seed):
    graph = solved(group, seed)
    certificate = certify(graph)
    assert certificate.certified, certificate.reason
    assert certificate.reason == "globally optimal"
    assert certificate.cost == pytest.approx(chordal_cost(graph), rel=1e-12)
    assert abs(certificate.smallest_eigenvalue) < 1e-9 * certificate.norm
    assert certificate.suboptimality < 1e-5 * certificate.cost
    eigenvalues = np.linalg.eigvalsh(dense_certificate(graph))
    assert abs(eigenvalues[: graph.space]).max() < 1e-9 * certificate.norm
    assert eigenvalues[graph.space] > 1e-6 * certificate.norm


@each_group
def test_the_gradient_is_that_of_the_cost(group):
    graph, Ts = world(group, noise=0.2)
    d, n = graph.space, graph.num_nodes
    G = _Matrix.at(graph, Ts).gradient
    step = 1e-6
    for i in (3, n - 1):  # the position of node 0 is struck out
        for a in range(graph.dim):
            costs = []
            for sign in (1.0, -1.0):
                moved = Ts.copy()
                moved[i] = moved[i] @ EXP[group](sign * step * np.eye(graph.dim)[a])
                costs.append(chordal_cost(graph.placed(moved)))
            direction = Ts[i] @ (EXP[group](step * np.eye(graph.dim)[a]) - np.eye(d + 1)) / step
            expected = 2.0 * np.sum(G[i] * direction[:d])
            assert (costs[0] - costs[1]) / (2 * step) == pytest.approx(expected, rel=1e-3, abs=1e-2)


@each_group
def test_no_poses_cost_less_than_the_bound(group):
    graph = solved(group, noise=0.2)
    bound = certify(graph).lower_bound
    rng = np.random.default_rng(0)
    for size in (1e-3, 0.1, 1.0):
        other = graph.placed(
            graph.Ts_world_node @ EXP[group](size * rng.normal(size=(30, graph.dim)))
        )
        assert chordal_cost(other) >= bound
        assert certify(other).lower_bound <= bound


@each_group
def test_moving_all_and_other_units_of_length_change_nothing(group):
    graph = solved(group)
    d = graph.space
    motion = EXP[group](np.linspace(-3.0, 2.0, graph.dim))
    in_millimetres = []
    for T in (graph.Ts_world_node, graph.Ts_first_second):
        scaled = T.copy()
        scaled[:, :d, d] *= 1000.0
        in_millimetres.append(scaled)
    information = graph.information.copy()
    information[:, :d, :] /= 1000.0
    information[:, :, :d] /= 1000.0
    for bad in (False, True):
        Ts = graph.Ts_world_node.copy()
        if bad:
            Ts[7] = Ts[7] @ EXP[group](np.ones(graph.dim))
        here, moved = certify(graph.placed(Ts)), certify(graph.placed(motion @ Ts))
        scaled = Ts.copy()
        scaled[:, :d, d] *= 1000.0
        other = replace(
            graph,
            Ts_world_node=scaled,
            Ts_first_second=in_millimetres[1],
            information=information,
        )
        for one in (moved, certify(other)):
            assert one.certified == here.certified == (not bad)
            assert one.cost == pytest.approx(here.cost, rel=1e-9)
            assert one.norm == pytest.approx(here.norm, rel=1e-3)
            close = pytest.approx(here.smallest_eigenvalue, rel=1e-6, abs=1e-9 * here.norm)
            assert one.smallest_eigenvalue == close


@pytest.mark.parametrize("n", [8, 100, 5000])
def test_a_ring_wound_once_too_often_is_a_minimum_but_not_certified(n):
    wound = ring(n, 1)
    certificate = certify(wound)
    assert certificate.decrease < 1e-6 * certificate.cost  # nothing to gain nearby
    assert not certificate.certified
    assert "local minimum" in certificate.reason
    assert certificate.suboptimality > 0.5 * certificate.cost
    best = certify(ring(n, 0))
    assert best.certified, best.reason


def test_a_long_rings_eigenvalue_alone_would_pass():
    certificate = certify(ring(5000, 1))
    assert -1e-6 * certificate.norm < certificate.smallest_eigenvalue < 0.0


@each_group
def test_what_is_no_minimum_is_told_to_be_solved(group):
    graph = solved(group)
    Ts = graph.Ts_world_node.copy()
    Ts[7] = Ts[7] @ EXP[group](np.full(graph.dim, 0.1))
    certificate = certify(graph.placed(Ts))
    assert not certificate.certified
    assert "no minimum of the chordal cost" in certificate.reason
    assert certificate.decrease > 1e-3 * certificate.cost
    assert certificate.suboptimality >= certificate.cost - chordal_cost(graph)


@each_group
def test_parts_are_certified_together(group):
    one, two = solved(group, 1), solved(group, 2)
    n = one.num_nodes
    both = PoseGraph(
        group,
        np.concatenate([one.Ts_world_node, two.Ts_world_node, two.Ts_world_node[:1]]),
        np.concatenate([one.first, n + two.first]),
        np.concatenate([one.second, n + two.second]),
        np.concatenate([one.Ts_first_second, two.Ts_first_second]),
        np.concatenate([one.information, two.information]),
    )
    certificate = certify(both)
    assert certificate.certified, certificate.reason
    assert certificate.num_components == 3  # the last node is tied to none
    assert certificate.cost == pytest.approx(chordal_cost(one) + chordal_cost(two))
    Ts = both.Ts_world_node.copy()
    Ts[n + 3] = Ts[n + 3] @ EXP[group](np.ones(both.dim))
    assert not certify(both.placed(Ts)).certified


@each_group
def test_priors_are_edges_from_the_world(group):
    graph, truth = world(group, noise=0.05)
    nodes = np.array([0, 9, 21])
    noise = EXP[group](0.05 * np.random.default_rng(0).normal(size=(3, graph.dim)))
    priors = Priors(nodes, truth[nodes] @ noise, graph.information[:3])
    graph = replace(graph, priors=priors)
    best = solve(graph, cost="chordal", config=SolverConfig(tolerance=1e-14)).graph
    certificate = certify(best)
    assert certificate.certified, certificate.reason
    assert certificate.cost > chordal_cost(best)
    moved = EXP[group](np.full(graph.dim, 0.1)) @ best.Ts_world_node
    assert not certify(best.placed(moved)).certified


@each_group
def test_a_fixed_node_is_a_gauge_and_two_are_not(group):
    graph = solved(group)
    assert certify(replace(graph, is_fixed=np.arange(30) == 5)).certified
    with pytest.raises(InputError, match="more than one fixed node"):
        certify(replace(graph, is_fixed=np.arange(30) < 2))
    prior = Priors([4], graph.Ts_world_node[4:5], graph.information[:1])
    with pytest.raises(InputError, match="beside priors"):
        certify(replace(graph, is_fixed=np.arange(30) == 5, priors=prior))


def test_what_cannot_be_certified_says_so():
    graph, Ts = world("Sim3")
    with pytest.raises(InputError, match="Sim3"):
        check_certifiable(graph)
    graph, Ts = world("SE2")
    with pytest.raises(InputError, match="landmarks"):
        certify(with_landmarks(graph, Ts)[0])
    with pytest.raises(InputError, match="not known"):
        certify(graph)


@each_group
def test_singular_information_is_no_obstacle(group):
    graph, truth = world(group, noise=0.0)
    information = graph.information.copy()
    d = graph.space
    information[::3, d:, d:] = 0.0
    information[1::3, :d, :d] = 0.0
    information[5] = 0.0
    certificate = certify(replace(graph, Ts_world_node=truth, information=information))
    assert certificate.certified, certificate.reason
    assert np.isfinite(certificate.smallest_eigenvalue)


def test_the_same_twice_and_in_any_order_of_elimination():
    graph = solved("SE3")
    assert certify(graph) == certify(graph)
    order = np.random.default_rng(0).permutation(30)
    other = certify(graph, order)
    assert other.certified
    assert other.norm == certify(graph).norm


@each_group
def test_no_edges_are_as_good_as_can_be(group):
    k, none = DIM[group], np.zeros(0, np.int64)
    m = 3 if group == "SE2" else 4
    Ts = EXP[group](np.ones((2, k)))
    graph = PoseGraph(group, Ts, none, none, np.zeros((0, m, m)), np.zeros((0, k, k)))
    certificate = certify(graph)
    assert certificate.certified
    assert certificate.cost == certificate.lower_bound == 0.0
