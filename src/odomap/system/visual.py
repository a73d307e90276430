"""A visual system: tracker, mapper and map put together for the cameras of a rig.

Odometry and SLAM look through the same eye and measure depth with the same ranger; what differs is
who tracks and who maps. Here is what they have in common.

Reference: Klein, Murray, "Parallel Tracking and Mapping for Small AR Workspaces", ISMAR 2007.
"""

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.maps.map import Map
from odomap.sensors.rig import Rig
from odomap.system.config import Config
from odomap.system.depthbias import DepthBias
from odomap.system.eye import Eye
from odomap.system.ranging import DepthRanger, Ranger, StereoRanger
from odomap.system.stages import Stages
from odomap.system.system import System
from odomap.system.uncertainty import Calibration, NoiseConfig
from odomap.vision.rectifier import Rectifier

__all__ = ["Sight", "VisualSystem"]


@dataclass(frozen=True, eq=False)
class Sight:
    """How a rig is looked through.

    Attributes:
        eye: the ideal camera that is tracked.
        ranger: measures depth beside its image; None for a single camera.
        T_body_tracked: (4, 4) where on the body that is what poses are of.
    """

    eye: Eye
    ranger: Ranger | None
    T_body_tracked: NDArray[np.float64]

    def depth_bias(self, noise: NoiseConfig) -> DepthBias:
        """Return what measured depths may be off by together, to be learnt."""
        calibration = 0.0 if self.ranger is None else self.ranger.calibration
        eye = self.eye
        known = Calibration.of(noise, eye.camera, eye.T_body_camera, calibration)
        return DepthBias(known.inverse_depth)

    @staticmethod
    def of(rig: Rig, config: Config) -> "Sight":
        """Return how a configuration looks through a rig.

        Raises:
            CalibrationError: the rig does not carry what `tracking.sensors` says.
        """
        if config.tracking.sensors == "stereo":
            return Sight.of_pair(rig, config)
        if config.tracking.sensors == "rgbd":
            return Sight.of_depth(rig, config)
        if not rig.cameras:
            raise CalibrationError("this rig has no camera: monocular odometry needs one")
        return Sight.of_camera(rig.cameras[0].camera, rig.cameras[0].T_body_camera)

    @staticmethod
    def of_pair(rig: Rig, config: Config) -> "Sight":
        """Return a stereo pair."""
        rectifier = Rectifier(rig)
        ranger = StereoRanger.of(rig, rectifier, config.stereo, config.noise.calibration_px)
        return Sight(Eye.of_pair(rig, rectifier), ranger, np.eye(4))

    @staticmethod
    def of_depth(rig: Rig, config: Config) -> "Sight":
        """Return a camera with a registered depth image."""
        if rig.depth is None:
            raise CalibrationError("RGB-D needs 'depth' in the rig: camera, factor, invalid values")
        mount = rig.camera(rig.depth.camera)
        eye = Eye.of_camera(mount.camera, rig.cameras.index(mount), mount.T_body_camera)
        return Sight(eye, DepthRanger(eye, config.depth), np.eye(4))

    @staticmethod
    def of_camera(camera: Camera, T_body_camera: SE3 | None = None) -> "Sight":
        """Return a single camera, which is the body; its mount only says which part of one."""
        mount = np.eye(4) if T_body_camera is None else np.array(T_body_camera.matrix)
        return Sight(Eye.of_camera(camera), None, mount)


class VisualSystem(System):
    """What odometry and SLAM with cameras have in common.

    Attributes:
        map: keyframes and landmarks.
        worker: runs the stages; its lists of observers are told of estimates and keyframes.
    """

    def __init__(self, sight: Sight, config: Config, rhythm: str, map: Map | None = None) -> None:
        self._sight, self._config = sight, config
        super().__init__(config.threads, rhythm, map)

    def _make_stages(self) -> Stages:
        return self._stages(self._sight, self._config)

    @abstractmethod
    def _stages(self, sight: Sight, config: Config) -> Stages:
        """Make the agents that share the map."""

    @property
    def _is_metric(self) -> bool:
        return self._sight.ranger is not None

    @property
    def _T_body_tracked(self) -> NDArray[np.float64]:
        return self._sight.T_body_tracked
