"""Visual odometry: the path of a stereo pair, a single camera, or a camera with depth.

Two stages share a map: the tracker places every frame against the last keyframe (`tracking`), the
mapper adjusts the window of the last keyframes whenever there is a new one (`mapping`). What is
remembered hangs from keyframes, so an adjusted window moves the frames that hang from it.

    vo = StereoVO(source.rig)
    for frame in source:
        estimate = vo.track(frame)
    vo.finish().trajectory

Cost: flow of some 300 points per frame; detection, stereo and one bundle adjustment per keyframe.

Reference: Nistér, Naroditsky, Bergen, "Visual Odometry", CVPR 2004.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from odomap.errors import CalibrationError, ConfigError
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.geometry.trajectory import Trajectory
from odomap.maps.estimate import Estimate
from odomap.maps.map import Map
from odomap.sensors.frame import Frame
from odomap.sensors.rig import Rig
from odomap.system.config import Config, make_association, preset
from odomap.system.eye import Eye
from odomap.system.keyframing import Keyframes
from odomap.system.mapping import WindowMapper
from odomap.system.ranging import DepthRanger, Ranger, StereoRanger
from odomap.system.rhythms import make_worker
from odomap.system.stages import Stages
from odomap.system.starting import OneViewStart, Start, TwoViewsStart
from odomap.system.tracking import Tracker
from odomap.vision.rectifier import Rectifier

__all__ = ["MonocularVO", "Odometry", "Result", "RgbdVO", "StereoVO", "make_odometry"]


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
    """

    trajectory: Trajectory
    trajectory_live: Trajectory
    keyframes: Trajectory
    map: Map
    is_metric: bool = True
    T_body_tracked: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))

    def truth(self, truth: Trajectory) -> Trajectory:
        """Return a ground truth of the body as one of what was tracked."""
        return Trajectory(truth.stamps_ns, truth.Ts_world_body @ self.T_body_tracked)


class Odometry:
    """What the odometries of all cameras have in common.

    Attributes:
        map: keyframes and landmarks.
        worker: runs the stages; its lists of observers are told of estimates and keyframes.
    """

    def __init__(self, eye: Eye, ranger: Ranger | None, config: Config, rhythm: str) -> None:
        self.map = Map()
        self._is_metric, self._T_body_tracked = ranger is not None, np.eye(4)
        association = make_association(config, eye.mask)
        keyframes = Keyframes(self.map, eye, ranger, association, config)
        start: Start = OneViewStart(keyframes, association, config)
        if ranger is None:
            start = TwoViewsStart(self.map, eye, keyframes, association, config)
        self._tracker = Tracker(self.map, eye, association, keyframes, start, config)
        depth = (1.0, 0.0) if ranger is None else (ranger.sigma, ranger.calibration)
        mapper = WindowMapper(
            self.map,
            eye.T_body_camera,
            eye.camera,
            config.window,
            config.bundle,
            config.noise,
            *depth,
        )
        stages = Stages(self.map, self._tracker, mapper)
        self.worker = make_worker(rhythm, stages, config.threads)

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
        path = self._tracker.path
        return Result(
            path.trajectory(),
            path.trajectory_live(),
            path.keyframes(),
            self.map,
            self._is_metric,
            self._T_body_tracked,
        )


class StereoVO(Odometry):
    """Visual odometry of a stereo pair: metric.

    Args:
        rig: with two cameras.
        config: sections for all parts; default the preset "stereo".
        rhythm: which thread runs what; see `rhythms`.

    Raises:
        CalibrationError: if the rig has no plausible stereo pair.
        ConfigError: if there is no such rhythm.
    """

    def __init__(self, rig: Rig, config: Config | None = None, rhythm: str = "inline") -> None:
        config = preset("stereo") if config is None else config
        rectifier = Rectifier(rig)
        ranger = StereoRanger.of(rig, rectifier, config.stereo, config.noise.calibration_px)
        super().__init__(Eye.of_pair(rig, rectifier), ranger, config, rhythm)


class MonocularVO(Odometry):
    """Visual odometry of a single camera: the camera is the body, the scale is free but constant.

    Poses are in units of the scene's median depth at the start. Frames before the second view have
    no pose when they come, and get one when tracking has started.

    Args:
        camera: its lens; the first image of a frame is looked at.
        config: sections for all parts; default the preset "mono".
        rhythm: which thread runs what; see `rhythms`.
        T_body_camera: its mount on a rig, which a result tells; poses are the camera's anyway.

    Raises:
        ConfigError: if there is no such rhythm, or the configuration does not follow candidates.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | None = None,
        rhythm: str = "inline",
        T_body_camera: SE3 | None = None,
    ) -> None:
        config = preset("mono") if config is None else config
        if not config.candidates.follow:
            raise ConfigError(
                "candidates.follow: false, but a single camera gets its landmarks that way alone: "
                "set it true, or take the preset mono"
            )
        super().__init__(Eye.of_camera(camera), None, config, rhythm)
        if T_body_camera is not None:
            self._T_body_tracked = np.array(T_body_camera.matrix)


class RgbdVO(Odometry):
    """Visual odometry of a camera with a registered depth image: metric.

    Args:
        rig: with a camera and a depth image.
        config: sections for all parts; default the preset "rgbd".
        rhythm: which thread runs what; see `rhythms`.

    Raises:
        CalibrationError: if the rig has no depth image.
        ConfigError: if there is no such rhythm.
    """

    def __init__(self, rig: Rig, config: Config | None = None, rhythm: str = "inline") -> None:
        config = preset("rgbd") if config is None else config
        if rig.depth is None:
            raise CalibrationError("RGB-D needs 'depth' in the rig: camera, factor, invalid values")
        mount = rig.camera(rig.depth.camera)
        eye = Eye.of_camera(mount.camera, rig.cameras.index(mount), mount.T_body_camera)
        super().__init__(eye, DepthRanger(eye, config.depth), config, rhythm)


def make_odometry(rig: Rig, config: Config, rhythm: str = "inline") -> Odometry:
    """Return the odometry that a configuration asks for.

    Args:
        rig: what there is.
        config: `tracking.sensors` says which of it is used.
        rhythm: which thread runs what; see `rhythms`.

    Raises:
        CalibrationError: the rig does not carry that.
    """
    if config.tracking.sensors == "stereo":
        return StereoVO(rig, config, rhythm)
    if config.tracking.sensors == "rgbd":
        return RgbdVO(rig, config, rhythm)
    if not rig.cameras:
        raise CalibrationError("this rig has no camera: monocular odometry needs one")
    mount = rig.cameras[0]
    return MonocularVO(mount.camera, config, rhythm, mount.T_body_camera)
