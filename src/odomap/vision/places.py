"""Places: which images seen before have the words of this one.

A database of bags of words, each under the id of its keyframe. Inverse indices (`inverted`) know
for every word the keyframes it occurs in, so that a query touches only those that share a word,
and gets their scores all at once,

    s(a, b_k) = Σ over common words of min(a_w, b_kw)   in [0, 1].

What a good score is depends on how many features there are and how much they repeat; compare it
with that of the keyframe just before (`system/revisits`), never with a constant alone.

Cost of a query: some 2 ms with 10,000 keyframes of 1,000 features; of one more keyframe 0.1 ms,
and up to 50 ms where an index has to grow, which has 4,096 keyframes at most. A keyframe takes some
20 kB. Scores are exact to 1e-6. One thread at a time may use it.

Reference: Gálvez-López, Tardós, "Bags of binary words for fast place recognition in image
sequences", T-RO 28(5), 2012; Mur-Artal, Montiel, Tardós, "ORB-SLAM", T-RO 2015, section III-E.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.errors import InputError
from odomap.vision.inverted import COUNT, ONE, InverseIndex
from odomap.vision.vocabulary import BagOfWords

__all__ = ["Candidates", "Places"]

Index = NDArray[np.int64]
Whole = NDArray[np.int32]

SEGMENT = 4096
"""Keyframes of one index: with more, growing takes longer, with less, a query does."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Keyframes that look like a query, the most alike first, of equal ones the oldest.

    Attributes:
        keyframe_ids: (n,) int64.
        scores: (n,) float64, 0 to 1.
        num_common: (n,) int64 words in common.
    """

    keyframe_ids: Index
    scores: NDArray[np.float64]
    num_common: Index

    def __len__(self) -> int:
        return len(self.keyframe_ids)


class Places:
    """A database of places.

    Args:
        num_words: of the vocabulary that makes the bags.

    Example:
        >>> places = Places(3)
        >>> bow = BagOfWords(np.array([0, 2]), np.array([0.5, 0.5]), np.empty(0, np.int64))
        >>> places.add(7, bow)
        >>> places.query(bow).scores
        array([1.])
    """

    def __init__(self, num_words: int) -> None:
        self.num_words = num_words
        self._segments: list[InverseIndex] = []
        # of each row of all segments, one after the other: whose it is, -1 if it is free
        self._ids = np.empty(0, np.int64)
        self._free: list[int] = []
        self._row_of: dict[int, int] = {}
        self._bags: dict[int, tuple[Whole, Whole]] = {}

    def __len__(self) -> int:
        return len(self._row_of)

    def __contains__(self, keyframe_id: int) -> bool:
        return keyframe_id in self._row_of

    @property
    def keyframe_ids(self) -> Index:
        """(n,) the keyframes that are in it, ascending."""
        return np.array(sorted(self._row_of), np.int64)

    @property
    def nbytes(self) -> int:
        """Memory of all arrays."""
        kept = sum(words.nbytes + weights.nbytes for words, weights in self._bags.values())
        return sum(index.nbytes for index in self._segments) + self._ids.nbytes + kept

    def add(self, keyframe_id: int, bow: BagOfWords) -> None:
        """Remember a keyframe.

        Args:
            keyframe_id: not in it yet.
            bow: its words.

        Raises:
            InputError: it is in already, or a word is none of the vocabulary's.
        """
        if keyframe_id in self._row_of:
            raise InputError(f"places: keyframe {keyframe_id} is in already: remove it first")
        words, weights = self._whole(bow)
        if not self._free:
            self._segments.append(InverseIndex(self.num_words, SEGMENT))
            self._free = list(range(len(self._ids) + SEGMENT - 1, len(self._ids) - 1, -1))
            self._ids = np.concatenate([self._ids, np.full(SEGMENT, -1, np.int64)])
        row = self._free.pop()
        self._ids[row], self._row_of[keyframe_id] = keyframe_id, row
        self._bags[keyframe_id] = words, weights
        self._segments[row // SEGMENT].add(row % SEGMENT, words, weights)

    def remove(self, keyframe_id: int) -> None:
        """Forget a keyframe; nothing happens where it is not in."""
        row = self._row_of.pop(keyframe_id, None)
        if row is None:
            return
        words, _ = self._bags.pop(keyframe_id)
        self._segments[row // SEGMENT].remove(row % SEGMENT, words)
        self._ids[row] = -1
        self._free.append(row)

    def bag(self, keyframe_id: int) -> BagOfWords:
        """Return the words of a keyframe, their weights to 1e-9, without the direct index.

        Raises:
            KeyError: it is not in.
        """
        words, weights = self._bags[keyframe_id]
        return BagOfWords(words.astype(np.int64), weights / ONE, np.empty(0, np.int64))

    def query(
        self,
        bow: BagOfWords,
        most: int = 10,
        excluded: ArrayLike = (),
        least_score: float = 0.0,
    ) -> Candidates:
        """Find the keyframes that are most like an image.

        Args:
            bow: its words.
            most: keyframes returned, at most.
            excluded: (E,) ids of keyframes that are not looked for, such as those around it.
            least_score: what a keyframe must score at least; it must score above 0.

        Raises:
            InputError: a word is none of the vocabulary's.
        """
        words, weights = self._whole(bow)
        parts = [index.sums(words, weights) for index in self._segments]
        sums = np.concatenate(parts) if parts else np.empty(0, np.int64)
        scores = np.minimum((sums & (COUNT - 1)) / ONE, 1.0)
        unwanted = np.asarray(excluded, np.int64).ravel().tolist()
        scores[[self._row_of[k] for k in unwanted if k in self._row_of]] = 0.0
        rows = np.flatnonzero((scores > 0.0) & (scores >= least_score))
        if len(rows) > most > 0:
            bar = np.partition(scores[rows], len(rows) - most)[len(rows) - most]
            rows = rows[scores[rows] >= bar]
        rows = rows[np.lexsort((self._ids[rows], -scores[rows]))][: max(most, 0)]
        return Candidates(self._ids[rows], scores[rows], sums[rows] // COUNT)

    def scores_of(self, bow: BagOfWords, keyframe_ids: ArrayLike) -> NDArray[np.float64]:
        """Return how alike an image is to some keyframes.

        Args:
            bow: its words.
            keyframe_ids: (n,) ids.

        Returns:
            (n,) scores, NaN for keyframes that are not in.
        """
        ids = np.asarray(keyframe_ids, np.int64).ravel().tolist()
        scores = [self.bag(k).score(bow) if k in self._bags else np.nan for k in ids]
        return np.array(scores, np.float64)

    def _whole(self, bow: BagOfWords) -> tuple[Whole, Whole]:
        """Return words and weights as the indices keep them.

        Raises:
            InputError: a word is none of the vocabulary's.
        """
        if len(bow) and not 0 <= bow.words[0] <= bow.words[-1] < self.num_words:
            raise InputError(
                f"places: word {bow.words[-1]} of {self.num_words}: the words are those of another "
                "vocabulary"
            )
        return bow.words.astype(np.int32), np.rint(bow.weights * ONE).astype(np.int32)
