"""Writing a solution into a map that went on without it: the rules behind `Map.apply`.

Pure functions over the parts of a map; the caller holds the lock. In order: re-express the solution
on the anchor as it is now; move the keyframes still alive; move the keyframes created since with
the nearest ancestor that moved, S_k ← S_a' S_a⁻¹ S_k, which keeps their geometry relative to it;
store landmarks relative to their (moved) anchors; drop observations found wrong. All steps are
vectorised, O(size of the update + keyframes created since).

Reference: R. Mur-Artal, J. Montiel, J. Tardós, ORB-SLAM: a versatile and accurate monocular SLAM
system, 2015 (propagating a full bundle adjustment along the spanning tree).
"""

import numpy as np
from numpy.typing import NDArray

from odomap.maps.landmarks import Landmarks
from odomap.maps.observations import Observations
from odomap.maps.snapshot import Update
from odomap.maps.states import (
    Placement,
    States,
    act,
    act_inverse,
    compose,
    inverse,
    stretched,
)
from odomap.maps.tree import ALIVE, Tree

__all__ = ["correction", "drop_observations", "move_keyframes", "move_landmarks"]


def correction(tree: Tree, states: States, update: Update) -> Placement | None:
    """Return C = S_anchor^now (S_anchor^solved)⁻¹, or None where it is exactly the identity."""
    Ts, scales = tree.placements(states, np.array([update.anchor_id]))
    now = Ts[0], scales[0]
    scale = now[1] if update.scale_anchor is None else np.float64(update.scale_anchor)
    if np.array_equal(now[0], update.T_world_anchor) and now[1] == scale:
        return None
    return compose(now, inverse((update.T_world_anchor, np.asarray(scale))))


def move_keyframes(tree: Tree, states: States, update: Update, C: Placement | None) -> None:
    """Write the poses of an update, and let the keyframes created since follow."""
    ids = np.asarray(update.keyframe_ids, np.int64)
    alive = tree.status[ids] == ALIVE
    ids = ids[alive]
    scales = states.scales[ids] if update.scales is None else update.scales[alive]
    solved: Placement = np.asarray(update.Ts_world_body)[alive], scales
    if C is not None:
        moved = compose(C, solved)
        solved = moved[0], scales if update.scales is None else moved[1]
    before = states.placements(ids)
    followers, leaders = _followers(tree, ids, update.version)
    states.move(ids, solved)
    if update.covariances is not None:
        by = 1.0 if C is None or update.scales is None else C[1]
        states.covariances[ids] = stretched(update.covariances[alive], by)
    if len(followers):
        after = solved[0][leaders], solved[1][leaders]
        delta = compose(after, inverse((before[0][leaders], before[1][leaders])))
        states.move(followers, compose(delta, states.placements(followers)))


def _followers(
    tree: Tree, moved: NDArray[np.int64], version: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the keyframes created since, and the index in `moved` of the ancestor they follow."""
    newborn = tree.newborn(version).tolist()
    leader = {k: n for n, k in enumerate(moved.tolist())} if newborn else {}
    followers, leaders = [], []
    for keyframe in newborn:  # parents come before their children
        if keyframe in leader:
            continue
        ancestor = leader.get(int(tree.parent[keyframe]))
        if ancestor is not None:
            leader[keyframe] = ancestor
            followers.append(keyframe)
            leaders.append(ancestor)
    return np.asarray(followers, np.int64), np.asarray(leaders, np.int64)


def move_landmarks(
    landmarks: Landmarks, states: States, update: Update, C: Placement | None
) -> None:
    """Store the points of an update with their anchors; a survivor's own point comes first."""
    ids = np.asarray(update.landmark_ids, np.int64)
    slots = landmarks.slots(ids)
    alive = slots >= 0
    ids, slots, points = ids[alive], slots[alive], np.asarray(update.points_world)[alive]
    if not (slots[1:] > slots[:-1]).all():  # some were fused, or the order is another
        inherited = landmarks.ids[slots] != ids
        order = np.argsort(inherited, kind="stable")
        _, first = np.unique(slots[order], return_index=True)
        chosen = order[first]
        slots, points = slots[chosen], points[chosen]
    if C is not None:
        points = act(C, points)
    anchors = states.placements(landmarks.anchor[slots].astype(np.int64))
    landmarks.p_anchor[slots] = act_inverse(anchors, points)


def drop_observations(observations: Observations, landmarks: Landmarks, update: Update) -> None:
    """Remove the observations an update found wrong, if they are still there."""
    if update.dropped_keyframes is None or update.dropped_landmarks is None:
        return
    slots = landmarks.slots(np.asarray(update.dropped_landmarks, np.int64))
    known = slots >= 0
    keyframes = np.asarray(update.dropped_keyframes, np.int64)[known]
    rows = observations.find(keyframes, slots[known])
    there = rows >= 0
    if update.dropped_keypoints is not None:
        keypoints = np.asarray(update.dropped_keypoints, np.int64)[known]
        there[there] = observations.read(rows[there])[2] == keypoints[there]
    observations.remove(rows[there])
