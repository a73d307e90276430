"""Matching by words: what brute force finds, where nodes agree."""

import numpy as np
import pytest

from odomap.errors import InputError
from odomap.vision.matching import MatchConfig, match_all
from odomap.vision.wordmatching import match_words

CONFIG = MatchConfig(ratio=0.8, max_hamming=60)


@pytest.fixture(scope="module")
def views():
    """Descriptors of two views: of 150 things both see 90, with some bits turned."""
    rng = np.random.default_rng(6)
    things = rng.integers(0, 256, (150, 32), dtype=np.uint8)
    first, second = rng.permutation(150)[:120], rng.permutation(150)[:120]

    def seen(which):
        flips = np.packbits(rng.random((len(which), 256)) < 0.06, axis=1)
        return things[which] ^ flips

    return seen(first), first, seen(second), second


def plain(first, nodes, second, others):
    """The same in plain loops."""
    d = np.unpackbits(first[:, None] ^ second[None], axis=2).sum(axis=2).astype(float)
    d[nodes[:, None] != others[None]] = np.inf
    matches = np.full(len(first), -1)
    for i in range(len(first)):
        j = int(d[i].argmin())
        rest = np.delete(d[i], j).min(initial=257)
        clear = d[i, j] <= CONFIG.max_hamming and d[i, j] < CONFIG.ratio * min(rest, 257)
        if clear and d[:, j].argmin() == i:
            matches[i] = j
    return matches


def test_within_one_node_it_is_brute_force(views):
    first, a, second, b = views
    matches = match_words(first, np.zeros(120, int), second, np.zeros(120, int), CONFIG)
    assert matches.tolist() == match_all(first, second, CONFIG).tolist()
    found = matches >= 0
    assert found.sum() > 70
    assert a[found].tolist() == b[matches[found]].tolist()


@pytest.mark.parametrize("nodes", [3, 10, 40])
def test_only_features_of_the_same_node_are_compared(views, nodes):
    first, a, second, b = views
    of = np.random.default_rng(nodes).integers(0, nodes, 150)
    matches = match_words(first, of[a], second, of[b], CONFIG)
    assert matches.tolist() == plain(first, of[a], second, of[b]).tolist()
    assert (matches >= 0).sum() > 70
    assert (match_words(first, of[a], second, of[b] + 100, CONFIG) == -1).all()
    taken = matches[matches >= 0]
    assert len(set(taken.tolist())) == len(taken)


def test_nothing_matches_nothing(views):
    first, a, _, _ = views
    none, no_nodes = np.empty((0, 32), np.uint8), np.empty(0, np.int64)
    assert (match_words(first, a, none, no_nodes, CONFIG) == -1).all()
    assert match_words(none, no_nodes, first, a, CONFIG).shape == (0,)


def test_nodes_of_other_features_are_refused(views):
    first, a, second, b = views
    with pytest.raises(InputError, match="120 and 120 descriptors, but 119 and 120 nodes"):
        match_words(first, a[1:], second, b, CONFIG)
