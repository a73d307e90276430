"""Thinning a map of scans: submaps go that show nothing new, so that it grows with the space seen.

A robot that goes round the same building all day adds submap after submap of what is known. Those
go that are redundant (`redundancy`); the oldest stay, which have been tied to most others.

With a redundant submap the keyframes go that are in no other, and all edges to them, but where
nothing else ties what is left together: there they are folded into the surest edge that does
(`backend/graphs/folding`). To keep all they said would make the path surer than it is, and worse:
matches of many scans to the same walls are not independent. Frames that hung from
these keyframes hang from the nearest of the older ones from then on. So poses and covariances stay
as they are, and later corrections move all that lies together.

Only submaps are looked at that are new, and one of the others in turn, since what is close to what
may have been corrected. Cost: some milliseconds per submap.

Reference: H. Kretzschmar, C. Stachniss, "Information-theoretic compression of pose graphs for
laser-based SLAM", International Journal of Robotics Research 31(11), 2012.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.components import connected_components
from odomap.backend.graphs.folding import fold
from odomap.backend.graphs.posegraph import PoseGraph
from odomap.geometry.lie import se3_inverse
from odomap.geometry.planar import (
    IN_PLANE,
    from_plane,
    lift_information,
    planar_matrix,
    to_plane,
)
from odomap.geometry.se2 import se2_log
from odomap.lidar.scans import Beams
from odomap.maps.edges import FOLDED, GAP, LOOP, EdgeTable
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.system.redundancy import ScanMap, redundant
from odomap.system.scanconfig import ScanThinningConfig
from odomap.system.stages import Change, Closer, Job, Loop
from odomap.system.submaps import SUBMAP, Submap, Submaps

__all__ = ["ScanThinner"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bool = NDArray[np.bool_]

NEW, IN_TURN = 3, 1
"""Submaps that are looked at: so many of the newest, and of the others."""
RECENT = 1
"""Submaps that are not, since the path through them is not settled yet."""
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
    new = _with_kind(edges, np.flatnonzero(renamed), FOLDED)
    new = _joined(new, _ties(read, ids, is_gone, between, left))
    return _Plan(ids, np.array(holders, np.int64), np.flatnonzero(is_gone | renamed), new)


def _holder(read: ScanMap, k: int, left: Index) -> int:
    """Return the nearest of the older keyframes that are left."""
    older = left[left < k]
    older = older[read.pieces[read.rows(older)] == read.pieces[read.rows([k])]]
    apart = np.linalg.norm(read.x[read.rows(older), :2] - read.place(k)[:2], axis=1)
    return int(older[apart.argmin()])


def _ties(read: ScanMap, ids: Index, is_gone: Bool, between: Bool, left: Index) -> EdgeTable:
    """Return what ties together what would fall apart without keyframes.

    Args:
        read: of the map.
        ids: of these keyframes.
        is_gone: (E,) edges to them.
        between: (E,) edges between others.
        left: ids of the others.
    """
    edges = read.edges
    alive = np.isin(edges.i, read.ids) & np.isin(edges.j, read.ids)
    believed = _is_believed(read, alive)
    stay = between & believed & (edges.information[:, 0, 0] > 0.0)
    parts = connected_components(
        len(left), np.searchsorted(left, edges.i[stay]), np.searchsorted(left, edges.j[stay])
    )
    used = np.flatnonzero(is_gone & alive & believed)
    around = np.setdiff1d(np.r_[edges.i[used], edges.j[used]], ids)
    if len(np.unique(parts[np.searchsorted(left, around)])) < 2:
        return _with_kind(edges, used[:0], FOLDED)
    nodes = np.union1d(around, np.r_[edges.i[used], edges.j[used]])
    graph = PoseGraph(
        "SE2",
        planar_matrix(read.x[read.rows(nodes)]),
        np.searchsorted(nodes, edges.i[used]),
        np.searchsorted(nodes, edges.j[used]),
        planar_matrix(to_plane(edges.Ts_i_j[used])),
        edges.information[used][:, IN_PLANE[:, None], IN_PLANE],
    )
    tree = fold(graph, np.isin(nodes, ids))
    i, j = nodes[tree.first], nodes[tree.second]
    ends = np.searchsorted(left, i), np.searchsorted(left, j)
    chosen = _joining(parts, *ends, np.linalg.slogdet(tree.information)[1])
    x = np.column_stack([
        tree.Ts_first_second[chosen, :2, 2],
        np.arctan2(tree.Ts_first_second[chosen, 1, 0], tree.Ts_first_second[chosen, 0, 0]),
    ])  # fmt: skip
    return EdgeTable(
        i[chosen],
        j[chosen],
        from_plane(x),
        np.ones(len(chosen)),
        lift_information(tree.information[chosen]),
        (FOLDED,) * len(chosen),
    )


def _joining(parts: Index, i: Index, j: Index, sure: Array) -> Index:
    """Return the rows of the surest edges that make one of parts (N,) of a graph."""
    parts, chosen = parts.copy(), []
    for row in np.argsort(-sure, kind="stable").tolist():
        a, b = parts[i[row]], parts[j[row]]
        if a != b:
            parts[parts == b] = a
            chosen.append(row)
    return np.array(chosen, np.int64)


def _is_believed(read: ScanMap, chosen: Bool) -> Bool:
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
