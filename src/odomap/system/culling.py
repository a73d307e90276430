"""Culling: landmarks and keyframes that the map does not need go.

A landmark is on probation: it stays if, a few keyframes after its making, enough keyframes see it,
and if it was found in enough of the frames in which it should have been seen. A keyframe is
redundant if nearly all that it sees, others see as well and as near: with n(m, l) the keyframes
that see landmark m on level l or a finer one, the landmark is safe without keyframe k, which sees
it on level l, when

    n(m, l) − 1 ≥ 3.

Only observations of the window count: keyframes outside may see a landmark, but how well is not
known, and a keyframe is rather kept. After each that goes all are counted anew, so that two that
only stand in for each other do not both go.

Cost: O(observations + landmarks · levels) for each keyframe that goes.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, sections VI-B and VI-E.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.system.localwindow import LocalWindow
from odomap.system.visualconfig import CullConfig

__all__ = ["CullConfig", "poor_landmarks", "redundant_keyframes"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


def redundant_keyframes(
    window: LocalWindow,
    config: CullConfig,
    is_protected: Mask | None = None,
    near: float | None = None,
) -> Index:
    """Choose keyframes that see hardly anything that others do not see as well.

    Args:
        window: who sees what; a fixed keyframe never goes, nor does the newest one.
        config: thresholds.
        is_protected: (K,) those that must stay for other reasons.
        near: metres up to which landmarks count, for a rig that measures depth: those further away
            are easily made anew. None counts all.

    Returns:
        (n,) rows of keyframes in the order in which they go, the most redundant first.
    """
    may_go = ~window.is_fixed
    may_go[window.newest] = False
    if is_protected is not None:
        may_go &= ~is_protected
    level, depth = _of_keypoints(window)
    counted = np.ones(len(level), np.bool_) if near is None else depth <= near
    gone: list[int] = []
    stays = np.ones(len(level), np.bool_)
    for _ in range(config.keyframes):
        seen_by = _as_well(window, level, stays)
        safe = (seen_by >= config.observers) & counted
        K = len(window.keyframes)
        total = np.bincount(window.obs_keyframe[counted], minlength=K)
        part = np.bincount(window.obs_keyframe[safe], minlength=K) / np.maximum(total, 1)
        part[~may_go | (total == 0)] = -1.0
        k = int(np.argmax(part))
        if part[k] < config.redundant:
            break
        gone.append(k)
        may_go[k] = False
        stays &= window.obs_keyframe != k
    return np.asarray(gone, np.int64)


def _of_keypoints(window: LocalWindow) -> tuple[Index, Array]:
    """Return the (N,) level and depth of each observation's keypoint; NaN where not measured."""
    features = [window.features(k) for k in range(len(window.keyframes))]
    first = np.cumsum([0, *(len(f) for f in features)])[:-1]
    at = first[window.obs_keyframe] + window.obs_keypoint
    level = np.concatenate([f.level for f in features]).astype(np.int64)
    return level[at], np.concatenate([f.depth for f in features])[at]


def _as_well(window: LocalWindow, level: Index, stays: Mask) -> Index:
    """Return how many others see each observation's landmark on its level or a finer one, (N,)."""
    levels = int(level.max(initial=0)) + 1
    cell = window.obs_landmark * levels + level
    counts = np.bincount(cell[stays], minlength=levels * len(window.points_world))
    seen = np.cumsum(counts.reshape(-1, levels), axis=1)
    return np.asarray(seen.ravel()[cell] - stays)


def poor_landmarks(
    age: Index,
    num_observers: Index,
    found: Index,
    expected: Index,
    is_ranged: Mask,
    config: CullConfig,
) -> Index:
    """Choose landmarks on probation that are seen too rarely.

    Args:
        age: (M,) keyframes since each was made.
        num_observers: (M,) keyframes that see it.
        found: (M,) frames in which it was found.
        expected: (M,) frames in which it should have been visible; 0 says nothing about it.
        is_ranged: (M,) whether its depth was measured.
        config: thresholds.

    Returns:
        (n,) rows, ascending.
    """
    least = np.where(is_ranged, config.min_observers_ranged, config.min_observers)
    unseen = (age >= config.min_age) & (num_observers < least)
    missed = found < config.min_found * expected
    return np.flatnonzero((age <= config.max_age) & (unseen | missed))
