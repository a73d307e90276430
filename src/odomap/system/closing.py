"""Closing: places seen before are recognised, and the path is corrected by what was measured there.

A closer must not read the map while it works, and only its work tells what there is to read. So it
goes from keyframe to keyframe, in two steps:

    keyframe k      words → places that look like it, several keyframes in a row (`revisits`)
    keyframe k + 1  both sides are read (`loopsides`) → geometry decides (`verifying`)
                    → the path, corrected by an essential graph (`essentialgraph`)

What the first step asks of the map is written down when keyframes come (`loopsearch`). For some
keyframes after a loop was closed nothing is looked for. A loop that joins two pieces of the map
waits for a second one that agrees. Each candidate that is refused says why.

What is written is how keyframes move, S ← S_corrected S_read⁻¹ S_now, so that what mapping found in
the meantime stays; then landmarks that turned out to be one are fused, and the measurement is kept
as an edge of kind "loop".

Cost: `add` and `write` O(K) over some numbers per keyframe; `solve` a query, geometry only with a
candidate, and a few sparse factorisations only with a loop.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section VII.
"""

import logging
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.graphproblem import import_group
from odomap.geometry.camera import Camera
from odomap.geometry.lie import so3_log
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.system.closure import (
    Closure,
    Reading,
    Tie,
    carry_covariance,
    edges_of,
    pieces_of,
    read_essentials,
    strayed,
)
from odomap.system.covisibility import Acquaintance
from odomap.system.essentialgraph import Corrected, Essentials, correct
from odomap.system.loopsearch import ClosingConfig, LoopSearch, News
from odomap.system.loopsides import LoopSide, read_side
from odomap.system.rejoining import Rejoining, Unbent
from odomap.system.revisits import Revisit
from odomap.system.stages import Loop
from odomap.system.verifying import Verified, VerifyConfig, verify
from odomap.vision.matching import MatchConfig

__all__ = [
    "ClosingChange",
    "ClosingJob",
    "LoopCloser",
    "SideVerifier",
    "Verifier",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Verifier(Protocol):
    """Decides by geometry whether two keyframes show one place."""

    def read(self, map: Map, keyframe_id: int, part: Collection[int] | None = None) -> LoopSide:
        """Read what a keyframe and those around it show, of a part of the map."""
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

    def read(self, map: Map, keyframe_id: int, part: Collection[int] | None = None) -> LoopSide:
        """Read what a keyframe and those around it show, of a part of the map."""
        return read_side(map, keyframe_id, self.camera, self.T_body_camera, part=part)

    def verify(self, newer: LoopSide, matched: LoopSide, seed: int) -> Verified:
        """Decide, and measure how the two lie to each other."""
        return verify(
            newer.without(matched.landmark_ids),  # what both know would speak for the drifted path
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
    """A place that a keyframe may have come back to, with both sides and their times read."""

    newer: LoopSide
    matched: LoopSide
    stamps_ns: tuple[int, int]
    unbent: Unbent | None = None

    def path(self, essentials: Essentials) -> Essentials:
        """Return the path to be corrected: as odometry told it before landmarks tied the two."""
        return essentials if self.unbent is None else self.unbent.of(essentials)


class LoopCloser:
    """The closer of SLAM with cameras.

    Args:
        map: where keyframes and landmarks are; what it holds already is taken in at once.
        search: finds candidates.
        verifier: asked about them.
        with_scale: whether scale drifts: a single camera.
        config: when loops are looked for.
        on_closed: called when the map's covariances have been corrected, before anybody reads them.
    """

    def __init__(
        self,
        map: Map,
        search: LoopSearch,
        verifier: Verifier,
        with_scale: bool,
        config: ClosingConfig,
        on_closed: Callable[[], None] | None = None,
    ) -> None:
        self._map, self.search, self.verifier = map, search, verifier
        self._with_scale, self._config, self._on_closed = with_scale, config, on_closed
        self._asked: list[Revisit] = []
        self._since_closed: int = config.rest
        self._waiting: Tie | None = None
        self._rejoining = Rejoining(search.known)
        import_group("Sim3" if with_scale else "SE3")
        search.index(search.follow(map))

    def add(self, keyframe: Keyframe) -> "ClosingJob":
        """Take in a keyframe that is mapped, and read both sides of the last candidates.

        Later ones may be in the map already, where the tracker runs ahead: they wait.
        """
        self._since_closed += 1
        return self._job(keyframe)

    def last(self) -> "ClosingJob | None":
        """Read both sides of the last keyframe's candidates, if it has any: none comes after it."""
        return self._job(None) if self._asked else None

    def _job(self, keyframe: Keyframe | None) -> "ClosingJob":
        news = self.search.follow(self._map, None if keyframe is None else keyframe.id)
        asked, self._asked = self._asked, []
        candidates = self._read(asked)
        if keyframe is not None:
            candidates = (*self._read_rejoined(keyframe.id), *candidates)
        path = read_essentials(self._map, self.search.known) if candidates else None
        return ClosingJob(self, keyframe, news, candidates, path)

    def _read(self, revisits: list[Revisit]) -> tuple[_Candidate, ...]:
        """Read both sides of the candidates of a keyframe, or of what is left of their groups."""
        alive, read = self._map.is_keyframe_alive, self.verifier.read
        there = [[k for k in revisit.group.tolist() if alive(k)] for revisit in revisits]
        left = [group[0] for group in there if group]
        if not left or not alive(revisits[0].keyframe_id):
            return ()
        newer = read(self._map, k_newer := revisits[0].keyframe_id)
        stamp_ns, at = self._map.keyframe(k_newer).stamp_ns, self._map.keyframe
        return tuple(
            _Candidate(newer, read(self._map, k), (stamp_ns, at(k).stamp_ns)) for k in left
        )

    def _read_rejoined(self, keyframe_id: int) -> tuple[_Candidate, ...]:
        """Read both sides of what landmarks tie a keyframe to, far along all that was measured."""
        tie = self._rejoining.follow(self._map, keyframe_id)
        if tie is None or self._since_closed < self._config.rest:
            return ()
        ends = (tie.keyframe_id, tie.here), (tie.matched_id, tie.there)
        newer, matched = (self.verifier.read(self._map, k, part) for k, part in ends)
        stamps_ns = tuple(self._map.keyframe(k).stamp_ns for k, _ in ends)
        return (_Candidate(newer, matched, (stamps_ns[0], stamps_ns[1]), tie.unbent),)

    # ---- without the map ----

    def recognise(self, keyframe: Keyframe, news: News) -> None:
        """Look for places like a keyframe's; what is found is read when the next one comes."""
        self.search.index(news)
        found = self.search.find(keyframe, news.recent)
        if self._since_closed >= self._config.rest:
            self._asked = found[: self._config.most]

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
            is_tied = candidate.unbent is not None
            loop = replace(loop, stamps_ns=candidate.stamps_ns, is_tied=is_tied)
            if found.is_accepted:
                tie = Tie(*ends, found)
                path = candidate.path(essentials)
                corrected = correct(path, edges_of(path, (tie,)), self._with_scale)
                same, reason = self._confirming(path, tie, corrected)
                if not reason:
                    loops.append(_closed(loop, essentials, corrected))
                    return loops, Closure((tie,), essentials, corrected, same)
                loop = replace(loop, reason=reason)
            loops.append(loop)
        return loops, None

    def _confirming(
        self, essentials: Essentials, tie: Tie, corrected: Corrected
    ) -> tuple[tuple[Tie, ...], str]:
        """Return what else must speak for a loop, or why it is not believed.

        Where it ties two pieces of the map nothing measured before could contradict it, so that two
        must agree: a look-alike of one place is rarely seen from another as well. And the camera
        must have been able to get there while it was lost.
        """
        if not (corrected.is_accepted and corrected.is_merging.any()):
            return (), corrected.reason
        ends = tie.keyframe_id, tie.matched_id
        if reason := strayed(*ends, essentials, corrected, self._with_scale):
            return (), reason
        other, self._waiting = self._waiting, tie
        known = set(essentials.keyframe_ids.tolist())
        is_there = other is not None and {other.keyframe_id, other.matched_id} <= known
        if other is None or not is_there or other.keyframe_id == tie.keyframe_id:
            return (), "joins two pieces of the map: a second place must say the same"
        other_pieces, pieces = pieces_of(essentials, (other, tie))
        if other_pieces != pieces:
            return (), "joins two pieces of the map, and the place before it two others"
        both = correct(essentials, edges_of(essentials, (other, tie)), self._with_scale)
        if not both.is_believed.all():
            return (), "joins two pieces of the map, but not as the place before it"
        return (other,), ""

    def _with_nodes(self, side: LoopSide) -> LoopSide:
        return side.with_nodes(self.search.nodes(side.descriptors))

    # ---- with the map again ----

    def write(self, closure: Closure, map: Map) -> None:
        """Correct the map by a loop, and begin to look anew."""
        self.search.begin_anew(closure.write(map, self.search.known))
        self._asked, self._since_closed, self._waiting = [], 0, None
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
        keyframe: the new keyframe; None at the end of a run, where none is.
        news: what became of the map's keyframes.
        candidates: of the keyframe before.
        path: what it is corrected with; None without candidates.
    """

    closer: LoopCloser
    keyframe: Keyframe | None
    news: News
    candidates: tuple[_Candidate, ...]
    path: Reading | None

    def solve(self) -> "ClosingChange":
        """Look for places like this one, and decide on those found at the keyframe before."""
        closer = self.closer
        stale = self.news.stale
        if self.keyframe is not None:
            closer.recognise(self.keyframe, self.news)
        if self.path is None:
            return ClosingChange(closer, stale, (), None)
        loops, closure = closer.close(self.candidates, self.path.essentials())
        _log(loops)
        return ClosingChange(closer, stale, tuple(loops), closure)


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


def _closed(loop: Loop, before: Essentials, after: Corrected) -> Loop:
    """Return a loop that is believed, with what it does to the keyframe that came back."""
    k = int(np.searchsorted(before.keyframe_ids, loop.keyframe_id))
    T, T_new = before.Ts_world_body[k], after.Ts_world_body[k]
    return replace(
        loop,
        is_accepted=True,
        merges=bool(after.is_merging[0]),
        moved=float(np.linalg.norm(T_new[:3, 3] - T[:3, 3])),
        turned=float(np.linalg.norm(so3_log(T[:3, :3].T @ T_new[:3, :3]))),
        rescaled=float(after.scales[k] / before.scales[k]),
        doubts=tuple((int(newer), int(matched)) for newer, matched in after.doubted),
    )


def _log(loops: list[Loop]) -> None:
    for loop in loops:
        ends = loop.keyframe_id, loop.matched_id
        if loop.is_accepted:
            text = "keyframe %d is back at %d: %d inliers, moved by %.3g%s%s"
            merged = ", two pieces are one" if loop.merges else ""
            tied = ", where tracking had found the old map again" if loop.is_tied else ""
            said = *ends, loop.num_inliers, loop.moved, merged, tied
            logging.getLogger(__name__).info(text, *said)
            for doubted in loop.doubts:
                text = "keyframe %d is not believed to be back at %d any more: that contradicts %d"
                logging.getLogger(__name__).warning(text, *doubted, loop.keyframe_id)
        else:
            text = "keyframe %d is not back at %d: %s"
            logging.getLogger(__name__).info(text, *ends, loop.reason)
