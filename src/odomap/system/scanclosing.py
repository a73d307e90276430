"""Closing loops with a laser: scans are searched for in the submaps of earlier.

A new keyframe may show what an old, finished submap holds. How far it may have drifted from there
is known, and in a window of that size branch and bound finds the best of all poses, or says that
none is good enough; where it found one the scan is matched exactly. Each that holds is an edge
between the submap's anchor and the keyframe. After some of them the path is solved anew,

    min over x_k   Σ_submap |x_a⁻¹ x_k ⊖ z|²_Λ  +  Σ_loop min( |x_a⁻¹ x_k ⊖ z|²_Λ, c² ),

in the plane: graduated non-convexity decides which loops the others contradict, and these are left
out. Covariances are the graph's marginals.

Cost: a search some milliseconds, two at a keyframe at most; a solution O(K).

Reference: W. Hess, D. Kohler, H. Rapp, D. Andor, "Real-time loop closure in 2D LIDAR SLAM", ICRA
2016, sections V and VI.
"""

import logging
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.covariances import GraphCovariances
from odomap.backend.graphs.gnc import find_inliers
from odomap.backend.graphs.graphproblem import import_group
from odomap.backend.graphs.solve import solve
from odomap.geometry.planar import (
    IN_PLANE,
    between_planar,
    from_plane,
    lift_covariance,
    lift_information,
    planar_matrix,
    to_plane,
    transform_planar,
)
from odomap.lidar.branchbound import GridPyramid
from odomap.lidar.gridmatching import match_to_grid
from odomap.lidar.scans import Beams
from odomap.maps.edges import LOOP
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.maps.snapshot import Snapshot
from odomap.system.correction import correction
from odomap.system.essentialgraph import EssentialGraph
from odomap.system.scanconfig import ScanClosingConfig
from odomap.system.stages import Loop
from odomap.system.submaps import SUBMAP, Submap, Submaps

__all__ = ["ScanCloser"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

PYRAMIDS = 24
"""Submaps whose pyramids are kept."""
SIGMAS = 3.0
"""Standard deviations of where the keyframe is in a submap that are searched."""


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A submap in which a keyframe may be.

    Attributes:
        submap: finished.
        x_guess: (3,) where the keyframe should be in it.
        reach, turn: half the window, metres and radians.
    """

    submap: Submap
    x_guess: Array
    reach: float
    turn: float


@dataclass(frozen=True, eq=False)
class _Tie:
    """A keyframe found in a submap: where it was expected and is, (3,), how sure, (3, 3)."""

    submap: Submap
    keyframe_id: int
    x_expected: Array
    x_anchor_keyframe: Array
    information: Array
    num_on_walls: int


@dataclass(frozen=True, eq=False)
class _Graph:
    """What is solved, read from the map: edges by ids of living keyframes."""

    snapshot: Snapshot
    i: Index
    j: Index
    x: Array
    information: Array
    is_loop: NDArray[np.bool_]


class ScanCloser:
    """The closer of SLAM with a 2D laser.

    Args:
        map: keyframes with scans, and edges.
        beams: of the laser.
        submaps: of the map.
        config: when loops are looked for.
    """

    def __init__(self, map: Map, beams: Beams, submaps: Submaps, config: ScanClosingConfig) -> None:
        self._map, self._beams, self._submaps, self._config = map, beams, submaps, config
        self._pyramids: OrderedDict[int, GridPyramid] = OrderedDict()
        self._tied: dict[int, int] = {}
        self._since_searched = self._since_solved = self._next = 0
        self._pending = 0
        import_group("SE2")

    def add(self, keyframe: Keyframe) -> "ScanClosingJob | None":
        """Read where a keyframe may be in earlier submaps, and the graph if it is to be solved."""
        self._since_searched += 1
        self._since_solved += 1
        candidates: tuple[_Candidate, ...] = ()
        if self._since_searched >= self._config.every and keyframe.scan is not None:
            candidates = self._candidates(keyframe)
            self._since_searched = 0
        return self._job(keyframe, candidates, self._is_due())

    def last(self) -> "ScanClosingJob | None":
        """Read the graph at the end of a run, if it was not solved since the last loop."""
        return self._job(None, (), self._pending > 0)

    def _is_due(self) -> bool:
        least = max(self._config.solve_every, self._config.solve_share * self._map.num_keyframes)
        return self._pending > 0 and self._since_solved >= least

    def _job(
        self,
        keyframe: Keyframe | None,
        candidates: tuple[_Candidate, ...],
        solves: bool,
    ) -> "ScanClosingJob | None":
        if not candidates and not solves:
            return None
        graph = self._read_graph() if solves else None
        if graph is not None:
            self._since_solved = self._pending = 0
        return ScanClosingJob(self, keyframe, candidates, graph)

    def _candidates(self, keyframe: Keyframe) -> tuple[_Candidate, ...]:
        """Return submaps that a keyframe may be in, in turn, so that each gets its chance."""
        k, config = keyframe.id, self._config
        x, sure = self._pose(k)
        finished = self._submaps.finished
        chosen: list[_Candidate] = []
        for n in range(len(finished)):
            index = (self._next + n) % len(finished)
            submap = finished[index]
            if k - self._tied.get(submap.anchor_id, -config.apart) < config.apart:
                continue
            if submap.keyframe_ids[-1] > k - self._submaps.config.scans // 2:
                continue  # what is tied to it by submaps already
            x_anchor, anchor_sure = self._pose(submap.anchor_id)
            drift = np.maximum(np.diag(sure - anchor_sure), 0.0)
            reach = float(SIGMAS * np.sqrt(drift[:2].max()) + config.least_reach)
            reach = min(reach, config.farthest)
            guess = between_planar(x_anchor, x)
            if np.linalg.norm(guess[:2] - submap.middle) > submap.radius + reach:
                continue
            turn = min(float(SIGMAS * np.sqrt(drift[2]) + 0.1), config.widest_rad)
            chosen.append(_Candidate(submap, guess, reach, turn))
            if len(chosen) == config.most:
                self._next = index + 1
                break
        return tuple(chosen)

    def _pose(self, k: int) -> tuple[Array, Array]:
        covariance = self._map.covariance(k)[IN_PLANE[:, None], IN_PLANE]
        return to_plane(self._map.T_world_body(k)), covariance

    def _read_graph(self) -> _Graph:
        """Read the poses of living keyframes and the edges between them."""
        with self._map.lock:
            snapshot = self._map.snapshot(self._map.keyframe_ids, landmarks=False)
            edges = self._map.edges()
        kinds = np.array(edges.kind, str)
        alive = np.isin(edges.i, snapshot.keyframe_ids) & np.isin(edges.j, snapshot.keyframe_ids)
        used = np.flatnonzero(alive & np.isin(kinds, (SUBMAP, LOOP)))
        plane = IN_PLANE[:, None], IN_PLANE
        return _Graph(
            snapshot,
            edges.i[used],
            edges.j[used],
            to_plane(edges.Ts_i_j[used]),
            edges.information[used][:, *plane],
            kinds[used] == LOOP,
        )

    # ---- without the map ----

    def search(self, keyframe: Keyframe, candidates: tuple[_Candidate, ...]) -> list["_Tie | Loop"]:
        """Search for a keyframe in submaps: ties, and why others are none."""
        assert keyframe.scan is not None
        scan = self._beams.points(keyframe.scan)
        found: list[_Tie | Loop] = []
        if not len(scan):
            return found
        config = self._config
        for candidate in candidates:
            submap = candidate.submap
            window = candidate.x_guess, candidate.reach, candidate.turn
            best = self._pyramid(submap).search(scan.hits, *window, config.score)
            ends = keyframe.id, submap.anchor_id
            if best is None:
                where = f"within {candidate.reach:.1f} m and {np.degrees(candidate.turn):.0f}°"
                reason = f"nowhere {where} {config.score:.0%} of the scan meet walls"
                T = from_plane(candidate.x_guess)
                found.append(Loop(*ends, T, 0, False, reason))
                continue
            match = match_to_grid(submap.grid, scan.hits, scan.normals, best.x_grid_body)
            count = round(match.on_walls * len(scan))
            free = submap.grid.share_in_free(transform_planar(match.x_grid_body, scan.hits))
            if free > config.in_free * (free + match.on_walls):
                reason = (
                    f"{match.on_walls:.0%} of {len(scan)} beams meet walls, but {free:.0%} end "
                    "where the submap is free"
                )
                T = from_plane(match.x_grid_body)
                found.append(Loop(*ends, T, count, False, reason))
                continue
            found.append(
                _Tie(
                    submap,
                    keyframe.id,
                    candidate.x_guess,
                    match.x_grid_body,
                    match.information,
                    count,
                )
            )
        return found

    def _pyramid(self, submap: Submap) -> GridPyramid:
        """Return the pyramid of a submap; those used last are kept."""
        pyramid = self._pyramids.pop(submap.anchor_id, None) or GridPyramid(submap.grid)
        self._pyramids[submap.anchor_id] = pyramid
        if len(self._pyramids) > PYRAMIDS:
            self._pyramids.popitem(last=False)
        return pyramid

    def solve(self, graph: _Graph) -> "_Solved":
        """Find the poses that agree best with the edges."""
        ids = graph.snapshot.keyframe_ids
        order = np.argsort(ids)
        sorted_ids = ids[order]
        i, j = (np.searchsorted(sorted_ids, ends) for ends in (graph.i, graph.j))
        x = to_plane(graph.snapshot.Ts_world_body[order])
        is_fixed = np.zeros(len(x), bool)
        is_fixed[0] = True
        edges = EssentialGraph(
            "SE2",
            planar_matrix(x),
            i,
            j,
            planar_matrix(graph.x),
            graph.information,
            is_fixed=is_fixed,
            is_doubted=graph.is_loop,
        )
        doubts = np.where(graph.is_loop, self._config.doubt**-2, 1.0)
        inliers = find_inliers(edges, doubts)
        is_true = inliers.is_inlier | ~graph.is_loop
        solution = solve(edges.placed(inliers.Ts_world_node), initial="given", weights=is_true)
        believed = edges.without(~is_true).placed(solution.Ts_world_node)
        covariances = GraphCovariances(believed).marginals()
        T = solution.Ts_world_node  # rotations to the digits of a solver: made anew from headings
        x = np.stack([T[:, 0, 2], T[:, 1, 2], np.arctan2(T[:, 1, 0], T[:, 0, 0])], axis=1)
        Ts = from_plane(x)
        doubted = np.stack([graph.j[~is_true], graph.i[~is_true]], axis=1)
        return _Solved(sorted_ids, order, Ts, lift_covariance(covariances), doubted)

    # ---- with the map again ----

    def tie(self, ties: list[_Tie], map: Map) -> None:
        """Keep where keyframes were found in submaps."""
        for tie in ties:
            if not map.is_keyframe_alive(tie.keyframe_id):
                continue
            map.add_edge(
                tie.submap.anchor_id,
                tie.keyframe_id,
                from_plane(tie.x_anchor_keyframe),
                lift_information(tie.information),
                LOOP,
            )
            self._tied[tie.submap.anchor_id] = tie.keyframe_id
            self._pending += 1


@dataclass(frozen=True, eq=False)
class _Solved:
    """The path solved: ids ascending, their rows as read, poses, covariances, doubted loops."""

    keyframe_ids: Index
    order: Index
    Ts_world_body: Array
    covariances: Array
    doubted: Index


@dataclass(frozen=True, eq=False)
class ScanClosingJob:
    """A keyframe to be searched for, and a graph to be solved."""

    closer: ScanCloser
    keyframe: Keyframe | None
    candidates: tuple[_Candidate, ...]
    graph: _Graph | None

    def solve(self) -> "ScanClosingChange":
        """Search and solve."""
        found: list[_Tie | Loop] = []
        if self.keyframe is not None and self.candidates:
            found = self.closer.search(self.keyframe, self.candidates)
        solved = None if self.graph is None else self.closer.solve(self.graph)
        ties = [tie for tie in found if isinstance(tie, _Tie)]
        refused = [loop for loop in found if isinstance(loop, Loop)]
        return ScanClosingChange(self.closer, ties, refused, self.graph, solved)


@dataclass(frozen=True, eq=False)
class ScanClosingChange:
    """What was found about a keyframe, and the path anew."""

    closer: ScanCloser
    ties: list[_Tie]
    refused: list[Loop]
    graph: _Graph | None
    solved: _Solved | None

    @property
    def loops(self) -> tuple[Loop, ...]:
        """Ties, and submaps that the keyframe was not found in."""
        accepted = [
            Loop(
                tie.keyframe_id,
                tie.submap.anchor_id,
                from_plane(tie.x_anchor_keyframe),
                tie.num_on_walls,
                True,
                moved=float(np.linalg.norm((tie.x_anchor_keyframe - tie.x_expected)[:2])),
                turned=abs(float(between_planar(tie.x_expected, tie.x_anchor_keyframe)[2])),
            )
            for tie in self.ties
        ]
        return (*accepted, *self.refused)

    def write(self, map: Map) -> None:
        """Correct the path, and keep the ties."""
        if self.graph is not None and self.solved is not None:
            read, solved = self.graph.snapshot, self.solved
            ones = np.ones(len(solved.keyframe_ids))
            Ts_read = read.Ts_world_body[solved.order]
            map.apply(
                correction(
                    map,
                    solved.keyframe_ids,
                    (Ts_read, ones),
                    (solved.Ts_world_body, ones),
                    int(solved.keyframe_ids[0]),
                    read.version,
                    solved.covariances,
                )
            )
            if len(solved.doubted):
                text = "%d loops contradict the others and are not believed"
                logging.getLogger(__name__).warning(text, len(solved.doubted))
        self.closer.tie(self.ties, map)
