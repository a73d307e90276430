"""Where in a map a scan was taken, when nothing is known of it: every submap is searched.

Branch and bound over all of a submap, in all directions, is quick once a good pose is known: what
the best submap so far gave bounds the next. It may take a while all the same, so a scan is searched
for in some submaps at a time, beside the scans that follow it; the one that came last when all are
done is then matched near where the first one was found.

One scan cannot tell places that look the same, and a corridor looks the same all along. So a place
is not believed

    if another submap fits nearly as well somewhere else,
    if this one does, turned by more than half a radian,
    if it does after the walls that the scan lies on were taken out,
    if the scan does not fix the place, or many beams contradict it,

and the body has to go on until it sees something that is there once. Even then it is watched for
some scans whether the place stays what it seems to be (`scantracking`).

Cost: some 50 ms for each submap.

Reference: W. Hess, D. Kohler, H. Rapp, D. Andor, "Real-time loop closure in 2D LIDAR SLAM", ICRA
2016, section V.
"""

from collections import OrderedDict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.planar import between_planar, from_plane, to_plane, transform_planar
from odomap.lidar.branchbound import Found, GridPyramid
from odomap.lidar.grid import OccupancyGrid, beside
from odomap.lidar.gridmatching import GridMatch, lay_on_grid
from odomap.lidar.scans import ScanPoints
from odomap.maps.map import Map
from odomap.system.scanconfig import ScanTrackingConfig
from odomap.system.scanpieces import Pieces
from odomap.system.submaps import Submap

__all__ = ["Recognised", "ScanFinder"]

Array = NDArray[np.float64]
Recognised = tuple[Submap, GridMatch]
"""A submap, and how a scan lies in it."""

POINTS, NEARBY = 100, 8.0
"""Beams that are searched with, and how far they go if half of all go no further: the further, the
more headings there are to try."""
LEVELS = 7
"""Of the pyramids: windows are as large as submaps."""
NEARLY = 0.9
"""Share of the best score that is nearly as good."""
SAME = 1.0, 0.5
"""How far apart poses may be that are of one place, metres and radians."""
TAKEN_OUT = 3
"""Cells around a scan that are taken out with it."""
PYRAMIDS = 12
"""Submaps whose pyramids are kept."""
AGAIN = 1.0
"""How far the body may have turned while a scan was searched for, radians."""


class ScanFinder:
    """Finds scans in the submaps of a map, some of them at a time.

    Args:
        map: where the submaps are.
        pieces: of the map.
        config: what a scan must show to be recognised.

    Attributes:
        rounds: how often all submaps were searched in vain since it was last told to forget.
        best: what came nearest when all were searched, believed or not.
    """

    def __init__(self, map: Map, pieces: Pieces, config: ScanTrackingConfig) -> None:
        self._map, self._pieces, self._config = map, pieces, config
        self._pyramids: OrderedDict[tuple[int, int], GridPyramid] = OrderedDict()
        self.forget()

    def forget(self) -> None:
        """Give up what is being searched for."""
        self._sought: ScanPoints | None = None
        self._left: list[Submap] = []
        self._found: list[tuple[Submap, Found]] = []
        self.rounds = 0
        self.best: Recognised | None = None

    def near(
        self, submap: Submap, scan: ScanPoints, x: Array, reach: float, turn: float
    ) -> GridMatch | None:
        """Find a scan around a pose in a submap.

        Args:
            submap: where to search.
            scan: with some hits.
            x: (3,) the middle of what is searched.
            reach: how far from there in x and y, metres.
            turn: how far in heading, radians.

        Returns:
            How it lies there; None if it does not.
        """
        config = self._config
        found = self.best_near(submap, scan, x, reach, turn, config.lost_score)
        if found is None:
            return None
        match = self._laid(submap, found, scan)
        is_there = match.on_walls >= config.few_on_walls and _is_free_of_doubt(
            submap, scan, match, config.known_in_free
        )
        return match if is_there else None

    def best_near(
        self, submap: Submap, scan: ScanPoints, x: Array, reach: float, turn: float, score: float
    ) -> Found | None:
        """Return the best pose around a pose (3,) in a submap, if it is as good as that."""
        return self._pyramid(submap).search(scan.hits, x, reach, turn, score)

    def anywhere(
        self, submaps: Sequence[Submap], scan: ScanPoints, most: int | None = None
    ) -> Recognised | str:
        """Find a scan in any submap, or go on with finding one that came before.

        Args:
            submaps: where to search, when a search begins.
            scan: the newest one, with some hits.
            most: submaps that are searched now; None for all.

        Returns:
            The submap that it fits, and how it lies there; or why it is in none so far.
        """
        if self._sought is None:
            self._sought, self._left, self._found = scan, list(submaps), []
        sought = _thinned(self._sought)
        for _ in range(len(self._left) if most is None else most):
            if self._left:
                self._search(self._left.pop(), sought)
        if self._left:
            return f"{len(self._left)} submaps are still to be searched"
        first, self._sought = self._sought, None
        found = self._decided(sought, first, scan, len(submaps))
        if isinstance(found, str):
            self.rounds += 1
        return found

    def _search(self, submap: Submap, sought: Array) -> None:
        best = max((found.score for _, found in self._found), default=0.0)
        least = max(self._config.known_score, NEARLY * best)
        found = self._searched(self._pyramid(submap), submap, sought, 0.0, np.pi, least)
        if found is not None:
            self._found.append((submap, found))

    def _searched(
        self, pyramid: GridPyramid, submap: Submap, sought: Array, heading: float, turn: float,
        least: float,
    ) -> Found | None:  # fmt: skip
        middle = np.array([*submap.middle, heading])
        return pyramid.search(sought, middle, submap.radius, turn, least)

    def _decided(
        self, sought: Array, first: ScanPoints, scan: ScanPoints, count: int
    ) -> Recognised | str:
        """Say where the last scan is, after all submaps were searched for the first."""
        config = self._config
        self.best = None
        if not self._found:
            return f"in none of {count} submaps {config.known_score:.0%} of the scan meet walls"
        most = max(found.score for _, found in self._found)
        laid = [
            (submap, self._laid(submap, found, first))
            for submap, found in self._found
            if found.score >= NEARLY * most
        ]
        submap, match = self.best = max(laid, key=lambda place: place[1].on_walls)
        likely = [place for place in laid if self._is_likely(*place, first, match.on_walls)]
        if not likely:
            return f"where {match.on_walls:.0%} of the beams meet walls, others contradict it"
        submap, match = self.best = max(likely, key=lambda place: place[1].on_walls)
        if doubt := self._looks_like_another(likely, first, NEARLY * most):
            return doubt
        if scan is not first:
            window = match.x_grid_body, config.lost_reach, AGAIN
            again = self.near(submap, scan, *window)
            if again is None or again.on_walls < config.known_on_walls:
                return "what was recognised is not what is seen now"
            match = again
        weakest = float(np.linalg.eigvalsh(match.information[:2, :2])[0])
        if weakest * config.known_sigma**2 < 1.0:
            return "it shows no place, but a corridor"
        return submap, match

    def _laid(self, submap: Submap, found: Found, scan: ScanPoints) -> GridMatch:
        return lay_on_grid(scan, submap.grid, found.x_grid_body)

    def _is_likely(self, submap: Submap, match: GridMatch, scan: ScanPoints, best: float) -> bool:
        """Say whether a scan may have been taken in a place, beside one of so much on walls."""
        is_on_walls = match.on_walls >= max(self._config.known_on_walls, NEARLY * best)
        in_free = self._config.known_in_free
        return is_on_walls and _is_free_of_doubt(submap, scan, match, in_free)

    def _looks_like_another(
        self, likely: Sequence[Recognised], scan: ScanPoints, least: float
    ) -> str:
        """Say that another place looks nearly the same as the best; empty if none does."""
        assert self.best is not None
        submap, match = self.best
        here, piece = self._in_world(*self.best), self._pieces.of(submap.anchor_id)
        for other in likely:  # how a piece lies to another is not known
            is_known = self._pieces.of(other[0].anchor_id) == piece
            if is_known and not _is_same(here, self._in_world(*other)):
                return "it looks like two places"
        x, sought = match.x_grid_body, _thinned(scan)
        walls = transform_planar(x, np.concatenate([scan.hits, scan.between]))
        rest = GridPyramid(_without(submap.grid, walls), LEVELS)
        window = submap, sought, float(x[2]) + np.pi
        back = self._searched(self._pyramid(submap), *window, np.pi - SAME[1], least)
        beyond = self._searched(rest, *window, np.pi, least)
        for found, words in ((back, "the same in another direction"), (beyond, "like two places")):
            if found is None:
                continue
            if self._is_likely(submap, self._laid(submap, found, scan), scan, match.on_walls):
                return f"it looks {words}"
        return ""

    def is_one_place(self, one: Recognised, other: Recognised) -> bool:
        """Say whether two findings are of one place."""
        return _is_same(self._in_world(*one), self._in_world(*other))

    def _in_world(self, submap: Submap, match: GridMatch) -> Array:
        return to_plane(self._map.place(submap.anchor_id, from_plane(match.x_grid_body)))

    def _pyramid(self, submap: Submap) -> GridPyramid:
        """Return the pyramid of a submap as it is now; those used last are kept."""
        key = submap.anchor_id, len(submap.keyframe_ids)
        pyramid = self._pyramids.pop(key, None) or GridPyramid(submap.grid, LEVELS)
        self._pyramids[key] = pyramid
        if len(self._pyramids) > PYRAMIDS:
            self._pyramids.popitem(last=False)
        return pyramid


def _is_same(x: Array, y: Array) -> bool:
    """Say whether two poses (3,) are of one place."""
    apart = between_planar(x, y)
    return bool(np.hypot(*apart[:2]) <= SAME[0] and abs(apart[2]) <= SAME[1])


def _is_free_of_doubt(submap: Submap, scan: ScanPoints, match: GridMatch, in_free: float) -> bool:
    """Say whether nearly no beam ends in the open, or behind a wall."""
    hits, sensor = (
        transform_planar(match.x_grid_body, points) for points in (scan.hits, scan.origin[None])
    )
    against = submap.grid.share_against(sensor[0], hits)
    return against <= in_free * (against + match.on_walls)


def _thinned(scan: ScanPoints) -> Array:
    """Return some of the points, (n, 2)."""
    near = scan.hits[np.linalg.norm(scan.hits, axis=1) < NEARBY]
    chosen = near if 2 * len(near) >= len(scan) else scan.hits
    rows = np.linspace(0, len(chosen) - 1, min(POINTS, len(chosen))).astype(np.int64)
    return np.ascontiguousarray(chosen[rows])


def _without(grid: OccupancyGrid, points: Array) -> OccupancyGrid:
    """Return a grid without what is near points (N, 2)."""
    x, y = np.floor((points - grid.origin) / grid.resolution).astype(np.int64).T
    height, width = grid.log_odds.shape
    is_in = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    taken = np.zeros(grid.log_odds.shape, np.bool_)
    taken[y[is_in], x[is_in]] = True
    for _ in range(TAKEN_OUT):
        taken = beside(taken)
    left = np.where(taken, 0.0, grid.log_odds).astype(np.float32)
    return OccupancyGrid.of(left, grid.origin, grid.resolution, grid.evidence)
