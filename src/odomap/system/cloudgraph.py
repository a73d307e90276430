"""The graph of a path with a 3D LiDAR: steps of odometry, and loops between keyframes.

    min over T_k   Σ_step |T_i⁻¹ T_j ⊖ Z|²_Λ  +  Σ_loop ρ( |T_i⁻¹ T_j ⊖ Z|²_Λ ),

in SE(3), from the path as it is. Some loops are false, though the clouds fit: it is decided which
of them the others and the path contradict (`loopgraph`). Loops that are new are decided on with all
others before any is written; those that do not hold are named, new ones as refused, earlier ones as
not believed any more.

Steps say what the map of odometry drifted by between two keyframes, not what either sweep was off
by itself, which is white and comes on top of the marginals (`cloudmotion`). Real LiDARs err by what
none of them knows; so while it is decided on loops, steps are taken to be less sure than they say.

Across gaps nothing was measured; an edge that draws nothing keeps the graph in one piece until
loops tie the two. Covariances are the graph's marginals, relative to the first keyframe.

Cost: O(K) for a solution, some ten of them to decide.

Reference: H. Yang, P. Antonante, V. Tzoumas, L. Carlone, "Graduated non-convexity for robust
spatial perception", RA-L 5(2), 2020.
"""

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.lie import orthonormalize, se3_inverse
from odomap.maps.edges import FOLDED, GAP, LOOP, ODOMETRY
from odomap.system.cloudconfig import CloudClosingConfig
from odomap.system.cloudplaces import Places
from odomap.system.essentialgraph import EssentialGraph
from odomap.system.loopgraph import solve_loops

__all__ = ["CloudGraph", "CloudPath", "Tie", "graph_of"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bool = NDArray[np.bool_]
Pair = tuple[int, int]

SHORTEST = 0.1
"""Length that a step is taken to have at least, metres."""
UNKNOWN = np.diag([1e-4] * 3 + [0.1] * 3)
"""Information of the step from one piece of the map to the next: it keeps the graph in one."""


@dataclass(frozen=True, eq=False)
class Tie:
    """A keyframe measured relative to an earlier one.

    Attributes:
        keyframe_id: that came back.
        matched_id: that it came back to.
        T_matched_keyframe: (4, 4).
        information: (6, 6), right tangent.
        num_inliers: points that say so.
    """

    keyframe_id: int
    matched_id: int
    T_matched_keyframe: Array
    information: Array
    num_inliers: int

    @property
    def ends(self) -> Pair:
        """The keyframe, and the one it came back to."""
        return self.keyframe_id, self.matched_id


@dataclass(frozen=True, eq=False)
class CloudPath:
    """The path solved.

    Attributes:
        keyframe_ids: (K,) ascending.
        Ts_world_body: (K, 4, 4).
        covariances: (K, 6, 6).
        false: loops that are not believed: keyframe that came back, and where to.
    """

    keyframe_ids: Index
    Ts_world_body: Array
    covariances: Array
    false: frozenset[Pair]


@dataclass(frozen=True, eq=False)
class CloudGraph:
    """What is solved.

    Attributes:
        keyframe_ids: (K,) ascending.
        Ts_world_body: (K, 4, 4) as they are.
        i, j: (E,) ids of keyframes.
        Ts_i_j: (E, 4, 4).
        information: (E, 6, 6).
        is_loop: (E,) whether it was found by the closer.
        is_false: (E,) loops that were not believed the last time.
    """

    keyframe_ids: Index
    Ts_world_body: Array
    i: Index
    j: Index
    Ts_i_j: Array
    information: Array
    is_loop: Bool
    is_false: Bool

    def solve(self, config: CloudClosingConfig, decides: bool) -> CloudPath:
        """Find the poses that agree best with the edges.

        Args:
            config: how far loops may be off.
            decides: whether it is decided anew which loops are false.
        """
        limits = config.doubt, config.outlying
        graph = self._graph()
        loose = replace(graph, information=self._loosened(config))
        solved = solve_loops(graph, self.is_false, *limits, decides, deciding=loose)
        Ts, is_false = np.array(solved.Ts_world_node), ~solved.is_true
        Ts[:, :3, :3] = orthonormalize(Ts[:, :3, :3])
        false = zip(self.j[is_false].tolist(), self.i[is_false].tolist(), strict=True)
        return CloudPath(self.keyframe_ids, Ts, solved.covariances, frozenset(false))

    def _loosened(self, config: CloudClosingConfig) -> Array:
        """Return the information (E, 6, 6) with which it is decided which loops are true."""
        loosened = np.array(self.information)
        steps = np.flatnonzero(~self.is_loop)
        length = np.linalg.norm(self.Ts_i_j[steps, :3, 3], axis=1)
        slack = np.repeat([config.slack, config.slack_rad], 3) ** 2
        more = np.maximum(length, SHORTEST)[:, None, None] * np.diag(slack)
        loosened[steps] = np.linalg.inv(np.linalg.inv(loosened[steps]) + more)
        return loosened

    def _graph(self) -> EssentialGraph:
        """Return the graph of keyframes, the first of which stays."""
        ids = self.keyframe_ids
        return EssentialGraph(
            "SE3",
            self.Ts_world_body,
            np.searchsorted(ids, self.i),
            np.searchsorted(ids, self.j),
            self.Ts_i_j,
            self.information,
            is_fixed=np.arange(len(ids)) == 0,
            is_doubted=self.is_loop,
        )


def graph_of(places: Places, ties: Sequence[Tie], false: Set[Pair]) -> CloudGraph:
    """Return the graph of a map, with loops that are not in it yet, last.

    Args:
        places: the map as it was read.
        ties: these loops.
        false: loops that are not believed: keyframe that came back, and where to.
    """
    edges, ids = places.edges, places.ids
    kinds = np.array(edges.kind, str)
    alive = np.isin(edges.i, ids) & np.isin(edges.j, ids)
    used = np.flatnonzero(alive & np.isin(kinds, (ODOMETRY, FOLDED, LOOP, GAP)))
    Ts, information = edges.Ts_i_j[used], edges.information[used]
    is_gap = kinds[used] == GAP  # which draws nothing to where it was
    rows = (np.searchsorted(ids, end[used[is_gap]]) for end in (edges.i, edges.j))
    i, j = (places.Ts_world_body[end] for end in rows)
    Ts[is_gap], information[is_gap] = se3_inverse(i) @ j, UNKNOWN
    is_loop = kinds[used] == LOOP
    ends = zip(edges.j[used].tolist(), edges.i[used].tolist(), strict=True)
    is_false = np.array([pair in false for pair in ends], bool) & is_loop
    count = len(ties)
    return CloudGraph(
        ids,
        places.Ts_world_body,
        np.append(edges.i[used], [tie.matched_id for tie in ties]).astype(np.int64),
        np.append(edges.j[used], [tie.keyframe_id for tie in ties]).astype(np.int64),
        np.concatenate([Ts, np.array([t.T_matched_keyframe for t in ties]).reshape(-1, 4, 4)]),
        np.concatenate([information, np.array([t.information for t in ties]).reshape(-1, 6, 6)]),
        np.append(is_loop, np.ones(count, bool)),
        np.append(is_false, np.zeros(count, bool)),
    )
