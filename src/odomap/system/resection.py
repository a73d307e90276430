"""Resection: the pose of a view from what a few keyframes see, without a prediction.

Features of the view are compared by descriptor alone with the landmarks of a keyframe and of those
that share landmarks with it; with a vocabulary, only those that pass the same node of its tree.
Pairs of pixel and landmark give the pose: P3P in RANSAC, then a guided search for the landmarks
that the pose expects to be seen, then least squares,

    min over T_world_camera of  Σ ρ(|π(T_world_camera⁻¹ pᵢ) - xᵢ|² / σ(levelᵢ)²).

A pose counts only if enough landmarks agree and their pixels are spread: a single poster looks the
same on every wall. Spread is the area of the ellipse with the pixels' covariance, 4 π √det Σ.

Cost: O(N M) distances for N features and M landmarks, ten times less with words: some 8 ms then.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section V-C (relocalisation).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_inverse
from odomap.geometry.pnp import PnpResult, refine_pose, solve_pnp
from odomap.maps.map import Map
from odomap.vision.coverage import coverage
from odomap.vision.matching import KeypointGrid, MatchConfig, match_projected, nearest
from odomap.vision.wordmatching import match_words

__all__ = ["FEWEST", "Place", "Recognised", "Resection", "Sight", "pairs", "votes"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Descriptors = NDArray[np.uint8]

FEWEST = 8
"""Landmarks that must agree by descriptors alone for the guided search to begin."""
THRESHOLD_PX = 4.0
"""Largest error of an inlier on the finest level."""
GUIDED_PX = 8.0
"""Radius in which landmarks are looked for once there is a pose."""
SAMPLES = 300
"""Most triples drawn: every fifth pair has to be right."""
SPREAD = 0.05
"""Share of the image that the inliers must cover."""


@dataclass(frozen=True, eq=False)
class Recognised:
    """Where a view was taken.

    Attributes:
        T_world_camera: (4, 4).
        covariance: (6, 6) of it, tangent (translation, rotation), right update.
        landmark_ids: (n,) landmarks seen in the view.
        rows: (n,) at which of its features.
        keyframe_id: the keyframe that sees most of them.
    """

    T_world_camera: Array
    covariance: Array
    landmark_ids: Index
    rows: Index
    keyframe_id: int

    @property
    def num_inliers(self) -> int:
        """How many landmarks agree with the pose."""
        return len(self.rows)


@dataclass(frozen=True, eq=False)
class Sight:
    """The view.

    Attributes:
        descriptors: (N, 32).
        keypoints: (N, 2).
        levels: (N,) of the pyramid.
        sigma: (N,) of the keypoints, 1 on the finest level.
        nodes: (N,) of the features in the direct index; None without a vocabulary.
    """

    descriptors: Descriptors
    keypoints: Array
    levels: NDArray[np.uint8]
    sigma: Array
    nodes: Index | None = None


@dataclass(frozen=True, eq=False)
class Place:
    """What a keyframe sees.

    Attributes:
        keyframe_id: the keyframe.
        landmark_ids: (M,) its landmarks.
        descriptors: (M, 32) how they look in it.
        nodes: (M,) of that in the direct index; None without a vocabulary.
    """

    keyframe_id: int
    landmark_ids: Index
    descriptors: Descriptors
    nodes: Index | None = None


class Resection:
    """Finds poses from places.

    Args:
        map: where the landmarks are; it is read only.
        camera: the ideal pinhole of the views.
        matching: how descriptors are compared.
        min_inliers: landmarks that must agree.
    """

    def __init__(self, map: Map, camera: Camera, matching: MatchConfig, min_inliers: int) -> None:
        self._map, self._camera, self._matching = map, camera, matching
        self._min_inliers = min_inliers

    def locate(
        self, view: Sight, group: Sequence[Place], seed: int
    ) -> Recognised | tuple[int, str]:
        """Find the pose from a place and those around it.

        Args:
            view: what is seen.
            group: the place that it may be, first, and its neighbours.
            seed: of the random draws.

        Returns:
            What was recognised, or how many landmarks agreed at most and what was wrong.
        """
        rows, ids = _joined([pairs(view, place, self._matching) for place in group])
        start = solve_pnp(
            self._map.points_world(ids),
            view.keypoints[rows],
            self._camera,
            seed=seed,
            threshold_px=THRESHOLD_PX,
            sigma_px=view.sigma[rows],
            max_iterations=SAMPLES,
            min_inliers=FEWEST,
        )
        if not start.converged:
            return start.num_inliers, self._too_few(start.num_inliers)
        result, rows, ids = self._grown(view, group, start)
        rows, ids = rows[result.inliers], ids[result.inliers]
        if len(rows) < self._min_inliers:
            return len(rows), self._too_few(len(rows))
        share = coverage(view.keypoints[rows], self._camera)
        if not result.converged or share < SPREAD:
            why = result.reason or f"all that agrees is in {100 * share:.0f} % of the image"
            return len(rows), why
        seen_by = self._map.observing(ids)[0]
        if not len(seen_by):
            return len(rows), "no keyframe shows what agrees any more"
        most_seen = int(seen_by[0])
        return Recognised(result.T_world_camera.matrix, result.covariance, ids, rows, most_seen)

    def _too_few(self, agreed: int) -> str:
        return f"{agreed} landmarks agree of {self._min_inliers} needed: another place?"

    def _grown(
        self, view: Sight, group: Sequence[Place], start: PnpResult
    ) -> tuple[PnpResult, Index, Index]:
        """Look for all landmarks that a pose expects to be seen, and refine it on them.

        Returns:
            The refined pose, features (n,) and their landmarks (n,).
        """
        ids, first = np.unique(np.concatenate([p.landmark_ids for p in group]), return_index=True)
        looks = np.concatenate([p.descriptors for p in group])[first]
        points, keypoints = self._map.points_world(ids), view.keypoints.astype(np.float32)
        grid = KeypointGrid.of(keypoints, (self._camera.height, self._camera.width))
        finest, coarsest = np.zeros(len(ids), np.int64), np.full(len(ids), 255, np.int64)
        radius, result = np.full(len(ids), GUIDED_PX), start
        for _ in range(2):
            T_camera_world = se3_inverse(np.asarray(result.T_world_camera.matrix))
            ahead = points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
            guess = self._camera.project(ahead)
            guess[~self._camera.is_inside(guess)] = np.nan
            found = match_projected(
                looks,
                guess,
                radius,
                finest,
                coarsest,
                view.descriptors,
                keypoints,
                view.levels,
                grid,
                self._matching,
            )
            seen = np.flatnonzero(found >= 0)
            rows = found[seen]
            result = refine_pose(
                points[seen],
                view.keypoints[rows],
                self._camera,
                result.T_world_camera,
                threshold_px=THRESHOLD_PX,
                sigma_px=view.sigma[rows],
                huber=1.5,
            )
        return result, rows, ids[seen]


def votes(descriptors: Descriptors, place: Place, matching: MatchConfig) -> int:
    """Return how many features clearly look like something that a keyframe sees."""
    _, distance, second = nearest(descriptors, place.descriptors)
    return int(np.count_nonzero(_is_clear(distance, second, matching)))


def pairs(view: Sight, place: Place, matching: MatchConfig) -> tuple[Index, Index]:
    """Return features (n,) and the landmarks (n,) they clearly look like, and which do so."""
    if view.nodes is not None and place.nodes is not None:
        match = match_words(view.descriptors, view.nodes, place.descriptors, place.nodes, matching)
        rows = np.flatnonzero(match >= 0)
        return rows, place.landmark_ids[match[rows]]
    match, distance, second = nearest(view.descriptors, place.descriptors)
    rows = np.flatnonzero(_is_clear(distance, second, matching))
    looked_at, back = np.unique(match[rows], return_inverse=True)
    mutual = nearest(place.descriptors[looked_at], view.descriptors)[0][back] == rows
    return rows[mutual], place.landmark_ids[match[rows[mutual]]]


def _is_clear(distance: Index, second: Index, matching: MatchConfig) -> NDArray[np.bool_]:
    return (distance <= matching.max_hamming) & (distance < matching.ratio * second)


def _joined(matches: list[tuple[Index, Index]]) -> tuple[Index, Index]:
    """Join the matches of several keyframes, the one that most of them agree on first.

    Returns:
        Features (n,) and landmarks (n,), none of them twice.
    """
    rows = np.concatenate([rows for rows, _ in matches])
    ids = np.concatenate([ids for _, ids in matches])
    stride = int(ids.max(initial=0)) + 1
    both, count = np.unique(rows * stride + ids, return_counts=True)
    rows, ids = np.divmod(both[np.argsort(-count, kind="stable")], stride)
    first = np.sort(np.unique(rows, return_index=True)[1])
    rows, ids = rows[first], ids[first]
    first = np.sort(np.unique(ids, return_index=True)[1])
    return rows[first], ids[first]
