"""Positive definite block matrices of all shapes, for the tests of the sparse factorisation."""

import numpy as np

from odomap.backend.sparse.blocks import BlockPattern


def normal_equations(sizes, i, j, seed=0, prior=0.5):
    """Return the pattern and the values of Σ JᵀJ + prior·I over the edges (i, j)."""
    pattern = BlockPattern.of(sizes, i, j)
    rng = np.random.default_rng(seed)
    values = np.zeros(pattern.num_values)
    values[pattern.diagonal] = prior
    pairs = pattern.pair_of(i, j)
    for a, b, pair in zip(i, j, pairs):
        if pair < 0:
            continue
        a, b = min(a, b), max(a, b)
        s, t = pattern.sizes[a], pattern.sizes[b]
        J, K = rng.normal(size=(max(s, t), s)), rng.normal(size=(max(s, t), t))
        start = pattern.diagonal_start
        values[start[a] : start[a] + s * s] += (J.T @ J).ravel()
        values[start[b] : start[b] + t * t] += (K.T @ K).ravel()
        start = pattern.pair_start[pair]
        values[start : start + s * t] += (J.T @ K).ravel()
    return pattern, values


def chain_with_loops(n, size, loops, seed=0):
    """Return the edges of a path of n poses that meets itself `loops` times."""
    rng = np.random.default_rng(seed)
    i, j = np.arange(n - 1), np.arange(1, n)
    return (
        np.full(n, size),
        np.append(i, rng.integers(0, n, loops)),
        np.append(j, rng.integers(0, n, loops)),
    )


def grid(rows, columns, size):
    """Return sizes and edges of a grid of nodes."""
    node = np.arange(rows * columns).reshape(rows, columns)
    i = np.append(node[:, :-1].ravel(), node[:-1].ravel())
    j = np.append(node[:, 1:].ravel(), node[1:].ravel())
    return np.full(rows * columns, size), i, j


def random_graph(n, edges, seed, sizes=(1, 8)):
    """Return sizes and edges of any graph: loose parts, repeated edges, edges to itself."""
    rng = np.random.default_rng(seed)
    return rng.integers(*sizes, n), rng.integers(0, n, edges), rng.integers(0, n, edges)


SHAPES = {
    "one block": ([3], [], []),
    "one number": ([1], [], []),
    "unconnected": ([2, 3, 1, 7], [], []),
    "path": (np.full(40, 3), np.arange(39), np.arange(1, 40)),
    "loops": chain_with_loops(300, 6, 60),
    "plane": chain_with_loops(500, 3, 150, seed=1),
    "grid": grid(14, 17, 3),
    "dense": (np.full(24, 6), *np.triu_indices(24, 1)),
    "arrow": (np.append(np.full(300, 2), [7, 6]), np.arange(300), np.full(300, 300)),
    "hub in a path": (np.full(400, 3), np.r_[0:399, 2:400], np.r_[1:400, np.zeros(398, int)]),
    "mixed": random_graph(60, 150, 3),
    "two parts": (np.full(20, 6), np.r_[0:9, 10:19], np.r_[1:10, 11:20]),
    "largest blocks": random_graph(15, 30, 4, (1, 17)),
}
