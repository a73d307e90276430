"""Which submaps show nothing new: those whose scans enough older ones show.

A submap shows a scan if it has a keyframe close by, most beams end on its walls, and hardly any
where it is free. So a wall that was moved is not shown by what is older than that.

Cost: half a millisecond for each scan that is looked at; where a place is new one look is enough.

Reference: H. Kretzschmar, C. Stachniss, "Information-theoretic compression of pose graphs for
laser-based SLAM", International Journal of Robotics Research 31(11), 2012.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.planar import between_planar, transform_planar
from odomap.lidar.grid import OccupancyGrid, beside, is_wall
from odomap.lidar.scans import Beams
from odomap.maps.edges import EdgeTable
from odomap.maps.keyframes import Keyframe
from odomap.system.scanconfig import ScanThinningConfig
from odomap.system.submaps import Submap

__all__ = ["ScanMap", "redundant"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bool = NDArray[np.bool_]

EVERY = 3
"""Of the keyframes of a submap, and of the beams of a scan, those that are looked at."""
FARTHEST = 12.0
"""Beams that end farther away say little of a place, metres."""


@dataclass(frozen=True, eq=False)
class ScanMap:
    """A map of scans as it was read.

    Attributes:
        finished: the submaps, in order.
        looked_at: (n,) which of them may go.
        held: keyframes that must stay.
        ids: (K,) of living keyframes, ascending.
        x: (K, 3) where they are.
        keyframes: by id.
        edges: all there are.
        pieces: (K,) of the map that they are in.
    """

    finished: tuple[Submap, ...]
    looked_at: Index
    held: set[int]
    ids: Index
    x: Array
    keyframes: dict[int, Keyframe]
    edges: EdgeTable
    pieces: Index

    def place(self, k: int) -> Array:
        """Return where (3,) a living keyframe is."""
        return np.asarray(self.x[np.searchsorted(self.ids, k)])

    def rows(self, ids: list[int] | Index) -> Index:
        """Return the rows of those of some keyframes that live."""
        some = np.asarray(ids, np.int64)
        return np.searchsorted(self.ids, some[np.isin(some, self.ids)])


def redundant(read: ScanMap, beams: Beams, config: ScanThinningConfig) -> list[Submap]:
    """Return the submaps that older ones show.

    Args:
        read: of the map.
        beams: of the laser.
        config: when.
    """
    gone: list[int] = []
    look = _Look(read, beams, config)
    for n in read.looked_at.tolist():
        ids = [k for k in read.finished[n].keyframe_ids[::EVERY] if k in read.keyframes]
        may_fail = round((1.0 - config.share) * len(ids))
        failed = 0
        for k in ids:
            failed += not look.is_shown(k, n, gone)
            if failed > may_fail:
                break
        if failed <= may_fail:
            gone.append(n)
    return [read.finished[n] for n in gone]


class _Look:
    """Looks whether submaps show what keyframes saw."""

    def __init__(self, read: ScanMap, beams: Beams, config: ScanThinningConfig) -> None:
        self._read, self._beams, self._config = read, beams, config
        rows = [read.rows(submap.keyframe_ids) for submap in read.finished]
        self._owner = np.repeat(np.arange(len(rows)), [len(each) for each in rows])
        self._places = read.x[np.concatenate(rows), :2]
        self._pieces = read.pieces[np.concatenate(rows)]
        self._walls: dict[int, Bool] = {}

    def is_shown(self, k: int, before: int, gone: list[int]) -> bool:
        """Say whether enough submaps before one, but for those that go, show a keyframe's scan."""
        config, x, scan = self._config, self._read.place(k), self._read.keyframes[k].scan
        apart = self._places - x[:2]
        is_near = np.hypot(*apart.T) <= config.near
        is_near &= self._pieces == self._read.pieces[self._read.rows([k])]
        owners = np.unique(self._owner[is_near])
        owners = np.setdiff1d(owners[owners < before], gone)
        if len(owners) < config.covers or scan is None:
            return False
        hits = self._beams.rays(scan).hits[::EVERY]
        hits = hits[np.hypot(*hits.T) < FARTHEST]
        shown = 0
        for left, n in zip(range(len(owners), 0, -1), owners.tolist()):
            shown += self._shows(n, x, hits)
            if shown >= config.covers or shown + left <= config.covers:
                break
        return shown >= config.covers

    def _shows(self, n: int, x: Array, hits: Array) -> bool:
        """Say whether a submap shows beams (N, 2) that were seen from a place (3,)."""
        submap = self._read.finished[n]
        if n not in self._walls:
            self._walls[n] = beside(is_wall(submap.grid))
        in_submap = between_planar(self._read.place(submap.anchor_id), x)
        points = transform_planar(in_submap, hits)
        if _share(submap.grid, self._walls[n], points) < self._config.on_walls:
            return False
        return submap.grid.share_in_free(points) <= self._config.in_free


def _share(grid: OccupancyGrid, marked: Bool, points: Array) -> float:
    """Return the share of points (N, 2) in marked cells of a grid."""
    x, y = np.floor((points - grid.origin) / grid.resolution).astype(np.int64).T
    height, width = marked.shape
    is_in = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    return float(marked[y[is_in], x[is_in]].sum()) / max(len(points), 1)
