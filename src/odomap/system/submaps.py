"""Submaps: small grids that grow with the path, each as if there was no other.

A grid of the whole path would blur as the path drifts. A submap holds the scans of some keyframes
only, over which drift does not show, in the frame of the first of them, its anchor:

    submap s = { anchor a,  x_a_k of its keyframes k,  the grid of their scans there }

Scans are laid onto walls of scans before, and add walls of their own: the share f of them that was
not known yet is as unsure as the way since the last keyframe, R, and so a submap drifts, too,
by f R from keyframe to keyframe.

Two are active at a time, the older half full when the younger begins, so that a scan is always
matched to one that has seen enough; full ones are finished and never change. What is kept in the
map is an edge of kind "submap" from the anchor to each of its keyframes, where it was when its scan
was added: from these, and from the scans, the grids are made again when a map is opened.

Reference: W. Hess, D. Kohler, H. Rapp, D. Andor, "Real-time loop closure in 2D LIDAR SLAM", ICRA
2016, section IV.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.planar import (
    between_planar,
    compose_planar,
    from_plane,
    lift_information,
    moved_covariance,
    to_plane,
    transform_planar,
)
from odomap.lidar.fusion import fused
from odomap.lidar.grid import Evidence, OccupancyGrid
from odomap.lidar.scans import Beams, ScanRays
from odomap.maps.map import Map
from odomap.system.scanconfig import SubmapConfig
from odomap.system.scanpieces import Pieces

__all__ = ["SUBMAP", "Submap", "Submaps"]

Array = NDArray[np.float64]

NEARER = 0.5
"""How much nearer the middle of another submap must be for scans to be placed in that."""
SUBMAP = "submap"
"""Kind of the edges from the anchor of a submap to its keyframes."""


@dataclass(eq=False)
class Submap:
    """The grid of some keyframes, in the frame of the first.

    Attributes:
        anchor_id: the first keyframe.
        grid: of their scans.
        keyframe_ids: of those in it.
        x_anchor_body: (3,) where the body is now, while the submap is active.
        covariance: (3, 3) of that, right tangent.
        x_anchor_keyframe: (3,) its newest keyframe.
        drift: (3, 3) how unsure its newest walls are in its frame, tangent at the anchor.
        places: of each keyframe in it: where (3,), and the drift (3, 3) of walls that it added.
    """

    anchor_id: int
    grid: OccupancyGrid
    keyframe_ids: list[int] = field(default_factory=list)
    x_anchor_body: Array = field(default_factory=lambda: np.zeros(3))
    covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))
    x_anchor_keyframe: Array = field(default_factory=lambda: np.zeros(3))
    drift: Array = field(default_factory=lambda: np.zeros((3, 3)))
    places: list[tuple[Array, Array]] = field(default_factory=list)

    def insert(self, keyframe_id: int, scan: ScanRays, x_anchor_body: Array) -> None:
        """Add the scan of a keyframe."""
        parts = scan.hits, scan.between, scan.free, scan.origin[None]
        points = transform_planar(x_anchor_body, np.concatenate(parts))
        n, m = len(scan.hits), len(scan.hits) + len(scan.between)
        self.grid.insert(points[-1], points[:n], between=points[n:m], free=points[m:-1])
        self.keyframe_ids.append(keyframe_id)
        self.places.append((x_anchor_body, self.drift))
        self.x_anchor_keyframe = x_anchor_body

    def extend(self, covariance: Array) -> None:
        """Let the newest walls be less sure than those before by (3, 3), tangent at the body."""
        to_anchor = between_planar(self.x_anchor_body, np.zeros(3))
        self.drift = self.drift + moved_covariance(covariance, to_anchor)
        self.places[-1] = self.places[-1][0], self.drift

    @property
    def whole_covariance(self) -> Array:
        """(3, 3) of where the body is, relative to the anchor and not to the walls around."""
        return self.covariance + moved_covariance(self.drift, self.x_anchor_body)

    def drift_near(self, x_anchor_body: Array) -> Array:
        """Return how unsure (3, 3) the walls around a pose (3,) are, tangent at the body there."""
        apart = [float(np.hypot(*(x - x_anchor_body)[:2])) for x, _ in self.places]
        return moved_covariance(self.places[int(np.argmin(apart))][1], x_anchor_body)

    @property
    def middle(self) -> Array:
        """(2,) the middle of what it holds, metres from the anchor."""
        shape = np.array(self.grid.log_odds.shape[::-1])
        return np.asarray(self.grid.origin + 0.5 * self.grid.resolution * shape)

    @property
    def radius(self) -> float:
        """How far from its middle what it holds reaches, metres."""
        return 0.5 * self.grid.resolution * float(np.linalg.norm(self.grid.log_odds.shape))


class Submaps:
    """The submaps of a map.

    Args:
        map: where their anchors and edges are.
        config: how large they are.

    Attributes:
        active: one or two that still grow, the older first.
        finished: the others, in order.
        held: those that were active before a finished one was entered on trial.
        pieces: which piece of the map each keyframe is in.
    """

    def __init__(self, map: Map, config: SubmapConfig | None = None) -> None:
        self._map, self.config = map, SubmapConfig() if config is None else config
        self.active: list[Submap] = []
        self.finished: list[Submap] = []
        self.held: list[Submap] = []
        self.pieces = Pieces(map)

    def add(self, keyframe_id: int, scan: ScanRays, drift: Array) -> None:
        """Add a keyframe's scan where the active submaps have the body; begin and finish them.

        Args:
            keyframe_id: the keyframe.
            scan: its scan.
            drift: (3, 3) how much less sure walls are that it adds than those before.
        """
        if not self.active or len(self.active[-1].keyframe_ids) >= self.config.scans // 2:
            self.begin(keyframe_id)
        for submap in self.active:
            submap.insert(keyframe_id, scan, submap.x_anchor_body)
            if submap.anchor_id != keyframe_id:
                submap.extend(drift)
                self._tie(submap, keyframe_id)
        if len(self.active[0].keyframe_ids) >= self.config.scans:
            self.finish()

    def begin(self, anchor_id: int) -> None:
        """Begin a submap."""
        config = self.config
        evidence = Evidence(config.hit, config.miss, config.limit)
        grid = OccupancyGrid(config.resolution, evidence, keeps_hits=True)
        self.active.append(Submap(anchor_id, grid))

    def finish(self) -> None:
        """Finish the older of the active submaps."""
        full = self.active.pop(0)
        full.grid = full.grid.finished()
        self.finished.append(full)

    def leave(self) -> None:
        """Finish all that are active: what comes next was not measured in them."""
        self.go_back()
        while self.active:
            self.finish()

    def try_in(self, submap: Submap, x_anchor_body: Array, covariance: Array) -> None:
        """Place scans in another submap for a while; those that grow are held."""
        held = self.held or self.active
        self.stay(submap, x_anchor_body, covariance)
        self.held = held

    def go_back(self) -> None:
        """Place scans in those that grow again."""
        if self.held:
            self.active, self.held = self.held, []

    def piece_of(self, submap: Submap) -> int:
        """Return the piece of the map that a submap is in."""
        return self.pieces.of(submap.anchor_id)

    def stay(self, submap: Submap, x_anchor_body: Array, covariance: Array) -> None:
        """Place scans in a finished submap, which does not change."""
        held = replace(submap, x_anchor_body=x_anchor_body, covariance=covariance)
        self.active = [replace(held, x_anchor_keyframe=np.zeros(3))]

    def change(self) -> bool:
        """Place scans in another finished submap if the body is clearly nearer to its middle."""
        here = self.active[0]
        T_world_body = self._map.place(here.anchor_id, from_plane(here.x_anchor_body))
        nearest = min(self.finished, key=lambda submap: self._apart(submap, T_world_body))
        if self._apart(nearest, T_world_body) > NEARER * self._apart(here, T_world_body):
            return False
        x = to_plane(self._map.relative(nearest.anchor_id, T_world_body))
        self.stay(nearest, x, here.covariance)
        return True

    def _apart(self, submap: Submap, T_world_body: Array) -> float:
        """Return how far a body is from the middle of a submap, metres."""
        x = to_plane(self._map.relative(submap.anchor_id, T_world_body))
        return float(np.linalg.norm(x[:2] - submap.middle))

    def _tie(self, submap: Submap, keyframe_id: int) -> None:
        """Keep where a keyframe is in a submap. Two submaps say it of one measurement."""
        count = len(self.active)
        information = np.linalg.inv(submap.whole_covariance) / count
        self._map.add_edge(
            submap.anchor_id,
            keyframe_id,
            from_plane(submap.x_anchor_body),
            lift_information(information),
            SUBMAP,
        )

    def restore(self, beams: Beams) -> None:
        """Make the submaps of a map that was loaded, all of them finished."""
        edges = self._map.edges()
        rows: dict[int, list[int]] = {}
        for row, kind in enumerate(edges.kind):
            if kind == SUBMAP:
                rows.setdefault(int(edges.i[row]), []).append(row)
        for anchor_id, members in rows.items():
            self.begin(anchor_id)
            submap = self.active.pop()
            members_at = [(anchor_id, np.zeros(3))]
            members_at += [(int(edges.j[r]), to_plane(edges.Ts_i_j[r])) for r in members]
            for k, x in members_at:
                scan = self._map.keyframe(k).scan if self._map.is_keyframe_alive(k) else None
                if scan is not None:
                    submap.insert(k, beams.rays(scan), x)
            submap.grid = submap.grid.finished()
            self.finished.append(submap)

    def move(self, motion: Array, noise: Array) -> None:
        """Let the body move in all active submaps by a motion (3,), sure to (3, 3)."""
        for submap in (*self.active, *self.held):
            submap.x_anchor_body = compose_planar(submap.x_anchor_body, motion)
            submap.covariance = moved_covariance(submap.covariance, motion) + noise

    def place(self, x_anchor_body: Array, information: Array) -> None:
        """Let the body be where a scan was found in the older active submap.

        Args:
            x_anchor_body: (3,) there.
            information: (3, 3) of the scan, without what was known before.
        """
        motion = between_planar(self.active[0].x_anchor_body, x_anchor_body)
        for submap in self.active:
            submap.x_anchor_body = compose_planar(submap.x_anchor_body, motion)
            submap.covariance = fused(submap.covariance, information)
