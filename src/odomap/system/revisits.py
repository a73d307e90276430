"""Revisits: which places seen before are worth a closer look, before geometry is asked.

A keyframe looks like many others a little. What its score s(v, v_k) means depends on how much its
features repeat, and is read relative to the score with the keyframe just before, which surely shows
the same place,

    η(v, v_k) = s(v, v_k) / s(v, v_before)  >=  similarity.

Keyframes that see the same landmarks compete for one place: scores are summed over groups of
covisible keyframes, groups far below the best one are left, and the best of each is its candidate.
At last a place has to be pointed at by several keyframes in a row: a group goes on where the groups
of the keyframe before have a keyframe in common with it. A single look-alike does not last.

Cost: one query (`vision/places`), and the covisible keyframes of some candidates.

Reference: Gálvez-López, Tardós, "Bags of binary words for fast place recognition in image
sequences", T-RO 28(5), 2012, sections V-B, V-C; Mur-Artal, Montiel, Tardós, "ORB-SLAM", T-RO 2015,
section VII-A.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from odomap.limits import Count, Fraction, NotNegative, check_limits
from odomap.vision.places import Candidates, Places
from odomap.vision.vocabulary import BagOfWords

__all__ = ["Revisit", "RevisitConfig", "Revisits"]

Index = NDArray[np.int64]
Covisible = Callable[[int], Index]


@dataclass(frozen=True)
class RevisitConfig:
    """When a place seen before is worth a closer look."""

    similarity: NotNegative = 0.3
    """Least score of a place, relative to that with the keyframe just before."""
    least_reference: Fraction = 0.01
    """A keyframe that is less like the one before than this is compared with none."""
    keyframes: Count = 30
    """Keyframes that may be candidates at a time, the most alike."""
    group: Count = 10
    """Keyframes of a place: one and those that share most landmarks with it."""
    group_share: Fraction = 0.75
    """Summed score of a place relative to that of the best one."""
    in_a_row: Count = 3
    """Keyframes one after the other that must point at the same place."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True, eq=False)
class Revisit:
    """A place that a keyframe looks like.

    Attributes:
        keyframe_id: the keyframe that came.
        matched_id: that of the place which is most like it.
        group: (n,) keyframes of the place, `matched_id` first, then those that share most with it.
        score: of the two, 0 to 1.
        similarity: score relative to that with the keyframe just before.
        total: summed scores of the place, relative to the same.
        num_in_a_row: keyframes one after the other that pointed at it, this one included.
        reason: why it is not worth a closer look; empty if it is.
    """

    keyframe_id: int
    matched_id: int
    group: Index
    score: float
    similarity: float
    total: float
    num_in_a_row: int
    reason: str = ""

    @property
    def is_candidate(self) -> bool:
        """Whether it is worth a closer look."""
        return not self.reason


class Revisits:
    """Looks for places that were seen before, keyframe by keyframe.

    Args:
        places: what was seen; it is read only.
        config: when a place counts.
    """

    def __init__(self, places: Places, config: RevisitConfig | None = None) -> None:
        self._places = places
        self._config = RevisitConfig() if config is None else config
        self._before: BagOfWords | None = None
        self._chains: list[tuple[frozenset[int], int]] = []

    def find(
        self, keyframe_id: int, bow: BagOfWords, excluded: ArrayLike, covisible: Covisible
    ) -> list[Revisit]:
        """Find the places that a keyframe may have come back to.

        To be asked for all keyframes in their order, each before or after it is added to the
        database.

        Args:
            keyframe_id: of the keyframe, which is not compared with itself.
            bow: its words.
            excluded: (E,) keyframes that are no revisit: those that share landmarks with it, and
                the last ones.
            covisible: of a keyframe those that share landmarks with it, most first
                (`Map.covisible(k)[0]`).

        Returns:
            The places, the most alike first, also those that did not last long enough yet.
        """
        config, before = self._config, self._before
        self._before = bow
        reference = 0.0 if before is None else bow.score(before)
        if reference < config.least_reference or reference <= 0.0:
            self._chains = []
            return []
        unwanted = np.append(np.asarray(excluded, np.int64).ravel(), keyframe_id)
        least = config.similarity * reference
        found = self._places.query(bow, config.keyframes, unwanted, least)
        groups = group_scores(found, covisible, config.group, config.group_share)
        chains: list[tuple[frozenset[int], int]] = []
        revisits = []
        for matched, members, score, total in groups:
            place = frozenset(members.tolist())
            length = 1 + max((n for other, n in self._chains if other & place), default=0)
            chains.append((place, length))
            missing = length < config.in_a_row
            reason = f"seen {length} times in a row of {config.in_a_row} needed" if missing else ""
            similar = score / reference, total / reference
            revisits.append(Revisit(keyframe_id, matched, members, score, *similar, length, reason))
        self._chains = chains
        return revisits

    def forget(self) -> None:
        """Begin anew: after a loop was closed, or when tracking was lost."""
        self._before, self._chains = None, []


def group_scores(
    found: Candidates, covisible: Covisible, size: int, share: float
) -> list[tuple[int, Index, float, float]]:
    """Let candidates that see the same landmarks compete for one place.

    Args:
        found: candidates.
        covisible: of a keyframe those that share landmarks with it, most first.
        size: keyframes of a group, at most.
        share: of the best group's summed score that others must have.

    Returns:
        For each place its best keyframe, the group of that, the score of it and the summed score
        of the best group it is in; the best keyframe first. A keyframe of a better one's group is
        no place of its own.
    """
    scores = dict(zip(found.keyframe_ids.tolist(), found.scores.tolist()))
    groups = {k: np.append(k, covisible(k))[:size].astype(np.int64) for k in scores}
    best: dict[int, float] = {}
    for members in groups.values():
        inside = [m for m in members.tolist() if m in scores]
        total = sum(scores[m] for m in inside)
        winner = min(inside, key=lambda m: (-scores[m], m))
        best[winner] = max(total, best.get(winner, 0.0))
    bar = share * max(best.values(), default=0.0)
    kept: list[int] = []
    for k in sorted((k for k in best if best[k] >= bar), key=lambda k: (-scores[k], k)):
        if not any(k in groups[better] for better in kept):
            kept.append(k)
    return [(k, groups[k], scores[k], best[k]) for k in kept]
