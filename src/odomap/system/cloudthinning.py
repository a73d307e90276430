"""Thinning a map of clouds: keyframes go that show nothing new; it grows with the space seen.

Who drives the same streets all day adds keyframe after keyframe of what is known. Once the path has
been tied to that of an earlier passage, a keyframe goes if that shows nearly all it does:

    two older keyframes of another passage are within 6 m, and
    95 % of its voxels within 30 m are theirs (`lidar/covering`);

the oldest stay, which have been tied to most others. What changed, a new house, is not shown by
what is older, and so stays. The newest stay, too, as the path through them may change yet. Edges to
keyframes that go, go as well, unless the graph would fall apart (`edgefolding`); frames that hung
from them hang from the nearest of the older ones from then on, so that they stay where they are,
and later corrections move all that lies together.

Each keyframe is looked at once, when it is settled. Cost: 5 ms.

Reference: H. Kretzschmar, C. Stachniss, "Information-theoretic compression of pose graphs for
laser-based SLAM", International Journal of Robotics Research 31(11), 2012.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import se3_inverse
from odomap.lidar.covering import covered_share
from odomap.maps.edges import GAP, LOOP, EdgeTable
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.system.cloudclosing import CloudCloser, CloudClosingChange, CloudClosingJob
from odomap.system.cloudconfig import CloudThinningConfig
from odomap.system.cloudplaces import Places, cloud_points
from odomap.system.edgefolding import folded_ties
from odomap.system.stages import Loop

__all__ = ["CloudThinner"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

ANOTHER = 25.0
"""Way between two keyframes of different passages, metres."""
TIED = 25.0
"""Way from a keyframe to one that is tied to an earlier passage, metres."""
MOST = 3
"""Keyframes that are looked at in one job."""
FAR = 60.0
"""Way through what is left beyond which an edge is folded, metres: rounds stay closed."""
OTHERS = 6
"""Older keyframes that are compared with one, the nearest."""


class CloudThinner:
    """A closer that lets keyframes go as well, which show nothing new.

    Args:
        closer: does all else.
        config: when one is redundant.
    """

    def __init__(self, closer: CloudCloser, config: CloudThinningConfig) -> None:
        self._closer, self._config = closer, config
        self._next = 0

    def add(self, keyframe: Keyframe) -> "_Job | None":
        """Read what the closer needs of the map."""
        job = self._closer.add(keyframe)
        return None if job is None else _Job(self, job)

    def last(self) -> CloudClosingJob | None:
        """Read what is left to be done at the end."""
        return self._closer.last()

    def expect(self) -> None:
        """Take notice of a loop that somebody else closed."""
        self._closer.expect()

    def plan(self, places: Places, most: int = MOST) -> "_Plan | None":
        """Look at keyframes that are settled, and say which go, and what becomes of the map.

        Args:
            places: of the map.
            most: how many are looked at; the next ones at the next call.
        """
        settled = places.ids[: max(len(places.ids) - self._config.settled, 0)]
        rows = np.flatnonzero(settled >= self._next)[:most]
        if not len(rows):
            return None
        self._next = int(places.ids[rows[-1]]) + 1
        held = _held(places)
        gone: list[int] = []
        for row in rows.tolist():
            if int(places.ids[row]) not in held and self._is_shown(places, row, gone):
                gone.append(row)
        return _plan(places, np.array(gone, np.int64)) if gone else None

    def _is_shown(self, places: Places, row: int, gone: list[int]) -> bool:
        """Say whether keyframes of an earlier passage show what one does."""
        config, Ts = self._config, places.Ts_world_lidar
        points = cloud_points(places.keyframes[row])
        apart = np.linalg.norm(Ts[:, :3, 3] - Ts[row, :3, 3], axis=1)
        is_other = places.way < places.way[row] - ANOTHER
        is_other &= (places.piece == places.piece[row]) & (apart <= config.near)
        is_other[gone] = False
        rows = np.flatnonzero(is_other)
        if not len(points) or len(rows) < config.covers or not _is_tied(places, row):
            return False
        rows = rows[np.argsort(apart[rows], kind="stable")[:OTHERS]]
        moves = se3_inverse(Ts[row]) @ Ts[rows]
        others = [
            cloud_points(places.keyframes[n]) @ T[:3, :3].T + T[:3, 3]
            for n, T in zip(rows.tolist(), moves, strict=True)
        ]
        near = points[np.linalg.norm(points, axis=1) <= config.within]
        return covered_share(near, np.concatenate(others), config.voxel) >= config.share


@dataclass(frozen=True, eq=False)
class _Job:
    """A closer's job, after which keyframes are looked at."""

    thinner: CloudThinner
    job: CloudClosingJob

    def solve(self) -> "_Thinned":
        """Do the closer's job, and where it leaves the path as it is, find what is redundant."""
        change = self.job.solve()
        plan = None if change.path is not None else self.thinner.plan(change.places)
        return _Thinned(change, len(change.places.edges.kind), plan)


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
    """A closer's change, and keyframes that go."""

    change: CloudClosingChange
    num_edges: int
    plan: _Plan | None

    @property
    def loops(self) -> tuple[Loop, ...]:
        """What the closer decided on."""
        return self.change.loops

    def write(self, map: Map) -> None:
        """Write the closer's change, and let the keyframes go."""
        self.change.write(map)
        if self.plan is None:
            return
        plan, edges = self.plan, map.edges()
        came = np.r_[edges.i[self.num_edges :], edges.j[self.num_edges :]]
        if np.isin(came, plan.keyframe_ids).any():
            return  # something was tied to them meanwhile
        map.cull_keyframes(plan.keyframe_ids, plan.holder_ids)
        map.replace_edges(plan.rows, plan.edges)


def _held(places: Places) -> set[int]:
    """Return the keyframes that stay whatever they show: the first, and both ends of gaps."""
    edges = places.edges
    gaps = np.flatnonzero(np.array(edges.kind, str) == GAP)
    return {int(places.ids[0]), *edges.i[gaps].tolist(), *edges.j[gaps].tolist()}


def _is_tied(places: Places, row: int) -> bool:
    """Say whether the path near a keyframe has been tied to an earlier passage."""
    edges, ids = places.edges, places.ids
    used = (np.array(edges.kind, str) == LOOP) & np.isin(edges.i, ids) & np.isin(edges.j, ids)
    i, j = (places.way[np.searchsorted(ids, end[used])] for end in (edges.i, edges.j))
    is_near = (np.abs(j - places.way[row]) <= TIED) & (i < places.way[row] - ANOTHER)
    return bool(is_near.any())


def _plan(places: Places, gone: Index) -> _Plan:
    """Say which keyframes and edges go, and what comes in their place."""
    ids, edges = places.ids[gone], places.edges
    touched = np.flatnonzero(np.isin(edges.i, ids) | np.isin(edges.j, ids))
    new = folded_ties(edges, places.ids, places.Ts_world_body, ids, "SE3", FAR)
    holders = [_holder(places, row, gone) for row in gone.tolist()]
    return _Plan(ids, np.array(holders, np.int64), touched, new)


def _holder(places: Places, row: int, gone: Index) -> int:
    """Return the nearest of the older keyframes that are left."""
    Ts = places.Ts_world_body
    apart = np.linalg.norm(Ts[:row, :3, 3] - Ts[row, :3, 3], axis=1)
    apart[places.piece[:row] != places.piece[row]] = np.inf
    apart[gone[gone < row]] = np.inf
    return int(places.ids[apart.argmin()])
