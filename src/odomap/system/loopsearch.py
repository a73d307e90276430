"""Looking for loops: which places seen before a new keyframe may show, keyframe by keyframe.

The search follows a map whose keyframes come and go, and reads it only for that: who shares
landmarks with whom is written down (`covisibility`), so that words can be looked up, and the places
found grouped, in a thread that must not touch the map.

What landmarks tie already needs no loop. Left out are the newest keyframes, those that share
landmarks with the new one, and those that share some with these:

    excluded = newest ∪ N(k) ∪ N(N(k)).

Everything else is up to words (`vision/places`) and to how long they last (`revisits`).

Cost: O(keyframes that are new) to follow, and a query of some milliseconds.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section VII-A.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.maps.edges import LOOP
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.system.covisibility import Acquaintance, Carried, Covisibility, acquaint
from odomap.system.placeindex import described
from odomap.system.revisits import Revisit, RevisitConfig, Revisits
from odomap.system.visualconfig import ClosingConfig
from odomap.vision.places import Places
from odomap.vision.vocabulary import VocabularyTree

__all__ = ["ClosingConfig", "LoopSearch", "News"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class News(NamedTuple):
    """What became of a map's keyframes.

    Attributes:
        gone: keyframes that were culled.
        come: keyframes that are new.
        stale: those of them whose covariance a mapper found that did not know of a loop yet.
        recent: (n,) the newest keyframes.
    """

    gone: list[int]
    come: list[Keyframe]
    stale: list[Acquaintance]
    recent: Index


class LoopSearch:
    """Looks for places like those that keyframes show.

    Args:
        vocabulary: makes the words.
        config: which keyframes are left out.
        revisits: when a place is worth a closer look.

    Attributes:
        known: what was written down of the map's keyframes.
    """

    def __init__(
        self,
        vocabulary: VocabularyTree,
        config: ClosingConfig,
        revisits: RevisitConfig | None = None,
    ) -> None:
        self._vocabulary, self._config = vocabulary, config
        self.known = Covisibility(config.min_shared, config.strong_shared)
        self._places = Places(vocabulary.num_words)
        self._revisits = Revisits(self._places, revisits)
        self._carried: dict[int, Carried] = {}

    def follow(self, map: Map, newest: int | None = None) -> News:
        """Write down which keyframes of a map went and came, and in the map how unsure steps were.

        Of a map that is opened with loops in it covariances say what loops told: where it does not
        know how unsure a step was (`maps/growth`), that stays unknown.

        Args:
            map: what is followed.
            newest: the last keyframe that mappers are done with; what is written down of later ones
                would be what nobody has mapped yet, and so they wait. Default: the last there is.
        """
        alive, known = map.keyframe_ids, self.known.keyframe_ids
        alive = alive if newest is None else alive[alive <= newest]
        gone = known[~np.isin(known, alive)].tolist()
        come = alive[~np.isin(alive, known)].tolist()
        for k in gone:
            self.known.cull(k)
        stale, told = [], len(known) > 0 or LOOP not in map.edges().kind
        for k in come:
            carried, of_parent, is_stale = self._carried.pop(k, None), None, False
            if carried is not None:  # a mapper that did not know of the loop may have spoken since
                is_stale = not np.array_equal(carried.own, map.covariance(k), equal_nan=True)
                of_parent = carried.parent_before if is_stale else carried.parent
            self.known.add(keyframe := acquaint(map, k, of_parent, told))
            map.set_growth(k, keyframe.growth)
            stale += [keyframe] if is_stale else []
        recent = alive[-self._config.recent :]
        return News(gone, [map.keyframe(k) for k in come], stale, recent)

    def index(self, news: News) -> None:
        """Keep the words of all keyframes up to date."""
        for k in news.gone:
            self._places.remove(k)
        for keyframe in news.come:
            descriptors = described(keyframe)
            if descriptors is not None:
                self._places.add(keyframe.id, self._vocabulary.transform(descriptors))

    def find(self, keyframe: Keyframe, recent: Index) -> list[Revisit]:
        """Find places that are worth a closer look, the most alike first.

        Args:
            keyframe: the new one.
            recent: (n,) keyframes that are none.
        """
        descriptors = described(keyframe)
        if descriptors is None:
            return []
        bow = self._vocabulary.transform(descriptors)
        excluded = [*self.known.around(keyframe.id), *recent.tolist()]
        found = self._revisits.find(keyframe.id, bow, excluded, self.known.neighbours)
        return [revisit for revisit in found if revisit.is_candidate]

    def nodes(self, descriptors: NDArray[np.uint8]) -> Index:
        """Return the (N,) nodes of (N, 32) descriptors in the direct index."""
        return self._vocabulary.transform(descriptors).nodes

    def begin_anew(self, carried: dict[int, Carried]) -> None:
        """Forget what places were pointed at: a loop was closed.

        Args:
            carried: how sure it made keyframes that came since it was found.
        """
        self._carried.update(carried)
        self._revisits.forget()
