"""The graph of a path with a 2D laser: keyframes in submaps, and loops between them.

What is known of the path are the poses of keyframes in submaps, measured when their scans were
added, and in submaps of earlier, found by the closer. In the plane,

    min over x_k   Σ_submap |x_a⁻¹ x_k ⊖ z|²_Λ  +  Σ_loop ρ( |x_a⁻¹ x_k ⊖ z|²_Λ ),

from the path as it is, with Cauchy's loss. Some loops are false, though the scan fits: one office
is like the next. Graduated non-convexity decides which of them the others contradict, with all
standard deviations larger, as submaps bend a little and nobody told them by how much. Covariances
are the graph's marginals.

Cost: O(K) for a solution, some ten of them to decide.

Reference: K. Konolige et al., "Efficient sparse pose adjustment for 2D mapping", IROS 2010.
"""

from collections.abc import Set
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.gnc import GncConfig
from odomap.geometry.planar import (
    IN_PLANE,
    between_planar,
    from_plane,
    lift_covariance,
    planar_matrix,
    to_plane,
)
from odomap.maps.edges import FOLDED, GAP, LOOP, ODOMETRY
from odomap.maps.map import Map
from odomap.maps.snapshot import Snapshot
from odomap.system.essentialgraph import EssentialGraph
from odomap.system.loopgraph import solve_loops
from odomap.system.scanconfig import ScanClosingConfig
from odomap.system.submaps import SUBMAP

__all__ = ["ScanGraph", "ScanPath", "read_graph"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Pair = tuple[int, int]

UNKNOWN = np.diag([1e-4, 1e-4, 0.1])
"""Information of the step from one piece of the map to the next: it keeps the graph in one."""
AS_STATED = GncConfig(least_variance=1.0)
"""Two submaps say one measurement of a keyframe, so that what is left of submap edges is next to
nothing and tells nothing of how sure loops are; no gate is made narrower by that."""


@dataclass(frozen=True, eq=False)
class ScanPath:
    """The path solved.

    Attributes:
        keyframe_ids: (K,) ascending.
        order: (K,) their rows in what was read.
        Ts_world_body: (K, 4, 4).
        covariances: (K, 6, 6).
        false: (n, 2) loops that the others contradict: keyframe and anchor.
    """

    keyframe_ids: Index
    order: Index
    Ts_world_body: Array
    covariances: Array
    false: Index


@dataclass(frozen=True, eq=False)
class ScanGraph:
    """What is solved, a copy from the map.

    Attributes:
        snapshot: poses of living keyframes.
        i, j: (E,) ids of anchors, and of keyframes in their submaps.
        x: (E, 3) these there.
        information: (E, 3, 3) of that.
        is_loop: (E,) whether it was found by the closer.
        is_false: (E,) loops known to be false.
    """

    snapshot: Snapshot
    i: Index
    j: Index
    x: Array
    information: Array
    is_loop: NDArray[np.bool_]
    is_false: NDArray[np.bool_]

    def solve(self, config: ScanClosingConfig, decides: bool) -> ScanPath:
        """Find the poses that agree best with the edges.

        Args:
            config: how far loops may be off.
            decides: whether it is decided anew which loops are false.
        """
        order = np.argsort(self.snapshot.keyframe_ids)
        limits = config.doubt, config.outlying
        solved = solve_loops(self._edges(order), self.is_false, *limits, decides, AS_STATED)
        T = solved.Ts_world_node  # rotations to the digits of a solver: made anew from headings
        x = np.stack([T[:, 0, 2], T[:, 1, 2], np.arctan2(T[:, 1, 0], T[:, 0, 0])], axis=1)
        is_false = ~solved.is_true
        return ScanPath(
            self.snapshot.keyframe_ids[order],
            order,
            from_plane(x),
            lift_covariance(solved.covariances),
            np.stack([self.j[is_false], self.i[is_false]], axis=1),
        )

    def _edges(self, order: Index) -> EssentialGraph:
        """Return the graph of keyframes in this order, the first of which stays."""
        ids = self.snapshot.keyframe_ids[order]
        x = to_plane(self.snapshot.Ts_world_body[order])
        return EssentialGraph(
            "SE2",
            planar_matrix(x),
            np.searchsorted(ids, self.i),
            np.searchsorted(ids, self.j),
            planar_matrix(self.x),
            self.information,
            is_fixed=np.arange(len(ids)) == 0,
            is_doubted=self.is_loop,
        )


def read_graph(map: Map, false: Set[Pair]) -> ScanGraph:
    """Read the poses of living keyframes and the edges between them.

    Args:
        map: with edges of submaps and loops.
        false: loops known to be false: keyframe and anchor.
    """
    with map.lock:
        snapshot = map.snapshot(map.keyframe_ids, landmarks=False)
        edges = map.edges()
    kinds = np.array(edges.kind, str)
    alive = np.isin(edges.i, snapshot.keyframe_ids) & np.isin(edges.j, snapshot.keyframe_ids)
    used = np.flatnonzero(alive & np.isin(kinds, (SUBMAP, FOLDED, LOOP, ODOMETRY, GAP)))
    x, information = to_plane(edges.Ts_i_j[used]), edges.information[used]
    information = information[:, IN_PLANE[:, None], IN_PLANE]
    for row in np.flatnonzero(kinds[used] == GAP):  # which draws nothing to where it was
        i, j = (to_plane(map.T_world_body(int(each[used[row]]))) for each in (edges.i, edges.j))
        x[row], information[row] = between_planar(i, j), UNKNOWN
    ends = zip(edges.j[used].tolist(), edges.i[used].tolist(), strict=True)
    return ScanGraph(
        snapshot,
        edges.i[used],
        edges.j[used],
        x,
        information,
        kinds[used] == LOOP,
        np.array([pair in false for pair in ends], bool),
    )
