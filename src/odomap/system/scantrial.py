"""A place on trial: where a scan was recognised, and whether the scans after it belong there.

Corridors, and rooms of one plan, fit each other for a scan, and for the next. But they are not the
same for long: a door is missing, a niche is too many, and beams end where they cannot. So the place
that was recognised is believed when scans have fitted it for a while, moving along as those of a
body that is there would; until then nothing is added to the map, and what was known before is held
to be gone back to.

Reference: D. Fox, W. Burgard, S. Thrun, "Markov localization for mobile robots in dynamic
environments", JAIR 11, 1999 (hypotheses of where a body is, told apart as it goes).
"""

import numpy as np

from odomap.lidar.fusion import fused
from odomap.lidar.gridmatching import GridMatch
from odomap.lidar.scans import ScanPoints
from odomap.system.scanconfig import ScanTrackingConfig
from odomap.system.scanjudging import ScanJudge
from odomap.system.submaps import Submap, Submaps

__all__ = ["ScanTrial"]


class ScanTrial:
    """Watches whether a body is where it was recognised.

    Args:
        submaps: of the map.
        judge: says how scans lie there.
        config: how long, and what they must show.

    Attributes:
        submap: in which it was recognised; None where nothing is on trial.
        scans: how many have been watched.
        was_lost: whether the body was lost before.
    """

    def __init__(self, submaps: Submaps, judge: ScanJudge, config: ScanTrackingConfig) -> None:
        self._submaps, self._judge, self._config = submaps, judge, config
        self.submap: Submap | None = None
        self.scans, self.was_lost = 0, False

    @property
    def left(self) -> int:
        """How many scans more must fit."""
        return self._config.known_scans - self.scans

    def begin(self, submap: Submap, match: GridMatch, was_lost: bool) -> None:
        """Go on in a submap; those that grow are held."""
        sure = fused(np.eye(3), match.information)
        self._submaps.try_in(submap, match.x_grid_body, sure)
        self.submap, self.scans, self.was_lost = submap, 0, was_lost

    def watch(self, scan: ScanPoints, is_measured: bool) -> GridMatch | None:
        """Lay the next scan; return how it lies, None if it does not and the trial is over."""
        said = self._judge.match(self._submaps.active[0], scan, is_measured)
        self.scans += 1
        match = said.match
        if match is None or said.is_doubtful or match.on_walls < self._config.known_on_walls:
            self.end()
            return None
        self._submaps.place(match.x_grid_body, match.information)
        return match

    def end(self) -> Submap | None:
        """Go back to the submaps that grow; return the one on trial."""
        self._submaps.go_back()
        submap, self.submap = self.submap, None
        return submap
