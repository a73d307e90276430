"""Blocks of an inverse anywhere, against the dense inverse."""

import numpy as np
import pytest

from odomap.backend.sparse.blockcholesky import BlockCholesky
from odomap.backend.sparse.blocks import BlockPattern
from odomap.backend.sparse.crossblocks import cross_blocks
from odomap.errors import InputError


def system(size, seed=0, blocks=40, pairs=60):
    """Return a factored system of blocks of one size, in two parts, and its inverse."""
    rng = np.random.default_rng(seed)
    half = blocks // 2
    i, j = rng.integers(0, half, (2, pairs))
    pattern = BlockPattern.of(np.full(blocks, size), np.append(i, i + half), np.append(j, j + half))
    values = rng.normal(size=pattern.num_values)
    for b in range(blocks):
        block = slice(pattern.diagonal_start[b], pattern.diagonal_start[b] + size**2)
        square = values[block].reshape(size, size)
        values[block] = (square @ square.T + 8.0 * size * np.eye(size)).ravel()
    factor = BlockCholesky(pattern)
    assert factor.factor(values)
    inverse = np.linalg.inv(pattern.to_scipy(values).toarray())
    return factor, inverse.reshape(blocks, size, blocks, size).transpose(0, 2, 1, 3)


@pytest.mark.parametrize("size", [1, 3, 6, 7])
def test_blocks_of_any_pairs(size):
    factor, inverse = system(size)
    rng = np.random.default_rng(1)
    first, second = rng.integers(0, 40, (2, 100))
    second[:20], first[20:40] = 7, 11  # many pairs of one block
    want = inverse[first, second]
    found = cross_blocks(factor, first, second)
    np.testing.assert_allclose(found, want, atol=1e-12 * np.abs(inverse).max())
    apart = (first < 20) != (second < 20)
    assert apart.any()
    assert not found[apart].any()
    back = cross_blocks(factor, second, first)
    np.testing.assert_allclose(back, np.swapaxes(want, 1, 2), atol=1e-12 * np.abs(inverse).max())


def test_none_and_what_is_not_factored():
    none = np.zeros(0, np.int64)
    assert cross_blocks(system(3)[0], none, none).shape[0] == 0
    with pytest.raises(InputError):
        cross_blocks(BlockCholesky(BlockPattern.of([1, 1], [0], [1])), none, none)
