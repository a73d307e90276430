import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csc_matrix

from blockmatrices import SHAPES, chain_with_loops, grid, random_graph
from odomap.backend.sparse.blocks import BlockPattern
from odomap.backend.sparse.ordering import approximate_minimum_degree


def fill(pattern, order):
    """Return the scalar entries of L, by elimination on the graph itself."""
    neighbours = [set() for _ in pattern.sizes]
    for a, b in zip(pattern.first, pattern.second):
        neighbours[a].add(b)
        neighbours[b].add(a)
    entries = 0
    for i in order:
        s = pattern.sizes[i]
        entries += s * (s + 1) // 2 + s * sum(pattern.sizes[j] for j in neighbours[i])
        for j in neighbours[i]:
            neighbours[j] |= neighbours[i]
            neighbours[j] -= {i, j}
    return int(entries)


def library_fill(pattern):
    """Return the entries of L in the order that QDLDL's own implementation of AMD finds."""
    import qdldl

    values = np.full(pattern.num_values, -1.0)
    values[pattern.diagonal] = 1e3
    L, _, _ = qdldl.Solver(csc_matrix(pattern.to_scipy(values))).factors()
    return L.nnz + pattern.size


@pytest.mark.parametrize("shape", SHAPES)
def test_an_order_is_a_permutation(shape):
    pattern = BlockPattern.of(*SHAPES[shape])
    order = approximate_minimum_degree(pattern)
    assert sorted(order) == list(range(len(pattern.sizes)))
    np.testing.assert_array_equal(approximate_minimum_degree(pattern), order)


@settings(deadline=None, max_examples=100)
@given(st.integers(1, 40), st.integers(0, 120), st.integers(0, 10_000))
def test_any_graph_has_an_order(n, edges, seed):
    pattern = BlockPattern.of(*random_graph(n, edges, seed))
    assert sorted(approximate_minimum_degree(pattern)) == list(range(n))


@settings(deadline=None, max_examples=30)
@given(st.integers(2, 60), st.integers(0, 10_000))
def test_a_forest_fills_nothing(n, seed):
    rng = np.random.default_rng(seed)
    child = np.arange(1, n)
    label = rng.permutation(n)
    pattern = BlockPattern.of(
        np.ones(n), label[child], label[(rng.random(n - 1) * child).astype(int)]
    )
    assert fill(pattern, approximate_minimum_degree(pattern)) == n + len(pattern.first)


@pytest.mark.parametrize(
    "graph", [chain_with_loops(800, 1, 200), grid(25, 25, 1), chain_with_loops(400, 1, 400, seed=5)]
)
def test_fill_is_that_of_the_reference_library(graph):
    pattern = BlockPattern.of(*graph)
    assert fill(pattern, approximate_minimum_degree(pattern)) < 1.03 * library_fill(pattern)


def test_sizes_weigh():
    # Two ways around a ring: eliminating the large blocks first would join the small ones twice.
    sizes, i, j = grid(12, 12, 1)
    sizes = np.where(np.arange(144) % 2 == 0, 1, 12)
    weighted = BlockPattern.of(sizes, i, j)
    unweighted = BlockPattern.of(np.ones(144), i, j)
    assert fill(weighted, approximate_minimum_degree(weighted)) < fill(
        weighted, approximate_minimum_degree(unweighted)
    )


def test_a_hub_comes_last_and_costs_little():
    n = 3000
    path, rest = np.arange(n - 1), np.arange(1, n)
    pattern = BlockPattern.of(
        np.ones(n + 1), np.append(path, np.arange(n)), np.append(rest, [n] * n)
    )
    order = approximate_minimum_degree(pattern)
    assert order[-1] == n
    assert fill(pattern, order) == (n + 1) + (n - 1) + n
