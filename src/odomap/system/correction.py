"""A correction: poses solved aside are written where keyframes have moved meanwhile.

A path is read, and solved for a while; mapping goes on, and moves keyframes by what it finds around
them. Both are kept if what is written is how the solution moves each keyframe,

    S ← S_solved S_read⁻¹ S_now,

which is S_solved where nobody else has moved it. The root stays where it is. Keyframes that came
since follow their parents, and those that went are passed over (`maps/writing`).

Cost: O(K).

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015, section VII-D.
"""

import numpy as np
from numpy.typing import NDArray

from odomap.maps.map import Map
from odomap.maps.snapshot import Update
from odomap.maps.states import Placement, compose, inverse

__all__ = ["correction"]


def correction(
    map: Map,
    keyframe_ids: NDArray[np.int64],
    read: Placement,
    solved: Placement,
    root_id: int,
    version: int,
    covariances: NDArray[np.float64] | None = None,
) -> Update:
    """Return a solution as the map takes it as it is now.

    Args:
        map: the map, which nobody else changes until it is written.
        keyframe_ids: (K,) ascending.
        read: (K, 4, 4) poses and (K,) scales as they were read.
        solved: (K, 4, 4) and (K,) as they were solved.
        root_id: the one of them that stays.
        version: of the map when it was read.
        covariances: (K, 6, 6) of the poses solved, or None to keep those known.
    """
    now = map.snapshot(keyframe_ids, landmarks=False)
    row = np.searchsorted(keyframe_ids, now.keyframe_ids)
    (Ts_read, scales_read), Ts, scales = read, solved[0][row], solved[1][row]
    is_as_read = (now.Ts_world_body == Ts_read[row]).all(axis=(1, 2))
    other = np.flatnonzero(~(is_as_read & (now.scales == scales_read[row])))
    were = Ts_read[row[other]], scales_read[row[other]]
    moved = compose((Ts[other], scales[other]), inverse(were))
    Ts[other], scales[other] = compose(moved, (now.Ts_world_body[other], now.scales[other]))
    return Update(
        anchor_id=root_id,
        T_world_anchor=map.T_world_body(root_id),
        keyframe_ids=now.keyframe_ids,
        Ts_world_body=Ts,
        landmark_ids=np.zeros(0, np.int64),
        points_world=np.zeros((0, 3)),
        version=version,
        scales=scales,
        scale_anchor=map.scale(root_id),
        covariances=None if covariances is None else covariances[row],
    )
