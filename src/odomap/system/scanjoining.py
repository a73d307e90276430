"""Joining pieces of a map that a 2D laser made: one is recognised in the other.

A body that was carried away unseen begins a piece of its own (`maps/atlas`). Its keyframes are
searched for in the submaps of the other pieces, some of those at a time, and each that is found
says how the two pieces lie to each other,

    C = T_world_a  T_a_k  T_world_k⁻¹,      k of this piece, found in the submap of anchor a,

a rigid motion of one as a whole. Rooms may be alike: only where a second keyframe, some way on,
says the same are they one. Then the newer piece is moved, both findings are loops, and the closer
solves the path of all.

Cost: two searches for each keyframe, while there are pieces.

Reference: Elvira, Tardós, Montiel, "ORBSLAM-Atlas: a robust and accurate multi-map system", IROS
2019, section IV.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.planar import (
    between_planar,
    compose_planar,
    from_plane,
    lift_information,
    to_plane,
)
from odomap.lidar.scans import Beams
from odomap.maps.edges import LOOP
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.maps.snapshot import Update
from odomap.system.scanclosing import ScanCloser, ScanClosingChange, ScanClosingJob
from odomap.system.scanconfig import ScanTrackingConfig
from odomap.system.scanrecognition import Recognised, ScanFinder
from odomap.system.stages import Loop
from odomap.system.submaps import Submap, Submaps

__all__ = ["ScanJoiner"]

Array = NDArray[np.float64]

APART = 10
"""Keyframes between two that must say the same."""
AGREE = 0.5, 0.1
"""How far what they say may be apart, metres and radians."""


@dataclass(frozen=True, eq=False)
class _Finding:
    """A keyframe found in a submap of another piece: where it is there, (3,), and how sure."""

    keyframe_id: int
    submap: Submap
    x_anchor_keyframe: Array
    information: Array
    num_on_walls: int


class ScanJoiner:
    """A closer that joins pieces as well.

    Args:
        map: keyframes with scans, and edges.
        beams: of the laser.
        submaps: of the map.
        config: what a scan must show to be recognised.
        closer: closes loops within a piece.
    """

    def __init__(
        self,
        map: Map,
        beams: Beams,
        submaps: Submaps,
        config: ScanTrackingConfig,
        closer: ScanCloser,
    ) -> None:
        self._map, self._beams, self._submaps, self._config = map, beams, submaps, config
        self._closer = closer
        self._finder = ScanFinder(map, submaps.pieces, config)
        self._piece = -1
        self._before: _Finding | None = None

    def add(self, keyframe: Keyframe) -> "ScanClosingJob | ScanJoiningJob | None":
        """Read what there is to do: loops, and submaps of other pieces."""
        job, submaps, pieces = self._closer.add(keyframe), self._submaps, self._submaps.pieces
        if pieces.is_one or keyframe.scan is None:
            return job
        piece = pieces.of(keyframe.id)
        if piece != self._piece:
            self._piece, self._before = piece, None
            self._finder.forget()
        others = [s for s in submaps.finished if submaps.piece_of(s) != piece]
        return ScanJoiningJob(self, job, keyframe, others) if others else job

    def last(self) -> "ScanClosingJob | None":
        """Read what the last keyframe left to do."""
        return self._closer.last()

    def search(self, keyframe: Keyframe, others: Sequence[Submap]) -> _Finding | None:
        """Search for a keyframe, or go on with one before, in submaps of other pieces."""
        assert keyframe.scan is not None
        scan = self._beams.points(keyframe.scan)
        if len(scan) < self._config.min_hits:
            return None
        found: Recognised | str = self._finder.anywhere(others, scan, self._config.lost_submaps)
        if isinstance(found, str):
            return None
        submap, match = found
        count = round(match.on_walls * len(scan))
        return _Finding(keyframe.id, submap, match.x_grid_body, match.information, count)

    def join(self, found: _Finding, map: Map) -> tuple[Loop, ...]:
        """Keep where a keyframe was found, and make two pieces one if another says the same."""
        pieces, before = self._submaps.pieces, self._before
        here, there = pieces.of(found.keyframe_id), self._submaps.piece_of(found.submap)
        if here == there:
            return ()
        is_other = before is None or self._submaps.piece_of(before.submap) != there
        if before is None or is_other or found.keyframe_id - before.keyframe_id < APART:
            self._before = found if is_other else before
            return ()
        said, again = self._motion(before, map), self._motion(found, map)
        x = to_plane(map.T_world_body(found.keyframe_id))
        apart = between_planar(compose_planar(said, x), compose_planar(again, x))
        moved = float(np.hypot(*(compose_planar(again, x) - x)[:2]))
        turned = abs(float(again[2]))
        T = from_plane(found.x_anchor_keyframe)
        ends = found.keyframe_id, found.submap.anchor_id
        loop = Loop(*ends, T, found.num_on_walls, True, "", True, moved, turned)
        if np.hypot(*apart[:2]) > AGREE[0] or abs(apart[2]) > AGREE[1]:
            self._before = found
            reason = f"{np.hypot(*apart[:2]):.1f} m from where another keyframe was found"
            return (replace(loop, is_accepted=False, reason=reason, merges=False),)
        newer = max(here, there)
        by = again if newer == here else between_planar(again, np.zeros(3))
        self._move(newer, by, map)
        for tie in (before, found):
            information = lift_information(tie.information)
            T = from_plane(tie.x_anchor_keyframe)
            map.add_edge(tie.submap.anchor_id, tie.keyframe_id, T, information, LOOP)
            self._closer.expect()
        pieces.join(here, there)
        self._before = None
        first = replace(
            loop,
            keyframe_id=before.keyframe_id,
            matched_id=before.submap.anchor_id,
            T_matched_keyframe=from_plane(before.x_anchor_keyframe),
            num_inliers=before.num_on_walls,
            merges=False,
        )
        return (first, loop)

    def _motion(self, found: _Finding, map: Map) -> Array:
        """Return C (3,): how the piece of a keyframe is to be moved."""
        x_anchor = to_plane(map.T_world_body(found.submap.anchor_id))
        x = to_plane(map.T_world_body(found.keyframe_id))
        return compose_planar(
            compose_planar(x_anchor, found.x_anchor_keyframe), between_planar(x, np.zeros(3))
        )

    def _move(self, piece: int, by: Array, map: Map) -> None:
        """Move all keyframes of a piece."""
        pieces, ids = self._submaps.pieces, map.keyframe_ids
        moved = ids[[pieces.of(k) == piece for k in ids.tolist()]]
        root = int(ids.min())
        map.apply(
            Update(
                anchor_id=root,
                T_world_anchor=map.T_world_body(root),
                keyframe_ids=moved,
                Ts_world_body=from_plane(by) @ map.Ts_world_body(moved),
                landmark_ids=np.zeros(0, np.int64),
                points_world=np.zeros((0, 3)),
                version=map.version,
            )
        )


@dataclass(frozen=True, eq=False)
class ScanJoiningJob:
    """A keyframe to be searched for in other pieces, and what the closer has to do."""

    joiner: ScanJoiner
    closing: ScanClosingJob | None
    keyframe: Keyframe
    others: Sequence[Submap]

    def solve(self) -> "ScanJoiningChange":
        """Search and solve."""
        closing = None if self.closing is None else self.closing.solve()
        return ScanJoiningChange(
            self.joiner, closing, self.joiner.search(self.keyframe, self.others)
        )


class ScanJoiningChange:
    """What was found about a keyframe, in its piece and in others.

    Args:
        joiner: who asked.
        closing: what the closer found.
        found: where the keyframe is in another piece.

    Attributes:
        loops: what was decided on; of pieces, when it is written.
    """

    def __init__(
        self, joiner: ScanJoiner, closing: ScanClosingChange | None, found: _Finding | None
    ) -> None:
        self._joiner, self._closing, self._found = joiner, closing, found
        self.loops: tuple[Loop, ...] = () if closing is None else closing.loops

    def write(self, map: Map) -> None:
        """Write what the closer found, and join."""
        if self._closing is not None:
            self._closing.write(map)
        if self._found is not None:
            self.loops += self._joiner.join(self._found, map)
