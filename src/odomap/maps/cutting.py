"""Cutting a part out of a map: rows copied under the lock, a snapshot made of them without it.

What a solver gets (`Snapshot`) numbers keyframes and landmarks 0, 1, 2, ... and holds points in the
world. To number and to place takes longer than to copy, so that only the copying is done while
others wait. A landmark belongs to the part if a free keyframe sees it; observations of it in fixed
keyframes come along, other ones of theirs are left out. O(observations of the keyframes).

Reference: B. Triggs et al., Bundle adjustment, a modern synthesis, 2000 (subproblems).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.maps.columns import positions
from odomap.maps.keyframes import Keyframe
from odomap.maps.snapshot import Snapshot
from odomap.maps.states import Placement, act

__all__ = ["Cut", "snapshot_from"]


@dataclass(frozen=True, eq=False)
class Cut:
    """Rows of a map, as they were at one moment.

    Attributes:
        keyframes: the n keyframes, free ones first.
        ids: (n,) their ids.
        num_free: how many are free.
        placements: (n, 4, 4) poses and (n,) scales.
        slots: (m,) slots of the landmarks that free keyframes see, ascending.
        landmark_ids: (m,) their ids.
        anchor_ids: (m,) their anchors.
        anchors: (m, 4, 4) poses and (m,) scales of these.
        p_anchor: (m, 3) places in these.
        indptr: (n + 1,) observations of each keyframe, or (1,) where none are wanted.
        obs_slot: (o,) slots of what is seen.
        obs_keypoint: (o,) and where.
        version: of the map.
        epoch: of the map.
    """

    keyframes: tuple[Keyframe, ...]
    ids: NDArray[np.int64]
    num_free: int
    placements: Placement
    slots: NDArray[np.int64]
    landmark_ids: NDArray[np.int64]
    anchor_ids: NDArray[np.int64]
    anchors: Placement
    p_anchor: NDArray[np.float64]
    indptr: NDArray[np.int64]
    obs_slot: NDArray[np.int32]
    obs_keypoint: NDArray[np.int32]
    version: int
    epoch: int


def snapshot_from(cut: Cut) -> Snapshot:
    """Return the snapshot that rows of a map make."""
    n, fixed = len(cut.ids), cut.ids[cut.num_free :]
    keyframe = np.repeat(np.arange(len(cut.indptr) - 1), np.diff(cut.indptr))
    landmark = positions(cut.obs_slot, cut.slots)
    used = landmark >= 0
    Ts, scales = cut.placements
    return Snapshot(
        keyframes=cut.keyframes,
        keyframe_ids=cut.ids,
        is_fixed=np.arange(n) >= cut.num_free,
        Ts_world_body=Ts,
        scales=scales,
        landmark_ids=cut.landmark_ids,
        points_world=act(cut.anchors, cut.p_anchor),
        anchors=cut.anchor_ids,
        points_anchor=cut.p_anchor,
        obs_keyframe=keyframe[used],
        obs_landmark=landmark[used],
        obs_keypoint=cut.obs_keypoint[used].astype(np.int64),
        anchor_id=int(fixed[0]) if len(fixed) else int(cut.ids[0]),
        version=cut.version,
        epoch=cut.epoch,
    )
