import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from blockmatrices import SHAPES, normal_equations
from odomap.backend.sparse.blocks import BlockPattern
from odomap.errors import InputError


def dense(pattern, values):
    """Return the whole matrix, block by block."""
    A = np.zeros((pattern.size, pattern.size))
    rows = [slice(a, b) for a, b in zip(pattern.row_start, pattern.row_start[1:])]
    for i, s in enumerate(pattern.sizes):
        start = pattern.diagonal_start[i]
        A[rows[i], rows[i]] = values[start : start + s * s].reshape(s, s)
    for i, j, start in zip(pattern.first, pattern.second, pattern.pair_start):
        s, t = pattern.sizes[[i, j]]
        A[rows[i], rows[j]] = values[start : start + s * t].reshape(s, t)
        A[rows[j], rows[i]] = A[rows[i], rows[j]].T
    return A


@pytest.mark.parametrize("shape", SHAPES)
def test_products_and_conversion_agree_with_the_whole_matrix(shape):
    pattern, values = normal_equations(*SHAPES[shape])
    A, x = dense(pattern, values), np.random.default_rng(0).normal(size=(pattern.size, 3))
    np.testing.assert_allclose(pattern.to_scipy(values).toarray(), A)
    np.testing.assert_allclose(pattern.multiply(values, x), A @ x, atol=1e-12 * abs(A).max())
    np.testing.assert_allclose(
        pattern.multiply(values, x[:, 0]), A @ x[:, 0], atol=1e-12 * abs(A).max()
    )
    np.testing.assert_array_equal(values[pattern.diagonal], np.diag(A))


@settings(deadline=None, max_examples=60)
@given(st.data())
def test_any_pairs_make_a_pattern(data):
    n = data.draw(st.integers(1, 12))
    node = st.integers(0, n - 1)
    edges = data.draw(st.lists(st.tuples(node, node), max_size=40))
    sizes = data.draw(st.lists(st.integers(1, 16), min_size=n, max_size=n))
    i, j = np.array(edges, dtype=np.int64).reshape(-1, 2).T
    pattern = BlockPattern.of(sizes, i, j)
    assert {(a, b) for a, b in zip(pattern.first, pattern.second)} == {
        (min(e), max(e)) for e in edges if e[0] != e[1]
    }
    assert pattern.num_values == sum(s * s for s in sizes) + sum(
        sizes[a] * sizes[b] for a, b in zip(pattern.first, pattern.second)
    )
    for e, pair in zip(edges, pattern.pair_of(i, j)):
        found = (pattern.first[pair], pattern.second[pair]) if pair >= 0 else (e[0], e[0])
        assert found == (min(e), max(e))
    again = BlockPattern.of(sizes, np.append(j, i), np.append(i, j))
    np.testing.assert_array_equal(again.pair_start, pattern.pair_start)


def test_no_blocks_at_all():
    pattern = BlockPattern.of([], [], [])
    assert (pattern.size, pattern.num_values) == (0, 0)
    assert pattern.multiply(np.zeros(0), np.zeros(0)).shape == (0,)


def test_a_pair_that_is_not_there_is_named():
    pattern = BlockPattern.of([1, 1, 1], [0], [1])
    with pytest.raises(InputError, match=r"\(1, 2\)"):
        pattern.pair_of([0, 2], [1, 1])


@pytest.mark.parametrize(
    ("sizes", "i", "j", "complaint"),
    [
        ([1, 17], [0], [1], "1 to 16 rows"),
        ([1, 0], [0], [1], "1 to 16 rows"),
        ([1, 1], [0], [2], "not one of 2"),
        ([1, 1], [-1], [1], "not one of 2"),
        ([1, 1], [0, 1], [1], "2 first indices, 1 second"),
    ],
)
def test_bad_pairs_are_refused(sizes, i, j, complaint):
    with pytest.raises(InputError, match=complaint):
        BlockPattern.of(sizes, i, j)


@pytest.mark.parametrize(("first", "second"), [([1], [0]), ([0, 0], [1, 1]), ([1, 0], [2, 1])])
def test_pairs_given_directly_must_be_sorted(first, second):
    with pytest.raises(InputError, match="sorted"):
        BlockPattern(np.ones(3, np.int64), np.array(first), np.array(second))


def test_wrong_lengths_are_refused():
    pattern = BlockPattern.of([1, 1], [0], [1])
    with pytest.raises(InputError, match=r"\(2,\), not \(3,\)"):
        pattern.multiply(np.ones(2), np.ones(2))
    with pytest.raises(InputError, match="first axis: 2"):
        pattern.multiply(np.ones(3), np.ones(3))
