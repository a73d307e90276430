"""Vocabularies: centres that minimise, descents that find the nearest, scores that are scores."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from odomap.errors import InputError
from odomap.vision.hamming import as_words
from odomap.vision.kmajority import cluster
from odomap.vision.vocabulary import BagOfWords, VocabularyTree


def distances(a, b):
    """Return (N, M) Hamming distances, by bits."""
    return np.unpackbits(a[:, None] ^ b[None], axis=2).sum(axis=2)


def noisy(rng, prototypes, count, flips=20):
    """Return (count, 32) copies of prototypes with some bits turned, and whose copies they are."""
    of = rng.integers(0, len(prototypes), count)
    bits = np.unpackbits(prototypes[of], axis=1)
    bits ^= rng.random(bits.shape) < flips / 256
    return np.packbits(bits, axis=1), of


def random_descriptors(rng, count):
    return rng.integers(0, 256, (count, 32), dtype=np.uint8)


@pytest.fixture(scope="module")
def images():
    """Forty images of fifty features each, of 300 things that are seen again and again."""
    rng = np.random.default_rng(1)
    things = random_descriptors(rng, 300)
    return [noisy(rng, things, 50)[0] for _ in range(40)]


@pytest.fixture(scope="module")
def tree(images):
    return VocabularyTree.train(images, branching=5, depth=3, seed=2)


def by_hand(tree, descriptor):
    """Return the nodes on the way down from the root, the root first."""
    path = [0]
    first = 1
    starts = []
    for n in tree.num_children:
        starts.append(first)
        first += n
    while tree.num_children[path[-1]]:
        start = starts[path[-1]]
        children = tree.centres[start : start + tree.num_children[path[-1]]]
        path.append(start + int(distances(descriptor[None], children)[0].argmin()))
    return path


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.integers(2, 6))
def test_a_centre_minimises_the_summed_distance_of_its_members(seed, count, k):
    rng = np.random.default_rng(seed)
    members = noisy(rng, random_descriptors(rng, 4), count)[0]
    centres, labels = cluster(as_words(members), k, seed)
    centres = centres.view(np.uint8)
    near = distances(members, centres)
    assert near[np.arange(count), labels].tolist() == near.min(axis=1).tolist()
    assert sorted(set(labels.tolist())) == list(range(len(centres)))
    for c in range(len(centres)):
        own = np.unpackbits(members[labels == c], axis=1)
        best = np.minimum(own.sum(axis=0), (1 - own).sum(axis=0)).sum()
        assert near[labels == c, c].sum() == best


def test_clusters_are_those_that_are_there():
    rng = np.random.default_rng(0)
    members, of = noisy(rng, random_descriptors(rng, 8), 400)
    _, labels = cluster(as_words(members), 8, 3)
    pairs = set(zip(of.tolist(), labels.tolist()))
    assert len(pairs) == len(set(of.tolist())) == 8


def test_few_members_are_clusters_of_their_own_and_equal_ones_are_one():
    three = np.array([[0], [255], [15]], np.uint8).repeat(32, axis=1)
    centres, labels = cluster(as_words(three[[0, 1, 0, 2, 1]]), 10)
    assert len(centres) == 3
    assert labels[0] == labels[2] != labels[1] == labels[4] != labels[3]
    assert np.array_equal(centres.view(np.uint8)[labels], three[[0, 1, 0, 2, 1]])


def test_a_word_is_the_leaf_at_the_end_of_the_nearest_children(tree, images):
    descriptors = np.concatenate([images[0][:20], random_descriptors(np.random.default_rng(4), 20)])
    leaves = np.flatnonzero(tree.num_children == 0)
    for level in range(5):
        nodes = tree.transform(descriptors, level).nodes
        for i, descriptor in enumerate(descriptors):
            path = by_hand(tree, descriptor)
            assert leaves[tree.words_of(descriptor[None])[0]] == path[-1]
            assert nodes[i] == path[min(level, len(path) - 1)]


def test_a_bag_holds_term_frequency_times_inverse_document_frequency(tree, images):
    bag = tree.transform(images[3])
    words = tree.words_of(images[3])
    number = np.zeros(tree.num_words)
    for other in images:
        number[np.unique(tree.words_of(other))] += 1
    assert tree.weights == pytest.approx(np.log(len(images) / number))
    expected = np.bincount(words, minlength=tree.num_words) * tree.weights
    expected /= expected.sum()
    assert bag.words.tolist() == np.flatnonzero(expected).tolist()
    assert bag.weights == pytest.approx(expected[bag.words], rel=1e-12)


def test_the_score_is_one_for_itself_and_between_zero_and_one(tree, images):
    bags = [tree.transform(image) for image in images]
    for a in bags[:8]:
        assert a.score(a) == pytest.approx(1.0, abs=1e-12)
        for b in bags:
            wide = np.zeros((2, tree.num_words))
            wide[0, a.words], wide[1, b.words] = a.weights, b.weights
            assert a.score(b) == pytest.approx(1 - 0.5 * np.abs(wide[0] - wide[1]).sum(), abs=1e-12)
            assert 0.0 <= a.score(b) == b.score(a) <= 1.0


def test_an_image_without_features_is_like_none(tree, images):
    empty = tree.transform(np.empty((0, 32), np.uint8))
    assert len(empty) == 0
    assert empty.score(tree.transform(images[0])) == empty.score(empty) == 0.0


def test_a_view_of_the_same_things_scores_higher_than_one_of_others():
    rng = np.random.default_rng(7)
    places = [random_descriptors(rng, 80) for _ in range(12)]
    tree = VocabularyTree.train(
        [noisy(rng, place, 80)[0] for place in places for _ in range(4)], branching=8, depth=4
    )
    first = [tree.transform(noisy(rng, place, 80)[0]) for place in places]
    again = [tree.transform(noisy(rng, place, 80)[0]) for place in places]
    scores = np.array([[a.score(b) for b in first] for a in again])
    assert scores.argmax(axis=1).tolist() == list(range(12))
    others = scores - np.diag(np.diag(scores))
    assert (np.diag(scores) > 1.5 * others.max(axis=1)).all()


def test_the_same_seed_gives_the_same_tree_and_another_one_another(images, tree):
    again = VocabularyTree.train(images, branching=5, depth=3, seed=2)
    other = VocabularyTree.train(images, branching=5, depth=3, seed=3)
    assert np.array_equal(again.centres, tree.centres)
    assert np.array_equal(again.weights, tree.weights)
    assert not np.array_equal(other.centres[:6], tree.centres[:6])


def test_training_tells_how_far_it_is(images):
    told = []
    VocabularyTree.train(images, branching=4, depth=2, progress=lambda *step: told.append(step))
    done = [step[0] for step in told]
    assert done == sorted(done)
    assert done[-1] == told[-1][1] == 2 * sum(map(len, images))


def test_a_cut_tree_has_the_same_nodes_and_weights_of_their_words(tree, images):
    short = tree.cut(2)
    assert np.array_equal(short.centres, tree.centres[: len(short.centres)])
    assert short.depth == 2
    leaves = np.flatnonzero(short.num_children == 0)
    for image in images[:3]:
        assert leaves[short.words_of(image)].tolist() == tree.transform(image, 2).nodes.tolist()
    # a leaf that was one keeps its weight; of others it is that of independent words
    deep_words = tree.word_of_node[: len(short.centres)]
    for word, node in enumerate(leaves):
        if deep_words[node] >= 0:
            assert short.weights[word] == pytest.approx(tree.weights[deep_words[node]])
        else:
            start = tree.first_child[node]
            own = tree.word_of_node[start : start + tree.num_children[node]]
            share = 1 - np.prod(1 - np.exp(-tree.weights[own]))
            assert short.weights[word] == pytest.approx(-np.log(share), abs=1e-9)
    assert tree.cut(3) is tree


def test_rows_of_one_array_count_as_images():
    four = np.array([[0], [255], [15], [240]], np.uint8).repeat(32, axis=1)
    tree = VocabularyTree.train(four, branching=2, depth=2)
    assert tree.num_words == tree.num_images == 4
    assert tree.weights == pytest.approx(np.log(4))


@pytest.mark.parametrize(
    ("descriptors", "message"),
    [
        ([], "0 images with features"),
        (np.empty((0, 32), np.uint8), "0 images with features"),
        ([np.zeros((0, 32), np.uint8)] * 5, "0 images with features"),
        ([np.zeros((9, 32), np.uint8)], "1 images with features"),
        ([np.zeros((9, 32), np.uint8)] * 2, "are the same"),
        ([np.zeros((9, 64), np.uint8)] * 2, r"\(9, 64\): its words are of 256 bits"),
        ([np.zeros((9, 32))] * 2, "float64"),
        ([np.zeros(32, np.uint8)] * 2, r"\(32,\)"),
    ],
)
def test_what_nothing_can_be_learned_from(descriptors, message):
    with pytest.raises(InputError, match=message) as caught:
        VocabularyTree.train(descriptors)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "sizes", [{"branching": 1}, {"branching": 256}, {"depth": 0}, {"depth": 17}]
)
def test_sizes_that_cannot_be(sizes, images):
    with pytest.raises(InputError, match=next(iter(sizes))):
        VocabularyTree.train(images, **sizes)


@pytest.mark.parametrize(
    ("children", "weights", "message"),
    [
        ([2, 0], [1.0], "make no tree"),
        ([0, 2, 0], [1.0, 1.0], "make no tree"),
        ([3, 0, 0, 0], [1.0] * 3, "0 to 2 children"),
        ([-1, 2, 0], [1.0], "0 to 2 children"),
        ([1, 1, 1, 0], [1.0], "more than 2 levels"),
        ([2, 0, 0], [1.0], "weights of shape"),
        ([2, 0, 0], [1.0, np.nan], "not finite"),
        ([2, 0, 0], [1.0, -1.0], "negative"),
        ([0], [1.0], "1 nodes"),
    ],
)
def test_what_is_no_tree(children, weights, message):
    centres = np.zeros((len(children), 32), np.uint8)
    with pytest.raises(InputError, match=message):
        VocabularyTree(centres, np.array(children), np.array(weights), 2, 2)


def test_other_descriptors_are_refused(tree):
    with pytest.raises(InputError, match="256 bits"):
        tree.transform(np.zeros((3, 64), np.uint8))


def test_a_bag_is_what_it_is_made_of():
    bag = BagOfWords(np.array([1, 4]), np.array([0.25, 0.75]), np.empty(0, np.int64))
    other = BagOfWords(np.array([4, 9]), np.array([0.5, 0.5]), np.empty(0, np.int64))
    assert len(bag) == 2
    assert bag.score(other) == 0.5
