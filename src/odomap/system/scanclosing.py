"""Closing loops with a laser: scans are searched for in the submaps of earlier.

A new keyframe may show what an old, finished submap holds. How far it may have drifted from there
is known, and in a window of that size branch and bound finds the best of all poses, or says that
none is good enough; where it found one the scan is matched exactly. Each that holds is an edge
between the submap's anchor and the keyframe, as unsure as the match and the walls there together.
After some of them the path is solved anew (`scangraph`). Whenever there are half as many loops
again, and at the end, it is decided anew which of them the others contradict; these are left out
until then.

Cost: a search some milliseconds, two at a keyframe at most; a solution O(K).

Reference: W. Hess, D. Kohler, H. Rapp, D. Andor, "Real-time loop closure in 2D LIDAR SLAM", ICRA
2016, sections V and VI.
"""

import logging
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.graphproblem import import_group
from odomap.geometry.planar import (
    IN_PLANE,
    between_planar,
    from_plane,
    lift_information,
    to_plane,
    transform_planar,
)
from odomap.lidar.branchbound import GridPyramid
from odomap.lidar.gridmatching import lay_on_grid
from odomap.lidar.scans import Beams
from odomap.maps.edges import LOOP
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.system.correction import correction
from odomap.system.scanconfig import ScanClosingConfig
from odomap.system.scangraph import ScanGraph, ScanPath, read_graph
from odomap.system.stages import Loop
from odomap.system.submaps import Submap, Submaps

__all__ = ["ScanCloser"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

PYRAMIDS = 24
"""Submaps whose pyramids are kept."""
MORE = 1.5
"""How many times as many loops there must be for it to be decided anew which are true."""
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
        self._false: frozenset[tuple[int, int]] = frozenset()
        self._num_loops, self._num_decided = 0, 0
        import_group("SE2")

    def add(self, keyframe: Keyframe) -> "ScanClosingJob | None":
        """Read where a keyframe may be in earlier submaps, and the graph if it is to be solved."""
        self._since_searched += 1
        self._since_solved += 1
        candidates: tuple[_Candidate, ...] = ()
        if self._since_searched >= self._config.every and keyframe.scan is not None:
            candidates = self._candidates(keyframe)
            self._since_searched = 0
        decides = self._num_loops >= MORE * self._num_decided
        return self._job(keyframe, candidates, self._is_due(), decides)

    def last(self) -> "ScanClosingJob | None":
        """Read the graph at the end of a run, if it was not solved since the last loop."""
        return self._job(None, (), self._num_loops > 0, True)

    def expect(self) -> None:
        """Take notice of a loop that somebody else closed: the path is to be solved."""
        self._pending += 1
        self._num_loops += 1

    def _is_due(self) -> bool:
        least = max(self._config.solve_every, self._config.solve_share * self._map.num_keyframes)
        return self._pending > 0 and self._since_solved >= least

    def _job(
        self,
        keyframe: Keyframe | None,
        candidates: tuple[_Candidate, ...],
        solves: bool,
        decides: bool,
    ) -> "ScanClosingJob | None":
        if not candidates and not solves:
            return None
        graph = read_graph(self._map, self._false) if solves else None
        if graph is not None:
            self._since_solved = self._pending = 0
            if decides:
                self._num_decided = self._num_loops
        return ScanClosingJob(self, keyframe, candidates, graph, decides)

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
            if self._submaps.piece_of(submap) != self._submaps.pieces.of(k):
                continue  # where it is from there nobody knows
            if submap.keyframe_ids[-1] > k - self._submaps.config.scans // 2:
                continue  # what is tied to it by submaps already
            x_anchor, anchor_sure = self._pose(submap.anchor_id)
            drift = np.maximum(np.diag(sure - anchor_sure), 0.0)
            reach = float(SIGMAS * np.sqrt(drift[:2].max()) + config.least_reach)
            reach = min(reach, config.farthest)
            guess = between_planar(x_anchor, x)
            if np.linalg.norm(guess[:2] - submap.middle) > submap.radius + reach:
                continue
            turn = min(float(SIGMAS * np.sqrt(drift[2]) + config.least_rad), config.widest_rad)
            chosen.append(_Candidate(submap, guess, reach, turn))
            if len(chosen) == config.most:
                self._next = index + 1
                break
        return tuple(chosen)

    def _pose(self, k: int) -> tuple[Array, Array]:
        covariance = self._map.covariance(k)[IN_PLANE[:, None], IN_PLANE]
        return to_plane(self._map.T_world_body(k)), covariance

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
            match = lay_on_grid(scan, submap.grid, best.x_grid_body)
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
                    _less_sure(match.information, submap.drift_near(match.x_grid_body)),
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

    def solve(self, graph: ScanGraph, decides: bool) -> ScanPath:
        """Find the path that agrees best with submaps and loops."""
        return graph.solve(self._config, decides)

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
            self._num_loops += 1

    def forget(self) -> None:
        """Let the pyramids of submaps go that have gone."""
        left = {submap.anchor_id for submap in self._submaps.finished}
        for gone in self._pyramids.keys() - left:
            del self._pyramids[gone]

    def disbelieve(self, false: Index) -> None:
        """Keep which loops (n, 2), keyframe and anchor, are contradicted by the others."""
        now = frozenset((k, anchor) for k, anchor in false.tolist())
        if now - self._false:
            text = "%d loops of %d contradict the others and are not believed"
            logging.getLogger(__name__).warning(text, len(now), self._num_loops)
        self._false = now


@dataclass(frozen=True, eq=False)
class ScanClosingJob:
    """A keyframe to be searched for, and a graph to be solved."""

    closer: ScanCloser
    keyframe: Keyframe | None
    candidates: tuple[_Candidate, ...]
    graph: ScanGraph | None
    decides: bool

    def solve(self) -> "ScanClosingChange":
        """Search and solve."""
        found: list[_Tie | Loop] = []
        if self.keyframe is not None and self.candidates:
            found = self.closer.search(self.keyframe, self.candidates)
        solved = None if self.graph is None else self.closer.solve(self.graph, self.decides)
        ties = [tie for tie in found if isinstance(tie, _Tie)]
        refused = [loop for loop in found if isinstance(loop, Loop)]
        return ScanClosingChange(self.closer, ties, refused, self.graph, solved)


@dataclass(frozen=True, eq=False)
class ScanClosingChange:
    """What was found about a keyframe, and the path anew."""

    closer: ScanCloser
    ties: list[_Tie]
    refused: list[Loop]
    graph: ScanGraph | None
    solved: ScanPath | None

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
            self.closer.disbelieve(solved.false)
        self.closer.tie(self.ties, map)
        self.closer.forget()


def _less_sure(information: Array, covariance: Array) -> Array:
    """Return (Λ⁻¹ + Σ)⁻¹ of information Λ (3, 3) that may be singular, and a covariance Σ."""
    less = np.linalg.solve(np.eye(3) + information @ covariance, information)
    return np.asarray(0.5 * (less + less.T))
