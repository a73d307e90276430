"""SLAM with a 3D LiDAR.

    sweep → front-end → CloudTracker → estimate;   keyframe → closer → path corrected

The tracker lays every sweep onto those before (`cloudtracking`). Keyframes keep their sweeps,
thinned out, so that the cloud of everything is made anew whenever somebody asks for it, with the
path as it is known then.

Reference: I. Vizzo et al., "KISS-ICP: in defense of point-to-point ICP", RA-L 8(2), 2023.
"""

from typing import TYPE_CHECKING, Any

from odomap.errors import CalibrationError, ConfigError
from odomap.lidar.featureconfig import LegoConfig, LoamConfig
from odomap.lidar.frontend import FrontEnd
from odomap.maps.map import Map
from odomap.sensors.rig import LidarMount, Rig
from odomap.system.cloudrecognition import CloudFinder
from odomap.system.cloudtracking import CloudTracker
from odomap.system.cloudview import CloudViewer
from odomap.system.config import Config, preset
from odomap.system.path import Path
from odomap.system.stages import Closer, Stages
from odomap.system.system import System

if TYPE_CHECKING:
    from odomap.vision.vocabulary import VocabularyTree

__all__ = ["CloudSlam", "lidar_of"]


class CloudSlam(System):
    """Simultaneous localisation and mapping with the first 3D LiDAR of a rig.

    Args:
        rig: with a 3D LiDAR.
        config: sections for all parts; default the preset "lidar".
        rhythm: which thread runs what; see `rhythms`.
        map: a map to go on with; default a new one.
        is_mapping: whether the map is changed.
        vocabulary: of no use to a LiDAR.

    Raises:
        CalibrationError: the rig has no 3D LiDAR.
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
            raise ConfigError("vocabulary: a LiDAR knows no words: leave it out")
        self._config = preset("lidar") if config is None else config
        self._mount = lidar_of(rig)
        self._is_mapping = is_mapping
        super().__init__(self._config.threads, rhythm, map)

    def _make_stages(self) -> Stages:
        config = self._config.cloud_tracking
        front_end = self._front_end()
        viewer = CloudViewer(self._mount, front_end, config)
        sections = self._config.cloud_recognition, self._config.cloud_closing
        finder = CloudFinder(self.map, viewer.T_body_lidar, *sections)
        parts = self.map, viewer, front_end, finder, config
        self._tracker = CloudTracker(*parts, self._is_mapping)
        return Stages(self.map, self._tracker, None, self._closer() if self._is_mapping else None)

    def _closer(self) -> Closer | None:
        if not self._config.cloud_closing.enabled:
            return None
        from odomap.system.cloudclosing import CloudCloser  # what compiles pose graphs
        from odomap.system.cloudthinning import CloudThinner

        config = self._config
        closer = CloudCloser(self.map, self._mount.T_body_lidar.matrix, config.cloud_closing)
        if not config.cloud_thinning.enabled:
            return closer
        return CloudThinner(closer, config.cloud_thinning)

    def _front_end(self) -> FrontEnd[Any]:
        """Return what lays sweeps onto each other; only what is chosen is imported and compiled."""
        config, name = self._config, self._config.cloud_tracking.front_end
        rules, T_body_lidar = (
            (config.curvature, config.feature_map),
            self._mount.T_body_lidar.matrix,
        )
        if name == "loam":
            from odomap.lidar.loam import LoamFrontEnd

            return LoamFrontEnd(LoamConfig(*rules), T_body_lidar)
        if name == "lego":
            from odomap.lidar.lego import LegoFrontEnd

            return LegoFrontEnd(LegoConfig(*rules, config.ground), T_body_lidar)
        from odomap.lidar.planefrontend import PlaneFrontEnd

        return PlaneFrontEnd(config.points)

    @property
    def _path(self) -> Path:
        return self._tracker.path


def lidar_of(rig: Rig) -> LidarMount:
    """Return the first 3D LiDAR of a rig.

    Raises:
        CalibrationError: it has none.
    """
    for mount in rig.lidars:
        if mount.angles[2] == 0:
            return mount
    raise CalibrationError("this rig has no 3D LiDAR")
