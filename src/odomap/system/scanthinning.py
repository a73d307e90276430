"""Thinning a map of scans: submaps go that show nothing new, so that it grows with the space seen.

A robot that goes round the same building all day adds submap after submap of what is known. Those
go that are redundant (`redundancy`); the oldest stay, which have been tied to most others.

With a redundant submap the keyframes go that are in no other, and all edges to them, but where
nothing else ties what is left together (`edgefolding`). Frames that hung from these keyframes hang
from the nearest of the older ones from then on. So poses and covariances stay as they are, and
later corrections move all that lies together.

Only submaps are looked at that are new, and one of the others in turn, since what is close to what
may have been corrected. Cost: some milliseconds per submap.

Reference: H. Kretzschmar, C. Stachniss, "Information-theoretic compression of pose graphs for
laser-based SLAM", International Journal of Robotics Research 31(11), 2012.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.planar import from_plane, to_plane
from odomap.lidar.scans import Beams
from odomap.maps.edges import FOLDED, GAP, EdgeTable
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.system.edgefolding import folded_ties, joined_edges, with_kind
from odomap.system.redundancy import ScanMap, redundant
from odomap.system.scanconfig import ScanThinningConfig
from odomap.system.stages import Change, Closer, Job, Loop
from odomap.system.submaps import SUBMAP, Submap, Submaps

__all__ = ["ScanThinner"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

NEW, IN_TURN = 3, 1
"""Submaps that are looked at: so many of the newest, and of the others."""
RECENT = 1
"""Submaps that are not, since the path through them is not settled yet."""


class ScanThinner:
    """A closer that lets submaps go as well, which show nothing new.

    Args:
        closer: does all else.
        map: keyframes with scans, and edges.
        beams: of the laser.
        submaps: of the map.
        config: when one is redundant.
    """

    def __init__(
        self, closer: Closer, map: Map, beams: Beams, submaps: Submaps, config: ScanThinningConfig
    ) -> None:
        self._closer, self._map, self._beams = closer, map, beams
        self._submaps, self._config = submaps, config
        self._newest, self._next = -1, 0

    def add(self, keyframe: Keyframe) -> Job | None:
        """Read what the closer needs of the map, and where a submap was finished, its graph."""
        job = self._closer.add(keyframe)
        finished = self._submaps.finished
        if not finished or finished[-1].anchor_id == self._newest:
            return job
        self._newest = finished[-1].anchor_id
        if len(finished) <= self._config.covers + RECENT:
            return job
        return _Job(job, self._read(), self._submaps, self._beams, self._config)

    def last(self) -> Job | None:
        """Read what is left to be done at the end."""
        return self._closer.last()

    def _read(self) -> ScanMap:
        """Read the map, and choose the submaps that are looked at."""
        finished, active = tuple(self._submaps.finished), self._submaps.active
        last = len(finished) - RECENT
        new = np.arange(max(last - NEW, 0), last)
        others = (self._next + np.arange(IN_TURN)) % max(last, 1)
        self._next += IN_TURN
        with self._map.lock:
            ids, edges = self._map.keyframe_ids, self._map.edges()
            x = to_plane(self._map.Ts_world_body(ids))
            keyframes = {k: self._map.keyframe(k) for k in ids.tolist()}
        held = {k for submap in active for k in submap.keyframe_ids}
        gaps = np.flatnonzero(np.array(edges.kind, str) == GAP)
        held |= {int(ids[0]), *edges.i[gaps].tolist(), *edges.j[gaps].tolist()}
        pieces = np.array([self._submaps.pieces.of(k) for k in ids.tolist()], np.int64)
        return ScanMap(finished, np.union1d(new, others), held, ids, x, keyframes, edges, pieces)


@dataclass(frozen=True, eq=False)
class _Job:
    """A closer's job, and submaps to be looked at."""

    job: Job | None
    read: ScanMap
    submaps: Submaps
    beams: Beams
    config: ScanThinningConfig

    def solve(self) -> "_Thinned":
        """Do the closer's job, find what is redundant, and plan what becomes of the map."""
        change = None if self.job is None else self.job.solve()
        gone = redundant(self.read, self.beams, self.config)
        plan = _plan(self.read, gone) if gone else None
        return _Thinned(change, self.submaps, gone, len(self.read.edges.kind), plan)


@dataclass(frozen=True, eq=False)
class _Plan:
    """What becomes of a map.

    Attributes:
        keyframe_ids: (n,) that go.
        holder_ids: (n,) from which hangs what hung from them.
        rows: of edges that go.
        edges: in their place.
    """

    keyframe_ids: Index
    holder_ids: Index
    rows: Index
    edges: EdgeTable


@dataclass(frozen=True, eq=False)
class _Thinned:
    """A closer's change, and submaps that go."""

    change: Change | None
    submaps: Submaps
    gone: list[Submap]
    num_edges: int
    plan: _Plan | None

    @property
    def loops(self) -> tuple[Loop, ...]:
        """What the closer decided on."""
        return () if self.change is None else self.change.loops

    def write(self, map: Map) -> None:
        """Write the closer's change, and let the submaps go with their keyframes."""
        if self.change is not None:
            self.change.write(map)
        if self.plan is None:
            return
        plan, edges = self.plan, map.edges()
        came = np.r_[edges.i[self.num_edges :], edges.j[self.num_edges :]]
        if np.isin(came, plan.keyframe_ids).any():
            return  # something was tied to them meanwhile: another time
        map.cull_keyframes(plan.keyframe_ids, plan.holder_ids)
        map.replace_edges(plan.rows, plan.edges)
        names = {submap.anchor_id for submap in self.gone}
        self.submaps.finished[:] = [s for s in self.submaps.finished if s.anchor_id not in names]


def _plan(read: ScanMap, gone: list[Submap]) -> _Plan:
    """Say which keyframes and edges go with submaps, and what comes in their place."""
    anchors = {submap.anchor_id for submap in gone}
    stay = {k for s in read.finished if s.anchor_id not in anchors for k in s.keyframe_ids}
    members = {k for submap in gone for k in submap.keyframe_ids}
    ids = np.array(sorted((members - stay - read.held) & read.keyframes.keys()), np.int64)
    left = np.setdiff1d(read.ids, ids)
    edges, kinds = read.edges, np.array(read.edges.kind, str)
    # Edges that make submaps, of which both ends stay, make none any more.
    is_gone = np.isin(edges.i, ids) | np.isin(edges.j, ids)
    between = np.isin(edges.i, left) & np.isin(edges.j, left)
    renamed = (kinds == SUBMAP) & np.isin(edges.i, list(anchors)) & between
    holders = [_holder(read, k, left) for k in ids.tolist()]
    new = with_kind(edges, np.flatnonzero(renamed), FOLDED)
    new = joined_edges(new, folded_ties(edges, read.ids, from_plane(read.x), ids, "SE2"))
    return _Plan(ids, np.array(holders, np.int64), np.flatnonzero(is_gone | renamed), new)


def _holder(read: ScanMap, k: int, left: Index) -> int:
    """Return the nearest of the older keyframes that are left."""
    older = left[left < k]
    older = older[read.pieces[read.rows(older)] == read.pieces[read.rows([k])]]
    apart = np.linalg.norm(read.x[read.rows(older), :2] - read.place(k)[:2], axis=1)
    return int(older[apart.argmin()])
