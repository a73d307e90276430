"""Solution of exercise 2 (docs/lesson/exercise_2.md): places recognised by words, from scratch.

    python examples/exercise_2_solution.py [RECORDING [TRAINING [PICTURE]]]

A vocabulary tree over binary descriptors by k-majority, tf-idf, an inverted index, and precision
and recall. From odomap come the images, their features, and the truth to judge by.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from matplotlib.figure import Figure

import odomap
from odomap.vision.orb import OrbConfig, extract

RECORDING = "sim:room?seed=4&frames=74&sensors=mono&speed=8"
TRAINING = "sim:room?seed=11&frames=40&sensors=mono&speed=8"
NEAR, FAR = (1.0, 30.0), (2.0, 60.0)  # m and degrees: below is one place, above is another

Array = np.ndarray
Bag = dict[int, float]


def signs_of(recording: str) -> tuple[list[Array], Array]:
    """Return (N, 256) descriptors of each image, bits as -1 and 1, and the (K, 4, 4) true poses.

    With signs the Hamming distance is (256 - x . y) / 2: a product of matrices gives all of them.
    """
    source = odomap.open(recording)
    looks = [extract(frame.images[0], OrbConfig()).descriptors for frame in source]
    assert source.truth is not None, "this recording has no truth to judge by"
    return [2.0 * np.unpackbits(look, axis=1).astype(np.float32) - 1.0 for look in looks], (
        source.truth.Ts_world_body
    )


# ---- words ----


def k_majority(signs: Array, k: int, rng: np.random.Generator, rounds: int = 8) -> Array:
    """Return up to (k, 256) centres: each member votes on each bit of its centre."""
    centres = signs[rng.permutation(len(signs))[:k]]
    for _ in range(rounds):
        cluster = (signs @ centres.T).argmax(axis=1)
        votes = [signs[cluster == j].sum(axis=0) for j in range(len(centres))]
        # A cluster that lost all its members keeps its centre.
        voted = [np.where(v > 0, 1, -1) if v.any() else c for v, c in zip(votes, centres)]
        centres = np.array(voted, np.float32)
    return centres


@dataclass
class Node:
    """A node of the tree: a word, or centres and children."""

    word: int = -1
    centres: Array | None = None
    children: list["Node"] = field(default_factory=list)


class Vocabulary:
    """A tree of k-majority clusters; its leaves are words, each with a weight."""

    def __init__(self, images: list[Array], k: int, depth: int, seed: int = 0) -> None:
        self.num_words = 0
        self._rng = np.random.default_rng(seed)
        self._root = self._grow(np.concatenate(images), k, depth)
        contain = np.zeros(self.num_words)
        for image in images:
            contain[np.unique(self.words_of(image))] += 1
        self.weights = np.log(len(images) / np.maximum(contain, 1))

    def _grow(self, signs: Array, k: int, depth: int) -> Node:
        if depth == 0 or len(signs) <= k:
            self.num_words += 1
            return Node(word=self.num_words - 1)
        centres = k_majority(signs, k, self._rng)
        cluster = (signs @ centres.T).argmax(axis=1)
        parts = [signs[cluster == j] for j in range(len(centres))]
        return Node(centres=centres, children=[self._grow(part, k, depth - 1) for part in parts])

    def words_of(self, signs: Array) -> Array:
        """Return the (N,) words of descriptors: all of them go down the tree together."""
        words = np.full(len(signs), -1)
        todo = [(self._root, np.arange(len(signs)))]
        while todo:
            node, rows = todo.pop()
            if node.centres is None:
                words[rows] = node.word
            else:
                nearest = (signs[rows] @ node.centres.T).argmax(axis=1)
                todo += [(c, rows[nearest == j]) for j, c in enumerate(node.children)]
        return words

    def bag(self, signs: Array) -> Bag:
        """Return the weight of each word of an image, their sum 1: tf-idf."""
        words, counts = np.unique(self.words_of(signs), return_counts=True)
        weights = counts * self.weights[words]
        return {int(w): v / weights.sum() for w, v in zip(words, weights) if v > 0}


# ---- places ----


class Places:
    """An inverted index: for each word the images that have it, and its weight there."""

    def __init__(self) -> None:
        self.count = 0
        self._where: dict[int, list[tuple[int, float]]] = {}

    def add(self, bag: Bag) -> None:
        """Remember an image; its number is how many there were before."""
        for word, weight in bag.items():
            self._where.setdefault(word, []).append((self.count, weight))
        self.count += 1

    def scores(self, bag: Bag) -> Array:
        """Return how alike all images are: the sum of the smaller weights of common words."""
        scores = np.zeros(self.count)
        for word, weight in bag.items():
            for image, other in self._where.get(word, ()):
                scores[image] += min(weight, other)
        return scores


# ---- judging ----


def judge(Ts: Array) -> tuple[Array, Array]:
    """Return which pairs of views show one place, and which show two."""
    away = np.linalg.norm(Ts[:, None, :3, 3] - Ts[:, :3, 3], axis=2)
    trace = np.einsum("iab,jab->ij", Ts[:, :3, :3], Ts[:, :3, :3])
    turned = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    return (away < NEAR[0]) & (turned < NEAR[1]), (away > FAR[0]) | (turned > FAR[1])


def precision_recall(scores: Array, near: Array, far: Array) -> Iterator[tuple[float, float]]:
    """Yield precision and recall of the best answers, for each threshold, the highest first.

    Args:
        scores, near, far: (Q, M) of queries and images in the map.
    """
    rows, best = np.arange(len(scores)), scores.argmax(axis=1)
    ok, wrong = near[rows, best], far[rows, best]
    right = false = 0
    for q in np.argsort(-scores[rows, best], kind="stable"):
        right, false = right + int(ok[q]), false + int(wrong[q])
        if right + false:
            yield right / (right + false), right / near.any(axis=1).sum()


def compare(images: list[Array], Ts: Array, words: Vocabulary) -> tuple[Array, Array]:
    """Map the first third of a recording, and look for it in the second half.

    Returns:
        The scores of (Q, M) queries and images in the map, and (n, 2) precision and recall.
    """
    near, far = judge(Ts)
    mapped, queries = np.arange(len(images) // 3), np.arange(len(images) // 2, len(images))
    bags, places, pairs = [words.bag(image) for image in images], Places(), np.ix_(queries, mapped)
    for n in mapped:
        places.add(bags[n])
    scores = np.array([places.scores(bags[n]) for n in queries])
    return scores, np.array(list(precision_recall(scores, near[pairs], far[pairs])))


def draw(scores: Array, curve: Array) -> Figure:
    """Draw precision over recall, and the scores of all queries."""
    figure = Figure(figsize=(9.6, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(curve[:, 1], curve[:, 0])
    left.set(xlabel="recall", ylabel="precision", xlim=(0, 1.02), ylim=(0, 1.02))
    shown = right.imshow(scores, cmap="Blues", aspect="auto")
    right.set(xlabel="image in the map", ylabel="query")
    figure.colorbar(shown, ax=right, label="score")
    return figure


def main(
    recording: str = RECORDING, training: str = TRAINING, picture: str = "places.png"
) -> dict[str, float]:
    """Recognise places with vocabularies of several sizes; return recalls at precision 1."""
    (images, Ts), (learnt, _) = signs_of(recording), signs_of(training)
    recalls = {}
    for k, depth in ((10, 2), (10, 3), (10, 4)):
        words = Vocabulary(learnt, k, depth)
        scores, curve = compare(images, Ts, words)
        recalls[f"{k}^{depth}"] = float(curve[curve[:, 0] == 1.0, 1].max(initial=0.0))
        print(f"{words.num_words:5} words: recall {recalls[f'{k}^{depth}']:.2f} at precision 1")
    draw(scores, curve).savefig(picture, dpi=110)
    return recalls


if __name__ == "__main__":
    main(*sys.argv[1:])
