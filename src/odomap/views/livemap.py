"""Reading a map for the eye while others write it: little at a time, never for long.

A picture needs neither every landmark nor all of them at one instant. So a sample is kept, the ids
divisible by a power of two that grows with the map: a landmark that is shown stays shown. Its ids
come from the newest keyframes, its places are asked for by the thousand, each time with the lock
held for a fraction of a millisecond, whatever the size of the map. The path is kept as it hangs
from keyframes, p_world = S_keyframe p_keyframe, so that it moves with them when a loop closes, and
as it was told frame by frame, which shows from where it moved.

Reading O(sample + keyframes + frames), lock O(CHUNK).

Reference: R. Mur-Artal, J. Montiel, J. Tardós, ORB-SLAM: a versatile and accurate monocular SLAM
system, 2015 (what hangs from what).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.maps.columns import distinct, grown
from odomap.maps.estimate import Estimate, Status
from odomap.maps.map import Map
from odomap.views.loopview import gap_ends, loop_ends

__all__ = ["LandmarkSample", "LivePath", "Sketch", "sketch"]

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

LANDMARKS = 20_000
"""At most so many are shown."""
CHUNK = 2048
"""Rows asked for while the lock is held once."""
NEWEST = 10
"""Keyframes asked again for what they see: mapping goes on around them."""


@dataclass(frozen=True, eq=False)
class Sketch:
    """What of a map is drawn.

    Attributes:
        points: (M, 3) landmarks in the world.
        is_seen: (M,) whether the newest keyframe sees them.
        Ts_world_body: (K, 4, 4) of the living keyframes.
        num_landmarks: how many there are, shown or not.
        loops: (L, 2, 3) ends of loops that were closed.
        gaps: (G, 2, 3) keyframes between which nothing was measured.
    """

    points: Array
    is_seen: NDArray[np.bool_]
    Ts_world_body: Array
    num_landmarks: int
    loops: Array
    gaps: Array


class LandmarkSample:
    """Some landmarks of a map, spread evenly over their ids.

    Args:
        limit: at most so many.

    Attributes:
        ids: (N,) those in the sample, ascending.
    """

    def __init__(self, limit: int = LANDMARKS) -> None:
        self.ids = np.zeros(0, np.int64)
        self._limit, self._stride = limit, 1

    def add(self, ids: Ids) -> None:
        """Take (N,) ids into account."""
        new = ids[ids % self._stride == 0]
        if len(new):
            self._keep(distinct(np.concatenate([self.ids, new])))

    def places(self, map: Map) -> Array:
        """Return the (N, 3) places of the sample; landmarks that are gone leave it."""
        if len(self.ids):
            self._keep(distinct(np.concatenate([map.resolve(c) for c in _chunks(self.ids)])))
        parts = [map.points_world(chunk) for chunk in _chunks(self.ids)]
        points = np.concatenate([np.zeros((0, 3)), *parts])
        known = np.isfinite(points).all(axis=1)
        self.ids = self.ids[known]
        return np.asarray(points[known])

    def _keep(self, ids: Ids) -> None:
        ids = ids[(ids >= 0) & (ids % self._stride == 0)]
        while len(ids) > self._limit:
            self._stride *= 2
            ids = ids[ids % self._stride == 0]
        self.ids = ids


class LivePath:
    """The frames so far, by the keyframes they hang from.

    Args:
        t_body_camera: (3,) the point on the body whose path it is.
    """

    def __init__(self, t_body_camera: Array) -> None:
        self._t = t_body_camera
        self._rows = 0
        self._keyframe = np.zeros(0, np.int64)
        self._place = np.zeros((0, 3))
        self._told = np.zeros((0, 3))
        self._is_lost = np.zeros(0, np.bool_)

    def __len__(self) -> int:
        return self._rows

    def add(self, estimate: Estimate) -> None:
        """Append a frame; one from before the first keyframe has no place yet."""
        if estimate.keyframe_id < 0:
            return
        k = self._rows
        self._rows += 1
        self._keyframe = grown(self._keyframe, self._rows)
        self._place = grown(self._place, self._rows)
        self._told = grown(self._told, self._rows)
        self._is_lost = grown(self._is_lost, self._rows)
        T = estimate.T_keyframe_body.matrix
        self._keyframe[k] = estimate.keyframe_id
        self._place[k] = T[:3, :3] @ self._t + T[:3, 3]
        self._is_lost[k] = estimate.status == Status.LOST
        T = estimate.T_world_body.matrix
        self._told[k] = T[:3, :3] @ self._t + T[:3, 3]

    @property
    def told(self) -> Array:
        """(N, 3) the places in the world as they were told when the frames came."""
        return self._told[: self._rows]

    def positions(self, map: Map) -> tuple[Array, NDArray[np.bool_]]:
        """Return the (N, 3) places in the world as known now, and (N,) which frames were lost."""
        keyframe, is_lost = self._keyframe[: self._rows], self._is_lost[: self._rows].copy()
        if not self._rows:
            return np.zeros((0, 3)), is_lost
        ids, which = np.unique(keyframe, return_inverse=True)
        Ts = np.concatenate([map.Ts_world_body(chunk) for chunk in _chunks(ids)])[which]
        scales = _scales(map, ids)[which]
        turned = np.einsum("nij,nj->ni", Ts[:, :3, :3], self._place[: self._rows])
        return Ts[:, :3, 3] + scales[:, None] * turned, is_lost


def sketch(map: Map, sample: LandmarkSample, t_body_camera: Array | None = None) -> Sketch:
    """Read what is drawn of a map, a little at a time.

    Args:
        map: may change meanwhile; then a part is of before, another of after.
        sample: the landmarks wanted; those that the newest keyframes see join it.
        t_body_camera: (3,) the point on the body that loops are drawn at; default its origin.
    """
    keyframes = map.keyframe_ids
    seen = np.zeros(0, np.int64)
    for k in keyframes[-NEWEST:].tolist():
        seen, _ = map.observations_of(k)
        sample.add(seen)
    points = sample.places(map)
    is_seen = np.isin(sample.ids, seen)
    Ts = [map.Ts_world_body(chunk) for chunk in _chunks(keyframes)]
    return Sketch(
        points,
        is_seen,
        np.concatenate([np.zeros((0, 4, 4)), *Ts]),
        map.num_landmarks,
        loop_ends(map, t_body_camera),
        gap_ends(map, t_body_camera),
    )


def _chunks(ids: Ids) -> list[Ids]:
    return [ids[k : k + CHUNK] for k in range(0, len(ids), CHUNK)]


def _scales(map: Map, ids: Ids) -> Array:
    """Return the world units per unit of (n,) keyframes; ones unless a scale was corrected."""
    with map.lock:
        are_equal = bool((map.states.scales == 1.0).all())
    return np.ones(len(ids)) if are_equal else np.array([map.scale(k) for k in ids.tolist()])
