"""Verification: whether two keyframes show one place, and how they lie to each other.

Words say that two views look alike; many do. What decides is geometry, and what comes of it is the
measurement that a loop edge is made of, so nothing here reads where the drifted path says they are:

    features of both that have landmarks, matched by words → pairs of points
    three pairs → S (Horn; a scale for a single camera), RANSAC, judged in both images; where that
        finds none, from points of one side and pixels of the other (P3P)
    landmarks of either group, projected by S into the other's image → more pairs
    min over S of Σ ρ(|x - π(S⁻¹ q)|²/σ²) + ρ(|y - π(S p)|²/σ²)  →  S and its covariance.

A place counts only if enough points agree, if they are spread over both images, or over what must
show of the other side there (a single poster looks the same on every wall), and if they are a good
part of what must show (of one door among identical ones the door agrees, and nothing around it).
Each refusal says what was found, what was needed, and where. Draws come from the caller's seed.

Cost: O(samples · pairs) and O(landmarks · features in a circle); some 5 ms.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section VII-B; Mur-Artal, Tardós, "ORB-SLAM2", T-RO 2017, section III-C.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.alignransac import Alignment, refine_alignment, solve_alignment
from odomap.geometry.lie import sim3_adjoint
from odomap.geometry.pnp import solve_pnp
from odomap.limits import Count, Fraction, NotNegative, Positive, check_limits
from odomap.system.looppairs import (
    Expected,
    FeatureNoise,
    LoopPairs,
    match_expected,
    match_group,
    match_looks,
    sights_of,
    similarity_of,
)
from odomap.system.loopsides import LoopSide
from odomap.vision.coverage import coverage
from odomap.vision.matching import MatchConfig

__all__ = ["Verified", "VerifyConfig", "verify"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

BOTH = 2.0
"""Two pixels are compared, each with its error: twice the variance of one."""
LEAST_SPREAD = 0.01
"""Share of an image that is covered in any case: what is smaller shows how to turn, not where."""
WIDE = 4.0
"""Factor on the gate while the alignment is still rough."""


@dataclass(frozen=True)
class VerifyConfig:
    """When two keyframes show one place."""

    min_matches: Count = 12
    """Pairs of landmarks that must look alike for geometry to be asked."""
    first_inliers: Count = 8
    """Of them those that must agree for more to be looked for."""
    min_inliers: Count = 30
    """Points that must agree at last."""
    spread: Fraction = 0.05
    """Share of each image that they must cover: the ellipse with the pixels' covariance."""
    spread_share: Fraction = 0.25
    """Part of what must show that is enough to be covered where that is little of an image, as of a
    road seen from further back: half its width and half its height."""
    share: Fraction = 0.2
    """Least part of the landmarks expected to show that must agree."""
    ransac_iterations: Count = 300
    """Samples at most."""
    confidence: Fraction = 0.999
    """Probability of a clean sample at which the search stops."""
    gate: Positive = 9.21
    """Squared error of an inlier in variances, 99 % of two degrees of freedom stay below."""
    shared_px: NotNegative = 0.1
    """What errors that all points share are worth, pixels: the calibration, the poses that made
    the landmarks; they do not average out."""
    huber: Positive = 2.5
    """Standard deviations beyond which errors count less."""
    radius_px: Positive = 10.0
    """How far from its expected place a landmark is searched at first, on the finest level."""
    rounds: Count = 1
    """How often what was found is refined and searched again, with half the radius."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True, eq=False)
class Verified:
    """What was found about a candidate.

    Attributes:
        T_matched_keyframe: (4, 4) measured pose of the newer keyframe's body in the matched one's,
            in units of the matched; the identity where none was found.
        scale: units of the matched per unit of the newer; 1 where both are metric.
        information: (6, 6) of T_matched_keyframe, tangent (translation, rotation), right update;
            zero where it was not accepted.
        num_inliers: points that agree.
        pairs: (P, 2) landmarks, the newer's and the matched's, that are one point.
        reason: why it is not one place; empty where it is.
        covariance: (7, 7) of the similarity, tangent of Sim(3): translation in units of the newer,
            rotation, log scale (zeros where it is known); right update.
        seen_by_newer: (Q, 2) features of the newer keyframe without landmark, and the matched
            side's landmark each shows.
        seen_by_matched: (Q, 2) the same the other way round.
    """

    T_matched_keyframe: Array
    scale: float
    information: Array
    num_inliers: int
    pairs: Index
    reason: str
    covariance: Array = field(default_factory=lambda: np.zeros((7, 7)))
    seen_by_newer: Index = field(default_factory=lambda: np.empty((0, 2), np.int64))
    seen_by_matched: Index = field(default_factory=lambda: np.empty((0, 2), np.int64))

    @property
    def is_accepted(self) -> bool:
        """Whether the two show one place."""
        return not self.reason


def verify(
    newer: LoopSide,
    matched: LoopSide,
    T_body_camera: Array,
    sigma_px: float,
    level_scale: float,
    with_scale: bool,
    config: VerifyConfig,
    matching: MatchConfig,
    seed: int,
) -> Verified:
    """Decide whether two keyframes show one place, and measure how they lie to each other.

    Args:
        newer: the keyframe that came back.
        matched: the one of the place it may have come back to.
        T_body_camera: (4, 4) mount of the camera.
        sigma_px: standard deviation of a feature's position on the finest level.
        level_scale: size of a pyramid level's pixels relative to those of the finer one.
        with_scale: whether the two may differ in scale: those of a single camera.
        config: what is needed.
        matching: how descriptors are compared.
        seed: of the random draws.
    """
    noise, seek = FeatureNoise(sigma_px, level_scale), _Search(with_scale, config, matching, seed)
    where = f"between keyframes {newer.keyframe_id} and {matched.keyframe_id}"
    best = seek.start(newer, matched, noise)
    if isinstance(best, str):
        return _refused(f"{best} {where}")
    radius, gate = config.radius_px, BOTH * config.gate
    pairs, expected = match_expected(newer, matched, best, level_scale, radius, matching)
    for _ in range(config.rounds):
        sights = sights_of(newer, matched, pairs, noise)
        best = refine_alignment(sights, best, with_scale, gate, config.huber)
        radius *= 0.5
        pairs, expected = match_expected(newer, matched, best, level_scale, radius, matching)
    sights = sights_of(newer, matched, pairs, noise)
    best = refine_alignment(sights, best, with_scale, gate, config.huber)
    inliers = pairs.at(best.inliers)
    reason = _reason(newer, matched, inliers, best, expected, config)
    together = 1.0 + len(inliers) * config.shared_px**2 / (BOTH * sigma_px**2)
    best = replace(best, covariance=together * best.covariance)
    return _verified(newer, matched, inliers, best, T_body_camera, reason and f"{reason} {where}")


@dataclass(frozen=True, eq=False)
class _Search:
    """How a first alignment is looked for."""

    with_scale: bool
    config: VerifyConfig
    matching: MatchConfig
    seed: int

    def start(self, newer: LoopSide, matched: LoopSide, noise: FeatureNoise) -> Alignment | str:
        """Find one from points that both know, or else from points the matched knows.

        Returns:
            The alignment, or what is missing.
        """
        config, pairs = self.config, match_looks(newer, matched, self.matching)
        sights = sights_of(newer, matched, pairs, noise)
        gate = WIDE * BOTH * config.gate
        confidence, iterations = config.confidence, config.ransac_iterations
        found = solve_alignment(sights, self.with_scale, self.seed, gate, confidence, iterations)
        if found.num_inliers >= config.first_inliers:
            return refine_alignment(sights, found, self.with_scale, gate, config.huber)
        more = match_group(newer, matched, self.matching)
        if len(more) < config.min_matches:
            return f"{len(more)} matches of {config.min_matches} needed"
        seen = self._resected(newer, matched, more, noise)
        if seen.num_inliers >= config.first_inliers:
            return seen
        agreed = max(found.num_inliers, seen.num_inliers)
        return f"{agreed} inliers of {config.first_inliers} needed among {len(more)} matches"

    def _resected(
        self, newer: LoopSide, matched: LoopSide, pairs: LoopPairs, noise: FeatureNoise
    ) -> Alignment:
        """Place the newer camera among the matched's landmarks; the scale is that of depths."""
        points = matched.points_camera[pairs.matched_landmark]
        sigma_px = noise.sigma_px * noise.level_scale ** newer.levels[pairs.newer_feature].astype(
            np.float64
        )
        pose = solve_pnp(
            points,
            newer.keypoints[pairs.newer_feature],
            newer.camera,
            seed=self.seed,
            threshold_px=float(np.sqrt(WIDE * BOTH * self.config.gate)) * noise.sigma_px,
            sigma_px=sigma_px,
            confidence=self.config.confidence,
            max_iterations=self.config.ransac_iterations,
            min_inliers=self.config.first_inliers,
        )
        T, scale, inliers = np.array(pose.T_world_camera.matrix), 1.0, pose.inliers
        if self.with_scale and pose.converged:
            both = pose.inliers & (pairs.newer_landmark >= 0)
            depth = (points[both] - T[:3, 3]) @ T[:3, 2]
            known = newer.points_camera[pairs.newer_landmark[both], 2]
            inliers = inliers if np.count_nonzero(both) >= 3 else np.zeros_like(inliers)
            scale = float(np.median(depth / np.maximum(known, 1e-9))) if inliers.any() else 1.0
        if not (pose.converged and scale > 0):
            inliers = np.zeros_like(inliers)
        return Alignment(T, scale, inliers, np.full((7, 7), np.inf), bool(inliers.any()))


# ---- judging ----


def _reason(
    newer: LoopSide,
    matched: LoopSide,
    inliers: LoopPairs,
    best: Alignment,
    expected: Expected,
    config: VerifyConfig,
) -> str:
    """Say what is missing for two keyframes to show one place; empty if nothing is."""
    found = best.num_inliers
    if found < config.min_inliers:
        return f"{found} inliers of {config.min_inliers} needed"
    if not best.converged:
        return f"{found} inliers do not determine the relative pose"
    for side, features, pixels in (
        (newer, inliers.newer_feature, expected.in_newer),
        (matched, inliers.matched_feature, expected.in_matched),
    ):
        shown = features[features >= 0]
        covered = coverage(side.keypoints[shown], side.camera)
        enough = max(config.spread_share * coverage(pixels, side.camera), LEAST_SPREAD)
        needed = min(config.spread, enough)
        if covered < needed:
            what = f"{found} inliers cover {100 * covered:.1f} % of keyframe {side.keyframe_id}"
            if len(shown) < found:
                what = (
                    f"of {found} inliers keyframes around {side.keyframe_id} saw "
                    f"{found - len(shown)}, and in its own image {len(shown)} show, which cover "
                    f"{100 * covered:.1f} %"
                )
            return f"{what}, {100 * needed:.1f} % needed,"
    if found < config.share * len(expected):
        return (
            f"{found} inliers of {len(expected)} landmarks expected to show, "
            f"{100 * config.share:.0f} % needed,"
        )
    return ""


def _verified(
    newer: LoopSide,
    matched: LoopSide,
    inliers: LoopPairs,
    best: Alignment,
    T_body_camera: Array,
    reason: str,
) -> Verified:
    """Bring the alignment of the cameras to their bodies."""
    T = T_body_camera @ similarity_of(best) @ np.linalg.inv(T_body_camera)
    T[:3, :3] /= best.scale
    if reason:
        return replace(_refused(reason, best.num_inliers), T_matched_keyframe=T, scale=best.scale)
    Ad = sim3_adjoint(T_body_camera)
    covariance = Ad @ best.covariance @ Ad.T
    unit = np.array([best.scale] * 3 + [1.0] * 3)
    information = np.linalg.inv(unit[:, None] * covariance[:6, :6] * unit)
    i, a, j, b = inliers.columns
    both, new_sight, old_sight = (a >= 0) & (b >= 0), (a < 0) & (i >= 0), (b < 0) & (j >= 0)
    return Verified(
        T,
        best.scale,
        0.5 * (information + information.T),
        best.num_inliers,
        np.stack([newer.landmark_ids[a[both]], matched.landmark_ids[b[both]]], axis=1),
        "",
        covariance,
        np.stack([i[new_sight], matched.landmark_ids[b[new_sight]]], axis=1),
        np.stack([j[old_sight], newer.landmark_ids[a[old_sight]]], axis=1),
    )


def _refused(reason: str, num_inliers: int = 0) -> Verified:
    none = np.empty((0, 2), np.int64)
    return Verified(np.eye(4), 1.0, np.zeros((6, 6)), num_inliers, none, reason)
