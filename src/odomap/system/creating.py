"""Creating landmarks: keypoints of a new keyframe that its neighbours see as well.

A keypoint without landmark is a ray. It is matched along its epipolar line in each covisible
keyframe, and of each match the point that minimises

    Σ |π(p) − x|² / σ²  +  Σ (1/z − d)² / σ_d²      over both views, d where depth was measured

is judged: its depth must be known, its residuals must be noise, and its image must change size as
its distance does. What tells depth is the angle α between the rays, σ_z/z = σ/(f α), and as well a
measured inverse depth, which is worth an angle of σ/(f z σ_d); from which of the two the search
starts is decided by that. Several neighbours may see one keypoint: the point that most of them
agree on is made, the one of the widest angle among equals, and seen by all that agree.

Cost: O(free keypoints²) per neighbour for the matching, the rest is linear in the matches.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section VI-C.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_inverse
from odomap.system.creating_kernels import agree, judge
from odomap.system.localwindow import LocalWindow
from odomap.system.visualconfig import CreateConfig
from odomap.vision.matching import EpipolarView, MatchConfig, match_epipolar

__all__ = ["CreateConfig", "Created", "create_landmarks"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

CHECKS = ("parallax", "behind", "reprojection", "scale")
"""Why a match makes no point, in the order in which it is asked."""


@dataclass(frozen=True, eq=False)
class Created:
    """New landmarks and who sees them.

    Attributes:
        points_world: (C, 3).
        obs_keyframe: (O,) rows of keyframes; of each point the newest one's comes first.
        obs_point: (O,) rows into `points_world`, ascending.
        obs_keypoint: (O,) rows of the keyframes' features.
        matched: pairs of keypoints that were matched.
        failed: how many of them failed each check, by the name of the check: ``parallax``,
            ``behind``, ``reprojection``, ``scale``; ``baseline`` counts neighbours too near.
    """

    points_world: Array
    obs_keyframe: Index
    obs_point: Index
    obs_keypoint: Index
    matched: int
    failed: Mapping[str, int]

    def __len__(self) -> int:
        return len(self.points_world)


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Matches of the newest keyframe's keypoints: (P,) keypoint, neighbour row, keypoint there."""

    keypoint: Index
    neighbour: Index
    other: Index


@dataclass(frozen=True, eq=False)
class _Judged:
    """What became of the pairs.

    Attributes:
        points: (P, 3) in the newest camera's axes.
        verdict: (P,) 0, or 1 + the check that failed.
        winner: (P,) pair whose point it is that this one sees, −1 for none.
    """

    points: Array
    verdict: Index
    winner: Index


def create_landmarks(
    window: LocalWindow,
    config: CreateConfig,
    matching: MatchConfig,
    min_baseline: float | None = None,
) -> Created:
    """Find new landmarks that the newest keyframe shares with its neighbours.

    Args:
        window: the newest keyframe, its neighbours and their landmarks.
        config: thresholds.
        matching: how descriptors are matched.
        min_baseline: metres between the newest keyframe and a neighbour from which on it is of
            use; of a stereo pair its baseline. None: relative to the depth of the scene.

    Returns:
        The points, none of them in the window yet.
    """
    covisible = _covisible(window)[: config.neighbours]
    far = [k for k in covisible.tolist() if _is_aside(window, k, config, min_baseline)]
    pairs = _match(window, far, matching)
    judged = _judge(window, pairs, config)
    failed = dict(zip(CHECKS, np.bincount(judged.verdict, minlength=5)[1:].tolist(), strict=True))
    failed["baseline"] = len(covisible) - len(far)
    return _gather(window, pairs, judged, failed)


def _covisible(window: LocalWindow) -> Index:
    """Return the rows of the keyframes that share landmarks with the newest, most first."""
    own = np.zeros(len(window.points_world), np.bool_)
    own[window.obs_landmark[window.obs_keyframe == window.newest]] = True
    shared = window.obs_keyframe[own[window.obs_landmark]]
    counts = np.bincount(shared, minlength=len(window.keyframes))
    counts[window.newest] = 0
    order = np.argsort(-counts, kind="stable")
    return order[counts[order] > 0]


def _is_aside(
    window: LocalWindow, k: int, config: CreateConfig, min_baseline: float | None
) -> bool:
    """Say whether keyframe k is far enough from the newest one to tell depth."""
    baseline = float(np.linalg.norm(window.center(k) - window.center(window.newest)))
    if min_baseline is not None:
        return baseline >= min_baseline
    seen = window.points_world[window.obs_landmark[window.obs_keyframe == k]]
    depth = (seen - window.center(k)) @ window.Ts_world_camera[k, :3, 2]
    middle = (len(depth) - 1) // 2, len(depth) // 2
    median = np.partition(depth, middle)[list(middle)].mean()
    return baseline >= config.min_baseline * float(median)


def _match(window: LocalWindow, neighbours: list[int], matching: MatchConfig) -> _Pairs:
    """Match free keypoints with those of all neighbours, sorted by the newest one's keypoint."""
    n = window.newest
    # The line is as uncertain as the keypoint it comes from.
    sigma = np.sqrt(2.0) * window.sigma_px / window.camera.fx
    usable = np.ones(window.first[-1], np.bool_)
    usable[window.first[window.obs_keyframe] + window.obs_keypoint] = False
    first, rows = _free(window, n, usable), [np.empty((0, 3), np.int64)]
    T_newest_world = se3_inverse(window.Ts_world_camera[n])
    for k in neighbours:
        T = np.ascontiguousarray(se3_inverse(T_newest_world @ window.Ts_world_camera[k]))
        found = match_epipolar(
            first, _free(window, k, usable), T, sigma, window.level_scale, matching
        )
        rows.append(np.stack([found[:, 0], np.full(len(found), k), found[:, 1]], axis=1))
    all_rows = np.concatenate(rows)
    order = np.argsort(all_rows[:, 0], kind="stable")
    keypoint, neighbour, other = np.ascontiguousarray(all_rows[order].T)
    return _Pairs(keypoint, neighbour, other)


def _free(window: LocalWindow, k: int, usable: NDArray[np.bool_]) -> EpipolarView:
    """Return keyframe k for matching, where some of all keypoints (n,) are usable."""
    features, rows = window.features(k), slice(window.first[k], window.first[k + 1])
    return EpipolarView(features.descriptors, features.bearings, features.level, usable[rows])


def _views(window: LocalWindow) -> Array:
    """Return (K, 3, 4): from the newest camera's axes to those of each."""
    Ts = se3_inverse(window.Ts_world_camera) @ window.Ts_world_camera[window.newest]
    return np.ascontiguousarray(Ts[:, :3])


def _sightings(window: LocalWindow, keyframe: Index, keypoint: Index) -> Array:
    """Return (P, 4) of keypoints: x/z, y/z, inverse depth (NaN: unknown), size of the level."""
    at = window.first[keyframe] + keypoint
    bearings, seen = window.bearings[at], np.empty((len(keyframe), 4))
    seen[:, :2] = bearings[:, :2] / bearings[:, 2:]
    seen[:, 2] = 1.0 / window.depths[at]
    seen[:, 3] = window.level_scale ** window.levels[at].astype(np.float64)
    return seen


def _noise(window: LocalWindow, config: CreateConfig) -> Array:
    """Return (4,) σ on the plane z = 1, σ of inverse depth, least parallax, size tolerance."""
    return np.array(
        [
            window.sigma_px / window.camera.fx,
            window.inverse_depth_sigma,
            np.radians(config.min_parallax_deg),
            config.scale_tolerance * window.level_scale,
        ]
    )


def _judge(window: LocalWindow, pairs: _Pairs, config: CreateConfig) -> _Judged:
    """Find the point of each pair, and for each keypoint the one that most pairs agree on."""
    P = len(pairs.keypoint)
    measured = (
        _sightings(window, np.full(P, window.newest), pairs.keypoint),
        _sightings(window, pairs.neighbour, pairs.other),
        pairs.neighbour,
        _views(window),
        _noise(window, config),
    )
    points, parallax, verdict = np.zeros((P, 3)), np.zeros(P), np.zeros(P, np.int64)
    judge(*measured, window.newest, points, parallax, verdict)
    winner = np.full(P, -1)
    agree(*measured, pairs.keypoint, points, parallax, verdict, winner)
    return _Judged(points, verdict, winner)


def _gather(
    window: LocalWindow, pairs: _Pairs, judged: _Judged, failed: Mapping[str, int]
) -> Created:
    """Return the points that were agreed on, in the world, with their observations."""
    winner = judged.winner
    made = np.flatnonzero(winner == np.arange(len(winner)))
    number = np.full(len(winner), -1)
    number[made] = np.arange(len(made))
    seen = np.flatnonzero(winner >= 0)
    keyframe = np.concatenate([np.full(len(made), window.newest), pairs.neighbour[seen]])
    point = np.concatenate([np.arange(len(made)), number[winner[seen]]])
    keypoint = np.concatenate([pairs.keypoint[made], pairs.other[seen]])
    order = np.argsort(point, kind="stable")
    T = window.Ts_world_camera[window.newest]
    return Created(
        judged.points[made] @ T[:3, :3].T + T[:3, 3],
        keyframe[order],
        point[order],
        keypoint[order],
        len(winner),
        failed,
    )
