"""Connected components against scipy's, and their anchors."""

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components as scipy_components

from graphworlds import with_landmarks, world
from odomap.backend.graphs.components import connected_components, find_components
from odomap.backend.graphs.posegraph import PoseGraph, Priors


def graph_of(n, first, second, **more):
    """Return a planar graph without noise, all poses at the identity."""
    T = np.eye(3)
    edges = np.tile(T, (len(first), 1, 1))
    return PoseGraph("SE2", np.tile(T, (n, 1, 1)), first, second, edges, edges, **more)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("density", [0.0, 0.3, 0.5, 2.0])
def test_components_are_those_of_scipy(seed, density):
    rng = np.random.default_rng(seed)
    n = 200
    first, second = rng.integers(0, n, (2, int(density * n)))
    label = connected_components(n, first, second)
    count, expected = scipy_components(coo_array((np.ones(len(first)), (first, second)), (n, n)))
    assert label.max() + 1 == count
    # The same partition, numbered by lowest node.
    assert len(np.unique(np.stack([label, expected]), axis=1).T) == count
    lowest = np.unique(label, return_index=True)[1]
    assert (np.diff(lowest) > 0).all()


def test_long_chains_in_any_order():
    n = 20_000
    for order in (np.arange(n - 1), np.arange(n - 1)[::-1]):
        assert not connected_components(n, order, order + 1).any()


def test_the_anchor_is_fixed_else_has_a_prior_else_is_the_lowest():
    fixed = np.isin(np.arange(9), [2, 8])
    priors = Priors([1, 5, 4, 5], np.tile(np.eye(3), (4, 1, 1)), np.tile(np.eye(3), (4, 1, 1)))
    graph = graph_of(9, [0, 1, 3, 4, 7], [1, 2, 4, 5, 8], is_fixed=fixed, priors=priors)
    found = find_components(graph)
    np.testing.assert_array_equal(found.label, [0, 0, 0, 1, 1, 1, 2, 3, 3])
    np.testing.assert_array_equal(found.anchor, [2, 4, 6, 8])
    np.testing.assert_array_equal(found.has_fixed, [True, False, False, True])
    np.testing.assert_array_equal(found.has_prior, [True, True, False, False])
    np.testing.assert_array_equal(found.is_free, [False, False, True, False])
    assert found.count == 4


def test_edges_of_no_weight_do_not_connect():
    graph = graph_of(3, [0, 1], [1, 2])
    assert find_components(graph).count == 1
    np.testing.assert_array_equal(find_components(graph, np.array([1.0, 0.0])).label, [0, 0, 1])


def test_landmarks_connect_if_asked_to():
    graph, Ts = world("SE2", count=10, loops=0)
    graph, _ = with_landmarks(graph.without(np.arange(9) == 4), Ts)
    assert find_components(graph).count == 2
    assert find_components(graph, through_landmarks=True).count == 1


def test_no_nodes_have_no_components():
    found = find_components(graph_of(0, [], []))
    assert found.count == 0
    assert found.label.shape == (0,)
