"""The cloud of a map for the eye, from what its keyframes keep: a little of each.

Keyframes of a LiDAR keep what returned, as seen from where they were; its points hang from them,

    p_world = T_world_body T_body_sensor p,

so that a wall that is drawn twice becomes one when a loop closes. Of each keyframe a few points are
kept, chosen by chance and in an order that stays: the first q of them, q a power of two that falls
as the map grows, show all of it evenly, and a point that is shown was shown before. Where even few
of each are too many, only every second keyframe shows any, and so on. The newest shows more.

A keyframe is read once, some per look, so that a large map is shown bit by bit and the lock is held
for no longer than it takes to find some keyframes by their numbers. In 3D points are coloured by
their height above the ground around them, in one hue, ordered by lightness.

Cost: O(points of new keyframes + sample) per look, memory O(sample + keyframes).

Reference: J. S. Vitter, "Random sampling with a reservoir", ACM TOMS 11(1), 1985 (a sample of what
is not yet whole).
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from odomap.lidar.scans import Beams
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.sensors.rig import LidarMount
from odomap.views.ground import above_ground
from odomap.views.livemap import Shown

__all__ = ["CloudSample", "Returns", "ScanReturns", "SweepReturns"]

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Ids = NDArray[np.int64]
Colours = NDArray[np.uint8]

POINTS = 60_000
"""At most so many are shown, and what the newest keyframe shows more than others."""
MOST, FEWEST = 4096, 8
"""Points that a keyframe shows: the newest one, and each where there are many."""
AT_ONCE = 64
"""Keyframes read in one look."""
SWEEP_POINTS = 6000
"""At most so many of a sweep are shown while it is new."""
LOW, HIGH = (66, 80, 112), (222, 233, 246)
"""Colours of the ground and of what stands highest, on a dark page."""
TALL = 6.0
"""Height from which on it is all the same, metres."""


class Returns(Protocol):
    """What returned to a LiDAR, as seen from it."""

    has_heights: bool
    """Whether there is an above and below."""

    def of_keyframe(self, keyframe: Keyframe) -> Array:
        """Return the points (N, 3) that a keyframe keeps; none where it keeps nothing."""

    def of_frame(self, frame: Frame) -> Array:
        """Return points (N, 3) of a frame, not too many; none where it has none."""


class SweepReturns:
    """Returns of a 3D LiDAR.

    Args:
        mount: of the LiDAR.
    """

    has_heights = True

    def __init__(self, mount: LidarMount) -> None:
        self._range_m = mount.range_m

    def of_keyframe(self, keyframe: Keyframe) -> Array:
        """Return the points (N, 3) that a keyframe keeps."""
        if keyframe.cloud is None:
            return np.zeros((0, 3))
        return np.asarray(keyframe.cloud[:, :3], np.float64)

    def of_frame(self, frame: Frame) -> Array:
        """Return points (N, 3) of a sweep as it came: what the motion bent is bent."""
        if frame.cloud is None:
            return np.zeros((0, 3))
        # Beams come in turn, and there are 16, 32 or 64 of them: no step that is even meets all.
        points = frame.cloud.points[:: len(frame.cloud) // SWEEP_POINTS | 1]
        far = np.linalg.norm(points, axis=1)
        return np.asarray(
            points[(far > 0.0) & (far >= self._range_m[0]) & (far <= self._range_m[1])]
        )


class ScanReturns:
    """Returns of a 2D laser.

    Args:
        mount: of the laser.
    """

    has_heights = False

    def __init__(self, mount: LidarMount) -> None:
        self._beams = Beams(mount)
        self._height = mount.T_body_lidar.t[2]
        self._T_laser_body = mount.T_body_lidar.inverse()

    def of_keyframe(self, keyframe: Keyframe) -> Array:
        """Return the points (N, 3) that a keyframe's scan hit."""
        return self._hits(keyframe.scan)

    def of_frame(self, frame: Frame) -> Array:
        """Return the points (N, 3) that a frame's scan hit."""
        return self._hits(frame.scan)

    def _hits(self, ranges: Array | None) -> Array:
        # A scan of another number of beams is refused by the tracker, which says so.
        if ranges is None or ranges.shape != (len(self._beams),):
            return np.zeros((0, 3))
        hits = self._beams.rays(ranges).hits
        return np.asarray(self._T_laser_body @ np.c_[hits, np.full(len(hits), self._height)])


@dataclass(frozen=True, eq=False)
class _Kept:
    """Some points of a keyframe, in an order of chance, and their colours."""

    points: Array32
    colours: Colours

    def first(self, count: int) -> "_Kept":
        if count >= len(self.points):
            return self
        return _Kept(self.points[:count].copy(), self.colours[:count].copy())


class CloudSample:
    """Some points of each keyframe of a map.

    Args:
        returns: of the LiDAR.
        T_body_sensor: (4, 4) where it is on the body.
        limit: at most so many, and those of the newest keyframe.
        most: of a keyframe at most so many.
        is_hasty: whether one look reads all that is new, not some of it.

    Attributes:
        is_whole: whether the last look has read all that there was.
    """

    def __init__(
        self,
        returns: Returns,
        T_body_sensor: Array,
        limit: int = POINTS,
        most: int = MOST,
        is_hasty: bool = False,
    ) -> None:
        self.is_whole = False
        self._returns, self._T_body_sensor = returns, T_body_sensor
        self._limit, self._most, self._is_hasty = limit, most, is_hasty
        self._each, self._stride = most, 1
        self._kept: dict[int, _Kept] = {}
        self._counts: dict[int, int] = {}

    def look(self, map: Map, keyframe_ids: Ids, Ts_world_body: Array) -> Shown:
        """Read some of what is new, and return what is shown.

        Args:
            map: may change meanwhile.
            keyframe_ids: (K,) its living keyframes, in order.
            Ts_world_body: (K, 4, 4) where they are.
        """
        Ts = Ts_world_body @ self._T_body_sensor
        newest = int(keyframe_ids[-1]) if len(keyframe_ids) else -1
        self._forget(keyframe_ids)
        self._read(map, keyframe_ids, Ts)
        while self._is_hasty and not self.is_whole:
            self._read(map, keyframe_ids, Ts)
        rows = np.flatnonzero([k in self._kept for k in keyframe_ids.tolist()])
        kept = [self._kept[k] for k in keyframe_ids[rows].tolist()]
        of = np.repeat(rows, [len(one.points) for one in kept])
        points = np.concatenate([np.zeros((0, 3), np.float32), *(one.points for one in kept)])
        turned = np.einsum("nij,nj->ni", Ts[of, :3, :3], points)
        colours = np.concatenate([np.zeros((0, 3), np.uint8), *(one.colours for one in kept)])
        return Shown(
            turned + Ts[of, :3, 3],
            keyframe_ids[of] == newest,
            sum(self._counts.values()),
            colours if self._returns.has_heights else None,
        )

    def _read(self, map: Map, ids: Ids, Ts: Array) -> None:
        """Read some keyframes that are new, the newest ones first."""
        unread = [n for n, k in enumerate(ids.tolist()) if k not in self._counts]
        now = unread[::-1][:AT_ONCE]
        self.is_whole = len(now) == len(unread)
        with map.lock:
            found = [
                (map.keyframe(k), n)
                for n, k in zip(now, ids[now].tolist())
                if map.is_keyframe_alive(k)
            ]
        for keyframe, n in found:
            points = self._returns.of_keyframe(keyframe)
            self._counts[keyframe.id] = len(points)
            # A seed of its own: the same points are shown whenever the map is looked at.
            chosen = np.random.default_rng(keyframe.id).permutation(len(points))[: self._most]
            colours = np.zeros((len(chosen), 3), np.uint8)
            if self._returns.has_heights:
                colours = shades(above_ground(points[chosen] @ Ts[n, :3, :3].T))
            self._kept[keyframe.id] = _Kept(points[chosen].astype(np.float32), colours)
        self._thin(int(ids[-1]) if len(ids) else -1)

    def _forget(self, ids: Ids) -> None:
        """Forget keyframes that are gone."""
        alive = set(ids.tolist())
        self._counts = {k: count for k, count in self._counts.items() if k in alive}
        self._kept = {k: one for k, one in self._kept.items() if k in alive}

    def _thin(self, newest: int) -> None:
        """Let each keyframe show as few points as needed, but the newest."""
        shown = self._kept.pop(newest, None)
        while True:
            self._kept = {
                k: one.first(self._each) for k, one in self._kept.items() if k % self._stride == 0
            }
            if sum(len(one.points) for one in self._kept.values()) <= self._limit:
                break
            if self._each > FEWEST:
                self._each //= 2
            else:
                self._stride *= 2
        if shown is not None:
            self._kept[newest] = shown


def shades(heights: Array) -> Colours:
    """Return the colours (N, 3) of heights (N,) above the ground, metres."""
    share = np.sqrt(np.clip(heights / TALL, 0.0, 1.0))[:, None]
    return np.asarray((1.0 - share) * np.array(LOW) + share * np.array(HIGH), np.uint8)
