"""Merging: two maps of one place, each in a world of its own, become one map.

The second is taken in as a piece (`maps/absorbing`), and what closes loops within a run closes them
between the two: each of its keyframes is looked up among the places of the first by words, as if it
came there now, and geometry decides,

    words → revisits → verification → many measured (i, j, S_i_j) → those that agree → closure.

Here all can be asked before any is believed: places of one wall of windows look alike, but do not
agree on where the second map lies. Graduated non-convexity keeps the largest part that does, and
one alone is not enough. Neighbouring keyframes share their landmarks, and with these their errors;
so of the loops that agree only some, well apart, become edges, and all fuse landmarks.

Cost: a query and some 5 ms of geometry per keyframe, and two corrections of the path.

Reference: Elvira, Tardós, Montiel, "ORBSLAM-Atlas", IROS 2019, section IV; Campos et al.,
"ORB-SLAM3", T-RO 2021, section VI.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.limits import Count, check_limits
from odomap.maps.absorbing import Absorbed
from odomap.maps.map import Map
from odomap.maps.states import Placement, compose, inverse
from odomap.system.closing import Verifier
from odomap.system.closure import Closure, Tie, edges_of, pieces_of, read_essentials
from odomap.system.essentialgraph import correct
from odomap.system.loopsearch import ClosingConfig, LoopSearch
from odomap.system.loopsides import LoopSide
from odomap.system.stages import Loop
from odomap.vision.vocabulary import VocabularyTree

__all__ = ["MergeConfig", "Merger", "Merging"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Tell = Callable[[int, int, str], None]


@dataclass(frozen=True)
class MergeConfig:
    """When two maps are one."""

    agreeing: Count = 2
    """Places in common that must agree on how the two lie to each other."""
    apart: Count = 10
    """Keyframes between two loops that become edges."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True, eq=False)
class Merging:
    """What two maps were found to have in common.

    Attributes:
        map: both; where the second is not known if `reason` says something.
        absorbed: what the second's keyframes and landmarks are called in it.
        loops: all places that were compared, by keyframes of the merged map.
        T_first_second: (4, 4) the second's world in the first's, as its first keyframe moved.
        scale: units of the first's world per unit of the second's.
        num_fused: landmarks of the second that are one with some of the first.
        reason: why they are not one; empty if they are.
    """

    map: Map
    absorbed: Absorbed
    loops: tuple[Loop, ...]
    T_first_second: Array
    scale: float = 1.0
    num_fused: int = 0
    reason: str = ""

    @property
    def num_places(self) -> int:
        """How many places in common are believed."""
        return sum(loop.is_accepted for loop in self.loops)


class Merger:
    """Finds the places that two maps have in common, and makes them one.

    Args:
        vocabulary: makes the words.
        verifier: decides by geometry.
        with_scale: whether the two may differ in scale: those of a single camera.
        closing: how places are looked for.
        config: when they are enough.
    """

    def __init__(
        self,
        vocabulary: VocabularyTree,
        verifier: Verifier,
        with_scale: bool,
        closing: ClosingConfig | None = None,
        config: MergeConfig | None = None,
    ) -> None:
        self._verifier, self._with_scale = verifier, with_scale
        self._closing = ClosingConfig() if closing is None else closing
        self._config = MergeConfig() if config is None else config
        self._vocabulary = vocabulary

    def merge(self, first: Map, second: Map, tell: Tell | None = None) -> Merging:
        """Merge two maps; neither is changed.

        Args:
            first: stays where it is.
            second: is brought to it.
            tell: told of every keyframe of the second that is looked up.
        """
        merged = Map.restored(first.dump())
        absorbed, search = merged.absorb(second), LoopSearch(self._vocabulary, self._closing)
        ties, refused = self._compared(merged, absorbed, search, tell or (lambda *_: None))
        nowhere = Merging(merged, absorbed, tuple(refused), np.eye(4))
        if not ties:
            return _without(
                nowhere, ties, f"none of {len(refused)} candidates is a place in common"
            )
        essentials = read_essentials(merged, search.known).essentials()
        found = correct(essentials, edges_of(essentials, ties), self._with_scale)
        believed = [tie for tie, is_true in zip(ties, found.is_believed.tolist()) if is_true]
        pieces = pieces_of(essentials, believed)  # each pair of them needs its own
        agree, needed = Counter(pieces), self._config.agreeing
        most = max(agree.values(), default=0)
        if most < needed:
            return _without(nowhere, ties, f"{most} places in common agree of {needed} needed")
        believed = [tie for tie, both in zip(believed, pieces) if agree[both] >= needed]
        chosen = _apart(believed, self._config.apart)
        if len(chosen) < len(ties):
            found = correct(essentials, edges_of(essentials, chosen), self._with_scale)
            chosen = [tie for tie, is_true in zip(chosen, found.is_believed.tolist()) if is_true]
        if not chosen:
            return _without(nowhere, ties, found.reason)
        before, landmarks = _placed(merged, absorbed.root_id), merged.num_landmarks
        others = tuple(tie for tie in believed if tie not in chosen)
        Closure(tuple(chosen), essentials, found, others).write(merged, search.known)
        T, scale = compose(_placed(merged, absorbed.root_id), inverse(before))
        true = {id(tie) for tie in believed}
        loops = [_loop(tie, id(tie) in true) for tie in ties] + refused
        loops.sort(key=lambda loop: loop.keyframe_id)
        fused = landmarks - merged.num_landmarks
        return Merging(merged, absorbed, tuple(loops), T, float(scale), fused)

    def _compared(
        self, merged: Map, absorbed: Absorbed, search: LoopSearch, tell: Tell
    ) -> tuple[list[Tie], list[Loop]]:
        """Look every keyframe of the second up among those of the first; let geometry decide."""
        ids = absorbed.keyframe_ids
        news = search.follow(merged)
        search.index(news._replace(come=[k for k in news.come if k.id < absorbed.offset]))
        ties: list[Tie] = []
        refused: list[Loop] = []
        for done, k in enumerate(ids.tolist()):
            tell(done, len(ids), f"{len(ties)} places in common")
            revisits = search.find(merged.keyframe(k), ids)[: self._closing.most]
            newer = self._side(merged, k, search) if revisits else None
            for revisit in revisits:
                assert newer is not None
                matched = self._side(merged, revisit.matched_id, search)
                found = self._verifier.verify(newer, matched, k)
                tie = Tie(k, revisit.matched_id, found)
                if found.is_accepted:
                    ties.append(tie)
                    break
                refused.append(_loop(tie, False, found.reason))
        return ties, refused

    def _side(self, map: Map, keyframe_id: int, search: LoopSearch) -> LoopSide:
        side = self._verifier.read(map, keyframe_id)
        return side.with_nodes(search.nodes(side.descriptors))


def _apart(ties: list[Tie], apart: int) -> list[Tie]:
    """Choose loops that are so many keyframes apart, those with most inliers first."""
    chosen: list[Tie] = []
    for tie in sorted(ties, key=lambda tie: (-tie.measured.num_inliers, tie.keyframe_id)):
        if all(abs(tie.keyframe_id - other.keyframe_id) >= apart for other in chosen):
            chosen.append(tie)
    return sorted(chosen, key=lambda tie: tie.keyframe_id)


def _loop(tie: Tie, is_accepted: bool, reason: str = "") -> Loop:
    """Return what observers are told of a place compared."""
    ends, found = (tie.keyframe_id, tie.matched_id), tie.measured
    if not is_accepted:
        reason = reason or "does not agree with other places in common"
    inliers = found.num_inliers
    return Loop(*ends, found.T_matched_keyframe, inliers, is_accepted, reason, is_accepted)


def _without(nowhere: Merging, ties: list[Tie], reason: str) -> Merging:
    """Return what was compared in vain."""
    loops = [*nowhere.loops, *(_loop(tie, False) for tie in ties)]
    loops.sort(key=lambda loop: loop.keyframe_id)
    whole = nowhere.map, nowhere.absorbed, tuple(loops), nowhere.T_first_second
    return Merging(*whole, reason=reason)


def _placed(map: Map, keyframe_id: int) -> Placement:
    return map.T_world_body(keyframe_id), np.asarray(map.scale(keyframe_id))
