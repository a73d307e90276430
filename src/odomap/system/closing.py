"""Closing: places seen before are recognised, and the path is corrected by what was measured there.

A closer must not read the map while it works, and only its work tells what there is to read. So it
goes from keyframe to keyframe, in two steps:

    keyframe k      words → places that look like it, several keyframes in a row (`revisits`)
    keyframe k + 1  both sides are read (`loopsides`) → geometry decides (`verifying`)
                    → the path, corrected by an essential graph (`essentialgraph`)

What the first step asks of the map, who shares landmarks with whom, is written down when keyframes
come (`covisibility`). What is tied by landmarks needs no loop: keyframes that share some with the
new one, those that share some with these, and the newest are not looked for; nor is anything for
some keyframes after a loop was closed. Each candidate that is refused says why.

What is written is how keyframes move, S ← S_corrected S_read⁻¹ S_now, so that what mapping found in
the meantime stays; then landmarks that turned out to be one are fused, and the measurement is kept
as an edge of kind "loop".

Cost: `add` and `write` O(K) over some numbers per keyframe; `solve` a query, geometry only with a
candidate, and a few sparse factorisations only with a loop.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section VII.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.camera import Camera
from odomap.limits import Count, check_limits
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.system.closure import Closure, Reading, carry_covariance, read_essentials
from odomap.system.covisibility import Acquaintance, Covisibility, acquaint
from odomap.system.essentialgraph import Essentials, LoopEdges, correct
from odomap.system.loopsides import LoopSide, read_side
from odomap.system.revisits import Revisit, RevisitConfig, Revisits
from odomap.system.stages import Loop
from odomap.system.verifying import Verified, VerifyConfig, verify
from odomap.vision.matching import MatchConfig
from odomap.vision.places import Places
from odomap.vision.vocabulary import VocabularyTree

__all__ = [
    "ClosingChange",
    "ClosingConfig",
    "ClosingJob",
    "LoopCloser",
    "SideVerifier",
    "Verifier",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class ClosingConfig:
    """When loops are looked for, and closed."""

    enabled: bool = False
    """Whether places seen before are recognised and the path is corrected there."""
    recent: Count = 10
    """Newest keyframes that are no places seen before."""
    rest: Count = 10
    """Keyframes after a loop was closed in which no other is."""
    most: Count = 2
    """Places that geometry is asked about at a keyframe."""
    min_shared: Count = 15
    """Landmarks that two keyframes must share to be tied by them: no loop is needed."""
    strong_shared: Count = 100
    """Landmarks that they must share to hold each other in place when the path is corrected."""

    def __post_init__(self) -> None:
        check_limits(self)


class Verifier(Protocol):
    """Decides by geometry whether two keyframes show one place."""

    def read(self, map: Map, keyframe_id: int) -> LoopSide:
        """Read what a keyframe and those around it show."""
        ...

    def verify(self, newer: LoopSide, matched: LoopSide, seed: int) -> Verified:
        """Decide, and measure how the two lie to each other; without the map."""
        ...


@dataclass(frozen=True, eq=False)
class SideVerifier:
    """The verifier of features: pairs of landmarks, a similarity, and what it expects to be seen.

    Attributes:
        camera: the ideal pinhole that features are in.
        T_body_camera: (4, 4) its mount.
        sigma_px: standard deviation of a feature's position on the finest level.
        level_scale: size of a pyramid level's pixels relative to those of the finer one.
        with_scale: whether the two sides may differ in scale: those of a single camera.
        matching: how descriptors are compared.
        config: what is needed.
    """

    camera: Camera
    T_body_camera: Array
    sigma_px: float
    level_scale: float
    with_scale: bool
    matching: MatchConfig
    config: VerifyConfig = field(default_factory=VerifyConfig)

    def read(self, map: Map, keyframe_id: int) -> LoopSide:
        """Read what a keyframe and those around it show."""
        return read_side(map, keyframe_id, self.camera, self.T_body_camera)

    def verify(self, newer: LoopSide, matched: LoopSide, seed: int) -> Verified:
        """Decide, and measure how the two lie to each other."""
        return verify(
            newer,
            matched,
            self.T_body_camera,
            self.sigma_px,
            self.level_scale,
            self.with_scale,
            self.config,
            self.matching,
            seed,
        )


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A place that a keyframe may have come back to, with both sides read."""

    newer: LoopSide
    matched: LoopSide


class LoopCloser:
    """The closer of SLAM with cameras.

    Args:
        map: where keyframes and landmarks are; what it holds already is taken in at once.
        vocabulary: makes the words.
        verifier: asked about candidates.
        with_scale: whether scale drifts: a single camera.
        config: when loops are looked for.
        revisits: when a place is worth a closer look.
        on_closed: called when the map's covariances have been corrected, before anybody reads them.
    """

    def __init__(
        self,
        map: Map,
        vocabulary: VocabularyTree,
        verifier: Verifier,
        with_scale: bool,
        config: ClosingConfig | None = None,
        revisits: RevisitConfig | None = None,
        on_closed: Callable[[], None] | None = None,
    ) -> None:
        self.config = ClosingConfig() if config is None else config
        self.verifier, self.with_scale, self.vocabulary = verifier, with_scale, vocabulary
        self._map, self._on_closed = map, on_closed
        self._known = Covisibility(self.config.min_shared, self.config.strong_shared)
        self._places = Places(vocabulary.num_words)
        self._revisits = Revisits(self._places, revisits)
        self._asked: list[Revisit] = []
        self._since_closed: int = self.config.rest
        self._were: dict[int, Array] = {}
        self.index(*self._follow()[:2])

    def add(self, keyframe: Keyframe) -> "ClosingJob":
        """Take in a keyframe that is in the map, and read both sides of the last candidates."""
        gone, come, stale = self._follow()
        self._since_closed += 1
        asked, self._asked = self._asked, []
        candidates = self._read(asked)
        path = read_essentials(self._map, self._known) if candidates else None
        recent = self._map.keyframe_ids[-self.config.recent :]
        return ClosingJob(self, keyframe, gone, come, recent, stale, candidates, path)

    def _follow(self) -> tuple[list[int], list[Keyframe], list[Acquaintance]]:
        """Write down which keyframes went and came, and return them.

        The third are those whose covariance a mapper found that did not know of a loop yet.
        """
        alive = self._map.keyframe_ids
        known = self._known.keyframe_ids
        gone = known[~np.isin(known, alive)].tolist()
        come = alive[~np.isin(alive, known)].tolist()
        for k in gone:
            self._known.cull(k)
        stale = []
        for k in come:
            were = self._were.pop(k, None)
            self._known.add(keyframe := acquaint(self._map, k, were))
            stale += [] if were is None else [keyframe]
        return gone, [self._map.keyframe(k) for k in come], stale

    def _read(self, revisits: list[Revisit]) -> tuple[_Candidate, ...]:
        """Read both sides of the candidates of a keyframe, or of what is left of their groups."""
        alive, read = self._map.is_keyframe_alive, self.verifier.read
        there = [[k for k in revisit.group.tolist() if alive(k)] for revisit in revisits]
        left = [group[0] for group in there if group]
        if not left or not alive(revisits[0].keyframe_id):
            return ()
        newer = read(self._map, revisits[0].keyframe_id)
        return tuple(_Candidate(newer, read(self._map, k)) for k in left)

    # ---- without the map ----

    def index(self, gone: list[int], come: list[Keyframe]) -> None:
        """Keep the database of places up to date."""
        for k in gone:
            self._places.remove(k)
        for keyframe in come:
            descriptors = _descriptors(keyframe)
            if descriptors is not None:
                self._places.add(keyframe.id, self.vocabulary.transform(descriptors))

    def recognise(self, keyframe: Keyframe, recent: Index) -> None:
        """Look for places like a keyframe's; what is found is read when the next one comes."""
        descriptors = _descriptors(keyframe)
        if descriptors is None:
            return
        bow = self.vocabulary.transform(descriptors)
        excluded = [*self._known.around(keyframe.id), *recent.tolist()]
        found = self._revisits.find(keyframe.id, bow, excluded, self._known.neighbours)
        if self._since_closed >= self.config.rest:
            self._asked = [r for r in found if r.is_candidate][: self.config.most]

    def close(
        self, candidates: tuple[_Candidate, ...], essentials: Essentials
    ) -> tuple[list[Loop], Closure | None]:
        """Ask geometry and the path about candidates, until one is believed."""
        loops: list[Loop] = []
        for candidate in candidates:
            newer, matched = (self._with_nodes(s) for s in (candidate.newer, candidate.matched))
            found = self.verifier.verify(newer, matched, newer.keyframe_id)
            ends = newer.keyframe_id, matched.keyframe_id
            loop = Loop(*ends, found.T_matched_keyframe, found.num_inliers, False, found.reason)
            if found.is_accepted:
                row = np.searchsorted(essentials.keyframe_ids, ends)
                edge = LoopEdges(
                    row[1:],
                    row[:1],
                    found.T_matched_keyframe[None],
                    np.array([found.scale]),
                    found.information[None],
                )
                corrected = correct(essentials, edge, self.with_scale)
                if corrected.is_accepted:
                    loops.append(replace(loop, is_accepted=True))
                    return loops, Closure(*ends, found, essentials, corrected)
                loop = replace(loop, reason=corrected.reason)
            loops.append(loop)
        return loops, None

    def _with_nodes(self, side: LoopSide) -> LoopSide:
        return side.with_nodes(self.vocabulary.transform(side.descriptors).nodes)

    # ---- with the map again ----

    def write(self, closure: Closure, map: Map) -> None:
        """Correct the map by a loop, and begin to look anew."""
        self._were.update(closure.write(map, self._known))
        self._revisits.forget()
        self._asked, self._since_closed = [], 0
        self._tell_closed()

    def refresh(self, stale: list[Acquaintance], map: Map) -> None:
        """Count keyframes' uncertainty from their parents anew, which a loop has made surer."""
        for keyframe in stale:
            carry_covariance(map, keyframe)
        if stale:
            self._tell_closed()

    def _tell_closed(self) -> None:
        if self._on_closed is not None:
            self._on_closed()


@dataclass(frozen=True, eq=False)
class ClosingJob:
    """A keyframe to be recognised, and candidates to be decided on.

    Attributes:
        closer: whose job it is; its database of places belongs to the one job that is out.
        keyframe: the new keyframe.
        gone: keyframes that were culled.
        come: keyframes that are new, this one among them.
        recent: (n,) newest keyframes.
        stale: keyframes that are surer than their mapper knew.
        candidates: of the keyframe before.
        path: what it is corrected with; None without candidates.
    """

    closer: LoopCloser
    keyframe: Keyframe
    gone: list[int]
    come: list[Keyframe]
    recent: Index
    stale: list[Acquaintance]
    candidates: tuple[_Candidate, ...]
    path: Reading | None

    def solve(self) -> "ClosingChange":
        """Look for places like this one, and decide on those found at the keyframe before."""
        closer = self.closer
        closer.index(self.gone, self.come)
        closer.recognise(self.keyframe, self.recent)
        if self.path is None:
            return ClosingChange(closer, self.stale, (), None)
        loops, closure = closer.close(self.candidates, self.path.essentials())
        _log(loops)
        return ClosingChange(closer, self.stale, tuple(loops), closure)


@dataclass(frozen=True, eq=False)
class ClosingChange:
    """What was found about a keyframe.

    Attributes:
        closer: whose it is.
        stale: keyframes that are surer than their mapper knew.
        loops: candidates that were decided on.
        closure: how the map is to be corrected; None where no loop was believed.
    """

    closer: LoopCloser
    stale: list[Acquaintance]
    loops: tuple[Loop, ...]
    closure: Closure | None

    def write(self, map: Map) -> None:
        """Correct the map, if a loop was believed."""
        self.closer.refresh(self.stale, map)
        if self.closure is not None:
            self.closer.write(self.closure, map)


def _descriptors(keyframe: Keyframe) -> NDArray[np.uint8] | None:
    """Return the (N, 32) descriptors of a keyframe; None where it has none of 256 bits."""
    features = keyframe.features
    if features is None or features.descriptors.shape[1:] != (32,) or not len(features):
        return None
    return features.descriptors


def _log(loops: list[Loop]) -> None:
    for loop in loops:
        ends = loop.keyframe_id, loop.matched_id
        if loop.is_accepted:
            text = "keyframe %d is back at %d: %d inliers"
            logging.getLogger(__name__).info(text, *ends, loop.num_inliers)
        else:
            text = "keyframe %d is not back at %d: %s"
            logging.getLogger(__name__).info(text, *ends, loop.reason)
