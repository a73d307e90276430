"""Places of a map of clouds: where each keyframe's LiDAR was, and what was seen around there.

What closing, recognising and thinning know of a map is read once, as a copy: poses of living
keyframes, how unsure these are, how long the way between them was, and which edges there are. The
sweep of a single keyframe is sparse, and has holes where something stood in between; so what others
are laid onto are the clouds of keyframes some metres along the path before and after, together,

    place of m = ∪ { T_m⁻¹ T_k cloud_k :  |way_k - way_m| ≤ 10 m },

as the path has them by now. Those used last are kept, as long as the keyframes lie to each other as
they did. A place is bent by as much as its steps are unsure: of two walks at random away from m, n
steps each, the mean is off by n/6 of the variance of a step, which is 1/12 of that of all.

Cost: copying is O(K); a place 20 ms.

Reference: K. Koide, M. Yokozuka, S. Oishi, A. Banno, "Globally consistent 3D LiDAR mapping with
GPU-accelerated GICP matching cost factors", RA-L 6(4), 2021 (submaps of keyframes, matched).
"""

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.components import connected_components
from odomap.geometry.lie import se3_inverse
from odomap.lidar.target import Target
from odomap.maps.edges import GAP, ODOMETRY, EdgeTable
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.maps.snapshot import Snapshot

__all__ = [
    "CloudPlaces",
    "MapCopy",
    "Places",
    "cloud_points",
    "copy_map",
    "places_of",
    "read_places",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

KEPT = 8
"""Places that are kept ready."""
MOVED = 1e-3
"""How far its keyframes may have moved for one to be as it was, metres (and radians)."""
BENT = 1.0 / 12.0
"""Share of the variance of all steps by which a place is off."""
LEAST = 1e-3
"""Least information of a step, for what a step says nothing of."""


@dataclass(frozen=True, eq=False)
class Places:
    """A map of clouds as it was read.

    Attributes:
        ids: (K,) living keyframes, ascending.
        keyframes: these, in this order.
        Ts_world_body: (K, 4, 4).
        Ts_world_lidar: (K, 4, 4).
        sigma: (K,) how unsure their places are, metres; zero where nobody said.
        way: (K,) how far it was to each along the path, metres.
        piece: (K,) which piece of the map each is in.
        edges: all there are.
        snapshot: what was read.
    """

    ids: Index
    keyframes: tuple[Keyframe, ...]
    Ts_world_body: Array
    Ts_world_lidar: Array
    sigma: Array
    way: Array
    piece: Index
    edges: EdgeTable
    snapshot: Snapshot

    def row(self, keyframe_id: int) -> int:
        """Return the row of a living keyframe."""
        return int(np.searchsorted(self.ids, keyframe_id))

    def around(self, row: int, reach: float) -> Index:
        """Return the rows of keyframes with clouds so far along the path before and after one."""
        is_near = np.abs(self.way - self.way[row]) <= reach
        return np.flatnonzero(is_near & (self.piece == self.piece[row]))

    def bent(self, row: int, reach: float) -> Array:
        """Return by how much the place around a keyframe is off, (6, 6), tangent at its body."""
        ids, edges = self.ids[self.around(row, reach)], self.edges
        used = np.isin(edges.i, ids) & np.isin(edges.j, ids)
        used &= np.array(edges.kind, str) == ODOMETRY
        steps = np.linalg.inv(edges.information[used] + LEAST * np.eye(6))
        return np.asarray(BENT * steps.sum(axis=0))


@dataclass(frozen=True, eq=False)
class MapCopy:
    """What was copied of a map.

    Attributes:
        snapshot: poses and keyframes.
        covariances: (K, 6, 6) of the poses.
        edges: all there are.
    """

    snapshot: Snapshot
    covariances: Array
    edges: EdgeTable


def copy_map(map: Map) -> MapCopy:
    """Copy what is needed of a map, and nothing else: it is waited for."""
    with map.lock:
        snapshot = map.snapshot(map.keyframe_ids, landmarks=False)
        return MapCopy(snapshot, map.covariances(snapshot.keyframe_ids), map.edges())


def read_places(map: Map, T_body_lidar: Array) -> Places:
    """Read a map of clouds.

    Args:
        map: keyframes with clouds, and edges.
        T_body_lidar: (4, 4) where the LiDAR is on the body.
    """
    return places_of(copy_map(map), T_body_lidar)


def places_of(copy: MapCopy, T_body_lidar: Array) -> Places:
    """Return the places of a map that was copied."""
    snapshot, covariances, edges = copy.snapshot, copy.covariances, copy.edges
    order = np.argsort(snapshot.keyframe_ids)
    ids, Ts = snapshot.keyframe_ids[order], snapshot.Ts_world_body[order]
    variance = np.trace(covariances[order, :3, :3], axis1=1, axis2=2)
    steps = np.linalg.norm(np.diff(Ts[:, :3, 3], axis=0), axis=1)
    return Places(
        ids,
        tuple(snapshot.keyframes[n] for n in order.tolist()),
        Ts,
        Ts @ T_body_lidar,
        np.sqrt(np.where(np.isfinite(variance), np.maximum(variance, 0.0), 0.0)),
        np.concatenate([[0.0], np.cumsum(steps)]),
        _pieces(ids, edges),
        edges,
        snapshot,
    )


def _pieces(ids: Index, edges: EdgeTable) -> Index:
    """Return which piece (K,) each keyframe is in: what measured edges connect."""
    tied = np.array(edges.kind, str) != GAP
    tied &= np.isin(edges.i, ids) & np.isin(edges.j, ids)
    ends = np.searchsorted(ids, edges.i[tied]), np.searchsorted(ids, edges.j[tied])
    return connected_components(len(ids), *ends)


def cloud_points(keyframe: Keyframe) -> Array:
    """Return the points (N, 3) of a keyframe's cloud, none where it has no cloud."""
    if keyframe.cloud is None:
        return np.zeros((0, 3))
    return np.ascontiguousarray(keyframe.cloud[:, :3], np.float64)


class CloudPlaces:
    """Makes places ready to have clouds laid onto them.

    Args:
        reach: how far along the path keyframes belong to a place, metres.
        voxel: side of voxels, metres.
        max_distance: farthest that points will be apart, metres.
    """

    def __init__(self, reach: float, voxel: float, max_distance: float) -> None:
        self._reach, self._voxel, self._max_distance = reach, voxel, max_distance
        self._ready: OrderedDict[int, tuple[Index, Array, Target]] = OrderedDict()

    def target(self, places: Places, row: int) -> Target:
        """Return what was seen around a keyframe, in the frame of its LiDAR.

        Raises:
            InputError: hardly any points.
        """
        rows = places.around(row, self._reach)
        Ts = se3_inverse(places.Ts_world_lidar[row]) @ places.Ts_world_lidar[rows]
        key = int(places.ids[row])
        kept = self._ready.pop(key, None)
        if kept is None or not _is_as_it_was(kept, places.ids[rows], Ts):
            clouds = [
                cloud_points(places.keyframes[n]) @ T[:3, :3].T + T[:3, 3]
                for n, T in zip(rows.tolist(), Ts, strict=True)
            ]
            together = np.concatenate(clouds)
            kept = places.ids[rows], Ts, Target.of(together, self._voxel, self._max_distance)
        self._ready[key] = kept
        if len(self._ready) > KEPT:
            self._ready.popitem(last=False)
        return kept[2]


def _is_as_it_was(kept: tuple[Index, Array, Target], ids: Index, Ts: Array) -> bool:
    return np.array_equal(kept[0], ids) and bool(np.abs(kept[1] - Ts).max() < MOVED)
