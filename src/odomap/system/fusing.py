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

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_inverse
from odomap.system.fusing_kernels import look, refind, stand_apart
from odomap.system.joining import join
from odomap.system.localwindow import LocalWindow
from odomap.system.visualconfig import FuseConfig
from odomap.vision.hamming import as_words
from odomap.vision.matching import MatchConfig

__all__ = ["FuseConfig", "Fusions", "find_fusions", "fused"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

GATE, GATE_WITH_DEPTH = 5.991, 7.815
"""95 % of χ² with two and three degrees of freedom."""


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
        first: (K + 1,) where each keyframe's keypoints begin in the following.
        keypoints, levels, depth, descriptors: (n, 2) float32, (n,) uint8, (n,) and (n, 32), of all
            keyframes.
        look: (M, 4) per landmark the sum of unit vectors towards its observers, and the mean log
            of the distance at which it would show on the finest level; NaN where nobody sees it.
        Ts_camera_world: (K, 4, 4).
        pinhole: (6,) fx fy cx cy width height.
        sizes: (levels,) of a pixel of each level there is, in those of the image.
    """

    keypoint_of: Index
    first: Index
    keypoints: NDArray[np.float32]
    levels: NDArray[np.uint8]
    depth: Array
    descriptors: NDArray[np.uint8]
    look: Array
    Ts_camera_world: Array
    pinhole: Array
    sizes: Array

    @staticmethod
    def of(window: LocalWindow) -> "_Window":
        """Lay out a window."""
        features = [window.features(k) for k in range(len(window.keyframes))]
        keypoint_of = np.full((len(features), len(window.points_world)), -1)
        keypoint_of[window.obs_keyframe, window.obs_landmark] = window.obs_keypoint
        first = np.cumsum([0, *(len(f) for f in features)])
        levels = np.concatenate([f.level for f in features])
        seen = np.empty((len(window.points_world), 4))
        look(
            window.points_world,
            np.ascontiguousarray(window.Ts_world_camera[:, :3, 3]),
            window.obs_keyframe,
            window.obs_landmark,
            levels[first[window.obs_keyframe] + window.obs_keypoint].astype(np.int64),
            float(np.log(window.level_scale)),
            seen,
        )
        return _Window(
            keypoint_of,
            first,
            np.concatenate([f.keypoints for f in features]),
            levels,
            np.concatenate([f.depth for f in features]),
            np.concatenate([f.descriptors for f in features]),
            seen,
            np.ascontiguousarray(se3_inverse(window.Ts_world_camera)),
            np.array([*window.camera.intrinsics, *window.camera.resolution], np.float64),
            window.level_scale ** np.arange(int(levels.max(initial=0)) + 1, dtype=np.float64),
        )


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
    others = np.flatnonzero(~window.is_fixed)
    searched = np.concatenate([[window.newest], others[others != window.newest]])
    hits, expected = _search(window, laid, searched, config, matching)
    return _resolved(window, laid, _gated(window, laid, hits, expected))


def _search(
    window: LocalWindow,
    laid: _Window,
    searched: Index,
    config: FuseConfig,
    matching: MatchConfig,
) -> tuple[Index, Array]:
    """Look for landmarks in keyframes: keyframe, landmark, keypoint; u v 1/Z as expected."""
    most = int(np.diff(laid.first)[searched].sum())  # no keypoint is given twice
    hits, shown = np.empty((most, 3), np.int64), np.empty((most, 3))
    found = refind(
        searched,
        window.newest,
        laid.keypoint_of,
        window.points_world,
        laid.look,
        as_words(window.descriptors),
        laid.Ts_camera_world,
        laid.pinhole,
        float(np.cos(np.radians(config.max_angle_deg))),
        float(np.log(window.level_scale)),
        config.radius_px * laid.sizes,
        laid.first,
        laid.keypoints,
        laid.levels,
        as_words(laid.descriptors),
        matching.ratio,
        matching.max_hamming,
        hits,
        shown,
    )
    return hits[:found], shown[:found]


def _gated(window: LocalWindow, laid: _Window, hits: Index, expected: Array) -> _Found:
    """Return what was found near enough to where it was expected."""
    keyframe, landmark, keypoint = np.ascontiguousarray(hits.T)
    at = laid.first[keyframe] + keypoint
    sigma = window.sigma_px * laid.sizes[laid.levels[at]]
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
    pairs, apart = np.stack([a, b], axis=1), np.empty(len(a), np.bool_)
    stand_apart(
        pairs,
        laid.keypoint_of,
        laid.first,
        laid.keypoints,
        laid.levels,
        np.sqrt(2.0 * GATE) * window.sigma_px * laid.sizes,
        window.points_world,
        laid.Ts_camera_world,
        laid.pinhole,
        apart,
    )
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
