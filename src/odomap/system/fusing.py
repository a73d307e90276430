"""Fusing landmarks: one point of the world is one landmark, seen wherever it shows.

A new keyframe sees points that are landmarks already, under keypoints that tracking did not match,
or that were made a second time by its neighbours. Landmarks of the neighbours are therefore looked
for in the new keyframe, and its own in each of them. A landmark p is expected where it projects if
it lies ahead, in the image, within 60° of the mean direction it was seen from, and on the level

    l = log(s₀ / |p − c|) / log(scale),   log s₀ the mean of log(|p − c_k| scaleˡₖ) over who saw it,

one more or less. A match at a keypoint of no landmark is a new observation. At a keypoint of
another landmark the two are one, and the one that more keyframes see survives; unless some keyframe
sees the two apart, where they stay two if their points are apart as well. Whole groups are checked
before they are joined, the pairs that lie nearest first, so that no chain joins what stands apart.

Cost: O(landmarks + observations) per keyframe, and the guided matching.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, sections V-D and VI-C.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_inverse
from odomap.limits import Limits, Positive, check_limits
from odomap.system.fusing_kernels import expect, look
from odomap.system.joining import join
from odomap.system.localwindow import LocalWindow
from odomap.vision.matching import KeypointGrid, MatchConfig, match_projected

__all__ = ["FuseConfig", "Fusions", "find_fusions", "fused"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

GATE, GATE_WITH_DEPTH = 5.991, 7.815
"""95 % of χ² with two and three degrees of freedom."""


@dataclass(frozen=True)
class FuseConfig:
    """Where landmarks are looked for again."""

    radius_px: Positive = 3.0
    """Search radius around the expected position, in pixels of the expected level."""
    max_angle_deg: Annotated[float, Limits(above=0, most=180)] = 60.0
    """Angle from the mean direction of its observers beyond which a landmark looks different."""

    def __post_init__(self) -> None:
        check_limits(self)


@dataclass(frozen=True, eq=False)
class Fusions:
    """What belongs together: rows of a window.

    Attributes:
        keyframe, landmark, keypoint: (N,) new observations, of survivors where they are fused.
        survivors, gone: (F,) landmarks that are one; a survivor is never gone itself.
    """

    keyframe: Index
    landmark: Index
    keypoint: Index
    survivors: Index
    gone: Index


@dataclass(frozen=True, eq=False)
class _Window:
    """A window laid out for searching.

    Attributes:
        keypoint_of: (K, M) where each keyframe sees each landmark, −1 where it does not.
        first: (K,) row of each keyframe's first keypoint in the following.
        keypoints, levels, depth: (n, 2) float32, (n,) int64 and (n,), of all keyframes.
        look: (M, 4) per landmark the sum of unit vectors towards its observers, and the mean log
            of the distance at which it would show on the finest level; NaN where nobody sees it.
        top: the coarsest level there is.
    """

    keypoint_of: Index
    first: Index
    keypoints: NDArray[np.float32]
    levels: Index
    depth: Array
    look: Array
    top: int

    @staticmethod
    def of(window: LocalWindow) -> "_Window":
        """Lay out a window."""
        features = [window.features(k) for k in range(len(window.keyframes))]
        keypoint_of = np.full((len(features), len(window.points_world)), -1)
        keypoint_of[window.obs_keyframe, window.obs_landmark] = window.obs_keypoint
        first = np.cumsum([0, *(len(f) for f in features)])[:-1]
        levels = np.concatenate([f.level for f in features]).astype(np.int64)
        seen = np.empty((len(window.points_world), 4))
        look(
            window.points_world,
            np.ascontiguousarray(window.Ts_world_camera[:, :3, 3]),
            window.obs_keyframe,
            window.obs_landmark,
            levels[first[window.obs_keyframe] + window.obs_keypoint],
            float(np.log(window.level_scale)),
            seen,
        )
        keypoints = np.concatenate([f.keypoints for f in features])
        depth, top = np.concatenate([f.depth for f in features]), int(levels.max(initial=0))
        return _Window(keypoint_of, first, keypoints, levels, depth, seen, top)


@dataclass(frozen=True, eq=False)
class _Found:
    """Matches: (N,) keyframe, landmark, keypoint, and |r|² in standard deviations."""

    keyframe: Index
    landmark: Index
    keypoint: Index
    chi2: Array

    def at(self, rows: Index) -> "_Found":
        """Return some of them."""
        return _Found(
            self.keyframe[rows], self.landmark[rows], self.keypoint[rows], self.chi2[rows]
        )


def find_fusions(window: LocalWindow, config: FuseConfig, matching: MatchConfig) -> Fusions:
    """Find landmarks again: those of the neighbours in the newest keyframe, and its own in them.

    Args:
        window: the newest keyframe, its neighbours and their landmarks. In fixed keyframes nothing
            is looked for, but their landmarks are.
        config: where to look.
        matching: how descriptors are matched.

    Returns:
        New observations, and pairs of landmarks that are one.
    """
    laid = _Window.of(window)
    sees = laid.keypoint_of >= 0
    own = sees[window.newest]
    hits = [_search(window, laid, window.newest, ~own, config, matching)]
    others = [k for k in np.flatnonzero(~window.is_fixed).tolist() if k != window.newest]
    hits += [_search(window, laid, k, own & ~sees[k], config, matching) for k in others]
    return _resolved(window, laid, _gated(window, laid, [window.newest, *others], hits))


def _search(
    window: LocalWindow,
    laid: _Window,
    k: int,
    wanted: Mask,
    config: FuseConfig,
    matching: MatchConfig,
) -> tuple[Index, Index, Array]:
    """Look for landmarks of a (M,) mask in keyframe k: landmark, keypoint, u v 1/Z expected."""
    camera, features, M = window.camera, window.features(k), len(wanted)
    expected, level = np.empty((M, 3)), np.empty(M, np.int64)
    expect(
        window.points_world,
        laid.look,
        wanted,
        np.ascontiguousarray(se3_inverse(window.Ts_world_camera[k])),
        np.array([*camera.intrinsics, *camera.resolution]),
        float(np.cos(np.radians(config.max_angle_deg))),
        float(np.log(window.level_scale)),
        laid.top,
        expected,
        level,
    )
    ahead = np.flatnonzero(level >= 0)
    level, expected = level[ahead], expected[ahead]
    keypoint = match_projected(
        window.descriptors[ahead],
        expected[:, :2],
        config.radius_px * window.level_scale ** level.astype(np.float64),
        np.maximum(level - 1, 0),
        np.minimum(level + 1, laid.top),
        features.descriptors,
        features.keypoints,
        features.level,
        KeypointGrid.of(features.keypoints, (camera.height, camera.width)),
        matching,
    )
    hit = np.flatnonzero(keypoint >= 0)
    return ahead[hit], keypoint[hit], expected[hit]


def _gated(
    window: LocalWindow, laid: _Window, keyframes: list[int], hits: list[tuple[Index, Index, Array]]
) -> _Found:
    """Return what was found in keyframes near enough to where it was expected."""
    keyframe = np.repeat(keyframes, [len(landmark) for landmark, _, _ in hits])
    landmark, keypoint, expected = (np.concatenate(column) for column in zip(*hits, strict=True))
    at = laid.first[keyframe] + keypoint
    sigma = window.sigma_px * window.level_scale ** laid.levels[at].astype(np.float64)
    off = (laid.keypoints[at] - expected[:, :2]) / sigma[:, None]
    deep = (1.0 / laid.depth[at] - expected[:, 2]) / window.inverse_depth_sigma
    chi2 = np.sum(off * off, axis=1) + np.where(np.isfinite(deep), deep * deep, 0.0)
    fits = np.flatnonzero(chi2 <= np.where(np.isfinite(deep), GATE_WITH_DEPTH, GATE))
    return _Found(keyframe[fits], landmark[fits], keypoint[fits], chi2[fits])


def _resolved(window: LocalWindow, laid: _Window, found: _Found) -> Fusions:
    """Tell new observations from pairs of landmarks, and join those that are one."""
    owner = np.full(len(laid.keypoints), -1)
    owner[laid.first[window.obs_keyframe] + window.obs_keypoint] = window.obs_landmark
    other = owner[laid.first[found.keyframe] + found.keypoint]
    taken = np.flatnonzero(other >= 0)
    taken = taken[np.argsort(found.chi2[taken], kind="stable")]
    pairs = np.stack([found.landmark[taken], other[taken]], axis=1)
    survivors, gone = join(
        _once(pairs), window.num_observers, lambda a, b: _is_apart(window, laid, a, b)
    )
    heir = np.arange(len(window.points_world))
    heir[gone] = survivors
    sees = np.zeros(laid.keypoint_of.shape, np.bool_)
    sees[window.obs_keyframe, heir[window.obs_landmark]] = True
    free = found.at(np.flatnonzero(other < 0))
    landmark = heir[free.landmark]
    # Of several that one survivor would get in a keyframe the nearest stays.
    order = np.argsort(free.chi2, kind="stable")
    place = free.keyframe[order] * len(heir) + landmark[order]
    once = np.sort(np.unique(place, return_index=True)[1])
    kept = order[once]
    kept = np.sort(kept[~sees[free.keyframe[kept], landmark[kept]]])
    return Fusions(free.keyframe[kept], landmark[kept], free.keypoint[kept], survivors, gone)


def _once(pairs: Index) -> Index:
    """Return (P, 2) unordered pairs without repetition, in the order of their first occurrence."""
    low, high = np.sort(pairs, axis=1).T
    place = low * (int(high.max(initial=0)) + 1) + high
    return pairs[np.sort(np.unique(place, return_index=True)[1])]


def _is_apart(window: LocalWindow, laid: _Window, a: Index, b: Index) -> Mask:
    """Say of (P,) pairs of landmarks whether a keyframe sees them apart, and they are.

    Seen apart are two keypoints further from each other than the noise of two; the points are apart
    if in such a keyframe their projections are as well.
    """
    here, there = laid.keypoint_of[:, a], laid.keypoint_of[:, b]
    k, pair = np.nonzero((here >= 0) & (there >= 0) & (here != there))
    rows = laid.first[k] + here[k, pair], laid.first[k] + there[k, pair]
    level = np.maximum(laid.levels[rows[0]], laid.levels[rows[1]]).astype(np.float64)
    noise = np.sqrt(2.0 * GATE) * window.sigma_px * window.level_scale**level
    seen = np.linalg.norm(laid.keypoints[rows[0]] - laid.keypoints[rows[1]], axis=1)
    Ts = se3_inverse(window.Ts_world_camera)
    p, q = (
        np.einsum("nij,nj->ni", Ts[k, :3, :3], window.points_world[m[pair]]) + Ts[k, :3, 3]
        for m in (a, b)
    )
    expected = np.linalg.norm(window.camera.project(p) - window.camera.project(q), axis=1)
    apart = np.zeros(len(a), np.bool_)
    # A point behind a camera that sees it projects to NaN, and is no evidence that they are one.
    apart[pair[(seen > noise) & ~(expected <= noise)]] = True
    return apart


def fused(window: LocalWindow, fusions: Fusions) -> LocalWindow:
    """Return the window with fusions applied; all rows of landmarks and keyframes stay.

    Args:
        window: what they were found in.
        fusions: from `find_fusions`.

    Returns:
        The window in which survivors have the observations of those gone, and these none. Where a
        keyframe saw several that are one, the survivor's observation stays, else that of the
        lowest row. A survivor counts the observers of both, as if none outside the window saw both.
    """
    M = len(window.points_world)
    heir = np.arange(M)
    heir[fusions.gone] = fusions.survivors
    landmark = heir[window.obs_landmark]
    moved = np.flatnonzero(landmark != window.obs_landmark)
    moved = moved[np.argsort(window.obs_landmark[moved], kind="stable")]
    taken = np.zeros((len(window.keyframes), M), np.bool_)
    own = np.flatnonzero(landmark == window.obs_landmark)
    taken[window.obs_keyframe[own], landmark[own]] = True
    place = window.obs_keyframe[moved] * M + landmark[moved]
    once = np.unique(place, return_index=True)[1]
    stays = np.zeros(len(landmark), np.bool_)
    stays[own] = True
    stays[moved[once]] = ~taken.ravel()[place[once]]
    observers = np.bincount(heir, window.num_observers, minlength=M).astype(np.int64)
    observers -= np.bincount(landmark[~stays], minlength=M)
    return replace(
        window,
        num_observers=observers + np.bincount(fusions.landmark, minlength=M),
        obs_keyframe=np.concatenate([window.obs_keyframe[stays], fusions.keyframe]),
        obs_landmark=np.concatenate([landmark[stays], fusions.landmark]),
        obs_keypoint=np.concatenate([window.obs_keypoint[stays], fusions.keypoint]),
    )
