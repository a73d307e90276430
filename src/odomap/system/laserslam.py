"""SLAM with a 2D laser, with or without the odometry of wheels.

    scan → ScanTracker → estimate;   keyframes → Submaps;   keyframe → ScanJoiner → path corrected

The tracker lays every scan onto a submap of the last keyframes (`scantracking`, `submaps`), the
closer searches for keyframes in the submaps of earlier and solves the graph of all (`scanclosing`).
Keyframes keep their scans, so that a grid of everything is made anew whenever somebody asks for it,
with the path as it is known then.

Reference: W. Hess, D. Kohler, H. Rapp, D. Andor, "Real-time loop closure in 2D LIDAR SLAM", ICRA
2016.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from odomap.errors import CalibrationError, ConfigError
from odomap.lidar.scans import Beams
from odomap.maps.map import Map
from odomap.sensors.rig import LidarMount, Rig
from odomap.system.config import Config, preset
from odomap.system.path import Path
from odomap.system.scantracking import ScanTracker
from odomap.system.stages import Closer, Stages
from odomap.system.submaps import Submaps
from odomap.system.system import System

if TYPE_CHECKING:
    from odomap.vision.vocabulary import VocabularyTree

__all__ = ["LaserSlam"]


class LaserSlam(System):
    """Simultaneous localisation and mapping with the first 2D laser of a rig.

    Args:
        rig: with a 2D laser.
        config: sections for all parts; default the preset "lidar2d".
        rhythm: which thread runs what; see `rhythms`.
        map: a map to go on with; default a new one.
        is_mapping: whether the map is changed.
        vocabulary: of no use to a laser.

    Attributes:
        submaps: the grids that scans are laid onto.

    Raises:
        CalibrationError: the rig has no 2D laser.
        ConfigError: there is no such rhythm.
    """

    def __init__(
        self,
        rig: Rig,
        config: Config | None = None,
        rhythm: str = "inline",
        map: Map | None = None,
        is_mapping: bool = True,
        vocabulary: "VocabularyTree | None" = None,
    ) -> None:
        if vocabulary is not None:
            raise ConfigError("vocabulary: a laser knows no words: leave it out")
        self._config = preset("lidar2d") if config is None else config
        self._beams = Beams(laser_of(rig), self._config.scan)
        self._is_mapping = is_mapping
        super().__init__(self._config.threads, rhythm, map)

    def _make_stages(self) -> Stages:
        config = self._config
        self.submaps = Submaps(self.map, config.submaps)
        self.submaps.restore(self._beams)
        parts = self.map, self._beams, self.submaps, config.scan_tracking
        self._tracker = ScanTracker(*parts, self._is_mapping)
        return Stages(self.map, self._tracker, None, self._closer() if self._is_mapping else None)

    def _closer(self) -> Closer | None:
        if not self._config.scan_closing.enabled:
            return None
        from odomap.system.scanclosing import ScanCloser  # what compiles pose graphs
        from odomap.system.scanjoining import ScanJoiner
        from odomap.system.scanthinning import ScanThinner

        parts, config = (self.map, self._beams, self.submaps), self._config
        closer = ScanCloser(*parts, config.scan_closing)
        joiner = ScanJoiner(*parts, config.scan_tracking, closer)
        if not config.scan_thinning.enabled:
            return joiner
        return ScanThinner(joiner, *parts, config.scan_thinning)

    @property
    def _path(self) -> Path:
        return self._tracker.path

    def _counts(self) -> Mapping[str, int]:
        """Return how many submaps there are."""
        return {"submaps": len(self.submaps.finished) + len(self.submaps.active)}


def laser_of(rig: Rig) -> LidarMount:
    """Return the first 2D laser of a rig.

    Raises:
        CalibrationError: it has none.
    """
    for mount in rig.lidars:
        if mount.angles[2] > 0:
            return mount
    raise CalibrationError("this rig has no 2D laser: its 'angles' say first, last, and how many")
