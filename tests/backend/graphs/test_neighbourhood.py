"""Neighbourhoods in a growing graph, against sets; and the arrays they grow in."""

from collections import deque

import numpy as np
import pytest

from odomap.backend.graphs.growing import GrowingArray
from odomap.backend.graphs.neighbourhood import EdgeLists


def test_rows_stay_what_they_were():
    array = GrowingArray((2,), float)
    for n in range(100):
        array.append([n, -n])
        assert len(array) == len(array.rows) == n + 1
    np.testing.assert_array_equal(array.rows, [[n, -n] for n in range(100)])
    assert array.rows.flags.c_contiguous
    array.rows[3] = 7.0
    assert (array.rows[3] == 7.0).all()


@pytest.mark.parametrize("seed", range(8))
def test_a_ball_is_what_a_search_finds(seed):
    rng = np.random.default_rng(seed)
    n = 60
    pairs = [(i, i + 1) for i in range(n - 1)] + rng.integers(0, n, (20, 2)).tolist()
    pairs = [(i, j) if rng.random() < 0.5 else (j, i) for i, j in pairs if i != j]
    lists = EdgeLists()
    for _ in range(n):
        lists.add_node()
    for i, j in pairs:
        lists.add_edge(i, j)
    held = rng.random(n) < 0.1
    size = int(rng.integers(1, 50))
    seeds = rng.choice(n, 3, replace=False)
    for _ in range(2):  # twice: nothing of the first search may be left behind
        near = lists.around(seeds, size, held)
        inner = set(near.nodes[: near.num_inner].tolist())
        border = set(near.nodes[near.num_inner :].tolist())
        touching = [e for e, (i, j) in enumerate(pairs) if i in inner or j in inner]
        assert len(near.nodes) == len(inner | border)
        assert not held[list(inner)].any()
        assert sorted(near.edges.tolist()) == touching
        ends = np.column_stack([near.nodes[near.first], near.nodes[near.second]])
        np.testing.assert_array_equal(ends, np.array(pairs).reshape(-1, 2)[near.edges])
        across = {k for e in touching for k in pairs[e]} - inner
        assert across <= border <= across | set(seeds.tolist())
        assert len(inner) == min(size, len(reached(pairs, seeds, held)))


def reached(pairs, seeds, held):
    """Return the free nodes that are reached from seeds without passing held ones."""
    seen, queue = set(), deque(int(s) for s in seeds if not held[s])
    while queue:
        node = queue.popleft()
        if node in seen or held[node]:
            continue
        seen.add(node)
        queue.extend(j if i == node else i for i, j in pairs if node in (i, j))
    return seen
