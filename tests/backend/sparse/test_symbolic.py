import numpy as np
import pytest

from blockmatrices import SHAPES, normal_equations
from odomap.backend.sparse.blocks import BlockPattern
from odomap.backend.sparse.multifrontal import stack_size
from odomap.backend.sparse.ordering import approximate_minimum_degree
from odomap.backend.sparse.symbolic import analyse


@pytest.fixture(scope="module", params=SHAPES)
def plan(request):
    pattern, values = normal_equations(*SHAPES[request.param])
    return pattern, values, analyse(pattern, approximate_minimum_degree(pattern))


def border_of(fronts, s):
    return fronts.border_rows[fronts.border[s] : fronts.border[s + 1]]


def columns_of(fronts, s):
    return np.append(np.arange(fronts.pivot[s], fronts.pivot[s + 1]), border_of(fronts, s))


def test_the_order_is_a_permutation(plan):
    pattern, _, fronts = plan
    assert sorted(fronts.order) == list(range(len(pattern.sizes)))
    rows = [np.arange(pattern.row_start[b], pattern.row_start[b + 1]) for b in fronts.order]
    np.testing.assert_array_equal(fronts.rows, np.concatenate(rows))


def test_fronts_hold_the_whole_structure_of_the_factor(plan):
    pattern, values, fronts = plan
    A = pattern.to_scipy(values).toarray()[np.ix_(fronts.rows, fronts.rows)]
    structure = A != 0.0
    for j in range(len(A)):  # symbolic elimination, one scalar at a time
        below = j + 1 + np.flatnonzero(structure[j + 1 :, j])
        structure[np.ix_(below, below)] = True
    for s in range(len(fronts.parent)):
        inside = np.zeros(len(A), bool)
        inside[columns_of(fronts, s)] = True
        for j in range(fronts.pivot[s], fronts.pivot[s + 1]):
            assert not (structure[j:, j] & ~inside[j:]).any()


def test_a_border_lies_within_the_parent_front(plan):
    _, _, fronts = plan
    for s, above in enumerate(fronts.parent):
        border = border_of(fronts, s)
        assert (np.diff(border) > 0).all()
        if above < 0:
            assert len(border) == 0
            continue
        assert above > s
        runs = fronts.runs[fronts.run[s] : fronts.run[s + 1]]
        places = np.concatenate([np.arange(first, first + n) for n, first in runs])
        np.testing.assert_array_equal(columns_of(fronts, above)[places], border)


def test_postorder_makes_the_children_the_last_on_the_stack(plan):
    _, _, fronts = plan
    waiting = []
    for s in range(len(fronts.parent)):
        for _ in range(fronts.children[s]):
            assert fronts.parent[waiting.pop()] == s
        waiting.append(s)
    assert all(fronts.parent[s] < 0 for s in waiting)


def test_every_block_has_its_place(plan):
    pattern, values, fronts = plan
    assert len(fronts.entries) == len(pattern.sizes) + len(pattern.first)
    A = pattern.to_scipy(values).toarray()[np.ix_(fronts.rows, fronts.rows)]
    B = np.zeros_like(A)
    for s in range(len(fronts.parent)):
        f, columns = fronts.width[s], columns_of(fronts, s)
        for source, m, n, place, is_transposed in fronts.entries[
            fronts.entry[s] : fronts.entry[s + 1]
        ]:
            block = values[source : source + m * n].reshape(m, n)
            block = block.T if is_transposed else block
            row, column = divmod(place - fronts.start[s], f)
            rows = fronts.pivot[s] + row + np.arange(len(block))
            B[np.ix_(rows, columns[column : column + block.shape[1]])] += block
    np.testing.assert_array_equal(np.triu(B), np.triu(A))


def test_relaxed_fronts_are_few():
    pattern = BlockPattern.of(*SHAPES["plane"])
    fronts = analyse(pattern, approximate_minimum_degree(pattern))
    assert len(fronts.parent) < len(pattern.sizes) / 3
    assert stack_size(fronts) < 20 * pattern.size * pattern.sizes[0]
