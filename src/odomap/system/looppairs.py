"""Pairs of points for two sides of a loop: what one of them knows, found in the other's image.

At first only looks are known: features of both keyframes that have landmarks are compared, by words
of the vocabulary where there are some. Once there is a similarity S between the two cameras, it
says where to look, p → π(S p), on which level of the pyramid, and from which side: all landmarks of
either group are searched near there,

    l = l_ref + log_f (d_ref / d),      n · p / |p| > cos 60°.

A pair is a point that each side may know as a landmark, see as a feature, or both; what is found
both ways comes first, and no feature or landmark belongs to two pairs.

Cost: O(landmarks · features in a circle), 1 ms for 2,000 landmarks.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section VII-B.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.alignransac import Alignment, PairSights
from odomap.geometry.lie import sim3_inverse
from odomap.system.loopsides import LoopSide
from odomap.vision.matching import KeypointGrid, MatchConfig, match_projected, nearest
from odomap.vision.wordmatching import match_words

__all__ = [
    "Expected",
    "FeatureNoise",
    "LoopPairs",
    "match_expected",
    "match_group",
    "match_looks",
    "sights_of",
    "similarity_of",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

LEAST_COSINE = 0.5
"""Of the angle between how a landmark is seen and how it was: 60° are too much for descriptors."""
LEVELS_OFF = 1
"""Levels of the pyramid by which a landmark may be found off the expected one."""


@dataclass(frozen=True, eq=False)
class LoopPairs:
    """Points of both sides.

    Attributes:
        newer_feature: (n,) the newer keyframe's feature that shows each, -1 for none.
        newer_landmark: (n,) the newer side's row of the landmark it is, -1 for none.
        matched_feature: (n,) the same of the matched keyframe.
        matched_landmark: (n,) and of its side.
    """

    newer_feature: Index
    newer_landmark: Index
    matched_feature: Index
    matched_landmark: Index

    def __len__(self) -> int:
        return len(self.newer_feature)

    def at(self, rows: NDArray[np.bool_]) -> "LoopPairs":
        """Return some of them, by a mask (n,)."""
        return LoopPairs(*(column[rows] for column in self.columns))

    @property
    def columns(self) -> tuple[Index, Index, Index, Index]:
        """Feature and landmark of the newer, feature and landmark of the matched."""
        newer = self.newer_feature, self.newer_landmark
        return *newer, self.matched_feature, self.matched_landmark


@dataclass(frozen=True, eq=False)
class Expected:
    """Where landmarks of one side must show in the other's image, if the similarity is right.

    Attributes:
        in_newer: (n, 2) pixels of the newer keyframe's image.
        in_matched: (m, 2) of the matched one's.
    """

    in_newer: Array
    in_matched: Array

    def __len__(self) -> int:
        """Return how many, in the image that must show fewer."""
        return min(len(self.in_newer), len(self.in_matched))


@dataclass(frozen=True, eq=False)
class FeatureNoise:
    """Standard deviation of a feature on the finest level, pixels, and what a level adds."""

    sigma_px: float
    level_scale: float

    def weights(self, side: LoopSide, features: Index) -> Array:
        """Return (n,) inverse variances of features on the plane z = 1."""
        sigma = self.sigma_px * self.level_scale ** side.levels[features].astype(np.float64)
        fx, fy = side.camera.intrinsics[:2]
        return np.asarray(fx * fy / sigma**2)


def similarity_of(S: Alignment) -> Array:
    """Return the (4, 4) similarity [[sR, t], [0, 1]]."""
    T = np.array(S.T_second_first)
    T[:3, :3] *= S.scale
    return T


def match_looks(newer: LoopSide, matched: LoopSide, matching: MatchConfig) -> LoopPairs:
    """Pair features of both keyframes that have landmarks: by words, or all with all without."""
    first, second = (np.flatnonzero(side.landmark_of >= 0) for side in (newer, matched))
    looks = newer.descriptors[first], matched.descriptors[second]
    if newer.nodes is not None and matched.nodes is not None:
        found = match_words(looks[0], newer.nodes[first], looks[1], matched.nodes[second], matching)
    else:
        found = _match_all(*looks, matching)
    first, second = first[found >= 0], second[found[found >= 0]]
    return LoopPairs(first, newer.landmark_of[first], second, matched.landmark_of[second])


def match_group(newer: LoopSide, matched: LoopSide, matching: MatchConfig) -> LoopPairs:
    """Pair all features of the newer keyframe with all landmarks of the matched one's group."""
    found = _match_all(newer.descriptors, matched.landmark_descriptors, matching)
    i = np.flatnonzero(found >= 0)
    b = found[i]
    return LoopPairs(i, newer.landmark_of[i], matched.feature_of[b], b)


def _match_all(first: NDArray[np.uint8], second: NDArray[np.uint8], matching: MatchConfig) -> Index:
    """Return the (N,) clear and mutual best of each descriptor, -1 for none."""
    found, distance, other = nearest(first, second)
    rows = np.flatnonzero((distance <= matching.max_hamming) & (distance < matching.ratio * other))
    back = nearest(second, first)[0]
    matches = np.full(len(first), -1)
    mutual = rows[back[found[rows]] == rows]
    matches[mutual] = found[mutual]
    return matches


def match_expected(
    newer: LoopSide,
    matched: LoopSide,
    S: Alignment,
    level_scale: float,
    radius_px: float,
    matching: MatchConfig,
) -> tuple[LoopPairs, Expected]:
    """Look for the landmarks of either group in the other's image.

    Returns:
        The pairs, and where landmarks should have been found.
    """
    T = similarity_of(S)
    there, in_matched = _search(newer, matched, T, level_scale, radius_px, matching)
    back, in_newer = _search(matched, newer, sim3_inverse(T), level_scale, radius_px, matching)
    from_newer = _completed(there, newer, matched, back)
    from_matched = _completed(back, matched, newer, there)[:, [2, 3, 0, 1]]
    rows = np.concatenate([from_newer, from_matched])
    return _distinct(rows), Expected(in_newer, in_matched)


def _completed(found: Index, side: LoopSide, other: LoopSide, back: Index) -> Index:
    """Return (n, 4) pairs: feature and landmark of a side, feature and landmark of the other.

    Args:
        found: (M,) the other's feature at each landmark of the side, -1 for none.
        side: whose landmarks were looked for.
        other: in whose image.
        back: (M',) the side's feature at each landmark of the other.
    """
    landmark = np.flatnonzero(found >= 0)
    feature = side.feature_of[landmark]
    their_feature = found[landmark]
    their_landmark = other.landmark_of[their_feature]
    # What the side knows of its group only may show in its image all the same, as a free feature.
    shows = np.where(their_landmark >= 0, np.append(back, -1)[their_landmark], -1)
    is_free = (shows >= 0) & (np.append(side.landmark_of, -1)[shows] < 0)
    feature = np.where((feature < 0) & is_free, shows, feature)
    return np.stack([feature, landmark, their_feature, their_landmark], axis=1)


def _search(
    side: LoopSide,
    other: LoopSide,
    T_other_side: Array,
    level_scale: float,
    radius_px: float,
    matching: MatchConfig,
) -> tuple[Index, Array]:
    """Return the (M,) features of the other side at a side's landmarks, -1 for none.

    Beside them the (n, 2) pixels of those landmarks that should show.
    """
    scale = np.cbrt(np.linalg.det(T_other_side[:3, :3]))
    points = side.points_camera @ T_other_side[:3, :3].T + T_other_side[:3, 3]
    away = np.maximum(np.linalg.norm(points, axis=1), 1e-9)
    pixels = other.camera.project(points)
    normals = side.normals @ side.T_world_camera[:3, :3] @ T_other_side[:3, :3].T / scale
    ahead = (points[:, 2] > 0) & other.camera.is_inside(pixels)
    ahead &= np.sum(normals * points, axis=1) > LEAST_COSINE * away
    closer = np.maximum(side.distances / side.scale * scale, 1e-9) / away
    level = side.landmark_levels + np.log(closer) / np.log(level_scale)
    coarsest = int(other.levels.max(initial=0))
    ahead &= (level > -1.5) & (level < coarsest + 1.5)
    pixels[~ahead] = np.nan
    level = np.rint(np.clip(level, 0, coarsest)).astype(np.int64)
    keypoints = other.keypoints.astype(np.float32)
    found = match_projected(
        side.landmark_descriptors,
        pixels,
        radius_px * level_scale ** level.astype(np.float64),
        level - LEVELS_OFF,
        level + LEVELS_OFF,
        other.descriptors,
        keypoints,
        other.levels,
        KeypointGrid.of(keypoints, (other.camera.height, other.camera.width)),
        matching,
    )
    return found, pixels[ahead]


def _distinct(rows: Index) -> LoopPairs:
    """Return (n, 4) pairs without those that contradict others; what both ways say comes first."""
    rows, count = np.unique(rows, axis=0, return_counts=True)
    rows = rows[np.argsort(-count, kind="stable")]
    for column in range(4):
        _, first = np.unique(rows[:, column], return_index=True)
        kept = rows[:, column] < 0
        kept[first] = True
        rows = rows[kept]
    return LoopPairs(*(np.ascontiguousarray(column) for column in rows.T))


def sights_of(
    newer: LoopSide, matched: LoopSide, pairs: LoopPairs, noise: FeatureNoise
) -> PairSights:
    """Return what two cameras know and see of pairs, the newer's first."""
    i, a, j, b = pairs.columns
    return PairSights(
        newer.points_camera[a],
        newer.plane[i],
        np.where((i >= 0) & (b >= 0), noise.weights(newer, i), 0.0),
        matched.points_camera[b],
        matched.plane[j],
        np.where((j >= 0) & (a >= 0), noise.weights(matched, j), 0.0),
    )
