"""Closing loops with a 3D LiDAR: clouds are laid onto places seen before, and the path corrected.

    keyframe → search (looks, and where the path says) → lay → ties → graph → path

A new keyframe is described and compared with earlier ones that it may have come back to
(`cloudsearch`); its cloud is laid onto those that are most alike, and judged (`cloudverifying`).
What holds is a tie, an edge of kind "loop". Where one is off the path, or there have been some, the
path is solved with all loops, old and new, and it is decided which of them are false
(`cloudgraph`). Ties between two pieces of the map are believed only once a second one agrees,
since no path speaks for or against them; the newer piece is then moved as a whole.

Cost: a search 3 ms, a place 40 ms, some keyframes having two; a solution O(K).

Reference: C. Cadena et al., "Past, present, and future of simultaneous localization and mapping",
IEEE Trans. Robotics 32(6), 2016 (loop closing, verified, in a graph).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.graphproblem import import_group
from odomap.geometry.lie import se3_inverse, so3_log
from odomap.maps.edges import LOOP
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.system.cloudconfig import CloudClosingConfig
from odomap.system.cloudgraph import CloudPath, Tie, graph_of
from odomap.system.cloudplaces import MapCopy, Places, cloud_points, copy_map, places_of
from odomap.system.cloudsearch import Candidate, CloudSearch
from odomap.system.cloudverifying import CloudJudge, Laid
from odomap.system.correction import correction
from odomap.system.stages import Loop

__all__ = ["CloudCloser"]

Array = NDArray[np.float64]
Pair = tuple[int, int]

AGREE, AGREE_RAD = 2.0, 0.1
"""How far apart two ties between the same pieces may say that these are, metres and radians."""


class CloudCloser:
    """The closer of SLAM with a 3D LiDAR.

    Args:
        map: keyframes with clouds, and edges.
        T_body_lidar: (4, 4) where the LiDAR is on the body.
        config: when loops are looked for, and believed.
    """

    def __init__(self, map: Map, T_body_lidar: Array, config: CloudClosingConfig) -> None:
        self._map, self._T_body_lidar, self._config = map, np.array(T_body_lidar), config
        self._search = CloudSearch(config)
        self._judge = CloudJudge(self._T_body_lidar, config)
        self._since_solved = self._pending = 0
        self._tied_at: Array | None = None
        self._alone: dict[Pair, tuple[Array, Tie]] = {}
        self._false: frozenset[Pair] = frozenset()
        import_group("SE3")

    def add(self, keyframe: Keyframe) -> "CloudClosingJob | None":
        """Read the map as it is."""
        self._since_solved += 1
        if not self._map.is_keyframe_alive(keyframe.id):  # it went while it waited
            return None
        here = self._map.T_world_body(keyframe.id)[:3, 3]
        is_apart = self._tied_at is None or (
            float(np.linalg.norm(here - self._tied_at)) >= self._config.apart
        )
        return CloudClosingJob(self, keyframe, is_apart, copy_map(self._map), self._is_due())

    def last(self) -> "CloudClosingJob | None":
        """Read the map at the end of a run, if it was not solved since the last loop."""
        if not self._pending:
            return None
        return CloudClosingJob(self, None, False, copy_map(self._map), True)

    def expect(self) -> None:
        """Take notice of a loop that somebody else closed: the path is to be solved."""
        self._pending += 1

    def _is_due(self) -> bool:
        least = max(self._config.solve_every, self._config.solve_share * self._map.num_keyframes)
        return self._pending > 0 and self._since_solved >= least

    # ---- without the map ----

    def places(self, copy: MapCopy) -> Places:
        """Return the places of the map that was copied."""
        return places_of(copy, self._T_body_lidar)

    def find(
        self, keyframe: Keyframe, places: Places, looks_back: bool
    ) -> tuple[list[Tie], list[Loop]]:
        """Search for a keyframe in earlier places: a tie, and why others are none.

        Args:
            keyframe: that is new.
            places: of the map.
            looks_back: whether it is searched for, or only described to be found later.
        """
        self._search.catch_up(places)
        refused: list[Loop] = []
        if keyframe.cloud is None or not len(keyframe.cloud):
            return [], refused
        row = places.row(keyframe.id)
        looks = self._search.looks(cloud_points(keyframe), places.Ts_world_lidar[row, 2, :3])
        self._search.remember(keyframe.id, looks)
        for candidate in self._search.candidates(places, keyframe.id, looks) if looks_back else ():
            found = self._lay(keyframe, places, row, candidate)
            if isinstance(found, Tie):
                return [found], refused
            refused.append(found)
        return [], refused

    def _lay(
        self, keyframe: Keyframe, places: Places, row: int, candidate: Candidate
    ) -> Tie | Loop:
        """Lay a keyframe's cloud onto a place."""
        up = places.Ts_world_lidar[row, 2, :3]
        laid = self._judge.lay(places, candidate, cloud_points(keyframe), up)
        ends, T = (keyframe.id, int(places.ids[candidate.row])), laid.T_place_body
        reason = laid.reason or _unfixed(laid, self._config.sigma)
        if reason:
            return Loop(*ends, T, laid.num_inliers, False, reason)
        return Tie(*ends, T, laid.information, laid.num_inliers)

    def solve(self, places: Places, ties: list[Tie]) -> CloudPath:
        """Find the path that agrees best with steps and loops, new ones among them."""
        return graph_of(places, ties, self._false).solve(self._config, True)

    def agreed(self, places: Places, tie: Tie) -> tuple[Places, list[Tie], str]:
        """Ask whether a tie between two pieces of the map is not alone.

        Args:
            places: of the map.
            tie: that is new.

        Returns:
            The places, the newer piece moved to where it belongs; ties to be kept; or why none.
        """
        m, k = places.row(tie.matched_id), places.row(tie.keyframe_id)
        if places.piece[m] == places.piece[k]:
            return places, [tie], ""
        Ts = places.Ts_world_body
        move = Ts[m] @ tie.T_matched_keyframe @ se3_inverse(Ts[k])
        first = [int(places.ids[np.argmax(places.piece == places.piece[n])]) for n in (m, k)]
        before = self._alone.get((first[0], first[1]))
        self._alone[first[0], first[1]] = move, tie
        if before is None or not _is_same(before[0] @ Ts[k], move @ Ts[k]):
            return (
                places,
                [],
                "it alone ties two pieces of the map so far: another must agree",
            )
        newer = places.piece == places.piece[k if first[0] < first[1] else m]
        moved = Ts.copy()
        moved[newer] = (move if first[0] < first[1] else se3_inverse(move)) @ Ts[newer]
        return replace(places, Ts_world_body=moved), [before[1], tie], ""

    def is_off(self, places: Places, ties: list[Tie]) -> bool:
        """Say whether ties are so far off the path that it is to be solved at once."""
        return any(_off(places, tie)[0] > self._config.solve_off for tie in ties)

    # ---- with the map again ----

    def keep(self, ties: list[Tie], map: Map) -> None:
        """Keep ties as edges."""
        for tie in ties:
            if map.is_keyframe_alive(tie.keyframe_id) and map.is_keyframe_alive(tie.matched_id):
                T = tie.T_matched_keyframe
                map.add_edge(tie.matched_id, tie.keyframe_id, T, tie.information, LOOP)
                self._tied_at = map.T_world_body(tie.keyframe_id)[:3, 3]
                self._pending += 1

    def solved(self, false: frozenset[Pair]) -> None:
        """Take notice that the path was solved, and of the loops that are not believed."""
        self._false = false
        self._since_solved = self._pending = 0

    @property
    def false(self) -> frozenset[Pair]:
        """Loops that are not believed: keyframe that came back, and where to."""
        return self._false


@dataclass(frozen=True, eq=False)
class CloudClosingJob:
    """A keyframe to be searched for, and a path to be solved."""

    closer: CloudCloser
    keyframe: Keyframe | None
    looks_back: bool
    copy: MapCopy
    is_due: bool

    def solve(self) -> "CloudClosingChange":
        """Search, lay and solve."""
        closer = self.closer
        places = known = closer.places(self.copy)
        ties: list[Tie] = []
        refused: list[Loop] = []
        if self.keyframe is not None:
            ties, refused = closer.find(self.keyframe, places, self.looks_back)
        for tie in ties[:1]:
            places, ties, why = closer.agreed(places, tie)
            refused += [_refused(tie, why)] if why else []
        merges = places is not known
        path, doubts = None, frozenset[Pair]()
        if self.is_due or closer.is_off(known, ties):
            path = closer.solve(places, ties)
            doubts = path.false - closer.false - {tie.ends for tie in ties}
            for tie in [tie for tie in ties if tie.ends in path.false]:
                ties.remove(tie)
                refused.append(_refused(tie, _contradiction(known, tie)))
        told = _told(known, ties, sorted(doubts), merges)
        return CloudClosingChange(closer, known, ties, (*told, *refused), path)


@dataclass(frozen=True, eq=False)
class CloudClosingChange:
    """What was found about a keyframe, and the path anew."""

    closer: CloudCloser
    places: Places
    ties: list[Tie]
    loops: tuple[Loop, ...]
    path: CloudPath | None

    def write(self, map: Map) -> None:
        """Correct the path, and keep the ties."""
        self.closer.keep(self.ties, map)
        if self.path is None:
            return
        solved, ones = self.path, np.ones(len(self.path.keyframe_ids))
        map.apply(
            correction(
                map,
                solved.keyframe_ids,
                (self.places.Ts_world_body, ones),
                (solved.Ts_world_body, ones),
                int(solved.keyframe_ids[0]),
                self.places.snapshot.version,
                solved.covariances,
            )
        )
        self.closer.solved(solved.false)


def _told(places: Places, ties: list[Tie], doubts: list[Pair], merges: bool) -> tuple[Loop, ...]:
    """Return loops that are believed, the first with those that are not any more.

    Where there is none, these are told of as they are.
    """
    loops = []
    for tie in ties:
        moved, turned = _off(places, tie)
        loop = Loop(*tie.ends, tie.T_matched_keyframe, tie.num_inliers, True)
        loops.append(replace(loop, merges=merges, moved=moved, turned=turned))
    if loops:
        return replace(loops[0], doubts=tuple(doubts)), *loops[1:]
    edges = places.edges
    for k, m in doubts:
        rows = np.flatnonzero((edges.j == k) & (edges.i == m))
        why = "is not believed any more: loops that came since contradict it"
        loops += [Loop(k, m, T, 0, False, why) for T in edges.Ts_i_j[rows[-1:]]]
    return tuple(loops)


def _off(places: Places, tie: Tie) -> tuple[float, float]:
    """Return how far, and by how much turned, a tie is from where the path says."""
    i, j = (places.Ts_world_body[places.row(k)] for k in (tie.matched_id, tie.keyframe_id))
    off = se3_inverse(se3_inverse(i) @ j) @ tie.T_matched_keyframe
    return float(np.linalg.norm(off[:3, 3])), float(np.linalg.norm(so3_log(off[:3, :3])))


def _is_same(T: Array, other: Array) -> bool:
    """Say whether two poses are of one place."""
    off = se3_inverse(T) @ other
    turned = float(np.linalg.norm(so3_log(off[:3, :3])))
    return bool(np.linalg.norm(off[:3, 3]) <= AGREE and turned <= AGREE_RAD)


def _refused(tie: Tie, reason: str) -> Loop:
    return Loop(*tie.ends, tie.T_matched_keyframe, tie.num_inliers, False, reason)


def _unfixed(laid: Laid, most: float) -> str:
    """Say that what was seen does not fix a place, as any is as good along a tunnel; else ""."""
    sigma = float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(laid.information)[:3, :3])[-1]))
    return f"what it shows fixes the place to {sigma:.1f} m only" if sigma > most else ""


def _contradiction(places: Places, tie: Tie) -> str:
    """Say how far a tie is from the path that does not believe it."""
    moved, turned = _off(places, tie)
    return (
        f"contradicts the path: {moved:.2g} m away and {np.degrees(turned):.1f}° turned, "
        "more than odometry and other loops allow"
    )
