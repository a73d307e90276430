"""Recognition: where in a map a view was taken, without a prediction.

The features of the view are compared by descriptor alone with those that keyframes have landmarks
at. The keyframes with the most clear matches are candidates; each is joined by those that share
its landmarks, and pairs of pixel and landmark give the pose: P3P in RANSAC, then a guided search
for the landmarks that the pose expects to be seen, then least squares,

    min over T_world_camera of  Σ ρ(|π(T_world_camera⁻¹ pᵢ) - xᵢ|² / σ(levelᵢ)²).

A pose counts only if enough landmarks agree and their pixels are spread: a single poster looks the
same on every wall. Spread is the area of the ellipse with the pixels' covariance, 4 π √det Σ.
Nothing is drawn but from the caller's seed.

Cost: O(K N M) for K keyframes of M landmarks and N features. K is bounded by `most`; what was not
compared is compared by the next call, so that all of a large map have their turn.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section V-C (relocalisation).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.camera import Camera
from odomap.geometry.lie import se3_inverse
from odomap.geometry.pnp import PnpResult, refine_pose, solve_pnp
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.vision.matching import MatchConfig, match_guided, nearest

__all__ = ["MOST", "Recognised", "Recognizer", "describes_places"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Descriptors = NDArray[np.uint8]

MOST = 100
"""Keyframes compared per call."""
VOTERS = 250
"""Features of the view that vote for keyframes; all are matched with the candidates."""
CANDIDATES = 4
"""Keyframes that a pose is looked for with."""
NEIGHBOURS = 5
"""Keyframes that join a candidate: those that share most landmarks with it."""
FIRST_INLIERS = 8
"""Landmarks that must agree by descriptors alone for the guided search to begin."""
THRESHOLD_PX = 4.0
"""Largest error of an inlier on the finest level."""
GUIDED_PX = 8.0
"""Radius in which landmarks are looked for once there is a pose."""
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
class _Sight:
    """The view: descriptors (N, 32), keypoints (N, 2), and their (N,) σ, 1 on the finest level."""

    descriptors: Descriptors
    keypoints: Array
    sigma: Array


@dataclass(frozen=True, eq=False)
class _Place:
    """A keyframe's landmarks (M,), and how they look in it, (M, 32)."""

    keyframe_id: int
    landmark_ids: Index
    descriptors: Descriptors


class Recognizer:
    """Recognises views of the places in a map.

    Args:
        map: what is remembered; it is read only.
        camera: the ideal pinhole of the views.
        T_body_camera: (4, 4) its mount.
        matching: how descriptors are compared.
        min_inliers: landmarks that must agree.
        level_scale: size of a pyramid level's pixels relative to those of the finer one.
    """

    def __init__(
        self,
        map: Map,
        camera: Camera,
        T_body_camera: Array,
        matching: MatchConfig,
        min_inliers: int,
        level_scale: float = 1.2,
    ) -> None:
        self._map, self._camera, self._T_body_camera = map, camera, T_body_camera
        self._matching, self._min_inliers = matching, min_inliers
        self._level_scale = level_scale
        self._tried: set[int] = set()

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
            guess: (4, 4) a T_world_camera: keyframes near it are compared first; by default the
                newest are.
            most: keyframes to compare; the next calls go on with the others, until one succeeds.

        Returns:
            The pose and what is seen, or a sentence that says why there is none.
        """
        sigma = self._level_scale ** levels.astype(np.float64)
        view = _Sight(descriptors, np.asarray(keypoints, np.float64), sigma)
        if len(descriptors) < self._min_inliers:
            return f"{len(descriptors)} features of {self._min_inliers} needed: nothing to see?"
        places = self._next_places(guess, most)
        if not places:
            return "no keyframe of the map has landmarks with descriptors"
        step = -(-len(descriptors) // VOTERS)
        voters = np.ascontiguousarray(descriptors[::step])
        votes = [self._votes(voters, place) for place in places]
        best, reason = 0, "nothing of the map looks like this"
        for row in np.argsort(-np.asarray(votes), kind="stable")[:CANDIDATES].tolist():
            found = self._locate(view, places[row], seed)
            if isinstance(found, Recognised):
                self._tried.clear()
                return found
            agreed, said = found
            if agreed > best:
                best, reason = agreed, said
        return f"{reason}; {len(places)} of {self._map.num_keyframes} keyframes compared"

    def _next_places(self, guess: Array | None, most: int) -> list[_Place]:
        """Return the next keyframes to compare; from the first again when all had their turn."""
        ids = self._in_order(guess)
        left = [k for k in ids if k not in self._tried]
        if not left:
            self._tried.clear()
            left = ids
        chosen = left[:most]
        self._tried.update(chosen)
        places = [self._place(k) for k in chosen]
        return [place for place in places if place is not None]

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

    def _place(self, keyframe_id: int) -> _Place | None:
        """Return what a keyframe sees; None where that is nothing that could be recognised."""
        features = self._map.keyframe(keyframe_id).features
        if features is None or features.descriptors.shape[1] != 32:
            return None
        ids, keypoints = self._map.observations_of(keyframe_id)
        ids, keypoints = ids[keypoints >= 0], keypoints[keypoints >= 0]
        if len(ids) < FIRST_INLIERS:
            return None
        return _Place(keyframe_id, ids, np.ascontiguousarray(features.descriptors[keypoints]))

    def _votes(self, descriptors: Descriptors, place: _Place) -> int:
        """Return how many features clearly look like something that a keyframe sees."""
        _, distance, second = nearest(descriptors, place.descriptors)
        return int(np.count_nonzero(self._is_clear(distance, second)))

    def _pairs(self, descriptors: Descriptors, place: _Place) -> tuple[Index, Index]:
        """Return features (n,) and the landmarks (n,) they clearly look like, and which do so."""
        match, distance, second = nearest(descriptors, place.descriptors)
        rows = np.flatnonzero(self._is_clear(distance, second))
        looked_at, back = np.unique(match[rows], return_inverse=True)
        mutual = nearest(place.descriptors[looked_at], descriptors)[0][back] == rows
        return rows[mutual], place.landmark_ids[match[rows[mutual]]]

    def _is_clear(self, distance: Index, second: Index) -> NDArray[np.bool_]:
        limits = self._matching
        return (distance <= limits.max_hamming) & (distance < limits.ratio * second)

    def _locate(self, view: _Sight, place: _Place, seed: int) -> Recognised | tuple[int, str]:
        """Find the pose from a candidate and its neighbours.

        Returns:
            What was recognised, or how many landmarks agreed at most and what was wrong.
        """
        near = self._map.covisible(place.keyframe_id)[0][:NEIGHBOURS].tolist()
        group = [place, *(p for p in map(self._place, near) if p is not None)]
        rows, ids = _joined([self._pairs(view.descriptors, p) for p in group])
        start = solve_pnp(
            self._map.points_world(ids),
            view.keypoints[rows],
            self._camera,
            seed=seed,
            threshold_px=THRESHOLD_PX,
            sigma_px=view.sigma[rows],
            min_inliers=FIRST_INLIERS,
        )
        if not start.converged:
            return start.num_inliers, self._too_few(start.num_inliers)
        result, rows, ids = self._grown(view, group, start)
        rows, ids = rows[result.inliers], ids[result.inliers]
        if len(rows) < self._min_inliers:
            return len(rows), self._too_few(len(rows))
        share = _spread(view.keypoints[rows]) / (self._camera.width * self._camera.height)
        if not result.converged or share < SPREAD:
            why = result.reason or f"all that agrees is in {100 * share:.0f} % of the image"
            return len(rows), why
        return Recognised(
            result.T_world_camera.matrix, result.covariance, ids, rows, _most_seen(group, ids)
        )

    def _too_few(self, agreed: int) -> str:
        return f"{agreed} landmarks agree of {self._min_inliers} needed: another place?"

    def _grown(
        self, view: _Sight, group: list[_Place], start: PnpResult
    ) -> tuple[PnpResult, Index, Index]:
        """Look for all landmarks that a pose expects to be seen, and refine it on them.

        Returns:
            The refined pose, features (n,) and their landmarks (n,).
        """
        ids, first = np.unique(np.concatenate([p.landmark_ids for p in group]), return_index=True)
        looks = np.concatenate([p.descriptors for p in group])[first]
        points = self._map.points_world(ids)
        result, config = start, replace(self._matching, radius_px=GUIDED_PX)
        for _ in range(2):
            T_camera_world = se3_inverse(np.asarray(result.T_world_camera.matrix))
            ahead = points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
            guess = self._camera.project(ahead)
            guess[~self._camera.is_inside(guess)] = np.nan
            found = match_guided(
                looks, guess, view.descriptors, view.keypoints.astype(np.float32), config
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


def describes_places(map: Map) -> bool:
    """Return whether a map has what recognition needs: landmarks seen by described features."""
    with map.lock:
        return any(
            _is_described(map.keyframe(k)) and len(map.observations_of(k)[0])
            for k in map.keyframe_ids.tolist()
        )


def _is_described(keyframe: Keyframe) -> bool:
    features = keyframe.features
    return features is not None and features.descriptors.shape[1] == 32


def _joined(pairs: list[tuple[Index, Index]]) -> tuple[Index, Index]:
    """Join the matches of several keyframes, the one that most of them agree on first.

    Returns:
        Features (n,) and landmarks (n,), none of them twice.
    """
    rows = np.concatenate([rows for rows, _ in pairs])
    ids = np.concatenate([ids for _, ids in pairs])
    both, count = np.unique(np.stack([rows, ids], axis=1), axis=0, return_counts=True)
    both = both[np.argsort(-count, kind="stable")]
    for column in (0, 1):
        both = both[np.sort(np.unique(both[:, column], return_index=True)[1])]
    return np.ascontiguousarray(both[:, 0]), np.ascontiguousarray(both[:, 1])


def _spread(pixels: Array) -> float:
    """Return the area of the ellipse with the covariance of (n, 2) pixels."""
    return float(4.0 * np.pi * np.sqrt(max(np.linalg.det(np.cov(pixels.T, bias=True)), 0.0)))


def _most_seen(group: list[_Place], landmark_ids: Index) -> int:
    """Return the keyframe that sees most of some landmarks, the first of several."""
    counts = [np.count_nonzero(np.isin(landmark_ids, p.landmark_ids)) for p in group]
    return group[int(np.argmax(counts))].keyframe_id
