"""Thinning a map of scans: submaps go that show nothing new, so that it grows with the space seen.

A robot that goes round the same building all day adds submap after submap of what is known. One is
redundant if nearly all of its scans are shown by enough older ones: with a keyframe close by, the
beams on their walls, and hardly any that end where they are free. Where a wall was moved they do
not show it, and the new submaps stay until there are enough. The oldest are kept: they have been
tied to most others.

With a redundant submap the keyframes go that are in no other. What their edges said of those that
stay is folded into few edges (`backend/graphs/folding`); loops that the path contradicts say
nothing. Frames that hung from them hang from the nearest of the older keyframes from then on. So
poses and covariances stay as they are, and later corrections move all that lies together.

Only submaps are looked at that are new, and a few others in turn, since what is close to what may
have been corrected. Cost: some milliseconds per submap.

Reference: H. Kretzschmar, C. Stachniss, "Information-theoretic compression of pose graphs for
laser-based SLAM", International Journal of Robotics Research 31(11), 2012.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.folding import fold
from odomap.backend.graphs.posegraph import PoseGraph
from odomap.geometry.lie import se3_inverse
from odomap.geometry.planar import (
    IN_PLANE,
    between_planar,
    from_plane,
    lift_information,
    planar_matrix,
    to_plane,
    transform_planar,
)
from odomap.geometry.se2 import se2_log
from odomap.lidar.grid import OccupancyGrid, beside, is_wall
from odomap.lidar.scans import Beams
from odomap.maps.edges import FOLDED, GAP, LOOP, EdgeTable
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.system.scanconfig import ScanThinningConfig
from odomap.system.stages import Change, Closer, Job, Loop
from odomap.system.submaps import SUBMAP, Submap, Submaps

__all__ = ["ScanThinner"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bool = NDArray[np.bool_]

NEW, IN_TURN = 3, 1
"""Submaps that are looked at: so many of the newest, and of the others."""
EVERY = 3
"""Of the keyframes of a submap, and of the beams of a scan, those that are looked at."""
FARTHEST = 12.0
"""Beams that end farther away say little of a place, metres."""
DOUBTED = 10.0
"""Standard deviations by which a loop contradicts the path that does not believe it."""


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
        if len(finished) <= self._config.covers:
            return job
        return _Job(job, self._read(), self._submaps, self._beams, self._config)

    def last(self) -> Job | None:
        """Read what is left to be done at the end."""
        return self._closer.last()

    def _read(self) -> "_Read":
        """Read the map, and choose the submaps that are looked at."""
        finished, active = tuple(self._submaps.finished), self._submaps.active
        new = np.arange(max(len(finished) - NEW, 0), len(finished))
        others = (self._next + np.arange(IN_TURN)) % len(finished)
        self._next += IN_TURN
        with self._map.lock:
            ids, edges = self._map.keyframe_ids, self._map.edges()
            x = to_plane(self._map.Ts_world_body(ids))
            keyframes = {k: self._map.keyframe(k) for k in ids.tolist()}
        held = {k for submap in active for k in submap.keyframe_ids}
        gaps = np.flatnonzero(np.array(edges.kind, str) == GAP)
        held |= {int(ids[0]), *edges.i[gaps].tolist(), *edges.j[gaps].tolist()}
        return _Read(finished, np.union1d(new, others), held, ids, x, keyframes, edges)


@dataclass(frozen=True, eq=False)
class _Read:
    """What was read of a map.

    Attributes:
        finished: the submaps, in order.
        looked_at: (n,) which of them may go.
        held: keyframes that must stay.
        ids: (K,) of living keyframes, ascending.
        x: (K, 3) where they are.
        keyframes: by id.
        edges: all there are.
    """

    finished: tuple[Submap, ...]
    looked_at: Index
    held: set[int]
    ids: Index
    x: Array
    keyframes: dict[int, Keyframe]
    edges: EdgeTable

    def place(self, k: int) -> Array:
        """Return where (3,) a living keyframe is."""
        return np.asarray(self.x[np.searchsorted(self.ids, k)])

    def rows(self, ids: list[int] | Index) -> Index:
        """Return the rows of those of some keyframes that live."""
        some = np.asarray(ids, np.int64)
        return np.searchsorted(self.ids, some[np.isin(some, self.ids)])


@dataclass(frozen=True, eq=False)
class _Job:
    """A closer's job, and submaps to be looked at."""

    job: Job | None
    read: _Read
    submaps: Submaps
    beams: Beams
    config: ScanThinningConfig

    def solve(self) -> "_Thinned":
        """Do the closer's job, find what is redundant, and fold its edges."""
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


def redundant(read: _Read, beams: Beams, config: ScanThinningConfig) -> list[Submap]:
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

    def __init__(self, read: _Read, beams: Beams, config: ScanThinningConfig) -> None:
        self._read, self._beams, self._config = read, beams, config
        rows = [read.rows(submap.keyframe_ids) for submap in read.finished]
        self._owner = np.repeat(np.arange(len(rows)), [len(each) for each in rows])
        self._places = read.x[np.concatenate(rows), :2]
        self._walls: dict[int, Bool] = {}

    def is_shown(self, k: int, before: int, gone: list[int]) -> bool:
        """Say whether enough submaps before one, but for those that go, show a keyframe's scan."""
        config, x, scan = self._config, self._read.place(k), self._read.keyframes[k].scan
        apart = self._places - x[:2]
        owners = np.unique(self._owner[np.hypot(*apart.T) <= config.near])
        owners = np.setdiff1d(owners[owners < before], gone)
        if len(owners) < config.covers or scan is None:
            return False
        hits = self._beams.points(scan).hits[::EVERY]
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


def _plan(read: _Read, gone: list[Submap]) -> _Plan:
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
    folded, within = _folded(read, ids, is_gone, between & ((kinds == FOLDED) | renamed))
    rows = np.flatnonzero(is_gone | renamed | within)
    only_renamed = np.flatnonzero(renamed & ~within)
    holders = [_holder(read, k, left) for k in ids.tolist()]
    new = _joined(_with_kind(edges, only_renamed, FOLDED), folded)
    return _Plan(ids, np.array(holders, np.int64), rows, new)


def _holder(read: _Read, k: int, left: Index) -> int:
    """Return the nearest of the older keyframes that are left."""
    older = left[left < k]
    apart = np.linalg.norm(read.x[read.rows(older), :2] - read.place(k)[:2], axis=1)
    return int(older[apart.argmin()])


def _folded(read: _Read, ids: Index, is_gone: Bool, may_fold: Bool) -> tuple[EdgeTable, Bool]:
    """Fold the edges to keyframes that go.

    Args:
        read: of the map.
        ids: of these keyframes.
        is_gone: (E,) edges to them.
        may_fold: (E,) edges between others that may be folded in.

    Returns:
        The edges in their place, and which (E,) of those between others are folded in.
    """
    edges = read.edges
    alive = np.isin(edges.i, read.ids) & np.isin(edges.j, read.ids)
    telling = is_gone & alive & _is_believed(read, is_gone & alive)
    around = np.setdiff1d(np.r_[edges.i[telling], edges.j[telling]], ids)
    within = may_fold & np.isin(edges.i, around) & np.isin(edges.j, around)
    used = np.flatnonzero(telling | within)
    if not len(used):
        return _with_kind(edges, used, FOLDED), within
    nodes = np.union1d(around, np.r_[edges.i[used], edges.j[used]])
    ends = np.searchsorted(nodes, edges.i[used]), np.searchsorted(nodes, edges.j[used])
    plane = IN_PLANE[:, None], IN_PLANE
    graph = PoseGraph(
        "SE2",
        planar_matrix(read.x[read.rows(nodes)]),
        *ends,
        planar_matrix(to_plane(edges.Ts_i_j[used])),
        edges.information[used][:, *plane],
    )
    tree = fold(graph, np.isin(nodes, ids))
    x = np.column_stack([
        tree.Ts_first_second[:, :2, 2],
        np.arctan2(tree.Ts_first_second[:, 1, 0], tree.Ts_first_second[:, 0, 0]),
    ])  # fmt: skip
    count = len(x)
    table = EdgeTable(
        nodes[tree.first],
        nodes[tree.second],
        from_plane(x),
        np.ones(count),
        lift_information(tree.information),
        (FOLDED,) * count,
    )
    return table, within


def _is_believed(read: _Read, chosen: Bool) -> Bool:
    """Say of each edge (E,) whether the path does not contradict it; only loops may be."""
    edges, kinds = read.edges, np.array(read.edges.kind, str)
    rows = np.flatnonzero(chosen & (kinds == LOOP))
    Ts = from_plane(read.x)
    between = se3_inverse(Ts[read.rows(edges.i[rows])]) @ Ts[read.rows(edges.j[rows])]
    off = se2_log(planar_matrix(to_plane(se3_inverse(edges.Ts_i_j[rows]) @ between)))
    information = edges.information[rows][:, IN_PLANE[:, None], IN_PLANE]
    believed = np.ones(len(kinds), np.bool_)
    believed[rows] = np.einsum("ni,nij,nj->n", off, information, off) < DOUBTED**2
    return believed


def _with_kind(edges: EdgeTable, rows: Index, kind: str) -> EdgeTable:
    """Return some edges, as those of another kind."""
    return replace(
        edges,
        i=edges.i[rows],
        j=edges.j[rows],
        Ts_i_j=edges.Ts_i_j[rows],
        scales_i_j=edges.scales_i_j[rows],
        information=edges.information[rows],
        kind=(kind,) * len(rows),
    )


def _joined(a: EdgeTable, b: EdgeTable) -> EdgeTable:
    """Return the edges of both."""
    return EdgeTable(
        np.concatenate([a.i, b.i]),
        np.concatenate([a.j, b.j]),
        np.concatenate([a.Ts_i_j, b.Ts_i_j]),
        np.concatenate([a.scales_i_j, b.scales_i_j]),
        np.concatenate([a.information, b.information]),
        (*a.kind, *b.kind),
    )
