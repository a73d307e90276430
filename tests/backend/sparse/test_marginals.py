import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from blockmatrices import SHAPES, normal_equations, random_graph
from odomap.backend.sparse.blockcholesky import BlockCholesky
from odomap.backend.sparse.blocks import BlockPattern
from odomap.backend.sparse.marginals import Marginals, joint_covariance, marginal_blocks
from odomap.errors import InputError


def factored(graph, seed=0):
    pattern, values = normal_equations(*graph, seed)
    factor = BlockCholesky(pattern)
    assert factor.factor(values)
    return factor, np.linalg.inv(pattern.to_scipy(values).toarray())


def rows_of(pattern, blocks):
    starts = pattern.row_start
    return np.concatenate([np.arange(starts[b], starts[b + 1]) for b in blocks])


def assert_selected(factor, inverse):
    """Assert that all blocks on the diagonal and in the pattern are those of the dense inverse."""
    pattern, marginals = factor.pattern, Marginals(factor)
    tolerance = 1e-10 * abs(inverse).max()
    for i in range(len(pattern.sizes)):
        rows = rows_of(pattern, [i])
        np.testing.assert_allclose(
            marginals.blocks([i])[0], inverse[np.ix_(rows, rows)], atol=tolerance
        )
    for i, j in zip(pattern.first, pattern.second):
        block = inverse[np.ix_(rows_of(pattern, [i]), rows_of(pattern, [j]))]
        np.testing.assert_allclose(marginals.pairs([i], [j])[0], block, atol=tolerance)
        np.testing.assert_allclose(marginals.pairs([j], [i])[0], block.T, atol=tolerance)


@pytest.mark.parametrize("shape", SHAPES)
def test_selected_blocks_are_those_of_the_inverse(shape):
    assert_selected(*factored(SHAPES[shape]))


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 25), st.integers(0, 60), st.integers(0, 10_000))
def test_selected_blocks_of_any_graph(n, edges, seed):
    assert_selected(*factored(random_graph(n, edges, seed), seed))


def test_a_front_wider_than_a_tile():
    sizes = np.full(45, 6)
    factor, inverse = factored((sizes, *np.triu_indices(45, 1)))
    blocks = Marginals(factor).blocks(np.arange(45))
    expected = inverse.reshape(45, 6, 45, 6)[np.arange(45), :, np.arange(45)]
    np.testing.assert_allclose(blocks, expected, atol=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
def test_joint_covariance_of_blocks_anywhere(shape):
    factor, inverse = factored(SHAPES[shape])
    n = len(factor.pattern.sizes)
    blocks = np.random.default_rng(0).permutation(n)[:5]
    rows = rows_of(factor.pattern, blocks)
    joint = joint_covariance(factor, blocks)
    np.testing.assert_allclose(joint, inverse[np.ix_(rows, rows)], atol=1e-10)
    np.testing.assert_array_equal(joint, joint.T)


@pytest.mark.parametrize("count", [0, 1, 3, 300])
def test_few_blocks_and_all_are_the_same(count):
    factor, inverse = factored(SHAPES["loops"])
    chosen = np.random.default_rng(1).permutation(300)[:count]
    expected = inverse.reshape(300, 6, 300, 6)[chosen, :, chosen]
    found = marginal_blocks(factor, chosen)
    if count:
        np.testing.assert_allclose(found, expected, atol=1e-10)
    assert len(found) == count


def test_covariances_outlive_the_factor():
    pattern, values = normal_equations(*SHAPES["plane"])
    factor = BlockCholesky(pattern)
    factor.factor(values)
    marginals = Marginals(factor)
    before = marginals.blocks([3, 4])
    factor.factor(5.0 * values)
    np.testing.assert_array_equal(marginals.blocks([3, 4]), before)
    np.testing.assert_allclose(marginal_blocks(factor, [3, 4]), before / 5.0, atol=1e-12)


def test_misuse_is_refused():
    pattern, values = normal_equations(*SHAPES["path"])
    factor = BlockCholesky(pattern)
    for ask in (Marginals, lambda f: marginal_blocks(f, [0]), lambda f: joint_covariance(f, [0])):
        with pytest.raises(InputError, match="not factored"):
            ask(factor)
    factor.factor(values)
    marginals = Marginals(factor)
    with pytest.raises(InputError, match="no such block among 40"):
        marginals.blocks([40])
    with pytest.raises(InputError, match="no neighbours"):
        marginals.pairs([0], [39])
    with pytest.raises(InputError, match="2 first blocks, 1 second"):
        marginals.pairs([0, 1], [1])
    with pytest.raises(InputError, match="comes twice"):
        joint_covariance(factor, [1, 1])


def test_blocks_of_several_sizes_are_asked_for_one_size_at_a_time():
    pattern = BlockPattern.of([2, 3], [0], [1])
    values = np.zeros(pattern.num_values)
    values[pattern.diagonal] = 2.0
    factor = BlockCholesky(pattern)
    factor.factor(values)
    with pytest.raises(InputError, match="several sizes"):
        marginal_blocks(factor, [0, 1])
    assert Marginals(factor).pairs([0], [1]).shape == (1, 2, 3)
