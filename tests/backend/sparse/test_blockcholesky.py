from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from blockmatrices import SHAPES, chain_with_loops, grid, normal_equations, random_graph
from odomap.backend.sparse.blockcholesky import BlockCholesky
from odomap.backend.sparse.blocks import BlockPattern
from odomap.backend.sparse.fronts import TILE
from odomap.backend.sparse.ldl import QdldlFactor
from odomap.errors import InputError

FACTORS = BlockCholesky, QdldlFactor


def right_side(pattern, *columns, seed=0):
    return np.random.default_rng(seed).normal(size=(pattern.size, *columns))


@pytest.mark.parametrize("Factor", FACTORS)
@pytest.mark.parametrize("shape", SHAPES)
def test_solutions_solve(shape, Factor):
    pattern, values = normal_equations(*SHAPES[shape])
    A, factor = pattern.to_scipy(values).toarray(), Factor(pattern)
    assert factor.factor(values)
    assert factor.failed_block == -1
    b = right_side(pattern)
    np.testing.assert_allclose(A @ factor.solve(b), b, atol=1e-10)
    np.testing.assert_allclose(factor.solve(b), np.linalg.solve(A, b), rtol=1e-8, atol=1e-10)
    assert factor.log_determinant() == pytest.approx(np.linalg.slogdet(A)[1], rel=1e-10)


@pytest.mark.parametrize("Factor", FACTORS)
@pytest.mark.parametrize("columns", [0, 1, 3, 8, 11])
def test_several_right_sides_are_solved_as_each_alone(Factor, columns):
    pattern, values = normal_equations(*SHAPES["mixed"])
    factor = Factor(pattern)
    factor.factor(values)
    B = right_side(pattern, columns)
    X = factor.solve(B)
    assert X.shape == B.shape
    for b, x in zip(B.T, X.T):
        np.testing.assert_allclose(x, factor.solve(b), atol=1e-12)


@settings(deadline=None, max_examples=60)
@given(st.integers(1, 30), st.integers(0, 90), st.integers(0, 10_000))
def test_any_graph_in_any_order(n, edges, seed):
    pattern, values = normal_equations(*random_graph(n, edges, seed), seed)
    order = np.random.default_rng(seed).permutation(n)
    b = right_side(pattern)
    solutions = []
    for factor in (BlockCholesky(pattern), BlockCholesky(pattern, order)):
        assert sorted(factor.order) == list(range(n))
        assert factor.factor(values)
        x = factor.solve(b)
        assert abs(pattern.multiply(values, x) - b).max() < 1e-10
        solutions.append(x)
    np.testing.assert_allclose(solutions[0], solutions[1], rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("width", [TILE - 1, TILE, TILE + 1, 2 * TILE + 3])
def test_fronts_wider_than_a_tile(width):
    # One dense front of that many columns, in blocks that fit neither the tile nor groups of four.
    sizes = np.append(np.full(width // 7, 7), [width % 7] if width % 7 else [])
    pattern, values = normal_equations(sizes, *np.triu_indices(len(sizes), 1))
    factor = BlockCholesky(pattern)
    assert factor.factor(values)
    assert factor.fronts.width.max() == width
    b = right_side(pattern)
    assert abs(pattern.multiply(values, factor.solve(b)) - b).max() < 1e-8


def test_the_work_is_counted():
    pattern = BlockPattern.of(*SHAPES["dense"])
    n = pattern.size
    dense = BlockCholesky(pattern)
    assert dense.num_nonzeros == n * (n + 1) // 2
    assert dense.flops == n * (n + 1) * (2 * n + 1) / 6
    path = BlockCholesky(BlockPattern.of(*SHAPES["path"]))
    assert path.num_nonzeros >= 40 * 6 + 39 * 9


def test_memory_is_reused_and_nothing_is_left_behind():
    pattern, values = normal_equations(*chain_with_loops(200, 3, 50))
    factor, b = BlockCholesky(pattern), right_side(pattern)
    assert factor.factor(values)
    first, held = factor.solve(b), factor.values
    assert not factor.factor(values * np.nan)
    assert factor.factor(3.0 * values)
    np.testing.assert_allclose(factor.solve(b), first / 3.0, atol=1e-12)
    assert factor.factor(values)
    np.testing.assert_array_equal(factor.solve(b), first)
    assert factor.values is held


@pytest.mark.parametrize("Factor", FACTORS)
def test_the_shift_is_added_to_the_diagonal(Factor):
    pattern, values = normal_equations(*SHAPES["grid"])
    A, factor = pattern.to_scipy(values).toarray(), Factor(pattern)
    least = np.linalg.eigvalsh(A)[0]
    before = values.copy()
    assert factor.factor(values, 2.5)
    b = right_side(pattern)
    np.testing.assert_allclose((A + 2.5 * np.eye(len(A))) @ factor.solve(b), b, atol=1e-10)
    assert factor.factor(values, -0.99 * least)
    assert not factor.factor(values, -1.01 * least)
    np.testing.assert_array_equal(values, before)


@pytest.mark.parametrize("Factor", FACTORS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused(Factor, bad):
    pattern, values = normal_equations(*SHAPES["loops"])
    factor = Factor(pattern)
    for place in (pattern.diagonal[77], pattern.pair_start[33] + 5):
        spoilt = values.copy()
        spoilt[place] = bad
        assert not factor.factor(spoilt)
        assert 0 <= factor.failed_block < len(pattern.sizes)


@pytest.mark.parametrize("Factor", FACTORS)
def test_a_negative_block_is_named(Factor):
    pattern, values = normal_equations([3, 2, 4, 1], [], [])
    values[pattern.diagonal[pattern.row_start[2] + 1]] = -1.0
    factor = Factor(pattern)
    assert not factor.factor(values)
    assert factor.failed_block == 2


@pytest.mark.parametrize("shape", ["path", "loops", "plane", "grid", "two parts", "mixed"])
def test_a_graph_that_nothing_ties_is_refused(shape):
    # Σ JᵀJ of relative measurements, (x_j − x_i) weighted: all may move together.
    sizes, i, j = SHAPES[shape]
    if shape == "mixed":
        sizes = np.full(len(sizes), 5)
    pattern = BlockPattern.of(sizes, i, j)
    rng = np.random.default_rng(0)
    values, s = np.zeros(pattern.num_values), sizes[0]
    for a, b, pair in zip(i, j, pattern.pair_of(i, j)):
        if pair < 0:
            continue
        J = rng.normal(size=(s, s)) + 3 * np.eye(s)
        for start, sign in zip(
            (pattern.diagonal_start[a], pattern.diagonal_start[b], pattern.pair_start[pair]),
            (1, 1, -1),
        ):
            values[start : start + s * s] += sign * (J.T @ J).ravel()
    factor = BlockCholesky(pattern)
    assert not factor.factor(values)
    for part in (0, 10) if shape == "two parts" else (0,):
        values[pattern.diagonal[pattern.row_start[part] : pattern.row_start[part] + s]] += 1.0
    if shape != "mixed":  # that has loose parts
        assert factor.factor(values)


def test_no_blocks_at_all():
    for Factor in FACTORS:
        factor = Factor(BlockPattern.of([], [], []))
        assert factor.factor(np.zeros(0))
        assert factor.solve(np.zeros(0)).shape == (0,)
        assert factor.solve(np.zeros((0, 3))).shape == (0, 3)
        assert factor.log_determinant() == 0.0


@pytest.mark.parametrize("Factor", FACTORS)
def test_misuse_is_refused(Factor):
    pattern, values = normal_equations(*SHAPES["path"])
    factor = Factor(pattern)
    with pytest.raises(InputError, match="not factored"):
        factor.solve(right_side(pattern))
    with pytest.raises(InputError, match="values have shape"):
        factor.factor(values[1:])
    factor.factor(values)
    with pytest.raises(InputError, match="first axis: 120"):
        factor.solve(np.ones(119))
    with pytest.raises(InputError, match="first axis: 120"):
        factor.solve(np.ones((120, 2, 2)))


@pytest.mark.parametrize("order", [[0, 1], [0, 0, 1], [1, 2, 3]])
def test_an_order_must_be_a_permutation(order):
    with pytest.raises(InputError, match="permutation of 3 blocks"):
        BlockCholesky(BlockPattern.of([1, 1, 1], [0], [1]), order)


def test_threads_may_each_use_their_own():
    cases = [normal_equations(*grid(20, 20, size), seed=size) for size in (1, 2, 3, 6)] * 2

    def residual(case):
        pattern, values = case
        factor, b = BlockCholesky(pattern), right_side(pattern)
        worst = 0.0
        for scale in range(1, 8):
            assert factor.factor(scale * values)
            worst = max(worst, abs(pattern.multiply(scale * values, factor.solve(b)) - b).max())
        return worst

    with ThreadPoolExecutor(4) as pool:
        assert max(pool.map(residual, cases)) < 1e-9


def test_the_same_numbers_give_the_same_bytes():
    pattern, values = normal_equations(*SHAPES["loops"])
    b = right_side(pattern)
    solutions = []
    for _ in range(2):
        factor = BlockCholesky(pattern)
        factor.factor(values)
        solutions.append(factor.solve(b).tobytes())
    assert solutions[0] == solutions[1]
