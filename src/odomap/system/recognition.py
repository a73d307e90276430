"""Recognition: where in a map a view was taken, without a prediction.

With a vocabulary the view's words name the keyframes that are candidates (`placeindex`). Words are
made here, of the keyframes' features: a map made with another vocabulary needs nothing. Without
one, features of the view are compared with those that keyframes have landmarks at, and keyframes
with the most clear matches are candidates. From a candidate and those around it follows the pose
(`resection`). Nothing is drawn but from the caller's seed.

Cost: with words some 10 ms, however large the map. Without, O(K N M) for K keyframes of M landmarks
and N features: K is bounded by `most`; what was not compared is compared by the next call, so that
all of a large map have their turn.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section V-C (relocalisation).
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.camera import Camera
from odomap.maps.map import Map
from odomap.system.placeindex import PlaceIndex, described
from odomap.system.resection import FEWEST, Place, Recognised, Resection, Sight, votes
from odomap.vision.matching import MatchConfig
from odomap.vision.vocabulary import VocabularyTree

__all__ = ["MOST", "Recognised", "Recognizer", "describes_places"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Descriptors = NDArray[np.uint8]

MOST = 100
"""Keyframes compared per call, where no words tell which."""
AT_ONCE = 40
"""Keyframes that get their words in a call: some 15 ms."""
VOTERS = 250
"""Features of the view that vote for keyframes; all are matched with the candidates."""
CANDIDATES = 4
"""Keyframes that a pose is looked for with."""
PLACES = 3
"""Places that a pose is looked for in, where words tell them."""
NEIGHBOURS = 5
"""Keyframes that join a candidate: those that share most landmarks with it."""


class Recognizer:
    """Recognises views of the places in a map.

    Args:
        map: what is remembered; it is read only.
        camera: the ideal pinhole of the views.
        T_body_camera: (4, 4) its mount.
        matching: how descriptors are compared.
        min_inliers: landmarks that must agree.
        level_scale: size of a pyramid level's pixels relative to those of the finer one.
        vocabulary: finds keyframes by words; what the map holds gets its words now. Without it,
            views are compared with one keyframe after the other.
    """

    def __init__(
        self,
        map: Map,
        camera: Camera,
        T_body_camera: Array,
        matching: MatchConfig,
        min_inliers: int,
        level_scale: float = 1.2,
        vocabulary: VocabularyTree | None = None,
    ) -> None:
        self._map, self._T_body_camera = map, T_body_camera
        self._matching, self._min_inliers = matching, min_inliers
        self._level_scale = level_scale
        self._resection = Resection(map, camera, matching, min_inliers)
        self._tried: set[int] = set()
        self._index = None if vocabulary is None else PlaceIndex(map, vocabulary)

    def keep_up(self, most: int = 1) -> None:
        """Take in keyframes that are new in the map, at most some: less to do for `find`."""
        if self._index is not None:
            self._index.keep_up(most)

    def find(
        self,
        descriptors: Descriptors,
        keypoints: NDArray[np.floating],
        levels: NDArray[np.uint8],
        seed: int,
        *,
        guess: Array | None = None,
        most: int = MOST,
    ) -> Recognised | str:
        """Find where a view was taken.

        Args:
            descriptors: (N, 32) of its features.
            keypoints: (N, 2) their pixels.
            levels: (N,) their pyramid levels.
            seed: of the random draws.
            guess: (4, 4) a T_world_camera: without words, keyframes near it are compared first; by
                default the newest are.
            most: keyframes to compare without words; the next calls go on with the others, until
                one succeeds.

        Returns:
            The pose and what is seen, or a sentence that says why there is none.
        """
        sigma = self._level_scale ** levels.astype(np.float64)
        view = Sight(descriptors, np.asarray(keypoints, np.float64), levels, sigma)
        if len(descriptors) < self._min_inliers:
            return f"{len(descriptors)} features of {self._min_inliers} needed: nothing to see?"
        if self._index is None:
            places, compared = self._alike_by_looks(view, guess, most)
        else:
            bow = self._index.words(descriptors)
            view = replace(view, nodes=bow.nodes)
            self._index.keep_up(AT_ONCE)
            places, compared = self._places(self._index.find(bow, PLACES)), len(self._index)
        if not compared:
            return "no keyframe of the map has landmarks with descriptors"
        best, reason = 0, "nothing of the map looks like this"
        for place in places:
            found = self._resection.locate(view, self._around(place), seed)
            if isinstance(found, Recognised):
                self._tried.clear()
                return found
            agreed, said = found
            if agreed > best:
                best, reason = agreed, said
        return f"{reason}; {compared} of {self._map.num_keyframes} keyframes compared"

    def _alike_by_looks(
        self, view: Sight, guess: Array | None, most: int
    ) -> tuple[list[Place], int]:
        """Return the keyframes that a view looks like, of some that are next; and how many."""
        step = -(-len(view.descriptors) // VOTERS)
        voters = np.ascontiguousarray(view.descriptors[::step])
        places = self._next_places(guess, most)
        counts = [votes(voters, place, self._matching) for place in places]
        best = np.argsort(-np.asarray(counts), kind="stable")[:CANDIDATES]
        return [places[row] for row in best.tolist()], len(places)

    def _next_places(self, guess: Array | None, most: int) -> list[Place]:
        """Return the next keyframes to compare; from the first again when all had their turn."""
        ids = self._in_order(guess)
        left = [k for k in ids if k not in self._tried]
        if not left:
            self._tried.clear()
            left = ids
        chosen = left[:most]
        self._tried.update(chosen)
        return self._places(chosen)

    def _in_order(self, guess: Array | None) -> list[int]:
        """Return all keyframes, the nearest to a guess first, or the newest."""
        with self._map.lock:
            ids = self._map.keyframe_ids
            Ts_world_body = self._map.Ts_world_body(ids)
        if guess is None:
            return [int(k) for k in ids[::-1]]
        centers = (Ts_world_body @ self._T_body_camera)[:, :3, 3]
        distance = np.linalg.norm(centers - guess[:3, 3], axis=1)
        return [int(k) for k in ids[np.argsort(distance, kind="stable")]]

    def _around(self, place: Place) -> list[Place]:
        """Return a place and those that share most landmarks with it."""
        near = self._map.covisible(place.keyframe_id)[0][:NEIGHBOURS]
        return [place, *self._places(near.tolist())]

    def _places(self, keyframe_ids: list[int]) -> list[Place]:
        """Return what keyframes see, those left out that see nothing that could be recognised."""
        places = (self._place(k) for k in keyframe_ids)
        return [place for place in places if place is not None]

    def _place(self, keyframe_id: int) -> Place | None:
        descriptors = described(self._map.keyframe(keyframe_id))
        if descriptors is None:
            return None
        ids, rows = self._map.observations_of(keyframe_id)
        ids, rows = ids[rows >= 0], rows[rows >= 0]
        if len(ids) < FEWEST:
            return None
        nodes = None if self._index is None else self._index.nodes(keyframe_id)
        nodes = None if nodes is None else nodes[rows]
        return Place(keyframe_id, ids, np.ascontiguousarray(descriptors[rows]), nodes)


def describes_places(map: Map) -> bool:
    """Return whether a map has what recognition needs: landmarks seen by described features."""
    with map.lock:
        return any(
            described(map.keyframe(k)) is not None and len(map.observations_of(k)[0])
            for k in map.keyframe_ids.tolist()
        )
