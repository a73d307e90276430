"""Certificates against dense eigenvalues; what is wound, moved or unfinished gets none."""

from dataclasses import replace

import numpy as np
import pytest

from graphworlds import DIM, EXP, with_landmarks, world
from odomap.backend.descent import SolverConfig
from odomap.backend.graphs.certificate import _measured, certify, check_certifiable
from odomap.backend.graphs.chordal import chordal_cost, isotropic_weights
from odomap.backend.graphs.dualmatrix import DualMatrix
from odomap.backend.graphs.posegraph import PoseGraph, Priors
from odomap.backend.graphs.solve import solve
from odomap.backend.sparse.lanczos import largest_ritz_value
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


def at_rest(graph):
    """Return the graph with the best positions for its rotations."""
    n, d = graph.num_nodes, graph.space
    M, X = dense(graph)
    at = np.arange(n * (d + 1)) % (d + 1) == d
    t = -X[:, ~at] @ M[np.ix_(~at, at)] @ np.linalg.pinv(M[np.ix_(at, at)], rcond=1e-12)
    Ts = graph.Ts_world_node.copy()
    Ts[:, :d, d] = t.T
    return graph.placed(Ts)


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
        placed = at_rest(graph.placed(Ts))
        eigenvalues = np.linalg.eigvalsh(dense_certificate(placed))
        certificate = certify(placed)
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
    matrix = DualMatrix.at(_measured(graph), Ts)
    G, a_node = matrix.gradient, matrix.offset
    step = 1e-6
    for i in (3, n - 1):  # the position of node 0 is struck out
        for a in range(graph.dim):
            costs = []
            for sign in (1.0, -1.0):
                moved = Ts.copy()
                moved[i] = moved[i] @ EXP[group](sign * step * np.eye(graph.dim)[a])
                costs.append(chordal_cost(graph.placed(moved)))
            direction = Ts[i] @ (EXP[group](step * np.eye(graph.dim)[a]) - np.eye(d + 1)) / step
            direction[:d, d] -= direction[:d, :d] @ a_node[i]
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
@pytest.mark.parametrize("unit", [1.0, 1e3])
@pytest.mark.parametrize("has_rotation", [False, True])
def test_priors_in_map_coordinates_are_proven_as_near_the_origin(group, unit, has_rotation):
    graph, truth = world(group, seed=1, noise=0.05)
    d, k = graph.space, graph.dim
    nodes = np.arange(0, 30, 3)
    lengths, at = graph.Ts_first_second.copy(), truth[nodes].copy()
    at[:, :d, d] += 0.1 * np.random.default_rng(2).normal(size=(10, d))
    tied = np.zeros((10, k, k))
    tied[:, :d, :d] = 100.0 * np.eye(d)
    if has_rotation:
        tied[:, d:, d:] = 100.0 * np.eye(k - d)
    for Ts in (lengths, at):
        Ts[:, :d, d] *= unit
    information = graph.information.copy()
    for weights in (information, tied):
        weights[:, :d, :] /= unit
        weights[:, :, :d] /= unit
    seen = []
    for origin in (0.0, np.array([5e5, 5e6, 300.0])[:d]):
        moved = at.copy()
        moved[:, :d, d] += origin
        priors = Priors(nodes, moved, tied)
        one = replace(graph, Ts_first_second=lengths, information=information, priors=priors)
        best = solve(one, cost="chordal", config=SolverConfig(tolerance=1e-14)).graph
        seen.append(certify(best))
    for proof in seen:
        assert proof.certified, proof.reason
        assert proof.suboptimality < 1e-3 * proof.cost
    assert seen[1].cost == pytest.approx(seen[0].cost, rel=1e-6)
    assert seen[1].norm == pytest.approx(seen[0].norm, rel=1e-3)


@pytest.mark.parametrize("origin", [(0.0, 0.0), (5e5, 5e6)])
@pytest.mark.parametrize("as_edge", [False, True])
def test_a_wrong_ring_is_not_certified_wherever_its_world_is(origin, as_edge):
    wound, start = loop(60, 1, 100.0), np.eye(3)
    start[:2, 2] = origin
    Ts = start @ wound.Ts_world_node
    if as_edge:  # from a node at the origin, as files without priors have it
        graph = PoseGraph(
            "SE2",
            np.concatenate([Ts, np.eye(3)[None]]),
            np.append(wound.first, 60),
            np.append(wound.second, 0),
            np.concatenate([wound.Ts_first_second, Ts[:1]]),
            np.concatenate([wound.information, wound.information[:1]]),
        )
    else:
        graph = replace(wound, Ts_world_node=Ts, priors=Priors([0], Ts[:1], wound.information[:1]))
    wrong = solve(graph, cost="chordal", initial="given").graph
    certificate = certify(wrong)
    assert certificate.cost > 100.0
    assert not certificate.certified
    assert certificate.smallest_eigenvalue < -1e-4 * certificate.norm
    best = certify(solve(graph, cost="chordal", initial="chordal").graph)
    assert best.certified, best.reason
    assert best.cost < 1e-9


def loop(n, turns, information, noise=0.0):
    """Return a circle of n steps, wound `turns` times too often."""
    step, more = np.array([1.0, 0.0, 2 * np.pi / n]), np.array([0.0, 0.0, 2 * np.pi * turns / n])
    Ts = [np.eye(3)]
    for _ in range(n - 1):
        Ts.append(Ts[-1] @ se2_exp(step + more))
    Zs = se2_exp(step) @ se2_exp(noise * np.random.default_rng(1).normal(size=(n, 3)))
    node = np.arange(n)
    return PoseGraph(
        "SE2", Ts, node, (node + 1) % n, Zs, np.tile(information * np.eye(3), (n, 1, 1))
    )


@pytest.mark.parametrize("is_tied", [False, True])
def test_soft_parts_do_not_hide_behind_stiff_ones(is_tied):
    stiff = solve(loop(60, 0, 1e6, noise=0.05), cost="chordal").graph
    soft, tie = loop(60, 1, 1.0), np.eye(3)[None][: int(is_tied)]
    graph = PoseGraph(
        "SE2",
        np.concatenate([stiff.Ts_world_node, soft.Ts_world_node]),
        np.concatenate([stiff.first, 60 + soft.first, [0][: len(tie)]]).astype(np.int64),
        np.concatenate([stiff.second, 60 + soft.second, [60][: len(tie)]]).astype(np.int64),
        np.concatenate([stiff.Ts_first_second, soft.Ts_first_second, tie]),
        np.concatenate([stiff.information, soft.information, tie]),
    )
    wrong = solve(graph, cost="chordal", initial="given").graph
    certificate = certify(wrong)
    assert certificate.smallest_eigenvalue > -1e-6 * certificate.norm  # that alone would pass
    assert certificate.cost - certificate.lower_bound < 3e-4 * certificate.cost  # and so would this
    assert certificate.scaled_eigenvalue < -1e-3
    assert not certificate.certified
    best = certify(solve(graph, cost="chordal", initial="chordal").graph)
    assert best.certified, best.reason
    assert certificate.lower_bound <= best.cost < certificate.cost - 1.0


@each_group
def test_scaling_does_not_change_what_is_definite(group):
    graph = solved(group, noise=0.1)
    factors = 10.0 ** np.random.default_rng(0).uniform(-3, 3, (graph.num_edges, 1, 1))
    graph = at_rest(replace(graph, information=factors * graph.information))
    matrix = DualMatrix.at(_measured(graph), graph.Ts_world_node)
    root = np.repeat(np.sqrt(matrix.stiffness), graph.space)
    scaled = np.linalg.eigvalsh(dense_certificate(graph) / root / root[:, None])
    certificate = certify(graph)
    assert not certificate.certified
    assert certificate.scaled_eigenvalue == pytest.approx(scaled[0], rel=1e-6)
    assert scaled[-1] < 10.0


@each_group
def test_edges_without_information_tie_nothing(group):
    graph = solved(group)
    none = np.zeros_like(graph.information[:1])
    Ts = np.concatenate([graph.Ts_world_node, graph.Ts_world_node])
    first, second = graph.first, graph.second
    two = PoseGraph(
        group,
        Ts,
        np.concatenate([first, 30 + first, [0]]),
        np.concatenate([second, 30 + second, [30]]),
        np.concatenate([graph.Ts_first_second, graph.Ts_first_second, np.eye(len(Ts[0]))[None]]),
        np.concatenate([graph.information, graph.information, none]),
        is_fixed=np.isin(np.arange(60), (0, 30)),
        priors=Priors([0], Ts[:1], none),
    )
    certificate = certify(two)
    assert certificate.certified, certificate.reason
    assert certificate.num_components == 2
    assert certificate.cost == pytest.approx(2.0 * certify(graph).cost, rel=1e-12)


@each_group
def test_a_graph_that_measures_nothing_is_refused(group):
    k, none = DIM[group], np.zeros(0, np.int64)
    m = 3 if group == "SE2" else 4
    Ts = EXP[group](np.ones((2, k)))
    for graph in (
        PoseGraph(group, Ts, none, none, np.zeros((0, m, m)), np.zeros((0, k, k))),
        PoseGraph(group, Ts[:1], none, none, none, none),
        PoseGraph(group, Ts[:0], none, none, none, none),
        PoseGraph(group, Ts, [0], [1], Ts[:1], np.zeros((1, k, k))),
    ):
        with pytest.raises(InputError, match="nothing to prove"):
            certify(graph)


@pytest.mark.parametrize("length", [1e160, 1e200, 1e300])
def test_lengths_that_cannot_be_squared_are_refused(length):
    far = np.eye(3)
    far[0, 2] = length
    Ts = np.stack([np.eye(3), far])
    graph = PoseGraph("SE2", Ts, [0], [1], [far], [np.eye(3)])
    with pytest.raises(InputError, match=r"edge 0 \(0 to 1\): its length or information"):
        certify(graph)
    graph = PoseGraph(
        "SE2", Ts, [0], [1], [np.eye(3)], [np.eye(3)], priors=Priors([1], [far], [np.eye(3)])
    )
    with pytest.raises(InputError, match="prior 0"):
        certify(graph)


@pytest.mark.parametrize("length", [1e9, 1e20, 1e70])
def test_one_long_edge_does_not_hide_a_wrong_ring(length):
    wound, far = ring(20, 1), np.eye(3)
    far[0, 2] = length
    graph = PoseGraph(
        "SE2",
        np.concatenate([wound.Ts_world_node, far[None]]),
        np.append(wound.first, 3),
        np.append(wound.second, 20),
        np.concatenate([wound.Ts_first_second, np.linalg.inv(wound.Ts_world_node[3:4]) @ far]),
        np.concatenate([wound.information, wound.information[:1]]),
    )
    certificate = certify(graph)
    assert not certificate.certified
    assert not np.isnan(certificate.lower_bound)


def test_a_saddle_is_not_certified():
    half_turn = np.diag([1.0, -1.0, -1.0, 1.0])
    graph = PoseGraph("SE3", [np.eye(4), np.eye(4)], [0], [1], [half_turn], [np.eye(6)])
    stuck = solve(graph, cost="chordal", initial="given").graph
    certificate = certify(stuck)
    if certificate.cost > 1e-6:  # descent may or may not leave it
        assert not certificate.certified
        assert certificate.smallest_eigenvalue < -0.1 * certificate.norm
    assert not certify(graph).certified
    assert certify(solve(graph, cost="chordal").graph).certified


@each_group
def test_positions_alone_are_proven_too(group):
    m, d = (3, 2) if group == "SE2" else (4, 3)
    Z, information = np.eye(m), np.zeros((DIM[group], DIM[group]))
    Z[0, d] = 2.0
    information[:d, :d] = np.eye(d)
    graph = PoseGraph(group, [np.eye(m), Z], [0], [1], [Z], [information])
    certificate = certify(graph)
    assert certificate.certified, certificate.reason
    assert certificate.cost == certificate.lower_bound == 0.0


def test_lanczos_is_not_believed_before_it_has_converged():
    stretched = 1.0 - np.linspace(0.0, 1.0, 500) ** 2
    for steps in (5, 20, 80):
        value, error = largest_ritz_value(lambda x: stretched * x, 500, max_steps=steps)
        assert value <= 1.0 + 1e-12
        assert abs(stretched - value).min() <= error + 1e-12
    assert error < 1e-2
