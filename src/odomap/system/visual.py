"""A visual system: tracker, mapper and map put together for the cameras of a rig.

Odometry and SLAM look through the same eye and measure depth with the same ranger; what differs is
who tracks and who maps. Here is what they have in common:

    frame → Tracker.track → Estimate → caller;  keyframe → Mapper → map;  finish → Result

Reference: Klein, Murray, "Parallel Tracking and Mapping for Small AR Workspaces", ISMAR 2007.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.geometry.trajectory import Trajectory
from odomap.maps.estimate import Estimate
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig
from odomap.system.config import Config
from odomap.system.depthbias import DepthBias
from odomap.system.eye import Eye
from odomap.system.path import Path
from odomap.system.ranging import DepthRanger, Ranger, StereoRanger
from odomap.system.rhythms import make_worker
from odomap.system.stages import Loop, Stages
from odomap.system.uncertainty import Calibration, NoiseConfig
from odomap.vision.rectifier import Rectifier

__all__ = ["Result", "Sight", "VisualSystem"]


@dataclass(frozen=True)
class Result:
    """What a run leaves.

    Attributes:
        trajectory: T_world_body of all placed frames as known at the end, with covariances.
        trajectory_live: the frames that could be placed when they came, as they were emitted.
        keyframes: the keyframes among the frames, as known at the end.
        map: keyframes and landmarks.
        is_metric: whether lengths are metres; if not, their unit is the run's own.
        T_body_tracked: (4, 4) where on the body that is what the poses are of: the identity, or
            the mount of a single camera, whose path without a scale cannot carry the lever arm.
        mapping: what local mapping did, counts by name; empty for odometry.
        loops: places that were taken for ones seen before, accepted or not, in order.
    """

    trajectory: Trajectory
    trajectory_live: Trajectory
    keyframes: Trajectory
    map: Map
    is_metric: bool = True
    T_body_tracked: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    mapping: Mapping[str, int] = field(default_factory=dict)
    loops: tuple[Loop, ...] = ()

    def truth(self, truth: Trajectory) -> Trajectory:
        """Return a ground truth of the body as one of what was tracked."""
        return Trajectory(truth.stamps_ns, truth.Ts_world_body @ self.T_body_tracked)


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


class VisualSystem(ABC):
    """What odometry and SLAM have in common.

    Attributes:
        map: keyframes and landmarks.
        worker: runs the stages; its lists of observers are told of estimates and keyframes.
    """

    def __init__(self, sight: Sight, config: Config, rhythm: str, map: Map | None = None) -> None:
        self.map = Map() if map is None else map
        self._sight = sight
        stages = self._stages(sight, config)
        self.worker = make_worker(rhythm, stages, config.threads)
        self._loops: list[Loop] = []
        self.worker.on_loop.append(self._loops.append)

    @abstractmethod
    def _stages(self, sight: Sight, config: Config) -> Stages:
        """Make the agents that share the map."""

    @property
    @abstractmethod
    def _path(self) -> Path:
        """The frames placed so far."""

    def track(self, frame: Frame) -> Estimate:
        """Place one frame.

        Args:
            frame: the next one in time.

        Returns:
            Where the body is, how sure that is, and why not if it is lost.

        Raises:
            CalibrationError: images or depth cannot be what the rig says.
            KeyboardInterrupt: Ctrl-C was pressed meanwhile; the frame is done all the same.
        """
        return self.worker.track(frame)

    def finish(self) -> Result:
        """Return the path as known at the end; tracking may go on afterwards."""
        self.worker.finish()
        self._come_to_rest()
        return Result(
            self._path.trajectory(),
            self._path.trajectory_live(),
            self._path.keyframes(),
            self.map,
            self._sight.ranger is not None,
            self._sight.T_body_tracked,
            self._counts(),
            tuple(self._loops),
        )

    def _come_to_rest(self) -> None:
        """Do what is left when nobody changes the map any more."""
        return

    def _counts(self) -> Mapping[str, int]:
        """Return what the mapper did, by name."""
        return {}
