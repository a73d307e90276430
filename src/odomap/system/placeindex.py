"""The places of a map by their words: which of its keyframes may show what a view shows.

A database of bags of words (`vision/places`) follows a map whose keyframes come and go. It is
brought up to date when it is asked, and by some keyframes at a time only: those that are gone go
first, then the newest that are missing come in, so that no frame waits for a map that grew long
unasked. The words are those of all features of a keyframe, and are made here, by whatever
vocabulary is given: none are stored in maps, so that a map made with another vocabulary, or with
none, is indexed like any other.

Candidates that see the same landmarks compete for one place (`revisits.group_scores`). No row of
keyframes has to point at it as with a loop: one frame has to do, and geometry is asked at once.

Cost: some 0.4 ms for a keyframe that comes; a query 3 ms with 1,000 keyframes, most of it for the
neighbours of what it finds. Memory: 30 kB a keyframe. One thread at a time may use it.

Reference: Gálvez-López, Tardós, "Bags of binary words for fast place recognition in image
sequences", T-RO 28(5), 2012; Mur-Artal, Montiel, Tardós, "ORB-SLAM", T-RO 2015, section V-C.
"""

import logging

import numpy as np
from numpy.typing import NDArray

from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.system.revisits import group_scores
from odomap.system.visualconfig import PlacesConfig
from odomap.vision.places import Places
from odomap.vision.vocabulary import BagOfWords, VocabularyTree

__all__ = ["PlaceIndex", "PlacesConfig", "described"]

Descriptors = NDArray[np.uint8]
Index = NDArray[np.int64]

KEYFRAMES = 8
"""Keyframes that compete, the most alike."""
GROUP = 6
"""Keyframes of a place: one and those that share most landmarks with it."""
GROUP_SHARE = 0.3
"""Summed score of a place relative to that of the best one."""


class PlaceIndex:
    """Finds keyframes of a map by words.

    Args:
        map: it is read only; what it holds already is indexed at once.
        vocabulary: makes the words.
    """

    def __init__(self, map: Map, vocabulary: VocabularyTree) -> None:
        self._map, self._vocabulary = map, vocabulary
        self._places = Places(vocabulary.num_words)
        # The nodes of what is in; None for keyframes without features that have words.
        self._nodes: dict[int, NDArray[np.int32] | None] = {}
        if self.keep_up(map.num_keyframes) == 0 and len(self):
            logging.getLogger(__name__).info(
                "%d keyframes indexed by a vocabulary of %d words", len(self), vocabulary.num_words
            )

    def __len__(self) -> int:
        return len(self._places)

    def keep_up(self, most: int) -> int:
        """Follow the map.

        Args:
            most: keyframes taken in, at most.

        Returns:
            How many of the map are still missing.
        """
        ids = self._map.keyframe_ids.tolist()
        for gone in self._nodes.keys() - set(ids):
            self._places.remove(gone)
            del self._nodes[gone]
        missing = [k for k in ids if k not in self._nodes]
        for k in missing[::-1][:most]:
            self._add(k)
        return max(len(missing) - most, 0)

    def _add(self, keyframe_id: int) -> None:
        descriptors = described(self._map.keyframe(keyframe_id))
        if descriptors is None:
            self._nodes[keyframe_id] = None
            return
        bow = self._vocabulary.transform(descriptors)
        self._places.add(keyframe_id, bow)
        self._nodes[keyframe_id] = bow.nodes.astype(np.int32)

    def words(self, descriptors: Descriptors) -> BagOfWords:
        """Return the words of (N, 32) descriptors."""
        return self._vocabulary.transform(descriptors)

    def nodes(self, keyframe_id: int) -> Index | None:
        """Return the (N,) nodes of a keyframe's features in the direct index; None if not in."""
        nodes = self._nodes.get(keyframe_id)
        return None if nodes is None else nodes.astype(np.int64)

    def find(self, bow: BagOfWords, most: int) -> list[int]:
        """Return the best keyframes of the places that an image may show, the most alike first.

        Args:
            bow: its words.
            most: places, at most.
        """
        found = self._places.query(bow, KEYFRAMES)
        groups = group_scores(found, lambda k: self._map.covisible(k)[0], GROUP, GROUP_SHARE)
        return [matched for matched, *_ in groups[:most]]


def described(keyframe: Keyframe) -> Descriptors | None:
    """Return the (N, 32) descriptors of a keyframe; None where it has none of 256 bits."""
    features = keyframe.features
    if features is None or features.descriptors.shape[1:] != (32,) or not len(features):
        return None
    return features.descriptors
