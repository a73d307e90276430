"""Loop edges that confirm each other: the true ones do, random ones do not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from graphworlds import DIM, EXP, INVERSE, world
from loopworlds import passed_again
from odomap.backend.graphs.consensus import (
    LEAST_VARIANCE,
    LIE,
    _nearest,
    chi2_quantile,
    covariance_of,
    find_consensus,
)
from odomap.backend.graphs.posegraph import PoseGraph
from odomap.simulation.loops import with_false_loops

each_group = pytest.mark.parametrize("group", DIM)


def test_quantiles_are_those_of_the_table():
    for dim in (1, 3, 6, 7):
        for share in (0.5, 0.99, 0.999):
            assert chi2_quantile(dim, share) == pytest.approx(stats.chi2.ppf(share, dim))


def test_what_was_not_measured_is_very_unsure():
    covariance = covariance_of(np.array([np.diag([4.0, 100.0, 0.0]), np.zeros((3, 3))]))
    np.testing.assert_allclose(np.diag(covariance[0])[:2], [0.25, 0.01], rtol=1e-3)
    assert covariance[0, 2, 2] == pytest.approx(1e4)
    assert np.isfinite(covariance).all()


@each_group
def test_true_loops_are_confirmed_and_false_ones_are_not(group):
    graph, Ts = passed_again(group)
    count = int(graph.is_loop.sum())
    added, is_false = with_false_loops(graph.placed(Ts), count, seed=3)
    found = find_consensus(added)
    assert not found.is_confirmed[is_false].any()
    assert found.is_confirmed[graph.num_edges :].sum() == 0
    assert found.is_confirmed.sum() >= 0.95 * count
    assert not found.is_confirmed[~added.is_loop].any()
    assert found.variance == pytest.approx(1.0, abs=0.15)


@each_group
@pytest.mark.parametrize("modest", [0.02, 5.0])
def test_the_variance_factor_mends_what_is_stated(group, modest):
    graph, _ = passed_again(group, modest=modest)
    assert find_consensus(graph).variance * modest == pytest.approx(1.0, abs=0.15)


@each_group
def test_it_does_not_matter_where_the_world_is_nor_which_way_edges_point(group):
    graph, Ts = passed_again(group, noise=0.05)
    graph, _ = with_false_loops(graph.placed(Ts), 20, seed=1)
    before = find_consensus(graph)
    shift = np.zeros(graph.dim)
    shift[:2] = 300.0, -200.0
    moved = EXP[group](shift) @ Ts
    fixed = np.arange(graph.num_nodes) == graph.num_nodes // 2
    after = find_consensus(replace(graph, Ts_world_node=moved, is_fixed=fixed))
    np.testing.assert_array_equal(after.is_confirmed, before.is_confirmed)
    assert after.variance == pytest.approx(before.variance, rel=1e-6)
    turned = np.arange(graph.num_edges) % 2 == 0
    # Noise of a turned edge is at its other end: isotropic information is moved there by Ad(Z).
    Zs, information = graph.Ts_first_second.copy(), graph.information.copy()
    M = LIE[group].adjoint(INVERSE[group](Zs[turned]))
    information[turned] = np.swapaxes(M, 1, 2) @ information[turned] @ M
    Zs[turned] = INVERSE[group](Zs[turned])
    other = PoseGraph(
        group,
        graph.Ts_world_node,
        np.where(turned, graph.second, graph.first),
        np.where(turned, graph.first, graph.second),
        Zs,
        0.5 * (information + np.swapaxes(information, 1, 2)),
    )
    after = find_consensus(other)
    assert (after.is_confirmed != before.is_confirmed).mean() < 0.01
    assert after.variance == pytest.approx(before.variance, rel=1e-3)


def test_without_noise_the_variance_factor_has_a_floor():
    graph, _ = passed_again("SE2", noise=1e-9)
    information = np.tile(np.eye(3), (graph.num_edges, 1, 1))
    found = find_consensus(replace(graph, information=information))
    assert found.variance == LEAST_VARIANCE
    assert found.is_confirmed.sum() == graph.is_loop.sum()


def test_a_loop_alone_is_confirmed_by_short_odometry_only():
    graph, Ts = world("SE2", count=200, loops=0, noise=0.005)

    def with_loop(to):
        Z = INVERSE["SE2"](Ts[[0]]) @ Ts[[to]]
        return replace(
            graph,
            first=np.append(graph.first, 0),
            second=np.append(graph.second, to),
            Ts_first_second=np.concatenate([graph.Ts_first_second, Z]),
            information=np.concatenate([graph.information, graph.information[:1]]),
        )

    assert find_consensus(with_loop(6)).is_confirmed[-1]
    wrong = with_loop(6)
    wrong.Ts_first_second[-1, 0, 2] += 1.0
    assert not find_consensus(wrong).is_confirmed[-1]


def test_edges_without_weight_confirm_nothing():
    graph, _ = passed_again("SE2")
    loops = np.flatnonzero(graph.is_loop)
    weights = np.ones(graph.num_edges)
    weights[loops[1:]] = 0.0
    found = find_consensus(graph, weights)
    assert not found.is_confirmed[loops[1:]].any()
    chain, _ = world("SE2", loops=0)
    assert find_consensus(chain).variance == 1.0
    assert not find_consensus(chain).is_confirmed.any()


@pytest.mark.parametrize("spread", [1, 4, 60])
def test_partners_are_the_nearest_also_of_many_loops_at_one_node(spread):
    rng = np.random.default_rng(spread)
    begin, end = rng.integers(0, spread, 120), rng.integers(0, 60, 120)
    order = np.lexsort((end, begin))
    begin, end = begin[order], end[order]
    near = np.full((120, 8), -1)
    _nearest(begin, end, 30, near)
    far = np.abs(begin[:, None] - begin) + np.abs(end[:, None] - end)
    np.fill_diagonal(far, 1000)
    for i in range(120):
        partners = near[i][near[i] >= 0]
        assert len(set(partners.tolist())) == len(partners)
        want = np.sort(far[i])[:8]
        np.testing.assert_array_equal(far[i, partners], want[want < 30])
