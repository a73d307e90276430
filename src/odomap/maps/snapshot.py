"""Snapshots and updates: how a solver works beside a map that keeps changing.

Solving under the map's lock would stop the tracker for as long as it takes. So a part of the map is
copied under the lock (`Map.snapshot`), solved without it, and written back (`Map.apply`). Between
the two the map may change in any way; an update is therefore not a set of values to store but a
statement "relative to the anchor keyframe, this is how the rest lies":

    S_k ← C S_k^solved,  p ← C p^solved,  C = S_anchor^now (S_anchor^solved)⁻¹

What was deleted meanwhile is dropped, what was fused follows its survivor, and keyframes that came
since move with the ancestor they were placed against.

Reference: M. Kaess et al., Concurrent filtering and smoothing, 2012 (solving beside a live map).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.maps.keyframes import Keyframe

__all__ = ["Snapshot", "Update"]


@dataclass(frozen=True, eq=False)
class Update:
    """What a solver found, relative to its anchor keyframe.

    Attributes:
        anchor_id: keyframe whose pose in the map stays what it is (culled meanwhile, it is where
            its stub says when the solution is written, and follows its parent from then on).
        T_world_anchor: (4, 4) its pose in the solution.
        keyframe_ids: (n,) distinct ids of keyframes to move.
        Ts_world_body: (n, 4, 4) their poses in the solution.
        landmark_ids: (m,) ids of landmarks to move.
        points_world: (m, 3) their places in the solution.
        version: of the map when the snapshot was taken; later keyframes move with their parents.
        scales: (n,) scales in the solution; None (with `scale_anchor`) to leave them as they are.
        scale_anchor: scale of the anchor in the solution.
        dropped_keyframes: (d,) keyframes of observations found wrong.
        dropped_landmarks: (d,) landmarks of observations found wrong.
        dropped_keypoints: (d,) keypoints of them; with these an observation is only dropped if it
            is still the one that was solved with.
        covariances: (n, 6, 6) of Ts_world_body, or None to keep those known.
    """

    anchor_id: int
    T_world_anchor: NDArray[np.float64]
    keyframe_ids: NDArray[np.int64]
    Ts_world_body: NDArray[np.float64]
    landmark_ids: NDArray[np.int64]
    points_world: NDArray[np.float64]
    version: int
    scales: NDArray[np.float64] | None = None
    scale_anchor: float | None = None
    dropped_keyframes: NDArray[np.int64] | None = None
    dropped_landmarks: NDArray[np.int64] | None = None
    dropped_keypoints: NDArray[np.int64] | None = None
    covariances: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        n, m = len(self.keyframe_ids), len(self.landmark_ids)
        if self.Ts_world_body.shape != (n, 4, 4) or self.T_world_anchor.shape != (4, 4):
            raise ValueError(f"update: {n} keyframes need ({n}, 4, 4) poses and a (4, 4) anchor")
        if self.points_world.shape != (m, 3):
            raise ValueError(f"update: {m} landmarks need ({m}, 3) points")
        if (self.scales is None) != (self.scale_anchor is None):
            raise ValueError("update: scales and scale_anchor come together")
        if len(set(np.asarray(self.keyframe_ids).tolist())) != n:
            raise ValueError("update: a keyframe comes twice")
        scales = np.ones(0) if self.scales is None else self.scales
        scales = np.append(scales, 1.0 if self.scale_anchor is None else self.scale_anchor)
        Ts = np.concatenate([self.Ts_world_body, self.T_world_anchor[None]])
        if not (np.isfinite(Ts).all() and np.isfinite(self.points_world).all()):
            raise ValueError("update: the solution is not finite, the map stays as it is")
        if not (np.isfinite(scales).all() and (scales > 0).all()):
            raise ValueError("update: scales must be positive")
        R = Ts[:, :3, :3]
        if np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max() > 1e-6:
            raise ValueError("update: a rotation is not orthonormal, the map stays as it is")


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A part of the map as it was at one version; arrays are copies, read-only.

    Attributes:
        keyframes: the n keyframes with their payloads.
        keyframe_ids: (n,) their ids.
        is_fixed: (n,) bool, keyframes that only hold the others in place.
        Ts_world_body: (n, 4, 4) poses.
        scales: (n,) world units per unit of the keyframe.
        landmark_ids: (m,) landmarks seen by at least one free keyframe.
        points_world: (m, 3) their places.
        anchors: (m,) keyframes they are stored relative to, by id.
        points_anchor: (m, 3) their places in these, in their units.
        obs_keyframe: (o,) index into keyframe_ids, ascending.
        obs_landmark: (o,) index into landmark_ids.
        obs_keypoint: (o,) index into the keyframe's features.
        anchor_id: the first fixed keyframe, or the first of all.
        version: of the map.
        epoch: of the map.
    """

    keyframes: tuple[Keyframe, ...]
    keyframe_ids: NDArray[np.int64]
    is_fixed: NDArray[np.bool_]
    Ts_world_body: NDArray[np.float64]
    scales: NDArray[np.float64]
    landmark_ids: NDArray[np.int64]
    points_world: NDArray[np.float64]
    anchors: NDArray[np.int64]
    points_anchor: NDArray[np.float64]
    obs_keyframe: NDArray[np.int64]
    obs_landmark: NDArray[np.int64]
    obs_keypoint: NDArray[np.int64]
    anchor_id: int
    version: int
    epoch: int

    def __post_init__(self) -> None:
        for value in vars(self).values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False

    def solved(
        self,
        Ts_world_body: NDArray[np.float64],
        points_world: NDArray[np.float64],
        *,
        scales: NDArray[np.float64] | None = None,
        dropped: NDArray[np.int64] | None = None,
        covariances: NDArray[np.float64] | None = None,
    ) -> Update:
        """Make the update that moves the free keyframes and the landmarks to a solution.

        Args:
            Ts_world_body: (n, 4, 4) solved poses of all keyframes, fixed ones included.
            points_world: (m, 3) solved places of all landmarks.
            scales: (n,) solved scales, those of the snapshot if they were not part of the problem.
            dropped: (d,) indices of the observations found wrong.
            covariances: (n, 6, 6) of Ts_world_body, right tangent.

        Returns:
            The update for `Map.apply`.
        """
        free = np.flatnonzero(~self.is_fixed)
        anchor = int(np.flatnonzero(self.keyframe_ids == self.anchor_id)[0])
        wrong = np.zeros(0, np.int64) if dropped is None else dropped
        units = self.scales if scales is None else scales
        return Update(
            anchor_id=self.anchor_id,
            T_world_anchor=Ts_world_body[anchor],
            keyframe_ids=self.keyframe_ids[free],
            Ts_world_body=Ts_world_body[free],
            landmark_ids=self.landmark_ids,
            points_world=points_world,
            version=self.version,
            scales=units[free],
            scale_anchor=float(units[anchor]),
            dropped_keyframes=self.keyframe_ids[self.obs_keyframe[wrong]],
            dropped_landmarks=self.landmark_ids[self.obs_landmark[wrong]],
            dropped_keypoints=self.obs_keypoint[wrong],
            covariances=None if covariances is None else covariances[free],
        )
