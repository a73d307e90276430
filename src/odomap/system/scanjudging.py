"""Laying a scan where the body should be, and saying whether that can be.

A scan fits if enough of its beams meet walls. Few do on new ground, but what they say of the ground
that is known agrees: none ends in the open, none comes from behind a wall. Where as many do as meet
walls, the body is somewhere else.

    fits          on walls ≥ 25 %, and half of the beams, or more than contradict the map
    new ground    fewer, but hardly any contradicts it
    elsewhere     the others

A corridor fits on another. Who is carried from one to the other sees that some of the beams
contradict the map from one scan to the next, and go on to do so; people and doors do that, too, but
they come and go by and by. So it is only a doubt, and only where it came suddenly it is searched
for a place that fits better.

Reference: W. Burgard, D. Fox, S. Thrun, "Active mobile robot localization by entropy minimization",
EUROBOT 1997 (telling from the map what a scan cannot be).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.geometry.planar import between_planar, transform_planar
from odomap.lidar.correlative import search_near
from odomap.lidar.gridmatching import GridMatch, lay_on_grid
from odomap.lidar.scans import ScanPoints
from odomap.system.scanconfig import ScanTrackingConfig
from odomap.system.scanrecognition import Recognised, ScanFinder
from odomap.system.submaps import Submap

__all__ = ["Judgement", "ScanJudge"]

Array = NDArray[np.float64]

CLEAN = 0.4
"""Part of what makes a scan doubtful up to which nothing contradicts it."""
HELD, ROUNDS = 15, 2
"""Scans for which a doubt holds back keyframes, and how often all places are searched for it."""
SURPRISE = 9.0
"""Squared standard deviations off odometry from which on it is asked whether that is true."""
MORE_ON_WALLS = 0.05
"""Share of the beams that must meet walls elsewhere, and not where odometry leads."""
SIGMAS = 3.0
"""Standard deviations of where the body should be that are searched."""


@dataclass(frozen=True, eq=False)
class Judgement:
    """How a scan lies where the body should be.

    Attributes:
        match: None where it does not.
        reason: why.
        is_doubtful: whether so much contradicts it that the body may be somewhere else.
        is_clean: whether hardly anything does.
        doubted: (3, 3) by how much odometry seems to be wrong; None where it is believed.
    """

    match: GridMatch | None
    reason: str
    is_doubtful: bool = False
    is_clean: bool = False
    doubted: Array | None = None


class ScanJudge:
    """Lays scans onto the submap that the body is in.

    Args:
        config: when one fits.
        finder: searches further away.

    Attributes:
        doubts: scans in a row that were doubtful, since one of which nothing was.
        was_clean: whether hardly anything contradicted the last scan that fitted without a doubt.
    """

    def __init__(self, config: ScanTrackingConfig, finder: ScanFinder) -> None:
        self._config, self._finder = config, finder
        self.doubts, self.was_clean = 0, True

    @property
    def is_settled(self) -> bool:
        """Whether there is no doubt, or it has lasted for long and nothing better was found."""
        return self.doubts == 0 or self.doubts > HELD or self._finder.rounds >= ROUNDS

    def match(self, submap: Submap, scan: ScanPoints, is_measured: bool) -> Judgement:
        """Lay a scan where the body should be.

        Args:
            submap: with the body in it.
            scan: with some hits.
            is_measured: whether the motion was; if not, poses around are tried first.
        """
        config, x, prior = self._config, submap.x_anchor_body, _prior(submap.covariance)
        if not is_measured:
            x = search_near(submap.grid, scan.hits, x, config.search, config.search_rad)
        match, doubted = lay_on_grid(scan, submap.grid, x, prior, submap.x_anchor_body), None
        off = between_planar(submap.x_anchor_body, match.x_grid_body)
        if is_measured and (match.on_walls < config.few_on_walls or off @ prior @ off > SURPRISE):
            match, doubted = self._match_anew(submap, scan, match)
        against = _against(submap, scan, match.x_grid_body)
        shown = f"only {match.on_walls:.0%} of {len(scan)} beams meet walls that are known"
        if match.on_walls < config.min_on_walls:
            return Judgement(None, shown)
        if match.on_walls < config.few_on_walls and against > match.on_walls:
            return Judgement(None, f"{shown}, {against:.0%} end in the open or behind walls")
        share = against / (against + match.on_walls)
        is_doubtful = share > config.doubtful
        return Judgement(match, shown, is_doubtful, share < CLEAN * config.doubtful, doubted)

    def _match_anew(
        self, submap: Submap, scan: ScanPoints, match: GridMatch
    ) -> tuple[GridMatch, Array | None]:
        """Look for a scan as if there was no odometry, as wheels slip, and some logs have it of
        another instant; stay with a match unless clearly more of the scan meets walls elsewhere."""
        config, grid, expected = self._config, submap.grid, submap.x_anchor_body
        x = search_near(grid, scan.hits, expected, config.slip_m, config.slip_rad)
        wide = np.diag([config.slip_m, config.slip_m, config.slip_rad]) ** 2
        prior = _prior(submap.covariance + wide)
        again = lay_on_grid(scan, grid, x, prior, expected)
        if max(again.on_walls, match.on_walls) < config.few_on_walls:
            window = expected, 2.0 * config.slip_m, 3.0 * config.slip_rad
            found = self._finder.best_near(submap, scan, *window, config.min_on_walls)
            if found is not None:
                farther = lay_on_grid(scan, grid, found.x_grid_body, prior, expected)
                again = max(again, farther, key=lambda each: each.on_walls)
        if again.on_walls < match.on_walls + MORE_ON_WALLS:
            return match, None
        return again, wide

    def around(self, submap: Submap, scan: ScanPoints, is_measured: bool) -> GridMatch | None:
        """Find a scan around where the body should be, as far as that is unsure; else None."""
        config = self._config
        reach, turn = config.lost_reach, np.pi
        if is_measured:
            sigma = np.sqrt(np.diag(submap.covariance))
            reach = min(SIGMAS * float(sigma[:2].max()) + config.search, config.lost_reach)
            turn = min(SIGMAS * float(sigma[2]) + config.search_rad, np.pi)
        near = self._finder.near(submap, scan, submap.x_anchor_body, reach, turn)
        if near is None or not is_measured:
            return near
        # Along a corridor any place is as good: the motion that was measured says which.
        prior = _prior(submap.covariance), submap.x_anchor_body
        return lay_on_grid(scan, submap.grid, near.x_grid_body, *prior)

    def elsewhere(
        self, places: Sequence[Submap], submap: Submap, scan: ScanPoints, said: Judgement
    ) -> Recognised | None:
        """Find a place that a scan fits better than where it was laid, after doubts in a row.

        Args:
            places: submaps in which the body may be.
            submap: in which it was laid.
            scan: with some hits.
            said: how it lies there.
        """
        is_sudden = self.was_clean or self.doubts > 0
        self.doubts = self.doubts + 1 if said.is_doubtful and is_sudden else 0
        self.was_clean = said.is_clean
        is_over = self._finder.rounds >= ROUNDS or self.doubts < self._config.patience
        if said.match is None or is_over:
            return None
        finder, laid = self._finder, (submap, said.match)
        found = finder.anywhere(places, scan, self._config.lost_submaps)
        if finder.best is not None and finder.is_one_place(finder.best, laid):
            finder.rounds = ROUNDS
        elif not isinstance(found, str) and found[1].on_walls > said.match.on_walls:
            return found
        return None

    def contradicts(self, submap: Submap, scan: ScanPoints) -> bool:
        """Say whether a scan cannot have been taken where the body should be."""
        return _against(submap, scan, submap.x_anchor_body) > self._config.doubtful


def _prior(covariance: Array) -> Array:
    return np.asarray(np.linalg.inv(covariance))


def _against(submap: Submap, scan: ScanPoints, x: Array) -> float:
    hits, sensor = (transform_planar(x, points) for points in (scan.hits, scan.origin[None]))
    return submap.grid.share_against(sensor[0], hits)
