"""Reading a map for the eye while others write it: little at a time, never for long.

A picture needs neither every landmark nor all of them at one instant. So a sample is kept, the ids
divisible by a power of two that grows with the map: a landmark that is shown stays shown. Its ids
come from the newest keyframes, its places are asked for by the thousand, each time with the lock
held for a fraction of a millisecond, whatever the size of the map. (What LiDARs saw is sampled by
`views.livecloud`.) The path is kept as it hangs from keyframes, p_world = S_keyframe p_keyframe, so
that it moves with them when a loop closes, and as it was told frame by frame, which shows from
where it moved.

Reading O(sample + keyframes + frames), lock O(CHUNK).

Reference: R. Mur-Artal, J. Montiel, J. Tardós, ORB-SLAM: a versatile and accurate monocular SLAM
system, 2015 (what hangs from what).
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from odomap.maps.columns import distinct, grown
from odomap.maps.estimate import Estimate, Status
from odomap.maps.map import Map
from odomap.views.loopview import gap_ends, loop_ends

__all__ = ["LandmarkSample", "LivePath", "Sample", "Shown", "Sketch", "sketch"]

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

LANDMARKS = 20_000
"""At most so many are shown."""
CHUNK = 2048
"""Rows asked for while the lock is held once."""
NEWEST = 10
"""Keyframes asked again for what they see: mapping goes on around them."""
ENOUGH = 20
"""Points in sight that tell how far a sensor sees."""


@dataclass(frozen=True, eq=False)
class Shown:
    """Points of a map that are drawn.

    Attributes:
        points: (M, 3) in the world.
        is_seen: (M,) whether the newest keyframe sees them.
        count: how many there are, shown or not.
        colours: (M, 3) uint8 of each, None where they are all alike.
    """

    points: Array
    is_seen: NDArray[np.bool_]
    count: int
    colours: NDArray[np.uint8] | None = None


@dataclass(frozen=True, eq=False)
class Sketch:
    """What of a map is drawn.

    Attributes:
        shown: its points.
        Ts_world_body: (K, 4, 4) of the living keyframes.
        loops: (L, 2, 3) ends of loops that were closed.
        gaps: (G, 2, 3) keyframes between which nothing was measured.
    """

    shown: Shown
    Ts_world_body: Array
    loops: Array
    gaps: Array

    def distance_seen(self, t_body_sensor: Array) -> float | None:
        """Return how far the newest keyframe sees, world units; None where it sees too little."""
        seen = self.shown.points[self.shown.is_seen]
        if len(seen) < ENOUGH or not len(self.Ts_world_body):
            return None
        T = self.Ts_world_body[-1]
        eye = T[:3, :3] @ t_body_sensor + T[:3, 3]
        return float(np.median(np.linalg.norm(seen - eye, axis=1)))


class Sample(Protocol):
    """Some of what a map remembers, spread evenly."""

    @property
    def is_whole(self) -> bool:
        """Whether the last look has read all that there was."""

    def look(self, map: Map, keyframe_ids: Ids, Ts_world_body: Array) -> Shown:
        """Read what is new, and return what is shown.

        Args:
            map: may change meanwhile.
            keyframe_ids: (K,) its living keyframes, in order.
            Ts_world_body: (K, 4, 4) where they are.
        """


class LandmarkSample:
    """Some landmarks of a map, spread evenly over their ids.

    Args:
        limit: at most so many.

    Attributes:
        ids: (N,) those in the sample, ascending.
        is_whole: whether the last look has read all that there was, which it always has.
    """

    def __init__(self, limit: int = LANDMARKS) -> None:
        self.ids = np.zeros(0, np.int64)
        self._limit, self._stride = limit, 1
        self.is_whole = True

    def look(self, map: Map, keyframe_ids: Ids, Ts_world_body: Array) -> Shown:
        """Return the sample; landmarks that the newest keyframes see join it."""
        seen = np.zeros(0, np.int64)
        for k in keyframe_ids[-NEWEST:].tolist():
            seen, _ = map.observations_of(k)
            self.add(seen)
        points = self.places(map)
        return Shown(points, np.isin(self.ids, seen), map.num_landmarks)

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
        t_body_sensor: (3,) the point on the body whose path it is.
    """

    def __init__(self, t_body_sensor: Array) -> None:
        self._t = t_body_sensor
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


def sketch(map: Map, sample: Sample, t_body_sensor: Array | None = None) -> Sketch:
    """Read what is drawn of a map, a little at a time.

    Args:
        map: may change meanwhile; then a part is of before, another of after.
        sample: the points wanted.
        t_body_sensor: (3,) the point on the body that loops are drawn at; default its origin.
    """
    ids = map.keyframe_ids
    Ts = np.concatenate(
        [np.zeros((0, 4, 4)), *(map.Ts_world_body(chunk) for chunk in _chunks(ids))]
    )
    shown = sample.look(map, ids, Ts)
    return Sketch(shown, Ts, loop_ends(map, t_body_sensor), gap_ends(map, t_body_sensor))


def _chunks(ids: Ids) -> list[Ids]:
    return [ids[k : k + CHUNK] for k in range(0, len(ids), CHUNK)]


def _scales(map: Map, ids: Ids) -> Array:
    """Return the world units per unit of (n,) keyframes; ones unless a scale was corrected."""
    with map.lock:
        are_equal = bool((map.states.scales == 1.0).all())
    return np.ones(len(ids)) if are_equal else np.array([map.scale(k) for k in ids.tolist()])
